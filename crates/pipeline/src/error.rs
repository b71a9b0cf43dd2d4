//! Error of a job.

use molmesh_formats::FormatError;
use molmesh_picture::PictureError;
use molmesh_structure::StructureError;
use molmesh_structure::map::MapError;
use molmesh_surface::SurfaceError;
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
