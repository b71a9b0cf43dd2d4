//! Stages against the rates of the device. Replaces the paper's table of a vendor's occupancy calculator.
//!
//! wgpu reports neither registers nor concurrent workgroups of a stage. The table contains workgroups, shared memory,
//! minimum bytes and multiply-adds, and time.

use std::collections::BTreeMap;

use molmesh::gpu::{Executor as _, GpuJob, Prepared, stage_shaders};
use molmesh::surface::{CancelToken, Control, Kernel, Spheres, Stage, SurfaceOptions, SurfaceParams};
use naga::AddressSpace;

use super::entries::{ENTRIES, surface};
use super::programs::{Program, Runner, timed};
use super::result::{Roofline, StageFacts};
use super::{Plan, rows};
use crate::device::Selected;
use crate::error::{Error, Result};
use crate::floor::Work;
use crate::gpu::LIMITS;
use crate::rates::{self, Rates};
use crate::stats::digits;
use crate::{program_2010, structures};

/// Atoms of the large structure.
const LARGE: usize = 300_000;
/// Unmeasured runs.
const WARM_UP: usize = 2;

/// Measures the largest selected structure of the paper and, on hardware, a larger one. Returns nothing if the device
/// does not support timestamps.
///
/// # Errors
/// Returns an [`Error`] if the device or a file cannot be used.
pub(super) fn measure(selected: &Selected, plan: &Plan) -> Result<Vec<Roofline>> {
    let Some(rates) = rates::measure(&selected.gpu()?, selected.software)? else { return Ok(Vec::new()) };
    let entry = plan.entries.last().copied().unwrap_or(&ENTRIES[ENTRIES.len() - 1]);
    let found = rows::find(entry, plan)?;
    let [_, grid] = rows::grids(entry, &found.spheres, Kernel::Gaussian)?;
    let params = surface(Kernel::Gaussian, grid.spacing)?;
    let structure =
        format!("{}{}, the paper's Gaussian", entry.id, if found.substitute { " (substitute)" } else { "" });
    let mut first = stages(selected, &found.spheres, &params, plan.runs, &rates, structure)?;
    if plan.programs.contains(&Program::Paper) {
        let times = timed(&mut *Program::Paper.on(selected)?, &found.spheres, &params, [WARM_UP, plan.runs])?;
        let shapes = shapes(program_2010::SHADERS)?;
        first.stages.extend(times.stages.into_iter().map(|stage| facts(Program::Paper, &shapes, stage)));
    }
    let mut all = vec![first];
    if !selected.software {
        let options = SurfaceOptions { resolution: Some(0.5), ..SurfaceOptions::default() };
        let params = SurfaceParams::new(&options).map_err(Error::failed)?;
        let structure = format!("4PTI tiled to {LARGE} atoms, default surface at 0.5 Å");
        all.push(stages(selected, &structures::tiled_sample(LARGE)?, &params, plan.runs, &rates, structure)?);
    }
    Ok(all)
}

/// Measures the GPU stages on a structure.
fn stages(
    selected: &Selected,
    spheres: &Spheres,
    params: &SurfaceParams,
    runs: usize,
    rates: &Rates,
    structure: String,
) -> Result<Roofline> {
    let mut engine = selected.engine()?;
    let times = timed(&mut engine as &mut dyn Runner, spheres, params, [WARM_UP, runs])?;
    let prepared = Prepared::new(spheres, params, &LIMITS, &Control::default()).map_err(Error::failed)?;
    let job = GpuJob { prepared: prepared.into(), cancel: CancelToken::default(), deadline: None };
    let finished = engine.run(std::slice::from_ref(&job)).pop().ok_or_else(|| Error::failed("no result"))?;
    let meshed = finished.map_err(Error::failed)?.meshed;
    let bricks = job.prepared.plan.bricks.len() as u64;
    let shapes = shapes(stage_shaders())?;
    let with_work = |(name, seconds): (String, f64)| {
        let stage = Stage::ALL.into_iter().find(|stage| stage.name() == name)?;
        let work = Work::of(stage, &job.prepared, &meshed);
        // Bricks per workgroup, if the structure is meshed in one piece.
        let each = match stage {
            Stage::Classify => 4,
            Stage::Scan => 1024,
            _ => 1,
        };
        Some(StageFacts {
            workgroups: Some(bricks.div_ceil(each)),
            bytes: Some(digits(work.bytes)),
            fmas: Some(digits(work.fmas)),
            ..facts(Program::Gpu, &shapes, (name, seconds))
        })
    };
    let stages = times.stages.into_iter().filter_map(with_work).collect();
    Ok(Roofline { structure, memory_rate: digits(rates.memory), fma_rate: digits(rates.fma), stages })
}

/// Creates the facts of a stage, without its work.
fn facts(program: Program, shapes: &BTreeMap<&str, [u32; 2]>, (stage, seconds): (String, f64)) -> StageFacts {
    let [workgroup_size, workgroup_bytes] = shapes.get(stage.as_str()).copied().unwrap_or_default();
    StageFacts {
        program: program.name().to_owned(),
        stage,
        workgroup_size,
        workgroup_bytes,
        workgroups: None,
        bytes: None,
        fmas: None,
        seconds,
    }
}

/// Returns the threads and the bytes of shared memory per workgroup of each shader.
fn shapes(shaders: impl IntoIterator<Item = (&'static str, &'static str)>) -> Result<BTreeMap<&'static str, [u32; 2]>> {
    let shape = |(name, source): (&'static str, &str)| {
        let module = naga::front::wgsl::parse_str(source).map_err(Error::failed)?;
        let threads = module.entry_points.iter().map(|entry| entry.workgroup_size.iter().product::<u32>()).sum();
        let shared = module.global_variables.iter().filter(|(_, global)| global.space == AddressSpace::WorkGroup);
        let bytes = shared.map(|(_, global)| module.types[global.ty].inner.size(module.to_ctx())).sum();
        Ok((name, [threads, bytes]))
    };
    shaders.into_iter().map(shape).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_are_read_from_the_shaders() {
        let paper = shapes(program_2010::SHADERS).unwrap();
        // Declared in field.wgsl, classify.wgsl and scan.wgsl.
        assert_eq!([paper["field"], paper["classify"], paper["scan"]], [[64, 0], [256, 0], [256, 2048]]);
        let ours = shapes(stage_shaders()).unwrap();
        let names: Vec<&str> = stage_shaders().map(|(name, _)| name).collect();
        assert_eq!(names, Stage::ALL[..8].iter().map(|stage| stage.name()).collect::<Vec<_>>());
        assert!(ours.values().all(|[threads, _]| *threads >= 64) && ours["field"][1] > 0, "{ours:?}");
        // With more than 12 KiB, an H100 (228 KiB, 1 KiB reserved per workgroup) runs fewer than 17 workgroups at once.
        assert!(ours["measure"][1] <= 12 << 10, "{ours:?}");
    }
}
