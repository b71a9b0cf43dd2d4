//! Why a job did not come back from a device.

use thiserror::Error;

use crate::surface::SurfaceError;

/// Errors of the GPU room.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum GpuError {
    /// The job's own fault, as on any backend; the device is well.
    #[error(transparent)]
    Surface(#[from] SurfaceError),
    /// The device has too little memory, even in tiles.
    #[error(
        "the device has too little memory: {needed} bytes are needed, {available} are there; {suggested_resolution} Å would fit"
    )]
    OutOfMemory {
        /// Bytes that the job's smallest tile and its output need.
        needed: u64,
        /// Bytes that the device can give.
        available: u64,
        /// A spacing that would fit, Å.
        suggested_resolution: f64,
    },
    /// The device went away; another attempt on a rebuilt device may work.
    #[error("the device was lost: {0}")]
    Lost(String),
    /// The job's deadline passed between two dispatches.
    #[error("the deadline passed")]
    Deadline,
    /// The graphics API refused what we asked for, or a result makes no sense: our mistake or the driver's.
    #[error("the device failed: {0}")]
    Failed(String),
    /// No device takes jobs any more.
    #[error("no device is up: {0}")]
    NoDevice(String),
}

impl GpuError {
    /// Whether the device is to blame: the same job may work elsewhere.
    #[must_use]
    pub const fn is_the_devices(&self) -> bool {
        !matches!(self, Self::Surface(_) | Self::Deadline)
    }
}
