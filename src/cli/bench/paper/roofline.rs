//! The device's stages against what it can do: in place of the occupancy calculator's numbers, which belong to one
//! vendor's cards.
//!
//! The registers of a stage are known to the driver, which does not tell them through wgpu; neither does it tell how many
//! workgroups are in flight. Workgroups, the memory that they share, the least bytes and multiply-adds, and the time are known.

use std::sync::Arc;

use molmesh::gpu::bench::{StageShape, shapes};
use molmesh::gpu::yardstick::{self, Effort, Rates};
use molmesh::gpu::{Engine, Executor, GpuJob, Prepared};
use molmesh::surface::{CancelToken, Control, Kernel, Spheres, Stage, SurfaceOptions, SurfaceParams};

use super::super::super::error::CliError;
use super::super::floor::Work;
use super::super::measure::{LIMITS, Spread};
use super::entries::{ENTRIES, surface};
use super::programs::{Chosen, Program};
use super::result::{Roofline, StageFacts, digits};
use super::{Plan, growth, rows, source};

/// Atoms of the large structure.
const LARGE: usize = 300_000;

/// Measures the paper's largest structure, and on hardware a large one; nothing where the device has no clock.
///
/// # Errors
/// [`CliError`] as the device or a file has it.
pub(super) fn measure(chosen: &Chosen, plan: &Plan) -> Result<Vec<Roofline>, CliError> {
    let failed = CliError::Service;
    let mut engine = chosen.engine().map_err(failed)?;
    let effort = if chosen.device.software { Effort::SOFTWARE } else { Effort::HARDWARE };
    let Some(rates) = yardstick::rates(&engine, effort).map_err(|e| failed(e.to_string()))? else {
        return Ok(Vec::new());
    };
    let mut measured = Vec::new();
    if let Some(entry) = plan.entries().last().copied().or(ENTRIES.last()) {
        let found = source::find(entry, plan.data.as_deref())?;
        let [_, grid] = rows::grids(entry, &found.spheres, Kernel::Gaussian).map_err(failed)?;
        let params = surface(Kernel::Gaussian, grid.spacing).map_err(failed)?;
        let structure =
            format!("{}{}, the paper's Gaussian", entry.id, if found.stand_in { " (stand-in)" } else { "" });
        let mut one = stages(&mut engine, &found.spheres, &params, plan.runs, &rates, structure).map_err(failed)?;
        if plan.programs.contains(&Program::Paper) {
            let mut paper = chosen.open(Program::Paper).map_err(failed)?;
            let timed = super::programs::timed(&mut *paper, &found.spheres, &params, [2, plan.runs]).map_err(failed)?;
            one.stages.extend(timed.stages.iter().map(|(stage, seconds)| baseline(stage, *seconds)));
        }
        measured.push(one);
    }
    if !chosen.device.software {
        let spheres = growth::tiled(&source::sample()?, LARGE).map_err(failed)?;
        let options = SurfaceOptions { resolution: Some(0.5), ..SurfaceOptions::default() };
        let params = SurfaceParams::new(&options).map_err(|e| failed(e.to_string()))?;
        let structure = format!("4PTI tiled to {LARGE} atoms, default surface at 0.5 Å");
        measured.push(stages(&mut engine, &spheres, &params, plan.runs, &rates, structure).map_err(failed)?);
    }
    Ok(measured)
}

/// A stage of the 2010 program: its least work is not counted.
fn baseline(stage: &str, seconds: f64) -> StageFacts {
    let shape = shape(true, stage);
    StageFacts {
        program: Program::Paper.name().to_owned(),
        stage: stage.to_owned(),
        workgroup_size: shape.map_or(0, |s| s.workgroup_size),
        workgroup_bytes: shape.map_or(0, |s| s.workgroup_bytes),
        workgroups: None,
        bytes: None,
        fmas: None,
        seconds,
    }
}

fn shape(paper: bool, stage: &str) -> Option<StageShape> {
    shapes().into_iter().find(|shape| shape.paper == paper && shape.stage == stage)
}

fn stages(
    engine: &mut Engine,
    spheres: &Spheres,
    params: &SurfaceParams,
    runs: usize,
    rates: &Rates,
    structure: String,
) -> Result<Roofline, String> {
    let prepared = Prepared::new(spheres, params, &LIMITS, &Control::default()).map_err(|e| e.to_string())?;
    let job = GpuJob { prepared: Arc::new(prepared), cancel: CancelToken::default(), deadline: None };
    let mut times: Vec<(Stage, Vec<f64>)> = Vec::new();
    let mut last = None;
    for run in 0..2 + runs {
        drop(last.take());
        let finished = engine.run(std::slice::from_ref(&job)).pop().ok_or("no answer")?.map_err(|e| e.to_string())?;
        if run >= 2 {
            for (i, (stage, ns)) in finished.stages.iter().enumerate() {
                if times.len() == i {
                    times.push((*stage, Vec::new()));
                }
                times[i].1.push(*ns as f64 * 1e-9);
            }
        }
        last = Some(finished);
    }
    let meshed = last.ok_or("no run")?.meshed;
    let bricks = job.prepared.plan.bricks.len() as u64;
    let facts = |(stage, seconds): (Stage, Vec<f64>)| {
        let (work, shape) = (Work::of(stage, &job.prepared, &meshed), shape(false, stage.name()));
        // As the recording has it, where the structure is one piece.
        let each = match stage {
            Stage::Classify => 4,
            Stage::Scan => 1024,
            _ => 1,
        };
        StageFacts {
            program: Program::Gpu.name().to_owned(),
            stage: stage.name().to_owned(),
            workgroup_size: shape.map_or(0, |s| s.workgroup_size),
            workgroup_bytes: shape.map_or(0, |s| s.workgroup_bytes),
            workgroups: Some(bricks.div_ceil(each)),
            bytes: Some(digits(work.bytes)),
            fmas: Some(digits(work.fmas)),
            seconds: digits(Spread::of(seconds).median),
        }
    };
    let stages = times.into_iter().map(facts).collect();
    Ok(Roofline { structure, memory_rate: digits(rates.memory), fma_rate: digits(rates.fma), stages })
}
