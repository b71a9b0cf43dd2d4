//! Search for the finest spacing whose mesh does not exceed a number of triangles.
//!
//! The number of triangles is only approximately proportional to the inverse square of the spacing: finer grids resolve
//! more of the surface, and narrow necks close or open. The search therefore computes meshes and counts their
//! triangles. The number of meshes is bounded, and the first one is coarse, so its time is short.

use std::sync::Arc;

use molmesh_structure::Context;
use molmesh_surface::{
    Control, Exceeded, Limit, MeshOutput, Observer, Reservation, Stage, SurfaceError, SurfaceParams,
};

use super::clock::WorkScope;
use super::meshing::Meshing;
use super::spacing::{COARSEST, FINEST, Spacing};
use super::{JobMesh, Options};

/// Maximum number of meshes, including the first coarse one and a repetition of the best one.
const MAX_TRIES: u32 = 8;
/// Number of tries after which the coarsest spacing is tried if no mesh has fitted.
const TRIES_BEFORE_COARSEST: u32 = 4;
/// Fraction of the limit from which a mesh is fine enough.
const FULL: f64 = 0.95;
/// Target of the search as a fraction of the limit. It is below 1 because the power law is not exact.
const AIM: f64 = 0.98;
/// Spacing of a first, coarse mesh as a multiple of the expected spacing.
pub(super) const COARSE_FACTOR: f64 = 2.0;
/// Minimum spacing of a first, coarse mesh, Å.
pub(super) const MIN_COARSE_SPACING: f64 = 1.0;

/// Next step of the search.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Next {
    /// Mesh at this spacing and record the number of triangles.
    Try(f64),
    /// Use this spacing, which was tried.
    Use(f64),
    /// No spacing fits. The fields describe the mesh with the fewest triangles.
    Fail {
        /// Spacing, Å.
        resolution: f64,
        /// Number of triangles.
        triangles: u64,
    },
}

/// State of a search. It is pure, so the result depends only on the counts.
#[derive(Debug, Clone)]
pub(super) struct Search {
    limit: u64,
    first: f64,
    /// Spacings that were tried, Å, with their triangles; `None` if there was no surface.
    tried: Vec<(f64, Option<u64>)>,
}

impl Search {
    /// Creates a search for at most `limit` triangles.
    pub(super) fn new(limit: u64, params: &SurfaceParams, atoms: usize) -> Self {
        let expected = Spacing::MaxTriangles(limit).expected(params, atoms as f64);
        let first = rounded((COARSE_FACTOR * expected).clamp(MIN_COARSE_SPACING, COARSEST));
        Self { limit, first, tried: Vec::new() }
    }

    /// Returns the number of computed meshes.
    pub(super) fn tries(&self) -> u32 {
        u32::try_from(self.tried.len()).unwrap_or(u32::MAX)
    }

    /// Returns true if any mesh fitted.
    pub(super) fn has_fit(&self) -> bool {
        self.fits().is_some()
    }

    /// Records the number of triangles at `spacing`; `None` if there was no surface.
    pub(super) fn record(&mut self, spacing: f64, triangles: Option<u64>) {
        self.tried.push((spacing, triangles));
    }

    /// Returns the next step.
    pub(super) fn next(&self) -> Next {
        // The best mesh may have to be computed again, which counts as a try.
        let spent = self.tries() + 1 >= MAX_TRIES;
        if let Some((h, n)) = self.fits() {
            let enough = spent || h <= FINEST || n as f64 >= FULL * self.limit as f64;
            return self.finer((h, n)).filter(|_| !enough).map_or(Next::Use(h), Next::Try);
        }
        let coarsest = self.counts().max_by(|a, b| a.0.total_cmp(&b.0));
        let next = match (coarsest, self.finest_empty(0.0)) {
            (None, None) => Some(self.first),
            (Some(exceeds), _) => self.coarser(exceeds),
            // No surface yet: try finer spacings.
            (None, Some(h)) => Some(rounded((0.5 * h).max(FINEST))),
        };
        if let Some(next) = next.filter(|next| !spent && self.is_new(*next)) {
            return Next::Try(next);
        }
        let (resolution, triangles) = self.counts().min_by_key(|(_, n)| *n).unwrap_or((FINEST, 0));
        Next::Fail { resolution, triangles }
    }

    /// Returns the spacings that had a surface, with their triangles.
    fn counts(&self) -> impl Iterator<Item = (f64, u64)> {
        self.tried.iter().filter_map(|(h, n)| n.map(|n| (*h, n)))
    }

    /// Returns the finest spacing that fitted, with its triangles.
    fn fits(&self) -> Option<(f64, u64)> {
        self.counts().filter(|(_, n)| *n <= self.limit).min_by(|a, b| a.0.total_cmp(&b.0))
    }

    /// Returns the finest spacing above `floor` that had no surface.
    fn finest_empty(&self, floor: f64) -> Option<f64> {
        let empty = self.tried.iter().filter(|(h, n)| n.is_none() && *h > floor);
        empty.map(|(h, _)| *h).min_by(f64::total_cmp)
    }

    fn is_new(&self, spacing: f64) -> bool {
        self.tried.iter().all(|(h, _)| h.total_cmp(&spacing).is_ne())
    }

    /// Returns a finer spacing than one that fits, if another one is likely to fit.
    fn finer(&self, (h, n): (f64, u64)) -> Option<f64> {
        let aim = AIM * self.limit as f64;
        let below = self.counts().filter(|(x, _)| *x < h).max_by(|a, b| a.0.total_cmp(&b.0));
        let guess = match below {
            None => h * (n as f64 / aim).sqrt(),
            // Two counts determine the exponent of the power law.
            Some((x, m)) => {
                let part = ((aim / n as f64).ln() / (m as f64 / n as f64).ln()).clamp(0.1, 0.9);
                h * (x / h).powf(part)
            }
        };
        let guess = rounded(guess.max(FINEST));
        (guess < h && below.is_none_or(|(x, _)| guess > x) && self.is_new(guess)).then_some(guess)
    }

    /// Returns a coarser spacing than one with too many triangles, below any without a surface.
    fn coarser(&self, (x, m): (f64, u64)) -> Option<f64> {
        let ceiling = self.finest_empty(x);
        let law = rounded(x * (m as f64 / (AIM * self.limit as f64)).sqrt()).max(rounded(1.01 * x));
        let next = match ceiling {
            Some(h) if law >= h => rounded((x * h).sqrt()),
            Some(_) => law,
            None if self.tries() >= TRIES_BEFORE_COARSEST => COARSEST,
            None => law.min(COARSEST),
        };
        (next > x && ceiling.is_none_or(|h| next < h)).then_some(next)
    }
}

/// Rounds up to a thousandth of an ångström, which keeps keys and reports short.
fn rounded(spacing: f64) -> f64 {
    // Tolerate rounding errors of exact thousandths.
    (spacing * 1000.0 - 1e-6).ceil() / 1000.0
}

/// Meshes the spheres of `meshing` at the finest spacing that has at most `limit` triangles.
///
/// # Errors
/// Returns [`SurfaceError::Limit`] if no spacing is coarse enough, [`SurfaceError::NoSurface`] if no mesh has a
/// surface, or another error of meshing.
pub(super) fn mesh(
    meshing: &Meshing<'_>,
    options: &Options,
    limit: u64,
    WorkScope { clock, control }: &WorkScope<'_>,
) -> Result<JobMesh, SurfaceError> {
    let n_atoms = meshing.spheres.len();
    let mut search = Search::new(limit, &options.params, n_atoms);
    // The last mesh with its memory.
    let mut last: Option<(JobMesh, Arc<Reservation>)> = None;
    // Name of the backend that computed the meshes.
    let mut made_by = None;
    let mut restarted = false;
    loop {
        let (spacing, again) = match search.next() {
            Next::Try(spacing) => (spacing, false),
            Next::Use(spacing) => {
                match last.take().filter(|(mesh, _)| mesh.params.resolution.total_cmp(&spacing).is_eq()) {
                    Some((mesh, memory)) => {
                        memory.keep();
                        return Ok(mesh);
                    }
                    None => (spacing, true),
                }
            }
            Next::Fail { resolution, triangles } => return Err(no_fit(options, limit, resolution, triangles)),
        };
        // Hold only one mesh at a time.
        last = None;
        let params = options.mesh_params(meshing.spheres, Some(spacing));
        let without_progress = WithoutProgress(*clock);
        let observer: &dyn Observer = if search.tries() == 0 { &without_progress } else { *clock };
        let (metered, memory) = control.with_reservation();
        let control = Control { observer, ..metered };
        let output = unless_empty(clock.pass(|| meshing.mesh(&params, &control)))?;
        let by = output.as_ref().and_then(|output| output.made_by.as_ref()).map(|identity| identity.backend);
        if by.is_some() && made_by.is_some() && by != made_by {
            // The counts of different backends, and therefore the spacing, may differ slightly. The content key names
            // one backend, so all counts must come from it.
            if std::mem::replace(&mut restarted, true) {
                return Err(SurfaceError::Device {
                    why: "different backends ran during the search for the grid spacing".into(),
                });
            }
            (search, made_by) = (Search::new(limit, &options.params, n_atoms), None);
            continue;
        }
        made_by = by.or(made_by);
        let triangles = output.as_ref().map(|output| output.mesh.n_triangles() as u64);
        search.record(spacing, triangles);
        let mesh = output.map(|output| JobMesh { output, params, tries: Some(search.tries()) });
        if again {
            // The same input gives the same mesh, so it fits again.
            let mesh = mesh.filter(|_| triangles.is_some_and(|n| n <= limit));
            let mesh = mesh.ok_or_else(|| SurfaceError::Device {
                why: "two runs on the same input returned different meshes".into(),
            })?;
            memory.keep();
            return Ok(mesh);
        }
        last = mesh.map(|mesh| (mesh, memory));
    }
}

/// Returns the spacing that [`mesh`] would probably find: the first one that fits, refined once without a mesh.
///
/// # Errors
/// Returns the errors of [`mesh`].
pub(super) fn expected(
    meshing: &Meshing<'_>,
    options: &Options,
    limit: u64,
    control: &Control<'_>,
) -> Result<f64, SurfaceError> {
    let mut search = Search::new(limit, &options.params, meshing.spheres.len());
    loop {
        match search.next() {
            Next::Try(spacing) if !search.has_fit() => {
                let params = SurfaceParams { resolution: spacing, atom_ids: false, ..options.params.clone() };
                let made = unless_empty(meshing.mesh(&params, control))?;
                search.record(spacing, made.map(|m| m.mesh.n_triangles() as u64));
            }
            Next::Try(spacing) | Next::Use(spacing) => return Ok(spacing),
            Next::Fail { resolution, triangles } => return Err(no_fit(options, limit, resolution, triangles)),
        }
    }
}

/// Converts [`SurfaceError::NoSurface`] and [`SurfaceError::NoPatch`] to `None`.
fn unless_empty(made: Result<MeshOutput, SurfaceError>) -> Result<Option<MeshOutput>, SurfaceError> {
    match made {
        Err(SurfaceError::NoSurface { .. } | SurfaceError::NoPatch) => Ok(None),
        made => made.map(Some),
    }
}

/// Returns the error for a search without a result.
fn no_fit(options: &Options, limit: u64, resolution: f64, triangles: u64) -> SurfaceError {
    match triangles {
        0 if options.selection.context == Context::Whole => SurfaceError::NoPatch,
        0 => SurfaceError::NoSurface { isovalue: options.params.level() },
        _ => {
            let subject = "at the coarsest spacing, the mesh".into();
            let error = Exceeded { subject, actual: Some(triangles), ..Exceeded::new(Limit::Triangles, limit) };
            Exceeded { resolution: Some(resolution), ..error }.error()
        }
    }
}

/// Observer that times stages but hides their progress: a first, coarse mesh does not advance the job, and a part
/// advances it only when it is complete.
pub(super) struct WithoutProgress<'a>(pub(super) &'a dyn Observer);

impl Observer for WithoutProgress<'_> {
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

    /// Searches with the triangle counts of `count`. Returns the last step and the spacings that were tried.
    fn search(limit: u64, atoms: usize, count: impl Fn(f64) -> Option<u64>) -> (Next, Vec<f64>) {
        let mut search = Search::new(limit, &SurfaceParams::default(), atoms);
        let mut tried = Vec::new();
        loop {
            match search.next() {
                Next::Try(h) => {
                    assert!((FINEST..=COARSEST).contains(&h) && !tried.contains(&h), "{h} after {tried:?}");
                    tried.push(h);
                    search.record(h, count(h));
                    assert!(tried.len() < MAX_TRIES as usize, "{tried:?}");
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
    fn results_fit_and_use_most_of_the_limit_or_the_finest_spacing() {
        for exponent in [1.6, 2.0, 2.2, 2.6] {
            for area in [40.0, 3400.0, 8e4, 6e6] {
                for limit in [1000, 20_000, 333_333, 5_000_000] {
                    // The expected number of atoms, and far too many or too few.
                    for atoms in [area / 75.0, area / 7.5, area] {
                        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "as above")]
                        let (end, tried) = search(limit, atoms as usize, law(area, exponent));
                        let coarsest = law(area, exponent)(COARSEST).unwrap();
                        let said = format!("{exponent} {area} {limit} {atoms}: {end:?} of {tried:?}");
                        match end {
                            Next::Use(h) => {
                                let n = law(area, exponent)(h).unwrap();
                                assert!(n <= limit && coarsest <= limit, "{said}: {n}");
                                let full = n as f64 >= 0.9 * limit as f64;
                                assert!(full || h <= FINEST, "{said}: {n}");
                                assert!(tried.len() <= 5, "{said}");
                            }
                            Next::Fail { resolution, triangles } => {
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
    fn irregular_counts_never_exceed_the_limit() {
        let mut bits = 1_u64;
        let mut random = || {
            bits = bits.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            bits >> 33
        };
        let (mut taken, mut refused) = (0, 0);
        for _ in 0..5000 {
            let seed = random();
            // Irregular counts, sometimes without a surface, but constant for a spacing.
            let count = |h: f64| {
                let mixed = (h.to_bits() ^ seed).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
                (!mixed.is_multiple_of(5)).then_some(mixed % 20_000)
            };
            match search(3000, 500, count).0 {
                Next::Use(h) => {
                    taken += 1;
                    assert!(count(h).is_some_and(|n| n <= 3000));
                }
                Next::Fail { resolution, triangles } => {
                    refused += 1;
                    assert!(triangles == 0 || (count(resolution) == Some(triangles) && triangles > 3000));
                }
                Next::Try(_) => panic!("the search does not end"),
            }
        }
        assert!(taken > 1000 && refused > 10, "{taken} {refused}");
    }

    #[test]
    fn spacings_without_a_surface_bound_the_search() {
        // One atom: no surface above 1.8 Å, and at least eight triangles.
        let atom = |h: f64| (h < 1.8).then(|| law(36.0, 2.0)(h).unwrap().max(8));
        let (end, _) = search(100, 1, atom);
        assert!(matches!(end, Next::Use(h) if atom(h).unwrap() <= 100), "{end:?}");
        let (end, tried) = search(8, 1, |h| if h < 1.8 { Some(50) } else { None });
        assert!(matches!(end, Next::Fail { triangles: 50, .. }), "{end:?} of {tried:?}");
        let (end, _) = search(100, 10, |_| None);
        assert!(matches!(end, Next::Fail { triangles: 0, .. }), "{end:?}");
    }
}
