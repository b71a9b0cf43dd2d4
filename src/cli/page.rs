//! Labelled lines on a terminal: layout of the summary, the banner and `doctor`.

use super::style::{Style, printable};

/// Width of the labels.
const LABEL: usize = 10;

/// Builder of labelled lines.
pub(crate) struct Page {
    /// Colours of the page.
    pub(crate) style: Style,
    lines: Vec<String>,
}

impl Page {
    /// Creates a page with a title.
    pub(crate) fn new(style: Style, title: &str, rest: &str) -> Self {
        Self {
            style,
            lines: vec![format!("{} {}", style.bold(&printable(title)), printable(rest)).trim_end().to_owned()],
        }
    }

    /// Adds a labelled line.
    pub(crate) fn row(&mut self, label: &str, value: &str) {
        self.lines.push(format!("  {} {value}", self.style.dim(&format!("{label:<LABEL$}"))));
    }

    /// Adds a labelled line for each value.
    pub(crate) fn rows(&mut self, label: &str, values: impl IntoIterator<Item = String>) {
        values.into_iter().for_each(|value| self.row(label, &value));
    }

    /// Adds a line without a label.
    pub(crate) fn line(&mut self, line: String) {
        self.lines.push(line);
    }

    /// Returns the text, with a line break at its end.
    pub(crate) fn finish(self) -> String {
        let mut text = self.lines.join("\n");
        text.push('\n');
        text
    }
}

/// Formats `1234567` as `1,234,567`.
pub(super) fn grouped(n: u64) -> String {
    indicatif::HumanCount(n).to_string()
}
