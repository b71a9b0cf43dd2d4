//! Limit of a request body.

use super::problem::Problem;
use super::problem_types::ProblemType;

/// Upper limit.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limit {
    /// Configuration key that sets it, unless it is fixed.
    pub(super) key: Option<&'static str>,
    pub(super) max: u64,
}

impl Limit {
    /// Returns the problem of a body with too many bytes.
    pub(super) fn exceeded_by_body(self) -> Problem {
        self.exceeded("the body has", "bytes")
    }

    /// Returns the problem of an exceeded limit; `what` begins the sentence.
    pub(super) fn exceeded(self, what: &str, unit: &str) -> Problem {
        let max = self.max;
        let key = self.key.map_or(String::new(), |key| format!(" ({key})"));
        Problem::new(ProblemType::BodyTooLarge, format!("{what} more than {max} {unit}{key}")).with("limit", max)
    }
}
