//! Entities of an mmCIF file: which of its chains (`label_asym_id`) are polymers.
//!
//! Dictionary: PDBx/mmCIF, categories `entity`, `entity_poly` and `struct_asym`.

use std::collections::{HashMap, HashSet};

/// Items to read, by category and name.
pub(super) const ITEMS: [(&str, &str); 5] = [
    ("entity", "id"),
    ("entity", "type"),
    ("entity_poly", "entity_id"),
    ("struct_asym", "id"),
    ("struct_asym", "entity_id"),
];

/// Largest number of values of an item. The largest entries of the PDB have about ten thousand chains.
pub(super) const MAX_VALUES: usize = 1 << 18;

/// Values of the [`ITEMS`], in file order.
#[derive(Debug, Default)]
pub(super) struct Entities {
    values: [Vec<String>; ITEMS.len()],
    full: bool,
}

impl Entities {
    /// Returns the index in [`ITEMS`] of an item, given as `category.item` in any case.
    pub(super) fn find(tag: &[u8]) -> Option<usize> {
        let mut parts = tag.splitn(2, |&b| b == b'.');
        let (category, item) = (parts.next()?, parts.next()?);
        let is = |text: &str, raw: &[u8]| text.as_bytes().eq_ignore_ascii_case(raw);
        ITEMS.iter().position(|(c, i)| is(c, category) && is(i, item))
    }

    /// Adds a value of the item with index `place`.
    pub(super) fn add(&mut self, place: usize, value: String) {
        let values = &mut self.values[place];
        if values.len() < MAX_VALUES {
            values.push(value);
        } else {
            self.full = true;
        }
    }

    /// Returns true if the types of entities and the entities of chains are known.
    pub(super) fn are_known(&self) -> bool {
        let [_, types, polymers, _, of_chains] = &self.values;
        !(of_chains.is_empty() || types.is_empty() && polymers.is_empty())
    }

    /// Returns a warning if there were too many values.
    pub(super) fn warning(&self) -> Option<String> {
        self.full.then(|| format!("more than {MAX_VALUES} entities or chains; the rest are treated as unknown"))
    }

    /// Maps each chain whose entity has a known type to true for polymers.
    pub(super) fn polymer_chains(self) -> HashMap<String, bool> {
        let [ids, types, listed, chains, of_chains] = self.values;
        let listed: HashSet<String> = listed.into_iter().collect();
        let types: HashMap<String, bool> =
            ids.into_iter().zip(types).map(|(id, kind)| (id, kind.eq_ignore_ascii_case("polymer"))).collect();
        let verdict = |entity: &String| listed.contains(entity).then_some(true).or(types.get(entity).copied());
        let known = chains.into_iter().zip(of_chains);
        known.filter_map(|(chain, entity)| verdict(&entity).map(|polymer| (chain, polymer))).collect()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    fn entities(values: &[(&str, &str)]) -> Entities {
        let mut entities = Entities::default();
        for (tag, value) in values {
            entities.add(Entities::find(tag.as_bytes()).unwrap(), (*value).to_owned());
        }
        entities
    }

    #[test]
    fn chains_have_the_type_of_their_entity() {
        let known = entities(&[
            ("entity.id", "1"),
            ("entity.type", "polymer"),
            ("ENTITY.ID", "2"),
            ("Entity.Type", "water"),
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
        assert!(known.are_known());
        let chains = known.polymer_chains();
        assert_eq!(["A", "B", "C", "D"].map(|c| chains.get(c).copied()), [Some(true), Some(false), Some(true), None]);
        assert!(!entities(&[("entity.id", "1"), ("struct_asym.entity_id", "1")]).are_known());
        assert_eq!([&b"entity.details"[..], b"entity", b"entity_poly.id"].map(Entities::find), [None; 3]);
    }

    #[test]
    fn values_are_bounded_and_the_bound_is_reported() {
        let mut many = Entities::default();
        (0..MAX_VALUES).for_each(|_| many.add(3, String::new()));
        assert_eq!(many.warning(), None);
        many.add(3, String::new());
        assert!(many.warning().unwrap().starts_with("more than 262144 entities"));
        assert_eq!(many.values[3].len(), MAX_VALUES);
    }
}
