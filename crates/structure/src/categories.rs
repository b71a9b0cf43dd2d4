//! Categories of an mmCIF file other than `atom_site`: entities, which define which chains (`label_asym_id`) are
//! polymers, assemblies, secondary structure, and the confidence of predicted models.
//!
//! Dictionaries: PDBx/mmCIF, categories `entity`, `entity_poly`, `struct_asym`, `pdbx_struct_assembly_gen`,
//! `pdbx_struct_oper_list`, `struct_conf` and `struct_sheet_range`; `ModelCIF`, categories `ma_qa_metric` and
//! `ma_qa_metric_local`.

use std::collections::HashMap;

use molmesh_surface::{Exceeded, Limit, MemoryMeter as _};

use super::annotations::{Annotations, ResidueConfidence, SecondaryRange};
use super::assembly::{Assemblies, Operator};
use super::error::StructureError;
use super::number;
use super::read::Reading;
use super::text::{decode, list};

const ENTITY: &str = "entity";
const CHAIN: &str = "struct_asym";
const GENERATOR: &str = "pdbx_struct_assembly_gen";
const OPERATOR: &str = "pdbx_struct_oper_list";
const CONF: &str = "struct_conf";
const SHEET: &str = "struct_sheet_range";
const METRIC: &str = "ma_qa_metric";
const LOCAL: &str = "ma_qa_metric_local";

/// Items to read, by category and name, in the order of [`GROUPS`].
pub(super) const ITEMS: [(&str, &str); 44] = [
    (ENTITY, "id"),
    (ENTITY, "type"),
    ("entity_poly", "entity_id"),
    (CHAIN, "id"),
    (CHAIN, "entity_id"),
    (GENERATOR, "assembly_id"),
    (GENERATOR, "oper_expression"),
    (GENERATOR, "asym_id_list"),
    (OPERATOR, "id"),
    (OPERATOR, "matrix[1][1]"),
    (OPERATOR, "matrix[1][2]"),
    (OPERATOR, "matrix[1][3]"),
    (OPERATOR, "vector[1]"),
    (OPERATOR, "matrix[2][1]"),
    (OPERATOR, "matrix[2][2]"),
    (OPERATOR, "matrix[2][3]"),
    (OPERATOR, "vector[2]"),
    (OPERATOR, "matrix[3][1]"),
    (OPERATOR, "matrix[3][2]"),
    (OPERATOR, "matrix[3][3]"),
    (OPERATOR, "vector[3]"),
    (CONF, "conf_type_id"),
    (CONF, "beg_auth_asym_id"),
    (CONF, "beg_auth_seq_id"),
    (CONF, "pdbx_beg_PDB_ins_code"),
    (CONF, "end_auth_asym_id"),
    (CONF, "end_auth_seq_id"),
    (CONF, "pdbx_end_PDB_ins_code"),
    (CONF, "pdbx_PDB_helix_class"),
    (SHEET, "beg_auth_asym_id"),
    (SHEET, "beg_auth_seq_id"),
    (SHEET, "pdbx_beg_PDB_ins_code"),
    (SHEET, "end_auth_asym_id"),
    (SHEET, "end_auth_seq_id"),
    (SHEET, "pdbx_end_PDB_ins_code"),
    (METRIC, "id"),
    (METRIC, "mode"),
    (METRIC, "type"),
    (LOCAL, "model_id"),
    (LOCAL, "label_asym_id"),
    (LOCAL, "label_seq_id"),
    (LOCAL, "label_comp_id"),
    (LOCAL, "metric_value"),
    (LOCAL, "metric_id"),
];

/// Names of the data that groups of items describe, and the end of each group among the [`ITEMS`].
const GROUPS: [(&str, usize); 4] =
    [("entities", 5), ("assemblies", 21), ("helices and strands", 35), ("confidences", 44)];
/// First items of the groups after the entities.
const ASSEMBLIES: usize = GROUPS[0].1;
const SECONDARY: usize = GROUPS[1].1;
const CONFIDENCES: usize = GROUPS[2].1;

/// Maximum number of values of an item. The largest entries of the PDB have about ten thousand chains.
pub(super) const MAX_VALUES: usize = 1 << 18;

/// Memory of a copy of a value besides its text, bytes: its entry in a map and its allocation.
const COPY_BYTES: u64 = 128;

/// Maximum number of helices and strands that a warning names.
const NAMED_RANGES: usize = 20;

/// Returns true if both items, given by index, belong to the same group.
pub(super) fn describe_the_same(a: usize, b: usize) -> bool {
    group(a) == group(b)
}

/// Returns the number of the group of an item, given by index.
fn group(place: usize) -> usize {
    GROUPS.iter().position(|(_, end)| place < *end).unwrap_or(GROUPS.len() - 1)
}

/// Type of an entity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Entity {
    /// Polymer.
    Polymer,
    /// Oligosaccharide.
    Branched,
    /// Any other type.
    Other,
}

impl Entity {
    fn of(name: &str) -> Self {
        match name.to_ascii_lowercase().as_str() {
            "polymer" => Self::Polymer,
            "branched" => Self::Branched,
            _ => Self::Other,
        }
    }
}

/// Values of the [`ITEMS`], in file order.
#[derive(Debug)]
pub(super) struct Categories {
    values: [Vec<String>; ITEMS.len()],
    /// Bytes of all values.
    bytes: u64,
    full: bool,
}

impl Default for Categories {
    fn default() -> Self {
        Self { values: std::array::from_fn(|_| Vec::new()), bytes: 0, full: false }
    }
}

impl Categories {
    /// Returns the index in [`ITEMS`] of an item, given as `category.item` in any case.
    pub(super) fn find(tag: &[u8]) -> Option<usize> {
        let mut parts = tag.splitn(2, |&b| b == b'.');
        let (category, item) = (parts.next()?, parts.next()?);
        let is = |text: &str, raw: &[u8]| text.as_bytes().eq_ignore_ascii_case(raw);
        ITEMS.iter().position(|(c, i)| is(c, category) && is(i, item))
    }

    /// Returns true if one of the [`ITEMS`] belongs to the category, given by its name in any case.
    pub(super) fn include(category: &[u8]) -> bool {
        ITEMS.iter().any(|(known, _)| known.as_bytes().eq_ignore_ascii_case(category))
    }

    /// Adds a value of the item with index `item_ix`. All values count towards the limit of decompressed data, because
    /// a BinaryCIF file may repeat one long text.
    ///
    /// # Errors
    /// Returns [`StructureError::Limit`] and [`StructureError::Memory`].
    pub(super) fn add(&mut self, item_ix: usize, value: &[u8], reading: &Reading<'_>) -> Result<(), StructureError> {
        let values = &mut self.values[item_ix];
        if values.len() >= MAX_VALUES {
            self.full = true;
            return Ok(());
        }
        let bytes = (size_of::<String>() + value.len()) as u64;
        let limit = reading.limits.max_inflated_bytes;
        self.bytes += value.len() as u64;
        if self.bytes > limit {
            return Err(Exceeded::new(Limit::InflatedBytes, limit).error());
        }
        reading.text.grow(bytes)?;
        // A list may be a text field of several lines.
        let spaces: Vec<u8> = value.iter().map(|&b| if b.is_ascii_whitespace() { b' ' } else { b }).collect();
        values.push(decode(&spaces).into_owned());
        Ok(())
    }

    /// Returns true if the item with this index describes entities, and true if it describes helices or strands.
    pub(super) fn describes(item_ix: usize) -> [bool; 2] {
        [0, 2].map(|of| group(item_ix) == of)
    }

    /// Returns true if a tag, without its underscore, belongs to a category that describes assemblies.
    pub(super) fn is_assembly(tag: &[u8]) -> bool {
        let category = tag.split(|&b| b == b'.').next().unwrap_or(tag);
        [GENERATOR, OPERATOR].iter().any(|name| category.eq_ignore_ascii_case(name.as_bytes()))
    }

    /// Removes the values of the group to which the item with index `item_ix` belongs. Returns the name of these data.
    pub(super) fn forget(&mut self, item_ix: usize) -> &'static str {
        let values = self.values.iter_mut().enumerate();
        values.filter(|(other, _)| describe_the_same(*other, item_ix)).for_each(|(_, values)| values.clear());
        GROUPS[group(item_ix)].0
    }

    /// Returns true if the types of entities and the entities of chains are known.
    pub(super) fn entities_are_known(&self) -> bool {
        let [_, types, polymers, _, of_chains, ..] = &self.values;
        !(of_chains.is_empty() || types.is_empty() && polymers.is_empty())
    }

    /// Returns true if every item that describes assemblies has values.
    pub(super) fn assemblies_are_known(&self) -> bool {
        self.values[ASSEMBLIES..SECONDARY].iter().all(|values| !values.is_empty())
    }

    /// Returns true if there are helices or strands.
    pub(super) fn secondary_is_known(&self) -> bool {
        self.values[SECONDARY..CONFIDENCES].iter().any(|values| !values.is_empty())
    }

    /// Returns true if there are confidences of residues.
    pub(super) fn confidences_are_known(&self) -> bool {
        self.values[CONFIDENCES..].iter().all(|values| !values.is_empty())
    }

    /// Returns a warning if there were too many values.
    pub(super) fn warning(&self) -> Option<String> {
        self.full.then(|| {
            format!(
                "more than {MAX_VALUES} entities, chains, operators of assemblies, helices, strands or confidences; \
                 the rest are treated as unknown"
            )
        })
    }

    /// Returns an upper bound of the memory of what is made of the values, bytes: maps of entities and annotations copy
    /// them.
    pub(super) fn copy_bytes(&self) -> u64 {
        self.bytes + COPY_BYTES * self.values.iter().map(Vec::len).sum::<usize>() as u64
    }

    /// Returns the types of entities by their ids.
    pub(super) fn entity_types(&self) -> HashMap<String, Entity> {
        let [ids, types, polymers, ..] = &self.values;
        let types = ids.iter().cloned().zip(types.iter().map(|name| Entity::of(name)));
        types.chain(polymers.iter().map(|id| (id.clone(), Entity::Polymer))).collect()
    }

    /// Returns the entity of each chain.
    pub(super) fn entity_ids(&self) -> HashMap<String, String> {
        let [_, _, _, chains, of_chains, ..] = &self.values;
        chains.iter().cloned().zip(of_chains.iter().cloned()).collect()
    }

    /// Returns the values of residues, and a warning about helices and strands that have two chains.
    pub(super) fn annotations(&self) -> (Annotations, Option<String>) {
        let row =
            |first: usize, row: usize| move |item: usize| self.values[first + item].get(row).map_or("", String::as_str);
        let conf = (0..self.values[SECONDARY].len()).filter_map(|i| {
            let value = row(SECONDARY, i);
            SecondaryRange::of_conf(std::array::from_fn(value))
        });
        let first_sheet = SECONDARY + 8;
        let sheets = (0..self.values[first_sheet].len()).filter_map(|i| {
            let value = row(first_sheet, i);
            SecondaryRange::of_sheet(std::array::from_fn(value))
        });
        let (mut secondary, mut rejected, mut n_rejected) = (Vec::new(), Vec::new(), 0);
        for range in conf.chain(sheets) {
            match range {
                Ok(range) => secondary.push(range),
                Err(ends) => {
                    n_rejected += 1;
                    if rejected.len() < NAMED_RANGES {
                        rejected.push(ends.to_string());
                    }
                }
            }
        }
        let warning = (n_rejected > 0).then(|| {
            let ends = list(rejected, n_rejected);
            format!("ignored helices and strands whose ends are in different chains: {ends}")
        });
        (Annotations { secondary, confidence: self.confidences() }, warning)
    }

    /// Returns the confidences of residues (pLDDT), from the first metric of this type.
    fn confidences(&self) -> Vec<ResidueConfidence> {
        let [ids, modes, types, rows @ .., metrics] = &self.values[CONFIDENCES..] else { return Vec::new() };
        let metric = ids.iter().zip(modes.iter().zip(types)).find(|(_, (mode, kind))| {
            mode.eq_ignore_ascii_case("local") && kind.to_ascii_lowercase().starts_with("plddt")
        });
        let Some((metric, (_, kind))) = metric else { return Vec::new() };
        let own = metrics.iter().enumerate().filter(|(_, of)| *of == metric);
        let mut own: Vec<ResidueConfidence> = own
            .filter_map(|(i, _)| {
                let value = |item: usize| rows[item].get(i).map_or("", String::as_str);
                ResidueConfidence::of(std::array::from_fn(value))
            })
            .collect();
        // Programs also use the plain type for values up to 1.
        if kind.contains("[0,1]") || own.iter().all(|row| row.value <= 1.0) {
            for row in &mut own {
                row.value *= 100.0;
            }
        }
        own
    }

    /// Returns the assemblies.
    pub(super) fn assemblies(self) -> Assemblies {
        let mut assemblies = Assemblies::default();
        let mut values = self.values.into_iter().take(SECONDARY).skip(ASSEMBLIES);
        let mut column = || values.next().unwrap_or_default();
        let [of, expressions, chains, ids] = [column(), column(), column(), column()];
        let numbers: Vec<Vec<String>> = values.collect();
        for (row, id) in ids.into_iter().enumerate() {
            let number = |item: usize| {
                let text = numbers.get(item)?.get(row)?.as_bytes();
                number::real(text, 0, text.len())
            };
            let rows = [0, 4, 8].map(|first| [0, 1, 2, 3].map(|k| number(first + k)));
            assemblies.add_operator(id, Operator::of(rows));
        }
        for ((assembly, expression), chains) in of.into_iter().zip(expressions).zip(chains) {
            assemblies.add_generator(assembly, expression, chains);
        }
        assemblies
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use molmesh_surface::Control;

    use super::*;
    use crate::ReadLimits;

    fn with(values: &[(&str, &str)]) -> Categories {
        let (limits, control) = (ReadLimits::default(), Control::default());
        let (mut known, reading) = (Categories::default(), Reading::new(&limits, &control));
        for (tag, value) in values {
            known.add(Categories::find(tag.as_bytes()).unwrap(), value.as_bytes(), &reading).unwrap();
        }
        known
    }

    #[test]
    fn chains_have_the_type_of_their_entity() {
        let known = with(&[
            ("entity.id", "1"),
            ("entity.type", "polymer"),
            ("ENTITY.ID", "2"),
            ("Entity.Type", "Branched"),
            ("entity_poly.entity_id", "3"),
            ("struct_asym.id", "A"),
            ("struct_asym.entity_id", "1"),
            ("struct_asym.id", "B"),
            ("struct_asym.entity_id", "2"),
            ("struct_asym.id", "C"),
            ("struct_asym.entity_id", "3"),
            ("struct_asym.id", "D"),
            ("struct_asym.entity_id", "4"),
        ]);
        assert!(known.entities_are_known());
        let ids = known.entity_ids();
        assert_eq!(["A", "B", "C", "D"].map(|c| ids.get(c).map(String::as_str)), ["1", "2", "3", "4"].map(Some));
        let types = known.entity_types();
        assert_eq!(
            ["1", "2", "3", "4"].map(|id| types.get(id).copied()),
            [Some(Entity::Polymer), Some(Entity::Branched), Some(Entity::Polymer), None]
        );
        assert!(!with(&[("entity.id", "1"), ("struct_asym.entity_id", "1")]).entities_are_known());
        assert_eq!([&b"entity.details"[..], b"entity", b"entity_poly.id"].map(Categories::find), [None; 3]);
    }

    #[test]
    fn values_are_bounded_and_the_bound_is_reported() {
        let (limits, control) = (ReadLimits { max_inflated_bytes: 1000, ..ReadLimits::default() }, Control::default());
        let (mut many, reading) = (Categories::default(), Reading::new(&limits, &control));
        (0..MAX_VALUES).for_each(|_| many.add(3, b"", &reading).unwrap());
        assert_eq!(many.warning(), None);
        many.add(3, b"", &reading).unwrap();
        assert!(many.warning().unwrap().starts_with("more than 262144 entities"));
        assert_eq!(many.values[3].len(), MAX_VALUES);
        // Each repetition of a long text counts.
        let long = [b'x'; 100];
        let added = (0..11).map(|_| many.add(6, &long, &reading)).collect::<Vec<_>>();
        assert!(added[..10].iter().all(Result::is_ok));
        assert_eq!(added[10], Err(Exceeded::new(Limit::InflatedBytes, 1000).error()));
    }

    #[test]
    fn assemblies_are_rules_and_operators() {
        let mut values = vec![("pdbx_struct_oper_list.id", "7"), ("PDBX_STRUCT_OPER_LIST.ID", "8")];
        for (row, (name, item)) in ITEMS.into_iter().take(21).skip(9).enumerate() {
            assert_eq!(name, "pdbx_struct_oper_list");
            let item: &'static str = format!("{name}.{item}").leak();
            // The identity with a translation of 4.5, -1 and 0 Å, and an operator without a number.
            let number = ["1", "0", "0", "4.5", "0", "1", "0", "-1", "0", "0", "1", "0"][row];
            values.extend([(item, number), (item, if row == 11 { "?" } else { number })]);
        }
        assert!(!with(&values).assemblies_are_known());
        for value in [("assembly_id", "1"), ("oper_expression", "7"), ("asym_id_list", "A,\nB C")] {
            values.push((format!("pdbx_struct_assembly_gen.{}", value.0).leak(), value.1));
        }
        let known = with(&values);
        assert!(known.assemblies_are_known());
        let assemblies = known.assemblies();
        let image = assemblies.expand("7").unwrap()[0].apply([1.0, 2.0, 3.0]);
        assert_eq!(image.map(|v| v.to_string()), ["5.5", "1", "3"]);
        assert!(assemblies.expand("8").unwrap_err().expected.contains("twelve numbers"));
        let rules: Vec<Vec<&str>> = assemblies.generators("1").map(|rule| rule.chains().collect()).collect();
        assert_eq!(rules, [["A", "B", "C"]]);
    }
}
