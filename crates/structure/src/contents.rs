//! Summary of a structure: models, chains and counts of atoms by kind.

use std::fmt;

use molmesh_surface::named;

use super::atoms::Structure;
use super::kind_set::KindSet;
use super::text::list;

/// Kind of molecule that an atom belongs to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// Proteins and peptides: their ATOM records, and the HETATM residues of a chain.
    Protein,
    /// Nucleic acids: their ATOM records, and the HETATM residues of a chain.
    Nucleic,
    /// Other polymers, and ATOM records of unknown residues.
    #[default]
    Polymer,
    /// Known cofactors in any record, unless they are part of a polymer.
    Cofactor,
    /// Saccharides in any record, unless they are part of a polymer; branched entities.
    Glycan,
    /// Other HETATM records.
    Ligand,
    /// Monatomic metals and halogens in any record.
    Ion,
    /// Water in any record.
    Water,
    /// Sites of a force field that are not atoms, such as the charge site of TIP4P water. They are never selected.
    VirtualSite,
}

named!(Kind, Protein => "protein", Nucleic => "nucleic", Polymer => "polymer", Cofactor => "cofactor",
    Glycan => "glycan", Ligand => "ligand", Ion => "ion", Water => "water", VirtualSite => "virtual");

/// Numbers of atoms by kind. Hydrogens are counted apart from the heavy atoms of their residues.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
#[schema(as = KindCounts)]
pub struct Counts {
    /// Heavy atoms of polymers, including proteins and nucleic acids.
    pub polymer: u64,
    /// Heavy atoms of proteins.
    pub protein: u64,
    /// Heavy atoms of nucleic acids.
    pub nucleic: u64,
    /// Heavy atoms of ligands, including cofactors and glycans.
    pub ligand: u64,
    /// Heavy atoms of cofactors.
    pub cofactor: u64,
    /// Heavy atoms of glycans.
    pub glycan: u64,
    /// Atoms of ions.
    pub ion: u64,
    /// Heavy atoms of water.
    pub water: u64,
    /// Hydrogen atoms.
    pub hydrogens: u64,
    /// Sites that are not atoms: charge sites of water models, lone pairs, Drude particles.
    pub virtual_sites: u64,
}

impl Counts {
    /// Returns the total number of atoms and virtual sites.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.polymer + self.ligand + self.ion + self.water + self.hydrogens + self.virtual_sites
    }

    fn add(&mut self, kind: Kind, hydrogen: bool) {
        let slot = match (hydrogen, kind) {
            (_, Kind::VirtualSite) => &mut self.virtual_sites,
            (true, _) => &mut self.hydrogens,
            (_, Kind::Ion) => &mut self.ion,
            (_, Kind::Water) => &mut self.water,
            (_, kind) if KindSet::POLYMER.has(kind) => &mut self.polymer,
            _ => &mut self.ligand,
        };
        *slot += 1;
        let part = match kind {
            _ if hydrogen => return,
            Kind::Protein => &mut self.protein,
            Kind::Nucleic => &mut self.nucleic,
            Kind::Cofactor => &mut self.cofactor,
            Kind::Glycan => &mut self.glycan,
            _ => return,
        };
        *part += 1;
    }
}

impl fmt::Display for Counts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { polymer, ligand, ion, water, hydrogens, virtual_sites, .. } = self;
        write!(f, "{polymer} polymer, {ligand} ligand, {ion} ion, {water} water and {hydrogens} hydrogen atoms")?;
        if *virtual_sites > 0 { write!(f, " and {virtual_sites} virtual sites") } else { Ok(()) }
    }
}

/// One chain of a model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChainContents {
    /// Author name; empty if blank in the file.
    pub name: String,
    /// Numbers of its atoms by kind.
    pub counts: Counts,
}

/// Contents of a structure.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Contents {
    /// Number of atoms in all models.
    pub atoms: u64,
    /// Model numbers, in order of first appearance.
    pub models: Vec<i32>,
    /// The model that the counts below describe.
    pub model: i32,
    /// Numbers of atoms of that model, including all alternative locations.
    pub counts: Counts,
    /// Number of atoms of that model that have an alternative location.
    pub alternatives: u64,
    /// Number of atoms of that model whose element is unknown.
    pub unknown_elements: u64,
    /// Chains of that model, in order of first appearance.
    pub chains: Vec<ChainContents>,
}

impl Contents {
    /// Summarizes `model`, by default the first one of the file. A model that does not exist has no atoms.
    #[must_use]
    pub fn of(structure: &Structure, model: Option<i32>) -> Self {
        let models = models(structure);
        let model = model.or(models.first().copied()).unwrap_or(1);
        let mut contents = Self {
            atoms: structure.len() as u64,
            models,
            model,
            counts: Counts::default(),
            alternatives: 0,
            unknown_elements: 0,
            chains: Vec::new(),
        };
        // Index of each text of the chain column among the chains of this model.
        let mut chain_at = vec![usize::MAX; structure.chain.texts().len()];
        for i in (0..structure.len()).filter(|&i| structure.model[i] == model) {
            let (kind, hydrogen) = (structure.kind[i], structure.is_hydrogen(i));
            contents.counts.add(kind, hydrogen);
            contents.alternatives += u64::from(structure.altloc[i] != 0);
            contents.unknown_elements += u64::from(structure.element[i] == 0);
            let n_chains = contents.chains.len();
            let at = &mut chain_at[structure.chain.id(i) as usize];
            if *at == usize::MAX {
                *at = n_chains;
                let name = structure.chain.get(i).to_owned();
                contents.chains.push(ChainContents { name, counts: Counts::default() });
            }
            contents.chains[*at].counts.add(kind, hydrogen);
        }
        contents
    }

    /// Lists chains for a message.
    #[must_use]
    pub(super) fn chain_list(&self) -> String {
        named(self.chains.iter().map(|c| shown(&c.name)), self.chains.len(), "chain")
    }

    /// Lists models for a message.
    #[must_use]
    pub(super) fn model_list(&self) -> String {
        named(self.models.iter().map(ToString::to_string), self.models.len(), "model")
    }
}

/// Names the only item, or counts and lists several.
fn named(names: impl Iterator<Item = String>, n: usize, what: &str) -> String {
    let list = list(names, n);
    if n == 1 { format!("{what} {list}") } else { format!("{n} {what}s: {list}") }
}

/// Returns the name of a chain for a message.
pub(super) fn shown(chain: &str) -> String {
    if chain.is_empty() { "(blank)".to_owned() } else { chain.to_owned() }
}

/// Returns the distinct model numbers, in order of first appearance.
fn models(structure: &Structure) -> Vec<i32> {
    let mut seen = std::collections::HashSet::new();
    let mut models = Vec::new();
    for run in structure.model.chunk_by(|a, b| a == b) {
        if seen.insert(run[0]) {
            models.push(run[0]);
        }
    }
    models
}
