//! Errors in binary files, with their location: category, column, encoding, byte.

use std::fmt::Display;

use super::super::error::StructureError;

/// An error and its location, as far as known. Always boxed, which keeps results small.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fault {
    location: String,
    found: String,
    expected: String,
}

impl Fault {
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn new(found: impl Into<String>, expected: impl Into<String>) -> Box<Self> {
        Box::new(Self { location: String::new(), found: found.into(), expected: expected.into() })
    }

    /// Prepends an enclosing location.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn within(mut self: Box<Self>, outer: impl Display) -> Box<Self> {
        self.location =
            if self.location.is_empty() { outer.to_string() } else { format!("{outer}, {}", self.location) };
        self
    }
}

impl From<Box<Fault>> for StructureError {
    fn from(fault: Box<Fault>) -> Self {
        let Fault { location, found, expected } = *fault;
        Self::Malformed { location, found, expected }
    }
}
