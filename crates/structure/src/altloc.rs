//! Chooses the alternative location of each atom.
//!
//! The atoms of a residue come from the alternative with the highest mean occupancy. Atoms that it lacks come from
//! those common to all alternatives, else from the best of the others. Two residue names of one residue
//! (microheterogeneity) are alternatives too, which are not mixed.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::ops::Range;

use molmesh_surface::{Control, MemoryMeter as _, Reservation};
use rustc_hash::FxHashMap;

use super::atoms::Structure;
use super::error::StructureError;
use super::read;
use super::select::Models;

/// Atoms between two checks of the cancellation flag: about a millisecond.
pub(super) const ATOMS_PER_CHECK: usize = 1 << 16;

/// Memory of a residue with alternatives, bytes.
const RESIDUE_BYTES: u64 = 192;
/// Memory of an atom of the residue at hand, and of an atom name, bytes.
const ATOM_BYTES: u64 = 64;
const NAME_BYTES: u64 = 64;

/// Model, chain, number and insertion code of a residue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct ResidueKey {
    model: i32,
    chain: u32,
    label_chain: u32,
    number: i32,
    insertion_code: u8,
}

/// Atoms that are left out because another alternative is chosen.
#[derive(Debug)]
pub(super) struct Alternatives {
    /// By atom; empty if no atom has alternatives.
    left_out: Vec<bool>,
    _memory: Reservation,
}

/// Residue name and alternative location, 0 for atoms without one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct Conformer {
    residue: u32,
    altloc: u8,
}

impl Alternatives {
    /// Chooses an alternative for each atom of `models`: `preferred` in residues that have it, otherwise the one with
    /// the highest mean occupancy. Of equal ones, chooses the lowest letter.
    pub(super) fn choose(
        structure: &Structure,
        models: Models,
        preferred: Option<u8>,
        control: &Control<'_>,
    ) -> Result<Self, StructureError> {
        let memory = Reservation::new(&control.memory);
        if structure.altloc.iter().all(|&code| code == 0) {
            return Ok(Self { left_out: Vec::new(), _memory: memory });
        }
        memory.grow(structure.len() as u64)?;
        let mut left_out = vec![false; structure.len()];
        let _names = control.reserve(NAME_BYTES * structure.name.texts().len() as u64)?;
        let names = hydrogen_names(structure);
        let memory_of_residues = Reservation::new(&control.memory);
        let mut n_atoms = 0;
        for runs in residues(structure, models, &memory_of_residues, control)? {
            let n: usize = runs.iter().map(ExactSizeIterator::len).sum();
            n_atoms += n;
            if n_atoms >= ATOMS_PER_CHECK {
                read::check(control)?;
                n_atoms = 0;
            }
            let _atoms = control.reserve(ATOM_BYTES * n as u64)?;
            Residue::new(structure, &runs, &names).leave_out(preferred, &mut left_out);
        }
        Ok(Self { left_out, _memory: memory })
    }

    /// Returns true if atom `i` has no alternative or belongs to the chosen one.
    pub(super) fn keeps(&self, i: usize) -> bool {
        self.left_out.get(i) != Some(&true)
    }
}

/// Returns the rows of each residue of `models` that has alternatives, as runs of rows. Some programs write
/// alternatives in other places of the file: a later run belongs to the residue of its number if all its atoms have a
/// letter.
fn residues(
    structure: &Structure,
    models: Models,
    memory: &Reservation,
    control: &Control<'_>,
) -> Result<Vec<Vec<Range<usize>>>, StructureError> {
    let s = structure;
    let key = |i: usize| ResidueKey {
        model: s.model[i],
        chain: s.chain.id(i),
        label_chain: if s.label_chain.is_empty() { 0 } else { s.label_chain.id(i) },
        number: s.residue_number[i],
        insertion_code: s.insertion_code[i],
    };
    let mut residues: Vec<Vec<Range<usize>>> = Vec::new();
    let mut latest: HashMap<ResidueKey, usize> = HashMap::new();
    let (mut first, mut before) = (0, None);
    for i in 1..=s.len() {
        read::check_every(control, i, ATOMS_PER_CHECK)?;
        if i < s.len() && !s.starts_residue[i] {
            continue;
        }
        let (rows, here) = (first..i, key(first));
        // Consecutive residues of one number are different ones, as are those without a number.
        let may_continue = before != Some(here) && (here.number, here.insertion_code) != (0, 0);
        (first, before) = (i, Some(here));
        let codes = &s.altloc[rows.clone()];
        if !models.contains(here.model) || codes.iter().all(|&code| code == 0) {
            continue;
        }
        memory.grow(RESIDUE_BYTES)?;
        let known = latest.get(&here).copied().filter(|_| may_continue && codes.iter().all(|&code| code != 0));
        if let Some(residue) = known {
            residues[residue].push(rows);
        } else {
            latest.insert(here, residues.len());
            residues.push(vec![rows]);
        }
    }
    Ok(residues)
}

/// Returns the name that a hydrogen atom shares with its alternatives, by id of its own name: that of the hydrogen for
/// a deuterium, and otherwise the same.
fn hydrogen_names(structure: &Structure) -> Vec<u32> {
    let ids: FxHashMap<&str, u32> = structure.name.texts().zip(0..).collect();
    let hydrogen = |name: &str| ids.get(format!("H{}", name.strip_prefix('D')?).as_str()).copied();
    structure.name.texts().zip(0..).map(|(name, id)| hydrogen(name).unwrap_or(id)).collect()
}

/// An atom of a residue with alternatives.
#[derive(Debug, Clone, Copy)]
struct Alternative {
    name: u32,
    conformer: Conformer,
    row: usize,
}

/// Occupancies of a conformer.
#[derive(Debug, Clone, Copy)]
struct Occupancies {
    sum: f64,
    n: u32,
    first_row: usize,
}

impl Occupancies {
    /// Mean in units of 10⁻⁴. Files give two or three digits, and equal occupancies must compare as equal.
    #[expect(clippy::cast_possible_truncation, reason = "an occupancy times ten thousand fits; other values saturate")]
    fn rank(&self) -> i64 {
        (self.sum / f64::from(self.n) * 1e4).round() as i64
    }
}

/// Atoms of a residue with alternatives, by name.
struct Residue {
    atoms: Vec<Alternative>,
    /// Conformers by mean occupancy, best first.
    conformers: Vec<Conformer>,
}

impl Residue {
    fn new(structure: &Structure, runs: &[Range<usize>], hydrogen_names: &[u32]) -> Self {
        let atom = |row: usize| {
            let name = structure.name.id(row);
            let name = if structure.is_hydrogen(row) { hydrogen_names[name as usize] } else { name };
            let conformer = Conformer { residue: structure.residue.id(row), altloc: structure.altloc[row] };
            Alternative { name, conformer, row }
        };
        let mut atoms: Vec<Alternative> = runs.iter().cloned().flatten().map(atom).collect();
        atoms.sort_by_key(|atom| (atom.name, atom.conformer));
        let mut occupancies: HashMap<Conformer, Occupancies> = HashMap::new();
        let has_same_name =
            |a: &Alternative, b: &Alternative| (a.name, a.conformer.residue) == (b.name, b.conformer.residue);
        for same_name in atoms.chunk_by(has_same_name) {
            // An atom without a letter is an alternative of those of its name that have one.
            let has_letter = same_name.last().is_some_and(|last| last.conformer.altloc != 0);
            for atom in same_name.iter().filter(|_| has_letter) {
                let entry = occupancies.entry(atom.conformer);
                let known = entry.or_insert(Occupancies { sum: 0.0, n: 0, first_row: atom.row });
                known.sum += f64::from(structure.occupancy[atom.row]);
                known.n += 1;
                known.first_row = known.first_row.min(atom.row);
            }
        }
        let mut ranked: Vec<(Conformer, Occupancies)> = occupancies.into_iter().collect();
        ranked.sort_by_key(|(conformer, known)| (Reverse(known.rank()), conformer.altloc, known.first_row));
        Self { atoms, conformers: ranked.into_iter().map(|(conformer, _)| conformer).collect() }
    }

    /// Marks the atoms that other alternatives replace.
    fn leave_out(&self, preferred: Option<u8>, left_out: &mut [bool]) {
        let with_letter = self.conformers.iter().find(|conformer| Some(conformer.altloc) == preferred);
        let Some(&best) = with_letter.or(self.conformers.first()) else { return };
        let places: HashMap<Conformer, usize> = self.conformers.iter().copied().zip(0..).collect();
        // The best, then atoms without a letter, then the others.
        let order = |conformer: Conformer| (conformer != best, conformer.altloc != 0, places.get(&conformer));
        for same_name in self.atoms.chunk_by(|a, b| a.name == b.name) {
            let of_best_residue = same_name.iter().map(|a| a.conformer).filter(|c| c.residue == best.residue);
            let chosen = of_best_residue.min_by_key(|conformer| order(*conformer));
            for atom in same_name {
                // Atoms without a letter are common to all residue names, one of which they have.
                let is_common = chosen.is_none() && atom.conformer.altloc == 0;
                left_out[atom.row] = !(is_common || Some(atom.conformer) == chosen);
            }
        }
    }
}
