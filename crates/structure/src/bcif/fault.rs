//! Errors in binary files, with their location: category, column, encoding, byte.

use std::fmt::Display;

use super::super::error::StructureError;

/// An error and its location, as far as known. Always boxed, which keeps results small.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fault {
    location: String,
    found: String,
    expected: String,
    /// True if the temporary file failed; `found` is the message of the system.
    is_scratch: bool,
}

impl Fault {
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn new(found: impl Into<String>, expected: impl Into<String>) -> Box<Self> {
        let (found, expected) = (found.into(), expected.into());
        Box::new(Self { location: String::new(), found, expected, is_scratch: false })
    }

    /// Converts an error of the temporary file.
    #[cold]
    #[expect(clippy::unnecessary_box_returns, reason = "a boxed fault keeps results small")]
    pub(super) fn of_scratch(error: StructureError) -> Box<Self> {
        let found = match error {
            StructureError::Scratch { reason } => reason,
            error => error.to_string(),
        };
        Box::new(Self { location: String::new(), found, expected: String::new(), is_scratch: true })
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
        let Fault { location, found, expected, is_scratch } = *fault;
        if is_scratch { Self::Scratch { reason: found } } else { Self::Malformed { location, found, expected } }
    }
}
