//! PDB files: fixed columns, as written since 1972 and by programs that take liberties.
//!
//! Columns in this file are counted from 0 in code and from 1 in comments and messages, as the format description
//! (wwPDB, version 3.3) does. Read are ATOM, HETATM, MODEL, ENDMDL, END, HEADER and TITLE; atom serial numbers are
//! not, so overflowing ones are harmless. Liberties that are understood: lines without the columns after the
//! coordinates, hybrid-36 and five-digit residue numbers, residue names of four letters, chains of two, no element
//! columns, entry and line number in their place (before 1996), tabs, any line ending.

use std::collections::{HashMap, HashSet};

use super::atoms::{Atom, Columns, SourceFormat, Structure, Tables};
use super::element::{self, Name, atomic_number};
use super::error::StructureError;
use super::number::{hybrid36, real, single};
use super::read::{MAX_COORDINATE, ReadLimits};
use super::residue;
use super::scan::run_length;
use super::text::{self, Fault, tidy, trimmed};

/// Longest title that is kept, characters.
pub(super) const MAX_TITLE: usize = 1000;

type Card = [u8; 80];

pub(super) fn read(text: &[u8], limits: &ReadLimits) -> Result<Structure, StructureError> {
    let mut reader = Reader::new(text, limits);
    for line in Lines::new(text) {
        if let Err(fault) = reader.line(line) {
            return Err(fault.locate(text));
        }
        if reader.full {
            return Err(StructureError::TooManyAtoms { limit: limits.max_atoms });
        }
    }
    if reader.columns.len() == 0 {
        return Err(StructureError::NoAtoms { found: describe(text) });
    }
    let title = tidy(&reader.title, MAX_TITLE);
    Ok(reader.columns.finish(reader.tables, SourceFormat::Pdb, reader.id, title))
}

/// Lines that are not empty, as offsets, without their ends.
struct Lines<'a> {
    text: &'a [u8],
    at: usize,
    carriage_returns: bool,
}

impl<'a> Lines<'a> {
    fn new(text: &'a [u8]) -> Self {
        Self { text, at: 0, carriage_returns: memchr::memchr(b'\r', text).is_some() }
    }
}

impl Iterator for Lines<'_> {
    type Item = (usize, usize);

    #[inline]
    fn next(&mut self) -> Option<(usize, usize)> {
        let rest = self.text.get(self.at..).unwrap_or_default();
        let one_end = match rest {
            [b'\n', ..] => 1,
            [b'\r', b'\n', ..] => 2,
            _ => 0,
        };
        // Usually the next line begins right there.
        let next = if rest.get(one_end).is_some_and(|&b| b > b' ') { one_end } else { empty_lines(rest) };
        let start = self.at + next;
        let rest = self.text.get(start..).filter(|rest| !rest.is_empty())?;
        let len = if self.carriage_returns { memchr::memchr2(b'\n', b'\r', rest) } else { memchr::memchr(b'\n', rest) };
        self.at = start + len.unwrap_or(rest.len());
        Some((start, self.at))
    }
}

/// Length of the line ends and blank lines that `text` begins with.
fn empty_lines(text: &[u8]) -> usize {
    let blanks = &text[..run_length(text, false)];
    memchr::memrchr2(b'\n', b'\r', blanks).map_or(0, |i| i + 1)
}

/// Which model an atom belongs to. A number that comes back, and atoms after the end of a model, begin a new one.
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

struct Reader<'a> {
    text: &'a [u8],
    max_rows: usize,
    full: bool,
    tabs: bool,
    columns: Columns,
    tables: Tables,
    models: Models,
    id: Option<String>,
    title: Vec<u8>,
    /// Whether some atom's name of one letter stood in the first of its columns: this file's alignment says nothing.
    left_justified: bool,
    /// Guessed elements by name columns and residue.
    guesses: HashMap<(u32, u32), u8>,
    /// Columns 18-21 of the latest residue name that reaches into column 21, and whether that belongs to the chain.
    four_letters: ([u8; 4], bool),
}

impl<'a> Reader<'a> {
    fn new(text: &'a [u8], limits: &ReadLimits) -> Self {
        Self {
            text,
            max_rows: limits.max_rows(),
            full: false,
            tabs: memchr::memchr(b'\t', text).is_some(),
            columns: Columns::default(),
            tables: Tables::default(),
            models: Models::default(),
            id: None,
            title: Vec::new(),
            left_justified: false,
            guesses: HashMap::new(),
            four_letters: ([0; 4], false),
        }
    }

    #[inline]
    fn line(&mut self, (start, end): (usize, usize)) -> Result<(), Box<Fault>> {
        let line = &self.text[start..end];
        match line {
            [b'A', b'T', b'O', b'M'] | [b'A', b'T', b'O', b'M', b' ' | b'\t' | b'0'..=b'9', ..] => {
                self.atom(start, end, false)
            }
            [b'H', b'E', b'T', b'A', b'T', b'M', ..] => self.atom(start, end, true),
            [b'M' | b'E' | b'H' | b'T', ..] => self.other(start, line),
            _ => Ok(()),
        }
    }

    fn other(&mut self, start: usize, line: &[u8]) -> Result<(), Box<Fault>> {
        let word = &line[..line.len().min(6)];
        match word.trim_ascii_end() {
            b"MODEL" => self.model(start, line)?,
            b"ENDMDL" | b"END" => self.models.current = None,
            b"HEADER" if self.id.is_none() => {
                let id = line.get(62..66).unwrap_or_default();
                if id.first().is_some_and(u8::is_ascii_digit) && id.iter().all(u8::is_ascii_alphanumeric) {
                    self.id = tidy(id, 4);
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
        if self.tabs && line.contains(&b'\t') {
            let (expanded, origin) = expand_tabs(line);
            return self.columns_of(&expanded, hetero).map_err(|mut fault| {
                fault.at = start + origin.get(fault.at).copied().unwrap_or(line.len());
                fault
            });
        }
        self.columns_of(line, hetero).map_err(|mut fault| {
            fault.at += start;
            fault
        })
    }

    /// Reads the columns of one line; faults are relative to it.
    #[inline]
    fn columns_of(&mut self, line: &[u8], hetero: bool) -> Result<(), Box<Fault>> {
        if line.len() < 54 {
            let found = format!("a line of {} columns", line.len());
            return Err(Fault::words(line.len(), found, "coordinates in columns 31 to 54"));
        }
        let mut padded = [b' '; 80];
        let card: &Card = line.first_chunk().unwrap_or_else(|| {
            padded[..line.len()].copy_from_slice(line);
            &padded
        });
        if self.columns.len() >= self.max_rows {
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
            occupancy: optional(card, 54, 60, 1.0, "an occupancy")?,
            b_factor: optional(card, 60, 66, 0.0, "a B-factor")?,
            model: match self.models.current {
                Some(model) => model,
                None => self.models.begin(None),
            },
            hetero,
        };
        if self.columns.len() == 0 {
            // Were all lines as long as this one, so many atoms would fit.
            let rows = self.text.len() / (line.len() + 1) + 1;
            self.columns.reserve(rows.min(self.max_rows));
        }
        self.columns.push(&atom);
        Ok(())
    }

    /// Where the residue name ends and the chain begins: column 21 belongs to either.
    #[inline]
    fn residue_and_chain(&mut self, card: &Card) -> (usize, usize) {
        if card[20] <= b' ' {
            return (20, 21);
        }
        let four = [card[17], card[18], card[19], card[20]];
        if self.four_letters.0 != four {
            self.four_letters = (four, residue::splits_from_chain(four));
        }
        if self.four_letters.1 && card[21] > b' ' { (20, 20) } else { (21, 21) }
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

/// Whether columns 73-80 hold the entry's id and a line number, as before 1996: `4PTI  88`, `2HHBA 206`.
fn numbered_line(card: &Card) -> bool {
    card[72].is_ascii_digit()
        && card[73..76].iter().all(u8::is_ascii_alphanumeric)
        && card[79].is_ascii_digit()
        && (card[78].is_ascii_digit() || card[78] == b' ')
}

#[inline]
fn coordinate(card: &Card, from: usize, axis: &str) -> Result<f64, Box<Fault>> {
    match number(card, from, from + 8) {
        Some(value) if value.abs() <= MAX_COORDINATE => Ok(value),
        _ => Err(Fault::token(card, from, from + 8, format!("the {axis} coordinate in Å, within ±{MAX_COORDINATE}"))),
    }
}

/// A number that may be left out.
#[inline]
fn optional(card: &Card, from: usize, to: usize, default: f32, what: &str) -> Result<f32, Box<Fault>> {
    match number(card, from, to) {
        Some(value) => Ok(single(value)),
        None if trimmed(&card[from..to]).1 == 0 => Ok(default),
        None => Err(Fault::token(card, from, to, format!("{what} in columns {} to {to}, or blanks", from + 1))),
    }
}

/// The number in `card[from..to]`, with blanks around it.
#[inline]
fn number(card: &Card, from: usize, to: usize) -> Option<f64> {
    let mut start = from;
    while start < to && card[start] == b' ' {
        start += 1;
    }
    real(card, start, to).or_else(|| {
        let (a, b) = trimmed(&card[from..to]);
        real(card, from + a, from + b)
    })
}

/// Columns 23-26 and the insertion code in column 27, which is the fifth digit of numbers that need one.
#[inline]
fn residue_number(card: &Card) -> Result<(i32, u8), Box<Fault>> {
    let code = card[26];
    if code.is_ascii_digit() && card[22..26].iter().all(|b| b.is_ascii_digit() || *b == b'-') {
        let number = super::number::integer(&card[22..27]);
        return number.map(|n| (n, 0)).ok_or_else(|| Fault::token(card, 22, 27, "a residue number"));
    }
    let (from, to) = trimmed(&card[22..26]);
    let number = if from == to { Some(0) } else { hybrid36(&card[22 + from..22 + to]) };
    let number = number.ok_or_else(|| Fault::token(card, 22, 26, "a residue number, decimal or hybrid-36"))?;
    Ok((number, if code > b' ' { code } else { 0 }))
}

/// A line with tab stops every eight columns, and where each of its bytes came from.
fn expand_tabs(line: &[u8]) -> (Vec<u8>, Vec<usize>) {
    let (mut out, mut origin) = (Vec::with_capacity(96), Vec::with_capacity(96));
    // What lies beyond column 80 is not read; a tab is eight columns at most.
    for (i, &b) in line.iter().enumerate().take(96) {
        let columns = if b == b'\t' { 8 - out.len() % 8 } else { 1 };
        out.extend(std::iter::repeat_n(if b == b'\t' { b' ' } else { b }, columns));
        origin.extend(std::iter::repeat_n(i, columns));
    }
    (out, origin)
}

/// What a file without atoms holds.
fn describe(text: &[u8]) -> String {
    /// So many lines are looked at for records to name.
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
