//! Assignment of a kind to every atom: first polymer, ligand, water or virtual site, then a more specific kind.
//!
//! ATOM records are polymer, except for water and single ions. A HETATM residue is polymer if the file declares it a
//! polymer: by the entity of its chain or its `label_seq_id` (mmCIF), or by a SEQRES or MODRES record (PDB). It is also
//! polymer if a backbone bond joins it to an adjacent polymer residue of the file, directly or through other HETATM
//! residues.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::Ordering;

use super::atoms::{Columns, Slices, Structure, Tables};
use super::categories::{Categories, Entity};
use super::chemistry::TextClasses;
use super::contents::Kind;
use super::error::StructureError;
use super::read::Reading;
use super::{pieces, residue, sites};

/// Sequence information of a file, by chain.
#[derive(Debug, Clone, Default)]
pub(super) struct Sequence {
    /// Chains and residue names of SEQRES and MODRES records, standard residues excepted.
    pub(super) listed: HashSet<Listed>,
    /// Types of chains (`label_asym_id`) with a known entity.
    pub(super) entities: HashMap<String, Entity>,
    /// Entity of each chain (`label_asym_id`), if the file describes it.
    pub(super) entity_ids: HashMap<String, String>,
}

impl Sequence {
    /// Returns the sequence information of an mmCIF or BinaryCIF file.
    pub(super) fn of(categories: &Categories) -> Self {
        Self { entities: categories.of_chains(), entity_ids: categories.entity_ids(), ..Self::default() }
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

/// Maximum length of a bond between carbon and nitrogen of a peptide, Å. The usual length is 1.33 Å; non-bonded
/// contacts are longer.
const PEPTIDE_BOND: f64 = 2.0;
/// Maximum length of a bond between O3' and the next phosphorus, Å. The usual length is 1.6 Å.
const PHOSPHATE_BOND: f64 = 2.2;

/// Sets the kinds of all atoms. The reader has set ATOM records and rows with a `label_seq_id` to polymer, and other
/// HETATM records to ligand. Checks for cancellation between passes. Chains are independent and assigned in parallel.
pub(super) fn assign(
    columns: &mut Columns,
    tables: &Tables,
    sequence: &Sequence,
    reading: &Reading<'_>,
) -> Result<(), StructureError> {
    let solvent = Solvent::new(tables);
    let declared = Declared::new(columns, tables, sequence, &solvent, reading);
    let joints: Vec<Option<Joint>> = tables.name.texts().map(Joint::of).collect();
    let texts = TextClasses::new(tables, sequence);
    let bytes = usize::try_from(Columns::bytes(columns.len())).unwrap_or(usize::MAX);
    let mut parts = whole_chains(columns, reading.n_pieces(bytes));
    let assigned = pieces::map(&mut parts, |rows| {
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
        texts.refine(rows);
        Ok(())
    });
    assigned.into_iter().collect::<Result<(), StructureError>>()?;
    reading.check()?;
    sites::mark(columns, tables);
    reading.check()
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
struct Solvent {
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

    fn has(&self, residue: u32) -> bool {
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
struct Declared<'a> {
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
        let is_polymer = |chain| Some(*sequence.entities.get(chain)? == Entity::Polymer);
        let chains = tables.label_chain.texts().map(is_polymer).collect();
        let mut declared = Self { chains, numbered: false, tables, sequence };
        let found = declared.sequence_numbers(columns, solvent);
        // The other blocks are not known. [`HeteroBlocks::agree`] checks them.
        declared.numbered = reading.is_block || are_numbered(found);
        reading.hetero.store(found, Ordering::Relaxed);
        declared
    }

    /// Returns true for polymers if the entity of the chain is known.
    fn of_entity(&self, label_chain: u32) -> Option<bool> {
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
const OPEN: u8 = 4;

/// Returns true if `label_seq_id` distinguishes polymers from other residues. Some programs write it for every atom,
/// even for water.
const fn are_numbered(found: u8) -> bool {
    found & (WITHOUT | SOLVENT) == WITHOUT
}

/// Findings on the HETATM records of consecutive blocks of a file.
#[derive(Debug, Default)]
pub(super) struct HeteroBlocks(u8);

impl HeteroBlocks {
    /// Adds the findings of a block.
    pub(super) fn add(&mut self, reading: &Reading<'_>) {
        self.0 |= reading.hetero.load(Ordering::Relaxed);
    }

    /// Rejects records whose sequence numbers do not distinguish polymers, as the blocks assume. `expected` describes a
    /// file of known entities.
    pub(super) fn check(&self, expected: &'static str) -> Result<(), StructureError> {
        if self.0 & OPEN == 0 || are_numbered(self.0) {
            return Ok(());
        }
        let found = "HETATM records with `label_seq_id` in chains of unknown entity, but no HETATM record without it, or \
                     water with it";
        Err(StructureError::NotAStream { found: found.to_owned(), expected })
    }
}

/// Returns the last row before which a file can be divided: the kinds and alternative locations of the rows before and
/// after it do not depend on each other. Returns `None` without such a row.
pub(super) fn last_division(structure: &Structure) -> Option<usize> {
    (1..structure.len()).rev().find(|&i| divides(structure, i))
}

fn divides(s: &Structure, i: usize) -> bool {
    let before = i - 1;
    // A Drude particle follows its atom.
    if s.name.get(i).starts_with('D') {
        return false;
    }
    if s.chain.id(i) != s.chain.id(before) || s.model[i] != s.model[before] {
        return true;
    }
    // Names of one number and code are alternatives.
    if (s.residue_number[i], s.insertion_code[i]) == (s.residue_number[before], s.insertion_code[before]) {
        return false;
    }
    let both = |of: fn(&str) -> bool| of(s.residue.get(before)) && of(s.residue.get(i));
    both(residue::is_water) || (both(residue::is_polymer) && !s.hetero[before] && !s.hetero[i])
}

/// Backbone atoms that join the residues of a chain.
#[derive(Debug, Clone, Copy)]
enum Joint {
    /// Carbon of a peptide bond.
    C,
    /// Nitrogen of a peptide bond.
    N,
    /// Oxygen before the phosphorus of the next nucleotide.
    O3,
    /// Phosphorus.
    P,
}

impl Joint {
    fn of(name: &str) -> Option<Self> {
        match name {
            "C" => Some(Self::C),
            "N" => Some(Self::N),
            "O3'" | "O3*" => Some(Self::O3),
            "P" => Some(Self::P),
            _ => None,
        }
    }
}

/// The first atom of each [`Joint`] in a residue.
#[derive(Debug, Clone, Copy, Default)]
struct Joints([Option<[f64; 3]>; 4]);

impl Joints {
    /// Returns true if a bond joins this residue to the `next` one.
    fn lead_to(&self, next: &Self) -> bool {
        let near = |a: Joint, b: Joint, limit: f64| match (self.0[a as usize], next.0[b as usize]) {
            (Some(a), Some(b)) => a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>() <= limit * limit,
            _ => false,
        };
        near(Joint::C, Joint::N, PEPTIDE_BOND) || near(Joint::O3, Joint::P, PHOSPHATE_BOND)
    }
}

/// Sets the kind of HETATM residues to polymer if backbone bonds join them to a polymer residue, unless the entity of
/// their chain is known. `joints` are by name id.
fn bonded(columns: &mut Slices<'_>, joints: &[Option<Joint>], declared: &Declared<'_>) {
    let open = |columns: &Slices<'_>, i: usize| {
        columns.kind[i] == Kind::Ligand && columns.hetero[i] && declared.of_entity(columns.label_chain[i]).is_none()
    };
    if !(0..columns.len()).any(|i| open(columns, i) && joints[columns.name[i] as usize].is_some()) {
        return;
    }
    // A group is a sequence of residues joined by bonds.
    let (mut group, mut has_polymer, mut has_open) = (0, false, false);
    let (mut before, mut first) = (Joints::default(), 0);
    loop {
        let (end, here) = residue_from(columns, first, joints);
        let at_end = first == columns.len();
        if at_end || !(first > 0 && same_chain(columns, first - 1, first) && before.lead_to(&here)) {
            if has_polymer && has_open {
                for i in group..first {
                    if open(columns, i) {
                        columns.kind[i] = Kind::Polymer;
                    }
                }
            }
            (group, has_polymer, has_open) = (first, false, false);
        }
        if at_end {
            return;
        }
        if !has_open {
            // Only the residue before the next open one matters.
            let Some(next) = (first..columns.len()).find(|&i| open(columns, i)) else { return };
            let near = residue_start(columns, next.saturating_sub(1).max(first));
            if near > first {
                (before, first, group, has_polymer) = (Joints::default(), near, near, false);
                continue;
            }
        }
        has_polymer |= columns.kind[first] == Kind::Polymer;
        has_open |= open(columns, first);
        (before, first) = (here, end);
    }
}

pub(super) fn same_chain(columns: &Slices<'_>, a: usize, b: usize) -> bool {
    columns.chain[a] == columns.chain[b] && columns.model[a] == columns.model[b]
}

/// Returns the index of the first atom in the residue of atom `i`.
fn residue_start(columns: &Slices<'_>, i: usize) -> usize {
    (0..i).rev().find(|&before| !same_residue(columns, before, i)).map_or(0, |before| before + 1)
}

pub(super) fn same_residue(columns: &Slices<'_>, a: usize, b: usize) -> bool {
    columns.residue_number[a] == columns.residue_number[b]
        && columns.residue[a] == columns.residue[b]
        && columns.insertion_code[a] == columns.insertion_code[b]
        && same_chain(columns, a, b)
}

/// Returns the end of the residue that begins with atom `first`, and its joints.
fn residue_from(columns: &Slices<'_>, first: usize, joints: &[Option<Joint>]) -> (usize, Joints) {
    let mut found = Joints::default();
    let mut i = first;
    while i < columns.len() && same_residue(columns, i, first) {
        if let Some(joint) = joints[columns.name[i] as usize] {
            found.0[joint as usize].get_or_insert([columns.x[i], columns.y[i], columns.z[i]]);
        }
        i += 1;
    }
    (i, found)
}
