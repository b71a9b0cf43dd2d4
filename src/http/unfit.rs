//! Problems of meshes that no file holds.

use super::kinds::Kind;
use super::problem::Problem;
use crate::formats::FormatError;

/// A mesh file of `bytes` bytes where `limit` are allowed; files grow with the inverse square of the spacing.
#[expect(clippy::cast_precision_loss, reason = "an estimate: 52 bits are plenty")]
pub(super) fn file_too_large(bytes: u64, limit: u64, resolution: f64) -> Problem {
    let fits = resolution * (bytes as f64 / limit as f64).sqrt();
    let fits = (fits * 105.0).ceil() / 100.0;
    Problem::new(
        Kind::MeshTooLarge,
        format!("the file would take {bytes} bytes, the limit is {limit}; {fits} Å would fit"),
    )
    .with("limit", limit)
    .with("actual", bytes)
    .with("suggested_resolution", fits)
}

/// A mesh that its format cannot hold, or that no format could.
pub(super) fn of_format(error: &FormatError, resolution: f64) -> Problem {
    match *error {
        FormatError::GlbTooLarge { bytes, limit } => file_too_large(bytes, limit, resolution),
        FormatError::TooMany { count, limit, .. } => file_too_large(count, limit, resolution),
        FormatError::AtomIndexTooLarge { limit, .. } => {
            Problem::new(Kind::MeshTooLarge, error.to_string()).with("limit", limit).with("parameter", "atom_ids")
        }
        _ => Problem::internal(error),
    }
}
