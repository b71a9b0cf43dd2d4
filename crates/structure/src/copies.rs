//! Copies of the selected atoms that form an assembly, and its distinct units.

use std::collections::HashMap;
use std::num::NonZeroU32;
use std::ops::Range;

use indexmap::IndexMap;
use molmesh_surface::{Control, Exceeded, Limit, Reservation};

use super::assembly::{Assemblies, BadExpression, Generator, Operator};
use super::atoms::Structure;
use super::chain_placements::Placements;
use super::contents::shown;
use super::error::StructureError;
use super::read::{ReadLimits, check};
use super::select::Selected;
use super::text::list;
use super::texts::TextColumn;

/// Copy of atoms, moved by an operator.
#[derive(Debug, Clone, PartialEq)]
pub struct PlacedCopy {
    /// Rows of [`Selected::atoms`].
    pub rows: Range<usize>,
    /// Operator that moves the atoms to their positions in the assembly.
    pub operator: Operator,
}

/// Atoms that an assembly repeats, and their placements.
#[derive(Debug, Clone, PartialEq)]
pub struct Unit {
    /// Author names of the chains, separated by commas; at most 40 characters.
    pub name: String,
    /// Rows of [`Selected::atoms`].
    pub rows: Range<usize>,
    /// Operators that place the instances.
    pub operators: Vec<Operator>,
    /// Rotations of the operators, as unit quaternions (x, y, z, w).
    pub rotations: Vec<[f64; 4]>,
}

/// Maximum length of the name of a unit, characters.
const MAX_NAME: usize = 40;

/// Rule that applies, with the rows of each of its chains.
type AppliedRule<'s> = (&'s Generator, Vec<Range<usize>>);

/// Rows of the chains of a unit, with the rules that place it.
type UnitRules<'s> = IndexMap<Vec<Range<usize>>, Vec<&'s Generator>>;

/// Rule of an assembly with its chains.
struct RuleChains<'s> {
    generator: &'s Generator,
    /// Ids of the chains in their column, ascending.
    chains: Vec<u32>,
}

/// Returns the column of the chain names that the assemblies of a file use.
pub(super) fn chain_column(structure: &Structure) -> &TextColumn {
    if structure.label_chain.is_empty() { &structure.chain } else { &structure.label_chain }
}

/// Rules of an assembly for the chains of a file.
pub struct AssemblyRules<'s> {
    assemblies: &'s Assemblies,
    id: &'s str,
    parts: Vec<RuleChains<'s>>,
    /// True for chains of the assembly, by id.
    covered: Vec<bool>,
}

impl<'s> AssemblyRules<'s> {
    /// Finds an assembly among those of a file. `names` are the names of its chains by number.
    ///
    /// # Errors
    /// Returns [`StructureError::NotFound`], [`StructureError::BadAssembly`] without atoms, and the errors of memory.
    pub fn find(
        assemblies: &'s Assemblies,
        names: &[&str],
        id: &'s str,
        control: &Control<'_>,
    ) -> Result<Self, StructureError> {
        let mut ids: HashMap<&str, Vec<u32>> = HashMap::new();
        names.iter().copied().zip(0..).for_each(|(name, id)| ids.entry(name).or_default().push(id));
        let part = |generator: &'s Generator| {
            let chains = generator.chain_ids(&ids);
            control.memory.grow(size_of::<RuleChains<'_>>() as u64 + size_of_val(&*chains) as u64)?;
            Ok::<_, StructureError>(RuleChains { generator, chains })
        };
        let parts = assemblies.generators(id).map(part).collect::<Result<Vec<RuleChains<'s>>, _>>()?;
        if parts.is_empty() {
            let known = assemblies.list(0);
            let n = known.len();
            let names = list(known.into_iter().map(|(id, _)| id.to_owned()), n);
            return Err(StructureError::NotFound {
                what: "assembly",
                requested: format!("`{}`", id.chars().take(40).collect::<String>()),
                available: if n == 0 { "no assemblies".to_owned() } else { format!("the assemblies {names}") },
            });
        }
        let mut covered = vec![false; names.len()];
        parts.iter().flat_map(|part| &part.chains).for_each(|&chain| covered[chain as usize] = true);
        if !covered.contains(&true) {
            let named = || parts.iter().flat_map(|part| part.generator.chains()).map(shown);
            return Err(StructureError::BadAssembly {
                id: id.chars().take(40).collect(),
                found: format!("chains without atoms: {}", list(named(), named().count())),
                expected: format!("chains of the file: {}", list(names.iter().copied().map(shown), names.len())),
            });
        }
        Ok(Self { assemblies, id, parts, covered })
    }

    /// Returns true if the assembly contains the chain with this number.
    pub(crate) fn covers(&self, chain: usize) -> bool {
        self.covered[chain]
    }

    /// Returns the placements of chains with these numbers of selected atoms.
    ///
    /// # Errors
    /// Returns the errors of `Assembly::copy`.
    pub fn placements(
        &self,
        n_atoms: &[u64],
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Placements, StructureError> {
        let has_atoms = |chain: u32| n_atoms[chain as usize] > 0;
        let (rules, counts) = self.applied(has_atoms, limits)?;
        let of_rule = |(rule, copies): (&&RuleChains<'_>, &u64)| {
            copies.saturating_mul(rule.chains.iter().map(|chain| n_atoms[*chain as usize]).sum())
        };
        self.check_atoms(rules.iter().zip(&counts).map(of_rule).fold(0, u64::saturating_add), limits)?;
        control.memory.grow(size_of::<PlacedCopy>() as u64 * counts.iter().sum::<u64>())?;
        let mut placements = Placements { operators: Vec::new(), rules: Vec::new() };
        for rule in rules {
            check(control)?;
            let first = placements.operators.len();
            placements.operators.append(&mut self.expand(rule.generator)?);
            let chains = rule.chains.iter().copied().filter(|chain| has_atoms(*chain)).collect();
            placements.rules.push((chains, first..placements.operators.len()));
        }
        Ok(placements)
    }

    /// Returns the rules of which some chain has atoms, and their numbers of copies.
    fn applied(
        &self,
        has_atoms: impl Fn(u32) -> bool,
        limits: &ReadLimits,
    ) -> Result<(Vec<&RuleChains<'s>>, Vec<u64>), StructureError> {
        let (mut rules, mut counts) = (Vec::new(), Vec::new());
        let mut n_copies = 0_u64;
        for rule in self.parts.iter().filter(|rule| rule.chains.iter().any(|chain| has_atoms(*chain))) {
            let count = self.assemblies.count(&rule.generator.expression, limits.max_copies);
            counts.push(count.map_err(|bad| self.bad(bad))?);
            n_copies = n_copies.saturating_add(counts.last().copied().unwrap_or_default());
            if n_copies > limits.max_copies {
                let subject = format!("assembly {}", self.shown()).into();
                return Err(Exceeded { subject, ..Exceeded::new(Limit::Copies, limits.max_copies) }.error());
            }
            rules.push(rule);
        }
        Ok((rules, counts))
    }

    /// Checks the number of atoms to mesh, and returns it.
    fn check_atoms(&self, atoms: u64, limits: &ReadLimits) -> Result<usize, StructureError> {
        let n = usize::try_from(atoms).unwrap_or(usize::MAX);
        if n <= limits.max_rows() {
            return Ok(n);
        }
        let subject = format!("the selection of assembly {}", self.shown()).into();
        Err(Exceeded { subject, actual: Some(atoms), ..limits.too_many_atoms() }.error())
    }

    /// Returns the operators of a rule.
    fn expand(&self, generator: &Generator) -> Result<Vec<Operator>, StructureError> {
        self.assemblies.expand(&generator.expression).map_err(|bad| self.bad(bad))
    }

    fn bad(&self, BadExpression { found, expected }: BadExpression) -> StructureError {
        StructureError::BadAssembly { id: self.shown(), found, expected }
    }

    /// Returns the id, shortened for a message.
    fn shown(&self) -> String {
        self.id.chars().take(40).collect()
    }
}

/// Assembly that a selection names.
pub(super) struct Assembly<'s> {
    structure: &'s Structure,
    /// Column of the chain names that the assemblies of this file use.
    column: &'s TextColumn,
    rules: AssemblyRules<'s>,
}

impl<'s> Assembly<'s> {
    /// Finds an assembly of the file.
    ///
    /// # Errors
    /// Returns the errors of [`AssemblyRules::find`].
    pub(super) fn find(structure: &'s Structure, id: &'s str, control: &Control<'_>) -> Result<Self, StructureError> {
        let column = chain_column(structure);
        let rules = AssemblyRules::find(&structure.assemblies, &column.texts().collect::<Vec<_>>(), id, control)?;
        Ok(Self { structure, column, rules })
    }

    /// Returns true if the assembly contains the chain of atom `i`.
    #[inline]
    pub(super) fn covers(&self, i: usize) -> bool {
        self.rules.covers(self.column.id(i) as usize)
    }

    /// Replaces the selected atoms by their copies, in the order of the file: by rule, operator, chain and atom.
    ///
    /// # Errors
    /// Returns [`StructureError::BadAssembly`] and [`StructureError::Limit`], each before memory is allocated, and the
    /// errors of memory and cancellation.
    pub(super) fn copy(
        self,
        selected: Selected,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Selected, StructureError> {
        let mut atoms = selected.atoms;
        let _sorting = self.sort(&mut atoms, control)?;
        let (rules, counts) = self.applied(&atoms, limits)?;
        let n_copies: u64 = counts.iter().sum();
        let of_rule = |((_, rows), copies): (&AppliedRule<'_>, &u64)| copies.saturating_mul(n_rows(rows));
        let n_atoms = rules.iter().zip(&counts).map(of_rule).fold(0, u64::saturating_add);
        let capacity = self.rules.check_atoms(n_atoms, limits)?;
        control.memory.grow(4 * n_atoms + size_of::<PlacedCopy>() as u64 * n_copies)?;
        let (mut all, mut copies) = (Vec::with_capacity(capacity), Vec::new());
        for (generator, rows) in rules {
            for operator in self.rules.expand(generator)? {
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

    /// Replaces the selected atoms by those of the distinct units, whose placements are recorded and not applied. Rules
    /// for the same chains have one unit.
    ///
    /// # Errors
    /// Returns the errors of [`Self::copy`], and [`StructureError::BadAssembly`] for an operator that is no rotation.
    pub(super) fn units(
        self,
        selected: Selected,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Selected, StructureError> {
        let mut atoms = selected.atoms;
        let _sorting = self.sort(&mut atoms, control)?;
        let (placed, n_instances) = self.rules_by_unit(&atoms, limits)?;
        let n_atoms = placed.keys().map(|rows| n_rows(rows)).fold(0, u64::saturating_add);
        let capacity = self.rules.check_atoms(n_atoms, limits)?;
        let of_instance = (size_of::<Operator>() + size_of::<[f64; 4]>()) as u64;
        control.memory.grow(4 * n_atoms + of_instance * n_instances)?;
        let (mut all, mut units) = (Vec::with_capacity(capacity), Vec::new());
        for (rows, generators) in placed {
            check(control)?;
            let first = all.len();
            for rows in &rows {
                all.extend_from_slice(&atoms[rows.clone()]);
            }
            let mut operators = Vec::new();
            for generator in generators {
                operators.append(&mut self.rules.expand(generator)?);
            }
            let rotations: Option<Vec<[f64; 4]>> = operators.iter().map(Operator::rotation).collect();
            let rotations = rotations.ok_or_else(|| StructureError::BadAssembly {
                id: self.rules.shown(),
                found: "an operator that is not a rotation and a translation".to_owned(),
                expected: "rotations and translations only, for `instances`".to_owned(),
            })?;
            units.push(Unit { name: self.unit_name(&atoms, &rows), rows: first..all.len(), operators, rotations });
        }
        Ok(Selected { atoms: all, units, ..selected })
    }

    /// Returns those of `atoms` that belong to one of the units that [`Self::units`] would return for them, in file
    /// order. `number` counts from 1.
    ///
    /// # Errors
    /// Returns [`StructureError::NotFound`] if the assembly has fewer units, and the errors of [`Self::units`].
    pub(super) fn unit(
        self,
        number: NonZeroU32,
        mut atoms: Vec<u32>,
        limits: &ReadLimits,
        control: &Control<'_>,
    ) -> Result<Vec<u32>, StructureError> {
        let _sorting = self.sort(&mut atoms, control)?;
        let (placed, _) = self.rules_by_unit(&atoms, limits)?;
        let Some((rows, _)) = placed.get_index(number.get() as usize - 1) else {
            let (n, id) = (placed.len(), self.rules.shown());
            let available = if n == 1 { "one unit".to_owned() } else { format!("the units 1 to {n}") };
            let available = format!("{available} in assembly {id} with the selected atoms");
            return Err(StructureError::NotFound { what: "unit", requested: number.to_string(), available });
        };
        let mut unit: Vec<u32> = rows.iter().flat_map(|rows| &atoms[rows.clone()]).copied().collect();
        unit.sort_unstable();
        Ok(unit)
    }

    /// Returns the distinct units that have some of `atoms`, which are sorted by chain, and the number of instances of
    /// all units.
    fn rules_by_unit(&self, atoms: &[u32], limits: &ReadLimits) -> Result<(UnitRules<'s>, u64), StructureError> {
        let (rules, counts) = self.applied(atoms, limits)?;
        let mut placed = UnitRules::new();
        for (generator, rows) in rules {
            placed.entry(rows).or_default().push(generator);
        }
        Ok((placed, counts.iter().sum()))
    }

    /// Returns the author names of the chains of a unit.
    fn unit_name(&self, atoms: &[u32], rows: &[Range<usize>]) -> String {
        let chain = &self.structure.chain;
        let mut names: Vec<String> = rows.iter().map(|rows| chain.get(atoms[rows.start] as usize)).map(shown).collect();
        names.dedup();
        names.join(",").chars().take(MAX_NAME).collect()
    }

    /// Sorts atoms by chain. Returns the reservation of the sort.
    fn sort(&self, atoms: &mut [u32], control: &Control<'_>) -> Result<Reservation, StructureError> {
        let sorting = control.reserve(size_of_val(atoms) as u64)?;
        // Stable, so the atoms of a chain stay in file order.
        atoms.sort_by_key(|&i| self.column.id(i as usize));
        Ok(sorting)
    }

    /// Returns the rules that apply to `atoms`, which are sorted by chain, and their numbers of copies.
    fn applied(&self, atoms: &[u32], limits: &ReadLimits) -> Result<(Vec<AppliedRule<'s>>, Vec<u64>), StructureError> {
        let rows = self.rows_of_chains(atoms);
        let (rules, counts) = self.rules.applied(|chain| !rows[chain as usize].is_empty(), limits)?;
        let of_rule = |rule: &RuleChains<'s>| {
            let rows = rule.chains.iter().map(|&chain| rows[chain as usize].clone());
            (rule.generator, rows.filter(|rows| !rows.is_empty()).collect())
        };
        Ok((rules.into_iter().map(of_rule).collect(), counts))
    }

    /// Returns the rows of each chain in `atoms`, which are sorted by chain.
    fn rows_of_chains(&self, atoms: &[u32]) -> Vec<Range<usize>> {
        let mut rows = vec![0..0; self.column.texts().len()];
        let mut first = 0;
        for chain in atoms.chunk_by(|&a, &b| self.column.id(a as usize) == self.column.id(b as usize)) {
            rows[self.column.id(chain[0] as usize) as usize] = first..first + chain.len();
            first += chain.len();
        }
        rows
    }
}

/// Returns the number of atoms in these rows.
fn n_rows(rows: &[Range<usize>]) -> u64 {
    rows.iter().map(|rows| rows.len() as u64).sum()
}
