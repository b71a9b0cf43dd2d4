//! Selection of the atoms to mesh: an expression, chains, a model and alternative locations.

mod evaluate;
mod expression;
mod left_out;
mod near;
mod parse;

use std::collections::HashSet;
use std::ops::Range;

use evaluate::{Evaluation, Marks};
pub use expression::Expression;
pub use left_out::LeftOut;
use left_out::Tally;
pub use parse::{BadExpression, MAX_DEPTH, MAX_DISTANCE, MAX_WITHIN};
use rayon::prelude::*;

use super::altloc::Alternatives;
use super::atoms::Structure;
use super::contents::{Contents, Kind};
use super::copies::{Assembly, PlacedCopy};
use super::error::StructureError;
use super::read::{ReadLimits, Reading, check};
use super::text::list;
use super::{duplicates, pieces};
use crate::surface::{Control, Spheres, SurfaceError};

/// Models of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ModelChoice {
    /// The first model.
    #[default]
    First,
    /// The model with this number.
    Number(i32),
    /// All models.
    All,
}

/// Models that a selection takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Models {
    One(i32),
    All,
}

impl Models {
    /// Returns true if `model` is one of them.
    #[inline]
    pub(super) fn contains(self, model: i32) -> bool {
        match self {
            Self::One(number) => number == model,
            Self::All => true,
        }
    }
}

/// Selection of atoms. Default: first model, polymer, no hydrogens, alternative locations with the highest occupancy.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Selection {
    /// Models to select from.
    pub model: ModelChoice,
    /// Author names of chains; all by default. The empty string and `_` select the blank chain.
    pub chains: Option<Vec<String>>,
    /// Condition on atoms.
    pub atoms: Expression,
    /// Preferred alternative location, for residues that have it.
    pub altloc: Option<char>,
    /// Id of the assembly to build from the selected atoms; the asymmetric unit by default.
    pub assembly: Option<String>,
}

/// Result of a selection.
#[derive(Debug, Clone, PartialEq)]
pub struct Selected {
    /// Indices of the selected atoms in the columns of the structure: ascending, or by copy in an assembly.
    pub atoms: Vec<u32>,
    /// Copies that form the assembly; empty for the asymmetric unit.
    pub copies: Vec<PlacedCopy>,
    /// Number of selected atoms before they were copied.
    pub n_distinct: usize,
    /// The selected model; the first one if all are selected.
    pub model: i32,
    /// Counts of the other atoms of the selected models.
    pub left_out: LeftOut,
}

/// Number of atoms that a task selects or copies, and minimum number that a task moves: about 0.1 ms of work.
const ATOMS_PER_TASK: usize = 1 << 14;

/// Selects atoms.
///
/// # Errors
/// Returns [`StructureError::EmptySelection`] if no atom is selected, and [`StructureError::NotFound`] for a model,
/// chain, alternative location or assembly that does not exist. Returns [`StructureError::BadAssembly`],
/// [`StructureError::TooManyCopies`] and [`StructureError::AssemblyTooLarge`] for an assembly that cannot be built
/// within the default limits.
pub fn select(structure: &Structure, selection: &Selection) -> Result<Selected, StructureError> {
    select_with(structure, selection, &ReadLimits::default(), &Control::default())
}

/// Selects atoms as [`select`] does, within `limits`. Checks for cancellation every few milliseconds, and adds the
/// memory of an assembly to the meter of `control`.
///
/// # Errors
/// Returns the errors of [`select`], [`StructureError::TooManyDistances`], [`StructureError::Memory`] and
/// [`StructureError::Cancelled`].
pub fn select_with(
    structure: &Structure,
    selection: &Selection,
    limits: &ReadLimits,
    control: &Control<'_>,
) -> Result<Selected, StructureError> {
    let assembly = selection.assembly.as_deref().map(|id| Assembly::find(structure, id)).transpose()?;
    let models = models(structure, selection)?;
    let chains = match &selection.chains {
        Some(names) => Some(chains(structure, names.iter().map(String::as_str), "chain")?),
        None => None,
    };
    let wanted = alternative(structure, selection, models)?;
    let alternatives = Alternatives::choose(structure, models, wanted, control)?;
    let Expression { condition, hydrogens } = &selection.atoms;
    let mut names = Vec::new();
    condition.chains(&mut names);
    // Fails for chains that do not exist.
    self::chains(structure, names, SELECTED_CHAIN)?;
    let distances = near::TestCount::new(limits);
    let mut evaluation = Evaluation { structure, control, distances, usable: None };
    if condition.depends_on_others() {
        evaluation.usable = Some(evaluation.each(|i| {
            models.contains(structure.model[i])
                && structure.kind[i] != Kind::VirtualSite
                && (*hydrogens || !structure.is_hydrogen(i))
                && alternatives.keeps(structure, i)
        })?);
    }
    let marks = evaluation.marks(condition)?;
    let rules =
        Rules { structure, models, chains, assembly: assembly.as_ref(), marks, hydrogens: *hydrogens, alternatives };
    let Found { atoms, mut left_out, residues } = rules.find(control)?;
    let first = structure.model.first().copied().unwrap_or(1);
    let model = if let Models::One(model) = models { model } else { first };
    if atoms.is_empty() {
        return Err(StructureError::EmptySelection { holds: holds(structure, selection, model) });
    }
    left_out.name_residues(structure, residues);
    let selected = Selected { n_distinct: atoms.len(), atoms, copies: Vec::new(), model, left_out };
    match assembly {
        Some(assembly) => assembly.copy(selected, limits, control),
        None => Ok(selected),
    }
}

/// Rules by which atoms are selected.
struct Rules<'a> {
    structure: &'a Structure,
    models: Models,
    /// True for selected chains, by id.
    chains: Option<Vec<bool>>,
    assembly: Option<&'a Assembly<'a>>,
    marks: Marks,
    hydrogens: bool,
    alternatives: Alternatives,
}

/// Selected atoms, and counts of the others.
#[derive(Default)]
struct Found {
    atoms: Vec<u32>,
    left_out: LeftOut,
    residues: Tally,
}

impl Rules<'_> {
    /// Finds the selected atoms, in parallel.
    fn find(&self, control: &Control<'_>) -> Result<Found, StructureError> {
        let n = self.structure.len();
        let range = |first| first..n.min(first + ATOMS_PER_TASK);
        let mut ranges: Vec<Range<usize>> = (0..n).step_by(ATOMS_PER_TASK).map(range).collect();
        let parts = pieces::map(&mut ranges, |range| check(control).map(|()| self.find_in(range.clone())));
        let mut found = Found::default();
        for part in parts {
            let Found { atoms, left_out, residues } = part?;
            found.atoms.extend_from_slice(&atoms);
            found.left_out.add(&left_out);
            found.residues.append(residues);
        }
        Ok(found)
    }

    fn find_in(&self, range: Range<usize>) -> Found {
        let Self { structure, chains, assembly, .. } = self;
        let Found { mut atoms, mut left_out, mut residues } = Found::default();
        for i in range {
            if !self.models.contains(structure.model[i]) {
                continue;
            }
            if chains.as_ref().is_some_and(|chains| !chains[structure.chain.id(i) as usize])
                || assembly.is_some_and(|assembly| !assembly.covers(i))
            {
                left_out.other_chains += 1;
            } else if structure.kind[i] == Kind::VirtualSite {
                left_out.virtual_sites += 1;
            } else if !self.marks.atoms[i] {
                residues.add(structure.residue.id(i), structure.kind[i]);
            } else if !self.hydrogens && structure.is_hydrogen(i) {
                left_out.hydrogens += 1;
            } else if !self.alternatives.keeps(structure, i) {
                left_out.alternatives += 1;
            } else {
                // The reader limits the number of atoms, so indices have 32 bits.
                atoms.push(u32::try_from(i).unwrap_or(u32::MAX));
            }
        }
        Found { atoms, left_out, residues }
    }
}

fn models(structure: &Structure, selection: &Selection) -> Result<Models, StructureError> {
    match selection.model {
        ModelChoice::First => Ok(Models::One(structure.model.first().copied().unwrap_or(1))),
        ModelChoice::All => Ok(Models::All),
        ModelChoice::Number(requested) if structure.model.contains(&requested) => Ok(Models::One(requested)),
        ModelChoice::Number(requested) => Err(StructureError::NotFound {
            what: "model",
            requested: requested.to_string(),
            available: Contents::of(structure, None).model_list(),
        }),
    }
}

/// Name of chains in an expression, in [`StructureError::NotFound`].
const SELECTED_CHAIN: &str = "selected chain";

/// Returns, for each text of the chain column, true if it is one of `requested`. `_` is the blank chain unless a chain
/// has this name.
fn chains<'a>(
    structure: &'a Structure,
    requested: impl IntoIterator<Item = &'a str>,
    what: &'static str,
) -> Result<Vec<bool>, StructureError> {
    let known: HashSet<&str> = structure.chain.texts().collect();
    let mut names: HashSet<&str> = HashSet::new();
    for requested in requested {
        let name = if requested == "_" && !known.contains("_") { "" } else { requested };
        if !known.contains(name) {
            return Err(StructureError::NotFound {
                what,
                requested: format!("`{}`", requested.chars().take(40).collect::<String>()),
                available: Contents::of(structure, None).chain_list(),
            });
        }
        names.insert(name);
    }
    Ok(structure.chain.texts().map(|text| names.contains(text)).collect())
}

fn alternative(structure: &Structure, selection: &Selection, models: Models) -> Result<Option<u8>, StructureError> {
    let Some(requested) = selection.altloc else { return Ok(None) };
    let mut present = [false; 256];
    for (altloc, _) in structure.altloc.iter().zip(&structure.model).filter(|(_, model)| models.contains(**model)) {
        present[usize::from(*altloc)] = true;
    }
    match u8::try_from(requested) {
        Ok(letter) if letter != 0 && present[usize::from(letter)] => Ok(Some(letter)),
        _ => {
            let letters: Vec<String> =
                (1..=u8::MAX).filter(|&b| present[usize::from(b)]).map(|b| char::from(b).into()).collect();
            let n = letters.len();
            let available = if n == 0 { "none".to_owned() } else { list(letters, n) };
            Err(StructureError::NotFound {
                what: "alternative location",
                requested: format!("`{requested}`"),
                available,
            })
        }
    }
}

/// Describes the contents of the file and the parameters that select them.
fn holds(structure: &Structure, selection: &Selection, model: i32) -> String {
    let contents = Contents::of(structure, Some(model));
    let counts = contents.counts;
    let mut kinds: Vec<&str> = Vec::new();
    let of_kinds =
        [("polymer", counts.polymer), ("ligand", counts.ligand), ("ion", counts.ion), ("water", counts.water)];
    for (name, atoms) in of_kinds {
        if atoms > 0 {
            kinds.push(name);
        }
    }
    let heavy = !kinds.is_empty();
    if !heavy && counts.hydrogens > 0 {
        kinds = vec!["all"];
    }
    let hint = if kinds.is_empty() {
        "an atom of radius 0 and a site that is not an atom have no surface".to_owned()
    } else {
        format!("`select={}` selects them", kinds.join(","))
    };
    let requested: String = selection.atoms.to_string().chars().take(200).collect();
    let chains = match &selection.chains {
        Some(names) => format!(" of chains {}", list(names.iter().cloned(), names.len())),
        None => String::new(),
    };
    let assembly = selection.assembly.as_ref().map(|id| format!(" in assembly {id}")).unwrap_or_default();
    format!(
        "{requested}{chains}{assembly} was requested; model {model} has {counts} in {}; the file has {}; {hint}",
        contents.chain_list(),
        contents.model_list(),
    )
}

impl Selected {
    /// Returns the selected atoms as spheres with van der Waals radii.
    ///
    /// # Errors
    /// Returns [`SurfaceError::BadSphere`] if a coordinate is out of range.
    pub fn spheres(&self, structure: &Structure) -> Result<Spheres, SurfaceError> {
        let (n, atoms) = (self.atoms.len(), self.atoms.chunks(ATOMS_PER_TASK));
        let (mut x, mut y, mut z, mut r) = (vec![0.0; n], vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        let centres = x.chunks_mut(ATOMS_PER_TASK).zip(y.chunks_mut(ATOMS_PER_TASK)).zip(z.chunks_mut(ATOMS_PER_TASK));
        let mut parts: Vec<_> = atoms.zip(centres).zip(r.chunks_mut(ATOMS_PER_TASK)).collect();
        pieces::map(&mut parts, |((atoms, ((x, y), z)), r)| {
            for (row, i) in atoms.iter().map(|&i| i as usize).enumerate() {
                (x[row], y[row], z[row]) = (structure.x[i], structure.y[i], structure.z[i]);
                r[row] = structure.vdw_radius(i);
            }
        });
        for PlacedCopy { rows, operator } in &self.copies {
            let rows = || rows.clone();
            let moved = (&mut x[rows()], &mut y[rows()], &mut z[rows()]).into_par_iter().with_min_len(ATOMS_PER_TASK);
            moved.for_each(|(x, y, z)| [*x, *y, *z] = operator.apply([*x, *y, *z]));
        }
        Spheres::new(x, y, z, r)
    }

    /// Rejects an assembly in which more atoms than allowed have the same position.
    ///
    /// # Errors
    /// Returns [`StructureError::TooManyDuplicates`] and the errors of memory and cancellation.
    pub fn check_duplicates(
        &self,
        spheres: &Spheres,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<(), StructureError> {
        if self.copies.is_empty() {
            // The reader has checked the atoms of the file.
            return Ok(());
        }
        duplicates::check(spheres.len(), |i| (self.model, spheres.centre(i)), &Reading::new(limits, control))
    }
}
