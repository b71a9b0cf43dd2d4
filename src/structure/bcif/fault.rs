//! Errors in binary files, with their location: category, column, encoding, byte.

use std::fmt::Display;

use super::super::error::StructureError;

/// An error and its location, as far as known. Always boxed, which keeps results small.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fault {
    place: String,
    found: String,
    expected: String,
}

impl Fault {
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn new(found: impl Into<String>, expected: impl Into<String>) -> Box<Self> {
        Box::new(Self { place: String::new(), found: found.into(), expected: expected.into() })
    }

    /// Prepends an enclosing location.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
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
