//! Entry point of the readers: bytes to atoms.

use super::atoms::{SourceFormat, Structure};
use super::error::StructureError;
use super::{bcif, inflate, mmcif, pdb, pieces, pqr, sniff, xyz};
use crate::surface::{Control, MemoryMeter as _, Reservation};

/// Limits of reading, checked before memory is allocated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[expect(clippy::struct_field_names, reason = "every field is a maximum")]
pub struct ReadLimits {
    /// Bytes after decompression.
    pub max_inflated_bytes: u64,
    /// Atoms in all models, and of an assembly.
    pub max_atoms: u64,
    /// Atoms of one model, or of an assembly, at exactly the same position.
    pub max_duplicates: u64,
    /// Copies of chains in an assembly.
    pub max_copies: u64,
    /// Parts into which `split` divides the selected atoms.
    pub max_parts: u64,
}

impl Default for ReadLimits {
    fn default() -> Self {
        Self {
            max_inflated_bytes: 4 << 30,
            max_atoms: 20_000_000,
            max_duplicates: 1000,
            max_copies: 10_000,
            max_parts: 1000,
        }
    }
}

impl ReadLimits {
    /// Checks the number of atoms in all models.
    pub(crate) fn check_atoms(&self, n: usize) -> Result<(), StructureError> {
        if n > self.max_rows() { Err(StructureError::TooManyAtoms { limit: self.max_atoms }) } else { Ok(()) }
    }

    /// Atoms in all models, as a number of rows: rows are counted in 32 bits.
    pub(super) fn max_rows(&self) -> usize {
        usize::try_from(self.max_atoms.min(u64::from(u32::MAX))).unwrap_or(usize::MAX)
    }
}

/// Memory of a distinct text in a string table, bytes: its entry, its allocation and its hash.
const BYTES_PER_TEXT: u64 = 96;

/// Limits, cancellation and memory while one file is read.
pub(super) struct Reading<'a> {
    pub(super) limits: &'a ReadLimits,
    control: &'a Control<'a>,
    /// Memory that is freed when the file has been read: text, decoded columns, and what pieces hold besides rows.
    pub(super) text: Reservation,
    /// Number of pieces to read; `None` to choose it by size.
    pieces: Option<usize>,
}

impl<'a> Reading<'a> {
    pub(super) fn new(limits: &'a ReadLimits, control: &'a Control<'a>) -> Self {
        Self { limits, control, text: Reservation::new(&control.memory), pieces: None }
    }

    /// Returns the number of pieces for a text of this size.
    pub(super) fn n_pieces(&self, bytes: usize) -> usize {
        self.pieces.unwrap_or_else(|| pieces::number(bytes))
    }

    /// Fails if the caller cancelled.
    pub(super) fn check(&self) -> Result<(), StructureError> {
        check(self.control)
    }

    /// Reserves memory until the reservation is dropped.
    pub(super) fn reserve(&self, bytes: u64) -> Result<Reservation, StructureError> {
        Ok(self.control.reserve(bytes)?)
    }

    /// Adds the memory of `n` more distinct texts of a piece.
    pub(super) fn hold_texts(&self, n: usize) -> Result<(), StructureError> {
        Ok(self.text.grow(BYTES_PER_TEXT * n as u64)?)
    }

    /// Reserves memory that belongs to the structure.
    pub(super) fn keep(&self, bytes: u64) -> Result<(), StructureError> {
        Ok(self.control.memory.grow(bytes)?)
    }

    /// Adds the memory of `n` more distinct texts, which belong to the structure.
    pub(super) fn keep_texts(&self, n: usize) -> Result<(), StructureError> {
        self.keep(BYTES_PER_TEXT * n as u64)
    }
}

/// Fails if the caller cancelled.
pub(super) fn check(control: &Control<'_>) -> Result<(), StructureError> {
    if control.cancel.is_cancelled() { Err(StructureError::Cancelled) } else { Ok(()) }
}

/// Largest accepted coordinate (Å, absolute value per axis). No structure file format has columns for larger values.
pub(super) use crate::surface::spheres::MAX_COORDINATE;

/// Reads a structure. Compression and format are detected from the content, not from a file name. Lines, columns and
/// byte offsets in errors refer to the decompressed text.
///
/// # Errors
/// Returns any [`StructureError`] of reading. Never panics, whatever the input.
pub fn read(bytes: &[u8], limits: &ReadLimits) -> Result<Structure, StructureError> {
    read_with(bytes, limits, &Control::default())
}

/// Reads a structure as [`read`] does, checks for cancellation every few milliseconds, and adds memory to the meter of
/// `control` before it is allocated. The memory of the structure stays added.
///
/// # Errors
/// Returns the errors of [`read`], [`StructureError::Memory`] and [`StructureError::Cancelled`].
pub fn read_with(bytes: &[u8], limits: &ReadLimits, control: &Control<'_>) -> Result<Structure, StructureError> {
    of_bytes(bytes, &Reading::new(limits, control))
}

/// Reads a structure in a fixed number of pieces.
#[cfg(any(test, feature = "server"))]
pub(crate) fn read_in_pieces(bytes: &[u8], limits: &ReadLimits, n: usize) -> Result<Structure, StructureError> {
    of_bytes(bytes, &Reading { pieces: Some(n), ..Reading::new(limits, &Control::default()) })
}

fn of_bytes(bytes: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    reading.check()?;
    let plain = inflate::inflate(bytes, reading.limits.max_inflated_bytes, reading)?;
    let text = without_mark(&plain);
    match sniff::sniff(text)? {
        SourceFormat::Pdb => pdb::read(text, reading),
        SourceFormat::Mmcif => mmcif::read(text, reading),
        SourceFormat::BinaryCif => bcif::read(text, reading),
        SourceFormat::Pqr => pqr::read(text, reading),
        SourceFormat::Xyz => xyz::read(text, reading),
    }
}

/// Strips the byte order mark that some editors write before UTF-8 text.
pub(super) fn without_mark(text: &[u8]) -> &[u8] {
    text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text)
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use std::fmt::Write as _;
    use std::io::Write as _;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;
    use crate::surface::{CancelToken, MemoryMeter, OutOfMemory};

    /// Budget that records its maximum, and cancels once that exceeds a value.
    #[derive(Debug)]
    struct Budget {
        limit: u64,
        held: AtomicU64,
        most: AtomicU64,
        cancel: CancelToken,
        cancel_at: u64,
    }

    impl MemoryMeter for Budget {
        fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
            let held = self.held.fetch_add(bytes, Ordering::SeqCst) + bytes;
            if held > self.limit {
                self.held.fetch_sub(bytes, Ordering::SeqCst);
                return Err(OutOfMemory::Budget { needed: bytes, held: held - bytes, limit: self.limit });
            }
            self.most.fetch_max(held, Ordering::SeqCst);
            if held > self.cancel_at {
                self.cancel.cancel();
            }
            Ok(())
        }

        fn shrink(&self, bytes: u64) {
            self.held.fetch_sub(bytes, Ordering::SeqCst);
        }
    }

    fn read_within(bytes: &[u8], limit: u64, cancel_at: u64) -> (Result<Structure, StructureError>, Arc<Budget>) {
        let (cancel, zero) = (CancelToken::default(), AtomicU64::default);
        let budget = Arc::new(Budget { limit, held: zero(), most: zero(), cancel: cancel.clone(), cancel_at });
        let memory: Arc<dyn MemoryMeter> = Arc::<Budget>::clone(&budget);
        let read = read_with(bytes, &ReadLimits::default(), &Control { cancel, memory, ..Control::default() });
        (read, budget)
    }

    /// Returns 40,000 atoms as PDB and mmCIF, more than the mmCIF reader leaves to one thread.
    fn files() -> [Vec<u8>; 2] {
        let (mut pdb, mut cif) = (String::new(), "data_x\nloop_\n".to_owned());
        for item in ["group_PDB", "type_symbol", "label_atom_id", "label_comp_id", "Cartn_x", "Cartn_y", "Cartn_z"] {
            writeln!(cif, "_atom_site.{item}").unwrap();
        }
        for i in 0..40_000_u32 {
            let (x, y, number) = (f64::from(i % 200), f64::from(i / 200), i % 9999);
            writeln!(
                pdb,
                "ATOM  {number:>5}  CA  ALA A{number:>4}    {x:>8.3}{y:>8.3}   1.000  1.00  0.00           C"
            )
            .unwrap();
            writeln!(cif, "ATOM C CA ALA {x:<20} {y:<20} 1.0").unwrap();
        }
        [pdb.into_bytes(), cif.into_bytes()]
    }

    fn gzip(text: &[u8]) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(text).unwrap();
        encoder.finish().unwrap()
    }

    #[test]
    fn memory_is_reserved_before_it_is_allocated() {
        for text in files() {
            let (read, budget) = read_within(&gzip(&text), u64::MAX, u64::MAX);
            let structure = read.unwrap();
            let (held, most) = (budget.held.load(Ordering::SeqCst), budget.most.load(Ordering::SeqCst));
            // An atom takes 61 bytes, and the text is freed.
            assert!((40_000 * 61..40_000 * 90).contains(&held), "{held}");
            assert!(most >= held + text.len() as u64, "{most} {held}");
            for limit in [1000, 1 << 20, most - 1] {
                let (read, budget) = read_within(&gzip(&text), limit, u64::MAX);
                assert!(matches!(read, Err(StructureError::Memory(OutOfMemory::Budget { .. }))), "{limit}");
                assert!(budget.most.load(Ordering::SeqCst) <= limit);
            }
            assert_eq!(read_within(&gzip(&text), most, u64::MAX).0.unwrap(), structure);
        }
    }

    #[test]
    fn cancellation_stops_every_phase() {
        for text in files() {
            let (_, budget) = read_within(&gzip(&text), u64::MAX, u64::MAX);
            let most = budget.most.load(Ordering::SeqCst);
            for cancel_at in [0, 2 << 20, most - 1] {
                assert_eq!(
                    read_within(&gzip(&text), u64::MAX, cancel_at).0,
                    Err(StructureError::Cancelled),
                    "{cancel_at}"
                );
            }
        }
    }
}
