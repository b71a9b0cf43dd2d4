//! One row of `atom_site` to one atom.

use std::collections::HashMap;

use super::super::atoms::{Atom, Tables};
use super::super::cif::unquote;
use super::super::element::{self, Name, atomic_number};
use super::super::number::{integer, real, single};
use super::super::read::MAX_COORDINATE;
use super::super::text::Fault;

/// Tags of the category begin with this.
pub(super) const PREFIX: &[u8] = b"_atom_site.";

/// Longest name of an atom, a residue or a chain, bytes: the dictionary's have five.
const MAX_NAME: usize = 255;

/// No such column.
const NONE: usize = usize::MAX;

/// Where the items stand in a row.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    /// Items of a row.
    pub(super) width: usize,
    group: usize,
    element: usize,
    name: [usize; 2],
    residue: [usize; 2],
    chain: [usize; 2],
    number: [usize; 2],
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
    /// Finds the items among the tags of a loop, given as offsets into `text`.
    pub(super) fn new(text: &[u8], tags: &[(usize, usize)]) -> Result<Self, Box<Fault>> {
        let mut found: HashMap<Vec<u8>, usize> = HashMap::with_capacity(tags.len());
        for (i, &(start, end)) in tags.iter().enumerate() {
            let tag = text[start..end].to_ascii_lowercase();
            if found.insert(tag, i).is_some() {
                return Err(Fault::token(text, start, end, "every tag once in its category"));
            }
        }
        let column = |item: &str| {
            let tag = [PREFIX, item.to_ascii_lowercase().as_bytes()].concat();
            found.get(&tag).copied().unwrap_or(NONE)
        };
        // The author's item, then the dictionary's.
        let pair = |auth: &str, label: &str| match (column(auth), column(label)) {
            (NONE, label) => [label, NONE],
            (auth, label) => [auth, label],
        };
        Ok(Self {
            width: tags.len(),
            group: column("group_PDB"),
            element: column("type_symbol"),
            name: pair("auth_atom_id", "label_atom_id"),
            residue: pair("auth_comp_id", "label_comp_id"),
            chain: pair("auth_asym_id", "label_asym_id"),
            number: pair("auth_seq_id", "label_seq_id"),
            insertion_code: column("pdbx_PDB_ins_code"),
            altloc: column("label_alt_id"),
            position: POSITION.map(column),
            occupancy: column("occupancy"),
            b_factor: column("B_iso_or_equiv"),
            model: column("pdbx_PDB_model_num"),
            label_chain: column("label_asym_id"),
        })
    }

    /// Names the coordinates that are missing.
    pub(super) fn check(&self) -> Result<(), String> {
        let missing: Vec<&str> =
            POSITION.iter().zip(self.position).filter(|(_, column)| *column == NONE).map(|(item, _)| *item).collect();
        if missing.is_empty() { Ok(()) } else { Err(missing.join(", ")) }
    }
}

/// A row: where its values stand in the text. Most rows have no quotes, and are spared looking for them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Row<'a, const QUOTES: bool> {
    pub(super) text: &'a [u8],
    /// Offsets count from here.
    pub(super) base: usize,
    /// Start and end of each value, with its quotes.
    pub(super) offsets: &'a [u32],
}

impl<const QUOTES: bool> Row<'_, QUOTES> {
    /// Start and end of a value as it stands.
    #[inline]
    pub(super) fn raw(&self, column: usize) -> (usize, usize) {
        (self.base + self.offsets[2 * column] as usize, self.base + self.offsets[2 * column + 1] as usize)
    }

    /// Start and end of a value without quotes; `None` where there is no such column, or `?` or `.` stands there.
    #[inline]
    fn value(&self, column: usize) -> Option<(usize, usize)> {
        if column == NONE {
            return None;
        }
        let (start, end) = self.raw(column);
        let (start, end, quoted) = if QUOTES { unquote(self.text, start, end) } else { (start, end, false) };
        let null = !quoted && end - start == 1 && matches!(self.text[start], b'?' | b'.');
        (!null).then_some((start, end))
    }

    #[inline]
    fn first_of(&self, columns: [usize; 2]) -> Option<(usize, usize)> {
        self.value(columns[0]).or_else(|| self.value(columns[1]))
    }

    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "results stay small where nothing is wrong")]
    fn fault(&self, column: usize, expected: String) -> Box<Fault> {
        let (start, end) = self.raw(column);
        Fault::token(self.text, start, end, expected)
    }
}

/// Turns rows into atoms.
#[derive(Debug)]
pub(super) struct AtomSite {
    pub(super) layout: Layout,
    pub(super) tables: Tables,
    /// Guessed elements by name and residue.
    guesses: HashMap<(u32, u32), u8>,
}

impl AtomSite {
    pub(super) fn new(layout: Layout) -> Self {
        Self { layout, tables: Tables::default(), guesses: HashMap::new() }
    }

    #[inline]
    pub(super) fn atom<const QUOTES: bool>(&mut self, row: &Row<'_, QUOTES>) -> Result<Atom, Box<Fault>> {
        let layout = self.layout;
        let text = row.text;
        let position = [coordinate(row, &layout, 0)?, coordinate(row, &layout, 1)?, coordinate(row, &layout, 2)?];
        let (from, to) = text_of(row, row.first_of(layout.name), layout.name[0])?;
        let name = self.tables.name.intern(text, from, to);
        let (from, to) = text_of(row, row.first_of(layout.residue), layout.residue[0])?;
        let residue = self.tables.residue.intern(text, from, to);
        let (from, to) = text_of(row, row.first_of(layout.chain), layout.chain[0])?;
        let chain = self.tables.chain.intern(text, from, to);
        let label_chain = if layout.label_chain == NONE {
            0
        } else {
            let (from, to) = text_of(row, row.value(layout.label_chain), layout.label_chain)?;
            self.tables.label_chain.intern(text, from, to)
        };
        Ok(Atom {
            position,
            element: self.element(row, name, residue),
            name,
            residue,
            chain,
            label_chain,
            residue_number: whole(row, row.first_of(layout.number), layout.number[0], 0, "a residue number")?,
            insertion_code: character(row, layout.insertion_code, "an insertion code")?,
            altloc: character(row, layout.altloc, "an alternative location")?,
            occupancy: optional(row, layout.occupancy, 1.0, "an occupancy")?,
            b_factor: optional(row, layout.b_factor, 0.0, "a B-factor")?,
            model: whole(row, row.value(layout.model), layout.model, 1, "a model number")?,
            hetero: hetero(row, layout.group)?,
        })
    }

    #[inline]
    fn element<const QUOTES: bool>(&mut self, row: &Row<'_, QUOTES>, name: u32, residue: u32) -> u8 {
        let symbol = row.value(self.layout.element).map_or(0, |(start, end)| atomic_number(&row.text[start..end]));
        if symbol != 0 { symbol } else { self.guess(name, residue) }
    }

    #[cold]
    fn guess(&mut self, name: u32, residue: u32) -> u8 {
        let tables = &self.tables;
        *self.guesses.entry((name, residue)).or_insert_with(|| {
            let name = Name { text: tables.name.text(name).as_bytes(), columns: None };
            element::guess(name, tables.residue.text(residue))
        })
    }
}

#[inline]
fn coordinate<const QUOTES: bool>(row: &Row<'_, QUOTES>, layout: &Layout, axis: usize) -> Result<f64, Box<Fault>> {
    let column = layout.position[axis];
    if let Some((start, end)) = row.value(column)
        && let Some(value) = real(row.text, start, end)
        && value.abs() <= MAX_COORDINATE
    {
        return Ok(value);
    }
    Err(row.fault(column, format!("{} in Å, within ±{MAX_COORDINATE}", POSITION[axis])))
}

/// A name, empty where there is none.
#[inline]
fn text_of<const QUOTES: bool>(
    row: &Row<'_, QUOTES>,
    value: Option<(usize, usize)>,
    column: usize,
) -> Result<(usize, usize), Box<Fault>> {
    match value {
        None => Ok((0, 0)),
        Some((start, end)) if end - start <= MAX_NAME => Ok((start, end)),
        Some(_) => Err(row.fault(column, format!("a name of at most {MAX_NAME} bytes"))),
    }
}

#[inline]
fn optional<const QUOTES: bool>(
    row: &Row<'_, QUOTES>,
    column: usize,
    default: f32,
    what: &str,
) -> Result<f32, Box<Fault>> {
    let Some((start, end)) = row.value(column) else { return Ok(default) };
    match real(row.text, start, end) {
        Some(value) => Ok(single(value)),
        None => Err(row.fault(column, format!("{what}, ? or ."))),
    }
}

#[inline]
fn whole<const QUOTES: bool>(
    row: &Row<'_, QUOTES>,
    value: Option<(usize, usize)>,
    column: usize,
    default: i32,
    what: &str,
) -> Result<i32, Box<Fault>> {
    let Some((start, end)) = value else { return Ok(default) };
    integer(&row.text[start..end]).ok_or_else(|| row.fault(column, format!("{what} (a whole number), ? or .")))
}

#[inline]
fn character<const QUOTES: bool>(row: &Row<'_, QUOTES>, column: usize, what: &str) -> Result<u8, Box<Fault>> {
    match row.value(column) {
        None => Ok(0),
        Some((start, end)) if end - start == 1 => Ok(row.text[start]),
        // An empty or blank quoted value is another way to say that there is none.
        Some((start, end)) if row.text[start..end].iter().all(|&b| b == b' ') => Ok(0),
        Some(_) => Err(row.fault(column, format!("{what} of one character, ? or ."))),
    }
}

#[inline]
fn hetero<const QUOTES: bool>(row: &Row<'_, QUOTES>, column: usize) -> Result<bool, Box<Fault>> {
    let Some((start, end)) = row.value(column) else { return Ok(false) };
    match &row.text[start..end] {
        b"ATOM" => Ok(false),
        b"HETATM" => Ok(true),
        _ => Err(row.fault(column, "ATOM or HETATM".to_owned())),
    }
}
