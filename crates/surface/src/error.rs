//! Errors of the meshing core. Each variant carries the numbers that a caller needs to adjust the request.

use thiserror::Error;

use super::memory::OutOfMemory;
use super::params::MAX_RESOLUTION;

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
    /// More grid points than allowed would be needed.
    #[error(
        "the grid would need about {grid_points} grid points at {resolution} Å, the limit is {limit}{}",
        fitting(*suggested_resolution)
    )]
    GridTooLarge {
        /// Estimated number of grid points.
        grid_points: u64,
        /// Grid points allowed.
        limit: u64,
        /// Requested spacing, Å.
        resolution: f64,
        /// A spacing that probably fits, in Å; infinite if there is none.
        suggested_resolution: f64,
    },
    /// The spheres would reach more grid bricks than allowed in total: too many of them overlap.
    #[error(
        "the spheres would reach at least {candidates} grid bricks in total at {resolution} Å, the limit is {limit}; {}",
        suggested_resolution
            .map_or_else(|| "a coarser grid or smaller radii reach fewer".to_owned(), |h| format!("{h} Å should fit"))
    )]
    TooManyCandidates {
        /// Pairs of a sphere and a brick (a lower bound: counting stops soon after the limit).
        candidates: u64,
        /// Pairs allowed.
        limit: u64,
        /// Requested spacing, Å.
        resolution: f64,
        /// A spacing that probably fits, in Å, if there is one.
        suggested_resolution: Option<f64>,
    },
    /// Too many pairs of spheres enlarged by the probe overlap.
    #[error(
        "at least {overlaps} pairs of spheres overlap when enlarged by the probe (64 comparisons of overlaps count as \
         a pair), the limit is {limit}; use a smaller probe or smaller radii"
    )]
    TooManyOverlaps {
        /// Ordered pairs of overlapping spheres; 64 comparisons of caps count as a pair. A lower bound, because
        /// counting stops soon after the limit.
        overlaps: u64,
        /// Pairs allowed.
        limit: u64,
    },
    /// The mesh would take more bytes than allowed.
    #[error("the mesh would take about {bytes} bytes, the limit is {limit}{}", fitting(*suggested_resolution))]
    MeshTooLarge {
        /// Estimated bytes of vertices and triangles.
        bytes: u64,
        /// Bytes allowed.
        limit: u64,
        /// A spacing that probably fits, in Å; infinite if there is none.
        suggested_resolution: f64,
    },
    /// The triangle limit cannot be met at any spacing that still shows the surface, or with the error of a
    /// simplification.
    #[error("{}; the limit is {limit}", simplify.map_or_else(
        || format!("the mesh has {triangles} triangles at the coarsest spacing, {resolution} Å"),
        |error| format!("the mesh has {triangles} triangles after simplification with an error of {error} Å"),
    ))]
    TooManyTriangles {
        /// Smallest number of triangles found.
        triangles: u64,
        /// Maximum number of triangles requested.
        limit: u64,
        /// Spacing with that number of triangles, Å.
        resolution: f64,
        /// Error of the simplification, Å; `None` if the spacing was searched.
        simplify: Option<f64>,
    },
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
    /// More grid points than allowed would be needed to search for pockets.
    #[error(
        "the search for pockets would need {grid_points} grid points at {spacing} Å, the limit is {limit}; a smaller \
         selection or pocket_probe needs fewer"
    )]
    PocketGridTooLarge {
        /// Points of the box around the molecule and the large probe.
        grid_points: u64,
        /// Grid points allowed.
        limit: u64,
        /// Spacing, Å.
        spacing: f64,
    },
    /// The search for pockets would pass over more rows of grid points than allowed.
    #[error(
        "the search for pockets would pass over {rows} rows of grid points in reach of the probes, the limit is \
         {limit}; select fewer atoms, or use smaller radii or a smaller pocket_probe"
    )]
    TooManyPocketRows {
        /// Rows of grid points of all spheres enlarged by the probes.
        rows: u64,
        /// Rows allowed.
        limit: u64,
    },
    /// A tileset would have too many tiles.
    #[error("the tileset would have more than {limit} tiles at {resolution} Å; a coarser grid needs fewer")]
    TooManyTiles {
        /// Tiles allowed.
        limit: u64,
        /// Spacing of the last level, Å.
        resolution: f64,
    },
    /// The index of a tileset is too large to be kept, and each tile would need it again.
    #[error(
        "the index of the tileset has more than {limit} bytes, the limit of the cache of structures{}",
        on_disk(*.parameter)
    )]
    TilesetTooLarge {
        /// Bytes allowed.
        limit: u64,
        /// Parameter because of which the index cannot be on disk.
        parameter: Option<&'static str>,
    },
    /// The sink of the mesh failed. It keeps the cause.
    #[error("the mesh sink failed")]
    Sink,
    /// The device has too little memory for the mesh, even piece by piece.
    #[error("the device would need {needed} bytes of memory, it has {available}{}", fitting(*suggested_resolution))]
    DeviceMemory {
        /// Bytes needed.
        needed: u64,
        /// Bytes available on the device.
        available: u64,
        /// A spacing that probably fits, in Å; infinite if there is none.
        suggested_resolution: f64,
    },
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
    /// Returns a grid spacing at which the job probably fits, Å, if the error is about a size and there is one. It is
    /// an estimate that errs on the coarse side. The job may still exceed another limit there.
    #[must_use]
    pub fn suggested_resolution(&self) -> Option<f64> {
        let spacing = match self {
            Self::GridTooLarge { suggested_resolution, .. }
            | Self::MeshTooLarge { suggested_resolution, .. }
            | Self::DeviceMemory { suggested_resolution, .. } => Some(*suggested_resolution),
            Self::TooManyCandidates { suggested_resolution, .. } => *suggested_resolution,
            _ => None,
        };
        spacing.filter(|spacing| *spacing <= MAX_RESOLUTION)
    }
}

/// Explains that a parameter needs an index in memory.
fn on_disk(parameter: Option<&str>) -> String {
    parameter.map_or_else(String::new, |name| {
        format!("; a larger index is on disk, but the parameter `{name}` needs all atoms in memory")
    })
}

/// Describes a grid spacing at which a job would fit.
fn fitting(spacing: f64) -> String {
    if spacing <= MAX_RESOLUTION {
        format!("; {spacing} Å should fit")
    } else {
        "; no coarser grid spacing is suggested".to_owned()
    }
}
