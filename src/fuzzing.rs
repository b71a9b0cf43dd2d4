//! Private parsers for the targets of `molmesh-fuzz`. Not part of the library's interface.

use std::net::IpAddr;
use std::sync::LazyLock;
use std::time::UNIX_EPOCH;

use crate::access::{self, KeyFileError, SignatureCheck, SigningKeys};
use crate::config::Proxies;
use crate::jobs::JobRecord;
use crate::structure::{ReadLimits, Structure, StructureError};

/// Parses a key file.
///
/// # Errors
/// Returns the first error in the file.
pub fn key_file(text: &str) -> Result<(), KeyFileError> {
    access::parse_key_file(text).map(drop)
}

/// Returns true if a path and query carry a valid signature at the start of 1970.
#[must_use]
pub fn has_valid_signature(keys: &SigningKeys, target: &str) -> bool {
    let (path, query) = target.split_once('?').map_or((target, None), |(path, query)| (path, Some(query)));
    matches!(keys.check(path, query, UNIX_EPOCH), SignatureCheck::Valid(_))
}

/// Returns the client of a request from the trusted proxy 10.0.0.1 with these values of `X-Forwarded-For`. All
/// addresses in 10.0.0.0/8 are trusted.
#[must_use]
pub fn forwarded(values: &[&str]) -> IpAddr {
    access::forwarded_client(IpAddr::from([10, 0, 0, 1]), values.iter().copied(), PROXIES.as_ref())
}

/// Returns true if [`forwarded`] trusts this address.
#[must_use]
pub fn is_trusted_proxy(address: IpAddr) -> bool {
    PROXIES.as_ref().is_some_and(|proxies| proxies.contains(address))
}

static PROXIES: LazyLock<Option<Proxies>> = LazyLock::new(|| "10.0.0.0/8".parse().ok());

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
    let record: JobRecord = serde_json::from_slice(bytes).map_err(|error| error.to_string())?;
    record.request()?;
    serde_json::to_vec(&record).map_err(|error| error.to_string())
}
