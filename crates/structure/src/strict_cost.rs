//! Upper bound of the work of pdbtbx on a file. pdbtbx searches lists linearly, so its time grows with the square of
//! several numbers: residues of a chain, atoms of a model, alternatives of a residue, records of some kinds.

use rustc_hash::FxHashMap;

use super::atoms::Structure;
use super::source::SourceFormat;

/// Maximum number of search steps: about a second.
const MAX_STEPS: u64 = 1_000_000_000;
/// Number of steps that take as long as copying an atom.
const STEPS_PER_COPY: u64 = 700;
/// Memory of a copied atom, bytes.
const BYTES_PER_COPY: u64 = 320;
/// Residue names of a SEQRES record.
const NAMES_PER_SEQRES: u64 = 13;
/// Number of steps that take as long as comparing a record with an atom.
const STEPS_PER_RECORD: u64 = 8;
/// Steps per residue of a chain when a missing one is inserted.
const STEPS_PER_INSERTION: u64 = 4;

/// Upper bound of the work on a file.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Cost {
    /// Number of search steps, including the steps that stand for copies.
    steps: u64,
    /// Atoms copied to the alternatives of their residue.
    copies: u64,
}

#[derive(Default)]
struct ModelCounts {
    index: u64,
    n_chains: u64,
    n_atoms: u64,
}

#[derive(Default)]
struct ChainCounts {
    index: u64,
    n_residues: u64,
}

#[derive(Default)]
struct ResidueCounts {
    index: u64,
    n_atoms: u64,
}

impl Cost {
    /// Returns the bound for `text`, from which `structure` was read.
    pub(super) fn of(structure: &Structure, text: &[u8]) -> Self {
        let mut models: FxHashMap<i32, ModelCounts> = FxHashMap::default();
        let mut chains: FxHashMap<(i32, u32), ChainCounts> = FxHashMap::default();
        let mut residues: FxHashMap<(i32, u32, i32, u8), ResidueCounts> = FxHashMap::default();
        let mut hierarchy = 0;
        for i in 0..structure.len() {
            let (number, n_models) = (structure.residue_number[i], models.len() as u64);
            let of_chain = (structure.model[i], structure.chain.id(i));
            let of_residue = (of_chain.0, of_chain.1, number, structure.insertion_code[i]);
            let model = models.entry(of_chain.0).or_insert(ModelCounts { index: n_models, ..ModelCounts::default() });
            let chain = chains.entry(of_chain).or_insert_with(|| {
                model.n_chains += 1;
                ChainCounts { index: model.n_chains, ..ChainCounts::default() }
            });
            let residue = residues.entry(of_residue).or_insert_with(|| {
                chain.n_residues += 1;
                ResidueCounts { index: chain.n_residues, ..ResidueCounts::default() }
            });
            // Every atom without a number begins a residue. The number of such atoms is 0.
            if number == 0 {
                chain.n_residues += 1;
            }
            model.n_atoms += 1;
            residue.n_atoms += 1;
            hierarchy += model.index
                + chain.index
                + if residue.n_atoms == 1 || number == 0 { chain.n_residues } else { chain.n_residues - residue.index };
        }
        let (n_atoms, n_residues) = (structure.len() as u64, residues.len() as u64);
        let compared = if models.len() > 1 { models.values().map(|m| m.n_atoms * m.n_atoms).sum() } else { 0 };
        let searched = match structure.format {
            SourceFormat::Pdb => {
                let records = RecordCounts::of(text);
                let names = NAMES_PER_SEQRES * records.seqres;
                let others = STEPS_PER_RECORD * records.others * n_atoms.max(records.others);
                others + STEPS_PER_INSERTION * names * (n_residues + names)
            }
            SourceFormat::Mmcif => hierarchy + count(text, b"_struct_ncs_oper.").pow(2),
            SourceFormat::BinaryCif | SourceFormat::Pqr | SourceFormat::Xyz => 0,
        };
        // A residue of n atoms has at most n / 2 alternatives of n / 2 atoms.
        let copies: u64 = residues.values().map(|r| r.n_atoms * r.n_atoms / 4).sum();
        Self { steps: compared + searched + STEPS_PER_COPY * copies, copies }
    }

    /// Returns true if checking the file takes at most about a second.
    pub(super) fn is_low(&self) -> bool {
        self.steps <= MAX_STEPS
    }

    /// Returns the memory of copied atoms, bytes.
    pub(super) fn bytes(&self) -> u64 {
        BYTES_PER_COPY * self.copies
    }
}

/// Returns the number of times that `tag` occurs.
pub(super) fn count(text: &[u8], tag: &[u8]) -> u64 {
    memchr::memmem::find_iter(text, tag).count() as u64
}

/// Numbers of records of a PDB file that begin a search.
#[derive(Default)]
struct RecordCounts {
    seqres: u64,
    others: u64,
}

impl RecordCounts {
    fn of(text: &[u8]) -> Self {
        let mut records = Self::default();
        for line in text.split(|&byte| byte == b'\n') {
            match line.first_chunk::<5>() {
                Some(b"SEQRE") => records.seqres += 1,
                Some(b"ANISO" | b"DBREF" | b"MASTE" | b"MODRE" | b"MTRIX" | b"SEQAD" | b"SSBON") => records.others += 1,
                _ => {}
            }
        }
        records
    }
}
