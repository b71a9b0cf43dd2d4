//! Pictures of meshes: pixels and PNG from a mesh and a view. Does not depend on files, clocks or a graphics API.
//!
//! The projection is orthographic, so lengths can be measured in a picture: [`Rendered::pixel`] is the width of a pixel
//! in Å. [`camera`] computes the view, `bins` and `raster` the visible surface at four samples per pixel,
//! [`finish`] shades the pixels, [`png`] encodes them. [`cpu`] combines these steps in a [`Renderer`]; a device
//! renderer uses the same parameters.
//!
//! All sums have a fixed order, so the same mesh gives the same pixels on any number of threads.

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

pub use cpu::CpuRenderer;
use molmesh_surface::{BackendIdentity, Control, Exceeded, Mesh, OutOfMemory, SurfaceError, arithmetic};
pub use params::{Background, DEFAULT_SIDE, MAX_SIDE, PictureLimits, PictureParams, Style, View};
pub use raster::MeshColumns;

/// Reason why a picture cannot be drawn.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PictureError {
    /// A limit is exceeded.
    #[error(transparent)]
    Limit(#[from] Box<Exceeded>),
    /// The run was cancelled.
    #[error("cancelled")]
    Cancelled,
    /// Not enough memory is available.
    #[error(transparent)]
    Memory(#[from] OutOfMemory),
    /// The vertices are quantized.
    #[error("quantized vertices cannot be drawn")]
    Quantized,
    /// The device failed, and there is no fallback.
    #[error("no device could draw the picture: {why}")]
    Device {
        /// Message of the device.
        why: String,
    },
    /// The pixels cannot be encoded.
    #[error("the picture cannot be written: {0}")]
    Png(String),
}

impl From<SurfaceError> for PictureError {
    fn from(error: SurfaceError) -> Self {
        match error {
            SurfaceError::Cancelled => Self::Cancelled,
            SurfaceError::Memory(error) => Self::Memory(error),
            SurfaceError::Limit(error) => Self::Limit(error),
            other => Self::Device { why: other.to_string() },
        }
    }
}

/// Image with pixels in rows from the top, each red, green, blue (sRGB) and alpha, not premultiplied.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Number of pixels per row.
    pub width: u32,
    /// Number of rows.
    pub height: u32,
    /// `width` × `height` pixels.
    pub pixels: Vec<[u8; 4]>,
}

impl Image {
    /// Returns the pixel in column `x` of row `y`; transparent outside the image.
    #[must_use]
    pub fn pixel(&self, x: u32, y: u32) -> [u8; 4] {
        let at = y as usize * self.width as usize + x as usize;
        if x < self.width { self.pixels.get(at).copied().unwrap_or_default() } else { [0; 4] }
    }
}

/// Picture with its scale and renderer.
#[derive(Debug, Clone, PartialEq)]
pub struct Rendered {
    /// Image.
    pub image: Image,
    /// Width and height of a pixel, Å.
    pub pixel: f64,
    /// Fallback that drew it instead of a device, if any.
    pub made_by: Option<BackendIdentity>,
}

/// Draws meshes. Equal meshes and parameters give equal pixels.
pub trait Renderer: Send + Sync {
    /// Stable short name: `cpu` or `gpu`.
    fn name(&self) -> &'static str;

    /// Name of the arithmetic. Equal names give equal pixels for equal meshes.
    fn arithmetic(&self) -> String {
        format!("{} {}", self.name(), arithmetic())
    }

    /// Description of the hardware, for display.
    fn describe(&self) -> String;

    /// Returns the identity of this renderer for the report of a picture.
    fn identity(&self) -> BackendIdentity {
        BackendIdentity::new(self.name(), self.arithmetic(), self.describe())
    }

    /// Draws `mesh`, whose vertices must not be quantized.
    ///
    /// # Errors
    /// Any [`PictureError`] but [`PictureError::Png`] and [`PictureError::Limit`], which are detected earlier.
    fn render(&self, mesh: &Arc<Mesh>, params: &PictureParams, control: &Control<'_>)
    -> Result<Rendered, PictureError>;
}

/// Renderer in use, with the reason for its choice.
#[derive(Clone)]
pub struct SelectedRenderer {
    /// Renderer.
    pub renderer: Arc<dyn Renderer>,
    /// Reason for the choice.
    pub reason: String,
}

impl SelectedRenderer {
    /// Returns the CPU renderer.
    #[must_use]
    pub fn cpu(reason: &str) -> Self {
        Self { renderer: Arc::new(CpuRenderer), reason: reason.to_owned() }
    }
}
