//! Columns of short texts (names of atoms, residues and chains) stored once each and referred to by number.
//!
//! Real files repeat a few hundred names millions of times. A small cache answers almost every look-up with one
//! comparison; what it does not know goes to a hash table with a random seed, so that no choice of names is slow.

use std::hash::{BuildHasher, RandomState};

use super::text;

/// Distinct texts, one behind the other, by number.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Texts {
    joined: String,
    ends: Vec<usize>,
}

impl Texts {
    fn len(&self) -> usize {
        self.ends.len()
    }

    fn get(&self, id: usize) -> &str {
        let start = if id == 0 { 0 } else { self.ends[id - 1] };
        &self.joined[start..self.ends[id]]
    }

    fn iter(&self) -> impl ExactSizeIterator<Item = &str> {
        (0..self.len()).map(|id| self.get(id))
    }
}

/// Texts of a column: `get(i)` is the text of row `i`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TextColumn {
    ids: Vec<u32>,
    texts: Texts,
}

impl TextColumn {
    /// The text of row `i`.
    #[must_use]
    pub fn get(&self, i: usize) -> &str {
        self.texts.get(self.ids[i] as usize)
    }

    /// The number of the text of row `i`: equal numbers are equal texts, counted in order of first appearance.
    #[must_use]
    pub fn id(&self, i: usize) -> u32 {
        self.ids[i]
    }

    /// The numbers of all rows.
    #[must_use]
    pub fn ids(&self) -> &[u32] {
        &self.ids
    }

    /// The distinct texts, by number.
    #[must_use]
    pub fn texts(&self) -> impl ExactSizeIterator<Item = &str> {
        self.texts.iter()
    }

    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there is no row.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }
}

const CACHE_BITS: u32 = 8;

/// The length of a text that a cache entry holds, 1 to 8.
fn short(len: usize) -> u32 {
    u32::try_from(len).unwrap_or(0)
}

/// Gives numbers to texts.
#[derive(Debug)]
pub(super) struct Interner {
    texts: Texts,
    seed: RandomState,
    /// Hash and number plus one of each text, open addressing; a power of two, at most half full.
    table: Vec<(u32, u32)>,
    /// Up to eight bytes of a text, their count, and the text's number; direct mapped, vacant where the count is 0.
    cache: Box<[(u64, u32, u32); 1 << CACHE_BITS]>,
}

impl Default for Interner {
    fn default() -> Self {
        let cache = Box::new([(0, 0, 0); 1 << CACHE_BITS]);
        Self { texts: Texts::default(), seed: RandomState::new(), table: vec![(0, 0); 64], cache }
    }
}

impl Interner {
    pub(super) fn is_empty(&self) -> bool {
        self.texts.len() == 0
    }

    pub(super) fn text(&self, id: u32) -> &str {
        self.texts.get(id as usize)
    }

    /// The distinct texts, by number.
    pub(super) fn texts(&self) -> impl ExactSizeIterator<Item = &str> {
        self.texts.iter()
    }

    /// The number of `text[start..end]`.
    #[inline]
    pub(super) fn intern(&mut self, text: &[u8], start: usize, end: usize) -> u32 {
        let len = end - start;
        let Some(&word) = text.get(start..).and_then(|t| t.first_chunk::<8>()) else {
            return self.intern_slow(&text[start..end]);
        };
        if len > 8 || len == 0 {
            return self.intern_slow(&text[start..end]);
        }
        // The first byte of the text is the lowest of the word; what follows the text is shifted out.
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

    /// The number of the text in fixed columns, without the blanks around it.
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

    /// The number of `text`, which is added if it is new.
    fn number(&mut self, text: &str) -> u32 {
        let hash = self.hash(text);
        let mut slot = self.slot(hash);
        loop {
            match self.table[slot] {
                (_, 0) => break,
                (known, id_plus_one) if known == hash && self.text(id_plus_one - 1) == text => return id_plus_one - 1,
                _ => slot = (slot + 1) % self.table.len(),
            }
        }
        // As many distinct texts as 32 bits count need as many rows, which the reader's limit refuses.
        let id = u32::try_from(self.texts.len()).unwrap_or(u32::MAX - 1);
        self.texts.joined.push_str(text);
        self.texts.ends.push(self.texts.joined.len());
        self.table[slot] = (hash, id + 1);
        if 2 * self.texts.len() > self.table.len() {
            self.grow();
        }
        id
    }

    fn grow(&mut self) {
        let old = std::mem::take(&mut self.table);
        self.table = vec![(0, 0); 4 * old.len()];
        for entry in old.into_iter().filter(|entry| entry.1 != 0) {
            let mut slot = self.slot(entry.0);
            while self.table[slot].1 != 0 {
                slot = (slot + 1) % self.table.len();
            }
            self.table[slot] = entry;
        }
    }

    fn hash(&self, text: &str) -> u32 {
        // The upper half of the hash; the table never needs more bits.
        u32::try_from(self.seed.hash_one(text) >> 32).unwrap_or(0)
    }

    fn slot(&self, hash: u32) -> usize {
        hash as usize % self.table.len()
    }

    /// Learns the texts of `other` and rewrites `ids` accordingly.
    pub(super) fn adopt(&mut self, other: &Self, ids: &mut [u32]) {
        let map: Vec<u32> = other.texts.iter().map(|text| self.number(text)).collect();
        if map.iter().enumerate().any(|(i, &id)| i != id as usize) {
            for id in ids {
                *id = map[*id as usize];
            }
        }
    }

    pub(super) fn column(self, ids: Vec<u32>) -> TextColumn {
        TextColumn { ids, texts: self.texts }
    }
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
        // At the end of the bytes, where no word can be loaded, too.
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
        a.adopt(&b, &mut ids);
        let column = a.column(ids);
        assert_eq!((0..3).map(|i| column.get(i)).collect::<Vec<_>>(), ["Y", "Z", "X"]);
        assert_eq!(column.texts().len(), 3);
    }
}
