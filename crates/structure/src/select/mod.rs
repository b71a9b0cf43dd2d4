//! Selection of the atoms to mesh: an expression, chains, a model and alternative locations.

mod blocks;
mod context;
mod evaluate;
mod expression;
mod left_out;
mod near;
mod parse;
mod selected;

use std::collections::HashSet;
use std::num::NonZeroU32;
use std::ops::Range;

pub use blocks::{SelectedBlocks, SelectedOfBlock};
pub use context::Context;
use evaluate::{Evaluation, Marks};
pub use expression::Expression;
use left_out::Tally;
pub use left_out::{KindCount, LeftOut, ResidueCount};
use molmesh_surface::Control;
pub use parse::{BadExpression, MAX_DEPTH, MAX_DISTANCE, MAX_WITHIN};
pub use selected::Selected;

use super::altloc::Alternatives;
use super::atoms::Structure;
use super::contents::{Contents, Kind};
use super::copies::Assembly;
use super::error::StructureError;
use super::pieces;
use super::read::{ReadLimits, check};
use super::text::list;

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
    /// Atoms whose surface is made.
    pub context: Context,
    /// True to mesh the distinct units of the assembly instead of all copies.
    pub instances: bool,
    /// Number of the unit of the assembly to mesh without its operators, from 1 in the order of
    /// [`Selected::units`]; all copies by default.
    pub unit: Option<NonZeroU32>,
}

/// Number of atoms that a task selects or copies, and minimum number that a task moves: about 0.1 ms of work.
const ATOMS_PER_TASK: usize = 1 << 14;

/// Selects atoms.
///
/// # Errors
/// Returns [`StructureError::EmptySelection`] if no atom is selected, and [`StructureError::NotFound`] for a model,
/// chain, alternative location or assembly that does not exist. Returns [`StructureError::BadAssembly`] for an assembly
/// that cannot be built, and [`StructureError::Limit`] if it exceeds the default limits or `within` tests too many
/// distances.
pub fn select(structure: &Structure, selection: &Selection) -> Result<Selected, StructureError> {
    select_with(structure, selection, &ReadLimits::default(), &Control::default())
}

/// Selects atoms as [`select`] does, within `limits`. Checks for cancellation every few milliseconds, and adds the
/// memory of an assembly, and [`Structure::table_bytes`], to the meter of `control`.
///
/// # Errors
/// Returns the errors of [`select`], [`StructureError::Memory`] and [`StructureError::Cancelled`].
pub fn select_with(
    structure: &Structure,
    selection: &Selection,
    limits: &ReadLimits,
    control: &Control<'_>,
) -> Result<Selected, StructureError> {
    control.memory.grow(structure.table_bytes())?;
    let mut assembly = selection.assembly.as_deref().map(|id| Assembly::find(structure, id, control)).transpose()?;
    let rules = Rules::new(structure, selection, true, limits, control)?;
    let mut found = rules.find(structure.len(), assembly.as_ref(), control)?;
    if let Some(number) = selection.unit
        && !found.atoms.is_empty()
        && let Some(assembly) = assembly.take()
    {
        let before = found.atoms.len();
        found.atoms = assembly.unit(number, found.atoms, limits, control)?;
        found.left_out.other_chains += (before - found.atoms.len()) as u64;
    }
    let Found { atoms, mut left_out, residues } = found;
    let first = structure.model.first().copied().unwrap_or(1);
    let model = if let Models::One(model) = rules.models { model } else { first };
    let marks = rules.marks(&atoms, control)?;
    if !marks.as_ref().map_or(!atoms.is_empty(), |marks| marks.contains(&true)) {
        return Err(StructureError::EmptySelection { holds: holds(structure, selection, model) });
    }
    let texts: Vec<&str> = structure.residue.texts().collect();
    left_out.finish(residues.named(&texts).collect(), structure.unread);
    let selected =
        Selected { n_distinct: atoms.len(), atoms, marks, copies: Vec::new(), units: Vec::new(), model, left_out };
    match assembly {
        Some(assembly) if selection.instances => assembly.units(selected, limits, control),
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
    marks: Marks,
    hydrogens: bool,
    /// With [`Context::Whole`], marks of the atoms of the default selection, with their hydrogens.
    context: Option<Marks>,
    alternatives: Alternatives,
}

/// Atoms to mesh, and counts of the others.
#[derive(Default)]
struct Found {
    atoms: Vec<u32>,
    left_out: LeftOut,
    residues: Tally,
}

impl<'a> Rules<'a> {
    /// Prepares the selection of atoms of a structure, or of a block of one unless `is_whole`. A block may lack the
    /// model, the chains and the alternative location that are requested.
    fn new(
        structure: &'a Structure,
        selection: &Selection,
        is_whole: bool,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Self, StructureError> {
        let models = match selection.model {
            ModelChoice::Number(number) if !is_whole => Models::One(number),
            _ => models(structure, selection)?,
        };
        let of_names = |names: &Vec<String>| {
            let names = names.iter().map(String::as_str);
            if is_whole { chains(structure, names, "chain") } else { Ok(known_chains(structure, names)) }
        };
        let chains = selection.chains.as_ref().map(of_names).transpose()?;
        let wanted = match selection.altloc {
            Some(letter) if !is_whole => u8::try_from(letter).ok(),
            _ => alternative(structure, selection, models)?,
        };
        let alternatives = Alternatives::choose(structure, models, wanted, control)?;
        let Expression { condition, hydrogens } = &selection.atoms;
        if is_whole {
            let mut names = Vec::new();
            condition.chains(&mut names);
            // Fails for chains that do not exist.
            self::chains(structure, names, SELECTED_CHAIN)?;
        }
        let distances = near::TestCount::new(limits);
        let mut evaluation = Evaluation { structure, control, distances, usable: None, is_whole };
        if condition.depends_on_others() {
            evaluation.usable = Some(evaluation.each(|i| {
                models.contains(structure.model[i])
                    && structure.kind[i] != Kind::VirtualSite
                    && (*hydrogens || !structure.is_hydrogen(i))
                    && alternatives.keeps(i)
            })?);
        }
        let marks = evaluation.marks(condition)?;
        let context = match selection.context {
            Context::Selection => None,
            Context::Whole => Some(evaluation.marks(&Expression::default().condition)?),
        };
        Ok(Self { structure, models, chains, marks, hydrogens: *hydrogens, context, alternatives })
    }

    /// Returns true if atom `i` belongs to a selected chain.
    fn has_chain(&self, i: usize) -> bool {
        self.chains.as_ref().is_none_or(|chains| chains[self.structure.chain.id(i) as usize])
    }

    /// Returns true if atom `i` is meshed because of [`Context::Whole`], whether it is selected or not.
    fn is_context(&self, i: usize) -> bool {
        self.context.as_ref().is_some_and(|marks| marks.atoms[i] && !self.structure.is_hydrogen(i))
    }

    /// Marks the selected ones of the `atoms` to mesh; `None` without [`Context::Whole`], as all of them are selected.
    fn marks(&self, atoms: &[u32], control: &Control<'_>) -> Result<Option<Vec<bool>>, StructureError> {
        if self.context.is_none() {
            return Ok(None);
        }
        control.memory.grow(self.structure.len() as u64)?;
        let mut marks = vec![false; self.structure.len()];
        for atoms in atoms.chunks(ATOMS_PER_TASK) {
            check(control)?;
            for i in atoms.iter().map(|&i| i as usize) {
                let hydrogen = !self.hydrogens && self.structure.is_hydrogen(i);
                marks[i] = self.marks.atoms[i] && self.has_chain(i) && !hydrogen;
            }
        }
        Ok(Some(marks))
    }

    /// Finds the atoms to mesh among the first `n`, of the chains of `assembly` if there is one, in parallel.
    fn find(&self, n: usize, assembly: Option<&Assembly<'_>>, control: &Control<'_>) -> Result<Found, StructureError> {
        let range = |first| first..n.min(first + ATOMS_PER_TASK);
        let mut ranges: Vec<Range<usize>> = (0..n).step_by(ATOMS_PER_TASK).map(range).collect();
        let parts = pieces::map(&mut ranges, |range| check(control).map(|()| self.find_in(range.clone(), assembly)));
        let mut found = Found::default();
        let parts = parts.into_iter().collect::<Result<Vec<Found>, StructureError>>()?;
        found.atoms.reserve_exact(parts.iter().map(|part| part.atoms.len()).sum());
        for Found { atoms, left_out, residues } in parts {
            found.atoms.extend_from_slice(&atoms);
            found.left_out.add(&left_out);
            found.residues.append(residues);
        }
        Ok(found)
    }

    fn find_in(&self, range: Range<usize>, assembly: Option<&Assembly<'_>>) -> Found {
        let structure = self.structure;
        let Found { mut atoms, mut left_out, mut residues } = Found::default();
        for i in range {
            if !self.models.contains(structure.model[i]) {
                left_out.other_models += 1;
                continue;
            }
            let context = self.is_context(i);
            if !(context || self.has_chain(i)) || assembly.is_some_and(|assembly| !assembly.covers(i)) {
                left_out.other_chains += 1;
            } else if structure.kind[i] == Kind::VirtualSite {
                left_out.virtual_sites += 1;
            } else if !(context || self.marks.atoms[i]) {
                residues.add(structure.residue.id(i), structure.kind[i]);
            } else if !self.hydrogens && structure.is_hydrogen(i) {
                left_out.hydrogens += 1;
            } else if !self.alternatives.keeps(i) {
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
///
/// # Errors
/// [`StructureError::NotFound`] with `what`, if there is no such chain.
pub fn chains<'a>(
    structure: &'a Structure,
    requested: impl IntoIterator<Item = &'a str>,
    what: &'static str,
) -> Result<Vec<bool>, StructureError> {
    let known: HashSet<&str> = structure.chain.texts().collect();
    let requested: Vec<&str> = requested.into_iter().collect();
    let is_known = |name: &str| known.contains(name) || name == "_" && known.contains("");
    if let Some(unknown) = requested.iter().find(|name| !is_known(name)) {
        return Err(StructureError::NotFound {
            what,
            requested: format!("`{}`", unknown.chars().take(40).collect::<String>()),
            available: Contents::of(structure, None).chain_list(),
        });
    }
    Ok(known_chains(structure, requested))
}

/// Returns, for each text of the chain column, true if it is one of `requested`, as [`chains`] does. Ignores chains
/// that do not exist.
fn known_chains<'a>(structure: &'a Structure, requested: impl IntoIterator<Item = &'a str>) -> Vec<bool> {
    let has_underscore = structure.chain.texts().any(|text| text == "_");
    let name = |requested| if requested == "_" && !has_underscore { "" } else { requested };
    let names: HashSet<&str> = requested.into_iter().map(name).collect();
    structure.chain.texts().map(|text| names.contains(text)).collect()
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
            let letters = (1..=u8::MAX).filter(|&b| present[usize::from(b)]).map(|b| char::from(b).into()).collect();
            Err(not_found("alternative location", format!("`{requested}`"), letters))
        }
    }
}

/// Returns the error for a requested value that is not among the `available` ones.
fn not_found(what: &'static str, requested: String, mut available: Vec<String>) -> StructureError {
    available.sort_unstable();
    let n = available.len();
    let available = if n == 0 { "none".to_owned() } else { list(available, n) };
    StructureError::NotFound { what, requested, available }
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
