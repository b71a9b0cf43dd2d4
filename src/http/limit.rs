//! Limit of a request body, with the configuration key that sets it.

use super::problem::Problem;
use super::problem_types::ProblemType;

/// Upper limit with its configuration key.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limit {
    pub(super) key: &'static str,
    pub(super) max: u64,
}

impl Limit {
    /// Returns the problem of a body with too many bytes.
    pub(super) fn exceeded_by_body(self) -> Problem {
        self.exceeded("the body has", "bytes")
    }

    /// Returns the problem of an exceeded limit; `what` begins the sentence.
    pub(super) fn exceeded(self, what: &str, unit: &str) -> Problem {
        let Self { key, max } = self;
        Problem::new(ProblemType::BodyTooLarge, format!("{what} more than {max} {unit} ({key})")).with("limit", max)
    }
}
