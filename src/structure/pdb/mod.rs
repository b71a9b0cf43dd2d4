//! Reader of PDB files, including common deviations from the format.
//!
//! Code counts columns from 0; comments and messages count from 1, as the format description (wwPDB, version 3.3) does.
//! The reader uses ATOM, HETATM, MODEL, ENDMDL, END, HEADER, TITLE, SEQRES and MODRES records. It ignores atom serial
//! numbers, so their overflow is harmless. Supported deviations: lines that end after the coordinates, hybrid-36 and
//! five-digit residue numbers, four-letter residue names, two-letter chain names, missing element columns, entry id and
//! line number in columns 73-80 (before 1996), tabs, any line ending.

mod card;
mod chains;
mod lines;
mod sequence;

use std::collections::{HashMap, HashSet};

use self::card::{Card, card, coordinate, expand_tabs, number, numbered_line, residue_number};
use self::chains::TwoLetterChains;
use self::lines::Lines;
use super::atoms::{Atom, Source, SourceFormat, Structure, Tables};
use super::contents::Kind;
use super::element::{self, Name, atomic_number};
use super::error::StructureError;
use super::growing::GrowingColumns;
use super::kinds::{Listed, Sequence};
use super::number::single;
use super::read::Reading;
use super::text::{self, Fault, normalize, trimmed};
use super::warnings::Warnings;

/// Longest title, characters.
pub(super) const MAX_TITLE: usize = 1000;

/// Lines between two checks of the cancellation flag: a few milliseconds.
const LINES_PER_CHECK: usize = 1 << 14;

pub(super) fn read(text: &[u8], reading: &Reading<'_>) -> Result<Structure, StructureError> {
    let mut reader = Reader::new(text);
    for (n, line) in Lines::new(text).enumerate() {
        if n % LINES_PER_CHECK == 0 {
            reading.check()?;
        }
        reader.line(line).map_err(|fault| fault.locate(text))?;
        if std::mem::take(&mut reader.full) {
            // Number of atoms if all lines were as long as this one.
            let expected = text.len() / (line.1 - line.0 + 1) + 1;
            reader.columns.reserve_chunk(&reader.tables, reading, expected)?;
            reader.line(line).map_err(|fault| fault.locate(text))?;
        }
    }
    if reader.columns.columns().len() == 0 {
        return Err(StructureError::NoAtoms { found: describe(text) });
    }
    let source = Source {
        format: SourceFormat::Pdb,
        id: reader.id,
        title: normalize(&reader.title, MAX_TITLE),
        sequence: Sequence { listed: reader.listed, ..Sequence::default() },
        warnings: reader.warnings.messages(|fault| fault.locate(text)),
    };
    reader.columns.into_columns().finish(reader.tables, source, reading)
}

/// Assigns atoms to models. A repeated model number, or atoms after the end of a model, begin a new model.
#[derive(Default)]
struct Models {
    current: Option<i32>,
    highest: i32,
    seen: HashSet<i32>,
}

impl Models {
    fn begin(&mut self, number: Option<i32>) -> i32 {
        let next = self.highest.saturating_add(1);
        let number = number.filter(|n| !self.seen.contains(n)).unwrap_or(next);
        self.highest = self.highest.max(number);
        self.seen.insert(number);
        self.current = Some(number);
        number
    }
}

#[derive(Default)]
struct Reader<'a> {
    text: &'a [u8],
    /// Set instead of reading an atom for which no memory is reserved.
    full: bool,
    tabs: bool,
    columns: GrowingColumns,
    tables: Tables,
    models: Models,
    id: Option<String>,
    title: Vec<u8>,
    /// True if a one-letter atom name was found in the first name column: the alignment of this file is not reliable.
    left_justified: bool,
    /// Guessed elements by name columns and residue.
    guesses: HashMap<(u32, u32), u8>,
    /// Two-letter chain names, resolved at the first use of column 21.
    two_letters: Option<TwoLetterChains>,
    /// Chains and residue names in SEQRES and MODRES records.
    listed: HashSet<Listed>,
    warnings: Warnings<Box<Fault>>,
}

impl<'a> Reader<'a> {
    fn new(text: &'a [u8]) -> Self {
        let tabs = memchr::memchr(b'\t', text).is_some();
        Self { text, tabs, ..Self::default() }
    }

    #[inline]
    fn line(&mut self, (start, end): (usize, usize)) -> Result<(), Box<Fault>> {
        let line = &self.text[start..end];
        match line {
            [b'A', b'T', b'O', b'M'] | [b'A', b'T', b'O', b'M', b' ' | b'\t' | b'0'..=b'9', ..] => {
                self.atom(start, end, false)
            }
            [b'H', b'E', b'T', b'A', b'T', b'M', ..] => self.atom(start, end, true),
            [b'M' | b'E' | b'H' | b'T' | b'S', ..] => self.other(start, line),
            _ => Ok(()),
        }
    }

    fn other(&mut self, start: usize, line: &[u8]) -> Result<(), Box<Fault>> {
        let word = &line[..line.len().min(6)];
        match word.trim_ascii_end() {
            b"MODEL" => self.model(start, line)?,
            b"ENDMDL" | b"END" => self.models.current = None,
            b"SEQRES" => sequence::of_chain(line, &mut self.listed),
            b"MODRES" => sequence::of_residue(line, &mut self.listed),
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

    fn model(&mut self, start: usize, line: &[u8]) -> Result<(), Box<Fault>> {
        let rest = line.get(6..).unwrap_or_default();
        let (from, _) = trimmed(rest);
        let token = rest[from..].split(|&b| b <= b' ').next().unwrap_or_default();
        let number = match super::number::integer(token) {
            None if !token.is_empty() => {
                let at = start + 6 + from;
                return Err(Fault::token(self.text, at, at + token.len(), "a model number"));
            }
            number => number,
        };
        self.models.begin(number);
        Ok(())
    }

    #[inline]
    fn atom(&mut self, start: usize, end: usize, hetero: bool) -> Result<(), Box<Fault>> {
        let line = &self.text[start..end];
        let n_warnings = self.warnings.len();
        if self.tabs && line.contains(&b'\t') {
            let (expanded, origin) = expand_tabs(line);
            let place = |at: usize| start + origin.get(at).copied().unwrap_or(line.len());
            let read = self.columns_of(&expanded, hetero);
            self.warnings.after(n_warnings).iter_mut().for_each(|w| w.fault.at = place(w.fault.at));
            return read.map_err(|mut fault| {
                fault.at = place(fault.at);
                fault
            });
        }
        let read = self.columns_of(line, hetero);
        self.warnings.after(n_warnings).iter_mut().for_each(|w| w.fault.at += start);
        read.map_err(|mut fault| {
            fault.at += start;
            fault
        })
    }

    /// Reads one line. Offsets in faults and warnings are relative to the line.
    #[inline]
    fn columns_of(&mut self, line: &[u8], hetero: bool) -> Result<(), Box<Fault>> {
        if line.len() < 54 {
            let found = format!("a line of {} columns", line.len());
            return Err(Fault::words(line.len(), found, "coordinates in columns 31 to 54"));
        }
        let mut padded = [b' '; 80];
        let card: &Card = line.first_chunk().unwrap_or_else(|| {
            padded = card(line);
            &padded
        });
        if !self.columns.has_space() {
            self.full = true;
            return Ok(());
        }
        let position = [coordinate(card, 30, "x")?, coordinate(card, 38, "y")?, coordinate(card, 46, "z")?];
        let (residue_end, chain_start) = self.residue_and_chain(card);
        let name = self.tables.name.intern_field(card, 12, 16);
        let residue = self.tables.residue.intern_field(card, 17, residue_end);
        let chain = self.tables.chain.intern_field(card, chain_start, 22);
        let (residue_number, insertion_code) = residue_number(card)?;
        let atom = Atom {
            position,
            element: self.element(card, residue),
            name,
            residue,
            chain,
            label_chain: 0,
            residue_number,
            insertion_code,
            altloc: if card[16] > b' ' { card[16] } else { 0 },
            occupancy: self.optional(card, (54, 60), (1.0, "1"), "an occupancy"),
            b_factor: self.optional(card, (60, 66), (0.0, "0"), "a B-factor"),
            model: match self.models.current {
                Some(model) => model,
                None => self.models.begin(None),
            },
            hetero,
            kind: if hetero { Kind::Ligand } else { Kind::Polymer },
        };
        self.columns.push(&atom);
        Ok(())
    }

    /// Returns the end of the residue name and the start of the chain name. Column 21 belongs to one of them.
    #[inline]
    fn residue_and_chain(&mut self, card: &Card) -> (usize, usize) {
        if card[20] <= b' ' {
            return (20, 21);
        }
        let chains = self.two_letters.get_or_insert_with(|| TwoLetterChains::find(self.text));
        if chains.has(card) { (20, 20) } else { (21, 21) }
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

    #[inline]
    fn element(&mut self, card: &Card, residue: u32) -> u8 {
        let symbol = &card[76..78];
        let (from, to) = trimmed(symbol);
        if from < to && !numbered_line(card) {
            let z = atomic_number(&symbol[from..to]);
            if z != 0 {
                return z;
            }
        }
        self.guess(card, residue)
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
        let name = Name { text: &columns[from..to], columns: (!self.left_justified).then_some(columns) };
        let z = element::guess(name, self.tables.residue.text(residue));
        self.guesses.insert((u32::from_le_bytes(columns), residue), z);
        z
    }
}

/// Describes the content of a file without atoms.
fn describe(text: &[u8]) -> String {
    /// Number of lines searched for record names.
    const LINES: usize = 10_000;
    let mut records: Vec<String> = Vec::new();
    for (start, end) in Lines::new(text).take(LINES) {
        let line = &text[start..end];
        let word = text::decode(line[..line.len().min(6)].trim_ascii()).into_owned();
        if records.len() < 10 && !word.is_empty() && !records.contains(&word) {
            records.push(word);
        }
    }
    let (n_lines, _) = text::line_and_column(text, text.len().saturating_sub(1));
    format!(
        "a PDB file of {n_lines} lines without ATOM and HETATM; it has {}",
        text::list(records.iter().cloned(), records.len())
    )
}
