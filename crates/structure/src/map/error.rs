//! Errors of reading maps.

use molmesh_surface::OutOfMemory;
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
    /// More points than allowed.
    #[error("the map has {points} points, the limit is {limit}")]
    TooManyPoints {
        /// Number of points.
        points: u64,
        /// Limit, number of points.
        limit: u64,
    },
    /// Compressed data is broken.
    #[error("cannot decompress the map, {encoding}: {reason}")]
    Decompress {
        /// `gzip` or `zstd`.
        encoding: &'static str,
        /// Message of the decoder.
        reason: String,
    },
    /// The input decompresses to more bytes than allowed.
    #[error("the map inflates to more than {limit} bytes")]
    InflatedTooLarge {
        /// Limit, bytes.
        limit: u64,
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
            StructureError::InflatedTooLarge { limit } => Self::InflatedTooLarge { limit },
            StructureError::Memory(error) => Self::Memory(error),
            StructureError::Cancelled => Self::Cancelled,
            other => Self::UnknownFormat { found: other.to_string() },
        }
    }
}
