//! Copies of the selected atoms that form an assembly.

use std::collections::HashMap;
use std::ops::Range;

use super::assembly::{BadExpression, Generator, Operator};
use super::atoms::Structure;
use super::contents::shown;
use super::error::StructureError;
use super::read::{ReadLimits, check};
use super::select::Selected;
use super::text::list;
use super::texts::TextColumn;
use crate::surface::Control;

/// Copy of atoms, moved by an operator.
#[derive(Debug, Clone, PartialEq)]
pub struct PlacedCopy {
    /// Rows of [`Selected::atoms`].
    pub rows: Range<usize>,
    /// Operator that moves the atoms to their positions in the assembly.
    pub operator: Operator,
}

/// Rule of an assembly with its chains.
struct RuleChains<'s> {
    generator: &'s Generator,
    /// Ids of the chains in their column, ascending.
    chains: Vec<u32>,
}

/// Assembly that a selection names.
pub(super) struct Assembly<'s> {
    structure: &'s Structure,
    id: &'s str,
    /// Column of the chain names that the assemblies of this file use.
    column: &'s TextColumn,
    parts: Vec<RuleChains<'s>>,
    /// True for chains of the assembly, by id.
    covered: Vec<bool>,
}

impl<'s> Assembly<'s> {
    /// Finds an assembly of the file.
    ///
    /// # Errors
    /// Returns [`StructureError::NotFound`] if the file has none with this id, [`StructureError::BadAssembly`] if it
    /// has no atoms of any of its chains.
    pub(super) fn find(structure: &'s Structure, id: &'s str) -> Result<Self, StructureError> {
        let column = if structure.label_chain.is_empty() { &structure.chain } else { &structure.label_chain };
        let ids: HashMap<&str, u32> = column.texts().zip(0..).collect();
        let part = |generator: &'s Generator| {
            let mut chains: Vec<u32> = generator.chains().filter_map(|name| ids.get(name).copied()).collect();
            chains.sort_unstable();
            chains.dedup();
            RuleChains { generator, chains }
        };
        let parts: Vec<RuleChains<'s>> = structure.assemblies.generators(id).map(part).collect();
        if parts.is_empty() {
            let known = structure.assemblies.list(0);
            let n = known.len();
            let names = list(known.into_iter().map(|(id, _)| id.to_owned()), n);
            return Err(StructureError::NotFound {
                what: "assembly",
                requested: format!("`{}`", id.chars().take(40).collect::<String>()),
                available: if n == 0 { "no assemblies".to_owned() } else { format!("the assemblies {names}") },
            });
        }
        let mut covered = vec![false; column.texts().len()];
        parts.iter().flat_map(|part| &part.chains).for_each(|&chain| covered[chain as usize] = true);
        if !covered.contains(&true) {
            let named: Vec<String> = parts.iter().flat_map(|part| part.generator.chains()).map(shown).collect();
            let n = named.len();
            return Err(StructureError::BadAssembly {
                id: id.chars().take(40).collect(),
                found: format!("chains without atoms: {}", list(named, n)),
                expected: format!("chains of the file: {}", list(column.texts().map(shown), column.texts().len())),
            });
        }
        Ok(Self { structure, id, column, parts, covered })
    }

    /// Returns true if the assembly contains the chain of atom `i`.
    #[inline]
    pub(super) fn covers(&self, i: usize) -> bool {
        self.covered[self.column.id(i) as usize]
    }

    /// Replaces the selected atoms by their copies, in the order of the file: by rule, operator, chain and atom.
    ///
    /// # Errors
    /// Returns [`StructureError::BadAssembly`], [`StructureError::TooManyCopies`] and
    /// [`StructureError::AssemblyTooLarge`], each before memory is allocated, and the errors of memory and
    /// cancellation.
    pub(super) fn copy(
        self,
        selected: Selected,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Selected, StructureError> {
        let assemblies = &self.structure.assemblies;
        let bad = |BadExpression { found, expected }| StructureError::BadAssembly { id: self.shown(), found, expected };
        let mut atoms = selected.atoms;
        let _sorting = control.reserve((size_of::<u32>() * atoms.len()) as u64)?;
        // Stable, so the atoms of a chain stay in file order.
        atoms.sort_by_key(|&i| self.column.id(i as usize));
        let rows = self.rows_of_chains(&atoms);
        let (mut n_copies, mut n_atoms) = (0_u64, 0_u64);
        let mut parts: Vec<(&Generator, Vec<Range<usize>>)> = Vec::new();
        for RuleChains { generator, chains } in &self.parts {
            let rows = chains.iter().map(|&chain| rows[chain as usize].clone());
            let rows: Vec<Range<usize>> = rows.filter(|rows| !rows.is_empty()).collect();
            if rows.is_empty() {
                continue;
            }
            let copies = assemblies.count(&generator.expression, limits.max_copies).map_err(bad)?;
            n_copies = n_copies.saturating_add(copies);
            if n_copies > limits.max_copies {
                return Err(StructureError::TooManyCopies { id: self.shown(), limit: limits.max_copies });
            }
            let of_copy: usize = rows.iter().map(ExactSizeIterator::len).sum();
            n_atoms = n_atoms.saturating_add(copies.saturating_mul(of_copy as u64));
            parts.push((generator, rows));
        }
        if n_atoms > limits.max_rows() as u64 {
            let id = self.shown();
            return Err(StructureError::AssemblyTooLarge { id, atoms: n_atoms, limit: limits.max_atoms });
        }
        let n_rows = usize::try_from(n_atoms).unwrap_or(usize::MAX);
        control.memory.grow(4 * n_atoms + size_of::<PlacedCopy>() as u64 * n_copies)?;
        let (mut all, mut copies) = (Vec::with_capacity(n_rows), Vec::new());
        for (generator, rows) in parts {
            for operator in assemblies.expand(&generator.expression).map_err(bad)? {
                check(control)?;
                let first = all.len();
                for rows in &rows {
                    all.extend_from_slice(&atoms[rows.clone()]);
                }
                copies.push(PlacedCopy { rows: first..all.len(), operator });
            }
        }
        Ok(Selected { atoms: all, copies, ..selected })
    }

    /// Returns the rows of each chain in `atoms`, which are sorted by chain.
    fn rows_of_chains(&self, atoms: &[u32]) -> Vec<Range<usize>> {
        let mut rows = vec![0..0; self.covered.len()];
        let mut first = 0;
        for chain in atoms.chunk_by(|&a, &b| self.column.id(a as usize) == self.column.id(b as usize)) {
            rows[self.column.id(chain[0] as usize) as usize] = first..first + chain.len();
            first += chain.len();
        }
        rows
    }

    /// Returns the id, shortened for a message.
    fn shown(&self) -> String {
        self.id.chars().take(40).collect()
    }
}
