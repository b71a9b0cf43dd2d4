//! Text rows of `atom_site`.

use std::collections::HashMap;

use super::super::atom_site::{self, Layout, NONE, Span};
use super::super::cif::unquote;
use super::super::text::Fault;

/// Prefix of the tags of the category.
pub(super) const PREFIX: &[u8] = b"_atom_site.";

/// Returns the column indices of the items among the tags of a loop, given as ranges of `text`.
pub(super) fn layout(text: &[u8], tags: &[(usize, usize)]) -> Result<Layout, Box<Fault>> {
    let mut found: HashMap<Vec<u8>, usize> = HashMap::with_capacity(tags.len());
    for (i, &(start, end)) in tags.iter().enumerate() {
        let tag = text[start..end].to_ascii_lowercase();
        if found.insert(tag, i).is_some() {
            return Err(Fault::token(text, start, end, "every tag once in its category"));
        }
    }
    Ok(Layout::new(tags.len(), |item| {
        let tag = [PREFIX, item.to_ascii_lowercase().as_bytes()].concat();
        found.get(&tag).copied()
    }))
}

/// A row as byte ranges of its values. `QUOTES` is false for rows without quotes, which need no unquoting.
#[derive(Debug, Clone, Copy)]
pub(super) struct Row<'a, const QUOTES: bool> {
    pub(super) text: &'a [u8],
    /// Origin of the offsets.
    pub(super) base: usize,
    /// Start and end of each value, including quotes.
    pub(super) offsets: &'a [u32],
}

impl<const QUOTES: bool> Row<'_, QUOTES> {
    /// Returns start and end of a value, including quotes.
    #[inline]
    fn raw(&self, column: usize) -> (usize, usize) {
        (self.base + self.offsets[2 * column] as usize, self.base + self.offsets[2 * column + 1] as usize)
    }
}

impl<const QUOTES: bool> atom_site::Row for Row<'_, QUOTES> {
    type Fault = Box<Fault>;

    /// Returns a value without quotes. `?` and `.` mean that there is no value.
    #[inline]
    fn text(&self, column: usize) -> Option<Span<'_>> {
        if column == NONE {
            return None;
        }
        let (start, end) = self.raw(column);
        let (start, end, quoted) = if QUOTES { unquote(self.text, start, end) } else { (start, end, false) };
        let null = !quoted && end - start == 1 && matches!(self.text[start], b'?' | b'.');
        (!null).then_some(Span { text: self.text, start, end })
    }

    #[cold]
    fn fault(&self, column: usize, expected: String) -> Box<Fault> {
        let (start, end) = self.raw(column);
        Fault::token(self.text, start, end, expected)
    }
}
