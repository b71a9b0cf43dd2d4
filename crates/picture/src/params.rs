//! Parameters of pictures.

use std::fmt;
use std::str::FromStr;

use molmesh_surface::{Exceeded, Limit, named};

use super::PictureError;

/// Default width and height, pixels.
pub const DEFAULT_SIDE: u32 = 512;
/// Maximum width and height, pixels: a texture size that all devices support.
pub const MAX_SIDE: u32 = 16_384;
/// Maximum working memory per pixel, bytes: depth, light, normal and colour, twice on a device.
const PIXEL_BYTES: u64 = 40;

/// Direction of view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum View {
    /// Along the smallest principal axis of the surface; the largest is horizontal.
    #[default]
    Principal,
    /// From +z in file coordinates; x points right, y up.
    Front,
    /// From −z.
    Back,
    /// From −x.
    Left,
    /// From +x.
    Right,
    /// From +y.
    Top,
    /// From −y.
    Bottom,
}

named!(View, Principal => "principal", Front => "front", Back => "back", Left => "left", Right => "right",
    Top => "top", Bottom => "bottom");

/// Style of shading.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Style {
    /// Gouraud shading, with ambient occlusion and a soft outline.
    #[default]
    Surface,
    /// Gouraud shading only: light per vertex, interpolated.
    Gouraud,
}

named!(Style, Surface => "surface", Gouraud => "gouraud");

/// Colour of the background: red, green, blue (sRGB) and alpha, not premultiplied.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Background(pub [u8; 4]);

impl Background {
    /// Transparent.
    pub const TRANSPARENT: Self = Self([0; 4]);
    /// White.
    pub const WHITE: Self = Self([255; 4]);
    /// Black.
    pub const BLACK: Self = Self([0, 0, 0, 255]);
    /// Syntax, for messages.
    pub const EXPECTED: &'static str = "transparent, white, black, or a colour as RRGGBB or RRGGBBAA in hexadecimal";
}

impl FromStr for Background {
    type Err = ();

    fn from_str(text: &str) -> Result<Self, ()> {
        match text {
            "transparent" => return Ok(Self::TRANSPARENT),
            "white" => return Ok(Self::WHITE),
            "black" => return Ok(Self::BLACK),
            _ => {}
        }
        let digits = text.strip_prefix('#').unwrap_or(text);
        if !matches!(digits.len(), 6 | 8) || !digits.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(());
        }
        let mut color = [255; 4];
        for (k, channel) in color.iter_mut().enumerate().take(digits.len() / 2) {
            *channel = u8::from_str_radix(&digits[2 * k..2 * k + 2], 16).map_err(|_not_hex| ())?;
        }
        Ok(Self(color))
    }
}

impl fmt::Display for Background {
    /// Formats the colour with its alpha; equal for equal backgrounds regardless of their spelling.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::TRANSPARENT => f.write_str("transparent"),
            Self([r, g, b, 255]) => write!(f, "#{r:02x}{g:02x}{b:02x}"),
            Self([r, g, b, a]) => write!(f, "#{r:02x}{g:02x}{b:02x}{a:02x}"),
        }
    }
}

/// Limits of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PictureLimits {
    /// Maximum width and height, pixels.
    pub max_side: u32,
}

impl Default for PictureLimits {
    fn default() -> Self {
        Self { max_side: MAX_SIDE }
    }
}

/// Parameters of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PictureParams {
    /// Width in pixels, 1 to [`MAX_SIDE`].
    pub width: u32,
    /// Height in pixels, 1 to [`MAX_SIDE`].
    pub height: u32,
    /// Direction of view.
    pub view: View,
    /// Rotation of the viewer to the right about the vertical axis of the view, degrees.
    pub azimuth: f64,
    /// Rotation of the viewer upwards after the azimuth, degrees.
    pub elevation: f64,
    /// Background.
    pub background: Background,
    /// Style of shading.
    pub style: Style,
}

impl Default for PictureParams {
    fn default() -> Self {
        Self {
            width: DEFAULT_SIDE,
            height: DEFAULT_SIDE,
            view: View::default(),
            azimuth: 0.0,
            elevation: 0.0,
            background: Background::default(),
            style: Style::default(),
        }
    }
}

impl PictureParams {
    /// Checks the sides against the limits.
    ///
    /// # Errors
    /// [`PictureError::Limit`].
    pub fn check(&self, limits: PictureLimits) -> Result<(), PictureError> {
        for (limit, pixels) in [(Limit::PictureWidth, self.width), (Limit::PictureHeight, self.height)] {
            if pixels > limits.max_side {
                let error = Exceeded::new(limit, limits.max_side.into());
                return Err(Exceeded { actual: Some(pixels.into()), ..error }.error());
            }
        }
        Ok(())
    }

    /// Bytes of working memory for drawing, without the mesh.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height) * PIXEL_BYTES
    }

    /// Canonical text of the parameters: equal for equal pictures.
    #[must_use]
    pub fn canonical(&self) -> String {
        let Self { width, height, view, azimuth, elevation, background, style } = self;
        let (view, style) = (view.name(), style.name());
        // Adding 0 turns −0 into 0.
        let (azimuth, elevation) = (azimuth + 0.0, elevation + 0.0);
        format!(
            "width={width}&height={height}&view={view}&azimuth={azimuth}&elevation={elevation}\
             &background={background}&style={style}"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn backgrounds_are_read_in_every_spelling() {
        for (text, expected) in [
            ("transparent", Some([0, 0, 0, 0])),
            ("white", Some([255; 4])),
            ("#FFffFF", Some([255; 4])),
            ("black", Some([0, 0, 0, 255])),
            ("1020ff80", Some([16, 32, 255, 128])),
            ("#1020ff", Some([16, 32, 255, 255])),
            ("#00000000", Some([0; 4])),
            ("", None),
            ("#", None),
            ("red", None),
            ("#12345", None),
            ("#1234567", None),
            ("##123456", None),
            ("+12345", None),
            ("12345é", None),
        ] {
            assert_eq!(text.parse().ok(), expected.map(Background), "{text}");
        }
        assert_eq!(Background([255; 4]).to_string(), "#ffffff");
        assert_eq!("#00000000".parse::<Background>().map(|b| b.to_string()), Ok("transparent".to_owned()));
        assert_eq!(Background([1, 2, 3, 4]).to_string(), "#01020304");
    }

    #[test]
    fn a_side_may_be_as_long_as_the_limit_and_no_longer() {
        let limits = PictureLimits { max_side: 100 };
        let of = |width, height| PictureParams { width, height, ..PictureParams::default() }.check(limits);
        assert_eq!(of(100, 100), Ok(()));
        let error = |limit| Exceeded { actual: Some(101), ..Exceeded::new(limit, 100) }.error();
        assert_eq!(of(101, 1), Err(error(Limit::PictureWidth)));
        assert_eq!(of(1, 101), Err(error(Limit::PictureHeight)));
    }

    #[test]
    fn canonical_texts_differ_where_pictures_do() {
        let plain = PictureParams::default();
        let mut all = [
            plain,
            PictureParams { width: 100, ..plain },
            PictureParams { height: 100, ..plain },
            PictureParams { view: View::Front, ..plain },
            PictureParams { azimuth: 1.0, ..plain },
            PictureParams { elevation: 1.0, ..plain },
            PictureParams { background: Background::WHITE, ..plain },
            PictureParams { style: Style::Gouraud, ..plain },
        ]
        .iter()
        .map(PictureParams::canonical)
        .collect::<Vec<_>>();
        assert_eq!(all[0], PictureParams { azimuth: -0.0, ..plain }.canonical());
        all.sort_unstable();
        all.dedup();
        assert_eq!(all.len(), 8);
    }
}
