//! What is wrong with a binary file, and where: the category, the column, the encoding, the byte.

use std::fmt::Display;

use super::super::error::StructureError;

/// Something wrong, with the place as far as it is known. Boxed, as results are to stay small where nothing is wrong.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fault {
    place: String,
    found: String,
    expected: String,
}

impl Fault {
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "results stay small where nothing is wrong")]
    pub(super) fn new(found: impl Into<String>, expected: impl Into<String>) -> Box<Self> {
        Box::new(Self { place: String::new(), found: found.into(), expected: expected.into() })
    }

    /// The same, with the place around the one that is known so far.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "results stay small where nothing is wrong")]
    pub(super) fn within(mut self: Box<Self>, outer: impl Display) -> Box<Self> {
        self.place = if self.place.is_empty() { outer.to_string() } else { format!("{outer}, {}", self.place) };
        self
    }
}

impl From<Box<Fault>> for StructureError {
    fn from(fault: Box<Fault>) -> Self {
        let Fault { place, found, expected } = *fault;
        Self::Malformed { place, found, expected }
    }
}
