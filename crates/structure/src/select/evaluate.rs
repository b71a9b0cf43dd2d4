//! Evaluation of conditions: one mark for each atom of a structure.

use std::collections::BTreeSet;

use molmesh_surface::{Control, MemoryMeter as _, Reservation};

use super::expression::Condition;
use super::{SELECTED_CHAIN, chains, known_chains, near};
use crate::altloc::ATOMS_PER_CHECK;
use crate::read::{check, check_every};
use crate::{Structure, StructureError, TextColumn};

/// Mark for each atom: true if it matches. Holds the memory reservation of the marks.
pub(super) struct Marks {
    pub(super) atoms: Vec<bool>,
    _memory: Reservation,
}

/// Evaluation of conditions on the atoms of a structure.
pub(super) struct Evaluation<'a> {
    pub(super) structure: &'a Structure,
    pub(super) control: &'a Control<'a>,
    /// Number of tested distances.
    pub(super) distances: near::TestCount,
    /// Atoms that can be meshed; `within` and `byres` ignore the others. `None` if no condition depends on other atoms.
    pub(super) usable: Option<Marks>,
    /// True to reject chains that the structure lacks.
    pub(super) is_whole: bool,
}

impl Evaluation<'_> {
    /// Marks the atoms for which `holds` is true.
    pub(super) fn each(&self, mut holds: impl FnMut(usize) -> bool) -> Result<Marks, StructureError> {
        check(self.control)?;
        let n = self.structure.len();
        let memory = Reservation::new(&self.control.memory);
        memory.grow(n as u64)?;
        let mut atoms = Vec::with_capacity(n);
        for first in (0..n).step_by(ATOMS_PER_CHECK) {
            check(self.control)?;
            atoms.extend((first..n.min(first + ATOMS_PER_CHECK)).map(&mut holds));
        }
        Ok(Marks { atoms, _memory: memory })
    }

    /// Marks the atoms that match a condition.
    pub(super) fn marks(&self, condition: &Condition) -> Result<Marks, StructureError> {
        let s = self.structure;
        match condition {
            Condition::Kinds(set) => self.each(|i| set.has(s.kind[i])),
            Condition::Chains(names) => {
                let names = names.iter().map(String::as_str);
                let marks = if self.is_whole { chains(s, names, SELECTED_CHAIN)? } else { known_chains(s, names) };
                self.texts(&s.chain, &marks)
            }
            Condition::Residues(ranges) => {
                // The atoms of a residue are consecutive.
                let mut latest = ((i32::MIN, 0), false);
                self.each(|i| {
                    let residue = (s.residue_number[i], s.insertion_code[i]);
                    if latest.0 != residue || i == 0 {
                        let holds = ranges.iter().any(|range| (range.first..=range.last).contains(&residue));
                        latest = (residue, holds);
                    }
                    latest.1
                })
            }
            Condition::ResidueNames(names) => self.texts(&s.residue, &listed(&s.residue, names)),
            Condition::AtomNames(names) => self.texts(&s.name, &listed(&s.name, names)),
            Condition::Elements(numbers) => {
                let listed: [bool; 256] = std::array::from_fn(|z| u8::try_from(z).is_ok_and(|z| numbers.contains(&z)));
                self.each(|i| listed[usize::from(s.element[i])])
            }
            Condition::Within(distance, of) => {
                let of = self.usable(self.marks(of)?);
                let mut marks = self.each(|_| false)?;
                near::mark(s, &of.atoms, distance.angstrom(), &mut marks.atoms, &self.distances, self.control)?;
                Ok(marks)
            }
            Condition::ByResidue(of) => {
                let mut marks = self.usable(self.marks(of)?);
                self.complete_residues(&mut marks.atoms)?;
                Ok(marks)
            }
            Condition::Not(of) => {
                let mut marks = self.marks(of)?;
                marks.atoms.iter_mut().for_each(|mark| *mark = !*mark);
                Ok(marks)
            }
            Condition::And(parts) => self.fold(parts, |a, b| a & b),
            Condition::Or(parts) => self.fold(parts, |a, b| a | b),
        }
    }

    fn fold(&self, parts: &BTreeSet<Condition>, join: impl Fn(bool, bool) -> bool) -> Result<Marks, StructureError> {
        let mut parts = parts.iter();
        let Some(first) = parts.next() else { return self.each(|_| false) };
        let mut marks = self.marks(first)?;
        for part in parts {
            let other = self.marks(part)?;
            marks.atoms.iter_mut().zip(&other.atoms).for_each(|(mark, other)| *mark = join(*mark, *other));
        }
        Ok(marks)
    }

    /// Marks the atoms whose text in `column` is marked in `texts`.
    fn texts(&self, column: &TextColumn, texts: &[bool]) -> Result<Marks, StructureError> {
        self.each(|i| texts[column.id(i) as usize])
    }

    /// Removes the marks of atoms that cannot be meshed.
    fn usable(&self, mut marks: Marks) -> Marks {
        if let Some(usable) = &self.usable {
            marks.atoms.iter_mut().zip(&usable.atoms).for_each(|(mark, usable)| *mark &= usable);
        }
        marks
    }

    /// Marks all atoms of each residue that has a marked atom. The atoms of a residue are consecutive.
    fn complete_residues(&self, marks: &mut [bool]) -> Result<(), StructureError> {
        let s = self.structure;
        let mut first = 0;
        for i in 1..=marks.len() {
            check_every(self.control, i, ATOMS_PER_CHECK)?;
            if i == marks.len() || !s.same_residue(i - 1, i) {
                if marks[first..i].contains(&true) {
                    marks[first..i].fill(true);
                }
                first = i;
            }
        }
        Ok(())
    }
}

/// Returns, for each text, true if it is one of `names`, which are in upper case.
fn listed(column: &TextColumn, names: &BTreeSet<String>) -> Vec<bool> {
    column.texts().map(|text| names.contains(&text.to_ascii_uppercase())).collect()
}
