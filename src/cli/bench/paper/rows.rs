//! The paper's tables, measured: each structure with each kernel on each program.

use molmesh::gpu::paper;
use molmesh::surface::lattice::Lattice;
use molmesh::surface::{Kernel, Spheres, SurfaceParams, reference};

use super::super::super::error::CliError;
use super::entries::{Entry, KERNELS, surface};
use super::grid::{self, Grid};
use super::programs::{OnCpu, Program, Runner, reference_estimate, timed};
use super::result::{Cell, Row, Side};
use super::source::{self, Found};
use super::{Plan, Progress};

/// Runs before the measured ones, of everything but the reference.
const WARM_UP: usize = 2;
/// A run of the reference that takes longer, s, is done once.
const SHORT: f64 = 2.0;

/// A program that is ready to run, or why it does not.
type Opened = Result<Box<dyn Runner>, String>;

/// The programs.
pub(super) struct Programs {
    runners: Vec<(Program, Opened)>,
}

impl Programs {
    /// Those of a plan.
    ///
    /// # Errors
    /// In words, where a device or a thread pool cannot be had.
    pub(super) fn open(plan: &Plan) -> Result<Self, String> {
        let mut runners = Vec::new();
        for program in Program::ALL {
            runners.push((program, plan.open(program)?));
        }
        Ok(Self { runners })
    }

    fn get(&mut self, program: Program) -> Result<&mut dyn Runner, String> {
        match self.runners.iter_mut().find(|(known, _)| *known == program) {
            Some((_, Ok(runner))) => Ok(&mut **runner),
            Some((_, Err(why))) => Err(why.clone()),
            None => Err("not asked for".to_owned()),
        }
    }
}

/// Measures everything that `plan` asks for; `done` is told of each row.
///
/// # Errors
/// [`CliError`] where a file cannot be used, or as `done` has it.
pub(super) fn measure(
    plan: &Plan,
    progress: &Progress,
    done: &mut dyn FnMut(Row) -> Result<(), CliError>,
) -> Result<(), CliError> {
    let mut programs = Programs::open(plan).map_err(CliError::Service)?;
    let entries: Vec<&Entry> = plan.entries();
    let kernels = plan.kernels();
    let total = entries.len() * kernels.len();
    for (i, entry) in entries.iter().enumerate() {
        let found = source::find(entry, plan.data.as_deref())?;
        for (j, kernel) in kernels.iter().enumerate() {
            let mut case = Case { entry, found: &found, kernel: *kernel, plan, programs: &mut programs };
            let row = case.row(&|program| {
                progress.at(i * kernels.len() + j, total, &format!("{} {kernel}: {}", entry.id, program.name()));
            });
            done(row.map_err(|why| CliError::Internal(format!("{}: {why}", entry.id)))?)?;
        }
    }
    Ok(())
}

/// A structure with a kernel.
struct Case<'a> {
    entry: &'a Entry,
    found: &'a Found,
    kernel: Kernel,
    plan: &'a Plan,
    programs: &'a mut Programs,
}

impl Case<'_> {
    fn row(&mut self, begins: &dyn Fn(Program)) -> Result<Row, String> {
        let (entry, found) = (self.entry, self.found);
        let number = KERNELS.iter().position(|k| *k == self.kernel).unwrap_or_default();
        let [cpu, gpu] = grids(entry, &found.spheres, self.kernel)?;
        let cpu = self.side(cpu, [Program::Reference, Program::Cpu], entry.cpu[number], entry.cubes[0], begins)?;
        let gpu = self.side(gpu, [Program::Paper, Program::Gpu], entry.gpu[number], entry.cubes[1], begins)?;
        Ok(Row {
            id: entry.id.to_owned(),
            kernel: self.kernel.name().to_owned(),
            paper_atoms: entry.atoms,
            atoms: found.spheres.len(),
            source: found.source.clone(),
            stand_in: found.stand_in,
            cpu,
            gpu,
        })
    }

    fn side(
        &mut self,
        grid: Grid,
        [baseline, ours]: [Program; 2],
        paper_seconds: f64,
        paper_cubes: u64,
        begins: &dyn Fn(Program),
    ) -> Result<Side, String> {
        let params = surface(self.kernel, grid.spacing)?;
        let baseline = self.cell(baseline, &params, grid, begins);
        let ours = self.cell(ours, &params, grid, begins);
        let triangles = match self.programs.get(Program::Cpu) {
            Ok(native) => Some(native.once(&self.found.spheres, &params)?.triangles),
            Err(_) => None,
        };
        let Grid { spacing, cubes } = grid;
        Ok(Side { paper_seconds, paper_cubes, cubes, spacing, baseline, ours, triangles })
    }

    fn cell(&mut self, program: Program, params: &SurfaceParams, grid: Grid, begins: &dyn Fn(Program)) -> Cell {
        begins(program);
        let result = self.time(program, params, grid);
        let (timed, not_run) = match result {
            Ok(timed) => (Some(timed), None),
            Err(why) => (None, Some(why)),
        };
        Cell { program: program.name().to_owned(), timed, not_run }
    }

    fn time(&mut self, program: Program, params: &SurfaceParams, grid: Grid) -> Result<super::result::Timed, String> {
        let spheres = &self.found.spheres;
        let runner = self.programs.get(program)?;
        let runs = if program == Program::Reference {
            let estimate = reference_estimate(spheres, params, grid.cubes);
            self.plan.within_limit(estimate)?;
            [0, if estimate > SHORT { 1 } else { self.plan.runs.min(3) }]
        } else {
            [WARM_UP, self.plan.runs]
        };
        timed(runner, spheres, params, runs)
    }
}

/// The grids of both tables: spacings at which their dense programs visit as many cubes as the paper's.
///
/// # Errors
/// In words, where no spacing comes within 1 %.
pub(super) fn grids(entry: &Entry, spheres: &Spheres, kernel: Kernel) -> Result<[Grid; 2], String> {
    let cpu = |spacing| {
        let cells = reference::cells(spheres, &surface(kernel, spacing)?).map_err(|e| e.to_string())?;
        Ok(cells.iter().product())
    };
    let gpu = |spacing| {
        let lattice = Lattice::new(spheres, &surface(kernel, spacing)?).map_err(|e| e.to_string())?;
        Ok(paper::cubes(&lattice).iter().product())
    };
    Ok([grid::for_cubes(entry.cubes[0], &cpu)?, grid::for_cubes(entry.cubes[1], &gpu)?])
}

/// What runs on the CPU, or the reason why it does not run.
pub(super) fn on_cpu(program: Program, threads: Option<usize>) -> Result<Box<dyn Runner>, String> {
    Ok(match program {
        Program::Reference => Box::new(OnCpu::reference()),
        _ => Box::new(OnCpu::native(threads)?.0),
    })
}

#[cfg(test)]
mod tests {
    use super::super::entries::ENTRIES;
    use super::*;

    #[test]
    fn every_row_has_the_papers_number_of_cubes_in_both_tables() {
        for entry in &ENTRIES {
            let found = source::find(entry, None).unwrap();
            for kernel in KERNELS {
                let grids = grids(entry, &found.spheres, kernel).unwrap();
                for (grid, cubes) in grids.iter().zip(entry.cubes) {
                    let off = (grid.cubes as f64 / cubes as f64 - 1.0).abs();
                    assert!(off <= grid::TOLERANCE, "{} {kernel}: {grid:?} for {cubes}", entry.id);
                    // The paper's cubes have 0.4 Å; ours differ by what the programs leave around the atoms.
                    assert!((0.36..0.44).contains(&grid.spacing), "{} {kernel}: {grid:?}", entry.id);
                }
            }
        }
    }
}
