//! Entry point of the readers: bytes to atoms.

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

/// Largest accepted coordinate (Å, absolute value per axis). No structure file format has columns for larger values.
pub(super) use crate::surface::spheres::MAX_COORDINATE;

/// Reads a structure. Compression and format are detected from the content, not from a file name. Lines, columns and
/// byte offsets in errors refer to the decompressed text.
///
/// # Errors
/// Returns any [`StructureError`] of reading. Never panics, whatever the input.
pub fn read(bytes: &[u8], limits: &ReadLimits) -> Result<Structure, StructureError> {
    let plain = inflate::inflate(bytes, limits.max_inflated_bytes)?;
    let text = without_mark(&plain);
    match sniff::sniff(text)? {
        SourceFormat::Pdb => pdb::read(text, limits),
        SourceFormat::Mmcif => mmcif::read(text, limits),
        SourceFormat::BinaryCif => bcif::read(text, limits),
    }
}

/// Strips the byte order mark that some editors write before UTF-8 text.
pub(super) fn without_mark(text: &[u8]) -> &[u8] {
    text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text)
}
