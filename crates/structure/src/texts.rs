//! Interned strings: columns of names of atoms, residues and chains, which store each distinct text once.
//!
//! Real files repeat a few hundred names millions of times. A small cache finds almost every text with one comparison.
//! Other texts are looked up in a hash table, whose random seed resists hostile choices of names.

use std::hash::RandomState;

use indexmap::IndexSet;

use super::text;

/// Column of texts: `get(i)` returns the text of row `i`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TextColumn {
    ids: Vec<u32>,
    texts: Vec<Box<str>>,
}

impl TextColumn {
    /// Returns the text of row `i`.
    #[must_use]
    pub fn get(&self, i: usize) -> &str {
        &self.texts[self.ids[i] as usize]
    }

    /// Returns the id of the text of row `i`. Equal ids are equal texts. Ids count from 0 in order of first appearance.
    #[must_use]
    pub fn id(&self, i: usize) -> u32 {
        self.ids[i]
    }

    /// Returns the ids of all rows.
    #[must_use]
    pub fn ids(&self) -> &[u32] {
        &self.ids
    }

    /// Returns the distinct texts by id.
    #[must_use]
    pub fn texts(&self) -> impl ExactSizeIterator<Item = &str> {
        self.texts.iter().map(AsRef::as_ref)
    }

    /// Returns the number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Returns true if there is no row.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }
}

/// Replaces each id `i` by `map[i]`.
pub(super) fn translate(ids: &mut [u32], map: &[u32]) {
    if map.iter().zip(0..).any(|(&id, i)| i != id) {
        for id in ids {
            *id = map[*id as usize];
        }
    }
}

const CACHE_BITS: u32 = 8;

/// Converts the length of a cacheable text, 1 to 8.
fn short(len: usize) -> u32 {
    u32::try_from(len).unwrap_or(0)
}

/// Returns the memory of a distinct text, bytes: its entry, its hash and its allocation.
fn text_bytes(text: &str) -> u64 {
    96 + text.len() as u64
}

/// Assigns ids to texts.
#[derive(Debug)]
pub(super) struct Interner {
    texts: IndexSet<Box<str>, RandomState>,
    /// Memory of the texts, bytes.
    bytes: u64,
    /// Up to eight bytes of a text, their count, and its id. Direct mapped; an entry with count 0 is vacant.
    cache: Box<[(u64, u32, u32); 1 << CACHE_BITS]>,
}

impl Default for Interner {
    fn default() -> Self {
        Self { texts: IndexSet::default(), bytes: 0, cache: Box::new([(0, 0, 0); 1 << CACHE_BITS]) }
    }
}

impl Interner {
    pub(super) fn is_empty(&self) -> bool {
        self.texts.is_empty()
    }

    pub(super) fn text(&self, id: u32) -> &str {
        &self.texts[id as usize]
    }

    /// Returns the distinct texts by id.
    pub(super) fn texts(&self) -> impl ExactSizeIterator<Item = &str> {
        self.texts.iter().map(AsRef::as_ref)
    }

    /// Returns the id of `text[start..end]`.
    #[inline]
    pub(super) fn intern(&mut self, text: &[u8], start: usize, end: usize) -> u32 {
        let len = end - start;
        let Some(&word) = text.get(start..).and_then(|t| t.first_chunk::<8>()) else {
            return self.intern_slow(&text[start..end]);
        };
        if len > 8 || len == 0 {
            return self.intern_slow(&text[start..end]);
        }
        // The first byte of the text is the lowest byte of the word. The shift removes bytes after the text.
        let key = u64::from_le_bytes(word) << (64 - 8 * len);
        let slot = (key.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> (64 - CACHE_BITS)) as usize;
        let (cached, cached_len, id) = self.cache[slot];
        if cached == key && cached_len == short(len) {
            return id;
        }
        let id = self.intern_slow(&text[start..end]);
        self.cache[slot] = (key, short(len), id);
        id
    }

    /// Returns the id of the text in fixed columns, without surrounding blanks.
    #[inline]
    pub(super) fn intern_field(&mut self, card: &[u8; 80], from: usize, to: usize) -> u32 {
        let (mut start, mut end) = (from, to);
        while start < end && card[start] <= b' ' {
            start += 1;
        }
        while end > start && card[end - 1] <= b' ' {
            end -= 1;
        }
        self.intern(card, start, end)
    }

    #[cold]
    fn intern_slow(&mut self, raw: &[u8]) -> u32 {
        self.number(&text::decode(raw))
    }

    /// Returns the id of `text`, and adds it if it is new.
    pub(super) fn number(&mut self, text: &str) -> u32 {
        let id = self.texts.get_index_of(text).unwrap_or_else(|| {
            self.bytes += text_bytes(text);
            self.texts.insert_full(text.into()).0
        });
        // The atom limit of the reader keeps the number of distinct texts below 2³².
        u32::try_from(id).unwrap_or(u32::MAX)
    }

    /// Adds the texts of `other`, and returns the new ids of its texts by their ids.
    pub(super) fn adopt(&mut self, other: &Self) -> Vec<u32> {
        other.texts().map(|text| self.number(text)).collect()
    }

    /// Returns a column whose texts are parts of those of the table, so that several ids may have equal texts.
    pub(super) fn column_of(self, ids: Vec<u32>, part: impl Fn(&str) -> &str) -> TextColumn {
        TextColumn { ids, texts: self.texts().map(|text| part(text).into()).collect() }
    }

    pub(super) fn column(self, ids: Vec<u32>) -> TextColumn {
        TextColumn { ids, texts: self.texts.into_iter().collect() }
    }
}

/// String tables that atoms refer to while a file is read.
#[derive(Debug, Default)]
pub(super) struct Tables {
    pub(super) name: Interner,
    pub(super) residue: Interner,
    pub(super) chain: Interner,
    pub(super) label_chain: Interner,
    /// Entity of each text of `label_chain`; empty if it is unknown. No entries if the atoms do not state entities.
    entities: Vec<Box<str>>,
    /// Memory of the entities, bytes.
    entity_bytes: u64,
}

impl Tables {
    /// Returns the memory of all tables, bytes.
    pub(super) fn bytes(&self) -> u64 {
        let tables = [&self.name, &self.residue, &self.chain, &self.label_chain];
        tables.map(|table| table.bytes).iter().sum::<u64>() + self.entity_bytes
    }

    /// Returns the entity of a text of `label_chain`, empty if it is unknown; `None` if the atoms do not state
    /// entities.
    pub(super) fn entity(&self, label_chain: usize) -> Option<&str> {
        self.entities.get(label_chain).map(AsRef::as_ref)
    }

    fn add_entity(&mut self, entity: &str) {
        self.entity_bytes += text_bytes(entity);
        self.entities.push(entity.into());
    }

    /// Adds the texts of `other`. Returns, for each table, the new ids by the ids in `other`.
    pub(super) fn adopt(&mut self, other: &Self) -> [Vec<u32>; 4] {
        let label_chains = if other.entities.is_empty() {
            self.label_chain.adopt(&other.label_chain)
        } else {
            let pairs = other.label_chain.texts().zip(other.entities.iter().map(AsRef::as_ref));
            let adopt = |(text, entity): (&str, &str)| {
                let chain = without_entity(text).as_bytes();
                self.chain_of_entity((chain, 0, chain.len()), entity.as_bytes())
            };
            pairs.map(adopt).collect()
        };
        [self.name.adopt(&other.name), self.residue.adopt(&other.residue), self.chain.adopt(&other.chain), label_chains]
    }

    /// Returns the id of a chain (`label_asym_id`), a range of a text, of which an atom states the entity. Atoms of one
    /// chain that state different entities have different ids.
    #[inline]
    pub(super) fn chain_of_entity(&mut self, (text, start, end): (&[u8], usize, usize), entity: &[u8]) -> u32 {
        let id = self.label_chain.intern(text, start, end);
        match self.entities.get(id as usize) {
            Some(known) if known.as_bytes() == entity => id,
            Some(_) => self.chain_of_other_entity(id, entity),
            None => {
                self.add_entity(&text::decode(entity));
                id
            }
        }
    }

    #[cold]
    fn chain_of_other_entity(&mut self, chain: u32, entity: &[u8]) -> u32 {
        let entity = text::decode(entity);
        if *self.entities[chain as usize] == *entity {
            return chain;
        }
        let id = self.label_chain.number(&format!("{}{ENTITY_MARK}{entity}", self.label_chain.text(chain)));
        if id as usize == self.entities.len() {
            self.add_entity(&entity);
        }
        id
    }
}

/// Separates the name of a chain from an entity that differs from that of its first atom. No decoded text contains it.
const ENTITY_MARK: char = '\u{1f}';

/// Returns the name of a chain, without an entity.
pub(super) fn without_entity(text: &str) -> &str {
    text.split(ENTITY_MARK).next().unwrap_or_default()
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    fn id(interner: &mut Interner, text: &str) -> u32 {
        let padded = [text.as_bytes(), b"        "].concat();
        interner.intern(&padded, 0, text.len())
    }

    #[test]
    fn equal_texts_have_equal_numbers() {
        let mut interner = Interner::default();
        let texts = ["A", "", "AA", "CA", "A", "a longer text than a word", "AA", "", "a longer text than a word"];
        let ids: Vec<u32> = texts.iter().map(|t| id(&mut interner, t)).collect();
        assert_eq!(ids, [0, 1, 2, 3, 0, 4, 2, 1, 4]);
        // At the end of the input, where a whole word cannot be loaded.
        assert_eq!(interner.intern(b"xCA", 1, 3), 3);
        assert_eq!(interner.text(3), "CA");
    }

    #[test]
    fn many_texts_keep_their_numbers() {
        let mut interner = Interner::default();
        let text = |i: u32| format!("{i}{}", "x".repeat(i as usize % 12));
        for turn in 0..2 {
            for i in 0..20_000 {
                assert_eq!(id(&mut interner, &text(i)), i, "turn {turn}");
            }
        }
        assert_eq!(interner.text(19_999), text(19_999));
    }

    #[test]
    fn two_tables_become_one() {
        let (mut a, mut b) = (Interner::default(), Interner::default());
        for t in ["X", "Y"] {
            id(&mut a, t);
        }
        let mut ids: Vec<u32> = ["Y", "Z", "X"].iter().map(|t| id(&mut b, t)).collect();
        translate(&mut ids, &a.adopt(&b));
        let column = a.column(ids);
        assert_eq!((0..3).map(|i| column.get(i)).collect::<Vec<_>>(), ["Y", "Z", "X"]);
        assert_eq!(column.texts().len(), 3);
    }
}
