//! One case: timed again and again, every part on its own.

use std::sync::Arc;
use std::time::Instant;

use molmesh::gpu::yardstick::Rates;
use molmesh::gpu::{Engine, Executor, GpuJob, Paper, Prepared};
use molmesh::surface::{
    Backend, CancelToken, Control, CpuBackend, Measures, Mesh, MeshOutput, Spheres, Stage, Step, SurfaceLimits,
    SurfaceParams, Validation,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::floor::Work;

/// A benchmark's machine is its own.
pub(super) const LIMITS: SurfaceLimits =
    SurfaceLimits { max_samples: 1 << 40, max_mesh_bytes: 64 << 30, max_candidates: 1 << 31 };
/// Runs before the measured ones.
pub(super) const WARM_UP: usize = 3;

/// Median and least of several values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct Spread {
    pub(super) median: f64,
    pub(super) min: f64,
}

impl Spread {
    /// Of some values; zeros of none.
    pub(super) fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let at = |i: usize| values.get(i).copied().unwrap_or_default();
        let n = values.len();
        let median = if n.is_multiple_of(2) { f64::midpoint(at(n.wrapping_sub(1) / 2), at(n / 2)) } else { at(n / 2) };
        Self { median, min: at(0) }
    }
}

/// A stage's times.
#[derive(Debug, Clone, Serialize)]
pub(super) struct StageRow {
    pub(super) stage: &'static str,
    /// Device time, ms.
    pub(super) ms: Spread,
    /// Bytes that it moves at least.
    pub(super) bytes: f64,
    /// Multiply-adds that it takes at least.
    pub(super) fmas: f64,
    /// Least time, ms.
    pub(super) floor_ms: Option<f64>,
    /// Median over least time.
    pub(super) ratio: Option<f64>,
}

/// What was measured of a case. Times are in ms.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Row {
    pub(super) resolution: f64,
    pub(super) atoms: usize,
    pub(super) box_cells: u64,
    pub(super) bricks: usize,
    pub(super) surface_bricks: u64,
    /// Pairs of a brick and an atom that reaches one of its samples.
    pub(super) pairs: u64,
    pub(super) vertices: usize,
    pub(super) triangles: usize,
    /// What vertices are rounded to, Å; none: they are single-precision numbers.
    pub(super) step: Option<f32>,
    /// Bytes of the mesh.
    pub(super) bytes: u64,
    /// A run's submissions.
    pub(super) submissions: u64,
    pub(super) stages: Vec<StageRow>,
    /// The stages' times, summed.
    pub(super) stages_ms: Spread,
    /// From the first stage's begin to the last one's end, summed over submissions.
    pub(super) device_ms: Spread,
    pub(super) floor_ms: Option<f64>,
    pub(super) ratio: Option<f64>,
    /// On the host, before the device: lattice and plan.
    pub(super) prepare_ms: Spread,
    /// From spheres to a mesh whose bytes can be read in host memory.
    pub(super) ready_ms: Spread,
    /// The same, until every byte was read.
    pub(super) read_ms: Spread,
    /// Least transfer time of the mesh.
    pub(super) transfer_floor_ms: Option<f64>,
    pub(super) check: Option<Check>,
    /// The 2010 program on the same device, or why it did not run; not for every case.
    pub(super) paper: Option<Result<PaperRow, String>>,
}

/// What was measured of the 2010 program. Times are in ms.
#[derive(Debug, Clone, Serialize)]
pub(super) struct PaperRow {
    pub(super) triangles: usize,
    pub(super) stages: Vec<(&'static str, Spread)>,
    pub(super) stages_ms: Spread,
    pub(super) ready_ms: Spread,
    /// Times that our stages are faster, by the sums of the stages' times.
    pub(super) faster: f64,
}

/// Measures the 2010 program, against our `stages_ms`.
///
/// # Errors
/// In words, as the device or the core put it.
pub(super) fn paper(
    paper: &mut Paper,
    spheres: &Spheres,
    params: &SurfaceParams,
    runs: usize,
    ours: Spread,
) -> Result<PaperRow, String> {
    let [mut ready, mut summed] = [const { Vec::new() }; 2];
    let mut stages = paper.times().map(|(name, _)| (name, Vec::new()));
    let mut triangles = 0;
    for run in 0..WARM_UP + runs {
        let start = Instant::now();
        let prepared = Prepared::new(spheres, params, &LIMITS, &Control::default()).map_err(|e| e.to_string())?;
        let job = GpuJob { prepared: Arc::new(prepared), cancel: CancelToken::default(), deadline: None };
        let finished = paper.run(&[job]).pop().ok_or("no answer")?.map_err(|e| e.to_string())?;
        if run >= WARM_UP {
            ready.push(start.elapsed().as_secs_f64() * 1e3);
            let times = paper.times().map(|(_, ns)| ns as f64 * 1e-6);
            summed.push(times.iter().sum());
            stages.iter_mut().zip(times).for_each(|((_, all), ms)| all.push(ms));
        }
        triangles = finished.meshed.mesh.n_triangles();
    }
    let stages_ms = Spread::of(summed);
    Ok(PaperRow {
        triangles,
        stages: stages.into_iter().map(|(name, all)| (name, Spread::of(all))).collect(),
        stages_ms,
        ready_ms: Spread::of(ready),
        faster: stages_ms.median / ours.median,
    })
}

/// What differs from the CPU's mesh.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Check {
    /// Triangles here minus those of the CPU.
    pub(super) triangles: i64,
    /// Area here over the CPU's, minus 1.
    pub(super) area: f64,
    /// Volume likewise.
    pub(super) volume: f64,
    pub(super) closed: bool,
}

/// Measures a case.
///
/// # Errors
/// In words, as the device or the core put it.
pub(super) fn measure(
    engine: &mut Engine,
    spheres: &Spheres,
    params: &SurfaceParams,
    runs: usize,
    rates: Option<&Rates>,
    check: bool,
) -> Result<Row, String> {
    let limits = LIMITS;
    let [mut prepare, mut ready, mut read, mut device, mut summed] = [const { Vec::new() }; 5];
    let mut stages: Vec<(Stage, Vec<f64>)> = Vec::new();
    let mut last = None;
    for run in 0..WARM_UP + runs {
        // The mesh before goes first: its memory is what this one lands in.
        drop(last.take());
        let start = Instant::now();
        let elapsed = || start.elapsed().as_secs_f64() * 1e3;
        let prepared =
            Arc::new(Prepared::new(spheres, params, &limits, &Control::default()).map_err(|e| e.to_string())?);
        let prepared_at = elapsed();
        let job = GpuJob { prepared: prepared.clone(), cancel: CancelToken::default(), deadline: None };
        let finished = engine.run(std::slice::from_ref(&job)).pop().ok_or("no answer")?.map_err(|e| e.to_string())?;
        let ready_at = elapsed();
        // The value itself is of no interest, but it must be computed.
        std::hint::black_box(sum_of_bytes(&finished.meshed.mesh));
        let read_at = elapsed();
        let metered = engine.metered();
        if run >= WARM_UP {
            prepare.push(prepared_at);
            ready.push(ready_at);
            read.push(read_at);
            device.push(metered.device_ns as f64 * 1e-6);
            summed.push(finished.stages.iter().map(|(_, ns)| *ns as f64 * 1e-6).sum());
            for (i, (stage, ns)) in finished.stages.iter().enumerate() {
                if stages.len() == i {
                    stages.push((*stage, Vec::new()));
                }
                stages[i].1.push(*ns as f64 * 1e-6);
            }
        }
        last = Some((prepared, finished, metered));
    }
    let (prepared, finished, metered) = last.ok_or("no run")?;
    let meshed = &finished.meshed;
    let rows: Vec<_> = stages.into_iter().map(|(stage, ms)| stage_row(stage, ms, &prepared, meshed, rates)).collect();
    let floor_ms = rows.iter().map(|row| row.floor_ms).sum::<Option<f64>>().filter(|floor| *floor > 0.0);
    let device_ms = Spread::of(device);
    let bytes = meshed.mesh.bytes();
    Ok(Row {
        resolution: params.resolution,
        atoms: spheres.len(),
        box_cells: prepared.lattice.box_cells,
        bricks: prepared.plan.bricks.len(),
        surface_bricks: meshed.grid.surface_bricks,
        pairs: prepared.plan.pairs,
        vertices: meshed.mesh.n_vertices(),
        triangles: meshed.mesh.n_triangles(),
        step: params.quantize.map(Step::length),
        bytes,
        submissions: metered.submissions,
        stages: rows,
        stages_ms: Spread::of(summed),
        device_ms,
        floor_ms,
        ratio: floor_ms.map(|floor| device_ms.median / floor),
        prepare_ms: Spread::of(prepare),
        ready_ms: Spread::of(ready),
        read_ms: Spread::of(read),
        transfer_floor_ms: rates.map(|rates| bytes as f64 / rates.to_host * 1e3),
        check: check.then(|| compare(meshed, spheres, params, &limits)).transpose()?,
        paper: None,
    })
}

fn stage_row(stage: Stage, ms: Vec<f64>, job: &Prepared, meshed: &MeshOutput, rates: Option<&Rates>) -> StageRow {
    let (ms, work) = (Spread::of(ms), Work::of(stage, job, meshed));
    let floor_ms = rates.map(|rates| work.seconds(rates) * 1e3);
    let ratio = floor_ms.map(|floor| ms.median / floor);
    StageRow { stage: stage.name(), ms, bytes: work.bytes, fmas: work.fmas, floor_ms, ratio }
}

/// Every byte of a mesh, added up in words.
pub(super) fn sum_of_bytes(mesh: &Mesh) -> u64 {
    fn sum(bytes: &[u8]) -> u64 {
        let words = |part: &[u8]| {
            let (words, rest) = part.as_chunks::<8>();
            let sum = words.iter().fold(0_u64, |s, word| s.wrapping_add(u64::from_le_bytes(*word)));
            rest.iter().fold(sum, |s, byte| s.wrapping_add(u64::from(*byte)))
        };
        bytes.par_chunks(1 << 20).map(words).reduce(|| 0, u64::wrapping_add)
    }
    bytes_of(mesh).into_iter().map(sum).fold(0, u64::wrapping_add)
}

/// Every column of a mesh, where it lies: one in pieces need not be joined for this.
pub(super) fn bytes_of(mesh: &Mesh) -> Vec<&[u8]> {
    let floats = mesh.positions.pieces().chain(mesh.normals.pieces()).map(bytemuck::cast_slice);
    let rounded = mesh.quantized.iter().flat_map(|q| {
        q.positions.pieces().map(bytemuck::cast_slice).chain(q.normals.pieces().map(bytemuck::cast_slice))
    });
    floats.chain(rounded).chain(mesh.triangles.pieces().map(bytemuck::cast_slice)).collect()
}

fn compare(
    meshed: &MeshOutput,
    spheres: &Spheres,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
) -> Result<Check, String> {
    let control = Control::default();
    let words = |e: molmesh::surface::SurfaceError| e.to_string();
    let of = |mesh: &Mesh| Measures::of(mesh, Validation::Checksum, &control).map_err(words);
    let theirs = CpuBackend::new(None)?.run(spheres, params, limits, &control).map_err(words)?;
    let (here, there) = (of(&meshed.mesh)?, of(&theirs.mesh)?);
    let count = |mesh: &Mesh| i64::try_from(mesh.n_triangles()).unwrap_or(i64::MAX);
    Ok(Check {
        triangles: count(&meshed.mesh) - count(&theirs.mesh),
        area: here.area / there.area - 1.0,
        volume: here.volume / there.volume - 1.0,
        closed: here.closed,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_is_the_median_and_the_least() {
        let of = |values: &[f64]| Spread::of(values.to_vec());
        assert_eq!(of(&[3.0, 1.0, 2.0]), Spread { median: 2.0, min: 1.0 });
        assert_eq!(of(&[4.0, 1.0, 2.0, 3.0]), Spread { median: 2.5, min: 1.0 });
        assert_eq!(of(&[]), Spread { median: 0.0, min: 0.0 });
    }

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
        let (before, read) = (sum_of_bytes(&mesh), bytes_of(&mesh).iter().map(|part| part.len() as u64).sum::<u64>());
        assert_eq!(read, mesh.bytes());
        mesh.quantized.iter_mut().for_each(|q| q.normals[4][0] += 1);
        assert_ne!(sum_of_bytes(&mesh), before);
    }

    #[test]
    fn a_mesh_that_differs_is_seen_to_differ() {
        let spheres = super::super::cases::ball(60, 1);
        let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
        let run = || CpuBackend::new(None).unwrap().run(&spheres, &params, &limits, &Control::default()).unwrap();
        let same = compare(&run(), &spheres, &params, &limits).unwrap();
        assert!(same.triangles == 0 && same.area.abs() < 1e-12 && same.closed, "{same:?}");
        let mut other = run();
        // They would no longer be where the triangles are.
        other.mesh.parts.clear();
        other.mesh.triangles = other.mesh.triangles[1..].to_vec().into();
        other.mesh.positions[0][0] += 0.1;
        let other = compare(&other, &spheres, &params, &limits).unwrap();
        assert!(other.triangles == -1 && other.area.abs() > 1e-9 && !other.closed, "{other:?}");
    }
}
