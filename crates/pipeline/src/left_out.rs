//! Report of the atoms that were not meshed.

use molmesh_structure::LeftOut;
use serde::Serialize;

/// Number of atoms of one kind.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct KindCount {
    /// Kind.
    pub kind: &'static str,
    /// Number of atoms.
    pub atoms: u64,
}

/// Number of atoms of one kind with one residue name.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct ResidueCount {
    /// Residue name.
    pub name: String,
    /// Kind.
    pub kind: &'static str,
    /// Number of atoms.
    pub atoms: u64,
}

/// Atoms of the file that are not meshed. Each atom is counted once, under the first field that applies.
#[derive(Debug, Clone, Default, Serialize, utoipa::ToSchema)]
pub struct LeftOutReport {
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

impl LeftOutReport {
    pub(super) fn new(left_out: &LeftOut) -> Self {
        let residues = left_out.residues.iter();
        Self {
            total: left_out.total(),
            other_blocks: left_out.other_blocks,
            spheres: left_out.spheres,
            other_models: left_out.other_models,
            other_chains: left_out.other_chains,
            virtual_sites: left_out.virtual_sites,
            kinds: left_out.kinds.iter().map(|(kind, atoms)| KindCount { kind: kind.name(), atoms: *atoms }).collect(),
            residues: residues
                .map(|(name, kind, atoms)| ResidueCount { name: name.clone(), kind: kind.name(), atoms: *atoms })
                .collect(),
            other_residues: left_out.other_residues,
            hydrogens: left_out.hydrogens,
            alternatives: left_out.alternatives,
        }
    }
}
