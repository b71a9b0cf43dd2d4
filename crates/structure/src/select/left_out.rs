//! Counts of the atoms that a selection leaves out.

use std::collections::{BTreeMap, HashMap};

use crate::Kind;
use crate::source::Unread;

/// Maximum number of residue names that are counted separately.
const MAX_NAMES: usize = 10;

/// Atoms of the file that were not selected. Each is counted under the first reason that applies, in field order.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct LeftOut {
    /// Atoms of data blocks after the first one with atoms.
    pub other_blocks: u64,
    /// Spheres of coarse-grained parts of integrative models.
    pub spheres: u64,
    /// Atoms of other models.
    pub other_models: u64,
    /// Atoms of other chains.
    pub other_chains: u64,
    /// Sites that are not atoms: charge sites of water models, lone pairs, Drude particles.
    pub virtual_sites: u64,
    /// Atoms of residues that are not selected, by kind, most frequent first.
    pub kinds: Vec<(Kind, u64)>,
    /// The atoms of `kinds` by residue name and kind, most frequent first; at most ten.
    pub residues: Vec<(String, Kind, u64)>,
    /// The atoms of `kinds` that `residues` does not list.
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
        let of_kinds: u64 = self.kinds.iter().map(|(_, n)| n).sum();
        of_kinds
            + self.other_blocks
            + self.spheres
            + self.other_models
            + self.other_chains
            + self.virtual_sites
            + self.hydrogens
            + self.alternatives
    }

    /// Adds the atoms of a file that were not read.
    pub(super) fn add_unread(&mut self, unread: Unread) {
        self.other_blocks += unread.blocks;
        self.spheres += unread.spheres;
    }

    /// Adds the counts of other atoms, without kinds and residue names.
    pub(super) fn add(&mut self, other: &Self) {
        self.other_models += other.other_models;
        self.other_chains += other.other_chains;
        self.virtual_sites += other.virtual_sites;
        self.hydrogens += other.hydrogens;
        self.alternatives += other.alternatives;
    }

    /// Sets the counts of kinds and residue names.
    pub(super) fn name_residues(&mut self, mut names: Vec<(&str, Kind, u64)>) {
        names.sort_unstable_by(|(a, i, m), (b, j, n)| n.cmp(m).then(a.cmp(b)).then(i.cmp(j)));
        let mut kinds: BTreeMap<Kind, u64> = BTreeMap::new();
        for (_, kind, n) in &names {
            *kinds.entry(*kind).or_default() += n;
        }
        self.kinds = kinds.into_iter().collect();
        self.kinds.sort_by_key(|(_, n)| std::cmp::Reverse(*n));
        let shown = names.len().min(MAX_NAMES);
        self.other_residues = names[shown..].iter().map(|(.., n)| n).sum();
        self.residues = names[..shown].iter().map(|(name, kind, n)| ((*name).to_owned(), *kind, *n)).collect();
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
