//! Error of a job.

use molmesh_formats::FormatError;
use molmesh_picture::PictureError;
use molmesh_structure::StructureError;
use molmesh_structure::map::MapError;
use molmesh_surface::{OutOfMemory, SurfaceError};
use thiserror::Error;

use super::ColorError;

/// Error of a job.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum JobError {
    /// Reading or selecting failed.
    #[error(transparent)]
    Structure(StructureError),
    /// Meshing failed.
    #[error(transparent)]
    Surface(#[from] SurfaceError),
    /// Drawing failed.
    #[error(transparent)]
    Picture(PictureError),
    /// The structure or the map lacks the values of the colour scheme.
    #[error(transparent)]
    Color(#[from] ColorError),
    /// Reading the map failed.
    #[error(transparent)]
    Map(MapError),
    /// The mesh cannot be compressed.
    #[error(transparent)]
    Format(#[from] FormatError),
}

impl JobError {
    /// Returns the name of the problem type with which the service answers.
    #[must_use]
    pub fn problem(&self) -> &'static str {
        match self {
            Self::Structure(error) => structure_problem(error),
            Self::Surface(error) => surface_problem(error),
            Self::Color(_) => "bad-parameter",
            Self::Map(_) => "unreadable-map",
            Self::Format(FormatError::Limit(error)) => error.limit.row().problem,
            Self::Picture(_) | Self::Format(_) => "internal",
        }
    }
}

fn structure_problem(error: &StructureError) -> &'static str {
    use StructureError as E;
    match error {
        E::Input { .. }
        | E::NotAStream { .. }
        | E::UnknownFormat { .. }
        | E::Syntax { .. }
        | E::Malformed { .. }
        | E::Decompress { .. }
        | E::BadAssembly { .. } => "unreadable-structure",
        E::NoAtoms { .. } => "no-atoms",
        E::EmptySelection { .. } | E::NotFound { .. } => "empty-selection",
        E::NoEntities => "bad-parameter",
        E::Limit(error) => error.limit.row().problem,
        E::Memory(error) | E::DiskSpace(error) => memory_problem(error),
        E::DiskFull => "store-full",
        E::Scratch { .. } => "internal",
        E::Cancelled => "shutting-down",
    }
}

fn surface_problem(error: &SurfaceError) -> &'static str {
    use SurfaceError as E;
    match error {
        E::NoSpheres => "no-atoms",
        E::BadSphere { .. } => "unreadable-structure",
        E::BadParameter { .. } => "bad-parameter",
        E::NoSurface { .. } | E::NoPatch | E::NoCavity { .. } => "no-surface",
        E::Limit(error) => error.limit.row().problem,
        E::Memory(error) => memory_problem(error),
        E::Device { .. } => "device-failed",
        E::Deadline => "deadline",
        E::Cancelled => "shutting-down",
        E::Sink => "internal",
    }
}

const fn memory_problem(error: &OutOfMemory) -> &'static str {
    match error {
        OutOfMemory::Budget { .. } | OutOfMemory::System { .. } => "memory-full",
        OutOfMemory::Share { .. } => "share-exceeded",
        OutOfMemory::Limit { .. } => "too-much-memory",
    }
}

impl From<StructureError> for JobError {
    fn from(error: StructureError) -> Self {
        match error {
            // Cancellation, lack of memory and exceeded limits are the same errors in all stages.
            StructureError::Cancelled => Self::Surface(SurfaceError::Cancelled),
            StructureError::Memory(error) => Self::Surface(error.into()),
            StructureError::Limit(error) => Self::Surface(error.into()),
            error => Self::Structure(error),
        }
    }
}

impl From<MapError> for JobError {
    fn from(error: MapError) -> Self {
        match error {
            MapError::Cancelled => Self::Surface(SurfaceError::Cancelled),
            MapError::Memory(error) => Self::Surface(error.into()),
            MapError::Limit(error) => Self::Surface(error.into()),
            error => Self::Map(error),
        }
    }
}

impl From<PictureError> for JobError {
    fn from(error: PictureError) -> Self {
        match error {
            PictureError::Cancelled => Self::Surface(SurfaceError::Cancelled),
            PictureError::Memory(error) => Self::Surface(error.into()),
            PictureError::Limit(error) => Self::Surface(error.into()),
            PictureError::Device { why } => Self::Surface(SurfaceError::Device { why }),
            error => Self::Picture(error),
        }
    }
}
