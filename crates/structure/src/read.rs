//! Entry point of the readers, and their limits.

use std::sync::atomic::AtomicU8;

use molmesh_surface::{Control, Exceeded, Limit, MemoryMeter as _, Reservation};

use super::atoms::Structure;
use super::error::StructureError;
use super::source::SourceFormat;
use super::{bcif, decoder, mmcif, pdb, pieces, pqr, sniff, xyz};

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
    /// Parts into which `split` or `model=all` divides the selected atoms.
    pub max_parts: u64,
    /// Distances between atoms that an expression with `within` tests.
    pub max_distances: u64,
}

/// Tested distances that a selection may have for each candidate pair of the surface.
pub const DISTANCES_PER_PAIR: u64 = 64;

impl Default for ReadLimits {
    fn default() -> Self {
        Self {
            max_inflated_bytes: 4 << 30,
            max_atoms: 20_000_000,
            // Structures have at most a few, and the work of a mesh grows with the square of their number.
            max_duplicates: 1000,
            max_copies: 10_000,
            // Most structures have fewer chains. Each part is meshed on its own and adds about a kilobyte to a glTF.
            max_parts: 1000,
            max_distances: DISTANCES_PER_PAIR << 30,
        }
    }
}

impl ReadLimits {
    /// Checks the number of atoms in all models.
    ///
    /// # Errors
    /// [`StructureError::Limit`].
    pub fn check_atoms(&self, n: usize) -> Result<(), StructureError> {
        if n > self.max_rows() { Err(self.too_many_atoms().error()) } else { Ok(()) }
    }

    /// Returns the error for too many atoms. Indices of atoms have 32 bits.
    pub(super) fn too_many_atoms(&self) -> Exceeded {
        Exceeded::capped(Limit::Atoms, self.max_atoms, u64::from(u32::MAX))
    }

    /// Maximum number of atoms in all models, limited to 32 bits.
    pub(super) fn max_rows(&self) -> usize {
        usize::try_from(self.too_many_atoms().max).unwrap_or(usize::MAX)
    }
}

/// Limits, cancellation and memory while one file is read.
pub(super) struct Reading<'a> {
    pub(super) limits: &'a ReadLimits,
    control: &'a Control<'a>,
    /// Memory that is freed when the file has been read: text, decoded columns, and the data of pieces besides rows.
    pub(super) text: Reservation,
    /// Number of pieces to read; `None` to choose it by size.
    pieces: Option<usize>,
    /// True for a block of a file.
    pub(super) is_block: bool,
    /// Findings about the kinds of atoms.
    pub(super) findings: AtomicU8,
}

impl<'a> Reading<'a> {
    pub(super) fn new(limits: &'a ReadLimits, control: &'a Control<'a>) -> Self {
        let text = Reservation::new(&control.memory);
        Self { limits, control, text, pieces: None, is_block: false, findings: AtomicU8::new(0) }
    }

    /// Begins to read a block of a file.
    pub(super) fn of_block(limits: &'a ReadLimits, control: &'a Control<'a>) -> Self {
        Self { is_block: true, ..Self::new(limits, control) }
    }

    /// Returns the number of pieces for a text of this size.
    pub(super) fn n_pieces(&self, bytes: usize) -> usize {
        self.pieces.unwrap_or_else(|| pieces::number(bytes))
    }

    /// Fails if the caller cancelled.
    pub(super) fn check(&self) -> Result<(), StructureError> {
        check(self.control)
    }

    /// Calls [`Self::check`] if `n` is a multiple of `step`.
    #[inline]
    pub(super) fn check_every(&self, n: usize, step: usize) -> Result<(), StructureError> {
        check_every(self.control, n, step)
    }

    /// Reserves memory until the reservation is dropped.
    pub(super) fn reserve(&self, bytes: u64) -> Result<Reservation, StructureError> {
        Ok(self.control.reserve(bytes)?)
    }

    /// Adds the memory of more texts of a piece, bytes.
    pub(super) fn hold_texts(&self, bytes: u64) -> Result<(), StructureError> {
        Ok(self.text.grow(bytes)?)
    }

    /// Reserves memory that belongs to the structure.
    pub(super) fn keep(&self, bytes: u64) -> Result<(), StructureError> {
        Ok(self.control.memory.grow(bytes)?)
    }
}

/// Fails if the caller cancelled.
pub(super) fn check(control: &Control<'_>) -> Result<(), StructureError> {
    if control.cancel.is_cancelled() { Err(StructureError::Cancelled) } else { Ok(()) }
}

/// Calls [`check`] if `n` is a multiple of `step`.
#[inline]
pub(super) fn check_every(control: &Control<'_>, n: usize, step: usize) -> Result<(), StructureError> {
    if n.is_multiple_of(step) { check(control) } else { Ok(()) }
}

/// Maximum absolute value of a coordinate, Å. No structure file format has columns for larger values.
pub(super) use molmesh_surface::spheres::MAX_COORDINATE;

/// Reads a structure. Compression and format are detected from the content, not from a file name. Lines, columns and
/// byte offsets in errors refer to the decompressed text.
///
/// # Errors
/// Returns any [`StructureError`] of reading. Never panics on any input.
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
///
/// # Errors
/// Returns the errors of [`read`].
pub fn read_in_pieces(bytes: &[u8], limits: &ReadLimits, n: usize) -> Result<Structure, StructureError> {
    of_bytes(bytes, &Reading { pieces: Some(n), ..Reading::new(limits, &Control::default()) })
}

fn of_bytes(bytes: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    reading.check()?;
    let check = |inflated: &[u8]| check_sample(inflated, reading);
    let limit = reading.limits.max_inflated_bytes;
    let plain = decoder::inflate(bytes, limit, &reading.text, reading.control, &check)?;
    of_text(without_mark(&plain), reading)
}

pub(super) fn of_text(text: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    match sniff::sniff(text)? {
        SourceFormat::Pdb => pdb::read(text, reading),
        SourceFormat::Mmcif => mmcif::read(text, reading),
        SourceFormat::BinaryCif => bcif::read(text, reading),
        SourceFormat::Pqr => pqr::read(text, reading),
        SourceFormat::Xyz => xyz::read(text, reading),
    }
}

/// Number of inflated bytes from which on a sample is checked whenever the number has doubled.
const SAMPLED_FROM: usize = 32 << 20;
/// Size of a sample, bytes: more than ten thousand atoms. It is read in a few milliseconds.
const SAMPLE_BYTES: usize = 1 << 20;

/// Rejects a file if a sample contains too many atoms at the same position, before the whole file is inflated: such
/// files compress well. Does not depend on the number of threads. Ignores other errors, which the reader of the whole
/// file reports.
fn check_sample(inflated: &[u8], reading: &Reading<'_>) -> Result<(), StructureError> {
    if inflated.len() < SAMPLED_FROM {
        return Ok(());
    }
    let text = without_mark(inflated);
    // Any lines of a PDB file can be read separately. Other formats require the beginning of the file.
    let last = matches!(sniff::sniff(text), Ok(SourceFormat::Pdb));
    let sample = if last { &text[text.len() - SAMPLE_BYTES..] } else { &text[..SAMPLE_BYTES] };
    let is_end = |b: &u8| *b == b'\n';
    let start = if last { sample.iter().position(is_end).map_or(0, |i| i + 1) } else { 0 };
    let end = sample.iter().rposition(is_end).map_or(start, |i| i + 1).max(start);
    let control = reading.control.metered();
    match of_text(&sample[start..end], &Reading { pieces: Some(1), ..Reading::new(reading.limits, &control) }) {
        Err(StructureError::Limit(error)) if error.limit == Limit::Duplicates => Err(error.into()),
        Err(StructureError::Cancelled) => Err(StructureError::Cancelled),
        _ => Ok(()),
    }
}

/// Returns the format of a file from its first bytes; `None` for a compressed file, which is not decompressed.
///
/// # Errors
/// [`StructureError::UnknownFormat`].
pub fn detect_format(bytes: &[u8]) -> Result<Option<SourceFormat>, StructureError> {
    if decoder::encoding(bytes).is_some() {
        return Ok(None);
    }
    let head = &bytes[..bytes.len().min(SAMPLE_BYTES)];
    sniff::sniff(without_mark(head)).map(Some)
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

    use molmesh_surface::{CancelToken, MemoryMeter, OutOfMemory};

    use super::*;

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

    /// Returns a compressed file of `head`, lines of atoms at positions 1 to `n_positions`, then `n_equal` equal lines.
    fn crowded(head: &str, line: impl Fn(u32) -> String, n_positions: u32, n_equal: usize) -> Vec<u8> {
        let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        encoder.write_all(head.as_bytes()).unwrap();
        (1..=n_positions).for_each(|i| encoder.write_all(line(i).as_bytes()).unwrap());
        let block = line(0).repeat(1000);
        (0..n_equal / 1000).for_each(|_| encoder.write_all(block.as_bytes()).unwrap());
        encoder.finish().unwrap()
    }

    #[test]
    fn atoms_at_one_position_end_the_reading_early() {
        let pdb = |i: u32| {
            let [x, y] = [i % 1000, i / 1000].map(f64::from);
            format!("ATOM      1  CA  ALA A   1    {x:>8.3}{y:>8.3}   0.000  1.00  0.00           C\n")
        };
        let head =
            "data_x\nloop_\n_atom_site.Cartn_x\n_atom_site.Cartn_y\n_atom_site.Cartn_z\n_atom_site.type_symbol\n";
        let cif = |i: u32| format!("{} {} 0.000 C\n", i % 1000, i / 1000);
        // The whole files have 128 MiB and more; the first 100,000 atoms of the PDB file have different positions.
        let files = [crowded("", pdb, 100_000, 1_700_000), crowded(head, cif, 0, 12_000_000)];
        for file in files {
            for n_pieces in [1, 2, 7] {
                let found = read_in_pieces(&file, &ReadLimits::default(), n_pieces).unwrap_err();
                assert!(matches!(&found, StructureError::Limit(e) if e.position == Some([0.0; 3])), "{found}");
            }
            let (read, budget) = read_within(&file, u64::MAX, u64::MAX);
            assert!(matches!(read, Err(StructureError::Limit(error)) if error.limit == Limit::Duplicates));
            let most = budget.most.load(Ordering::SeqCst);
            assert!(most < 64 << 20, "{most}");
            assert_eq!(budget.held.load(Ordering::SeqCst), 0);
        }
        // Control: as many atoms at different positions.
        let apart = crowded("", pdb, 500_000, 0);
        assert_eq!(read(&apart, &ReadLimits::default()).unwrap().len(), 500_000);
    }

    #[test]
    fn memory_is_reserved_before_it_is_allocated() {
        for text in files() {
            let (read, budget) = read_within(&gzip(&text), u64::MAX, u64::MAX);
            let structure = read.unwrap();
            let (held, most) = (budget.held.load(Ordering::SeqCst), budget.most.load(Ordering::SeqCst));
            // An atom takes 62 bytes, and the text is freed.
            assert!((40_000 * 62..40_000 * 90).contains(&held), "{held}");
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
    fn distinct_names_are_charged_by_their_length() {
        let mut cif = "data_x\nloop_\n".to_owned();
        for item in ["type_symbol", "auth_atom_id", "auth_comp_id", "Cartn_x", "Cartn_y", "Cartn_z"] {
            writeln!(cif, "_atom_site.{item}").unwrap();
        }
        let held = |length: usize| {
            let mut cif = cif.clone();
            (0..40_000).for_each(|i| writeln!(cif, "C C {i:x<length$} {} {} 1.0", i % 200, i / 200).unwrap());
            let (read, budget) = read_within(&gzip(cif.as_bytes()), u64::MAX, u64::MAX);
            assert_eq!(read.unwrap().len(), 40_000);
            budget.held.load(Ordering::SeqCst)
        };
        assert_eq!(held(255) - held(55), 40_000 * 200);
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
