//! Selection of the atoms of consecutive blocks of a structure.

use std::collections::{HashMap, HashSet};

use super::{LeftOut, ModelChoice, Rules, SELECTED_CHAIN, Selected, Selection};
use crate::structure::contents::Kind;
use crate::structure::error::StructureError;
use crate::structure::read::{ReadLimits, check};
use crate::structure::stream::Block;
use crate::structure::text::list;
use crate::surface::{Control, MemoryMeter as _, Reservation};

/// Model, chain, number and insertion code of a residue.
type ResidueId = (i32, String, i32, u8);

/// Atoms selected so far. Errors of a whole structure, such as a missing chain, are found at the end.
#[derive(Debug)]
pub struct SelectedBlocks {
    /// Number of selected atoms.
    pub n_selected: u64,
    /// Number of atoms.
    pub n_atoms: u64,
    left_out: LeftOut,
    residues: HashMap<(String, Kind), u64>,
    chains: HashSet<String>,
    models: HashSet<i32>,
    altlocs: HashSet<u8>,
    /// Residues of the file with alternative locations, with the number of their block.
    alternatives: HashMap<ResidueId, usize>,
    n_blocks: usize,
    first_model: Option<i32>,
    /// Memory of `alternatives`.
    memory: Reservation,
}

/// Memory of a residue with alternative locations, bytes.
const ALTERNATIVE_BYTES: u64 = 2 * (size_of::<(ResidueId, usize)>() as u64) + 16;

impl SelectedBlocks {
    /// Creates an empty selection.
    #[must_use]
    pub fn new(control: &Control<'_>) -> Self {
        Self {
            n_selected: 0,
            n_atoms: 0,
            left_out: LeftOut::default(),
            residues: HashMap::new(),
            chains: HashSet::new(),
            models: HashSet::new(),
            altlocs: HashSet::new(),
            alternatives: HashMap::new(),
            n_blocks: 0,
            first_model: None,
            memory: Reservation::new(&control.memory),
        }
    }

    /// Begins a file. Residues of different files are different residues.
    pub fn begin_file(&mut self) {
        self.memory.shrink(ALTERNATIVE_BYTES * self.alternatives.len() as u64);
        self.alternatives = HashMap::new();
    }

    /// Selects atoms of the next block. Returns their indices, ascending.
    ///
    /// # Errors
    /// Returns [`StructureError::TooManyAtoms`], [`StructureError::NotAStream`] and the errors of memory and
    /// cancellation.
    pub fn add(
        &mut self,
        block: &Block,
        selection: &Selection,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Vec<u32>, StructureError> {
        let s = &block.structure;
        self.n_atoms += block.len as u64;
        // Indices of atoms have 32 bits.
        let limit = limits.max_atoms.min(u64::from(u32::MAX));
        if self.n_atoms > limit {
            return Err(StructureError::TooManyAtoms { limit });
        }
        let first_model = *self.first_model.get_or_insert_with(|| s.model.first().copied().unwrap_or(1));
        let model = match selection.model {
            ModelChoice::First => ModelChoice::Number(first_model),
            model => model,
        };
        let selection = Selection { model, ..selection.clone() };
        let rules = Rules::new(s, &selection, false, limits, control)?;
        self.note(block, &rules)?;
        let found = rules.find(block.len, None, control)?;
        check(control)?;
        self.left_out.add(&found.left_out);
        for (name, kind, n) in found.residues.named(s) {
            *self.residues.entry((name.to_owned(), kind)).or_default() += n;
        }
        self.n_selected += found.atoms.len() as u64;
        Ok(found.atoms)
    }

    /// Notes chains, models and alternative locations of a block.
    fn note(&mut self, block: &Block, rules: &Rules<'_>) -> Result<(), StructureError> {
        let s = &block.structure;
        for name in s.chain.texts() {
            if !self.chains.contains(name) {
                self.chains.insert(name.to_owned());
            }
        }
        self.n_blocks += 1;
        self.models.extend(s.model[..block.len].chunk_by(|a, b| a == b).map(|run| run[0]));
        for i in 0..block.len {
            if s.altloc[i] == 0 || !rules.models.contains(s.model[i]) {
                continue;
            }
            self.altlocs.insert(s.altloc[i]);
            let residue = (s.model[i], s.chain.get(i).to_owned(), s.residue_number[i], s.insertion_code[i]);
            let n_known = self.alternatives.len();
            let block_of_residue = *self.alternatives.entry(residue).or_insert(self.n_blocks);
            if self.alternatives.len() > n_known {
                self.memory.grow(ALTERNATIVE_BYTES)?;
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

    /// Ends the selection.
    ///
    /// # Errors
    /// Returns [`StructureError::EmptySelection`], [`StructureError::NotFound`] for a model, chain or alternative
    /// location that does not exist, and [`StructureError::NotAStream`].
    pub fn finish(mut self, selection: &Selection) -> Result<Selected, StructureError> {
        let missing = |what, requested: String, mut available: Vec<String>| {
            available.sort_unstable();
            let n = available.len();
            let available = if n == 0 { "none".to_owned() } else { list(available, n) };
            Err(StructureError::NotFound { what, requested, available })
        };
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
                return missing(what, format!("`{}`", name.chars().take(40).collect::<String>()), known);
            }
        }
        let model = match selection.model {
            ModelChoice::Number(number) if !self.models.contains(&number) => {
                return missing("model", number.to_string(), self.models.iter().map(i32::to_string).collect());
            }
            ModelChoice::Number(number) => number,
            ModelChoice::First | ModelChoice::All => self.first_model.unwrap_or(1),
        };
        if let Some(letter) = selection.altloc
            && !u8::try_from(letter).is_ok_and(|letter| self.altlocs.contains(&letter))
        {
            let known = self.altlocs.iter().map(|letter| char::from(*letter).to_string()).collect();
            return missing("alternative location", format!("`{letter}`"), known);
        }
        if self.n_selected == 0 {
            let holds = format!("{} was requested; the files have {} atoms", selection.atoms, self.n_atoms);
            return Err(StructureError::EmptySelection { holds });
        }
        let counts = self.residues.iter().map(|((name, kind), n)| (name.as_str(), *kind, *n)).collect();
        self.left_out.name_residues(counts);
        let (marks, copies, units) = (None, Vec::new(), Vec::new());
        Ok(Selected { atoms: Vec::new(), marks, copies, units, n_distinct: 0, model, left_out: self.left_out })
    }
}
