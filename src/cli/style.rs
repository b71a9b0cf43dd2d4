//! Colour: only on a terminal, never when `NO_COLOR` is set.

use std::io::IsTerminal;

/// Whether to colour.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Style {
    coloured: bool,
}

impl Style {
    /// Never any colour.
    #[cfg(test)]
    pub(crate) const PLAIN: Self = Self { coloured: false };

    /// For text on stderr.
    pub(crate) fn stderr() -> Self {
        Self { coloured: std::io::stderr().is_terminal() && wanted() }
    }

    /// For text on stdout.
    #[cfg(feature = "server")]
    pub(crate) fn stdout() -> Self {
        Self { coloured: std::io::stdout().is_terminal() && wanted() }
    }

    /// Titles.
    pub(crate) fn bold(self, text: &str) -> String {
        self.wrap("1", text)
    }

    /// Side notes.
    pub(crate) fn dim(self, text: &str) -> String {
        self.wrap("2", text)
    }

    /// Failures.
    pub(crate) fn red(self, text: &str) -> String {
        self.wrap("1;31", text)
    }

    /// Successes.
    pub(crate) fn green(self, text: &str) -> String {
        self.wrap("32", text)
    }

    /// Links and bars.
    pub(crate) fn cyan(self, text: &str) -> String {
        self.wrap("36", text)
    }

    fn wrap(self, sgr: &str, text: &str) -> String {
        if self.coloured { format!("\x1b[{sgr}m{text}\x1b[0m") } else { text.to_owned() }
    }
}

/// `NO_COLOR` counts when it is set and not empty; a dumb terminal has no colour either.
fn wanted() -> bool {
    std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty()) && std::env::var_os("TERM").is_none_or(|v| v != "dumb")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colour_wraps_and_plain_does_not() {
        assert_eq!(Style::PLAIN.red("x"), "x");
        assert_eq!(Style { coloured: true }.red("x"), "\x1b[1;31mx\x1b[0m");
    }
}
