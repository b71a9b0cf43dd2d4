//! The spacing at which a dense program visits as many cubes as the paper's did.

/// How far off the number of cubes may be.
pub(super) const TOLERANCE: f64 = 0.01;
/// What is not worth a further look.
const CLOSE: f64 = 0.002;

/// A spacing, and the number of cubes there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Grid {
    /// Å.
    pub(super) spacing: f64,
    pub(super) cubes: u64,
}

/// A spacing whose number of cubes is that of `cubes`, as closely as there is one. `cubes_at` falls with the spacing, in steps: whole layers of
/// cubes come and go.
///
/// # Errors
/// In words, where none comes within 1 %, or as `cubes_at` puts it.
pub(super) fn for_cubes(cubes: u64, cubes_at: &dyn Fn(f64) -> Result<u64, String>) -> Result<Grid, String> {
    let (mut fine, mut coarse) = (0.05, 5.0);
    for _ in 0..20 {
        let middle = f64::sqrt(fine * coarse);
        if cubes_at(middle)? > cubes { fine = middle } else { coarse = middle }
    }
    let off = |found: u64| (found as f64 / cubes as f64 - 1.0).abs();
    let mut best: Option<Grid> = None;
    // From there outwards, until it is close enough.
    for step in (0..=100_i32).flat_map(|step| [step, -step]) {
        let spacing = coarse * (1.0 + 3e-4 * f64::from(step));
        let found = cubes_at(spacing)?;
        if best.is_none_or(|best| off(found) < off(best.cubes)) {
            best = Some(Grid { spacing, cubes: found });
        }
        if best.is_some_and(|best| off(best.cubes) <= CLOSE) {
            break;
        }
    }
    best.filter(|best| off(best.cubes) <= TOLERANCE).ok_or_else(|| format!("no spacing gives {cubes} cubes within 1 %"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spacing_is_found_where_there_is_one() {
        let cells = |side: f64, h: f64| (1..u64::MAX).take_while(|n| *n as f64 * h < side).count() as u64;
        let boxed = |h: f64| Ok(cells(30.0, h) * cells(34.1, h) * cells(41.7, h));
        for cubes in [100_000, 346_580, 7_229_120] {
            let grid = for_cubes(cubes, &boxed).unwrap();
            assert_eq!(boxed(grid.spacing), Ok(grid.cubes));
            assert!((grid.cubes as f64 / cubes as f64 - 1.0).abs() <= TOLERANCE, "{grid:?}");
        }
        assert!(for_cubes(1000, &|_| Ok(900)).unwrap_err().contains("1000 cubes"));
        assert_eq!(for_cubes(1000, &|_| Err("no".to_owned())), Err("no".to_owned()));
    }
}
