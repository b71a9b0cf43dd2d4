//! Tokenizer for the CIF 1.1 grammar. Source: S. R. Hall, J. D. Westbrook et al., *Specification of the
//! Crystallographic Information File*, International Tables for Crystallography G, chapter 2.2.
//!
//! Two relaxations, neither of which is ambiguous: every byte up to the space character counts as white space, and `[`,
//! `]` and `$` may begin a plain value.

use super::scan::run_length;
use super::text::Fault;

/// Kind of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TokenKind {
    /// `data_NAME`.
    Data,
    /// `save_NAME` begins a frame, `save_` ends it.
    Save,
    /// `loop_`.
    Loop,
    /// `stop_` or `global_`: reserved words that the reader does not use.
    Reserved,
    /// `_category.item`.
    Tag,
    /// A value, with its quotes.
    Value,
    /// The end of the text.
    End,
}

/// A token and its byte range.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Token {
    pub(super) kind: TokenKind,
    pub(super) start: usize,
    pub(super) end: usize,
}

impl Token {
    /// Returns the fault of a token other than the `expected` one.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn fault(&self, text: &[u8], expected: impl Into<String>) -> Box<Fault> {
        match self.kind {
            TokenKind::End => Fault::words(self.start, "the end of the file", expected),
            _ => Fault::token(text, self.start, self.end, expected),
        }
    }
}

/// Splits a text into tokens.
#[derive(Debug, Clone)]
pub(super) struct Tokenizer<'a> {
    pub(super) text: &'a [u8],
    pub(super) at: usize,
}

impl<'a> Tokenizer<'a> {
    pub(super) fn new(text: &'a [u8]) -> Self {
        Self { text, at: 0 }
    }

    /// Returns the next token. At the end, every call returns [`TokenKind::End`].
    pub(super) fn next(&mut self) -> Result<Token, Box<Fault>> {
        self.skip_blanks();
        let text = self.text;
        let start = self.at;
        let Some(&first) = text.get(start) else {
            return Ok(Token { kind: TokenKind::End, start, end: start });
        };
        match first {
            b'\'' | b'"' => self.quoted(first),
            b';' if at_line_start(text, start) => self.text_field(),
            _ => {
                self.at = start + token_length(&text[start..]);
                Ok(Token { kind: bare_kind(&text[start..self.at]), start, end: self.at })
            }
        }
    }

    /// Skips white space and comments.
    fn skip_blanks(&mut self) {
        let mut comment = false;
        let blanks = self.text[self.at..].iter().position(|&b| {
            // Both are short in real files, so a vectorized search would not be faster.
            comment = if comment { b != b'\n' && b != b'\r' } else { b == b'#' };
            !comment && b > b' '
        });
        self.at = blanks.map_or(self.text.len(), |n| self.at + n);
    }

    /// Reads a quoted value. It ends at the first quote on the same line that white space follows.
    fn quoted(&mut self, quote: u8) -> Result<Token, Box<Fault>> {
        let start = self.at;
        let mut before = 0;
        let blank = self.text[start + 1..].iter().position(|&b| {
            let ends = matches!(b, b'\n' | b'\r') || (before == quote && b <= b' ');
            before = b;
            ends
        });
        let end = blank.map_or(self.text.len(), |n| start + 1 + n);
        // The opening quote is not a closing one, even if a space follows it directly.
        if end > start + 1 && self.text[end - 1] == quote {
            self.at = end;
            return Ok(Token { kind: TokenKind::Value, start, end });
        }
        Err(Fault::token(self.text, start, end, format!("a closing {} on the same line", char::from(quote))))
    }

    /// Reads a text field, which reaches from a semicolon at the start of a line to the next such semicolon.
    fn text_field(&mut self) -> Result<Token, Box<Fault>> {
        let start = self.at;
        match line_beginning_with_semicolon(self.text, start + 1) {
            Some(i) => {
                self.at = i + 1;
                Ok(Token { kind: TokenKind::Value, start, end: self.at })
            }
            None => Err(Fault::words(start, "a text field without end", "a line that begins with ;")),
        }
    }
}

/// Returns the length of the token. A plain loop, because most tokens are too short for a vectorized search.
fn token_length(text: &[u8]) -> usize {
    let short = text.iter().take(32).position(|&b| b <= b' ');
    short.unwrap_or_else(|| run_length(text, true))
}

/// Returns the first semicolon at or after `at` that begins a line.
fn line_beginning_with_semicolon(text: &[u8], mut at: usize) -> Option<usize> {
    loop {
        at += memchr::memchr(b';', &text[at..])?;
        if at_line_start(text, at) {
            return Some(at);
        }
        // No other semicolon on this line can begin a line.
        at += memchr::memchr2(b'\n', b'\r', &text[at..])?;
    }
}

fn at_line_start(text: &[u8], at: usize) -> bool {
    at == 0 || matches!(text[at - 1], b'\n' | b'\r')
}

/// Returns the kind of an unquoted token.
pub(super) fn bare_kind(token: &[u8]) -> TokenKind {
    if token[0] == b'_' {
        return TokenKind::Tag;
    }
    if token.get(4) != Some(&b'_') && token.get(6) != Some(&b'_') {
        return TokenKind::Value;
    }
    let starts = |word: &[u8]| token.get(..word.len()).is_some_and(|t| t.eq_ignore_ascii_case(word));
    if starts(b"data_") {
        TokenKind::Data
    } else if starts(b"save_") {
        TokenKind::Save
    } else if token.eq_ignore_ascii_case(b"loop_") {
        TokenKind::Loop
    } else if token.eq_ignore_ascii_case(b"stop_") || token.eq_ignore_ascii_case(b"global_") {
        TokenKind::Reserved
    } else {
        TokenKind::Value
    }
}

/// Returns the range of a value without quotes or text field semicolons, and true if it had any.
#[inline]
pub(super) fn unquote(text: &[u8], start: usize, end: usize) -> (usize, usize, bool) {
    match text[start] {
        b'\'' | b'"' | b';' => unquote_slow(text, start, end),
        _ => (start, end, false),
    }
}

#[cold]
fn unquote_slow(text: &[u8], start: usize, end: usize) -> (usize, usize, bool) {
    let first = text[start];
    if first != b';' {
        return (start + 1, end - 1, true);
    }
    // A semicolon that does not begin a line is an ordinary character.
    if !at_line_start(text, start) || end < start + 3 {
        return (start, end, false);
    }
    // The line end before the closing semicolon is not part of the text.
    let body = end - 1;
    let line_end = if text[body - 2..body] == *b"\r\n" { 2 } else { 1 };
    (start + 1, (body - line_end).max(start + 1), true)
}

#[cfg(test)]
#[allow(clippy::pedantic, clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    fn tokens(text: &str) -> Vec<(TokenKind, String)> {
        let mut tokenizer = Tokenizer::new(text.as_bytes());
        let mut out = Vec::new();
        loop {
            let token = tokenizer.next().unwrap();
            if token.kind == TokenKind::End {
                return out;
            }
            let (start, end, _) = unquote(text.as_bytes(), token.start, token.end);
            out.push((token.kind, text[start..end].to_owned()));
        }
    }

    fn values(text: &str) -> Vec<String> {
        tokens(text).into_iter().filter(|t| t.0 == TokenKind::Value).map(|t| t.1).collect()
    }

    #[test]
    fn words_tags_and_values() {
        let kinds: Vec<TokenKind> =
            tokens("data_X\nLOOP_ _a.b save_f _c 1 save_ stop_ global_ datax loop_x").iter().map(|t| t.0).collect();
        use TokenKind::*;
        assert_eq!(kinds, [Data, Loop, Tag, Save, Tag, Value, Save, Reserved, Reserved, Value, Value]);
    }

    #[test]
    fn quotes_and_text_fields() {
        assert_eq!(
            values(r#"'a dog's life' "O5'" '' "a"b" ' # not a comment '"#),
            ["a dog's life", "O5'", "", "a\"b", " # not a comment "]
        );
        assert_eq!(values("a#b # a comment ' \n c"), ["a#b", "c"]);
        assert_eq!(values("\n;one\n two;\n;\n ;x y"), ["one\n two;", ";x", "y"]);
        assert_eq!(values("\r\n;one\r\ntwo\r\n; z"), ["one\r\ntwo", "z"]);
        assert_eq!(values("\n;\n; z"), ["", "z"]);
    }

    #[test]
    fn what_does_not_end_is_an_error_at_its_start() {
        for (text, at) in [("a 'b c\nd'", 2), ("\"abc", 0), ("x\n;abc\n d;", 2), ("'", 0), ("\n;", 1)] {
            let mut tokenizer = Tokenizer::new(text.as_bytes());
            let fault = loop {
                match tokenizer.next() {
                    Ok(token) => assert_ne!(token.kind, TokenKind::End, "{text:?}"),
                    Err(fault) => break fault,
                }
            };
            assert_eq!(fault.at, at, "{text:?}");
        }
    }

    proptest::proptest! {
        #[test]
        fn any_text_ends(text in "[a_;'\"# \n\r]{0,60}") {
            let mut tokenizer = Tokenizer::new(text.as_bytes());
            for _ in 0..=text.len() {
                match tokenizer.next() {
                    Ok(t) if t.kind != TokenKind::End => { unquote(text.as_bytes(), t.start, t.end); }
                    _ => return Ok(()),
                }
            }
            proptest::prop_assert!(false, "more tokens than bytes");
        }
    }
}
