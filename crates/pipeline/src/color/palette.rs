//! Palettes of numeric schemes, interpolated between equidistant sRGB colours.
#![expect(clippy::unreadable_literal, reason = "colours are written as in style sheets")]

use molmesh_surface::named;

/// Colour as `0xRRGGBB`, sRGB.
pub(super) type Rgb = u32;

/// Value of the parameter `palette`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Palette {
    /// Dark blue to yellow, perceptually uniform.
    Viridis,
    /// Dark blue to yellow, looks the same with red-green colour blindness.
    Cividis,
    /// Low values blue, high values red.
    BlueWhiteRed,
    /// Low values red, high values blue.
    RedWhiteBlue,
}

named!(Palette, Viridis => "viridis", Cividis => "cividis", BlueWhiteRed => "blue-white-red",
    RedWhiteBlue => "red-white-blue");

impl Palette {
    /// Returns the colour at `t`, from 0 to 1.
    pub(super) fn at(self, t: f64) -> Rgb {
        match self {
            Self::Viridis => between(&VIRIDIS, t),
            Self::Cividis => between(&CIVIDIS, t),
            Self::BlueWhiteRed => between(&RED_TO_BLUE, 1.0 - t),
            Self::RedWhiteBlue => between(&RED_TO_BLUE, t),
        }
    }
}

/// Interpolates between equidistant colours. `t` is clamped to 0 to 1.
fn between(stops: &[Rgb], t: f64) -> Rgb {
    let position = t.clamp(0.0, 1.0) * (stops.len() - 1) as f64;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the table")]
    let lower = (position as usize).min(stops.len() - 2);
    let (part, low, high) = (position - lower as f64, stops[lower].to_be_bytes(), stops[lower + 1].to_be_bytes());
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "between two bytes")]
    let mixed = |k: usize| (f64::from(low[k]) + part * (f64::from(high[k]) - f64::from(low[k]))).round() as u8;
    u32::from_be_bytes([0, mixed(1), mixed(2), mixed(3)])
}

/// Every fifth of the 256 colours of `viridis` by S. van der Walt and N. Smith, in the public domain (CC0).
#[rustfmt::skip]
const VIRIDIS: [Rgb; 52] = [
    0x440154, 0x46085c, 0x471063, 0x481769, 0x481d6f, 0x482475, 0x472a7a, 0x46307e, 0x453781, 0x433d84,
    0x414287, 0x3f4889, 0x3d4e8a, 0x3a538b, 0x38598c, 0x355e8d, 0x33638d, 0x31688e, 0x2e6d8e, 0x2c718e,
    0x2a768e, 0x297b8e, 0x27808e, 0x25848e, 0x23898e, 0x218e8d, 0x20928c, 0x1f978b, 0x1e9c89, 0x1fa188,
    0x21a585, 0x24aa83, 0x28ae80, 0x2eb37c, 0x35b779, 0x3dbc74, 0x46c06f, 0x50c46a, 0x5ac864, 0x65cb5e,
    0x70cf57, 0x7cd250, 0x89d548, 0x95d840, 0xa2da37, 0xb0dd2f, 0xbddf26, 0xcae11f, 0xd8e219, 0xe5e419,
    0xf1e51d, 0xfde725,
];

/// Every fifth of the 256 colours of `cividis` by J. R. Nuñez, C. R. Anderton and R. S. Renslow, `PLoS` ONE 13,
/// e0199239 (2018), in the public domain (CC0).
#[rustfmt::skip]
const CIVIDIS: [Rgb; 52] = [
    0x00224e, 0x002656, 0x002a5f, 0x002d68, 0x003070, 0x083370, 0x163770, 0x203a6f, 0x273e6e, 0x2e416d,
    0x34456c, 0x3a486c, 0x3f4c6c, 0x444f6c, 0x49536c, 0x4e566c, 0x535a6d, 0x575d6d, 0x5c616e, 0x60646f,
    0x656870, 0x696b71, 0x6d6f72, 0x727274, 0x767676, 0x7a7a78, 0x7e7d78, 0x838179, 0x888578, 0x8d8878,
    0x928c78, 0x969077, 0x9b9476, 0xa09875, 0xa59c74, 0xaaa073, 0xafa471, 0xb5a86f, 0xbaac6d, 0xbfb06b,
    0xc4b468, 0xc9b965, 0xcfbd62, 0xd4c15f, 0xdac65b, 0xdfca57, 0xe5cf52, 0xead34c, 0xf0d846, 0xf6dd3f,
    0xfce236, 0xfee838,
];

/// `RdBu` with nine classes by C. A. Brewer, colorbrewer2.org, suitable for people with colour blindness.
const RED_TO_BLUE: [Rgb; 9] =
    [0xb2182b, 0xd6604d, 0xf4a582, 0xfddbc7, 0xf7f7f7, 0xd1e5f0, 0x92c5de, 0x4393c3, 0x2166ac];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn palettes_have_the_published_ends_and_middles() {
        // Colours 0, 128 and 255 of matplotlib; the middle of an even table lies between two of them.
        let near = |palette: Palette, t: f64, expected: Rgb| {
            let (found, expected) = (palette.at(t).to_be_bytes(), expected.to_be_bytes());
            assert!(found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 1), "{palette:?} {t}: {found:?}");
        };
        for (palette, colors) in [
            (Palette::Viridis, [0x440154, 0x21918c, 0xfde725]),
            (Palette::Cividis, [0x00224e, 0x7d7c78, 0xfee838]),
            (Palette::BlueWhiteRed, [0x2166ac, 0xf7f7f7, 0xb2182b]),
            (Palette::RedWhiteBlue, [0xb2182b, 0xf7f7f7, 0x2166ac]),
        ] {
            for (t, color) in [0.0, 128.0 / 255.0, 1.0].into_iter().zip(colors) {
                near(palette, t, color);
            }
            assert_eq!((palette.at(-1.0), palette.at(2.0)), (palette.at(0.0), palette.at(1.0)));
        }
    }
}
