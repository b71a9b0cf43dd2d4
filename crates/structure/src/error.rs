//! Errors of reading structures and selecting atoms. Messages name the location and the expected content.

use molmesh_surface::{Exceeded, OutOfMemory};
use thiserror::Error;

/// Errors of reading and selecting.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum StructureError {
    /// The bytes are not in a supported format.
    #[error(
        "unknown structure format: {found}; expected PDB, mmCIF, BinaryCIF, PQR or XYZ, plain or compressed with \
         gzip or zstd"
    )]
    UnknownFormat {
        /// Description of the first bytes.
        found: String,
    },
    /// A line could not be read.
    #[error("line {line}, column {column}: found {found}, expected {expected}")]
    Syntax {
        /// Line, from 1.
        line: u64,
        /// Column, from 1.
        column: u64,
        /// The content found there.
        found: String,
        /// The expected content.
        expected: String,
    },
    /// A binary file could not be read.
    #[error("{location}: found {found}, expected {expected}")]
    Malformed {
        /// Location, from the outside in: format, category, column, then encoding, row (from 1) or byte (from 0).
        location: String,
        /// The content found there.
        found: String,
        /// The expected content.
        expected: String,
    },
    /// The input failed.
    #[error("cannot read the file: {reason}")]
    Input {
        /// Message of the system.
        reason: String,
    },
    /// The temporary file failed.
    #[error("cannot use the temporary file of the index of atoms: {reason}")]
    Scratch {
        /// Message of the system.
        reason: String,
    },
    /// The disk of the temporary file is full.
    #[error("the disk of the temporary file is full")]
    DiskFull,
    /// Other temporary files use the disk space; a later attempt may succeed.
    #[error("{}", disk_space(.0))]
    DiskSpace(OutOfMemory),
    /// The file cannot be read as a stream.
    #[error(
        "cannot read the file as a stream: found {found}, expected {expected}; it can be read if it fits into memory"
    )]
    NotAStream {
        /// The content found there.
        found: String,
        /// The expected content.
        expected: &'static str,
    },
    /// Compressed data is broken.
    #[error("cannot decompress {encoding}: {reason}")]
    Decompress {
        /// `gzip` or `zstd`.
        encoding: &'static str,
        /// Message of the decoder.
        reason: String,
    },
    /// A limit is exceeded.
    #[error(transparent)]
    Limit(#[from] Box<Exceeded>),
    /// The requested assembly is invalid in the file.
    #[error("assembly {id}: found {found}, expected {expected}")]
    BadAssembly {
        /// Id of the assembly.
        id: String,
        /// The content found in the file.
        found: String,
        /// The expected content.
        expected: String,
    },
    /// The atoms cannot be divided by entity.
    #[error(
        "parameter `split`: `entity` cannot be applied: the file does not assign chains to entities; only mmCIF and \
         BinaryCIF files can; expected none, chain or residue-group"
    )]
    NoEntities,
    /// Not enough memory is available.
    #[error(transparent)]
    Memory(#[from] OutOfMemory),
    /// The caller cancelled.
    #[error("cancelled")]
    Cancelled,
    /// The file holds no atoms.
    #[error("no atoms: {found}")]
    NoAtoms {
        /// Description of the content.
        found: String,
    },
    /// The selection is empty. The message lists the contents of the file and the parameters that select them.
    #[error("the selection holds no atoms: {holds}")]
    EmptySelection {
        /// Contents of the file and the parameters that select them.
        holds: String,
    },
    /// The requested model, chain, alternative location or assembly does not exist.
    #[error("{what} {requested} is not in the file; it has {available}")]
    NotFound {
        /// `model`, `chain`, `selected chain` (of an expression), `interface chain`, `alternative location` or
        /// `assembly`.
        what: &'static str,
        /// The requested value.
        requested: String,
        /// The available values.
        available: String,
    },
}

/// Describes which temporary files use the disk space.
fn disk_space(error: &OutOfMemory) -> String {
    let OutOfMemory::Budget { held, limit, .. } = error else { return error.to_string() };
    format!("temporary files take {held} of {limit} bytes of disk space, and indexes of other tilesets are in use")
}
