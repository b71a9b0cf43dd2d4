//! Text rows of `atom_site`.

use super::super::atom_layout::{Layout, NONE};
use super::super::atom_site::{self, Span};
use super::super::cif::unquote;
use super::super::text::Fault;

/// Prefix of the tags of the category.
const PREFIX: &[u8] = b"_atom_site.";

/// Returns the column indices of the items among the tags of a loop, given as ranges of `text`.
pub(super) fn layout(text: &[u8], tags: &[(usize, usize)]) -> Result<Layout, Box<Fault>> {
    let item = |&(start, end): &(usize, usize)| {
        let tag = &text[start..end];
        if has_prefix(tag) { &tag[PREFIX.len()..] } else { tag }
    };
    Layout::of(tags.iter().map(item)).map_err(|twice| {
        let (start, end) = tags[twice];
        Fault::token(text, start, end, "every tag once in its category")
    })
}

/// Returns true if the tag belongs to the category.
pub(super) fn has_prefix(tag: &[u8]) -> bool {
    tag.get(..PREFIX.len()).is_some_and(|prefix| prefix.eq_ignore_ascii_case(PREFIX))
}

/// A row as byte ranges of its values. `QUOTES` is false for rows without quotes, which need no unquoting.
#[derive(Debug, Clone, Copy)]
pub(super) struct TextRow<'a, const QUOTES: bool> {
    pub(super) text: &'a [u8],
    /// Origin of the offsets.
    pub(super) base: usize,
    /// Start and end of each value, including quotes.
    pub(super) offsets: &'a [u32],
}

impl<const QUOTES: bool> TextRow<'_, QUOTES> {
    /// Returns start and end of a value, including quotes.
    #[inline]
    fn raw(&self, column: usize) -> (usize, usize) {
        (self.base + self.offsets[2 * column] as usize, self.base + self.offsets[2 * column + 1] as usize)
    }
}

impl<const QUOTES: bool> atom_site::AtomRow for TextRow<'_, QUOTES> {
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
