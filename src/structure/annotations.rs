//! Values of residues besides those of atoms: helices and strands, and the confidence of predicted models.

use rustc_hash::FxHashMap;

use super::atoms::Structure;
use super::contents::Kind;
use super::error::StructureError;
use super::number;
use super::read::Reading;
use super::text::decode;

/// Author number and insertion code (0 if there is none) of a residue. They order the residues of a chain.
pub(super) type ResidueNumber = (i32, u8);

/// Secondary structure of a residue.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum SecondaryStructure {
    /// Right-handed or left-handed α helix, and helices of unknown type.
    AlphaHelix,
    /// 3₁₀ helix.
    ThreeTenHelix,
    /// π helix.
    PiHelix,
    /// Strand of a β sheet.
    Strand,
    /// Turn.
    Turn,
}

impl SecondaryStructure {
    /// Returns the type of a helix by its class in PDB files: 3 is a π helix, 5 a 3₁₀ helix.
    fn of_class(class: &[u8]) -> Self {
        match class.trim_ascii() {
            b"3" => Self::PiHelix,
            b"5" => Self::ThreeTenHelix,
            _ => Self::AlphaHelix,
        }
    }

    /// Returns the type by `struct_conf.conf_type_id` and the class of a helix; `None` for bends and polyproline
    /// helices, which are coil here.
    fn of_conf(id: &str, class: &str) -> Option<Self> {
        let id = id.to_ascii_uppercase();
        match id.as_str() {
            _ if id.starts_with("STRN") => Some(Self::Strand),
            _ if id.starts_with("TURN") => Some(Self::Turn),
            _ if !id.starts_with("HELX") || id.contains("_PP_") => None,
            _ if id.contains("_3T_") => Some(Self::ThreeTenHelix),
            _ if id.contains("_PI_") => Some(Self::PiHelix),
            _ => Some(Self::of_class(class.as_bytes())),
        }
    }
}

/// Residues of a chain with one secondary structure.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SecondaryRange {
    chain: Box<str>,
    first: ResidueNumber,
    last: ResidueNumber,
    structure: SecondaryStructure,
}

impl SecondaryRange {
    /// Reads a HELIX or SHEET record; `None` if a number is missing.
    pub(super) fn of_record(line: &[u8]) -> Option<Self> {
        let field = |from: usize, to: usize| line.get(from..to.min(line.len())).unwrap_or_default().trim_ascii();
        let helix = line.starts_with(b"HELIX");
        let [chain, first, last] = if helix { [18, 21, 33] } else { [20, 22, 33] };
        let residue = |at: usize| {
            let code = field(at + 4, at + 5).first().copied().unwrap_or(0);
            Some((number::integer(field(at, at + 4))?, code))
        };
        let structure = if helix { SecondaryStructure::of_class(field(38, 40)) } else { SecondaryStructure::Strand };
        let chain = decode(field(chain, chain + 2)).as_ref().into();
        Some(Self { chain, first: residue(first)?, last: residue(last)?, structure })
    }

    /// Reads the author names of a row of `struct_conf`: type, chain, number and insertion code of the first residue,
    /// number and insertion code of the last one, and class of the helix.
    pub(super) fn of_conf([id, chain, first, first_code, last, last_code, class]: [&str; 7]) -> Option<Self> {
        let structure = SecondaryStructure::of_conf(id, class)?;
        Self::of_names([chain, first, first_code, last, last_code], structure)
    }

    /// Reads the author names of a row of `struct_sheet_range`, as those of `struct_conf`.
    pub(super) fn of_sheet(names: [&str; 5]) -> Option<Self> {
        Self::of_names(names, SecondaryStructure::Strand)
    }

    fn of_names([chain, first, first_code, last, last_code]: [&str; 5], structure: SecondaryStructure) -> Option<Self> {
        let residue = |text: &str, code: &str| {
            let code = known(code).and_then(|code| code.as_bytes().first().copied()).unwrap_or(0);
            Some((number::integer(text.as_bytes())?, code))
        };
        let (first, last) = (residue(first, first_code)?, residue(last, last_code)?);
        Some(Self { chain: known(chain)?.into(), first, last, structure })
    }
}

/// Returns a value of mmCIF unless it is missing.
fn known(value: &str) -> Option<&str> {
    Some(value).filter(|value| !matches!(*value, "" | "?" | "."))
}

/// Row of `ma_qa_metric_local` with the confidence of a residue.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ResidueConfidence {
    model: i32,
    /// `label_asym_id`.
    chain: Box<str>,
    number: i32,
    residue: Box<str>,
    /// From 0 to 100.
    pub(super) value: f64,
}

impl ResidueConfidence {
    /// Reads a row: model, chain, number, name and value.
    pub(super) fn of([model, chain, number, residue, value]: [&str; 5]) -> Option<Self> {
        let integer = |text: &str| number::integer(text.as_bytes());
        let value = number::real(value.as_bytes(), 0, value.len())?;
        let (model, number) = (integer(model).unwrap_or(1), integer(number)?);
        Some(Self { model, chain: chain.into(), number, residue: residue.into(), value })
    }
}

/// Values of residues that a file has.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Annotations {
    /// In file order; they may overlap.
    pub(super) secondary: Vec<SecondaryRange>,
    pub(super) confidence: Vec<ResidueConfidence>,
}

impl Annotations {
    /// Bytes of an entry, with its names.
    const ENTRY_BYTES: usize = 80;

    /// Adds the memory of the values to that of the structure.
    pub(super) fn keep(&self, reading: &Reading<'_>) -> Result<(), StructureError> {
        reading.keep((Self::ENTRY_BYTES * (self.secondary.len() + self.confidence.len())) as u64)
    }
}

/// Secondary structure by chain and residue.
#[derive(Debug)]
pub struct SecondaryRanges {
    /// First and last residue of disjoint ranges in ascending order, by id of the chain.
    of_chains: Vec<Vec<(i64, i64, SecondaryStructure)>>,
}

impl SecondaryRanges {
    /// Returns the ranges of a structure; `None` if its file describes none. Of ranges that overlap, the one that
    /// begins first keeps the common residues.
    #[must_use]
    pub fn of(structure: &Structure) -> Option<Self> {
        let ranges = &structure.annotations.secondary;
        if ranges.is_empty() {
            return None;
        }
        let ids: FxHashMap<&str, usize> = structure.chain.texts().zip(0..).collect();
        let mut of_chains = vec![Vec::new(); ids.len()];
        for range in ranges {
            if let Some(&chain) = ids.get(&*range.chain) {
                of_chains[chain].push((key(range.first), key(range.last), range.structure));
            }
        }
        for ranges in &mut of_chains {
            ranges.sort_by_key(|(first, ..)| *first);
            let mut end = i64::MIN;
            ranges.retain_mut(|(first, last, _)| {
                *first = (*first).max(end);
                end = end.max(last.saturating_add(1));
                first <= last
            });
        }
        Some(Self { of_chains })
    }

    /// Returns the secondary structure of atom `i`; `None` for coil and for atoms that are not protein.
    #[must_use]
    pub fn get(&self, structure: &Structure, i: usize) -> Option<SecondaryStructure> {
        if structure.kind[i] != Kind::Protein {
            return None;
        }
        let ranges = &self.of_chains[structure.chain.id(i) as usize];
        let residue = key((structure.residue_number[i], structure.insertion_code[i]));
        let before = ranges.partition_point(|(first, ..)| *first <= residue);
        let (_, last, kind) = ranges.get(before.checked_sub(1)?)?;
        (residue <= *last).then_some(*kind)
    }
}

/// Returns a number with the order of residues.
fn key((number, code): ResidueNumber) -> i64 {
    i64::from(number) * 256 + i64::from(code)
}

/// Confidence of the residues of a predicted model, from 0 to 100.
#[derive(Debug)]
pub struct Confidences<'a> {
    /// Name and value by model, id of the `label_chain`, and number.
    of_residues: FxHashMap<(i32, u32, i32), (&'a str, f64)>,
}

impl<'a> Confidences<'a> {
    /// Returns the values of `ma_qa_metric_local`; `None` if the file has none for the polymers among the `selected`
    /// atoms, or numbers their residues differently: the table has `label_seq_id`, atoms have the author's number.
    #[must_use]
    pub fn of(structure: &'a Structure, selected: &[u32]) -> Option<Self> {
        let rows = &structure.annotations.confidence;
        let ids: FxHashMap<&str, u32> = structure.label_chain.texts().zip(0..).collect();
        let known = rows.iter().filter_map(|row| {
            let chain = *ids.get(&*row.chain)?;
            Some(((row.model, chain, row.number), (&*row.residue, row.value)))
        });
        let confidences = Self { of_residues: known.collect() };
        if confidences.of_residues.is_empty() {
            return None;
        }
        let is_polymer = |i: &usize| matches!(structure.kind[*i], Kind::Protein | Kind::Nucleic | Kind::Polymer);
        let mut polymers = selected.iter().map(|&i| i as usize).filter(is_polymer);
        polymers.all(|i| confidences.get(structure, i).is_some()).then_some(confidences)
    }

    /// Returns the value of the residue of atom `i`; `None` if the table lacks it.
    #[must_use]
    pub fn get(&self, structure: &Structure, i: usize) -> Option<f64> {
        let residue_id = (structure.model[i], structure.label_chain.id(i), structure.residue_number[i]);
        let (residue, value) = self.of_residues.get(&residue_id)?;
        (*residue == structure.residue.get(i)).then_some(*value)
    }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;
    use crate::structure::{ReadLimits, read};

    fn range(first: i32, last: i32, structure: SecondaryStructure) -> SecondaryRange {
        SecondaryRange { chain: "A".into(), first: (first, 0), last: (last, 0), structure }
    }

    #[test]
    fn records_have_the_columns_of_the_format() {
        let record = SecondaryRange::of_record;
        let helix = record(b"HELIX    1  H1 SER A   47  GLY A   56  1                                  10    ");
        assert_eq!(helix, Some(range(47, 56, SecondaryStructure::AlphaHelix)));
        let helix =
            record(b"HELIX    2  H2 GLU B   -3A THR B   30B 5").map(|helix| (helix.first, helix.last, helix.structure));
        assert_eq!(helix, Some(((-3, b'A'), (30, b'B'), SecondaryStructure::ThreeTenHelix)));
        let sheet = record(b"SHEET    2  S1 2 GLY A  28  GLY A  36 -1");
        assert_eq!(sheet, Some(range(28, 36, SecondaryStructure::Strand)));
        for short in ["HELIX", "SHEET    1  S1 2 ALA A  16", "SHEET    1  S1 2 ALA A      ALA A  25  0"] {
            assert_eq!(record(short.as_bytes()), None, "{short}");
        }
    }

    #[test]
    fn types_of_dictionaries_are_known() {
        use SecondaryStructure::{AlphaHelix, PiHelix, Strand, ThreeTenHelix, Turn};
        for (id, class, expected) in [
            ("HELX_P", "1", Some(AlphaHelix)),
            ("HELX_P", "5", Some(ThreeTenHelix)),
            ("HELX_RH_AL_P", "?", Some(AlphaHelix)),
            ("HELX_RH_3T_P", "?", Some(ThreeTenHelix)),
            ("HELX_RH_PI_P", "?", Some(PiHelix)),
            ("HELX_LH_PP_P", "?", None),
            ("TURN_TY1_P", "?", Some(Turn)),
            ("STRN", "?", Some(Strand)),
            ("BEND", "?", None),
        ] {
            assert_eq!(SecondaryStructure::of_conf(id, class), expected, "{id} {class}");
        }
    }

    #[test]
    fn overlapping_ranges_are_found_by_the_first_one() {
        use SecondaryStructure::{AlphaHelix, Strand, Turn};
        let mut structure = read(include_bytes!("../../samples/4pti.pdb"), &ReadLimits::default()).unwrap();
        structure.annotations.secondary =
            vec![range(20, 30, Strand), range(10, 24, AlphaHelix), range(12, 14, Turn), range(40, 39, Turn)];
        let ranges = SecondaryRanges::of(&structure).unwrap();
        let found = |number: i32| {
            let i = (0..structure.len()).find(|&i| structure.residue_number[i] == number).unwrap();
            ranges.get(&structure, i)
        };
        assert_eq!([9, 10, 13, 24].map(found), [None, Some(AlphaHelix), Some(AlphaHelix), Some(AlphaHelix)]);
        assert_eq!([25, 30, 31, 39, 40].map(found), [Some(Strand), Some(Strand), None, None, None]);
        structure.annotations.secondary.clear();
        assert!(SecondaryRanges::of(&structure).is_none());
    }
}
