//! Residue names of polymers, water, single ions, cofactors and saccharides, including those of simulation packages.

use std::collections::HashSet;
use std::sync::LazyLock;

/// Amino acids, their common variants and modifications, and caps of chains. Their atoms C*, N*, O*, H* are never
/// metals. Sources: chemical component dictionary; AMBER, CHARMM and GROMOS for protonation states and old nucleic acid
/// names.
const AMINO_ACIDS: &[&str] = &[
    "ALA", "ARG", "ASN", "ASP", "CYS", "GLN", "GLU", "GLY", "HIS", "ILE", "LEU", "LYS", "MET", "PHE", "PRO", "SER",
    "THR", "TRP", "TYR", "VAL", "ASX", "GLX", "UNK", "XLE", "MSE", "SEC", "PYL", "HID", "HIE", "HIP", "HSD", "HSE",
    "HSP", "HISA", "HISB", "HISD", "HISE", "HISH", "CYX", "CYM", "CYS2", "CYSH", "CSS", "ASH", "ASPH", "GLH", "GLUH",
    "LYN", "LYSH", "LSN", "ARGN", "PCA", "SEP", "TPO", "PTR", "HYP", "CSO", "CSD", "CME", "CSX", "OCS", "KCX", "MLY",
    "M3L", "MLZ", "ALY", "CGU", "DAL", "DAR", "DSG", "DAS", "DCY", "DGN", "DGL", "DHI", "DIL", "DLE", "DLY", "MED",
    "DPN", "DPR", "DSN", "DTH", "DTR", "DTY", "DVA", "AIB", "NLE", "ORN", "ABA", "SAR", "ACE", "NME", "NMA", "NH2",
    "FOR",
];

/// Nucleotides, from the same sources as [`AMINO_ACIDS`].
const NUCLEOTIDES: &[&str] = &[
    "A", "C", "G", "U", "T", "I", "N", "DA", "DC", "DG", "DT", "DU", "DI", "DN", "RA", "RC", "RG", "RU", "A3", "A5",
    "C3", "C5", "G3", "G5", "U3", "U5", "DA3", "DA5", "DC3", "DC5", "DG3", "DG5", "DT3", "DT5", "RA3", "RA5", "RC3",
    "RC5", "RG3", "RG5", "RU3", "RU5", "ADE", "CYT", "GUA", "THY", "URA", "PSU", "5MU", "5MC", "1MA", "2MG", "7MG",
    "H2U", "OMC", "OMG", "OMU", "4SU", "M2G", "YYG", "+A", "+C", "+G", "+U", "+T", "+I",
];

/// Cofactors, by their names in the component dictionary: nicotinamide and flavin nucleotides, haems, pyridoxal and
/// thiamine phosphates, coenzymes A, B and M, adenosylmethionine, cobalamins, biotin, lipoate, folates, biopterins,
/// glutathione, molybdopterins, quinones, ascorbate, coenzymes F420 and F430, chlorophylls, iron–sulphur clusters.
const COFACTORS: &[&str] = &[
    "NAD", "NAI", "NAP", "NDP", "NAJ", "TXD", "TXP", "FAD", "FDA", "FMN", "FNR", "RBF", "HEM", "HEA", "HEB", "HEC",
    "HEO", "HAS", "HEV", "HDD", "HDE", "HDM", "DHE", "SRM", "COH", "ZNH", "MNH", "MNR", "FDE", "FEC", "HIF", "HNI",
    "HP5", "HEG", "HES", "MH0", "PLP", "PMP", "PLR", "TPP", "TDP", "TPW", "THD", "TPU", "TZD", "COA", "ACO", "CAO",
    "COZ", "SCA", "MLC", "COD", "CMC", "3CP", "COF", "CO6", "COS", "CAA", "HMG", "MCA", "BCO", "FAQ", "PNS", "SAM",
    "SAH", "SMM", "B12", "CNC", "COB", "COY", "CBY", "BTN", "BTI", "LPA", "LPB", "LPM", "THG", "THF", "FFO", "C2F",
    "MEF", "THH", "FOZ", "DHF", "H4B", "BH4", "H2B", "HBI", "BIO", "THB", "GSH", "GDS", "GTT", "MTE", "PCD", "MGD",
    "MSS", "2MD", "XAX", "PQQ", "UQ1", "UQ2", "UQ5", "UQ6", "UQ7", "UQ8", "UQ9", "U10", "MQ7", "MQ8", "MQ9", "PQN",
    "PL9", "ASC", "F43", "F42", "COM", "TP7", "CLA", "CHL", "BCL", "BCB", "CL7", "BPB", "BPH", "PHO", "CL1", "CL2",
    "CL0", "SF4", "FES", "F3S", "CFM", "ICS", "CLF", "1CL", "SF3", "FS1", "FSO",
];

/// Water, by names of the component dictionary and of simulation packages.
const WATER: &[&str] = &[
    "HOH", "WAT", "H2O", "DOD", "D2O", "TIP", "TIP3", "TIP4", "TIP5", "TIP2", "TIP3P", "TIP4P", "TIP5P", "TP3", "TP3M",
    "TP4", "TP5", "T3P", "T4P", "T5P", "T3H", "SOL", "SPC", "SPCE", "OHH", "HHO", "WTR", "OPC", "OPC3", "SWM4", "SWM6",
];

/// CHARMM ion names that do not begin with the symbol of the element, or begin with the symbol of another element.
const IONS: &[(&str, u8)] = &[
    ("SOD", 11),
    ("POT", 19),
    ("CLA", 17),
    ("CAL", 20),
    ("CES", 55),
    ("LIT", 3),
    ("RUB", 37),
    ("CAD", 48),
    ("BAR", 56),
];

/// Single ions that may occur in ATOM records: names of the component dictionary and of simulation packages, without
/// digits and signs.
const SINGLE_IONS: &[&str] =
    &["NA", "K", "CL", "MG", "CA", "ZN", "LI", "RB", "CS", "BR", "CD", "BA", "MN", "FE", "CU", "CO", "NI", "SR", "IOD"];

/// The twenty standard amino acids and the standard nucleotides.
const STANDARD: &[&str] = &[
    "ALA", "ARG", "ASN", "ASP", "CYS", "GLN", "GLU", "GLY", "HIS", "ILE", "LEU", "LYS", "MET", "PHE", "PRO", "SER",
    "THR", "TRP", "TYR", "VAL", "A", "C", "G", "U", "T", "I", "DA", "DC", "DG", "DT", "DU", "DI",
];

/// Four-letter residue names whose first three letters are a residue name too: GROMOS names and AMBER chain ends.
const FOUR_LETTERS: &[&str] = &[
    "TIP2", "TIP3", "TIP4", "TIP5", "SPCE", "HISA", "HISB", "HISD", "HISE", "HISH", "CYS2", "CYSH", "ASPH", "GLUH",
    "LYSH", "ARGN", "ALAD", "NMET", "CMET", "NLEU",
];

/// Saccharides: components of the component dictionary whose type contains `saccharide`, ascorbate excepted.
static SACCHARIDES: LazyLock<HashSet<&'static str>> =
    LazyLock::new(|| include_str!("saccharides.txt").split_ascii_whitespace().collect());

/// Class of a residue by its name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Class {
    /// Amino acid or cap of a peptide.
    AminoAcid,
    /// Nucleotide.
    Nucleotide,
    /// Cofactor.
    Cofactor,
    /// Saccharide.
    Saccharide,
    /// Any other residue.
    Other,
}

impl Class {
    pub(super) fn of(residue: &str) -> Self {
        match residue {
            name if AMINO_ACIDS.contains(&name) => Self::AminoAcid,
            name if NUCLEOTIDES.contains(&name) => Self::Nucleotide,
            name if COFACTORS.contains(&name) => Self::Cofactor,
            name if SACCHARIDES.contains(name) => Self::Saccharide,
            _ => Self::Other,
        }
    }
}

pub(super) fn is_polymer(residue: &str) -> bool {
    matches!(Class::of(residue), Class::AminoAcid | Class::Nucleotide)
}

pub(super) fn is_water(residue: &str) -> bool {
    WATER.contains(&residue)
}

/// Returns the atomic number of an ion by its CHARMM name.
pub(super) fn charmm_ion(residue: &str) -> Option<u8> {
    IONS.iter().find(|(name, _)| *name == residue).map(|&(_, z)| z)
}

/// Returns true for a residue that is a single ion.
pub(super) fn is_ion(residue: &str) -> bool {
    let bare = residue.trim_end_matches(|c: char| c.is_ascii_digit() || c == '+' || c == '-');
    charmm_ion(residue).is_some() || SINGLE_IONS.iter().any(|ion| ion.eq_ignore_ascii_case(bare))
}

/// Returns true for a standard amino acid or nucleotide.
pub(super) fn is_standard(residue: &str) -> bool {
    STANDARD.contains(&residue)
}

/// Returns true for a known four-letter residue name whose first three letters are a residue name too.
pub(super) fn is_four_letters(residue: &str) -> bool {
    FOUR_LETTERS.contains(&residue)
}
