//! Search for the grid spacing at which a dense program visits a given number of cubes.

use crate::error::{Error, Result};

/// Maximum relative error of the number of cubes.
pub(crate) const TOLERANCE: f64 = 0.01;
/// Relative error at which the search ends.
const CLOSE: f64 = 0.002;

/// Grid spacing and its number of cubes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Grid {
    /// Grid spacing, Å.
    pub(crate) spacing: f64,
    pub(crate) cubes: u64,
}

/// Finds the spacing at which `cubes_at` is closest to `cubes`. `cubes_at` decreases with the spacing in steps, since
/// whole layers of cubes disappear.
///
/// # Errors
/// Returns [`Error::Failed`] if no spacing is within 1 %, or an error of `cubes_at`.
pub(crate) fn for_cubes(cubes: u64, cubes_at: &dyn Fn(f64) -> Result<u64>) -> Result<Grid> {
    let (mut fine, mut coarse) = (0.05, 5.0);
    for _ in 0..20 {
        let middle = f64::sqrt(fine * coarse);
        if cubes_at(middle)? > cubes { fine = middle } else { coarse = middle }
    }
    let error = |found: u64| (found as f64 / cubes as f64 - 1.0).abs();
    let mut best: Option<Grid> = None;
    for step in (0..=100_i32).flat_map(|step| [step, -step]) {
        let spacing = coarse * (1.0 + 3e-4 * f64::from(step));
        let found = cubes_at(spacing)?;
        if best.is_none_or(|best| error(found) < error(best.cubes)) {
            best = Some(Grid { spacing, cubes: found });
        }
        if best.is_some_and(|best| error(best.cubes) <= CLOSE) {
            break;
        }
    }
    best.filter(|best| error(best.cubes) <= TOLERANCE)
        .ok_or_else(|| Error::Failed(format!("no spacing gives {cubes} cubes within 1 %")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_spacing_or_fails() {
        let cells = |side: f64, h: f64| (1..u64::MAX).take_while(|n| *n as f64 * h < side).count() as u64;
        let boxed = |h: f64| Ok(cells(30.0, h) * cells(34.1, h) * cells(41.7, h));
        for cubes in [100_000, 346_580, 7_229_120] {
            let grid = for_cubes(cubes, &boxed).unwrap();
            assert_eq!(boxed(grid.spacing).unwrap(), grid.cubes);
            assert!((grid.cubes as f64 / cubes as f64 - 1.0).abs() <= TOLERANCE, "{grid:?}");
        }
        assert!(for_cubes(1000, &|_| Ok(900)).unwrap_err().to_string().contains("1000 cubes"));
        assert_eq!(for_cubes(1000, &|_| Err(Error::failed("no"))).unwrap_err().to_string(), "no");
    }
}
