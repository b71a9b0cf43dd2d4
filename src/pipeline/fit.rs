//! The finest spacing whose mesh has at most so many triangles: found by making meshes and counting.
//!
//! Triangles go with about the inverse square of the spacing, but not exactly: finer grids find more surface, and where a
//! neck closes is anybody's guess. So the law only proposes; what counts is the count of a mesh that was made. The number of
//! meshes is bounded, and the first is a coarse one that costs little.

use super::clock::StageClock;
use super::spacing::{COARSEST, FINEST, Spacing};
use super::{Choice, Job};
use crate::surface::{Control, MeshOutput, Observer, Spheres, Stage, SurfaceError, SurfaceLimits, SurfaceParams};

/// Meshes that are made at most, the first coarse one and a last one again included.
pub(super) const MOST_TRIES: u32 = 8;
/// Tries after which the coarsest spacing is taken if none has fitted.
const PATIENCE: u32 = 4;
/// A mesh with this part of the triangles that it may have is fine enough.
const FULL: f64 = 0.95;
/// The part of the triangles that is aimed at: a little less than allowed, as the law is not exact.
const AIM: f64 = 0.98;
/// Spacing of the first mesh, in spacings that are expected, and at least so much, Å.
const COARSER: f64 = 2.0;
const COARSE: f64 = 1.0;

/// What to do next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Next {
    /// Make a mesh at this spacing and tell how many triangles it has.
    Try(f64),
    /// This spacing, which was tried, is it.
    Take(f64),
    /// No spacing fits: the mesh with the fewest triangles was this one.
    Refuse {
        /// Its spacing.
        resolution: f64,
        /// Its triangles.
        triangles: u64,
    },
}

/// The search: counts come in, spacings go out. Pure, so what it finds is a function of the counts.
#[derive(Debug, Clone)]
pub(super) struct Search {
    limit: u64,
    first: f64,
    /// What was tried: spacings with their triangles, none where there was no surface.
    told: Vec<(f64, Option<u64>)>,
}

impl Search {
    /// For at most `limit` triangles of so many atoms.
    pub(super) fn new(limit: u64, params: &SurfaceParams, atoms: usize) -> Self {
        let expected = Spacing::MaxTriangles(limit).expected(params, atoms as f64);
        let first = rounded((COARSER * expected).clamp(COARSE, COARSEST));
        Self { limit, first, told: Vec::new() }
    }

    /// Meshes that were made.
    pub(super) fn tries(&self) -> u32 {
        u32::try_from(self.told.len()).unwrap_or(u32::MAX)
    }

    /// Whether some mesh fitted.
    pub(super) fn fitted(&self) -> bool {
        self.fits().is_some()
    }

    /// A mesh at `spacing` had so many triangles; `None` if it had no surface.
    pub(super) fn tell(&mut self, spacing: f64, triangles: Option<u64>) {
        self.told.push((spacing, triangles));
    }

    /// What to do next.
    pub(super) fn next(&self) -> Next {
        // The last mesh may have to be made again, which is a try as well.
        let spent = self.tries() + 1 >= MOST_TRIES;
        if let Some((h, n)) = self.fits() {
            let enough = spent || h <= FINEST || n as f64 >= FULL * self.limit as f64;
            return self.finer((h, n)).filter(|_| !enough).map_or(Next::Take(h), Next::Try);
        }
        let coarsest = self.counts().max_by(|a, b| a.0.total_cmp(&b.0));
        let next = match (coarsest, self.finest_hollow(0.0)) {
            (None, None) => Some(self.first),
            (Some(exceeds), _) => self.coarser(exceeds),
            // Nothing but air so far: finer, to where there is something, or to the end.
            (None, Some(h)) => Some(rounded((0.5 * h).max(FINEST))),
        };
        if let Some(next) = next.filter(|next| !spent && self.is_new(*next)) {
            return Next::Try(next);
        }
        let (resolution, triangles) = self.counts().min_by_key(|(_, n)| *n).unwrap_or((FINEST, 0));
        Next::Refuse { resolution, triangles }
    }

    /// Spacings with their triangles.
    fn counts(&self) -> impl Iterator<Item = (f64, u64)> {
        self.told.iter().filter_map(|(h, n)| n.map(|n| (*h, n)))
    }

    /// The finest spacing that fitted, with its triangles.
    fn fits(&self) -> Option<(f64, u64)> {
        self.counts().filter(|(_, n)| *n <= self.limit).min_by(|a, b| a.0.total_cmp(&b.0))
    }

    /// The finest spacing above `floor` at which atoms fell through the grid.
    fn finest_hollow(&self, floor: f64) -> Option<f64> {
        let hollow = self.told.iter().filter(|(h, n)| n.is_none() && *h > floor);
        hollow.map(|(h, _)| *h).min_by(f64::total_cmp)
    }

    fn is_new(&self, spacing: f64) -> bool {
        self.told.iter().all(|(h, _)| h.total_cmp(&spacing).is_ne())
    }

    /// A spacing below one that fits that should fit as well, if there is one worth a try.
    fn finer(&self, (h, n): (f64, u64)) -> Option<f64> {
        let aim = AIM * self.limit as f64;
        let below = self.counts().filter(|(x, _)| *x < h).max_by(|a, b| a.0.total_cmp(&b.0));
        let guess = match below {
            None => h * (n as f64 / aim).sqrt(),
            // Between two counts the law's exponent is known.
            Some((x, m)) => {
                let part = ((aim / n as f64).ln() / (m as f64 / n as f64).ln()).clamp(0.1, 0.9);
                h * (x / h).powf(part)
            }
        };
        let guess = rounded(guess.max(FINEST));
        (guess < h && below.is_none_or(|(x, _)| guess > x) && self.is_new(guess)).then_some(guess)
    }

    /// A spacing above one that had too many triangles, below any that had no surface.
    fn coarser(&self, (x, m): (f64, u64)) -> Option<f64> {
        let ceiling = self.finest_hollow(x);
        let law = rounded(x * (m as f64 / (AIM * self.limit as f64)).sqrt()).max(rounded(1.01 * x));
        let next = match ceiling {
            Some(h) if law >= h => rounded((x * h).sqrt()),
            Some(_) => law,
            None if self.tries() >= PATIENCE => COARSEST,
            None => law.min(COARSEST),
        };
        (next > x && ceiling.is_none_or(|h| next < h)).then_some(next)
    }
}

/// To a thousandth of an ångström, up: short in keys and reports, and never finer than was meant.
fn rounded(spacing: f64) -> f64 {
    // A thousandth that floats just miss is itself.
    (spacing * 1000.0 - 1e-6).ceil() / 1000.0
}

/// A mesh whose spacing was searched for.
pub(super) struct Fitted {
    pub(super) output: MeshOutput,
    pub(super) resolution: f64,
    /// Meshes that were made.
    pub(super) tries: u32,
}

/// Meshes `spheres` as finely as `limit` triangles allow.
///
/// # Errors
/// [`SurfaceError::TooManyTriangles`] if no spacing is coarse enough; any other error of a mesh on the way, but that it has
/// no surface, unless none has.
pub(super) fn mesh(
    spheres: &Spheres,
    job: &Job,
    limit: u64,
    limits: &SurfaceLimits,
    choice: &Choice<'_>,
    clock: &StageClock<'_>,
    control: &Control<'_>,
) -> Result<Fitted, SurfaceError> {
    let mut search = Search::new(limit, &job.params, spheres.len());
    // What was made last, and who made it.
    let mut last: Option<(f64, MeshOutput)> = None;
    let mut served = None;
    let mut restarted = false;
    loop {
        let (spacing, again) = match search.next() {
            Next::Try(spacing) => (spacing, false),
            Next::Take(spacing) => match last.take().filter(|(made, _)| made.total_cmp(&spacing).is_eq()) {
                Some((resolution, meshed)) => return Ok(Fitted { output: meshed, resolution, tries: search.tries() }),
                None => (spacing, true),
            },
            Next::Refuse { resolution, triangles } => return Err(refusal(&job.params, limit, resolution, triangles)),
        };
        // One mesh at a time is held.
        last = None;
        let mut params = SurfaceParams { resolution: spacing, ..job.params.clone() };
        let _storage = super::storage(job, &mut params, spheres);
        let quiet = Quiet(clock);
        let observer: &dyn Observer = if search.tries() == 0 { &quiet } else { clock };
        let control = Control { observer, ..control.clone() };
        let made = some(clock.pass(|| choice.backend.run(spheres, &params, limits, &control)))?;
        let by = made.as_ref().map(|m| m.served.as_ref().map_or(choice.backend.name(), |s| s.backend));
        if by.is_some() && served.is_some() && by != served {
            // Another backend's counts may differ in a triangle, and the spacing with them: a result's name says one
            // backend, so all counts are to be its own.
            if std::mem::replace(&mut restarted, true) {
                return Err(SurfaceError::Device { why: "backends took turns while the spacing was searched".into() });
            }
            (search, served) = (Search::new(limit, &job.params, spheres.len()), None);
            continue;
        }
        served = by.or(served);
        let triangles = made.as_ref().map(|m| m.mesh.n_triangles() as u64);
        search.tell(spacing, triangles);
        if again {
            // The same input gives the same mesh: it fits as it did.
            let meshed = made.filter(|_| triangles.is_some_and(|n| n <= limit));
            let meshed = meshed.ok_or_else(|| SurfaceError::Device { why: "two runs gave two meshes".into() })?;
            return Ok(Fitted { output: meshed, resolution: spacing, tries: search.tries() });
        }
        last = made.map(|meshed| (spacing, meshed));
    }
}

/// The spacing that [`mesh`] would probably find: that of the first mesh that fits, refined once without looking.
///
/// # Errors
/// Those of [`mesh`].
pub(super) fn expected(
    spheres: &Spheres,
    job: &Job,
    limit: u64,
    limits: &SurfaceLimits,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> Result<f64, SurfaceError> {
    let mut search = Search::new(limit, &job.params, spheres.len());
    loop {
        match search.next() {
            Next::Try(spacing) if !search.fitted() => {
                let params = SurfaceParams { resolution: spacing, atom_ids: false, ..job.params.clone() };
                let made = some(choice.backend.run(spheres, &params, limits, control))?;
                search.tell(spacing, made.map(|m| m.mesh.n_triangles() as u64));
            }
            Next::Try(spacing) | Next::Take(spacing) => return Ok(spacing),
            Next::Refuse { resolution, triangles } => return Err(refusal(&job.params, limit, resolution, triangles)),
        }
    }
}

/// A mesh, or none where atoms fell through the grid.
fn some(made: Result<MeshOutput, SurfaceError>) -> Result<Option<MeshOutput>, SurfaceError> {
    match made {
        Err(SurfaceError::NoSurface { .. }) => Ok(None),
        made => made.map(Some),
    }
}

fn refusal(params: &SurfaceParams, limit: u64, resolution: f64, triangles: u64) -> SurfaceError {
    match triangles {
        0 => SurfaceError::NoSurface { isovalue: params.isovalue },
        _ => SurfaceError::TooManyTriangles { triangles, limit, resolution },
    }
}

/// Times stages and keeps their progress to itself: a coarse mesh that is looked at first is not how far a job is.
struct Quiet<'a>(&'a StageClock<'a>);

impl Observer for Quiet<'_> {
    fn span(&self, stage: Stage, work: &mut dyn FnMut()) {
        self.0.span(stage, work);
    }

    fn elapsed(&self, stage: Stage, ns: u64) {
        self.0.elapsed(stage, ns);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Searches for at most `limit` triangles of something that has `count` of them at a spacing: how it ends, what was tried.
    fn search(limit: u64, atoms: usize, count: impl Fn(f64) -> Option<u64>) -> (Next, Vec<f64>) {
        let mut search = Search::new(limit, &SurfaceParams::default(), atoms);
        let mut tried = Vec::new();
        loop {
            match search.next() {
                Next::Try(h) => {
                    assert!((FINEST..=COARSEST).contains(&h) && !tried.contains(&h), "{h} after {tried:?}");
                    tried.push(h);
                    search.tell(h, count(h));
                    assert!(tried.len() < MOST_TRIES as usize, "{tried:?}");
                }
                end => return (end, tried),
            }
        }
    }

    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "counts of this test are small")]
    fn law(area: f64, exponent: f64) -> impl Fn(f64) -> Option<u64> {
        move |h| Some((3.0 * area / h.powf(exponent)) as u64)
    }

    #[test]
    fn what_is_taken_fits_and_is_nearly_full_or_the_finest() {
        for exponent in [1.6, 2.0, 2.2, 2.6] {
            for area in [40.0, 3400.0, 8e4, 6e6] {
                for limit in [1000, 20_000, 333_333, 5_000_000] {
                    // As many atoms as expected, and far too many or too few.
                    for atoms in [area / 75.0, area / 7.5, area] {
                        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "as above")]
                        let (end, tried) = search(limit, atoms as usize, law(area, exponent));
                        let coarsest = law(area, exponent)(COARSEST).unwrap();
                        let said = format!("{exponent} {area} {limit} {atoms}: {end:?} of {tried:?}");
                        match end {
                            Next::Take(h) => {
                                let n = law(area, exponent)(h).unwrap();
                                assert!(n <= limit && coarsest <= limit, "{said}: {n}");
                                let full = n as f64 >= 0.9 * limit as f64;
                                assert!(full || h <= FINEST, "{said}: {n}");
                                assert!(tried.len() <= 5, "{said}");
                            }
                            Next::Refuse { resolution, triangles } => {
                                assert_eq!((resolution.to_bits(), triangles), (COARSEST.to_bits(), coarsest), "{said}");
                                assert!(coarsest > limit, "{said}");
                            }
                            Next::Try(_) => panic!("{said}"),
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn counts_that_obey_no_law_are_never_exceeded() {
        let mut bits = 1_u64;
        let mut random = || {
            bits = bits.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            bits >> 33
        };
        let (mut taken, mut refused) = (0, 0);
        for _ in 0..5000 {
            let seed = random();
            // A count that jumps, with holes, but the same at the same spacing.
            let count = |h: f64| {
                let mixed = (h.to_bits() ^ seed).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
                (!mixed.is_multiple_of(5)).then_some(mixed % 20_000)
            };
            match search(3000, 500, count).0 {
                Next::Take(h) => {
                    taken += 1;
                    assert!(count(h).is_some_and(|n| n <= 3000));
                }
                Next::Refuse { resolution, triangles } => {
                    refused += 1;
                    assert!(triangles == 0 || (count(resolution) == Some(triangles) && triangles > 3000));
                }
                Next::Try(_) => panic!("it does not end"),
            }
        }
        assert!(taken > 1000 && refused > 10, "{taken} {refused}");
    }

    #[test]
    fn where_atoms_fall_through_the_grid_it_looks_between() {
        // One atom: nothing above 1.8 Å, eight triangles at the least.
        let atom = |h: f64| (h < 1.8).then(|| law(36.0, 2.0)(h).unwrap().max(8));
        let (end, _) = search(100, 1, atom);
        assert!(matches!(end, Next::Take(h) if atom(h).unwrap() <= 100), "{end:?}");
        let (end, tried) = search(8, 1, |h| if h < 1.8 { Some(50) } else { None });
        assert!(matches!(end, Next::Refuse { triangles: 50, .. }), "{end:?} of {tried:?}");
        let (end, _) = search(100, 10, |_| None);
        assert!(matches!(end, Next::Refuse { triangles: 0, .. }), "{end:?}");
    }
}
