//! Why a structure could not be read or selected from. Messages name the place and what was expected.

use thiserror::Error;

/// Errors of reading and selecting.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum StructureError {
    /// The bytes are no structure file that is read here.
    #[error(
        "unknown structure format: {found}; expected PDB, mmCIF or BinaryCIF, plain or compressed with gzip or zstd"
    )]
    UnknownFormat {
        /// What the first bytes look like.
        found: String,
    },
    /// A line could not be read.
    #[error("line {line}, column {column}: found {found}, expected {expected}")]
    Syntax {
        /// Line, from 1.
        line: u64,
        /// Column, from 1.
        column: u64,
        /// What stands there.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A binary file could not be read.
    #[error("{place}: found {found}, expected {expected}")]
    Malformed {
        /// Where, from the outside in: format, category, column, then encoding, row (from 1) or byte (from 0).
        place: String,
        /// What stands there.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// Compressed data is broken.
    #[error("cannot decompress {encoding}: {reason}")]
    Decompress {
        /// `gzip` or `zstd`.
        encoding: &'static str,
        /// The decoder's words.
        reason: String,
    },
    /// The input inflates to more bytes than allowed.
    #[error("the structure inflates to more than {limit} bytes")]
    InflatedTooLarge {
        /// Bytes allowed.
        limit: u64,
    },
    /// More atoms than allowed.
    #[error("the structure holds more than {limit} atoms")]
    TooManyAtoms {
        /// Atoms allowed.
        limit: u64,
    },
    /// The file holds no atoms.
    #[error("no atoms: {found}")]
    NoAtoms {
        /// What was there instead.
        found: String,
    },
    /// The selection is empty; the message says what the file holds and which flag takes it.
    #[error("the selection holds no atoms: {holds}")]
    EmptySelection {
        /// What the file holds and how to select it.
        holds: String,
    },
    /// A model or chain was asked for that the file does not have.
    #[error("{what} {asked} is not in the file; it has {available}")]
    NotFound {
        /// `model` or `chain`.
        what: &'static str,
        /// What was asked for.
        asked: String,
        /// What there is.
        available: String,
    },
}
