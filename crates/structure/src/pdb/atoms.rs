//! Second pass over a PDB file: reads the columns of ATOM and HETATM records.

use std::collections::HashMap;
use std::sync::OnceLock;

use super::super::atoms::{Atom, Slices, Tables};
use super::super::contents::Kind;
use super::super::element::{self, AtomName, atomic_number};
use super::super::error::StructureError;
use super::super::fields::LINES_PER_CHECK;
use super::super::number::single;
use super::super::read::Reading;
use super::super::text::{Fault, trimmed};
use super::super::warnings::Warnings;
use super::card::{Card, card, check_length, coordinate, expand_tabs, number, residue_number, segment, stated_element};
use super::chains::TwoLetterChains;
use super::records::Line;

/// File with the state that its pieces share.
pub(super) struct File<'a> {
    pub(super) text: &'a [u8],
    pub(super) tabs: bool,
    /// Two-letter chain names, resolved at the first use of column 21.
    two_letters: OnceLock<TwoLetterChains>,
}

impl<'a> File<'a> {
    pub(super) fn new(text: &'a [u8]) -> Self {
        Self { text, tabs: memchr::memchr(b'\t', text).is_some(), two_letters: OnceLock::new() }
    }
}

/// Reader of the atoms of a piece.
pub(super) struct Atoms<'a> {
    file: &'a File<'a>,
    pub(super) tables: Tables,
    pub(super) warnings: Warnings<Box<Fault>>,
    /// The fault of the first atom that cannot be read. Later atoms are not read.
    pub(super) fault: Option<Box<Fault>>,
    /// True if a one-letter atom name was found in the first name column: the alignment of this file is not reliable.
    pub(super) left_justified: bool,
    /// Guessed elements by name columns and residue.
    guesses: HashMap<(u32, u32), u8>,
    /// Columns 18-22 of the latest use of column 21, and true if that belongs to the chain name.
    latest: ([u8; 5], bool),
}

impl<'a> Atoms<'a> {
    /// Reads the atoms of a piece into its rows. `left_justified` is the result of the pieces before.
    ///
    /// # Errors
    /// Returns the errors of cancellation and memory.
    pub(super) fn read(
        file: &'a File<'a>,
        left_justified: bool,
        lines: &[Line],
        rows: &mut Slices<'_>,
        reading: &Reading<'_>,
    ) -> Result<Self, StructureError> {
        let mut tables = Tables::default();
        tables.label_chain.intern(b"", 0, 0);
        let mut atoms = Self {
            file,
            tables,
            warnings: Warnings::default(),
            fault: None,
            left_justified,
            guesses: HashMap::new(),
            latest: ([0; 5], false),
        };
        rows.rewind();
        for lines in lines.chunks(LINES_PER_CHECK) {
            reading.check()?;
            let text_bytes = atoms.tables.bytes();
            for line in lines {
                match atoms.atom(*line) {
                    Ok(atom) => rows.put(&atom),
                    Err(fault) => {
                        atoms.fault = Some(fault);
                        return Ok(atoms);
                    }
                };
            }
            reading.hold_texts(atoms.tables.bytes() - text_bytes)?;
        }
        Ok(atoms)
    }

    /// Returns true if the element of some atom was guessed.
    pub(super) fn has_guesses(&self) -> bool {
        !self.guesses.is_empty()
    }

    #[inline]
    fn atom(&mut self, line: Line) -> Result<Atom, Box<Fault>> {
        let range = line.range();
        let start = range.start;
        let line = &self.file.text[range];
        let n_warnings = self.warnings.len();
        if self.file.tabs && line.contains(&b'\t') {
            let (expanded, origin) = expand_tabs(line);
            let in_file = |at: usize| start + origin.get(at).copied().unwrap_or(line.len());
            let read = self.columns_of(&expanded);
            self.warnings.after(n_warnings).iter_mut().for_each(|w| w.fault.at = in_file(w.fault.at));
            return read.map_err(|mut fault| {
                fault.at = in_file(fault.at);
                fault
            });
        }
        let read = self.columns_of(line);
        self.warnings.after(n_warnings).iter_mut().for_each(|w| w.fault.at += start);
        read.map_err(|fault| fault.shifted(start))
    }

    /// Reads one line. Offsets in faults and warnings are relative to the line.
    #[inline]
    fn columns_of(&mut self, line: &[u8]) -> Result<Atom, Box<Fault>> {
        check_length(line)?;
        let mut padded = [b' '; 80];
        let card: &Card = line.first_chunk().unwrap_or_else(|| {
            padded = card(line);
            &padded
        });
        let position = [coordinate(card, 30, "x")?, coordinate(card, 38, "y")?, coordinate(card, 46, "z")?];
        let (residue_end, chain_start) = self.residue_and_chain(card);
        let name = self.tables.name.intern_field(card, 12, 16);
        let residue = self.tables.residue.intern_field(card, 17, residue_end);
        let chain = self.tables.chain.intern_field(card, chain_start, 22);
        let (residue_number, insertion_code) = residue_number(card).unwrap_or_else(|fault| {
            self.warnings.add("read as 0", || fault);
            (0, 0)
        });
        let hetero = card[0] == b'H';
        Ok(Atom {
            position,
            element: self.element(card, residue),
            name,
            residue,
            chain,
            label_chain: self.segment(card),
            residue_number,
            insertion_code,
            altloc: if card[16] > b' ' { card[16] } else { 0 },
            occupancy: self.optional(card, (54, 60), (1.0, "read as 1"), "an occupancy"),
            b_factor: self.optional(card, (60, 66), (0.0, "read as 0"), "a B-factor"),
            // Models are numbered when all pieces have been read.
            model: 0,
            hetero,
            kind: if hetero { Kind::Ligand } else { Kind::Polymer },
        })
    }

    /// Returns the end of the residue name and the start of the chain name. Column 21 belongs to one of them.
    #[inline]
    fn residue_and_chain(&mut self, card: &Card) -> (usize, usize) {
        if card[20] <= b' ' {
            return (20, 21);
        }
        let columns = [card[17], card[18], card[19], card[20], card[21]];
        if self.latest.0 != columns {
            let chains = self.file.two_letters.get_or_init(|| TwoLetterChains::find(self.file.text));
            self.latest = (columns, chains.has(columns));
        }
        if self.latest.1 { (20, 20) } else { (21, 21) }
    }

    /// Reads an optional number. An unreadable one is replaced by the default, with a warning.
    #[inline]
    fn optional(&mut self, card: &Card, at: (usize, usize), default: (f32, &'static str), what: &str) -> f32 {
        let (from, to) = at;
        match number(card, from, to) {
            Some(value) if single(value).is_finite() => return single(value),
            None if trimmed(&card[from..to]).1 == 0 => return default.0,
            _ => {}
        }
        self.warnings.add(default.1, || {
            Fault::token(card, from, to, format!("{what} in columns {} to {to}, or blanks", from + 1))
        });
        default.0
    }

    /// Returns the id of the segment; 0 without one.
    #[inline]
    fn segment(&mut self, card: &Card) -> u32 {
        match segment(card) {
            (start, end) if start == end => 0,
            (start, end) => self.tables.label_chain.intern_field(card, start, end),
        }
    }

    #[inline]
    fn element(&mut self, card: &Card, residue: u32) -> u8 {
        stated_element(card).unwrap_or_else(|| self.guess(card, residue))
    }

    fn guess(&mut self, card: &Card, residue: u32) -> u8 {
        let columns = [card[12], card[13], card[14], card[15]];
        let (from, to) = trimmed(&columns);
        if from == 0
            && to == 1
            && columns[0].is_ascii_alphabetic()
            && atomic_number(&columns[..1]) != 0
            && !self.left_justified
        {
            self.left_justified = true;
            self.guesses.clear();
        }
        if let Some(&z) = self.guesses.get(&(u32::from_le_bytes(columns), residue)) {
            return z;
        }
        let name = AtomName { text: &columns[from..to], columns: (!self.left_justified).then_some(columns) };
        let z = element::guess(name, self.tables.residue.text(residue));
        self.guesses.insert((u32::from_le_bytes(columns), residue), z);
        z
    }
}
