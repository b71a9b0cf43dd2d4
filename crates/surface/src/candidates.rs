//! Limit on candidate pairs: pairs of a sphere and a brick that its density can reach.
//!
//! Their number bounds the time of a run, since each pair costs up to 512 evaluations of the kernel, and the memory of
//! the candidate lists. Neither the number of spheres nor the number of grid points bounds it: overlapping spheres
//! share bricks.

use std::f64::consts::PI;
use std::sync::atomic::{AtomicU64, Ordering};

use super::control::Control;
use super::error::SurfaceError;
use super::kernel::Shape;
use super::lattice::{BRICK, Lattice, effective_radius, to_u64};
use super::limit::{Exceeded, Limit, slightly_coarser};
use super::params::{MAX_RESOLUTION, SurfaceLimits, SurfaceParams};
use super::spheres::Spheres;

/// Highest limit that takes effect: offsets into candidate lists have 32 bits, and a tile's lists also hold the
/// candidates of the bricks around it.
const MAX_LIMIT: u64 = 1 << 31;

/// Returns the limit of candidate pairs: that of `limits`, or `MAX_LIMIT` if it is lower.
#[must_use]
pub fn limit(limits: &SurfaceLimits) -> u64 {
    limits.max_candidates.min(MAX_LIMIT)
}

/// Rejects a run that is certain to exceed the limit. Passes over the radii once and allocates nothing.
///
/// # Errors
/// [`SurfaceError::Limit`].
pub fn check(spheres: &Spheres, params: &SurfaceParams, limits: &SurfaceLimits) -> Result<(), SurfaceError> {
    let reach = reach(params);
    let brick = f64::from(BRICK) * params.resolution;
    // Bricks fill space, so a sphere reaches at least as many as its volume holds, and at least one.
    let bricks = |radius: &f32| (4.0 / 3.0 * PI * (reach(*radius) / brick).powi(3)).max(1.0);
    let (n, (_, largest), limit) = (spheres.len(), spheres.radius_range(), limit(limits));
    // The sum is not needed if it fits for spheres of the largest radius.
    if n as f64 * bricks(&largest) <= limit as f64 {
        return Ok(());
    }
    let least = to_u64(spheres.radii().iter().map(bricks).sum());
    if least <= limit { Ok(()) } else { Err(too_many(least, spheres, params, limits)) }
}

/// Returns the error of a run on `spheres` that has at least `candidates` pairs.
#[must_use]
pub fn too_many(candidates: u64, spheres: &Spheres, params: &SurfaceParams, limits: &SurfaceLimits) -> SurfaceError {
    let (_, largest) = spheres.radius_range();
    error(candidates, limits, spheres.len(), reach(params)(largest), params.resolution)
}

/// Returns the function of a sphere's radius that gives the distance at which its effect ends, Å.
fn reach(params: &SurfaceParams) -> impl Fn(f32) -> f64 {
    let shape = Shape::new(params);
    move |radius| shape.reach(shape.length(effective_radius(radius, params)))
}

/// Returns the error of a run on `lattices` that has at least `candidates` pairs.
pub(super) fn exceeded(lattices: &[&Lattice], candidates: u64, limits: &SurfaceLimits) -> SurfaceError {
    let reach =
        |lattice: &&Lattice| lattice.atoms.iter().map(|atom| lattice.reach(atom)).fold(0.0, f64::max) * lattice.spacing;
    let (n, longest) = (lattices.iter().map(|lattice| lattice.atoms.len()).sum(), lattices.iter().map(reach));
    let spacing = lattices.first().map_or(MAX_RESOLUTION, |lattice| lattice.spacing);
    error(candidates, limits, n, longest.fold(0.0, f64::max), spacing)
}

/// Number of comparisons of two caps of a sphere that count as one pair of overlapping spheres. Ordinary structures
/// have fewer comparisons for each pair.
const COMPARISONS_PER_PAIR: u64 = 64;
/// Number of comparisons between two checks of the limit and of cancellation: they take about 0.2 ms.
const COMPARISONS_PER_CHECK: u64 = 1 << 16;

/// Work of finding the boundary of spheres, shared by its threads: pairs of overlapping spheres, and comparisons of
/// their caps.
pub(super) struct OverlapCount {
    so_far: AtomicU64,
    limits: SurfaceLimits,
}

impl OverlapCount {
    /// Starts a count at 0, limited by the limit on candidate pairs.
    pub(super) fn new(limits: &SurfaceLimits) -> Self {
        Self { so_far: AtomicU64::new(0), limits: *limits }
    }

    /// Returns the number of pairs so far, including the pairs that stand for comparisons.
    pub(super) fn total(&self) -> u64 {
        self.so_far.load(Ordering::Relaxed)
    }

    /// Adds `n` ordered pairs.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`].
    pub(super) fn add(&self, n: u64) -> Result<(), SurfaceError> {
        let overlaps = self.so_far.fetch_add(n, Ordering::Relaxed) + n;
        if overlaps <= limit(&self.limits) { Ok(()) } else { Err(too_many_overlaps(overlaps, &self.limits)) }
    }
}

/// Comparisons of the caps of a part of the spheres, by one thread.
pub(super) struct Comparisons<'a> {
    overlaps: &'a OverlapCount,
    control: &'a Control<'a>,
    /// Number of comparisons that `overlaps` does not count yet.
    uncounted: u64,
}

impl<'a> Comparisons<'a> {
    /// Returns a count of 0, whose comparisons are added to `overlaps`.
    pub(super) fn new(overlaps: &'a OverlapCount, control: &'a Control<'a>) -> Self {
        Self { overlaps, control, uncounted: 0 }
    }

    /// Adds `n` comparisons. Checks limit and cancellation from time to time.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`], [`SurfaceError::Cancelled`].
    #[inline]
    pub(super) fn add(&mut self, n: usize) -> Result<(), SurfaceError> {
        self.uncounted += n as u64;
        if self.uncounted < COMPARISONS_PER_CHECK { Ok(()) } else { self.count() }
    }

    /// Adds the comparisons that were not added yet to the shared count. The end of a part calls it, so that the total
    /// depends on the parts and not on the threads.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`], [`SurfaceError::Cancelled`].
    pub(super) fn count(&mut self) -> Result<(), SurfaceError> {
        self.control.check()?;
        self.overlaps.add(self.uncounted / COMPARISONS_PER_PAIR)?;
        self.uncounted %= COMPARISONS_PER_PAIR;
        Ok(())
    }
}

/// Returns the error of spheres of which at least `overlaps` pairs overlap.
#[must_use]
pub fn too_many_overlaps(overlaps: u64, limits: &SurfaceLimits) -> SurfaceError {
    Exceeded { actual: Some(overlaps), ..Exceeded::capped(Limit::Overlaps, limits.max_candidates, MAX_LIMIT) }.error()
}

fn error(candidates: u64, limits: &SurfaceLimits, n_spheres: usize, reach: f64, resolution: f64) -> SurfaceError {
    let error = Exceeded::capped(Limit::Candidates, limits.max_candidates, MAX_LIMIT);
    let suggested_resolution = fitting(error.max as f64 / n_spheres as f64, reach, resolution);
    Exceeded { actual: Some(candidates), resolution: Some(resolution), suggested_resolution, ..error }.error()
}

/// Returns a spacing above `resolution` (Å) at which spheres that reach `reach` Å probably have no more than `pairs`
/// candidate pairs each, if there is one.
fn fitting(pairs: f64, reach: f64, resolution: f64) -> Option<f64> {
    // Among random positions, a sphere of q bricks touches 1 + 6q + 3πq² + 4/3πq³ bricks on average, which is about
    // 4/3π(q + 0.7)³, and at most (2q + 2)³. Spheres at similar positions may exceed the mean: then this spacing was
    // refused as well, and the maximum is certain to fit.
    let by_mean = (pairs * 0.75 / PI).cbrt() - 0.7;
    let by_maximum = 0.5 * pairs.cbrt() - 1.0;
    let spacings = [by_mean, by_maximum].map(|radius| slightly_coarser(reach / (f64::from(BRICK) * radius.max(0.0))));
    spacings.into_iter().find(|spacing| *spacing > resolution && *spacing <= MAX_RESOLUTION)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use super::*;
    use crate::backend::Backend;
    use crate::control::{Observer, Stage};
    use crate::cpu::CpuBackend;
    use crate::occupancy::{self, Occupancy};
    use crate::params::SurfaceOptions;

    fn at_one_point(n: usize) -> Spheres {
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
        let (lattice, limits) = (Lattice::new(spheres, params, &Control::default()).unwrap(), SurfaceLimits::default());
        occupancy::count(&lattice, &limits, &Control::default()).unwrap().candidates
    }

    /// True once the field was evaluated.
    #[derive(Default)]
    struct Evaluated(AtomicBool);

    impl Observer for Evaluated {
        fn span(&self, stage: Stage, work: &mut dyn FnMut()) {
            self.0.fetch_or(stage == Stage::Field, Ordering::Relaxed);
            work();
        }
    }

    #[test]
    fn identical_spheres_are_rejected_at_the_exact_limit_and_the_suggestion_fits() {
        let (spheres, params) = (at_one_point(100), params(0.4, 3.0));
        let exact = pairs(&spheres, &params);
        let backend = CpuBackend::new(Some(2)).unwrap();
        let run = |max_candidates, params: &SurfaceParams| {
            let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
            backend.run(&spheres, params, &limits, &Control::default())
        };
        assert!(run(exact, &params).is_ok());
        // The pairs are counted before the field is evaluated.
        let (stages, limits) =
            (Evaluated::default(), SurfaceLimits { max_candidates: exact - 1, ..SurfaceLimits::default() });
        let control = Control { observer: &stages, ..Control::default() };
        assert!(backend.run(&spheres, &params, &limits, &control).is_err() && !stages.0.load(Ordering::Relaxed));
        backend.run(&spheres, &params, &SurfaceLimits::default(), &control).unwrap();
        assert!(stages.0.load(Ordering::Relaxed), "the control");
        let error = run(exact - 1, &params).unwrap_err();
        let exceeded = error.exceeded(Limit::Candidates).unwrap();
        assert!(exceeded.actual.unwrap() > exceeded.max && exceeded.max == exact - 1);
        let coarser = SurfaceParams { resolution: exceeded.suggested_resolution.unwrap(), ..params.clone() };
        assert!(coarser.resolution > params.resolution && run(exact - 1, &coarser).is_ok());
        // The occupancy count finds the same pairs.
        let lattice = Lattice::new(&spheres, &params, &Control::default()).unwrap();
        for (max_candidates, fits) in [(exact, true), (exact - 1, false)] {
            let limits = SurfaceLimits { max_candidates, ..SurfaceLimits::default() };
            assert_eq!(Occupancy::new(&lattice, &limits, &Control::default()).is_ok(), fits);
        }
    }

    #[test]
    fn the_lower_bound_holds_and_rejects_an_excessive_run_early() {
        for (resolution, scale) in [(0.2, 1.0), (0.5, 1.0), (0.5, 8.0), (4.0, 0.5)] {
            let (spheres, params) = (at_one_point(20), params(resolution, scale));
            let exact = pairs(&spheres, &params);
            let limits = SurfaceLimits { max_candidates: exact, ..SurfaceLimits::default() };
            assert!(check(&spheres, &params, &limits).is_ok(), "{resolution} {scale}");
        }
        let limits = SurfaceLimits { max_candidates: 1 << 28, ..SurfaceLimits::default() };
        let huge = check(&at_one_point(300_000), &params(0.5, 10.0), &limits);
        assert!(huge.unwrap_err().exceeded(Limit::Candidates).unwrap().actual.unwrap() > 1 << 29);
    }

    #[test]
    fn no_spacing_is_suggested_if_none_fits() {
        assert_eq!(fitting(1.0, 3.0, 0.5), None);
        assert_eq!(fitting(8.0, 3.0, 0.5), Some(0.73));
        assert_eq!(fitting(8.0, 3.0, 0.73), None);
        // The mean does not fit: the maximum does.
        assert_eq!(fitting(27.0, 4.0, 0.3), Some(0.46));
        assert_eq!(fitting(27.0, 4.0, 0.46), Some(1.05));
        assert_eq!(fitting(27.0, 400.0, 0.3), None);
    }
}
