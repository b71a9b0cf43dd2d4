//! Line and column of a byte offset, excerpts of texts for messages, and decoding of texts.

use std::borrow::Cow;

use super::error::StructureError;

/// A syntax error at a byte offset.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fault {
    /// Byte offset.
    pub(super) at: usize,
    /// The text found there.
    pub(super) found: String,
    /// The expected content.
    pub(super) expected: String,
}

impl Fault {
    /// Creates a fault whose `found` is an excerpt of `text[start..end]`.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn token(text: &[u8], start: usize, end: usize, expected: impl Into<String>) -> Box<Self> {
        Box::new(Self { at: start, found: quote(&text[start..end]), expected: expected.into() })
    }

    /// Creates a fault with a description of what was found.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn words(at: usize, found: impl Into<String>, expected: impl Into<String>) -> Box<Self> {
        Box::new(Self { at, found: found.into(), expected: expected.into() })
    }

    /// Moves the fault to a text in which this one begins at `offset`.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn shifted(mut self: Box<Self>, offset: usize) -> Box<Self> {
        self.at += offset;
        self
    }

    /// Converts the fault to an error with line and column.
    pub(super) fn locate(self, text: &[u8]) -> StructureError {
        let (line, column) = line_and_column(text, self.at);
        StructureError::Syntax { line, column, found: self.found, expected: self.expected }
    }
}

/// Returns line and column of a byte, both from 1. Lines end with LF, CR LF or a lone CR. Columns count bytes.
pub(super) fn line_and_column(text: &[u8], at: usize) -> (u64, u64) {
    let before = &text[..at.min(text.len())];
    let lf = memchr::memchr_iter(b'\n', before).count();
    let cr = memchr::memchr_iter(b'\r', before).count();
    // The line feed of the last CR LF pair may be at `at` itself.
    let pairs = if lf == 0 || cr == 0 {
        usize::from(before.last() == Some(&b'\r') && text.get(at) == Some(&b'\n'))
    } else {
        before.iter().zip(&text[1..]).filter(|&(&a, &b)| a == b'\r' && b == b'\n').count()
    };
    let lone_cr = cr - pairs;
    let start = memchr::memrchr2(b'\n', b'\r', before).map_or(0, |i| i + 1);
    ((lf + lone_cr) as u64 + 1, (before.len() - start) as u64 + 1)
}

/// Decodes bytes as UTF-8 if valid, as Latin-1 otherwise. Replaces control characters with U+FFFD, so that the text is
/// safe to print.
pub(super) fn decode(raw: &[u8]) -> Cow<'_, str> {
    // Almost all texts have no control characters.
    let text = match std::str::from_utf8(raw) {
        Ok(text) if raw.iter().all(|b| (b' '..=b'~').contains(b)) => return Cow::Borrowed(text),
        Ok(text) => Cow::Borrowed(text),
        Err(_) => Cow::Owned(raw.iter().copied().map(char::from).collect()),
    };
    if text.chars().any(char::is_control) {
        Cow::Owned(text.chars().map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect())
    } else {
        text
    }
}

/// Returns a quoted excerpt for a message.
pub(super) fn quote(raw: &[u8]) -> String {
    const SHOWN: usize = 40;
    if raw.is_empty() {
        return "nothing".to_owned();
    }
    if raw.iter().all(|&b| b == b' ') {
        return "blanks".to_owned();
    }
    let text = decode(&raw[..raw.len().min(SHOWN)]);
    if raw.len() > SHOWN { format!("`{text}…` ({} bytes)", raw.len()) } else { format!("`{text}`") }
}

/// Normalizes a title or id: collapses white space and keeps at most `max` characters. Returns `None` if nothing is
/// left.
pub(super) fn normalize(raw: &[u8], max: usize) -> Option<String> {
    // Bounds the copy: a hostile title may have 50 MB.
    let raw = &raw[..raw.len().min(8 * max)];
    let spaced: Vec<u8> = raw.iter().map(|&b| if b <= b' ' { b' ' } else { b }).collect();
    let text = decode(&spaced);
    let joined = text.split(' ').filter(|word| !word.is_empty()).collect::<Vec<_>>().join(" ");
    let short: String = joined.chars().take(max).collect();
    (!short.is_empty()).then_some(short)
}

/// Returns the range of `raw` without leading and trailing blanks and control characters.
pub(super) fn trimmed(raw: &[u8]) -> (usize, usize) {
    let Some(start) = raw.iter().position(|&b| b > b' ') else { return (0, 0) };
    let end = raw.iter().rposition(|&b| b > b' ').map_or(start, |i| i + 1);
    (start, end)
}

/// Joins `items` with commas: at most twenty of `total`, 48 characters of each and about 400 in all, since a file
/// determines their number and length.
pub(super) fn list<I: IntoIterator<Item = String>>(items: I, total: usize) -> String {
    const MAX_ITEMS: usize = 20;
    const MAX_ITEM_CHARS: usize = 48;
    const MAX_CHARS: usize = 400;
    let mut chars = 0;
    let shorten = |mut item: String| {
        if let Some((end, _)) = item.char_indices().nth(MAX_ITEM_CHARS) {
            item.truncate(end);
            item.push('…');
        }
        let fits = chars < MAX_CHARS;
        chars += item.chars().count();
        fits.then_some(item)
    };
    let shown: Vec<String> = items.into_iter().take(MAX_ITEMS).map_while(shorten).collect();
    let more = total.saturating_sub(shown.len());
    let joined = shown.join(", ");
    if more > 0 { format!("{joined} and {more} more") } else { joined }
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    #[test]
    fn lines_end_in_three_ways() {
        let text = b"ab\ncd\r\nef\rgh";
        let positions: Vec<_> = [0, 1, 3, 5, 7, 10, 11].iter().map(|&at| line_and_column(text, at)).collect();
        assert_eq!(positions, [(1, 1), (1, 2), (2, 1), (2, 3), (3, 1), (4, 1), (4, 2)]);
    }

    #[test]
    fn lists_are_short_for_any_items() {
        let (longest, longer) = ("x".repeat(48), "x".repeat(49));
        assert_eq!(list(["A".to_owned(), longest.clone()], 3), format!("A, {longest} and 1 more"));
        assert_eq!(list([longer], 1), format!("{longest}…"));
        assert_eq!(list(vec!["A".to_owned(); 21], 21), format!("{}A and 1 more", "A, ".repeat(19)));
        assert!(list(vec!["\u{1f9ec}".repeat(9999); 99], 99).len() < 2000);
    }

    #[test]
    fn latin_1_and_control_characters_are_safe_to_print() {
        assert_eq!(decode(b"caf\xe9"), "café");
        assert_eq!(decode("café".as_bytes()), "café");
        assert_eq!(decode(b"a\x1b[2J"), "a\u{fffd}[2J");
        assert_eq!(quote(b"    "), "blanks");
        assert_eq!(normalize(b"  a \n b\t", 10), Some("a b".to_owned()));
        assert_eq!(normalize(b" \n ", 10), None);
    }
}
