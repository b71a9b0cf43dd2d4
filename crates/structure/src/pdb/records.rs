//! First pass over a PDB file: finds the lines of atoms and reads all other records.

use std::collections::HashSet;
use std::ops::Range;

use molmesh_surface::MemoryMeter as _;

use super::super::annotations::SecondaryRange;
use super::super::error::StructureError;
use super::super::fields::LINES_PER_CHECK;
use super::super::kinds::Listed;
use super::super::models::{Mark, ModelBoundary};
use super::super::number;
use super::super::read::Reading;
use super::super::text::{Fault, normalize, trimmed};
use super::super::warnings::Warnings;
use super::atoms::File;
use super::card::{MIN_COLUMNS, check_length};
use super::lines::Lines;
use super::{MAX_TITLE, sequence};

/// Beginning of an ATOM or HETATM record. Columns beyond the first 96 are left out: they are not read.
#[derive(Debug, Clone, Copy)]
pub(super) struct Line(usize);

impl Line {
    const LEN_BITS: u32 = 7;
    const MAX_LEN: usize = 96;

    fn new(start: usize, end: usize) -> Self {
        let len = (end - start).min(Self::MAX_LEN);
        Self((start << Self::LEN_BITS) | len)
    }

    pub(super) fn range(self) -> Range<usize> {
        let start = self.0 >> Self::LEN_BITS;
        start..start + (self.0 & ((1 << Self::LEN_BITS) - 1))
    }
}

/// Memory of a mark and its model among the known ones, or of a REMARK 350, HELIX or SHEET record, bytes.
const BYTES_PER_MARK: u64 = 64;

/// Records of a piece.
#[derive(Debug, Default)]
pub(super) struct PieceRecords {
    /// ATOM and HETATM records.
    pub(super) atoms: Vec<Line>,
    /// Boundaries of models, by the number of atoms before them in the piece.
    pub(super) marks: Vec<Mark>,
    pub(super) id: Option<String>,
    pub(super) title: Vec<u8>,
    /// REMARK 350 records, as ranges of the text.
    pub(super) assemblies: Vec<(usize, usize)>,
    /// HELIX and SHEET records.
    pub(super) secondary: Vec<SecondaryRange>,
    pub(super) warnings: Warnings<Box<Fault>>,
    /// Chains and residue names in SEQRES and MODRES records.
    pub(super) listed: HashSet<Listed>,
    /// The first fault. Records after it are missing.
    pub(super) fault: Option<Box<Fault>>,
}

impl PieceRecords {
    /// Finds the records of a piece of a file.
    ///
    /// # Errors
    /// Returns the errors of cancellation and memory.
    pub(super) fn find(file: &File<'_>, piece: Range<usize>, reading: &Reading<'_>) -> Result<Self, StructureError> {
        let (offset, text) = (piece.start, &file.text[piece]);
        // Only lines with tabs may be shorter.
        let capacity = if file.tabs { Lines::new(text).count() } else { text.len() / (MIN_COLUMNS + 1) + 1 };
        reading.text.grow((size_of::<Line>() * capacity) as u64)?;
        let mut records = Self { atoms: Vec::with_capacity(capacity), ..Self::default() };
        let mut n_marks = 0;
        for (n, (start, end)) in Lines::new(text).enumerate() {
            if n % LINES_PER_CHECK == 0 {
                reading.check()?;
                reading.text.grow(BYTES_PER_MARK * (records.n_noted() - n_marks) as u64)?;
                n_marks = records.n_noted();
            }
            if let Err(fault) = records.line(file, offset + start, offset + end) {
                records.fault = Some(fault);
                break;
            }
        }
        Ok(records)
    }

    /// Returns the number of marks, of REMARK 350, HELIX and SHEET records, and of listed residue names.
    fn n_noted(&self) -> usize {
        self.marks.len() + self.assemblies.len() + self.secondary.len() + self.listed.len()
    }

    #[inline]
    fn line(&mut self, file: &File<'_>, start: usize, end: usize) -> Result<(), Box<Fault>> {
        let line = &file.text[start..end];
        match line {
            [b'A', b'T', b'O', b'M']
            | [b'A', b'T', b'O', b'M', b' ' | b'\t' | b'0'..=b'9', ..]
            | [b'H', b'E', b'T', b'A', b'T', b'M', ..] => {
                if !(file.tabs && line.contains(&b'\t')) {
                    check_length(line).map_err(|fault| fault.shifted(start))?;
                }
                self.atoms.push(Line::new(start, end));
            }
            [b'M' | b'E' | b'H' | b'T' | b'S', ..] => self.other(start, line)?,
            _ if line.starts_with(b"REMARK 350") => self.assemblies.push((start, end)),
            _ => {}
        }
        Ok(())
    }

    fn other(&mut self, start: usize, line: &[u8]) -> Result<(), Box<Fault>> {
        let word = &line[..line.len().min(6)];
        match word.trim_ascii_end() {
            b"MODEL" => {
                let boundary = ModelBoundary::Begins(model_number(start, line)?);
                self.marks.push(Mark { row: self.atoms.len(), boundary });
            }
            b"ENDMDL" => self.marks.push(Mark { row: self.atoms.len(), boundary: ModelBoundary::Ends }),
            b"END" => self.marks.push(Mark { row: self.atoms.len(), boundary: ModelBoundary::EndsPart }),
            b"SEQRES" => sequence::of_chain(line, &mut self.listed),
            b"MODRES" => sequence::of_residue(line, &mut self.listed),
            b"HELIX" | b"SHEET" => match SecondaryRange::of_record(line) {
                Some(Ok(range)) => self.secondary.push(range),
                Some(Err(ends)) => self
                    .warnings
                    .add("ignored", || Fault::words(start, ends.to_string(), "a helix or strand with one chain")),
                None => {}
            },
            b"HEADER" if self.id.is_none() => {
                let id = line.get(62..66).unwrap_or_default();
                if id.first().is_some_and(u8::is_ascii_digit) && id.iter().all(u8::is_ascii_alphanumeric) {
                    self.id = normalize(id, 4);
                }
            }
            b"TITLE" if self.title.len() < 8 * MAX_TITLE => {
                let part = line.get(10..line.len().min(80)).unwrap_or_default();
                self.title.extend_from_slice(part);
                self.title.push(b' ');
            }
            _ => {}
        }
        Ok(())
    }
}

/// Returns the number in a MODEL record, if it has one.
fn model_number(start: usize, line: &[u8]) -> Result<Option<i32>, Box<Fault>> {
    let rest = line.get(6..).unwrap_or_default();
    let (from, _) = trimmed(rest);
    let token = rest[from..].split(|&b| b <= b' ').next().unwrap_or_default();
    match number::integer(token) {
        None if !token.is_empty() => {
            Err(Fault::token(token, 0, token.len(), "a model number").shifted(start + 6 + from))
        }
        number => Ok(number),
    }
}
