//! Time and memory against atoms, program by program, as far as each gets.

use std::time::Instant;

use molmesh::surface::{Spheres, SurfaceOptions, SurfaceParams, reference};

use super::super::super::error::CliError;
use super::programs::{Program, Runner, reference_estimate, timed};
use super::result::{Growth, Point, Series, Timed};
use super::{Plan, Progress, source};

/// Sizes, atoms.
const SIZES: [usize; 10] = [100, 300, 1_000, 3_000, 10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000];
/// Seconds that the measured runs of one size take at most, where one run leaves a choice.
const PATIENCE: f64 = 4.0;

/// The sample, repeated on a lattice of boxes until there are `n` atoms: density and surface an atom stay.
pub(super) fn tiled(sample: &Spheres, n: usize) -> Result<Spheres, String> {
    let Some([lo, hi]) = sample.bounds() else { return Err("no atoms".to_owned()) };
    let copies = n.div_ceil(sample.len());
    let edge = (1..=copies).find(|e| e.pow(3) >= copies).unwrap_or(1);
    let (mut columns, mut radii) = ([const { Vec::new() }; 3], Vec::with_capacity(n));
    for column in &mut columns {
        column.reserve_exact(n);
    }
    for i in 0..n {
        let (copy, atom) = (i / sample.len(), i % sample.len());
        let at = [copy % edge, copy / edge % edge, copy / edge / edge];
        let centre = sample.centre(atom);
        (0..3).for_each(|k| columns[k].push(centre[k] + (hi[k] - lo[k] + 3.0) * at[k] as f64));
        radii.push(sample.radius(atom));
    }
    let [x, y, z] = columns;
    Spheres::new(x, y, z, radii).map_err(|e| e.to_string())
}

/// Measures every program up to `most` atoms; `done` is told of each size.
///
/// # Errors
/// [`CliError`] where a program cannot be started, or as `done` has it.
pub(super) fn measure(
    plan: &Plan,
    most: usize,
    progress: &Progress,
    done: &mut dyn FnMut(&Growth) -> Result<(), CliError>,
) -> Result<(), CliError> {
    let sample = source::sample()?;
    let options = SurfaceOptions { resolution: Some(plan.growth_spacing), ..SurfaceOptions::default() };
    let params = SurfaceParams::new(&options).map_err(|e| CliError::usage(e.to_string()))?;
    let sizes: Vec<usize> = SIZES.into_iter().filter(|n| *n <= most).collect();
    let structure = "the built-in 4PTI, tiled; default surface".to_owned();
    let mut growth = Growth { structure, spacing: params.resolution, series: Vec::new() };
    let programs: Vec<Program> = Program::ALL.into_iter().filter(|p| plan.programs.contains(p)).collect();
    for (i, program) in programs.iter().enumerate() {
        let mut series = Series { program: program.name().to_owned(), points: Vec::new(), ends: None };
        match plan.open(*program).map_err(CliError::Service)? {
            Err(why) => series.ends = Some(why),
            Ok(mut runner) => {
                for (j, n) in sizes.iter().enumerate() {
                    let step = i * sizes.len() + j;
                    progress.at(step, programs.len() * sizes.len(), &format!("{n} atoms: {}", program.name()));
                    let spheres = tiled(&sample, *n).map_err(CliError::Internal)?;
                    let before = series.points.last().map(|p: &Point| (p.atoms, p.timed.seconds.median));
                    match size(plan, *program, &mut *runner, &spheres, &params, before) {
                        Ok(timed) => series.points.push(Point { atoms: *n, timed }),
                        Err(why) => {
                            series.ends = Some(format!("{n} atoms: {why}"));
                            break;
                        }
                    }
                    let mut so_far = growth.clone();
                    so_far.series.push(series.clone());
                    done(&so_far)?;
                }
            }
        }
        growth.series.push(series);
        done(&growth)?;
    }
    Ok(())
}

/// One size of one program; `before`: atoms and seconds of the size before.
fn size(
    plan: &Plan,
    program: Program,
    runner: &mut dyn Runner,
    spheres: &Spheres,
    params: &SurfaceParams,
    before: Option<(usize, f64)>,
) -> Result<Timed, String> {
    let expected = if program == Program::Reference {
        let cells = reference::cells(spheres, params).map_err(|e| e.to_string())?;
        reference_estimate(spheres, params, cells.iter().product())
    } else {
        // Linear at best.
        before.map_or(0.0, |(atoms, seconds)| seconds * spheres.len() as f64 / atoms as f64)
    };
    plan.within_limit(expected)?;
    if program == Program::Reference && expected > 1.0 {
        return timed(runner, spheres, params, [0, 1]);
    }
    let start = Instant::now();
    runner.once(spheres, params)?;
    let once = start.elapsed().as_secs_f64().max(1e-6);
    // Few runs of many seconds each have no need of more warmth than the one before.
    let runs = (1..plan.runs).take_while(|n| *n as f64 * once < PATIENCE).count() + 1;
    timed(runner, spheres, params, [usize::from(runs > 1), runs])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_keep_their_distance() {
        let sample = source::sample().unwrap();
        let many = tiled(&sample, 3_000).unwrap();
        assert_eq!(
            (many.len(), many.centre(454)),
            (3_000, {
                let [lo, hi] = sample.bounds().unwrap();
                let mut first = sample.centre(0);
                first[0] += hi[0] - lo[0] + 3.0;
                first
            })
        );
        let few = tiled(&sample, 100).unwrap();
        assert_eq!((few.len(), few.centre(99)), (100, sample.centre(99)));
    }
}
