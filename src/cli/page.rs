//! A few labelled lines on a terminal: the form of the summary, the banner and `doctor`.

use super::style::Style;

/// Width of the labels.
const LABEL: usize = 10;

/// Lines, joined at the end.
pub(crate) struct Page {
    /// Colours of the page.
    pub(crate) style: Style,
    lines: Vec<String>,
}

impl Page {
    /// A page under a title.
    pub(crate) fn new(style: Style, title: &str, rest: &str) -> Self {
        Self { style, lines: vec![format!("{} {rest}", style.bold(title)).trim_end().to_owned()] }
    }

    /// A labelled line.
    pub(crate) fn row(&mut self, label: &str, value: &str) {
        self.lines.push(format!("  {} {value}", self.style.dim(&format!("{label:<LABEL$}"))));
    }

    /// A line as it is.
    pub(crate) fn line(&mut self, line: String) {
        self.lines.push(line);
    }

    /// The whole page, with a line break at its end.
    pub(crate) fn finish(self) -> String {
        let mut text = self.lines.join("\n");
        text.push('\n');
        text
    }
}
