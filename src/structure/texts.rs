//! Columns of short texts (names of atoms, residues and chains) stored once each and referred to by number.
//!
//! Real files repeat a few hundred names millions of times. A small cache answers almost every look-up with one
//! comparison; what it does not know goes to a hash map with a random seed, so that no choice of names is slow.

use std::collections::HashMap;

use super::text;

/// Texts of a column: `get(i)` is the text of row `i`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TextColumn {
    ids: Vec<u32>,
    texts: Vec<Box<str>>,
}

impl TextColumn {
    /// The text of row `i`.
    #[must_use]
    pub fn get(&self, i: usize) -> &str {
        &self.texts[self.ids[i] as usize]
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
    pub fn texts(&self) -> &[Box<str>] {
        &self.texts
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

/// Gives numbers to texts.
#[derive(Debug)]
pub(super) struct Interner {
    texts: Vec<Box<str>>,
    by_text: HashMap<Box<str>, u32>,
    /// Up to eight bytes of a text, their count, and the text's number; direct mapped, vacant where the count is 0.
    cache: Box<[(u64, u32, u32); 1 << CACHE_BITS]>,
    /// The number of the empty text: columns that are missing or blank are as common as any name.
    empty: Option<u32>,
}

impl Default for Interner {
    fn default() -> Self {
        Self { texts: Vec::new(), by_text: HashMap::new(), cache: Box::new([(0, 0, 0); 1 << CACHE_BITS]), empty: None }
    }
}

impl Interner {
    pub(super) fn is_empty(&self) -> bool {
        self.texts.is_empty()
    }

    pub(super) fn text(&self, id: u32) -> &str {
        &self.texts[id as usize]
    }

    /// The number of `text[start..end]`.
    #[inline]
    pub(super) fn intern(&mut self, text: &[u8], start: usize, end: usize) -> u32 {
        let len = end - start;
        if let (0, Some(id)) = (len, self.empty) {
            return id;
        }
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
        if cached == key && cached_len == len as u32 {
            return id;
        }
        let id = self.intern_slow(&text[start..end]);
        self.cache[slot] = (key, len as u32, id);
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
        let text = text::decode(raw);
        if let Some(&id) = self.by_text.get(&*text) {
            return id;
        }
        self.add(text.into_owned().into_boxed_str())
    }

    fn intern_text(&mut self, text: Box<str>) -> u32 {
        if let Some(&id) = self.by_text.get(&text) {
            return id;
        }
        self.add(text)
    }

    /// The number of a text that is new.
    fn add(&mut self, text: Box<str>) -> u32 {
        // More than 2³² distinct texts need more than 2³² rows, which the reader's limit refuses.
        let id = u32::try_from(self.texts.len()).unwrap_or(u32::MAX);
        if text.is_empty() {
            self.empty = Some(id);
        }
        self.texts.push(text.clone());
        self.by_text.insert(text, id);
        id
    }

    /// Learns the texts of `other` and rewrites `ids` accordingly.
    pub(super) fn adopt(&mut self, other: Self, ids: &mut [u32]) {
        let map: Vec<u32> = other.texts.into_iter().map(|text| self.intern_text(text)).collect();
        if map.iter().enumerate().any(|(i, &id)| i != id as usize) {
            ids.iter_mut().for_each(|id| *id = map[*id as usize]);
        }
    }

    pub(super) fn column(self, ids: Vec<u32>) -> TextColumn {
        TextColumn { ids, texts: self.texts }
    }
}

#[cfg(test)]
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
    fn two_tables_become_one() {
        let (mut a, mut b) = (Interner::default(), Interner::default());
        for t in ["X", "Y"] {
            id(&mut a, t);
        }
        let mut ids: Vec<u32> = ["Y", "Z", "X"].iter().map(|t| id(&mut b, t)).collect();
        a.adopt(b, &mut ids);
        let column = a.column(ids);
        assert_eq!((0..3).map(|i| column.get(i)).collect::<Vec<_>>(), ["Y", "Z", "X"]);
        assert_eq!(column.texts().len(), 3);
    }
}
