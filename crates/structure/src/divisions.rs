//! Division of a file into blocks whose kinds do not depend on each other.

use std::sync::atomic::Ordering;

use super::atoms::Structure;
use super::error::StructureError;
use super::kinds::{OPEN, POLYMER, UNLINKED, are_numbered};
use super::read::Reading;
use super::residue;

/// Findings on the records of consecutive blocks of a file.
#[derive(Debug, Default)]
pub(super) struct BlockFindings(u8);

impl BlockFindings {
    /// Adds the findings of a block.
    pub(super) fn add(&mut self, reading: &Reading<'_>) {
        self.0 |= reading.findings.load(Ordering::Relaxed);
    }

    /// Rejects records whose sequence numbers do not distinguish polymers, and files without any polymer but residues
    /// that may be one: the blocks assume otherwise. `expected` describes a file of known entities.
    pub(super) fn check(&self, expected: &'static str) -> Result<(), StructureError> {
        if self.0 & (UNLINKED | POLYMER) == UNLINKED {
            let found =
                "no residues but those with unknown names in ATOM records, which are polymer or ligand".to_owned();
            return Err(StructureError::NotAStream { found, expected: "a polymer" });
        }
        if self.0 & OPEN == 0 || are_numbered(self.0) {
            return Ok(());
        }
        let found = "HETATM records with `label_seq_id` in chains of unknown entity, but no HETATM record without it, or \
                     water with it";
        Err(StructureError::NotAStream { found: found.to_owned(), expected })
    }
}

/// Returns the last row before which a file can be divided: the kinds and alternative locations of the rows before and
/// after it do not depend on each other. Returns `None` without such a row.
pub(super) fn last_division(structure: &Structure) -> Option<usize> {
    (1..structure.len()).rev().find(|&i| divides(structure, i))
}

fn divides(s: &Structure, i: usize) -> bool {
    let before = i - 1;
    // A Drude particle follows its atom.
    if s.name.get(i).starts_with('D') {
        return false;
    }
    if s.chain.id(i) != s.chain.id(before) || s.model[i] != s.model[before] {
        return true;
    }
    // Names of one number and code are alternatives.
    if (s.residue_number[i], s.insertion_code[i]) == (s.residue_number[before], s.insertion_code[before]) {
        return false;
    }
    let both = |of: fn(&str) -> bool| of(s.residue.get(before)) && of(s.residue.get(i));
    both(residue::is_water) || (both(residue::is_polymer) && !s.hetero[before] && !s.hetero[i])
}
