//! Colours of text: only on a terminal, and not if `NO_COLOR` is set.

use std::borrow::Cow;
use std::io::IsTerminal;

/// Style of text, with or without colours.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Style {
    coloured: bool,
}

impl Style {
    /// Style without colours.
    #[cfg(test)]
    pub(crate) const PLAIN: Self = Self { coloured: false };

    /// Returns the style of stderr.
    pub(crate) fn stderr() -> Self {
        Self { coloured: std::io::stderr().is_terminal() && wanted() }
    }

    /// Returns the style of stdout.
    pub(crate) fn stdout() -> Self {
        Self { coloured: std::io::stdout().is_terminal() && wanted() }
    }

    /// Formats a title.
    pub(crate) fn bold(self, text: &str) -> String {
        self.wrap("1", text)
    }

    /// Formats a side note.
    pub(crate) fn dim(self, text: &str) -> String {
        self.wrap("2", text)
    }

    /// Formats a failure.
    pub(crate) fn red(self, text: &str) -> String {
        self.wrap("1;31", text)
    }

    /// Formats a success.
    pub(crate) fn green(self, text: &str) -> String {
        self.wrap("32", text)
    }

    /// Formats a link or a bar.
    pub(crate) fn cyan(self, text: &str) -> String {
        self.wrap("36", text)
    }

    fn wrap(self, sgr: &str, text: &str) -> String {
        if self.coloured { format!("\x1b[{sgr}m{text}\x1b[0m") } else { text.to_owned() }
    }
}

/// Escapes the control characters of a text from outside, such as a file name, which a terminal would execute.
pub(crate) fn printable(text: &str) -> Cow<'_, str> {
    let is_control = |c: char| c.is_control() && c != '\n';
    if !text.contains(is_control) {
        return text.into();
    }
    text.chars().map(|c| if is_control(c) { c.escape_default().to_string() } else { c.to_string() }).collect()
}

/// Returns false if `NO_COLOR` is set and not empty, or if the terminal is dumb.
fn wanted() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty()) && std::env::var_os("TERM").is_none_or(|v| v != "dumb")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_coloured_text_has_escapes() {
        assert_eq!(Style::PLAIN.red("x"), "x");
        assert_eq!(Style { coloured: true }.red("x"), "\x1b[1;31mx\x1b[0m");
    }

    #[test]
    fn control_characters_are_escaped() {
        assert_eq!(printable("a\x1b]0;x\x07.pdb\u{9b}\nsecond line é"), "a\\u{1b}]0;x\\u{7}.pdb\\u{9b}\nsecond line é");
    }
}
