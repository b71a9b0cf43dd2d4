//! Error for a grid of too many points, with a spacing that fits.

use rustc_hash::FxHashMap;

use super::control::Control;
use super::error::SurfaceError;
use super::lattice::{BRICK, Lattice, to_i32};
use super::memory::Reservation;
use super::params::{MAX_RESOLUTION, SurfaceLimits};

/// Ratio of the spacings that are tried.
const STEP: f64 = 1.08;
/// Atoms between two checks of the cancellation flag.
const ATOMS_PER_CHECK: usize = 1 << 13;

/// Returns the error for a grid of about `grid_points` grid points, with a spacing that fits. If the search for such a
/// spacing fails, returns its error.
pub(crate) fn exceeded(
    lattice: &Lattice,
    grid_points: u64,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> SurfaceError {
    let (limit, resolution) = (limits.max_grid_points, lattice.spacing);
    match fitting(lattice, limits, control) {
        Ok(suggested_resolution) => SurfaceError::GridTooLarge { grid_points, limit, resolution, suggested_resolution },
        Err(error) => error,
    }
}

/// Finds a spacing (Å) at which an upper bound of the number of grid points is within the limit; the coarsest spacing
/// if there is none. Bisection tries about seven spacings.
fn fitting(lattice: &Lattice, limits: &SurfaceLimits, control: &Control<'_>) -> Result<f64, SurfaceError> {
    let reach = lattice.atoms.iter().map(|atom| lattice.reach(atom)).fold(0.0, f64::max) * lattice.spacing;
    let spacing = |step: i32| (lattice.spacing * STEP.powi(step)).min(MAX_RESOLUTION);
    let (mut exceeds, mut fits) = (0, to_i32((MAX_RESOLUTION / lattice.spacing).ln() / STEP.ln()) + 1);
    while fits - exceeds > 1 {
        let middle = exceeds.midpoint(fits);
        if (Blocks { lattice, reach, spacing: spacing(middle) }).fit(limits, control)? {
            fits = middle;
        } else {
            exceeds = middle;
        }
    }
    Ok((spacing(fits) * 100.0).ceil() / 100.0)
}

/// Cubic blocks, whose edge is the longest reach plus the edge of a brick. The blocks that hold an atom and their 26
/// neighbours contain every brick in reach.
struct Blocks<'a> {
    lattice: &'a Lattice,
    /// Longest reach, Å.
    reach: f64,
    /// Spacing of the grid points, Å.
    spacing: f64,
}

impl Blocks<'_> {
    /// Returns true if all blocks together have no more grid points than the limit, which also bounds the memory.
    fn fit(&self, limits: &SurfaceLimits, control: &Control<'_>) -> Result<bool, SurfaceError> {
        let side = self.reach + self.spacing * f64::from(BRICK);
        let scale = self.lattice.spacing / side;
        let max_blocks = limits.max_grid_points as f64 / (side / self.spacing).powi(3);
        let memory = Reservation::new(&control.memory);
        // True if an atom lies in the block.
        let mut blocks: FxHashMap<[i32; 3], bool> = FxHashMap::default();
        for atoms in self.lattice.atoms.chunks(ATOMS_PER_CHECK) {
            control.check()?;
            for atom in atoms {
                memory.reserve_entries(&mut blocks, 27)?;
                let own: [i32; 3] = std::array::from_fn(|k| to_i32((atom.position(k) * scale).floor()));
                if blocks.insert(own, true) == Some(true) {
                    continue;
                }
                let [x, y, z] = own.map(|c| c - 1..=c + 1);
                for z in z {
                    for y in y.clone() {
                        for x in x.clone() {
                            blocks.entry([x, y, z]).or_insert(false);
                        }
                    }
                }
                if blocks.len() as f64 > max_blocks {
                    return Ok(false);
                }
            }
        }
        Ok(true)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::occupancy::count;
    use crate::surface::{Spheres, SurfaceOptions, SurfaceParams};

    fn lattice(resolution: f64) -> Lattice {
        let column = |factor: f64| (0..300).map(|i| f64::from(i) * factor % 90.0).collect();
        let spheres = Spheres::new(column(7.13), column(3.71), column(1.4), vec![1.7; 300]).unwrap();
        let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
        Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap()).unwrap()
    }

    #[test]
    fn the_suggested_spacing_fits_and_the_current_one_does_not() {
        for (resolution, max_grid_points) in [(0.1, 10_000_000), (0.3, 1_000_000), (1.0, 200_000)] {
            let (limits, control) = (SurfaceLimits { max_grid_points, ..SurfaceLimits::default() }, Control::default());
            let fits = fitting(&lattice(resolution), &limits, &control).unwrap();
            assert!(fits > resolution && fits < MAX_RESOLUTION, "{resolution}: {fits}");
            count(&lattice(fits), &limits, &control).unwrap();
            assert!(count(&lattice(resolution), &limits, &control).is_err(), "{resolution}: the control");
        }
        let limits = SurfaceLimits { max_grid_points: 511, ..SurfaceLimits::default() };
        let coarsest = fitting(&lattice(1.0), &limits, &Control::default()).unwrap();
        assert_eq!(coarsest.to_bits(), MAX_RESOLUTION.to_bits());
    }
}
