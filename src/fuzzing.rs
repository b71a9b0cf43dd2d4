//! Private parsers for the targets of `molmesh-fuzz`. Not part of the library's interface.

use std::time::UNIX_EPOCH;

use crate::access::{self, KeyFileError, SignatureCheck, SigningKeys};
use crate::jobs::Record;
use crate::structure::{ReadLimits, Structure, StructureError};

/// Parses a key file.
///
/// # Errors
/// Returns the first error in the file.
pub fn key_file(text: &str) -> Result<(), KeyFileError> {
    access::parse_key_file(text, 60).map(drop)
}

/// Returns true if a path and query carry a valid signature at the start of 1970.
#[must_use]
pub fn has_valid_signature(keys: &SigningKeys, target: &str) -> bool {
    let (path, query) = target.split_once('?').map_or((target, None), |(path, query)| (path, Some(query)));
    matches!(keys.check(path, query, UNIX_EPOCH), SignatureCheck::Valid(_))
}

/// Reads a structure in at most `n` pieces.
///
/// # Errors
/// Returns the errors of [`crate::structure::read()`].
pub fn structure(bytes: &[u8], limits: &ReadLimits, n: usize) -> Result<Structure, StructureError> {
    crate::structure::read::read_in_pieces(bytes, limits, n)
}

/// Reads the record of a job with its parameters, and returns it as it would be written.
///
/// # Errors
/// Returns the reason as text.
pub fn record(bytes: &[u8]) -> Result<Vec<u8>, String> {
    let record: Record = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
    record.request()?;
    serde_json::to_vec(&record).map_err(|error| error.to_string())
}
