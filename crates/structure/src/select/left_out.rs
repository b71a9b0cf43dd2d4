//! Counts of the atoms that a selection leaves out.

use std::collections::{BTreeMap, HashMap};

use serde::Serialize;

use crate::Kind;
use crate::source::Unread;

/// Maximum number of residue names that are counted separately.
const MAX_NAMES: usize = 10;

/// Number of atoms of one kind.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct KindCount {
    /// Kind.
    pub kind: &'static str,
    /// Number of atoms.
    pub atoms: u64,
}

/// Number of atoms of one kind with one residue name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct ResidueCount {
    /// Residue name.
    pub name: String,
    /// Kind.
    pub kind: &'static str,
    /// Number of atoms.
    pub atoms: u64,
}

/// Atoms of the file that are not meshed. Each atom is counted once, under the first field that applies.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[schema(as = LeftOutReport)]
pub struct LeftOut {
    /// Total number of these atoms.
    pub total: u64,
    /// Atoms of data blocks after the first one with atoms.
    pub other_blocks: u64,
    /// Spheres of coarse-grained parts of integrative models (`ihm_sphere_obj_site`).
    pub spheres: u64,
    /// Atoms of models that are not selected.
    pub other_models: u64,
    /// Atoms of chains that are not selected or not part of the assembly.
    pub other_chains: u64,
    /// Sites that are not atoms: charge sites of water models, lone pairs, Drude particles.
    pub virtual_sites: u64,
    /// Atoms of residues that are not selected, by kind.
    pub kinds: Vec<KindCount>,
    /// The atoms of `kinds` by residue name and kind; the ten most frequent.
    pub residues: Vec<ResidueCount>,
    /// The atoms of `kinds` that `residues` does not list.
    pub other_residues: u64,
    /// Hydrogen atoms of meshed residues.
    pub hydrogens: u64,
    /// Alternative locations of meshed residues other than the selected one.
    pub alternatives: u64,
}

impl LeftOut {
    /// Returns the number of atoms, each counted once.
    pub(super) fn sum(&self) -> u64 {
        let kind_atoms: u64 = self.kinds.iter().map(|kind| kind.atoms).sum();
        kind_atoms
            + self.other_blocks
            + self.spheres
            + self.other_models
            + self.other_chains
            + self.virtual_sites
            + self.hydrogens
            + self.alternatives
    }

    /// Adds the counts of other atoms, without kinds and residue names.
    pub(super) fn add(&mut self, other: &Self) {
        self.other_models += other.other_models;
        self.other_chains += other.other_chains;
        self.virtual_sites += other.virtual_sites;
        self.hydrogens += other.hydrogens;
        self.alternatives += other.alternatives;
    }

    /// Sets the total, the counts by kind and residue name, and the counts of atoms that were not read.
    pub(super) fn finish(&mut self, mut names: Vec<(&str, Kind, u64)>, unread: Unread) {
        (self.other_blocks, self.spheres) = (unread.blocks, unread.spheres);
        names.sort_unstable_by(|(a, i, m), (b, j, n)| n.cmp(m).then(a.cmp(b)).then(i.cmp(j)));
        let mut kinds: BTreeMap<Kind, u64> = BTreeMap::new();
        for (_, kind, n) in &names {
            *kinds.entry(*kind).or_default() += n;
        }
        self.kinds = kinds.into_iter().map(|(kind, atoms)| KindCount { kind: kind.name(), atoms }).collect();
        self.kinds.sort_by_key(|kind| std::cmp::Reverse(kind.atoms));
        let shown = names.len().min(MAX_NAMES);
        self.other_residues = names[shown..].iter().map(|(.., n)| n).sum();
        let residue =
            |&(name, kind, atoms): &(&str, Kind, u64)| ResidueCount { name: name.to_owned(), kind: kind.name(), atoms };
        self.residues = names[..shown].iter().map(residue).collect();
        self.total = self.sum();
    }
}

/// Counts of atoms by residue name id and kind.
#[derive(Debug, Default)]
pub(super) struct Tally {
    counts: HashMap<(u32, Kind), u64>,
    /// Latest residue name and kind, and the number of its atoms that are not counted yet. Equal ones are consecutive.
    latest: (u32, Kind),
    pending: u64,
}

impl Tally {
    pub(super) fn add(&mut self, residue: u32, kind: Kind) {
        if self.latest != (residue, kind) {
            self.flush();
            self.latest = (residue, kind);
        }
        self.pending += 1;
    }

    /// Adds the counts of other atoms.
    pub(super) fn append(&mut self, other: Self) {
        self.flush();
        other.finish().into_iter().for_each(|(key, n)| *self.counts.entry(key).or_default() += n);
    }

    fn flush(&mut self) {
        if self.pending > 0 {
            *self.counts.entry(self.latest).or_default() += std::mem::take(&mut self.pending);
        }
    }

    /// Returns the counts with the names of the residues. `texts` are those of the column of residue names.
    pub(super) fn named<'s>(self, texts: &[&'s str]) -> impl Iterator<Item = (&'s str, Kind, u64)> {
        self.finish().into_iter().map(|((residue, kind), n)| (texts[residue as usize], kind, n))
    }

    fn finish(mut self) -> HashMap<(u32, Kind), u64> {
        self.flush();
        self.counts
    }
}
