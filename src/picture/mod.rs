//! Pictures of meshes: a mesh and a view in, pixels and PNG out. Pure: no files, no clock, no graphics API.
//!
//! The projection is orthographic, so that lengths can be read off a picture: [`Rendered::pixel`] says how many ångström a
//! pixel has. [`camera`] decides from where, [`bins`] and [`raster`] find what is seen at four samples a pixel, [`finish`]
//! shades neighbourhoods and writes pixels, [`png`] packs them. [`cpu`] is these four as a [`Renderer`]; a device does the
//! same from the same numbers.
//!
//! Only sums in a fixed order and correctly rounded operations: the same mesh gives the same pixels on any number of threads.

mod axes;
mod bins;
pub mod camera;
pub mod cpu;
pub mod finish;
mod layers;
pub mod light;
mod params;
pub mod png;
mod raster;

use std::sync::Arc;

use thiserror::Error;

use crate::surface::{Control, Mesh, Served, SurfaceError, arithmetic};
pub use cpu::CpuRenderer;
pub use params::{Background, DEFAULT_SIDE, MOST_SIDE, PictureLimits, PictureParams, Style, View};

/// Why there is no picture.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PictureError {
    /// It would have too many pixels.
    #[error("the picture's {side} is {pixels} pixels, the limit is {limit}")]
    TooLarge {
        /// `width` or `height`.
        side: &'static str,
        /// Pixels asked for.
        pixels: u32,
        /// Pixels allowed.
        limit: u32,
    },
    /// Somebody asked the run to stop.
    #[error("cancelled")]
    Cancelled,
    /// Vertices as small integers are for files.
    #[error("quantised vertices cannot be drawn")]
    Quantized,
    /// A device could not draw it, and nothing stands in for it.
    #[error("no device could draw the picture: {why}")]
    Device {
        /// What it said.
        why: String,
    },
    /// The pixels cannot be packed.
    #[error("the picture cannot be written: {0}")]
    Png(String),
}

impl From<SurfaceError> for PictureError {
    fn from(error: SurfaceError) -> Self {
        match error {
            SurfaceError::Cancelled => Self::Cancelled,
            other => Self::Device { why: other.to_string() },
        }
    }
}

/// Pixels in rows from the top, each red, green, blue (sRGB) and alpha, not premultiplied.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Pixels of a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `width` × `height` pixels.
    pub pixels: Vec<[u8; 4]>,
}

impl Image {
    /// The pixel in column `x` of row `y`; transparent outside.
    #[must_use]
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 4] {
        let at = y as usize * self.width as usize + x as usize;
        if x < self.width { self.pixels.get(at).copied().unwrap_or_default() } else { [0; 4] }
    }
}

/// A picture, and who drew it.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendered {
    /// The pixels.
    pub image: Image,
    /// Å that a pixel is wide and high.
    pub pixel: f64,
    /// Who drew it, where that is known only afterwards: something stood in for a device.
    pub served: Option<Served>,
}

/// Draws meshes. The same mesh and parameters give the same pixels.
pub trait Renderer: Send + Sync {
    /// Short stable name: `cpu` or `gpu`.
    fn name(&self) -> &'static str;

    /// Name of the arithmetic: equal names give equal pixels for equal meshes.
    fn arithmetic(&self) -> String {
        format!("{} {}", self.name(), arithmetic())
    }

    /// What it runs on, for people.
    fn describe(&self) -> String;

    /// Draws `mesh`, whose vertices must not be quantised.
    ///
    /// # Errors
    /// Any [`PictureError`] but [`PictureError::Png`] and [`PictureError::TooLarge`], which are met before.
    fn render(&self, mesh: &Mesh, params: &PictureParams, control: &Control<'_>) -> Result<Rendered, PictureError>;
}

/// What draws, and why it was taken.
#[derive(Clone)]
pub struct Drawer {
    /// The renderer.
    pub renderer: Arc<dyn Renderer>,
    /// Why it was taken, in words.
    pub reason: String,
}

impl Drawer {
    /// The CPU, on rayon's pool.
    #[must_use]
    pub fn cpu(reason: &str) -> Self {
        Self { renderer: Arc::new(CpuRenderer::default()), reason: reason.to_owned() }
    }
}
