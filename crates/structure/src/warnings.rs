//! Warnings about unreadable values that do not affect the mesh. A default replaces the value, and the report lists it.

use super::error::StructureError;

/// Maximum number of warnings with their own message. A damaged file may have one per line.
const KEPT: usize = 10;

/// A fault, and how it was resolved, such as `read as 1`.
#[derive(Debug, Clone)]
pub(super) struct Warning<F> {
    pub(super) fault: F,
    used: &'static str,
}

/// The first warnings in file order, and the total number.
#[derive(Debug, Clone)]
pub(super) struct Warnings<F> {
    kept: Vec<Warning<F>>,
    total: u64,
}

impl<F> Default for Warnings<F> {
    fn default() -> Self {
        Self { kept: Vec::new(), total: 0 }
    }
}

impl<F> Warnings<F> {
    /// Adds a warning. Calls `fault` only if the message is kept.
    #[cold]
    pub(super) fn add(&mut self, used: &'static str, fault: impl FnOnce() -> F) {
        self.total += 1;
        if self.kept.len() < KEPT {
            self.kept.push(Warning { fault: fault(), used });
        }
    }

    /// Returns the number of warnings with a message.
    pub(super) fn len(&self) -> usize {
        self.kept.len()
    }

    /// Returns the kept warnings after the first `n`.
    pub(super) fn after(&mut self, n: usize) -> &mut [Warning<F>] {
        &mut self.kept[n..]
    }

    /// Adds the warnings of a later part of the file.
    pub(super) fn append(&mut self, mut later: Self) {
        self.total += later.total;
        later.kept.truncate(KEPT - self.kept.len());
        self.kept.append(&mut later.kept);
    }

    /// Returns messages for a report, at most [`KEPT`] and a summary.
    pub(super) fn messages(self, locate: impl Fn(F) -> StructureError) -> Vec<String> {
        let more = self.total - self.kept.len() as u64;
        let kept = self.kept.into_iter();
        let mut messages: Vec<String> = kept.map(|w| format!("{}; {}", locate(w.fault), w.used)).collect();
        if more > 0 {
            messages.push(format!("{more} more values that could not be read"));
        }
        messages
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests fail by panicking")]
mod tests {
    use super::*;

    fn warnings(faults: std::ops::Range<u64>) -> Warnings<u64> {
        let mut warnings = Warnings::default();
        faults.for_each(|i| warnings.add("read as 1", || i));
        warnings
    }

    fn messages(warnings: Warnings<u64>) -> Vec<String> {
        warnings.messages(|i| StructureError::NoAtoms { found: i.to_string() })
    }

    #[test]
    fn messages_are_bounded_and_the_rest_is_counted() {
        assert_eq!(messages(warnings(0..0)), Vec::<String>::new());
        assert_eq!(messages(warnings(7..8)), ["no atoms: 7; read as 1"]);
        let all = messages(warnings(0..1000));
        assert_eq!((all.len(), all[KEPT].as_str()), (KEPT + 1, "990 more values that could not be read"));
    }

    #[test]
    fn parts_add_up_to_the_whole() {
        let mut parts = warnings(0..6);
        parts.append(warnings(6..30));
        parts.append(warnings(30..31));
        assert_eq!(messages(parts), messages(warnings(0..31)));
    }
}
