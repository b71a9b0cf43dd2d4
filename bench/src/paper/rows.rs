//! Rows of the paper's tables: all structures, kernels and programs.

use molmesh::surface::lattice::Lattice;
use molmesh::surface::{Control, Kernel, Spheres, SurfaceParams, reference};

use super::entries::{Entry, KERNELS, surface};
use super::programs::{Program, reference_estimate, timed};
use super::result::{Cell, Row, Side, Timed};
use super::{NOT_SELECTED, Opened, Plan};
use crate::error::{Error, Result};
use crate::grid::{self, Grid};
use crate::{note, program_2010, structures, substitute};

/// Number of unmeasured runs of programs other than the reference.
const WARM_UP: usize = 2;
/// The reference runs once if a run takes longer than this, s.
const SHORT: f64 = 2.0;

/// Structure of the tables, or its substitute.
#[derive(Debug)]
pub(super) struct Found {
    pub(super) spheres: Spheres,
    /// Description of the source.
    pub(super) source: String,
    /// True if it replaces the paper's structure.
    pub(super) substitute: bool,
}

/// Finds the structure of a row: its file in `data`, the built-in sample, or a substitute.
///
/// # Errors
/// Returns an [`Error`] if a file contains no structure, or the folder cannot be read.
pub(super) fn find(entry: &Entry, plan: &Plan) -> Result<Found> {
    let file = |id: &str| plan.data.as_ref().map_or(Ok(None), |folder| structures::find(folder, id));
    if let Some(path) = file(entry.id)? {
        let source = format!("file {}", structures::file_name(&path));
        return Ok(Found { spheres: structures::read(&path, None)?, source, substitute: false });
    }
    if entry.id == "4PTI" {
        return Ok(Found {
            spheres: structures::sample()?,
            source: "the built-in sample".to_owned(),
            substitute: false,
        });
    }
    // 2HHB is also haemoglobin, with three atoms fewer.
    if entry.id == "1BIJ"
        && let Some(path) = file("2HHB")?
    {
        let source = format!("substitute: 2HHB, file {}", structures::file_name(&path));
        return Ok(Found { spheres: structures::read(&path, None)?, source, substitute: true });
    }
    let spheres = substitute::generate(entry.atoms, entry.cubes[0])?;
    Ok(Found { spheres, source: "substitute: generated".to_owned(), substitute: true })
}

/// Measures the rows of `plan`, and passes each to `done`.
///
/// # Errors
/// Returns an [`Error`] if a file or a program cannot be used, or an error of `done`.
pub(super) fn measure(plan: &Plan, done: &mut dyn FnMut(Row) -> Result<()>) -> Result<()> {
    let mut programs =
        Program::ALL.into_iter().map(|program| Ok((program, plan.open(program)?))).collect::<Result<Vec<_>>>()?;
    for entry in &plan.entries {
        let found = find(entry, plan)?;
        note(&format!("{}: {}, {} atoms", entry.id, found.source, found.spheres.len()));
        for &kernel in &plan.kernels {
            let k = KERNELS.iter().position(|known| *known == kernel).unwrap_or_default();
            let [cpu, gpu] = grids(entry, &found.spheres, kernel)?;
            let mut case = Case { found: &found, kernel, plan, programs: &mut programs };
            done(Row {
                id: entry.id.to_owned(),
                kernel: kernel.name().to_owned(),
                paper_atoms: entry.atoms,
                atoms: found.spheres.len(),
                source: found.source.clone(),
                substitute: found.substitute,
                cpu: case.side(cpu, [Program::Reference, Program::Cpu], entry.cpu[k], entry.cubes[0])?,
                gpu: case.side(gpu, [Program::Paper, Program::Gpu], entry.gpu[k], entry.cubes[1])?,
            })?;
        }
    }
    Ok(())
}

/// Structure with a kernel.
struct Case<'a> {
    found: &'a Found,
    kernel: Kernel,
    plan: &'a Plan,
    programs: &'a mut [(Program, Opened)],
}

impl Case<'_> {
    fn side(&mut self, grid: Grid, programs: [Program; 2], paper_seconds: f64, paper_cubes: u64) -> Result<Side> {
        let params = surface(self.kernel, grid.spacing)?;
        let [baseline, ours] = programs.map(|program| {
            note(&format!("  {}: {}", self.kernel, program.name()));
            let (timed, not_run) = match self.time(program, &params, grid) {
                Ok(timed) => (Some(timed), None),
                Err(why) => (None, Some(why.to_string())),
            };
            Cell { program: program.name().to_owned(), timed, not_run }
        });
        let native = self.programs.iter_mut().find(|(program, _)| *program == Program::Cpu);
        let triangles = match native {
            Some((_, Ok(native))) => Some(native.once(&self.found.spheres, &params)?.triangles),
            _ => None,
        };
        let Grid { spacing, cubes } = grid;
        Ok(Side { paper_seconds, paper_cubes, cubes, spacing, baseline, ours, triangles })
    }

    fn time(&mut self, program: Program, params: &SurfaceParams, grid: Grid) -> Result<Timed> {
        let runner = match self.programs.iter_mut().find(|(known, _)| *known == program) {
            Some((_, Ok(runner))) => runner,
            Some((_, Err(why))) => return Err(Error::Failed(why.clone())),
            None => return Err(Error::failed(NOT_SELECTED)),
        };
        let spheres = &self.found.spheres;
        let runs = if program == Program::Reference {
            let estimate = reference_estimate(spheres, params, grid.cubes);
            self.plan.within_limit(estimate)?;
            [0, if estimate > SHORT { 1 } else { self.plan.runs.min(3) }]
        } else {
            [WARM_UP, self.plan.runs]
        };
        timed(&mut **runner, spheres, params, runs)
    }
}

/// Returns the grids of both tables, at which their dense programs visit the same number of cubes as in the paper.
///
/// # Errors
/// Returns [`Error::Failed`] if no spacing is within 1 %.
pub(super) fn grids(entry: &Entry, spheres: &Spheres, kernel: Kernel) -> Result<[Grid; 2]> {
    let cpu = |spacing| {
        let cells = reference::cells(spheres, &surface(kernel, spacing)?).map_err(Error::failed)?;
        Ok(cells.iter().product())
    };
    let gpu = |spacing| {
        let lattice = Lattice::new(spheres, &surface(kernel, spacing)?, &Control::default()).map_err(Error::failed)?;
        Ok(program_2010::cubes(&lattice).iter().product())
    };
    Ok([grid::for_cubes(entry.cubes[0], &cpu)?, grid::for_cubes(entry.cubes[1], &gpu)?])
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;

    use super::super::entries::ENTRIES;
    use super::*;

    fn plan(data: Option<&Path>) -> Plan {
        Plan {
            programs: Vec::new(),
            device: Err(String::new()),
            data: data.map(Path::to_owned),
            entries: Vec::new(),
            kernels: Vec::new(),
            runs: 1,
            limit: 1.0,
            growth_spacing: 1.0,
            threads: None,
        }
    }

    #[test]
    fn grids_have_the_papers_number_of_cubes() {
        for entry in &ENTRIES {
            let found = find(entry, &plan(None)).unwrap();
            for kernel in KERNELS {
                let grids = grids(entry, &found.spheres, kernel).unwrap();
                for (grid, cubes) in grids.iter().zip(entry.cubes) {
                    let off = (grid.cubes as f64 / cubes as f64 - 1.0).abs();
                    assert!(off <= grid::TOLERANCE, "{} {kernel}: {grid:?} for {cubes}", entry.id);
                    // The paper's cubes have 0.4 Å. Margins around the atoms differ here.
                    assert!((0.36..0.44).contains(&grid.spacing), "{} {kernel}: {grid:?}", entry.id);
                }
            }
        }
    }

    #[test]
    fn files_are_preferred_to_the_sample_and_the_sample_to_substitutes() {
        let folder = tempfile::tempdir().unwrap();
        let found = |id: &str| {
            let entry = ENTRIES.iter().find(|entry| entry.id == id).unwrap();
            let found = find(entry, &plan(Some(folder.path()))).unwrap();
            (found.source, found.substitute, found.spheres.len())
        };
        assert_eq!(found("4PTI"), ("the built-in sample".to_owned(), false, 454));
        assert_eq!(found("1BK2"), ("substitute: generated".to_owned(), true, 468));
        for name in ["PDB1BK2.ENT", "2hhb.pdb"] {
            fs::write(folder.path().join(name), structures::SAMPLE).unwrap();
        }
        assert_eq!(found("1BK2"), ("file PDB1BK2.ENT".to_owned(), false, 454));
        assert_eq!(found("1BIJ"), ("substitute: 2HHB, file 2hhb.pdb".to_owned(), true, 454));
        fs::write(folder.path().join("1bij.pdb"), structures::SAMPLE).unwrap();
        assert!(!found("1BIJ").1);
    }
}
