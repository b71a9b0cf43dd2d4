//! Marks the first atom of each residue, and resolves guessed elements.
//!
//! A residue begins where the model, the chain, the segment, the number or the insertion code changes. It also begins
//! where an atom name repeats with the same alternative location: files without residue numbers have many residues
//! under one number.

use rustc_hash::FxHashMap;

use super::atoms::{Slices, Tables};
use super::chemistry::TextClasses;
use super::element::{self, GUESSED};
use super::kinds::{Solvent, same_chain};

/// Memory of a name in the map of names, bytes.
const BYTES_PER_NAME: u64 = 64;
/// Maximum distance between alternatives of an atom in a residue without a number, Å. Waters are farther apart.
const ALTERNATIVE_DISTANCE: f64 = 5.0;
/// Maximum length of a bond, Å. A bond between carbon and iodine has 2.14 Å, one of hydrogen at most 1.3 Å.
const BOND: f64 = 2.2;
const HYDROGEN_BOND_LENGTH: f64 = 1.3;
/// Number of preceding atoms among which the bonds of an atom are searched.
const SEARCH_WINDOW: usize = 64;

/// Properties of atom names and residue names, by text id.
pub(super) struct Names {
    /// True for names that are the symbol of a non-metal without a number. Some programs give such names to all atoms
    /// of a ligand.
    symbols: Vec<bool>,
    /// True for names of beads of coarse-grained models.
    beads: Vec<bool>,
    /// True for residue names that are in no list.
    unknown: Vec<bool>,
    /// True for names of amino acids and nucleotides.
    polymer: Vec<bool>,
}

impl Names {
    pub(super) fn new(tables: &Tables, texts: &TextClasses<'_>, solvent: &Solvent) -> Self {
        let is_symbol = |name: &str| {
            let z = element::atomic_number(name.as_bytes());
            z != 0 && !element::is_metal(z) && name.bytes().all(|b| b.is_ascii_alphabetic())
        };
        let names = || (0..).take(tables.residue.texts().len());
        Self {
            symbols: tables.name.texts().map(is_symbol).collect(),
            beads: tables.name.texts().map(element::is_bead).collect(),
            unknown: names().map(|id| texts.is_unknown_name(id) && !solvent.has(id)).collect(),
            polymer: names().map(|id| texts.is_polymer_name(id)).collect(),
        }
    }

    /// Returns the memory for marking `n` rows, bytes.
    pub(super) fn marking_bytes(&self, n: usize) -> u64 {
        BYTES_PER_NAME * (n as u64).min(256 * self.symbols.len() as u64)
    }

    /// Marks the first atom of each residue.
    pub(super) fn mark(&self, rows: &mut Slices<'_>) {
        let mut latest: FxHashMap<(u32, u8), usize> = FxHashMap::default();
        let mut first = 0;
        for i in 0..rows.len() {
            let before = latest.insert((rows.name[i], rows.altloc[i]), i);
            let repeats = before.is_some_and(|before| before >= first);
            let starts = i == 0
                || !same_number(rows, i - 1, i)
                || (repeats && !self.is_bonded(rows, first, i))
                || self.is_distant_alternative(rows, first, i)
                || (!is_numbered(rows, i) && rows.residue[i] != rows.residue[i - 1]);
            rows.starts_residue[i] = starts;
            if starts {
                first = i;
            }
        }
    }

    /// Returns true if atom `i` is bonded to an atom of the residue that begins with `first`, so that it belongs to it
    /// in spite of its name: hydrogens, and atoms of ligands that have the names of their elements.
    fn is_bonded(&self, rows: &Slices<'_>, first: usize, i: usize) -> bool {
        let is_hydrogen = rows.element[i] & !GUESSED == 1;
        let may_repeat = self.symbols[rows.name[i] as usize] && self.unknown[rows.residue[i] as usize];
        let length = if is_hydrogen { HYDROGEN_BOND_LENGTH } else { BOND };
        let mut window = first.max(i.saturating_sub(SEARCH_WINDOW))..i;
        (is_hydrogen || may_repeat) && window.any(|j| squared_distance(rows, i, j) <= length * length)
    }

    /// Returns true if atom `i` of a residue without a number is too far from its namesake to be an alternative of it.
    fn is_distant_alternative(&self, rows: &Slices<'_>, first: usize, i: usize) -> bool {
        if rows.altloc[i] == 0 || is_numbered(rows, i) || self.polymer[rows.residue[i] as usize] {
            return false;
        }
        let mut window = first.max(i.saturating_sub(SEARCH_WINDOW))..i;
        let same_name = window.rfind(|&j| rows.name[j] == rows.name[i]);
        same_name.is_some_and(|j| squared_distance(rows, i, j) > ALTERNATIVE_DISTANCE * ALTERNATIVE_DISTANCE)
    }

    /// Replaces guessed elements by known ones: 0 in residues that have a bead of a coarse-grained model.
    pub(super) fn resolve_elements(&self, rows: &mut Slices<'_>) {
        if !rows.element.iter().any(|z| z & GUESSED != 0) {
            return;
        }
        let mut first = 0;
        while first < rows.len() {
            let end = (first + 1..rows.len()).find(|&i| rows.starts_residue[i]).unwrap_or(rows.len());
            let is_bead = |i: usize| {
                (rows.element[i] == 0 || rows.element[i] & GUESSED != 0) && self.beads[rows.name[i] as usize]
            };
            let has_bead = (first..end).any(is_bead);
            for z in rows.element[first..end].iter_mut().filter(|z| **z & GUESSED != 0) {
                *z = if has_bead { 0 } else { *z & !GUESSED };
            }
            first = end;
        }
    }
}

/// Returns true if two atoms have the same model, chain, segment, residue number and insertion code.
fn same_number(rows: &Slices<'_>, a: usize, b: usize) -> bool {
    rows.residue_number[a] == rows.residue_number[b]
        && rows.insertion_code[a] == rows.insertion_code[b]
        && (rows.label_chain[a] == rows.label_chain[b] || are_alternatives(rows.altloc[a], rows.altloc[b]))
        && same_chain(rows, a, b)
}

/// Returns true for different letters. Some programs give alternatives segments or chains of their own.
fn are_alternatives(a: u8, b: u8) -> bool {
    a != 0 && b != 0 && a != b
}

fn is_numbered(rows: &Slices<'_>, i: usize) -> bool {
    rows.residue_number[i] != 0 || rows.insertion_code[i] != 0
}

fn squared_distance(rows: &Slices<'_>, i: usize, j: usize) -> f64 {
    [&rows.x, &rows.y, &rows.z].map(|axis| axis[i] - axis[j]).iter().map(|d| d * d).sum()
}
