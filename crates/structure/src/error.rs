//! Errors of reading structures and selecting atoms. Messages name the location and the expected content.

use molmesh_surface::OutOfMemory;
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
    /// Temporary files would exceed their limit.
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
    /// The input decompresses to more bytes than allowed.
    #[error("the structure inflates to more than {limit} bytes")]
    InflatedTooLarge {
        /// Limit, bytes.
        limit: u64,
    },
    /// More atoms than allowed.
    #[error("the structure holds more than {limit} atoms")]
    TooManyAtoms {
        /// Limit, number of atoms.
        limit: u64,
    },
    /// More atoms of one model at the same position than allowed.
    #[error("more than {limit} atoms have the position {x}, {y}, {z}")]
    TooManyDuplicates {
        /// Limit, number of atoms.
        limit: u64,
        /// Coordinates, Å.
        x: f64,
        /// Coordinates, Å.
        y: f64,
        /// Coordinates, Å.
        z: f64,
    },
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
    /// The requested assembly has more copies than allowed.
    #[error("assembly {id} has more than {limit} copies of chains")]
    TooManyCopies {
        /// Id of the assembly.
        id: String,
        /// Limit, number of copies.
        limit: u64,
    },
    /// The requested assembly has more selected atoms than allowed.
    #[error("assembly {id} has {atoms} selected atoms, the limit is {limit}")]
    AssemblyTooLarge {
        /// Id of the assembly.
        id: String,
        /// Number of atoms.
        atoms: u64,
        /// Limit, number of atoms.
        limit: u64,
    },
    /// `within` would test more distances than allowed.
    #[error(
        "`within` tests more than {limit} distances between atoms, which is the limit; select fewer atoms after `of`, \
         or use a smaller distance"
    )]
    TooManyDistances {
        /// Limit, number of distances.
        limit: u64,
    },
    /// The selected atoms would be divided into more parts than allowed.
    #[error("{rule} divides the selected atoms into more than {limit} parts")]
    TooManyParts {
        /// Parameter that divides the atoms, such as `split=chain`.
        rule: &'static str,
        /// Limit, number of parts.
        limit: u64,
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

/// Describes that the limit of temporary files is reached.
fn disk_space(error: &OutOfMemory) -> String {
    match error {
        OutOfMemory::Limit { needed, limit } => {
            format!("the index of the atoms needs at least {needed} bytes of disk space and the limit is {limit}")
        }
        OutOfMemory::Budget { held, limit, .. } => {
            format!(
                "temporary files take {held} of {limit} bytes of disk space, and indexes of other tilesets are in use"
            )
        }
        OutOfMemory::Share { .. } | OutOfMemory::System { .. } => error.to_string(),
    }
}
