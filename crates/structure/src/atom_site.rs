//! Converts rows of the mmCIF category `atom_site` to atoms, for text and binary files alike. Defines the meaning of
//! every item, the fallback for missing items, and the errors for invalid ones.

use std::collections::HashMap;

use super::atom_layout::{Layout, NONE, POSITION};
use super::atoms::{self, Atom, Slices, Tables};
use super::contents::Kind;
use super::element::{self, AtomName};
use super::number::{self, single};
use super::read::MAX_COORDINATE;
use super::warnings::Warnings;

/// Maximum length of the name of an atom, residue or chain, bytes. Names in the dictionary have up to five characters.
const MAX_NAME: usize = 255;

/// Joins the string tables and warnings of readers of consecutive rows, and translates the ids in these rows.
pub(super) fn join<F>(parts: Vec<(Slices<'_>, AtomSite<F>)>) -> (Tables, Warnings<F>) {
    let mut warnings = Warnings::default();
    let tables = atoms::join(parts.into_iter().map(|(rows, site)| {
        warnings.append(site.warnings);
        (rows, site.tables)
    }));
    (tables, warnings)
}

/// A range of a text: `text[start..end]`. The fast number parser may read bytes of the text after the range.
#[derive(Debug, Clone, Copy)]
pub(super) struct Span<'a> {
    pub(super) text: &'a [u8],
    pub(super) start: usize,
    pub(super) end: usize,
}

impl<'a> Span<'a> {
    const EMPTY: Self = Span { text: &[], start: 0, end: 0 };

    #[inline]
    fn bytes(&self) -> &'a [u8] {
        &self.text[self.start..self.end]
    }

    #[inline]
    fn len(&self) -> usize {
        self.end - self.start
    }

    /// Parses a real number.
    #[inline]
    pub(super) fn real(self) -> Result<f64, BadNumber> {
        number::real(self.text, self.start, self.end).ok_or(BadNumber)
    }

    /// Parses an integer.
    #[inline]
    pub(super) fn integer(self) -> Result<i32, BadNumber> {
        number::integer(self.bytes()).ok_or(BadNumber)
    }
}

/// Error for a value that is not a number or is out of range.
#[derive(Debug, Clone, Copy)]
pub(super) struct BadNumber;

/// A row of text or binary data. Column [`NONE`] never has a value.
pub(super) trait AtomRow {
    /// Error type for invalid values.
    type Fault;

    /// Returns the text in a column, or `None` if there is no value.
    fn text(&self, column: usize) -> Option<Span<'_>>;

    /// Returns the real number in a column.
    #[inline]
    fn real(&self, column: usize) -> Result<Option<f64>, BadNumber> {
        self.text(column).map(Span::real).transpose()
    }

    /// Returns the integer in a column.
    #[inline]
    fn integer(&self, column: usize) -> Result<Option<i32>, BadNumber> {
        self.text(column).map(Span::integer).transpose()
    }

    /// Returns the error for an invalid value in a column.
    fn fault(&self, column: usize, expected: String) -> Self::Fault;
}

/// Converts rows to atoms.
#[derive(Debug)]
pub(super) struct AtomSite<F> {
    pub(super) layout: Layout,
    pub(super) tables: Tables,
    pub(super) warnings: Warnings<F>,
    /// Guessed elements by name and residue.
    guesses: HashMap<(u32, u32), u8>,
}

impl<F> AtomSite<F> {
    pub(super) fn new(layout: Layout) -> Self {
        Self { layout, tables: Tables::default(), warnings: Warnings::default(), guesses: HashMap::new() }
    }

    /// Converts a row.
    #[inline]
    pub(super) fn atom<R: AtomRow<Fault = F>>(&mut self, row: &R) -> Result<Atom, F> {
        let layout = self.layout;
        let position = [coordinate(row, &layout, 0)?, coordinate(row, &layout, 1)?, coordinate(row, &layout, 2)?];
        let span = name(row, layout.name)?;
        let name_id = self.tables.name.intern(span.text, span.start, span.end);
        let span = name(row, layout.residue)?;
        let residue = self.tables.residue.intern(span.text, span.start, span.end);
        let span = name(row, layout.chain)?;
        let chain = self.tables.chain.intern(span.text, span.start, span.end);
        let label_chain = if layout.label_chain == NONE {
            0
        } else {
            let span = name(row, [layout.label_chain, NONE])?;
            if layout.entity == NONE {
                self.tables.label_chain.intern(span.text, span.start, span.end)
            } else {
                let entity = name(row, [layout.entity, NONE])?;
                self.tables.chain_of_entity((span.text, span.start, span.end), entity.bytes())
            }
        };
        let (residue_number, insertion_code) = self.number(row);
        let hetero = self.hetero(row);
        // Sequence numbers matter only for HETATM records, which are few.
        let in_sequence = !hetero || matches!(row.integer(layout.sequence_number), Ok(Some(_)));
        Ok(Atom {
            position,
            element: self.element(row, name_id, residue),
            name: name_id,
            residue,
            chain,
            label_chain,
            residue_number,
            insertion_code,
            altloc: self.character(row, layout.altloc, "an alternative location", alternative),
            occupancy: self.optional(row, layout.occupancy, (1.0, "read as 1"), "an occupancy"),
            b_factor: self.optional(row, layout.b_factor, (0.0, "read as 0"), "a B-factor"),
            model: whole(row, layout.model, 1, "a model number")?,
            hetero,
            kind: if in_sequence { Kind::Polymer } else { Kind::Ligand },
        })
    }

    /// Reads residue number and insertion code.
    #[inline]
    fn number<R: AtomRow<Fault = F>>(&mut self, row: &R) -> (i32, u8) {
        let layout = self.layout;
        let code = self.character(row, layout.insertion_code, "an insertion code", |text| text[0]);
        let number = match row.integer(layout.number[0]) {
            Ok(None) => row.integer(layout.number[1]),
            number => number,
        };
        match number {
            Ok(number) => (number.unwrap_or(0), code),
            Err(BadNumber) => self.number_text(row, code),
        }
    }

    /// Reads a residue number that is no whole number: a number followed by an insertion code, or any text, which
    /// `label_seq_id` replaces.
    #[cold]
    fn number_text<R: AtomRow<Fault = F>>(&mut self, row: &R, code: u8) -> (i32, u8) {
        let [first, second] = self.layout.number;
        let column = if matches!(row.integer(first), Ok(None)) { second } else { first };
        let fault = || row.fault(column, "a residue number (a whole number), ? or .".to_owned());
        let text = row.text(column).map_or(&[][..], |span| span.bytes());
        let n_digits = text.len() - text.iter().rev().take_while(|b| b.is_ascii_alphabetic()).count();
        if let Some(number) = number::integer(&text[..n_digits])
            && n_digits < text.len()
        {
            self.warnings.add("read as number and insertion code", fault);
            return (number, if code == 0 { text[n_digits] } else { code });
        }
        let number = row.integer(second).ok().flatten();
        self.warnings.add(if number.is_some() { "replaced by label_seq_id" } else { "read as 0" }, fault);
        (number.unwrap_or(0), code)
    }

    /// Reads an optional character. `replacement` returns the one that replaces a longer text, with a
    /// warning.
    #[inline]
    fn character<R: AtomRow<Fault = F>>(
        &mut self,
        row: &R,
        column: usize,
        what: &str,
        replacement: impl Fn(&[u8]) -> u8,
    ) -> u8 {
        match row.text(column).map(|span| span.bytes()) {
            None | Some([b' ']) => 0,
            Some([character]) => *character,
            // An empty or blank quoted value counts as missing.
            Some(text) if text.iter().all(|&b| b == b' ') => 0,
            Some(text) => {
                self.warnings
                    .add("replaced by one character", || row.fault(column, format!("{what} of one character, ? or .")));
                replacement(text)
            }
        }
    }

    /// Reads an optional number. An unreadable one is replaced by the default, with a warning.
    #[inline]
    fn optional<R: AtomRow<Fault = F>>(
        &mut self,
        row: &R,
        column: usize,
        default: (f32, &'static str),
        what: &str,
    ) -> f32 {
        match row.real(column) {
            Ok(None) => return default.0,
            Ok(Some(value)) if single(value).is_finite() => return single(value),
            _ => {}
        }
        self.warnings.add(default.1, || row.fault(column, format!("{what}, ? or .")));
        default.0
    }

    /// Returns true for a HETATM record. An unknown record is read as ATOM, with a warning.
    #[inline]
    fn hetero<R: AtomRow<Fault = F>>(&mut self, row: &R) -> bool {
        let column = self.layout.group;
        match row.text(column).map(|span| span.bytes().trim_ascii_end()) {
            Some(b"HETATM") => true,
            None | Some(b"ATOM") => false,
            Some(_) => {
                self.warnings.add("read as ATOM", || row.fault(column, "ATOM or HETATM".to_owned()));
                false
            }
        }
    }

    #[inline]
    fn element<R: AtomRow>(&mut self, row: &R, name: u32, residue: u32) -> u8 {
        let symbol = row.text(self.layout.element).and_then(|span| element::stated(span.bytes()));
        symbol.unwrap_or_else(|| self.guess(name, residue))
    }

    #[cold]
    fn guess(&mut self, name: u32, residue: u32) -> u8 {
        let tables = &self.tables;
        *self.guesses.entry((name, residue)).or_insert_with(|| {
            let name = AtomName { text: tables.name.text(name).as_bytes(), columns: None };
            element::guess(name, tables.residue.text(residue))
        })
    }
}

#[inline]
fn coordinate<R: AtomRow>(row: &R, layout: &Layout, axis: usize) -> Result<f64, R::Fault> {
    let column = layout.position[axis];
    if let Ok(Some(value)) = row.real(column)
        && value.abs() <= MAX_COORDINATE
    {
        return Ok(value);
    }
    Err(row.fault(column, format!("{} in Å, within ±{MAX_COORDINATE}", POSITION[axis])))
}

/// Returns a name, which is empty if there is none.
#[inline]
fn name<R: AtomRow>(row: &R, columns: [usize; 2]) -> Result<Span<'_>, R::Fault> {
    match row.text(columns[0]).or_else(|| row.text(columns[1])) {
        None => Ok(Span::EMPTY),
        Some(span) if span.len() <= MAX_NAME => Ok(span),
        Some(_) => Err(row.fault(columns[0], format!("a name of at most {MAX_NAME} bytes"))),
    }
}

#[inline]
fn whole<R: AtomRow>(row: &R, columns: [usize; 2], default: i32, what: &str) -> Result<i32, R::Fault> {
    let value = match row.integer(columns[0]) {
        Ok(None) => row.integer(columns[1]),
        value => value,
    };
    match value {
        Ok(value) => Ok(value.unwrap_or(default)),
        Err(BadNumber) => Err(row.fault(columns[0], format!("{what} (a whole number), ? or ."))),
    }
}

/// Returns a Latin-1 character beyond ASCII for an alternative location of several characters. Different texts rarely
/// have the same one.
fn alternative(text: &[u8]) -> u8 {
    let hash = text.iter().fold(0_u8, |hash, b| hash.wrapping_mul(31).wrapping_add(*b));
    0xA1 + hash % 95
}
