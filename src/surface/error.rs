//! Why a surface could not be made. Each variant carries the numbers that a caller needs to do better.

use thiserror::Error;

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
        /// `x`, `y`, `z` or `radius`.
        what: &'static str,
        /// The offending value.
        value: f64,
        /// What was expected, in words.
        expected: &'static str,
    },
    /// A parameter is out of its range, or does not go with another one.
    #[error("parameter `{name}`: {value} is not allowed; expected {expected}")]
    BadParameter {
        /// The parameter's name as query, JSON and command line spell it.
        name: &'static str,
        /// The offending value as text.
        value: String,
        /// What was expected, in words.
        expected: String,
    },
    /// More grid samples than allowed would be needed.
    #[error(
        "the grid would need {samples} samples at {resolution} Å, the limit is {limit}; {suggested_resolution} Å would fit"
    )]
    GridTooLarge {
        /// Samples needed (a lower bound: counting stops soon after the limit).
        samples: u64,
        /// Samples allowed.
        limit: u64,
        /// The spacing asked for, in Å.
        resolution: f64,
        /// A spacing that would fit, in Å.
        suggested_resolution: f64,
    },
    /// The spheres would reach more grid bricks than allowed, all spheres together: they overlap each other too often.
    #[error(
        "the spheres would reach at least {candidates} grid bricks in total at {resolution} Å, the limit is {limit}; {}",
        suggested_resolution
            .map_or_else(|| "a coarser grid or smaller radii reach fewer".to_owned(), |h| format!("{h} Å would fit"))
    )]
    TooManyCandidates {
        /// Pairs of a sphere and a brick (a lower bound: counting stops soon after the limit).
        candidates: u64,
        /// Pairs allowed.
        limit: u64,
        /// The spacing asked for, in Å.
        resolution: f64,
        /// A spacing that is certain to fit, in Å, if one is.
        suggested_resolution: Option<f64>,
    },
    /// The mesh would take more bytes than allowed.
    #[error("the mesh would take {bytes} bytes, the limit is {limit}; {suggested_resolution} Å would fit")]
    MeshTooLarge {
        /// Bytes of vertices and triangles.
        bytes: u64,
        /// Bytes allowed.
        limit: u64,
        /// A spacing that would fit, in Å.
        suggested_resolution: f64,
    },
    /// No spacing that is coarse enough for a bound on triangles shows the surface.
    #[error("the mesh has {triangles} triangles at {resolution} Å, and no coarser one has {limit} or fewer")]
    TooManyTriangles {
        /// The fewest that were found.
        triangles: u64,
        /// Triangles asked for at most.
        limit: u64,
        /// Where they were found, Å.
        resolution: f64,
    },
    /// No sample reaches the isovalue.
    #[error("no sample of the grid reaches the isovalue {isovalue}: lower it, or refine the resolution")]
    NoSurface {
        /// The isovalue asked for.
        isovalue: f64,
    },
    /// Whoever takes the mesh part by part failed, and knows why.
    #[error("the mesh could not be handed on")]
    Sink,
    /// The device has too little memory for the mesh, even piece by piece.
    #[error("the device would need {needed} bytes of memory, it has {available}; {suggested_resolution} Å would fit")]
    DeviceMemory {
        /// Bytes needed.
        needed: u64,
        /// Bytes that the device can give.
        available: u64,
        /// A spacing that would fit, in Å.
        suggested_resolution: f64,
    },
    /// Every device that could have run the job failed, and nothing stands in for them.
    #[error("no device could run the job: {why}")]
    Device {
        /// What happened, in words.
        why: String,
    },
    /// The deadline passed.
    #[error("the deadline passed")]
    Deadline,
    /// The run was cancelled by its caller.
    #[error("cancelled")]
    Cancelled,
}
