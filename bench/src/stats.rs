//! Statistics of repeated measurements.

use serde::{Deserialize, Serialize};

/// Median and minimum of several values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Summary {
    pub(crate) median: f64,
    pub(crate) min: f64,
}

impl Summary {
    /// Summarizes `values`. Both results are 0 if there are none.
    pub(crate) fn of(values: impl IntoIterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.into_iter().collect();
        values.sort_by(f64::total_cmp);
        let at = |i: usize| values.get(i).copied().unwrap_or_default();
        let n = values.len();
        let median = if n.is_multiple_of(2) { f64::midpoint(at(n.wrapping_sub(1) / 2), at(n / 2)) } else { at(n / 2) };
        Self { median, min: at(0) }
    }

    /// Rounds both values to five significant digits; more would be noise.
    pub(crate) fn rounded(self) -> Self {
        Self { median: digits(self.median), min: digits(self.min) }
    }
}

/// Rounds to five significant digits.
pub(crate) fn digits(v: f64) -> f64 {
    if v == 0.0 || !v.is_finite() { v } else { format!("{v:.4e}").parse().unwrap_or(v) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_summary_is_the_median_and_the_minimum() {
        assert_eq!(Summary::of([3.0, 1.0, 2.0]), Summary { median: 2.0, min: 1.0 });
        assert_eq!(Summary::of([4.0, 1.0, 2.0, 3.0]), Summary { median: 2.5, min: 1.0 });
        assert_eq!(Summary::of([]), Summary { median: 0.0, min: 0.0 });
    }

    #[test]
    #[expect(clippy::float_cmp, reason = "the rounded numbers are parsed from the same digits")]
    fn numbers_are_rounded_to_five_digits() {
        assert_eq!(
            [digits(0.0), digits(1.0), digits(123.456_789), digits(1.234_567e-9)],
            [0.0, 1.0, 123.46, 1.2346e-9]
        );
    }
}
