//! Assignment of a kind to every atom: first polymer, ligand, water or virtual site, then a more specific kind.
//!
//! A HETATM residue is polymer if the file declares it a polymer: by the entity of its chain or its `label_seq_id`
//! (mmCIF), or by a SEQRES or MODRES record (PDB). It is also polymer if a backbone bond joins it to an adjacent
//! polymer residue of the file, directly or through other HETATM residues.
//!
//! ATOM records are polymer, except for water, single ions, and residues of an unknown name that the file does not
//! declare and no backbone bond joins to an adjacent residue. Without any other polymer, these are polymer as well.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::atomic::Ordering;

use super::atoms::{Columns, Slices, Tables};
use super::bonds::{Joint, bonded, is_bonded};
use super::categories::{Categories, Entity};
use super::chemistry::{Membership, ResidueGroup, TextClasses};
use super::contents::Kind;
use super::error::StructureError;
use super::read::Reading;
use super::residues::Names;
use super::source::{SourceFields, SourceFormat};
use super::text::list;
use super::texts::without_entity;
use super::{pieces, residue, sites};

/// Sequence information of a file, by chain.
#[derive(Debug, Clone, Default)]
pub(super) struct Sequence {
    /// Chains and residue names of SEQRES and MODRES records, standard residues excepted.
    pub(super) listed: HashSet<Listed>,
    /// Types of entities by their ids.
    pub(super) types: HashMap<String, Entity>,
    /// Entity of each chain (`label_asym_id`), if the file describes it.
    pub(super) entity_ids: HashMap<String, String>,
}

impl Sequence {
    /// Returns the sequence information of an mmCIF or BinaryCIF file.
    pub(super) fn of(categories: &Categories) -> Self {
        Self { types: categories.entity_types(), entity_ids: categories.entity_ids(), ..Self::default() }
    }

    /// Returns the entity of a chain, given by its id in the table, if it is known: by `struct_asym` or, if the file
    /// does not have this category, by the atoms.
    pub(super) fn entity_id<'s>(&'s self, tables: &'s Tables, chain: usize) -> Option<&'s str> {
        if self.entity_ids.is_empty() {
            return tables.entity(chain).filter(|id| !id.is_empty());
        }
        let name = without_entity(tables.label_chain.text(u32::try_from(chain).ok()?));
        self.entity_ids.get(name).map(String::as_str)
    }

    /// Returns the type of the entity of each chain, if it is known, by id of the chain.
    pub(super) fn entities(&self, tables: &Tables) -> Vec<Option<Entity>> {
        let entity = |chain| self.types.get(self.entity_id(tables, chain)?).copied();
        (0..tables.label_chain.texts().len()).map(entity).collect()
    }

    /// Returns true if a record lists the residue name for the chain.
    pub(super) fn lists(&self, chain: &str, residue: &str) -> bool {
        !self.listed.is_empty()
            && listed(chain.as_bytes(), residue.as_bytes()).is_some_and(|pair| self.listed.contains(&pair))
    }
}

/// Columns of a chain (two) and a residue name (three), right-aligned.
pub(super) type Listed = [u8; 5];

/// Returns the columns of a chain and a residue name, if both fit into the columns of a PDB file.
pub(super) fn listed(chain: &[u8], residue: &[u8]) -> Option<Listed> {
    let mut columns = [b' '; 5];
    columns[..2].get_mut(2_usize.checked_sub(chain.len())?..)?.copy_from_slice(chain);
    columns[2..].get_mut(3_usize.checked_sub(residue.len())?..)?.copy_from_slice(residue);
    Some(columns)
}

/// Finds the residues, resolves guessed elements and sets the kinds of all atoms. The reader has set ATOM records and
/// rows with a `label_seq_id` to polymer, and other HETATM records to ligand. Checks for cancellation between passes.
/// Chains are independent and assigned in parallel. Returns a warning about residues of ATOM records that are ligands.
pub(super) fn assign(
    columns: &mut Columns,
    tables: &Tables,
    source: &SourceFields,
    reading: &Reading<'_>,
) -> Result<Option<String>, StructureError> {
    if source.format == SourceFormat::Xyz {
        // A frame is one residue of a polymer.
        for i in 0..columns.len() {
            columns.starts_residue[i] = i == 0 || columns.model[i] != columns.model[i - 1];
        }
        sites::mark(columns, tables);
        return reading.check().map(|()| None);
    }
    let solvent = Solvent::new(tables);
    let declared = Declared::new(columns, tables, &source.sequence, &solvent, reading);
    let joints: Vec<Option<Joint>> = tables.name.texts().map(Joint::of).collect();
    let texts = TextClasses::new(tables, &source.sequence);
    let names = Names::new(tables, &texts, &solvent);
    let bytes = usize::try_from(Columns::bytes(columns.len())).unwrap_or(usize::MAX);
    let mut parts = whole_chains(columns, reading.n_pieces(bytes));
    let found = pieces::map(&mut parts, |rows| {
        reading.check()?;
        let memory = reading.reserve(names.marking_bytes(rows.len()))?;
        names.mark(rows);
        drop(memory);
        names.resolve_elements(rows);
        reading.check()?;
        let has_hetero = rows.hetero.contains(&true);
        if has_hetero {
            declared.mark(rows);
        }
        solvent.mark(rows);
        if has_hetero {
            reading.check()?;
            bonded(rows, &joints, &declared);
        }
        reading.check()?;
        Ok(unlinked_residues(rows, &joints, &texts))
    });
    let found = found.into_iter().collect::<Result<Vec<Unlinked>, StructureError>>()?;
    let has_polymer = found.iter().any(|part| part.has_polymer);
    let has_unlinked = found.iter().any(|part| !part.atoms.is_empty());
    let findings = if has_polymer { POLYMER } else { 0 } | if has_unlinked { UNLINKED } else { 0 };
    reading.findings.fetch_or(findings, Ordering::Relaxed);
    // The other blocks are not known. `BlockFindings::check` checks them.
    let are_ligands = has_polymer || reading.is_block;
    pieces::map(&mut parts, |rows| {
        reading.check()?;
        if !are_ligands && has_unlinked {
            texts.unlinked_to_polymer(rows, &solvent);
        }
        texts.refine(rows);
        Ok(())
    })
    .into_iter()
    .collect::<Result<(), StructureError>>()?;
    reading.check()?;
    sites::mark(columns, tables);
    reading.check()?;
    Ok(if are_ligands && has_unlinked { Some(unlinked_warning(found, tables)) } else { None })
}

/// Residues of ATOM records in some chains that are no part of a polymer.
#[derive(Debug, Default)]
struct Unlinked {
    /// Number of atoms by id of the residue name.
    atoms: BTreeMap<u32, u64>,
    /// True if there is a polymer.
    has_polymer: bool,
}

/// Sets the kind of residues of ATOM records to ligand if their name is unknown, the file does not declare them to be
/// part of a polymer, and no bond joins them to an adjacent residue.
fn unlinked_residues(columns: &mut Slices<'_>, joints: &[Option<Joint>], texts: &TextClasses<'_>) -> Unlinked {
    let mut unlinked = Unlinked::default();
    let mut group = ResidueGroup::default();
    // Programs write the patches of a residue as other names under its number.
    let (mut residue_end_ix, mut has_polymer_name) = (0, false);
    let mut first = 0;
    while first < columns.len() {
        if first >= residue_end_ix {
            residue_end_ix = (first + 1..columns.len()).find(|&i| columns.starts_residue[i]).unwrap_or(columns.len());
            has_polymer_name =
                (first..residue_end_ix).any(|i| !columns.hetero[i] && texts.is_polymer_name(columns.residue[i]));
        }
        let end = residue_end(columns, first);
        if columns.kind[first] == Kind::Polymer {
            match texts.membership(columns, first, &mut group) {
                Membership::Neutral => {}
                Membership::Polymer => unlinked.has_polymer = true,
                Membership::Ligand => columns.kind[first..end].fill(Kind::Ligand),
                _ if has_polymer_name || is_bonded(columns, first..end, joints) => unlinked.has_polymer = true,
                Membership::Listed => columns.kind[first..end].fill(Kind::Ligand),
                Membership::Unknown => {
                    *unlinked.atoms.entry(columns.residue[first]).or_default() += (end - first) as u64;
                    columns.kind[first..end].fill(Kind::Ligand);
                }
            }
        }
        first = end;
    }
    unlinked
}

/// Returns a warning that names the residues, most frequent first.
fn unlinked_warning(found: Vec<Unlinked>, tables: &Tables) -> String {
    let mut atoms: BTreeMap<u32, u64> = BTreeMap::new();
    for (residue, n) in found.into_iter().flat_map(|part| part.atoms) {
        *atoms.entry(residue).or_default() += n;
    }
    let total: u64 = atoms.values().sum();
    let mut atoms: Vec<(u32, u64)> = atoms.into_iter().collect();
    atoms.sort_by_key(|(_, n)| std::cmp::Reverse(*n));
    let n_names = atoms.len();
    let names = list(atoms.into_iter().map(|(residue, n)| format!("`{}` {n}", tables.residue.text(residue))), n_names);
    format!(
        "{total} atoms in ATOM records belong to residues with unknown names that are neither in a sequence nor bonded \
         to a polymer; treated as ligands: {names}"
    )
}

/// Divides the rows at ends of chains into at most `n` parts of similar size.
fn whole_chains(columns: &mut Columns, n: usize) -> Vec<Slices<'_>> {
    let size = columns.len().div_ceil(n).max(1);
    let mut rest = columns.slices();
    let mut parts = Vec::with_capacity(n);
    while rest.len() > 0 {
        let end = (size..rest.len()).find(|&i| !same_chain(&rest, i - 1, i)).unwrap_or(rest.len());
        let (part, others) = rest.split(end);
        parts.push(part);
        rest = others;
    }
    parts
}

/// Residue names of water and single ions.
pub(super) struct Solvent {
    /// Kind by residue name id; `None` for other residues.
    kinds: Vec<Option<Kind>>,
    any: bool,
}

impl Solvent {
    fn new(tables: &Tables) -> Self {
        let kind = |name| match name {
            name if residue::is_water(name) => Some(Kind::Water),
            name if residue::is_ion(name) => Some(Kind::Ligand),
            _ => None,
        };
        let kinds: Vec<Option<Kind>> = tables.residue.texts().map(kind).collect();
        let any = kinds.iter().any(Option::is_some);
        Self { kinds, any }
    }

    pub(super) fn has(&self, residue: u32) -> bool {
        self.kinds[residue as usize].is_some()
    }

    fn mark(&self, columns: &mut Slices<'_>) {
        if !self.any {
            return;
        }
        for (kind, &residue) in columns.kind.iter_mut().zip(&*columns.residue) {
            if let Some(solvent) = self.kinds[residue as usize] {
                *kind = solvent;
            }
        }
    }
}

/// Declarations of a file about its HETATM residues.
pub(super) struct Declared<'a> {
    /// True for polymers, by `label_chain` id; `None` if the entity of the chain is unknown.
    chains: Vec<Option<bool>>,
    /// True if `label_seq_id` distinguishes polymers from other residues.
    numbered: bool,
    tables: &'a Tables,
    sequence: &'a Sequence,
}

impl<'a> Declared<'a> {
    fn new(
        columns: &Columns,
        tables: &'a Tables,
        sequence: &'a Sequence,
        solvent: &Solvent,
        reading: &Reading<'_>,
    ) -> Self {
        let is_polymer = |entity: Option<Entity>| entity.map(|entity| entity == Entity::Polymer);
        let chains = sequence.entities(tables).into_iter().map(is_polymer).collect();
        let mut declared = Self { chains, numbered: false, tables, sequence };
        let found = declared.sequence_numbers(columns, solvent);
        // The other blocks are not known. `BlockFindings::check` checks them.
        declared.numbered = reading.is_block || are_numbered(found);
        reading.findings.store(found, Ordering::Relaxed);
        declared
    }

    /// Returns true for polymers if the entity of the chain is known.
    pub(super) fn of_entity(&self, label_chain: u32) -> Option<bool> {
        self.chains.get(label_chain as usize).copied().flatten()
    }

    /// Returns the findings on the HETATM records.
    fn sequence_numbers(&self, columns: &Columns, solvent: &Solvent) -> u8 {
        let found = |i: usize| match columns.kind[i] {
            Kind::Polymer if solvent.has(columns.residue[i]) => SOLVENT,
            Kind::Polymer if self.of_entity(columns.label_chain[i]).is_none() => OPEN,
            Kind::Polymer => 0,
            _ => WITHOUT,
        };
        (0..columns.len()).filter(|&i| columns.hetero[i]).fold(0, |all, i| all | found(i))
    }

    /// Returns true if a record lists the residue name for the chain.
    fn lists(&self, chain: u32, residue: u32) -> bool {
        self.sequence.lists(self.tables.chain.text(chain), self.tables.residue.text(residue))
    }

    /// Sets the kinds of HETATM residues.
    fn mark(&self, columns: &mut Slices<'_>) {
        for i in 0..columns.len() {
            if !columns.hetero[i] {
                continue;
            }
            let polymer = self.of_entity(columns.label_chain[i]).unwrap_or_else(|| {
                (self.numbered && columns.kind[i] == Kind::Polymer) || self.lists(columns.chain[i], columns.residue[i])
            });
            columns.kind[i] = if polymer { Kind::Polymer } else { Kind::Ligand };
        }
    }
}

/// HETATM records without `label_seq_id`, those of water and ions with one, and others with one whose entity is
/// unknown.
const WITHOUT: u8 = 1;
const SOLVENT: u8 = 2;
pub(super) const OPEN: u8 = 4;
/// Residues of ATOM records that are no part of a polymer, and other residues of a polymer.
pub(super) const UNLINKED: u8 = 8;
pub(super) const POLYMER: u8 = 16;

/// Returns true if `label_seq_id` distinguishes polymers from other residues. Some programs write it for every atom,
/// even for water.
pub(super) const fn are_numbered(found: u8) -> bool {
    found & (WITHOUT | SOLVENT) == WITHOUT
}

pub(super) fn same_chain(columns: &Slices<'_>, a: usize, b: usize) -> bool {
    columns.chain[a] == columns.chain[b] && columns.model[a] == columns.model[b]
}

/// Returns true if atom `i` begins a residue, or another residue name of it.
fn starts_residue(columns: &Slices<'_>, i: usize) -> bool {
    columns.starts_residue[i] || columns.residue[i] != columns.residue[i - 1]
}

/// Returns the index of the first atom in the residue of atom `i`.
pub(super) fn residue_start(columns: &Slices<'_>, i: usize) -> usize {
    (1..=i).rev().find(|&start| starts_residue(columns, start)).unwrap_or(0)
}

/// Returns the end of the residue that begins with atom `first`.
pub(super) fn residue_end(columns: &Slices<'_>, first: usize) -> usize {
    (first + 1..columns.len()).find(|&i| starts_residue(columns, i)).unwrap_or(columns.len())
}
