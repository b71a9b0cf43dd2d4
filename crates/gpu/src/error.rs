//! Errors of jobs on devices.

use molmesh_surface::{Exceeded, SurfaceError};
use thiserror::Error;

/// Reason why a device did not finish a job.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum GpuError {
    /// The job itself is invalid, exceeds a limit, was cancelled or is late; the device works.
    #[error(transparent)]
    Surface(#[from] SurfaceError),
    /// The device has too little memory, even in chunks.
    #[error("the device has too little memory: {0}")]
    OutOfMemory(Box<Exceeded>),
    /// The device was lost; the job may succeed on the rebuilt device.
    #[error("the device was lost: {0}")]
    Lost(String),
    /// The device made no progress; the job may succeed elsewhere.
    #[error("the device hung: it made no progress for {after_ms} ms")]
    Hung {
        /// Time limit, ms.
        after_ms: u64,
    },
    /// The graphics API rejected a call, or a result is inconsistent: a defect of this program or of the driver.
    #[error("the device failed: {0}")]
    Failed(String),
    /// No device accepts jobs any more.
    #[error("no device is up: {0}")]
    NoDevice(String),
}

impl GpuError {
    /// Returns true if the device caused the error, so that the job may succeed elsewhere.
    #[must_use]
    pub const fn is_device_failure(&self) -> bool {
        !matches!(self, Self::Surface(_))
    }
}
