//! Iterator over the lines of a PDB file, with any line ending.

use super::super::scan::run_length;

/// Non-empty lines as byte ranges, without line endings.
pub(super) struct Lines<'a> {
    text: &'a [u8],
    at: usize,
    carriage_returns: bool,
}

impl<'a> Lines<'a> {
    pub(super) fn new(text: &'a [u8]) -> Self {
        Self { text, at: 0, carriage_returns: memchr::memchr(b'\r', text).is_some() }
    }
}

impl Iterator for Lines<'_> {
    type Item = (usize, usize);

    #[inline]
    fn next(&mut self) -> Option<(usize, usize)> {
        let rest = self.text.get(self.at..).unwrap_or_default();
        let one_end = match rest {
            [b'\n', ..] => 1,
            [b'\r', b'\n', ..] => 2,
            _ => 0,
        };
        // Usually the next line begins directly after the line ending.
        let next = if rest.get(one_end).is_some_and(|&b| b > b' ') { one_end } else { empty_lines(rest) };
        let start = self.at + next;
        let rest = self.text.get(start..).filter(|rest| !rest.is_empty())?;
        let len = if self.carriage_returns { memchr::memchr2(b'\n', b'\r', rest) } else { memchr::memchr(b'\n', rest) };
        self.at = start + len.unwrap_or(rest.len());
        Some((start, self.at))
    }
}

/// Returns the length of the line endings and blank lines at the beginning of `text`.
fn empty_lines(text: &[u8]) -> usize {
    let blanks = &text[..run_length(text, false)];
    memchr::memrchr2(b'\n', b'\r', blanks).map_or(0, |i| i + 1)
}
