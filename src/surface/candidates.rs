//! Limit on candidate pairs: pairs of a sphere and a brick that its density can reach.
//!
//! Their number bounds the time of a run, since each pair costs up to 512 evaluations of the kernel, and the memory of
//! the candidate lists. Neither the number of spheres nor the number of grid samples bounds it: overlapping spheres
//! share bricks.

use std::f64::consts::PI;
use std::sync::atomic::{AtomicU64, Ordering};

use super::error::SurfaceError;
use super::kernel::Shape;
use super::lattice::{BRICK, Lattice, effective_radius, to_u64};
use super::params::{MAX_RESOLUTION, SurfaceLimits, SurfaceParams};
use super::spheres::Spheres;

/// Highest limit that takes effect: offsets into candidate lists have 32 bits, and a tile's lists also hold the
/// candidates of the bricks around it.
const MAX_LIMIT: u64 = 1 << 31;

/// The limit that takes effect.
pub(super) fn limit(limits: &SurfaceLimits) -> u64 {
    limits.max_candidates.min(MAX_LIMIT)
}

/// Rejects a run that is certain to exceed the limit, by one pass over the radii and before anything is allocated.
///
/// # Errors
/// [`SurfaceError::TooManyCandidates`].
pub(crate) fn check(spheres: &Spheres, params: &SurfaceParams, limits: &SurfaceLimits) -> Result<(), SurfaceError> {
    let shape = Shape::new(params);
    let reach = |radius: f32| shape.reach(shape.length(effective_radius(radius, params)));
    let brick = f64::from(BRICK) * params.resolution;
    // Bricks fill space, so a sphere reaches at least as many as its volume holds, and at least one.
    let bricks = |radius: &f32| (4.0 / 3.0 * PI * (reach(*radius) / brick).powi(3)).max(1.0);
    let (n, (_, largest), limit) = (spheres.len(), spheres.radius_range(), limit(limits));
    // The sum is not needed if it fits for spheres of the largest radius.
    if n as f64 * bricks(&largest) <= limit as f64 {
        return Ok(());
    }
    let least = to_u64(spheres.radii().iter().map(bricks).sum());
    if least <= limit { Ok(()) } else { Err(error(least, limit, n, reach(largest), params.resolution)) }
}

/// Returns the error of a run on `lattice` that has at least `candidates` pairs.
pub(super) fn exceeded(lattice: &Lattice, candidates: u64, limits: &SurfaceLimits) -> SurfaceError {
    let longest = lattice.atoms.iter().map(|atom| lattice.reach(atom)).fold(0.0, f64::max) * lattice.spacing;
    error(candidates, limit(limits), lattice.atoms.len(), longest, lattice.spacing)
}

/// Number of pairs of overlapping spheres, which determines the time for finding their boundary.
pub(super) struct OverlapCount {
    so_far: AtomicU64,
    limit: u64,
}

impl OverlapCount {
    /// Starts at 0. The limit is the one of candidate pairs.
    pub(super) fn new(limits: &SurfaceLimits) -> Self {
        Self { so_far: AtomicU64::new(0), limit: limit(limits) }
    }

    /// Returns the number of pairs so far.
    pub(super) fn total(&self) -> u64 {
        self.so_far.load(Ordering::Relaxed)
    }

    /// Adds `n` ordered pairs.
    ///
    /// # Errors
    /// [`SurfaceError::TooManyOverlaps`].
    pub(super) fn add(&self, n: usize) -> Result<(), SurfaceError> {
        let overlaps = self.so_far.fetch_add(n as u64, Ordering::Relaxed) + n as u64;
        if overlaps <= self.limit { Ok(()) } else { Err(SurfaceError::TooManyOverlaps { overlaps, limit: self.limit }) }
    }
}

fn error(candidates: u64, limit: u64, n_spheres: usize, reach: f64, resolution: f64) -> SurfaceError {
    let suggested_resolution = fitting(limit as f64 / n_spheres as f64, reach);
    SurfaceError::TooManyCandidates { candidates, limit, resolution, suggested_resolution }
}

/// Returns a spacing (Å) at which a sphere that reaches `reach` Å has no more than `pairs` candidate pairs, if there is
/// one.
fn fitting(pairs: f64, reach: f64) -> Option<f64> {
    // A sphere touches at most 2·reach/brick + 2 bricks along each axis.
    let along = pairs.cbrt() - 2.0;
    let spacing = 2.0 * reach / (f64::from(BRICK) * along);
    let rounded = (spacing * 101.0).ceil() / 100.0;
    (along > 0.0 && rounded <= MAX_RESOLUTION).then_some(rounded)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::backend::Backend;
    use crate::surface::control::Control;
    use crate::surface::cpu::CpuBackend;
    use crate::surface::occupancy::Occupancy;
    use crate::surface::params::SurfaceOptions;

    fn same_place(n: usize) -> Spheres {
        Spheres::new(vec![0.3; n], vec![0.2; n], vec![0.1; n], vec![1.7; n]).unwrap()
    }

    fn params(resolution: f64, radius_scale: f64) -> SurfaceParams {
        let options = SurfaceOptions {
            resolution: Some(resolution),
            radius_scale: Some(radius_scale),
            ..SurfaceOptions::default()
        };
        SurfaceParams::new(&options).unwrap()
    }

    /// Exact number of candidate pairs.
    fn pairs(spheres: &Spheres, params: &SurfaceParams) -> u64 {
        let (lattice, limits) = (Lattice::new(spheres, params).unwrap(), SurfaceLimits::default());
        Occupancy::new(&lattice, &limits, &Control::default()).unwrap().n_candidates()
    }

    #[test]
    fn identical_spheres_are_rejected_at_the_exact_limit_and_the_suggestion_fits() {
        let (spheres, params) = (same_place(100), params(0.4, 3.0));
        let exact = pairs(&spheres, &params);
        let backend = CpuBackend::new(Some(2)).unwrap();
        let run = |max_candidates, params: &SurfaceParams| {
            let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
            backend.run(&spheres, params, &limits, &Control::default())
        };
        assert!(run(exact, &params).is_ok());
        let error = run(exact - 1, &params).unwrap_err();
        let SurfaceError::TooManyCandidates { candidates, limit, suggested_resolution, .. } = error else {
            panic!("{error}")
        };
        assert!(candidates > limit && limit == exact - 1);
        let coarser = SurfaceParams { resolution: suggested_resolution.unwrap(), ..params.clone() };
        assert!(coarser.resolution > params.resolution && run(exact - 1, &coarser).is_ok());
        // The occupancy count finds the same pairs.
        let lattice = Lattice::new(&spheres, &params).unwrap();
        for (max_candidates, fits) in [(exact, true), (exact - 1, false)] {
            let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
            assert_eq!(Occupancy::new(&lattice, &limits, &Control::default()).is_ok(), fits);
        }
    }

    #[test]
    fn the_lower_bound_holds_and_rejects_an_excessive_run_early() {
        for (resolution, scale) in [(0.2, 1.0), (0.5, 1.0), (0.5, 8.0), (4.0, 0.5)] {
            let (spheres, params) = (same_place(20), params(resolution, scale));
            let exact = pairs(&spheres, &params);
            let limits = SurfaceLimits { max_candidates: exact, ..SurfaceLimits::default() };
            assert!(check(&spheres, &params, &limits).is_ok(), "{resolution} {scale}");
        }
        let limits = SurfaceLimits { max_candidates: 1 << 28, ..SurfaceLimits::default() };
        let huge = check(&same_place(300_000), &params(0.5, 10.0), &limits);
        assert!(matches!(huge, Err(SurfaceError::TooManyCandidates { candidates, .. }) if candidates > 1 << 29));
    }

    #[test]
    fn no_spacing_is_suggested_if_none_fits() {
        assert_eq!(fitting(8.0, 3.0), None);
        assert_eq!(fitting(27.0, 4.0), Some(1.01));
        assert_eq!(fitting(27.0, 400.0), None);
    }
}
