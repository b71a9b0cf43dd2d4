//! Times of one case on one device: all stages, and the complete request.

use std::fmt::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use molmesh::gpu::{Engine, Executor as _, Finished, GpuJob};
use molmesh::surface::{
    Backend, Control, CpuBackend, Measures, Mesh, Spheres, Stage, Step, SurfaceError, SurfaceParams, Validation,
};
use rayon::prelude::*;
use serde::Serialize;

use super::{GpuArgs, LIMITS, WARM_UP, prepare};
use crate::error::{Error, Result};
use crate::floor::Work;
use crate::rates::Rates;
use crate::stats::Summary;

/// Times of a stage.
#[derive(Debug, Serialize)]
struct StageRow {
    stage: &'static str,
    /// Device time, ms.
    ms: Summary,
    /// Minimum memory traffic, bytes.
    bytes: f64,
    /// Minimum number of multiply-adds.
    fmas: f64,
    /// Lower bound of the time, ms.
    floor_ms: Option<f64>,
}

/// Measurements of a case. Times are in ms.
#[derive(Debug, Serialize)]
pub(super) struct CaseTimes {
    resolution: f64,
    atoms: usize,
    box_cells: u64,
    bricks: usize,
    surface_bricks: u64,
    /// Pairs of a brick and an atom that reaches a grid point of it.
    pairs: u64,
    vertices: usize,
    triangles: usize,
    /// Quantization step of the vertices, Å.
    step: Option<f32>,
    /// Size of the mesh, bytes.
    bytes: u64,
    stages: Vec<StageRow>,
    /// Sum of the stages.
    stages_ms: Summary,
    floor_ms: Option<f64>,
    /// Preparation on the host: lattice and plan.
    prepare_ms: Summary,
    /// Time from spheres to a mesh in host memory.
    ready_ms: Summary,
    /// Time from spheres until all bytes of the mesh were read.
    read_ms: Summary,
    /// Lower bound of the time to transfer the mesh.
    transfer_floor_ms: Option<f64>,
    /// Time per job of jobs that follow each other, each prepared in advance.
    following: Option<Following>,
    check: Option<Check>,
}

/// Time per job of jobs that follow each other, ms.
#[derive(Debug, Clone, Copy, Serialize)]
struct Following {
    /// Each job begins after the end of the one before.
    apart_ms: Summary,
    /// Each job is begun during the transfer of the one before.
    overlapped_ms: Summary,
}

/// Differences from the mesh of the CPU.
#[derive(Debug, Serialize)]
struct Check {
    /// Difference in triangles.
    triangles: i64,
    /// Relative difference in area.
    area: f64,
    /// Relative difference in volume.
    volume: f64,
    closed: bool,
}

/// Measures a case.
pub(super) fn measure(
    engine: &mut Engine,
    spheres: &Spheres,
    params: &SurfaceParams,
    args: &GpuArgs,
    rates: Option<&Rates>,
) -> Result<CaseTimes> {
    let [mut prepare_ms, mut ready_ms, mut read_ms, mut stages_ms] = [const { Vec::new() }; 4];
    let mut stages: Vec<(Stage, Vec<f64>)> = Vec::new();
    let mut last = None;
    for run in 0..WARM_UP + args.runs {
        // Drop the previous mesh first, so that its memory is reused.
        drop(last.take());
        let start = Instant::now();
        let elapsed = || start.elapsed().as_secs_f64() * 1e3;
        let job = prepare(spheres, params)?;
        let prepared_at = elapsed();
        let finished = run_job(engine, &job)?;
        let ready_at = elapsed();
        std::hint::black_box(sum_of_bytes(&finished.meshed.mesh));
        let read_at = elapsed();
        if run >= WARM_UP {
            prepare_ms.push(prepared_at);
            ready_ms.push(ready_at);
            read_ms.push(read_at);
            let ms = |(stage, ns): &(Stage, u64)| (*stage, *ns as f64 * 1e-6);
            stages_ms.push(finished.stages.iter().map(|stage| ms(stage).1).sum());
            for (i, (stage, ms)) in finished.stages.iter().map(ms).enumerate() {
                if stages.len() == i {
                    stages.push((stage, Vec::new()));
                }
                stages[i].1.push(ms);
            }
        }
        last = Some((job.prepared, finished.meshed));
    }
    let (prepared, meshed) = last.ok_or_else(|| Error::failed("no run"))?;
    let stage_row = |(stage, ms): (Stage, Vec<f64>)| {
        let work = Work::of(stage, &prepared, &meshed);
        let floor_ms = rates.map(|rates| work.seconds(rates) * 1e3);
        StageRow { stage: stage.name(), ms: Summary::of(ms), bytes: work.bytes, fmas: work.fmas, floor_ms }
    };
    let stages: Vec<_> = stages.into_iter().map(stage_row).collect();
    let bytes = meshed.mesh.bytes();
    let check = if args.check { Some(compare(&meshed.mesh, spheres, params)?) } else { None };
    let n = (meshed.mesh.n_vertices(), meshed.mesh.n_triangles());
    let surface_bricks = meshed.grid.surface_bricks;
    drop(meshed);
    Ok(CaseTimes {
        resolution: params.resolution,
        atoms: spheres.len(),
        box_cells: prepared.lattice.box_cells,
        bricks: prepared.plan.bricks.len(),
        surface_bricks,
        pairs: prepared.plan.pairs,
        vertices: n.0,
        triangles: n.1,
        step: params.quantize.map(Step::length),
        bytes,
        stages_ms: Summary::of(stages_ms),
        floor_ms: stages.iter().map(|row| row.floor_ms).sum::<Option<f64>>().filter(|floor| *floor > 0.0),
        stages,
        prepare_ms: Summary::of(prepare_ms),
        ready_ms: Summary::of(ready_ms),
        read_ms: Summary::of(read_ms),
        transfer_floor_ms: rates.map(|rates| bytes as f64 / rates.to_host * 1e3),
        following: if args.overlap { Some(following(engine, spheres, params, args.runs)?) } else { None },
        check,
    })
}

/// Runs one job.
fn run_job(engine: &mut Engine, job: &GpuJob) -> Result<Finished> {
    engine.run(std::slice::from_ref(job)).pop().ok_or_else(|| Error::failed("no result"))?.map_err(Error::failed)
}

/// Measures `runs` jobs that follow each other, first each after the one before, then each begun early.
fn following(engine: &mut Engine, spheres: &Spheres, params: &SurfaceParams, runs: usize) -> Result<Following> {
    let job = prepare(spheres, params)?;
    let early = Arc::new(AtomicBool::new(false));
    let next = (Arc::clone(&early), job.clone());
    engine.set_next_job(Box::new(move || next.0.load(Ordering::Relaxed).then(|| next.1.clone())));
    let mut times = [const { Vec::new() }; 2];
    for (n, times) in times.iter_mut().enumerate() {
        early.store(n == 1, Ordering::Relaxed);
        for run in 0..WARM_UP + runs {
            let start = Instant::now();
            drop(run_job(engine, &job)?);
            if run >= WARM_UP {
                times.push(start.elapsed().as_secs_f64() * 1e3);
            }
        }
    }
    let [apart_ms, overlapped_ms] = times.map(Summary::of);
    Ok(Following { apart_ms, overlapped_ms })
}

/// Sums all bytes of a mesh, as 64-bit words.
fn sum_of_bytes(mesh: &Mesh) -> u64 {
    let words = |part: &[u8]| {
        let (words, rest) = part.as_chunks::<8>();
        let sum = words.iter().fold(0_u64, |s, word| s.wrapping_add(u64::from_le_bytes(*word)));
        rest.iter().fold(sum, |s, byte| s.wrapping_add(u64::from(*byte)))
    };
    let sum = |bytes: &[u8]| bytes.par_chunks(1 << 20).map(words).reduce(|| 0, u64::wrapping_add);
    byte_columns(mesh).into_iter().map(sum).fold(0, u64::wrapping_add)
}

/// Returns the bytes of a mesh in chunks.
pub(super) fn byte_columns(mesh: &Mesh) -> Vec<&[u8]> {
    let floats = mesh.positions.pieces().chain(mesh.normals.pieces()).map(bytemuck::cast_slice);
    let quantized = mesh.quantized.iter().flat_map(|q| {
        q.positions.pieces().map(bytemuck::cast_slice).chain(q.normals.pieces().map(bytemuck::cast_slice))
    });
    floats.chain(quantized).chain(mesh.triangles.pieces().map(bytemuck::cast_slice)).collect()
}

fn compare(here: &Mesh, spheres: &Spheres, params: &SurfaceParams) -> Result<Check> {
    let control = Control::default();
    let cpu = CpuBackend::new(None).map_err(Error::Failed)?;
    let there = cpu.run(spheres, params, &LIMITS, &control).map_err(Error::failed)?.mesh;
    let measures = |mesh: &Mesh| -> std::result::Result<Measures, SurfaceError> {
        Measures::of(mesh, Validation::Checksum, &control)
    };
    let (a, b) = (measures(here).map_err(Error::failed)?, measures(&there).map_err(Error::failed)?);
    Ok(Check {
        triangles: here.n_triangles().cast_signed() as i64 - there.n_triangles().cast_signed() as i64,
        area: a.area / b.area - 1.0,
        volume: a.volume / b.volume - 1.0,
        closed: a.closed,
    })
}

/// Formats the measurements of a case.
pub(super) fn table(name: &str, row: &CaseTimes) -> String {
    let mut text = format!(
        "{name}: {} atoms at {:.4} Å, {} cells in the box, {} bricks ({} with surface), {} pairs, {} vertices{}, {} triangles, {:.1} MB\n",
        row.atoms,
        row.resolution,
        row.box_cells,
        row.bricks,
        row.surface_bricks,
        row.pairs,
        row.vertices,
        row.step.map(|step| format!(" in steps of {step} Å")).unwrap_or_default(),
        row.triangles,
        row.bytes as f64 * 1e-6,
    );
    // Writing to a string does not fail.
    _ = writeln!(text, "  ms                    median       min     floor   ratio        MB      Gfma");
    let mut line = |name: &str, ms: Summary, floor: Option<f64>, work: Option<[f64; 2]>| {
        let number = |v: Option<f64>, digits: usize| v.map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"));
        let ratio = floor.filter(|f| *f > 0.0).map(|floor| ms.median / floor);
        let [bytes, fmas] = [0, 1].map(|i| number(work.map(|w| w[i]), 2));
        let (floor, ratio) = (number(floor, 4), number(ratio, 1));
        _ = writeln!(text, "  {name:<18}{:>10.4}{:>10.4}{floor:>10}{ratio:>8}{bytes:>10}{fmas:>10}", ms.median, ms.min);
    };
    for stage in &row.stages {
        line(stage.stage, stage.ms, stage.floor_ms, Some([stage.bytes * 1e-6, stage.fmas * 1e-9]));
    }
    line("sum of stages", row.stages_ms, row.floor_ms, None);
    line("prepare (host)", row.prepare_ms, None, None);
    line("request to ready", row.ready_ms, row.transfer_floor_ms, None);
    line("request to read", row.read_ms, None, None);
    if let Some(Following { apart_ms, overlapped_ms }) = row.following {
        line("jobs in a row", apart_ms, None, None);
        line("overlapped", overlapped_ms, None, None);
    }
    if let Some(Check { triangles, area, volume, closed }) = &row.check {
        let differences = format!("{triangles:+} triangles, area {area:+.2e}, volume {volume:+.2e}, closed: {closed}");
        _ = writeln!(text, "  difference from the CPU: {differences}");
    }
    text + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_byte_counts() {
        let mut mesh =
            Mesh { positions: vec![[1.0; 3]; 5].into(), triangles: vec![[0, 1, 2]; 3].into(), ..Mesh::default() };
        let before = sum_of_bytes(&mesh);
        mesh.triangles[2][2] = 3;
        assert_eq!(sum_of_bytes(&mesh), before + 1);
        mesh.positions[4][2] = 1.5;
        assert_ne!(sum_of_bytes(&mesh), before + 1);
        mesh.quantize(Step::covering(2.0));
        let (before, read) =
            (sum_of_bytes(&mesh), byte_columns(&mesh).iter().map(|part| part.len() as u64).sum::<u64>());
        assert_eq!(read, mesh.bytes());
        mesh.quantized.iter_mut().for_each(|q| q.normals[4][0] += 1);
        assert_ne!(sum_of_bytes(&mesh), before);
    }

    #[test]
    fn differences_from_the_cpu_are_found() {
        let spheres = crate::structures::ball(60, 1).unwrap();
        let params = SurfaceParams::default();
        let mut mesh =
            CpuBackend::new(None).unwrap().run(&spheres, &params, &LIMITS, &Control::default()).unwrap().mesh;
        let same = compare(&mesh, &spheres, &params).unwrap();
        assert!(same.triangles == 0 && same.area.abs() < 1e-12 && same.closed, "{same:?}");
        mesh.triangles = mesh.triangles[1..].to_vec().into();
        mesh.positions[0][0] += 0.1;
        let other = compare(&mesh, &spheres, &params).unwrap();
        assert!(other.triangles == -1 && other.area.abs() > 1e-9 && !other.closed, "{other:?}");
    }
}
