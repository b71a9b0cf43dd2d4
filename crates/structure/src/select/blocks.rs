//! Selection of the atoms of consecutive blocks of a structure.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::ops::Range;

use indexmap::IndexMap;
use molmesh_surface::{Control, MemoryMeter as _, Reservation};

use super::{ATOMS_PER_TASK, Found, LeftOut, ModelChoice, Rules, SELECTED_CHAIN, Selected, Selection, not_found};
use crate::contents::Kind;
use crate::copies::{AssemblyRules, chain_column};
use crate::error::StructureError;
use crate::pieces;
use crate::read::{ReadLimits, check};
use crate::source::Unread;
use crate::stream::Block;
use crate::texts::TextColumn;

/// Model, chain, number and insertion code of a residue.
type ResidueId = (i32, String, i32, u8);

/// Selected atoms of a block.
#[derive(Debug)]
pub struct SelectedOfBlock {
    /// Indices of the atoms in the block, ascending.
    pub atoms: Vec<u32>,
    /// Number of the chain of each atom among those of all blocks, as assemblies name them, in order of appearance; 0
    /// without an assembly.
    pub chains: Vec<u32>,
}

/// Counts of the atoms of a chain.
#[derive(Debug, Default)]
struct ChainCounts {
    n_selected: u64,
    left_out: LeftOut,
    residues: BTreeMap<(String, Kind), u64>,
}

/// Atoms selected so far. Errors of a whole structure, such as a missing chain, are found at the end.
#[derive(Debug)]
pub struct SelectedBlocks {
    /// Number of atoms.
    pub n_atoms: u64,
    /// Counts by the chain names that assemblies use; of all chains together without an assembly.
    by_chain: IndexMap<String, ChainCounts>,
    chains: HashSet<String>,
    models: HashSet<i32>,
    altlocs: HashSet<u8>,
    /// Residues of the file with alternative locations, with the number of their block.
    alternatives: HashMap<ResidueId, usize>,
    /// Length of the names of chains in `alternatives`, bytes.
    alternative_names: u64,
    n_blocks: usize,
    /// Atoms that were not read of the files before, and of the current one.
    unread: Unread,
    unread_of_file: Unread,
    first_model: Option<i32>,
    /// Memory of `alternatives`.
    memory: Reservation,
    /// Memory of `by_chain`, `chains` and `models`.
    chain_memory: Reservation,
}

/// Memory of the counts of a chain, and of those of a residue name, bytes, besides the names.
const CHAIN_BYTES: u64 = 3 * (size_of::<(String, ChainCounts)>() as u64) + 16;
const NAME_BYTES: u64 = 2 * (size_of::<((String, Kind), u64)>() as u64) + 16;
/// Memory of the atoms of a run of a chain besides their indices, bytes.
const RUN_BYTES: u64 = 2 * (size_of::<(u32, Found)>() + size_of::<(u32, Range<usize>)>()) as u64;
/// Memory of a residue with alternative locations, bytes.
const ALTERNATIVE_BYTES: u64 = 2 * (size_of::<(ResidueId, usize)>() as u64) + 16;

impl SelectedBlocks {
    /// Creates an empty selection.
    #[must_use]
    pub fn new(control: &Control<'_>) -> Self {
        Self {
            n_atoms: 0,
            by_chain: IndexMap::new(),
            chains: HashSet::new(),
            models: HashSet::new(),
            altlocs: HashSet::new(),
            alternatives: HashMap::new(),
            alternative_names: 0,
            n_blocks: 0,
            unread: Unread::default(),
            unread_of_file: Unread::default(),
            first_model: None,
            memory: Reservation::new(&control.memory),
            chain_memory: Reservation::new(&control.memory),
        }
    }

    /// Begins a file. Residues of different files are different residues.
    pub fn begin_file(&mut self) {
        let Unread { blocks, spheres } = std::mem::take(&mut self.unread_of_file);
        self.unread.blocks += blocks;
        self.unread.spheres += spheres;
        let names = std::mem::take(&mut self.alternative_names);
        self.memory.shrink(ALTERNATIVE_BYTES * self.alternatives.len() as u64 + names);
        self.alternatives = HashMap::new();
    }

    /// Selects atoms of the next block, of all chains.
    ///
    /// # Errors
    /// Returns [`StructureError::Limit`], [`StructureError::NotAStream`] and the errors of memory and cancellation.
    pub fn add(
        &mut self,
        block: &Block,
        selection: &Selection,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<SelectedOfBlock, StructureError> {
        let s = &block.structure;
        self.n_atoms += block.len as u64;
        self.unread_of_file = s.unread;
        if self.n_atoms > limits.too_many_atoms().max {
            return Err(limits.too_many_atoms().error());
        }
        let first_model = *self.first_model.get_or_insert_with(|| s.model.first().copied().unwrap_or(1));
        let model = match selection.model {
            ModelChoice::First => ModelChoice::Number(first_model),
            model => model,
        };
        let selection = Selection { model, ..selection.clone() };
        let rules = Rules::new(s, &selection, false, limits, control)?;
        self.note(block, &rules)?;
        // Only assemblies need the counts of each chain.
        let chains = selection.assembly.as_ref().map(|_| chain_column(s));
        let names: Vec<&str> = chains.map_or_else(|| vec![""], |chains| chains.texts().collect());
        let numbers = names.into_iter().map(|name| self.number(name)).collect::<Result<Vec<u32>, _>>()?;
        let residues: Vec<&str> = s.residue.texts().collect();
        let mut selected = SelectedOfBlock { atoms: Vec::new(), chains: Vec::new() };
        for (chain, found) in rules.find_by_chain(block.len, chains, control)? {
            let number = numbers[chain as usize];
            let counts = &mut self.by_chain[number as usize];
            counts.n_selected += found.atoms.len() as u64;
            counts.left_out.add(&found.left_out);
            for (name, kind, n) in found.residues.named(&residues) {
                let n_known = counts.residues.len();
                *counts.residues.entry((name.to_owned(), kind)).or_default() += n;
                if counts.residues.len() > n_known {
                    self.chain_memory.grow(NAME_BYTES + name.len() as u64)?;
                }
            }
            selected.chains.resize(selected.chains.len() + found.atoms.len(), number);
            selected.atoms.extend_from_slice(&found.atoms);
        }
        Ok(selected)
    }

    /// Returns the number of atoms of the files, including those that were not read.
    #[must_use]
    pub fn n_in_files(&self) -> u64 {
        let unread = [self.unread, self.unread_of_file].map(|unread| unread.blocks + unread.spheres);
        self.n_atoms + unread.iter().sum::<u64>()
    }

    /// Returns the number of a chain.
    fn number(&mut self, name: &str) -> Result<u32, StructureError> {
        let known = self.by_chain.get_index_of(name);
        let number = known.map_or_else(
            || {
                self.chain_memory.grow(CHAIN_BYTES + name.len() as u64)?;
                Ok::<_, StructureError>(self.by_chain.insert_full(name.to_owned(), ChainCounts::default()).0)
            },
            Ok,
        )?;
        // There are at most as many chains as atoms.
        Ok(u32::try_from(number).unwrap_or(u32::MAX))
    }

    /// Returns the names of the chains by number.
    pub fn chain_names(&self) -> Vec<&str> {
        self.by_chain.keys().map(String::as_str).collect()
    }

    /// Returns the number of selected atoms of each chain.
    pub fn n_of_chains(&self) -> Vec<u64> {
        self.by_chain.values().map(|counts| counts.n_selected).collect()
    }

    /// Notes chains, models and alternative locations of a block.
    fn note(&mut self, block: &Block, rules: &Rules<'_>) -> Result<(), StructureError> {
        let s = &block.structure;
        for name in s.chain.texts() {
            if !self.chains.contains(name) {
                // A message about an unknown chain lists the names.
                self.chain_memory.grow(2 * (NAME_BYTES + name.len() as u64))?;
                self.chains.insert(name.to_owned());
            }
        }
        self.n_blocks += 1;
        let n_known = self.models.len();
        self.models.extend(s.model[..block.len].chunk_by(|a, b| a == b).map(|run| run[0]));
        self.chain_memory.grow(NAME_BYTES * (self.models.len() - n_known) as u64)?;
        for i in 0..block.len {
            if s.altloc[i] == 0 || !rules.models.contains(s.model[i]) {
                continue;
            }
            self.altlocs.insert(s.altloc[i]);
            let residue = (s.model[i], s.chain.get(i).to_owned(), s.residue_number[i], s.insertion_code[i]);
            let n_known = self.alternatives.len();
            let block_of_residue = *self.alternatives.entry(residue).or_insert(self.n_blocks);
            if self.alternatives.len() > n_known {
                let name = s.chain.get(i).len() as u64;
                self.alternative_names += name;
                self.memory.grow(ALTERNATIVE_BYTES + name)?;
            }
            if block_of_residue != self.n_blocks {
                let (chain, number) = (s.chain.get(i), s.residue_number[i]);
                return Err(StructureError::NotAStream {
                    found: format!("alternative locations of residue {number} of chain `{chain}` in several places"),
                    expected: "residues with different numbers",
                });
            }
        }
        Ok(())
    }

    /// Ends the selection. With an `assembly`, only its chains count as selected.
    ///
    /// # Errors
    /// Returns [`StructureError::EmptySelection`], [`StructureError::NotFound`] for a model, chain or alternative
    /// location that does not exist, and [`StructureError::NotAStream`].
    pub fn finish(
        mut self,
        selection: &Selection,
        assembly: Option<&AssemblyRules<'_>>,
    ) -> Result<Selected, StructureError> {
        let mut names = Vec::new();
        selection.atoms.condition.chains(&mut names);
        let of_expression = names.into_iter().map(|name| (SELECTED_CHAIN, name));
        for (what, name) in selection.chains.iter().flatten().map(|name| ("chain", name.as_str())).chain(of_expression)
        {
            if name == "_" && ["", "_"].iter().all(|name| self.chains.contains(*name)) {
                let expected = "one of the two, or a chain by its name";
                return Err(StructureError::NotAStream { found: "a chain `_` and a blank chain".to_owned(), expected });
            }
            let is_known = self.chains.contains(name) || (name == "_" && self.chains.contains(""));
            if !is_known {
                let known = self.chains.iter().map(|name| format!("`{name}`")).collect();
                return Err(not_found(what, format!("`{}`", name.chars().take(40).collect::<String>()), known));
            }
        }
        let model = match selection.model {
            ModelChoice::Number(number) if !self.models.contains(&number) => {
                let known = self.models.iter().map(i32::to_string).collect();
                return Err(not_found("model", number.to_string(), known));
            }
            ModelChoice::Number(number) => number,
            ModelChoice::First | ModelChoice::All => self.first_model.unwrap_or(1),
        };
        if let Some(letter) = selection.altloc
            && !u8::try_from(letter).is_ok_and(|letter| self.altlocs.contains(&letter))
        {
            let known = self.altlocs.iter().map(|letter| char::from(*letter).to_string()).collect();
            return Err(not_found("alternative location", format!("`{letter}`"), known));
        }
        let (mut n_selected, mut left_out, mut residues) = (0, LeftOut::default(), BTreeMap::new());
        for (number, counts) in std::mem::take(&mut self.by_chain).into_values().enumerate() {
            let named_atoms: u64 = counts.residues.values().sum();
            if assembly.is_some_and(|assembly| !assembly.covers(number)) {
                let LeftOut { other_models, .. } = counts.left_out;
                left_out.other_models += other_models;
                left_out.other_chains += counts.n_selected + counts.left_out.sum() - other_models + named_atoms;
                continue;
            }
            n_selected += counts.n_selected;
            left_out.add(&counts.left_out);
            for (key, n) in counts.residues {
                *residues.entry(key).or_default() += n;
            }
        }
        if n_selected == 0 {
            let holds = format!("{} was requested; the files have {} atoms", selection.atoms, self.n_atoms);
            return Err(StructureError::EmptySelection { holds });
        }
        let counts = residues.iter().map(|((name, kind), n)| (name.as_str(), *kind, *n)).collect();
        // Adds the unread atoms of the last file.
        self.begin_file();
        left_out.finish(counts, self.unread);
        let (marks, copies, units) = (None, Vec::new(), Vec::new());
        let n_distinct = usize::try_from(n_selected).unwrap_or(usize::MAX);
        Ok(Selected { atoms: Vec::new(), marks, copies, units, n_distinct, model, left_out })
    }
}

impl Rules<'_> {
    /// Finds the atoms to mesh among the first `n`, in parallel: in file order by runs of atoms of one of the `chains`,
    /// or of all chains together, with the number 0.
    fn find_by_chain(
        &self,
        n: usize,
        chains: Option<&TextColumn>,
        control: &Control<'_>,
    ) -> Result<Vec<(u32, Found)>, StructureError> {
        let runs = chains.map_or_else(
            || vec![(0, n)],
            |chains| chains.ids()[..n].chunk_by(|a, b| a == b).map(|run| (run[0], run.len())).collect(),
        );
        let mut first = 0;
        let mut ranges: Vec<(u32, Range<usize>)> = Vec::new();
        for (chain, length) in runs {
            let end = first + length;
            ranges.extend((first..end).step_by(ATOMS_PER_TASK).map(|at| (chain, at..end.min(at + ATOMS_PER_TASK))));
            first = end;
        }
        control.memory.grow(RUN_BYTES * ranges.len() as u64)?;
        let find = |(chain, range): &mut (u32, Range<usize>)| {
            check(control).map(|()| (*chain, self.find_in(range.clone(), None)))
        };
        pieces::map(&mut ranges, find).into_iter().collect()
    }
}
