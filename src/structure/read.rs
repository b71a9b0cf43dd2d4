//! Bytes to atoms.

use super::atoms::{SourceFormat, Structure};
use super::error::StructureError;
use super::{bcif, inflate, mmcif, pdb, sniff};

/// Limits of reading, checked before memory is allocated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadLimits {
    /// Bytes after decompression.
    pub max_inflated_bytes: u64,
    /// Atoms in all models.
    pub max_atoms: u64,
}

impl Default for ReadLimits {
    fn default() -> Self {
        Self { max_inflated_bytes: 4 << 30, max_atoms: 20_000_000 }
    }
}

impl ReadLimits {
    /// Atoms in all models, as a number of rows: rows are counted in 32 bits.
    pub(super) fn max_rows(&self) -> usize {
        usize::try_from(self.max_atoms.min(u64::from(u32::MAX))).unwrap_or(usize::MAX)
    }
}

/// Coordinates beyond this distance from the origin (Å, per axis) are refused, as no structure file's columns reach
/// that far: [`crate::surface::spheres::MAX_COORDINATE`].
pub(super) use crate::surface::spheres::MAX_COORDINATE;

/// Reads a structure: sniffs compression and format, never trusts a name. Lines, columns and bytes of errors are
/// those of the inflated text.
///
/// # Errors
/// Any [`StructureError`] of reading. No input panics.
pub fn read(bytes: &[u8], limits: &ReadLimits) -> Result<Structure, StructureError> {
    let plain = inflate::inflate(bytes, limits.max_inflated_bytes)?;
    let text = without_mark(&plain);
    match sniff::sniff(text)? {
        SourceFormat::Pdb => pdb::read(text, limits),
        SourceFormat::Mmcif => mmcif::read(text, limits),
        SourceFormat::BinaryCif => bcif::read(text, limits),
    }
}

/// Without the byte order mark that some editors put before UTF-8.
pub(super) fn without_mark(text: &[u8]) -> &[u8] {
    text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text)
}
