//! Selection of the atoms to mesh.

use std::collections::HashSet;

use thiserror::Error;

use super::altloc::{ATOMS_PER_CHECK, Alternatives};
use super::atoms::Structure;
use super::contents::{Contents, Kind};
use super::error::StructureError;
use super::radii;
use super::read::check;
use super::text::list;
use crate::surface::{Control, Spheres, SurfaceError};

/// Selection of atoms. Default: first model, polymer, no hydrogens, alternative locations with the highest occupancy.
#[derive(Debug, Clone, PartialEq, Eq)]
#[expect(clippy::struct_excessive_bools, reason = "independent options, set by name")]
pub struct Selection {
    /// Model number in the file; the first model by default.
    pub model: Option<i32>,
    /// Author names of chains; all by default. The empty string and `_` select the blank chain.
    pub chains: Option<Vec<String>>,
    /// Chains of amino acids and nucleotides, modified residues included.
    pub polymer: bool,
    /// Ligands and ions.
    pub ligands: bool,
    /// Water.
    pub waters: bool,
    /// Hydrogen and deuterium of the selected residues.
    pub hydrogens: bool,
    /// Preferred alternative location, for residues that have it.
    pub altloc: Option<char>,
}

impl Default for Selection {
    fn default() -> Self {
        Self { model: None, chains: None, polymer: true, ligands: false, waters: false, hydrogens: false, altloc: None }
    }
}

/// Names that [`Selection::set_kinds`] accepts, in documentation order: four kinds, and `all` for all of them.
pub const KIND_NAMES: [&str; 5] = ["polymer", "ligand", "water", "hydrogens", "all"];

/// Error for an invalid list of kinds.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("`{value}` is not a kind of atoms; expected {expected}")]
pub struct BadKinds {
    /// The invalid value.
    pub value: String,
    /// Description of valid values.
    pub expected: String,
}

impl Selection {
    /// Selects exactly the kinds in a list such as `polymer,ligand,hydrogens`.
    ///
    /// # Errors
    /// Returns [`BadKinds`] for a name that is not in [`KIND_NAMES`], an empty list, and `hydrogens` alone.
    pub fn set_kinds(&mut self, names: &str) -> Result<(), BadKinds> {
        let mut taken = [false; 4];
        for name in names.split(',').map(str::trim) {
            match KIND_NAMES.iter().position(|&known| known == name) {
                Some(4) => taken = [true; 4],
                Some(kind) => taken[kind] = true,
                None => {
                    let expected = format!("a list of {}", KIND_NAMES.join(", "));
                    return Err(BadKinds { value: name.chars().take(40).collect(), expected });
                }
            }
        }
        let [polymer, ligands, waters, hydrogens] = taken;
        if !(polymer || ligands || waters) {
            let expected =
                "polymer, ligand or water as well: hydrogens are added to the atoms of other kinds".to_owned();
            return Err(BadKinds { value: "hydrogens".to_owned(), expected });
        }
        *self = Self { polymer, ligands, waters, hydrogens, ..std::mem::take(self) };
        Ok(())
    }

    /// Returns the kinds as a list that [`Self::set_kinds`] accepts.
    #[must_use]
    pub fn kinds(&self) -> String {
        let flags = [self.polymer, self.ligands, self.waters, self.hydrogens];
        let names: Vec<&str> =
            KIND_NAMES.iter().zip(flags).filter(|(_, taken)| *taken).map(|(name, _)| *name).collect();
        names.join(",")
    }

    fn takes(&self, kind: Kind) -> bool {
        match kind {
            Kind::Polymer => self.polymer,
            Kind::Ligand => self.ligands,
            Kind::Water => self.waters,
            Kind::VirtualSite => false,
        }
    }
}

/// Result of a selection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selected {
    /// Indices of the selected atoms in the columns of the structure, ascending.
    pub atoms: Vec<u32>,
    /// The selected model.
    pub model: i32,
    /// Counts of the other atoms of that model.
    pub left_out: LeftOut,
}

/// Largest number of residue names that are counted separately.
const MAX_NAMES: usize = 10;

/// Atoms of the model that were not selected. Each is counted under the first reason that applies, in field order.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LeftOut {
    /// Atoms of other chains.
    pub other_chains: u64,
    /// Sites that are not atoms: charge sites of water models, lone pairs, Drude particles.
    pub virtual_sites: u64,
    /// Atoms of other kinds, by residue name, most frequent first. At most ten names.
    pub residues: Vec<(String, u64)>,
    /// Atoms of other kinds, with any other residue name.
    pub other_residues: u64,
    /// Hydrogen and deuterium of selected residues.
    pub hydrogens: u64,
    /// Other alternative locations of selected residues.
    pub alternatives: u64,
}

impl LeftOut {
    /// Returns the number of atoms and sites that were not selected.
    #[must_use]
    pub fn total(&self) -> u64 {
        let named: u64 = self.residues.iter().map(|(_, n)| n).sum();
        named + self.other_chains + self.virtual_sites + self.other_residues + self.hydrogens + self.alternatives
    }

    /// Sets the counts of residue names from counts by residue name id.
    fn name_residues(&mut self, structure: &Structure, counts: &[u64]) {
        let counted = structure.residue.texts().zip(counts).filter(|(_, n)| **n > 0);
        let mut names: Vec<(&str, u64)> = counted.map(|(name, n)| (name, *n)).collect();
        names.sort_unstable_by(|(a, m), (b, n)| n.cmp(m).then(a.cmp(b)));
        let shown = names.len().min(MAX_NAMES);
        self.other_residues = names[shown..].iter().map(|(_, n)| n).sum();
        self.residues = names[..shown].iter().map(|(name, n)| ((*name).to_owned(), *n)).collect();
    }
}

/// Selects atoms.
///
/// # Errors
/// Returns [`StructureError::EmptySelection`] if no atom is selected, and [`StructureError::NotFound`] for a model,
/// chain or alternative location that does not exist.
pub fn select(structure: &Structure, selection: &Selection) -> Result<Selected, StructureError> {
    select_with(structure, selection, &Control::default())
}

/// Selects atoms as [`select`] does, and checks for cancellation every few milliseconds.
///
/// # Errors
/// Returns the errors of [`select`], and [`StructureError::Cancelled`].
pub fn select_with(
    structure: &Structure,
    selection: &Selection,
    control: &Control<'_>,
) -> Result<Selected, StructureError> {
    let model = model(structure, selection)?;
    let chains = chains(structure, selection)?;
    let wanted = alternative(structure, selection, model)?;
    let alternatives = Alternatives::choose(structure, model, wanted, control)?;
    let mut left_out = LeftOut::default();
    let mut by_residue = vec![0; structure.residue.texts().len()];
    let mut atoms: Vec<u32> = Vec::new();
    // The reader limits the number of atoms to 32 bits.
    for (i, index) in (0..structure.len()).zip(0_u32..) {
        if i % ATOMS_PER_CHECK == 0 {
            check(control)?;
        }
        if structure.model[i] != model {
            continue;
        }
        let kind = structure.kind[i];
        if chains.as_ref().is_some_and(|chains| !chains[structure.chain.id(i) as usize]) {
            left_out.other_chains += 1;
        } else if kind == Kind::VirtualSite {
            left_out.virtual_sites += 1;
        } else if !selection.takes(kind) {
            by_residue[structure.residue.id(i) as usize] += 1;
        } else if !selection.hydrogens && structure.is_hydrogen(i) {
            left_out.hydrogens += 1;
        } else if !alternatives.keeps(structure, i) {
            left_out.alternatives += 1;
        } else {
            atoms.push(index);
        }
    }
    if atoms.is_empty() {
        return Err(StructureError::EmptySelection { holds: holds(structure, selection, model) });
    }
    left_out.name_residues(structure, &by_residue);
    Ok(Selected { atoms, model, left_out })
}

fn model(structure: &Structure, selection: &Selection) -> Result<i32, StructureError> {
    match selection.model {
        None => Ok(structure.model.first().copied().unwrap_or(1)),
        Some(asked) if structure.model.contains(&asked) => Ok(asked),
        Some(asked) => Err(StructureError::NotFound {
            what: "model",
            asked: asked.to_string(),
            available: Contents::of(structure, None).model_list(),
        }),
    }
}

/// Returns, for each text of the chain column, true if it is selected.
fn chains(structure: &Structure, selection: &Selection) -> Result<Option<Vec<bool>>, StructureError> {
    let Some(asked) = &selection.chains else { return Ok(None) };
    let known: HashSet<&str> = structure.chain.texts().collect();
    let mut names: HashSet<&str> = HashSet::new();
    for name in asked {
        let name = if name == "_" && !known.contains("_") { "" } else { name.as_str() };
        if !known.contains(name) {
            return Err(StructureError::NotFound {
                what: "chain",
                asked: format!("`{}`", name.chars().take(40).collect::<String>()),
                available: Contents::of(structure, None).chain_list(),
            });
        }
        names.insert(name);
    }
    Ok(Some(structure.chain.texts().map(|text| names.contains(text)).collect()))
}

fn alternative(structure: &Structure, selection: &Selection, model: i32) -> Result<Option<u8>, StructureError> {
    let Some(asked) = selection.altloc else { return Ok(None) };
    let mut present = [false; 256];
    for (altloc, _) in structure.altloc.iter().zip(&structure.model).filter(|(_, m)| **m == model) {
        present[usize::from(*altloc)] = true;
    }
    match u8::try_from(asked) {
        Ok(letter) if letter != 0 && present[usize::from(letter)] => Ok(Some(letter)),
        _ => {
            let letters: Vec<String> =
                (1..=u8::MAX).filter(|&b| present[usize::from(b)]).map(|b| char::from(b).into()).collect();
            let n = letters.len();
            let available = if n == 0 { "none".to_owned() } else { list(letters, n) };
            Err(StructureError::NotFound { what: "alternative location", asked: format!("`{asked}`"), available })
        }
    }
}

/// Describes the contents of the file and the parameters that select them.
fn holds(structure: &Structure, selection: &Selection, model: i32) -> String {
    let contents = Contents::of(structure, Some(model));
    let counts = contents.counts;
    let mut kinds: Vec<&str> = Vec::new();
    for (name, atoms) in [("polymer", counts.polymer), ("ligand", counts.ligand), ("water", counts.water)] {
        if atoms > 0 {
            kinds.push(name);
        }
    }
    let heavy = !kinds.is_empty();
    if !heavy && counts.hydrogens > 0 {
        kinds = vec!["all"];
    }
    let asked = selection.kinds();
    let chains = match &selection.chains {
        Some(names) => format!(" of chains {}", list(names.iter().cloned(), names.len())),
        None => String::new(),
    };
    format!(
        "{asked}{chains} was asked for; model {model} has {counts} in {}; the file has {}; `select={}` takes them",
        contents.chain_list(),
        contents.model_list(),
        kinds.join(",")
    )
}

impl Selected {
    /// Returns the selected atoms as spheres with van der Waals radii.
    ///
    /// # Errors
    /// Returns [`SurfaceError::BadSphere`] if a coordinate is out of range.
    pub fn spheres(&self, structure: &Structure) -> Result<Spheres, SurfaceError> {
        let column = |c: &[f64]| self.atoms.iter().map(|&i| c[i as usize]).collect();
        let r = self.atoms.iter().map(|&i| radii::vdw_radius(structure.element[i as usize])).collect();
        Spheres::new(column(&structure.x), column(&structure.y), column(&structure.z), r)
    }
}
