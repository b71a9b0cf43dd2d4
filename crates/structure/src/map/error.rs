//! Errors of reading maps.

use molmesh_surface::{Exceeded, Limit, OutOfMemory};
use thiserror::Error;

use crate::StructureError;

/// Errors of reading a map.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MapError {
    /// The bytes are not in a supported format.
    #[error(
        "unknown map format: the file begins with {found}; expected CCP4, MRC or OpenDX, plain or compressed with gzip \
         or zstd"
    )]
    UnknownFormat {
        /// The first bytes.
        found: String,
    },
    /// The content is invalid.
    #[error("the map cannot be read: {location}: found {found}, expected {expected}")]
    Malformed {
        /// Location: word and byte (from 0) of a binary file, or line (from 1).
        location: String,
        /// The content found there.
        found: String,
        /// The expected content.
        expected: String,
    },
    /// A limit is exceeded.
    #[error(transparent)]
    Limit(#[from] Box<Exceeded>),
    /// Compressed data is broken.
    #[error("cannot decompress the map, {encoding}: {reason}")]
    Decompress {
        /// `gzip` or `zstd`.
        encoding: &'static str,
        /// Message of the decoder.
        reason: String,
    },
    /// Not enough memory is available.
    #[error(transparent)]
    Memory(#[from] OutOfMemory),
    /// The caller cancelled.
    #[error("cancelled")]
    Cancelled,
}

impl From<StructureError> for MapError {
    /// Converts an error of decompression.
    fn from(error: StructureError) -> Self {
        match error {
            StructureError::Decompress { encoding, reason } => Self::Decompress { encoding, reason },
            StructureError::Limit(error) => Exceeded::new(Limit::MapBytes, error.max).error(),
            StructureError::Memory(error) => Self::Memory(error),
            StructureError::Cancelled => Self::Cancelled,
            other => Self::UnknownFormat { found: other.to_string() },
        }
    }
}
