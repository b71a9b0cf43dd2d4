//! Time and memory against atoms, for each program up to its limit.

use std::time::Instant;

use molmesh::surface::{Spheres, SurfaceOptions, SurfaceParams, reference};

use super::Plan;
use super::programs::{Program, Runner, reference_estimate, timed};
use super::result::{Growth, Point, Series, Timed};
use crate::error::{Error, Result};
use crate::{note, structures};

/// Numbers of atoms.
const SIZES: [usize; 10] = [100, 300, 1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000];
/// Approximate maximum time of the measured runs of one size, s. A single run may take longer.
const TIME_PER_SIZE: f64 = 4.0;

/// Measures all programs up to `max_atoms` atoms, and passes the results to `done` after each size.
///
/// # Errors
/// Returns an [`Error`] if a program cannot be started, or an error of `done`.
pub(super) fn measure(plan: &Plan, max_atoms: usize, done: &mut dyn FnMut(&Growth) -> Result<()>) -> Result<()> {
    let options = SurfaceOptions { resolution: Some(plan.growth_spacing), ..SurfaceOptions::default() };
    let params = SurfaceParams::new(&options).map_err(|e| Error::Usage(e.to_string()))?;
    let structure = "the built-in 4PTI, tiled; default surface".to_owned();
    let mut growth = Growth { structure, spacing: params.resolution, series: Vec::new() };
    for program in Program::ALL.into_iter().filter(|program| plan.programs.contains(program)) {
        let (mut runner, ends) = match plan.open(program)? {
            Ok(runner) => (Some(runner), None),
            Err(why) => (None, Some(why)),
        };
        let at = growth.series.len();
        growth.series.push(Series { program: program.name().to_owned(), points: Vec::new(), ends });
        for n in SIZES.into_iter().filter(|n| *n <= max_atoms) {
            let Some(runner) = &mut runner else { break };
            note(&format!("{n} atoms: {}", program.name()));
            let spheres = structures::tiled_sample(n)?;
            let series = &mut growth.series[at];
            let before = series.points.last().map(|point| (point.atoms, point.timed.seconds.median));
            match size(plan, program, &mut **runner, &spheres, &params, before) {
                Ok(timed) => series.points.push(Point { atoms: n, timed }),
                Err(why) => {
                    series.ends = Some(format!("{n} atoms: {why}"));
                    break;
                }
            }
            done(&growth)?;
        }
    }
    done(&growth)
}

/// Measures one size of one program. `before` contains atoms and seconds of the previous size.
fn size(
    plan: &Plan,
    program: Program,
    runner: &mut dyn Runner,
    spheres: &Spheres,
    params: &SurfaceParams,
    before: Option<(usize, f64)>,
) -> Result<Timed> {
    let expected = if program == Program::Reference {
        let cells = reference::cells(spheres, params).map_err(Error::failed)?;
        reference_estimate(spheres, params, cells.iter().product())
    } else {
        // Time grows at least linearly with atoms.
        before.map_or(0.0, |(atoms, seconds)| seconds * spheres.len() as f64 / atoms as f64)
    };
    plan.within_limit(expected)?;
    if program == Program::Reference && expected > 1.0 {
        return timed(runner, spheres, params, [0, 1]);
    }
    let start = Instant::now();
    runner.once(spheres, params)?;
    let once = start.elapsed().as_secs_f64().max(1e-6);
    let runs = (1..plan.runs).take_while(|n| *n as f64 * once < TIME_PER_SIZE).count() + 1;
    timed(runner, spheres, params, [usize::from(runs > 1), runs])
}
