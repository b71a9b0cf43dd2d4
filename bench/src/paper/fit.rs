//! Fits of power laws to times against atoms, by least squares of logarithms.

use super::result::{Series, Timed};

/// Fitted power law.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fit {
    pub(super) exponent: f64,
    pub(super) factor: f64,
    /// Smallest x of the points.
    pub(super) from: f64,
    /// Largest x of the points.
    pub(super) to: f64,
    /// Number of points.
    pub(super) points: usize,
}

impl Fit {
    /// Returns the value at `x`.
    pub(super) fn at(&self, x: f64) -> f64 {
        self.factor * x.powf(self.exponent)
    }
}

/// Fits the points with `x ≥ from`. Returns `None` for fewer than three.
fn fit(points: &[(f64, f64)], from: f64) -> Option<Fit> {
    let logs: Vec<(f64, f64)> =
        points.iter().filter(|(x, y)| *x >= from && *y > 0.0).map(|(x, y)| (x.ln(), y.ln())).collect();
    let n = logs.len();
    if n < 3 {
        return None;
    }
    let mean = |of: &dyn Fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / n as f64;
    let (x, y) = (mean(&|p| p.0), mean(&|p| p.1));
    let (xy, xx) = (mean(&|p| (p.0 - x) * (p.1 - y)), mean(&|p| (p.0 - x).powi(2)));
    let exponent = xy / xx;
    let range = |of: fn(f64, f64) -> f64, start: f64| logs.iter().map(|p| p.0).fold(start, of).exp();
    let (from, to) = (range(f64::min, f64::MAX), range(f64::max, f64::MIN));
    exponent.is_finite().then(|| Fit { exponent, factor: (y - exponent * x).exp(), from, to, points: n })
}

/// Returns the number of atoms from which a series is fitted: 10,000, where fixed costs become negligible, or the start
/// of the last three points if fewer are as large.
fn from(points: &[(f64, f64)]) -> f64 {
    const LARGE: f64 = 10_000.0;
    let large = points.iter().filter(|(x, _)| *x >= LARGE).count();
    if large >= 3 {
        return LARGE;
    }
    points.iter().rev().nth(2).map_or(0.0, |(x, _)| *x)
}

/// Fits the time and the device time of a series. Returns the fits with their names.
pub(super) fn fits(series: &Series) -> Vec<(&'static str, Fit)> {
    let named =
        [("time", series.points(&|t| Some(t.seconds.median))), ("device time", series.points(&Timed::device_median))];
    named.into_iter().filter_map(|(name, points)| Some((name, fit(&points, from(&points))?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_power_law_is_recovered() {
        for exponent in [0.8, 1.0, 1.05, 2.0] {
            let law = |x: f64| 3e-6 * x.powf(exponent);
            let points: Vec<_> = [1e2, 3e2, 1e3, 1e4, 3e4, 1e5, 1e6].map(|x| (x, law(x))).to_vec();
            let found = fit(&points, 0.0).unwrap();
            assert!((found.exponent - exponent).abs() < 1e-9 && (found.at(1e4) / law(1e4) - 1.0).abs() < 1e-9);
            assert_eq!((found.points, found.from.round(), found.to.round()), (7, 100.0, 1e6));
            // One point off by a factor of two moves the exponent.
            let mut bent = points.clone();
            bent[6].1 *= 2.0;
            assert!(fit(&bent, 0.0).unwrap().exponent > exponent + 0.02);
            assert!((fit(&bent[..6], 0.0).unwrap().exponent - exponent).abs() < 1e-9);
        }
    }

    #[test]
    fn fixed_costs_are_excluded_from_long_series() {
        let time = |x: f64| 1e-3 + 1e-6 * x;
        let points: Vec<_> = [1e2, 1e3, 1e4, 1e5, 1e6, 3e6].map(|x| (x, time(x))).to_vec();
        assert!(fit(&points, 0.0).unwrap().exponent < 0.85);
        assert!((fit(&points, from(&points)).unwrap().exponent - 1.0).abs() < 0.02);
        assert_eq!((from(&points[..3]), from(&points[..4]), from(&points[..2])), (1e2, 1e3, 0.0));
        assert_eq!((fit(&points[..2], 0.0), fit(&[(5.0, 1.0); 3], 0.0)), (None, None));
    }
}
