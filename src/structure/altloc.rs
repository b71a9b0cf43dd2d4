//! Chooses one alternative location for each residue.
//!
//! Model, chain, number and insertion code identify a residue. Two residue names with the same values
//! (microheterogeneity) are alternatives of one residue. The same letter applies to the whole residue, so that bonded
//! atoms always come from one alternative.

use std::collections::HashMap;

use super::atoms::Structure;
use super::error::StructureError;
use super::read;
use super::select::Models;
use crate::surface::Control;

/// Atoms between two checks of the cancellation flag: about a millisecond.
pub(super) const ATOMS_PER_CHECK: usize = 1 << 16;

type ResidueKey = (i32, u32, i32, u8);

/// The chosen letter of each residue that has alternatives.
#[derive(Debug, Default)]
pub(super) struct Alternatives {
    chosen: HashMap<ResidueKey, u8>,
}

#[derive(Debug, Clone, Copy)]
struct Letter {
    code: u8,
    occupancy: f64,
    atoms: u32,
}

impl Letter {
    /// Mean occupancy in units of 10⁻⁴. Files give two or three digits, and equal occupancies must compare as equal.
    #[expect(clippy::cast_possible_truncation, reason = "an occupancy times ten thousand fits; other values saturate")]
    fn rank(&self) -> i64 {
        (self.occupancy / f64::from(self.atoms) * 1e4).round() as i64
    }
}

fn residue(structure: &Structure, i: usize) -> ResidueKey {
    (structure.model[i], structure.chain.id(i), structure.residue_number[i], structure.insertion_code[i])
}

impl Alternatives {
    /// Chooses an alternative for each residue of `models`: `preferred` if the residue has it, otherwise the one with
    /// the highest mean occupancy. Of equal ones, chooses the lowest letter.
    pub(super) fn choose(
        structure: &Structure,
        models: Models,
        preferred: Option<u8>,
        control: &Control<'_>,
    ) -> Result<Self, StructureError> {
        let mut letters: HashMap<ResidueKey, Vec<Letter>> = HashMap::new();
        for i in 0..structure.len() {
            if i % ATOMS_PER_CHECK == 0 {
                read::check(control)?;
            }
            if structure.altloc[i] == 0 || !models.contains(structure.model[i]) {
                continue;
            }
            let of_residue = letters.entry(residue(structure, i)).or_default();
            let (letter, occupancy) = (structure.altloc[i], f64::from(structure.occupancy[i]));
            match of_residue.iter_mut().find(|l| l.code == letter) {
                Some(known) => {
                    known.occupancy += occupancy;
                    known.atoms += 1;
                }
                None => of_residue.push(Letter { code: letter, occupancy, atoms: 1 }),
            }
        }
        let best = |letters: Vec<Letter>| {
            let has = letters.iter().find(|l| Some(l.code) == preferred);
            let best = letters.iter().max_by_key(|l| (l.rank(), std::cmp::Reverse(l.code)));
            has.or(best).map_or(0, |l| l.code)
        };
        Ok(Self { chosen: letters.into_iter().map(|(residue, letters)| (residue, best(letters))).collect() })
    }

    /// Returns true if atom `i` is common to all alternatives or belongs to the chosen one.
    pub(super) fn keeps(&self, structure: &Structure, i: usize) -> bool {
        structure.altloc[i] == 0 || self.chosen.get(&residue(structure, i)) == Some(&structure.altloc[i])
    }
}
