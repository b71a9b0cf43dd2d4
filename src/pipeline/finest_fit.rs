//! Search for the finest grid spacing that fits all limits: the suggestion of an error about a size.
//!
//! Grids are planned, not meshed. The search interpolates between a spacing that exceeds a limit and one that fits. If
//! there are many spheres, a sample of them is searched first, and then few grids of all spheres are planned.

use super::estimate::{MeshPlan, ends_work, n_vertices};
use super::{Choice, SPHERE_BYTES, parts};
use crate::surface::cpu::{LATTICE_BYTES, check_work};
use crate::surface::lattice::{Lattice, is_certain_to_have_surface, slightly_coarser, to_u64};
use crate::surface::occupancy::{Excess, try_count};
use crate::surface::params::MAX_RESOLUTION;
use crate::surface::{Control, Spheres, SurfaceError, SurfaceLimits, SurfaceParams, candidates};

/// Maximum number of grids that are planned.
const MAX_PLANS: usize = 10;
/// Number of grids after which the coarsest one is planned if none has fitted.
const PLANS_BEFORE_COARSEST: usize = 6;
/// Cost of all plans above which the first spacing that fits is taken: about half a second of one core.
const MAX_COST: f64 = 1.2e6;
/// Pairs of a sphere and a brick that cost as much as placing a sphere on the lattice.
const PAIRS_PER_SPHERE: f64 = 16.0;
/// Minimum load at which a spacing that fits is fine enough.
const FULL: f64 = 0.95;
/// Target load of the search. It is below 1 because the load does not follow a power law exactly.
const AIM: f64 = 0.97;
/// Ratio of a spacing that fits and one that does not, at which the search ends.
const CLOSE: f64 = 1.02;
/// Maximum number of spheres that are searched without a sample.
const MAX_UNSAMPLED: usize = 1 << 16;
/// Runs of consecutive spheres that make a sample, and their length. Neighbours in a file are neighbours in space, and
/// share bricks.
const SAMPLE_RUNS: usize = 8;
const SAMPLE_RUN: usize = 1 << 12;
/// Margin of a spacing that was found with a sample.
const SAMPLE_MARGIN: f64 = 1.03;
/// Spacing of the mesh that gives the area, as a multiple of the suggested spacing.
const AREA_SPACING_FACTOR: f64 = 4.0;
/// Maximum number of spheres for which a coarse mesh gives the area. Above, the sum of the areas of the spheres is
/// used.
const MAX_MESHED_SPHERES: usize = 300_000;
/// Margin of the estimated size of a mesh that must fit.
const SIZE_MARGIN: f64 = 1.3;
/// Factor of the spacing if the grid fits but the boundary of the spheres does not, and the number of such steps.
const COARSER: f64 = 1.25;
const COARSER_STEPS: usize = 3;

/// Replaces the suggested spacing of an error about a size with the finest one, to about 2 %, that fits all limits and
/// is certain to have a surface. Suggests nothing if none is found.
pub(super) fn with_finest_fit(
    mut error: SurfaceError,
    plan: &MeshPlan<'_>,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> SurfaceError {
    use SurfaceError as E;
    let found = match &error {
        E::GridTooLarge { resolution, .. } | E::TooManyCandidates { resolution, .. } => {
            finest_grid(*resolution, error.suggested_resolution(), plan, control)
        }
        E::MeshTooLarge { .. } | E::DeviceMemory { .. } => Ok(error.suggested_resolution()),
        _ => return error,
    };
    let fits = match found.and_then(|found| fitting(found, plan, choice, control)) {
        Ok(fits) => fits,
        Err(ends) => return ends,
    };
    match &mut error {
        E::GridTooLarge { suggested_resolution, .. }
        | E::MeshTooLarge { suggested_resolution, .. }
        | E::DeviceMemory { suggested_resolution, .. } => *suggested_resolution = fits.unwrap_or(f64::INFINITY),
        E::TooManyCandidates { suggested_resolution, .. } => *suggested_resolution = fits,
        _ => {}
    }
    error
}

/// Returns the finest spacing above `resolution` whose planned grid fits. A backend may need more than the plan; its
/// `own` suggestion applies if the plan fits at `resolution`.
fn finest_grid(
    resolution: f64,
    own: Option<f64>,
    plan: &MeshPlan<'_>,
    control: &Control<'_>,
) -> Result<Option<f64>, SurfaceError> {
    let n = plan.spheres.len();
    // The spheres of one part, or of the sample.
    let _spheres =
        control.reserve(SPHERE_BYTES * if plan.parts.is_some() { n } else { n.min(MAX_UNSAMPLED) } as u64)?;
    let mut search = Search::default();
    let first = if n > MAX_UNSAMPLED {
        let sample = sample(plan.spheres);
        let part = |limit: u64| to_u64(limit as f64 * (sample.len() as f64 / n as f64)).max(512);
        let limits = SurfaceLimits {
            max_grid_points: part(plan.limits.max_grid_points),
            max_candidates: part(plan.limits.max_candidates),
            ..*plan.limits
        };
        let mut of_sample = Search::default();
        let sampled = MeshPlan { spheres: &sample, parts: None, limits: &limits, ..*plan };
        of_sample.run(resolution, &sampled, control)?;
        search.exceeds = of_sample.exceeds.first().copied().into_iter().collect();
        let found = of_sample.fits.map(|(spacing, _)| spacing).filter(|spacing| *spacing > resolution);
        found.map_or(resolution, |spacing| hundredths(SAMPLE_MARGIN * spacing).min(MAX_RESOLUTION))
    } else {
        resolution
    };
    search.run(first, plan, control)?;
    Ok(match search.fits {
        Some((spacing, _)) if spacing <= resolution => own.filter(|own| *own > resolution),
        Some((spacing, _)) => Some(spacing),
        None => None,
    })
}

/// Returns the spheres of [`SAMPLE_RUNS`] runs at equal distances.
fn sample(spheres: &Spheres) -> Spheres {
    let rows = (0..SAMPLE_RUNS).flat_map(|run| {
        let start = (spheres.len() - SAMPLE_RUN) / (SAMPLE_RUNS - 1) * run;
        start..start + SAMPLE_RUN
    });
    let rows: Vec<u32> = rows.filter_map(|row| u32::try_from(row).ok()).collect();
    spheres.subset(&rows)
}

/// State of a search. A load is the larger ratio of grid points or pairs to their limit.
#[derive(Debug, Default)]
struct Search {
    /// Spacings that exceed a limit (Å) with their loads, in the order of their plans.
    exceeds: Vec<(f64, f64)>,
    /// Finest spacing that fits, Å, with its load.
    fits: Option<(f64, f64)>,
    cost: f64,
}

impl Search {
    /// Plans grids from `first` on until the finest spacing is found.
    fn run(&mut self, first: f64, plan: &MeshPlan<'_>, control: &Control<'_>) -> Result<(), SurfaceError> {
        let mut next = Some(first);
        for _ in 0..MAX_PLANS {
            let Some(spacing) = next else { break };
            let (load, cost) = plan.load(spacing, control)?;
            self.cost += cost;
            if load <= 1.0 {
                self.fits = Some((spacing, load));
            } else {
                self.exceeds.push((spacing, load));
            }
            next = self.next();
        }
        Ok(())
    }

    /// Returns the next spacing to plan.
    fn next(&self) -> Option<f64> {
        let exceeds = self.exceeds.iter().copied().max_by(|a, b| a.0.total_cmp(&b.0));
        match (exceeds, self.fits) {
            // The first spacing fits.
            (None, _) => None,
            (Some((exceeds, load)), Some((fits, low))) => {
                let enough = low >= FULL || fits <= CLOSE * exceeds || self.cost > MAX_COST;
                // Bounded, because the load does not follow a power law exactly.
                let part = ((AIM / low).ln() / (load / low).ln()).clamp(0.1, 0.9);
                let finer = hundredths(fits * (exceeds / fits).powf(part));
                (!enough && finer < fits && finer > exceeds).then_some(finer)
            }
            (Some((spacing, _)), None) if spacing >= MAX_RESOLUTION => None,
            (Some(_), None) if self.exceeds.len() >= PLANS_BEFORE_COARSEST => Some(MAX_RESOLUTION),
            (Some((spacing, load)), None) => {
                let before = self.exceeds.iter().copied().filter(|(h, _)| *h < spacing);
                let before = before.max_by(|a, b| a.0.total_cmp(&b.0));
                // The volume that bricks cover grows with their size, so the load decreases with less than the cube.
                let exponent = before.map_or(3.0, |(h, more)| (more / load).ln() / (spacing / h).ln()).clamp(0.5, 3.0);
                let coarser = spacing * (load / AIM).powf(exponent.recip()).clamp(CLOSE, 8.0);
                Some(hundredths(coarser).min(MAX_RESOLUTION))
            }
        }
    }
}

/// Rounds a spacing up to hundredths of an Å.
fn hundredths(spacing: f64) -> f64 {
    // Tolerate rounding errors of exact hundredths.
    (spacing * 100.0 - 1e-6).ceil() / 100.0
}

impl MeshPlan<'_> {
    /// Plans the grid at a spacing. Returns its load, which is an estimate above 1, and the cost of the plan.
    fn load(&self, resolution: f64, control: &Control<'_>) -> Result<(f64, f64), SurfaceError> {
        let (params, limits) = (SurfaceParams { resolution, ..self.params.clone() }, self.limits);
        let load = |points: f64, pairs: f64| {
            (points / limits.max_grid_points as f64).max(pairs / candidates::limit(limits) as f64)
        };
        let (mut points, mut pairs, mut n_atoms) = (0.0, 0.0, 0);
        for own in parts::spheres_of(self.spheres, self.parts) {
            n_atoms += own.len();
            let counted = candidates::check(&own, &params, limits).and_then(|()| {
                let _lattice = control.reserve(LATTICE_BYTES * own.len() as u64)?;
                try_count(&Lattice::new(&own, &params, control)?, limits, control)
            });
            match counted {
                Ok(Ok(counts)) => {
                    points += (512 * counts.reached) as f64;
                    pairs += counts.candidates as f64;
                }
                Ok(Err(Excess::GridPoints(all))) => points += all as f64,
                Ok(Err(Excess::Pairs { all, .. })) | Err(SurfaceError::TooManyCandidates { candidates: all, .. }) => {
                    pairs += all as f64;
                }
                Err(error) if ends_work(&error) => return Err(error),
                // The lists of a plan need more memory than there is; those of a coarser one need less.
                Err(_) => return Ok((2.0, n_atoms as f64)),
            }
            let so_far = load(points, pairs);
            if so_far > 1.0 {
                let all = so_far * (self.spheres.len() as f64 / n_atoms as f64);
                return Ok((all, n_atoms as f64 + pairs / PAIRS_PER_SPHERE));
            }
        }
        Ok((load(points, pairs), n_atoms as f64 + pairs / PAIRS_PER_SPHERE))
    }
}

/// Returns `spacing`, or a coarser one, if boundary and mesh fit their limits there and there is a surface.
fn fitting(
    spacing: Option<f64>,
    plan: &MeshPlan<'_>,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> Result<Option<f64>, SurfaceError> {
    let Some(spacing) = spacing else { return Ok(None) };
    let Some(spacing) = with_fitting_boundary(spacing, plan, control)? else { return Ok(None) };
    let spacing = with_fitting_mesh(spacing, plan, choice, control)?;
    let params = SurfaceParams { resolution: spacing, ..plan.params.clone() };
    Ok((spacing <= MAX_RESOLUTION && is_certain_to_have_surface(plan.spheres, &params)).then_some(spacing))
}

/// Returns `spacing`, or a slightly coarser one, if the boundary of a union of spheres fits there. Grids of other
/// surfaces have no boundary.
fn with_fitting_boundary(
    mut spacing: f64,
    plan: &MeshPlan<'_>,
    control: &Control<'_>,
) -> Result<Option<f64>, SurfaceError> {
    if plan.params.level().is_some() {
        return Ok(Some(spacing));
    }
    for _ in 0..COARSER_STEPS {
        let params = SurfaceParams { resolution: spacing, ..plan.params.clone() };
        let checked = parts::spheres_of(plan.spheres, plan.parts).try_for_each(|own| {
            let _lattice = control.reserve(LATTICE_BYTES * own.len() as u64)?;
            check_work(&Lattice::new(&own, &params, control)?, &params, plan.limits, control).map(drop)
        });
        match checked {
            Ok(()) => return Ok(Some(spacing)),
            Err(error) if ends_work(&error) => return Err(error),
            // The number of overlaps does not depend on the spacing.
            Err(SurfaceError::TooManyOverlaps { .. }) => break,
            Err(_) => spacing = hundredths(COARSER * spacing).min(MAX_RESOLUTION),
        }
    }
    Ok(None)
}

/// Returns `spacing`, or a coarser one at which the mesh fits its limits as well.
fn with_fitting_mesh(
    spacing: f64,
    plan: &MeshPlan<'_>,
    choice: &Choice<'_>,
    control: &Control<'_>,
) -> Result<f64, SurfaceError> {
    let (params, limits) = (plan.params, plan.limits);
    // Ratio of the size of a mesh to the limit that it exceeds most.
    let excess = |area: f64| {
        let vertices = n_vertices(area, spacing);
        let bytes = params.mesh_bytes(vertices, vertices.saturating_mul(2));
        let with_attributes = bytes.saturating_add(plan.attribute_bytes.saturating_mul(vertices));
        let of_mesh = bytes as f64 / limits.max_mesh_bytes.max(1) as f64;
        let held = with_attributes.saturating_add(plan.compressed_bytes(vertices)) as f64
            / control.memory.available().max(1) as f64;
        of_mesh.max(held).max(with_attributes as f64 / plan.max_file_bytes.max(1) as f64)
    };
    let most = plan.spheres.area(params);
    if excess(most) <= 1.0 {
        return Ok(spacing);
    }
    let area = if plan.spheres.len() <= MAX_MESHED_SPHERES {
        let coarse = MeshPlan { params: &SurfaceParams { resolution: spacing, ..params.clone() }, ..*plan };
        match coarse.areas(AREA_SPACING_FACTOR * spacing, choice, control) {
            Ok([whole, _]) => most.min(SIZE_MARGIN * whole),
            Err(error) if ends_work(&error) => return Err(error),
            Err(_) => most,
        }
    } else {
        most
    };
    let excess = excess(area);
    Ok(if excess <= 1.0 { spacing } else { slightly_coarser(spacing * excess.sqrt()) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{Job, JobLimits, params};
    use crate::surface::{Backend, CpuBackend};

    fn job(pairs: &[(&str, &str)]) -> Job {
        params::parse(pairs.iter().copied()).unwrap().job
    }

    /// Runs a job on spheres. Returns the error with the spacing that it suggests.
    fn refused(spheres: &Spheres, job: &Job, limits: &JobLimits) -> Option<(SurfaceError, Option<f64>)> {
        let (backend, control) = (CpuBackend::new(Some(2)).unwrap(), Control::default());
        let error = backend.run(spheres, &job.params, &limits.surface, &control).err()?;
        let plan = MeshPlan::new(spheres, None, &job.params, job, limits);
        let error = with_finest_fit(error, &plan, &Choice { backend: &backend, reason: "" }, &control);
        let suggested = error.suggested_resolution();
        Some((error, suggested))
    }

    /// Returns an error's suggestion and the error at this spacing.
    fn suggestion(spheres: &Spheres, job: &Job, limits: &JobLimits) -> Option<(f64, Option<SurfaceError>)> {
        let (_, suggested) = refused(spheres, job, limits).unwrap();
        let again = |resolution| {
            let params = SurfaceParams { resolution, ..job.params.clone() };
            refused(spheres, &Job { params, ..job.clone() }, limits).map(|(error, _)| error)
        };
        suggested.map(|spacing| (spacing, again(spacing)))
    }

    fn spheres(n: usize, at: impl Fn(usize) -> [f64; 3]) -> Spheres {
        let column = |k: usize| (0..n).map(|i| at(i)[k]).collect();
        Spheres::new(column(0), column(1), column(2), vec![1.7; n]).unwrap()
    }

    #[test]
    fn a_spacing_for_many_sparse_spheres_is_found_with_few_plans() {
        // As many, relative to the limit, as a million spheres at the default limit.
        let n = 70_000;
        let at = |i: usize| [i % 40, i / 40 % 40, i / 1600].map(|k| 64.0 * k as f64);
        let (spheres, job) = (spheres(n, at), Job::default());
        let limits = JobLimits {
            surface: SurfaceLimits { max_grid_points: 75_000_000, ..SurfaceLimits::default() },
            ..JobLimits::default()
        };
        let plan = MeshPlan::new(&spheres, None, &job.params, &job, &limits);
        let control = Control::default();
        let spacing = finest_grid(0.5, None, &plan, &control).unwrap().unwrap();
        let load = |spacing| plan.load(spacing, &control).unwrap().0;
        assert!(load(spacing) <= 1.0 && load(0.9 * spacing) > 1.0, "{spacing}: {}", load(spacing));
        let mut search = Search::default();
        search.run(spacing, &plan, &control).unwrap();
        assert!(search.exceeds.is_empty() && search.fits.is_some(), "one plan confirms the sample");
    }

    #[test]
    fn loads_of_any_power_law_are_searched() {
        for exponent in [0.6, 1.0, 2.0, 3.0] {
            for excess in [1.001, 1.3, 20.0, 4000.0] {
                let load = |h: f64| excess * (h / 0.2_f64).powf(-exponent);
                let mut search = Search::default();
                let mut next = Some(0.2);
                for _ in 0..MAX_PLANS {
                    let Some(h) = next else { break };
                    if load(h) <= 1.0 {
                        search.fits = Some((h, load(h)));
                    } else {
                        search.exceeds.push((h, load(h)));
                    }
                    next = search.next();
                }
                match search.fits {
                    Some((h, low)) => assert!(low > 0.85 || load(h - 0.011) > 1.0, "{exponent} {excess}: {h} {low}"),
                    None => assert!(load(MAX_RESOLUTION) > 1.0, "{exponent} {excess}"),
                }
            }
        }
    }

    #[test]
    fn a_spacing_without_a_surface_is_not_suggested() {
        let (job, mut counts) = (job(&[("resolution", "0.5")]), [0, 0]);
        let limits = JobLimits {
            surface: SurfaceLimits { max_mesh_bytes: 150, ..SurfaceLimits::default() },
            ..JobLimits::default()
        };
        for step in 0..12 {
            let one = spheres(1, |_| [0.4 * f64::from(step); 3]);
            match suggestion(&one, &job, &limits) {
                Some((_, again)) => {
                    assert!(!matches!(again, Some(SurfaceError::NoSurface { .. })), "{again:?}");
                    counts[0] += 1;
                }
                None => counts[1] += 1,
            }
        }
        assert!(counts.iter().all(|count| *count > 0), "{counts:?}");
        // Control: between grid points there is no surface.
        let at = |c| spheres(1, |_| [c; 3]);
        let params = SurfaceParams { resolution: 4.0, ..SurfaceParams::default() };
        let run = |c| CpuBackend::default().run(&at(c), &params, &SurfaceLimits::default(), &Control::default());
        assert!(is_certain_to_have_surface(&at(4.5), &params) && run(4.5).is_ok());
        assert!(!is_certain_to_have_surface(&at(6.0), &params));
        assert!(matches!(run(6.0), Err(SurfaceError::NoSurface { .. })));
    }

    #[test]
    fn the_boundary_of_spheres_must_fit_as_well() {
        let cloud = spheres(60, |i| [i % 4, i / 4 % 4, i / 16].map(|k| 2.0 * k as f64));
        let limited = |max_candidates| JobLimits {
            surface: SurfaceLimits { max_candidates, ..SurfaceLimits::default() },
            ..JobLimits::default()
        };
        let job = job(&[("surface", "ses"), ("resolution", "0.05")]);
        // The pairs of overlapping spheres do not depend on the spacing, so nothing fits the lowest limit.
        assert!(suggestion(&cloud, &job, &limited(300)).is_none());
        let found = [3_000, 10_000, 30_000, 90_000].map(|limit| suggestion(&cloud, &job, &limited(limit)));
        assert!(found.iter().flatten().all(|(_, again)| again.is_none()), "{found:?}");
        assert!(found.iter().flatten().count() >= 2, "{found:?}");
    }

    #[test]
    fn the_file_at_the_suggested_spacing_is_within_its_limit() {
        let cloud = spheres(200, |i| [i % 6, i / 6 % 6, i / 36].map(|k| 2.5 * k as f64));
        let limited = |max_file_bytes| JobLimits {
            surface: SurfaceLimits { max_grid_points: 100_000, ..SurfaceLimits::default() },
            max_file_bytes,
            ..JobLimits::default()
        };
        let bytes = |limits: &JobLimits, job: &Job| {
            let (spacing, again) = suggestion(&cloud, job, limits).unwrap();
            assert_eq!(again, None);
            let params = SurfaceParams { resolution: spacing, ..job.params.clone() };
            let run = CpuBackend::default().run(&cloud, &params, &limits.surface, &Control::default());
            let mesh = run.unwrap().mesh;
            mesh.bytes() + job.attribute_bytes() * mesh.n_vertices() as u64
        };
        for job in [job(&[("resolution", "0.1")]), job(&[("resolution", "0.1"), ("color", "element")])] {
            let unlimited = bytes(&limited(u64::MAX), &job);
            let limit = unlimited / 3;
            let found = bytes(&limited(limit), &job);
            assert!(found <= limit && found > limit / 4, "{found} {limit}");
            assert!(unlimited > limit, "the control");
        }
    }
}
