//! Converts rows of the mmCIF category `atom_site` to atoms, for text and binary files alike. Defines the meaning of
//! every item, the fallback for missing items, and the errors for invalid ones.

use std::collections::HashMap;

use super::atoms::{self, Atom, Slices, Tables};
use super::contents::Kind;
use super::element::{self, AtomName, atomic_number};
use super::error::StructureError;
use super::number::{self, single};
use super::read::MAX_COORDINATE;
use super::text;
use super::warnings::Warnings;

/// Maximum length of the name of an atom, residue or chain, bytes. Names in the dictionary have up to five characters.
const MAX_NAME: usize = 255;

/// Marks a column that does not exist.
pub(super) const NONE: usize = usize::MAX;

/// Column index of each item in a row; [`NONE`] for missing items.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    /// Number of items in a row.
    pub(super) width: usize,
    group: usize,
    element: usize,
    name: [usize; 2],
    residue: [usize; 2],
    chain: [usize; 2],
    number: [usize; 2],
    sequence_number: usize,
    insertion_code: usize,
    altloc: usize,
    position: [usize; 3],
    occupancy: usize,
    b_factor: usize,
    model: usize,
    label_chain: usize,
}

const POSITION: [&str; 3] = ["Cartn_x", "Cartn_y", "Cartn_z"];

impl Layout {
    /// Returns the layout of rows of `items`, in any letter case, or the index of an item that occurs twice.
    pub(super) fn of<'n>(items: impl ExactSizeIterator<Item = &'n [u8]>) -> Result<Self, usize> {
        let width = items.len();
        let mut found = HashMap::with_capacity(width);
        for (i, item) in items.enumerate() {
            if found.insert(item.to_ascii_lowercase(), i).is_some() {
                return Err(i);
            }
        }
        let column = |item: &str| found.get(item.to_ascii_lowercase().as_bytes()).copied().unwrap_or(NONE);
        // The author's item comes first, the dictionary's item is the fallback.
        let pair = |auth: &str, label: &str| match (column(auth), column(label)) {
            (NONE, label) => [label, NONE],
            (auth, label) => [auth, label],
        };
        Ok(Self {
            width,
            group: column("group_PDB"),
            element: column("type_symbol"),
            name: pair("auth_atom_id", "label_atom_id"),
            residue: pair("auth_comp_id", "label_comp_id"),
            chain: pair("auth_asym_id", "label_asym_id"),
            number: pair("auth_seq_id", "label_seq_id"),
            sequence_number: column("label_seq_id"),
            insertion_code: column("pdbx_PDB_ins_code"),
            altloc: column("label_alt_id"),
            position: POSITION.map(column),
            occupancy: column("occupancy"),
            b_factor: column("B_iso_or_equiv"),
            model: column("pdbx_PDB_model_num"),
            label_chain: column("label_asym_id"),
        })
    }

    /// Describes missing coordinate items for [`Passed::lacking`]. Returns `None` if all exist.
    pub(super) fn missing(&self) -> Option<String> {
        let missing: Vec<&str> =
            POSITION.iter().zip(self.position).filter(|(_, column)| *column == NONE).map(|(item, _)| *item).collect();
        (!missing.is_empty()).then(|| format!("atom_site without {}", missing.join(", ")))
    }

    /// Returns the text columns. The second of a pair is the fallback for rows where the first has no value.
    pub(super) fn texts(&self) -> [[usize; 2]; 8] {
        let alone = |column| [column, NONE];
        let (names, others) = ([self.name, self.residue, self.chain], [self.group, self.element]);
        let [name, residue, chain] = names;
        let [group, element] = others.map(alone);
        let [code, altloc, label] = [self.insertion_code, self.altloc, self.label_chain].map(alone);
        [group, element, name, residue, chain, code, altloc, label]
    }

    /// Returns the number columns, in the same form.
    pub(super) fn numbers(&self) -> [[usize; 2]; 8] {
        let [x, y, z] = self.position;
        let others = [x, y, z, self.occupancy, self.b_factor, self.model, self.sequence_number];
        let [x, y, z, occupancy, b_factor, model, sequence] = others.map(|column| [column, NONE]);
        [self.number, x, y, z, occupancy, b_factor, model, sequence]
    }

    /// Removes `label_seq_id`, except as a fallback for the author's number.
    pub(super) fn without_sequence_numbers(self) -> Self {
        Self { sequence_number: NONE, ..self }
    }
}

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
            self.tables.label_chain.intern(span.text, span.start, span.end)
        };
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
            residue_number: whole(row, layout.number, 0, "a residue number")?,
            insertion_code: character(row, layout.insertion_code, "an insertion code")?,
            altloc: character(row, layout.altloc, "an alternative location")?,
            occupancy: self.optional(row, layout.occupancy, (1.0, "1"), "an occupancy"),
            b_factor: self.optional(row, layout.b_factor, (0.0, "0"), "a B-factor"),
            model: whole(row, [layout.model, NONE], 1, "a model number")?,
            hetero,
            kind: if in_sequence { Kind::Polymer } else { Kind::Ligand },
        })
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
        match row.text(column).map(|span| span.bytes()) {
            Some(b"HETATM") => true,
            None | Some(b"ATOM") => false,
            Some(_) => {
                self.warnings.add("ATOM", || row.fault(column, "ATOM or HETATM".to_owned()));
                false
            }
        }
    }

    #[inline]
    fn element<R: AtomRow>(&mut self, row: &R, name: u32, residue: u32) -> u8 {
        let symbol = row.text(self.layout.element).map_or(0, |span| atomic_number(span.bytes()));
        if symbol != 0 { symbol } else { self.guess(name, residue) }
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

#[inline]
fn character<R: AtomRow>(row: &R, column: usize, what: &str) -> Result<u8, R::Fault> {
    match row.text(column) {
        None => Ok(0),
        Some(span) if span.len() == 1 => Ok(span.text[span.start]),
        // An empty or blank quoted value counts as missing.
        Some(span) if span.bytes().iter().all(|&b| b == b' ') => Ok(0),
        Some(_) => Err(row.fault(column, format!("{what} of one character, ? or ."))),
    }
}

/// Blocks and categories that the reader passed, for the error message of a file without atoms.
#[derive(Debug, Default)]
pub(super) struct Passed {
    categories: Vec<String>,
    blocks: usize,
}

impl Passed {
    /// Maximum number of categories in the message.
    const KEPT: usize = 10;

    pub(super) fn block(&mut self) {
        self.blocks += 1;
    }

    /// Returns true if the message already lists the maximum number of categories.
    pub(super) fn is_full(&self) -> bool {
        self.categories.len() >= Self::KEPT
    }

    /// Adds an `atom_site` without coordinates, described by [`Layout::missing`]. It is always part of the message.
    pub(super) fn lacking(&mut self, missing: String) {
        self.categories.push(missing);
    }

    /// Adds a category, by its name without underscore.
    pub(super) fn category(&mut self, name: impl AsRef<str> + Into<String>) {
        if !self.is_full() && !self.categories.iter().any(|c| c == name.as_ref()) {
            self.categories.push(name.into());
        }
    }

    /// Returns the error for a file of this `format` that ends, in this block, without atoms.
    pub(super) fn no_atoms(self, format: &str, block: Option<String>) -> StructureError {
        let block = block.map_or_else(|| "no named data block".to_owned(), |b| format!("data block {b}"));
        let more = if self.blocks > 1 { format!(" (the last of {})", self.blocks) } else { String::new() };
        let n = self.categories.len();
        let found = if n == 0 {
            format!("{format} with {block}{more} and nothing in it")
        } else {
            format!("{format} with {block}{more}, categories {}", text::list(self.categories, n))
        };
        StructureError::NoAtoms { found }
    }
}
