//! Values of residues besides those of atoms: helices and strands, and the confidence of predicted models.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::ops::Range;

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
    pub(super) fn of_record(line: &[u8]) -> Option<Result<Self, TwoChains>> {
        let field = |from: usize, to: usize| line.get(from..to.min(line.len())).unwrap_or_default().trim_ascii();
        let helix = line.starts_with(b"HELIX");
        // Each chain is followed by a residue; two-letter names begin a column before.
        let [first_chain, first, last_chain, last] = if helix { [18, 21, 30, 33] } else { [20, 22, 31, 33] };
        let residue = |at: usize| {
            let code = field(at + 4, at + 5).first().copied().unwrap_or(0);
            Some((number::integer(field(at, at + 4))?, code))
        };
        let structure = if helix { SecondaryStructure::of_class(field(38, 40)) } else { SecondaryStructure::Strand };
        let [first_chain, last_chain] = [first_chain, last_chain].map(|at| decode(field(at, at + 2)).into_owned());
        Some(Self::between((&first_chain, residue(first)?), (&last_chain, residue(last)?), structure))
    }

    /// Reads the author names of a row of `struct_conf`: type, chain, number and insertion code of the first residue,
    /// the same of the last one, and class of the helix; `None` if one is missing.
    pub(super) fn of_conf([id, names @ .., class]: [&str; 8]) -> Option<Result<Self, TwoChains>> {
        let structure = SecondaryStructure::of_conf(id, class)?;
        Self::of_names(names, structure)
    }

    /// Reads the author names of a row of `struct_sheet_range`, as those of `struct_conf`.
    pub(super) fn of_sheet(names: [&str; 6]) -> Option<Result<Self, TwoChains>> {
        Self::of_names(names, SecondaryStructure::Strand)
    }

    fn of_names(
        [first_chain, first, first_code, last_chain, last, last_code]: [&str; 6],
        structure: SecondaryStructure,
    ) -> Option<Result<Self, TwoChains>> {
        let residue = |text: &str, code: &str| {
            let code = known(code).and_then(|code| code.as_bytes().first().copied()).unwrap_or(0);
            Some((number::integer(text.as_bytes())?, code))
        };
        let (first_chain, last_chain) = (known(first_chain)?, known(last_chain).unwrap_or_default());
        Some(Self::between(
            (first_chain, residue(first, first_code)?),
            (last_chain, residue(last, last_code)?),
            structure,
        ))
    }

    fn between(
        (chain, first): (&str, ResidueNumber),
        (last_chain, last): (&str, ResidueNumber),
        structure: SecondaryStructure,
    ) -> Result<Self, TwoChains> {
        // Some programs write the chain of the first residue only.
        if chain == last_chain || last_chain.is_empty() {
            return Ok(Self { chain: chain.into(), first, last, structure });
        }
        Err(TwoChains { first: (chain.into(), first.0), last: (last_chain.into(), last.0) })
    }
}

/// Chain and number of the ends of a helix or strand that has two chains.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct TwoChains {
    first: (Box<str>, i32),
    last: (Box<str>, i32),
}

impl fmt::Display for TwoChains {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [(first, m), (last, n)] = [&self.first, &self.last];
        write!(f, "residue {m} of chain `{first}` to residue {n} of chain `{last}`")
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
    /// Bytes of an entry besides its names.
    const ENTRY_BYTES: usize = 112;
    /// Bytes of a residue while secondary structure is found.
    const RESIDUE_BYTES: usize = 64;

    /// Adds the memory of the values to that of the structure, and the memory that [`SecondaryRanges`] needs for
    /// `n_residues`.
    pub(super) fn keep(&self, n_residues: usize, reading: &Reading<'_>) -> Result<(), StructureError> {
        let names = self.secondary.iter().map(|range| range.chain.len());
        let names = names.chain(self.confidence.iter().map(|row| row.chain.len() + row.residue.len()));
        let entries = names.map(|bytes| Self::ENTRY_BYTES + bytes).sum::<usize>();
        let residues = if self.secondary.is_empty() { 0 } else { Self::RESIDUE_BYTES * n_residues };
        reading.keep((entries + residues) as u64)
    }
}

/// Secondary structure of residues.
#[derive(Debug)]
pub struct SecondaryRanges {
    /// By chain and residue; coil is missing.
    by_residue: HashMap<(u32, ResidueNumber), SecondaryStructure>,
}

impl SecondaryRanges {
    /// Finds the secondary structure of each residue; `None` if the file describes none. A range has the residues of
    /// its chain between its ends, in the order of the first model, or by number if one of its ends is missing. Of
    /// ranges that overlap, the one that begins first keeps the common residues.
    #[must_use]
    pub fn of(structure: &Structure) -> Option<Self> {
        let ranges = &structure.annotations.secondary;
        if ranges.is_empty() {
            return None;
        }
        let ids: FxHashMap<&str, u32> = structure.chain.texts().zip(0..).collect();
        let mut of_chains: BTreeMap<u32, Vec<&SecondaryRange>> = BTreeMap::new();
        for range in ranges {
            if let Some(chain) = ids.get(&*range.chain) {
                of_chains.entry(*chain).or_default().push(range);
            }
        }
        // Model of each chain, and its residues in this model.
        let mut chains: FxHashMap<u32, (i32, Vec<ResidueNumber>)> = FxHashMap::default();
        for i in (0..structure.len()).filter(|&i| structure.starts_residue[i]) {
            let chain = structure.chain.id(i);
            let (model, residues) = chains.entry(chain).or_insert_with(|| (structure.model[i], Vec::new()));
            if *model == structure.model[i] && of_chains.contains_key(&chain) {
                residues.push(number(structure, i));
            }
        }
        let mut by_residue = HashMap::new();
        for (chain, ranges) in of_chains {
            let residues = chains.get(&chain).map_or(&[][..], |(_, residues)| residues);
            by_residue
                .extend(secondary_residues(residues, &ranges).map(|(place, kind)| ((chain, residues[place]), kind)));
        }
        Some(Self { by_residue })
    }

    /// Returns the secondary structure of atom `i`; `None` for coil and for atoms that are not protein.
    #[must_use]
    pub fn get(&self, structure: &Structure, i: usize) -> Option<SecondaryStructure> {
        if structure.kind[i] != Kind::Protein {
            return None;
        }
        self.by_residue.get(&(structure.chain.id(i), number(structure, i))).copied()
    }
}

fn number(structure: &Structure, i: usize) -> ResidueNumber {
    (structure.residue_number[i], structure.insertion_code[i])
}

/// Returns the places of residues among those of a chain, with their secondary structure. The last of several entries
/// for a place counts: ranges of which both ends exist come last.
fn secondary_residues(
    residues: &[ResidueNumber],
    ranges: &[&SecondaryRange],
) -> impl Iterator<Item = (usize, SecondaryStructure)> {
    let mut by_number: Vec<(i64, usize)> =
        residues.iter().zip(0..).map(|(&number, place)| (key(number), place)).collect();
    by_number.sort_unstable();
    // Residues of a chain may share a number: the first one counts.
    let first_from = |number: i64| by_number.partition_point(|(other, _)| *other < number);
    let place = |number: i64| by_number.get(first_from(number)).filter(|(other, _)| *other == number).map(|at| at.1);
    let (mut in_order, mut in_numbers) = (Vec::new(), Vec::new());
    for range in ranges {
        let (first, last) = (key(range.first), key(range.last));
        match (place(first), place(last)) {
            (Some(first_ix), Some(last_ix)) if first_ix <= last_ix => {
                in_order.push((first_ix..last_ix + 1, range.structure));
            }
            // Ends in descending order of numbers and of residues are an error of the file.
            (Some(_), Some(_)) if first > last => {}
            (Some(first_ix), Some(last_ix)) => in_order.push((last_ix..first_ix + 1, range.structure)),
            _ => in_numbers.push((first_from(first)..first_from(last.saturating_add(1)), range.structure)),
        }
    }
    let of_numbers: Vec<_> = disjoint(in_numbers).map(|(at, kind)| (by_number[at].1, kind)).collect();
    of_numbers.into_iter().chain(disjoint(in_order))
}

/// Returns the places in ranges. Of ranges that overlap, the one that begins first has the common places.
fn disjoint(mut ranges: Vec<(Range<usize>, SecondaryStructure)>) -> impl Iterator<Item = (usize, SecondaryStructure)> {
    ranges.sort_by_key(|(places, _)| places.start);
    let mut end = 0;
    ranges.into_iter().flat_map(move |(places, kind)| {
        let start = places.start.max(end);
        end = end.max(places.end);
        (start..places.end).map(move |place| (place, kind))
    })
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
        // A chain of several entities has several ids, of which the first is that of the polymer.
        let mut ids: FxHashMap<&str, u32> = FxHashMap::default();
        for (chain, id) in structure.label_chain.texts().zip(0..) {
            ids.entry(chain).or_insert(id);
        }
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
    use crate::{ReadLimits, read};

    fn range(first: i32, last: i32, structure: SecondaryStructure) -> SecondaryRange {
        SecondaryRange { chain: "A".into(), first: (first, 0), last: (last, 0), structure }
    }

    #[test]
    fn records_have_the_columns_of_the_format() {
        let record = |line: &[u8]| SecondaryRange::of_record(line)?.ok();
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
        let mut structure = read(include_bytes!("../../../samples/4pti.pdb"), &ReadLimits::default()).unwrap();
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
