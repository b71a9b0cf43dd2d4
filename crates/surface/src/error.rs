//! Errors of the meshing core. Each variant carries the numbers that a caller needs to adjust the request.

use thiserror::Error;

use super::limit::{Exceeded, Limit};
use super::memory::OutOfMemory;

/// Errors of the meshing core.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SurfaceError {
    /// There is nothing to mesh.
    #[error("no spheres to mesh")]
    NoSpheres,
    /// A sphere's centre or radius is not usable.
    #[error("sphere {index}: {what} is {value}, expected {expected}")]
    BadSphere {
        /// Index of the sphere in the input.
        index: usize,
        /// Name of the value: `x`, `y`, `z` or `radius`.
        what: &'static str,
        /// The offending value.
        value: f64,
        /// Description of valid values.
        expected: &'static str,
    },
    /// A parameter is out of its range, or conflicts with another one.
    #[error("parameter `{name}`: {value} is not allowed; expected {expected}")]
    BadParameter {
        /// The parameter's name as query, JSON and command line spell it.
        name: &'static str,
        /// The offending value as text.
        value: String,
        /// Description of valid values.
        expected: String,
    },
    /// A limit is exceeded.
    #[error(transparent)]
    Limit(#[from] Box<Exceeded>),
    /// No grid point lies inside the surface.
    #[error("{}", isovalue.map_or_else(
        || "no grid point lies inside the surface; a finer grid may have one".to_owned(),
        |level| format!("no grid point reaches the isovalue {level}; a lower isovalue or a finer grid may have a surface"),
    ))]
    NoSurface {
        /// Isovalue of the request, if the surface has one.
        isovalue: Option<f64>,
    },
    /// No triangle of the surface is nearest to a selected atom.
    #[error("no triangle of the surface of the whole structure is nearest to the selected atoms; they may be buried")]
    NoPatch,
    /// No component of the mesh encloses a cavity.
    #[error("no component of the mesh encloses a cavity; the atoms have {cavities} that hold a probe of {probe} Å")]
    NoCavity {
        /// Radius of the probe, Å.
        probe: f64,
        /// Number of cavities of the spheres.
        cavities: u64,
    },
    /// The sink of the mesh failed. It keeps the cause.
    #[error("the mesh sink failed")]
    Sink,
    /// Every device that could have run the job failed, and there is no fallback.
    #[error("no device could run the job: {why}")]
    Device {
        /// Description of the failure.
        why: String,
    },
    /// The deadline passed.
    #[error("the deadline passed")]
    Deadline,
    /// Not enough memory is available.
    #[error(transparent)]
    Memory(#[from] OutOfMemory),
    /// The run was cancelled by its caller.
    #[error("cancelled")]
    Cancelled,
}

impl SurfaceError {
    /// Returns the details if the error is that of exceeding `limit`.
    #[must_use]
    pub fn exceeded(&self, limit: Limit) -> Option<&Exceeded> {
        match self {
            Self::Limit(exceeded) if exceeded.limit == limit => Some(exceeded),
            _ => None,
        }
    }
}
