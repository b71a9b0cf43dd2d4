//! One structure at a time through the pool, on one device, two, and so on: whether several make it sooner together.

use std::fmt::Write as _;
use std::sync::Arc;
use std::time::Instant;

use molmesh::gpu::{CompletedJob, GpuBackend, GpuJob, Look, PoolSettings, Prepared, Program, discover};
use molmesh::surface::devices::DeviceName;
use molmesh::surface::{Backend, CancelToken, Control, DeviceChoice, Mesh, Spheres, Step, SurfaceParams};
use serde::Serialize;

use super::super::error::CliError;
use super::cases::Case;
use super::measure::{LIMITS, Spread, WARM_UP, bytes_of, sum_of_bytes};

/// A case on so many devices. Times are in ms.
#[derive(Debug, Clone, Serialize)]
pub(super) struct SpreadRow {
    case: &'static str,
    /// Devices of the pool.
    devices: usize,
    atoms: usize,
    bricks: usize,
    triangles: usize,
    /// What vertices are rounded to, Å; none: they are single-precision numbers.
    step: Option<f32>,
    /// Bytes of the mesh.
    bytes: u64,
    /// On the host, before the devices: lattice and plan.
    prepare_ms: Spread,
    /// From spheres to a mesh of which every byte can be read in host memory.
    ready_ms: Spread,
    /// The same, until every byte was read.
    read_ms: Spread,
    /// What each device did that had a part.
    by: Vec<DeviceRow>,
    /// Whether the mesh has the bytes of the one that a single device makes.
    same: bool,
}

/// One device's share.
#[derive(Debug, Clone, Serialize)]
struct DeviceRow {
    device: String,
    /// Device time per stage, ms.
    stages: Vec<(&'static str, Spread)>,
    stages_ms: Spread,
}

/// Measures `cases` on 1, 2, 4, … devices of those that `choice` takes, with at least `least` bricks a device.
pub(super) fn run(
    choice: &DeviceChoice,
    least: u64,
    cases: &[(Case, Spheres, SurfaceParams)],
    runs: usize,
) -> Result<Vec<SpreadRow>, CliError> {
    let failed = |e: &dyn std::fmt::Display| CliError::Service(e.to_string());
    let found = discover(choice, Look::Thorough);
    if let Some(why) = found.why_none() {
        return Err(CliError::NoBackend { asked: "gpu", why });
    }
    let taken: Vec<usize> = found.devices.iter().filter(|d| d.taken).map(|d| d.number).collect();
    let mut rows = Vec::new();
    let mut alone: Vec<Option<Vec<u8>>> = cases.iter().map(|_| None).collect();
    for devices in (1..=taken.len()).filter(|n| n.is_power_of_two() || *n == taken.len()) {
        let some = DeviceChoice::These(taken[..devices].iter().map(|&n| DeviceName::Number(n)).collect());
        let settings = PoolSettings { min_partition_bricks: Some(least), ..PoolSettings::default() };
        let backend = GpuBackend::start(&discover(&some, Look::Thorough), Program::Stages, &settings, None)
            .map_err(|e| failed(&e))?;
        backend.warm().map_err(|e| failed(&e))?;
        for ((case, spheres, params), alone) in cases.iter().zip(&mut alone) {
            let (row, digest) = measure(&backend, spheres, params, runs).map_err(|why| failed(&why))?;
            let same = *alone.get_or_insert_with(|| digest.clone()) == digest;
            rows.push(SpreadRow { case: case.name, devices, same, ..row });
        }
    }
    Ok(rows)
}

/// One case on the devices of `backend`, and a digest of its mesh.
fn measure(
    backend: &GpuBackend,
    spheres: &Spheres,
    params: &SurfaceParams,
    runs: usize,
) -> Result<(SpreadRow, Vec<u8>), String> {
    let [mut prepare, mut ready, mut read] = [const { Vec::new() }; 3];
    let mut all: Vec<CompletedJob> = Vec::with_capacity(runs);
    let mut last: Option<(Arc<Prepared>, Mesh)> = None;
    for run in 0..WARM_UP + runs {
        // The mesh before goes first: its memory is what this one lands in.
        drop(last.take());
        let start = Instant::now();
        let elapsed = || start.elapsed().as_secs_f64() * 1e3;
        let prepared =
            Arc::new(Prepared::new(spheres, params, &LIMITS, &Control::default()).map_err(|e| e.to_string())?);
        let prepared_at = elapsed();
        let job = GpuJob { prepared: Arc::clone(&prepared), cancel: CancelToken::default(), deadline: None };
        let mut ran = backend.pool().run(&job).map_err(|e| e.to_string())?;
        let ready_at = elapsed();
        let mesh = std::mem::take(&mut ran.finished.meshed.mesh);
        std::hint::black_box(sum_of_bytes(&mesh));
        let read_at = elapsed();
        if run >= WARM_UP {
            prepare.push(prepared_at);
            ready.push(ready_at);
            read.push(read_at);
            all.push(ran);
        }
        last = Some((prepared, mesh));
    }
    let (prepared, mesh) = last.ok_or("no run")?;
    let row = SpreadRow {
        case: "",
        devices: 0,
        atoms: spheres.len(),
        bricks: prepared.plan.bricks.len(),
        triangles: mesh.n_triangles(),
        step: prepared.params.quantize.map(Step::length),
        bytes: mesh.bytes(),
        prepare_ms: Spread::of(prepare),
        ready_ms: Spread::of(ready),
        read_ms: Spread::of(read),
        by: by_device(&all),
        same: false,
    };
    Ok((row, digest(&mesh)))
}

/// Medians of what each device did: the parts are the same in every run, and idle devices take them in turn.
fn by_device(all: &[CompletedJob]) -> Vec<DeviceRow> {
    let n = all.iter().map(|ran| ran.devices.len()).min().unwrap_or_default();
    let part = |k: usize| {
        let works = || all.iter().map(move |ran| &ran.devices[k]);
        let ms = |ns: u64| ns as f64 * 1e-6;
        let first = works().next().map(|work| &work.stages[..]).unwrap_or_default();
        let stage = |(i, (stage, _)): (usize, &(molmesh::surface::Stage, u64))| {
            let times = works().filter_map(|work| work.stages.get(i)).map(|(_, ns)| ms(*ns));
            (stage.name(), Spread::of(times.collect()))
        };
        let sums = works().map(|work| work.stages.iter().map(|(_, ns)| ms(*ns)).sum());
        DeviceRow {
            device: works().next().map(|work| work.device.clone()).unwrap_or_default(),
            stages: first.iter().enumerate().map(stage).collect(),
            stages_ms: Spread::of(sums.collect()),
        }
    };
    (0..n).map(part).collect()
}

/// A SHA-256 of every byte of a mesh, in order, however its columns lie.
fn digest(mesh: &Mesh) -> Vec<u8> {
    use sha2::{Digest as _, Sha256};
    let mut sum = Sha256::new();
    for part in bytes_of(mesh) {
        sum.update(part);
    }
    sum.finalize().to_vec()
}

/// The same as text.
pub(super) fn table(rows: &[SpreadRow]) -> String {
    let mut text = "one structure at a time; ms, medians (least)\n".to_owned();
    // A string takes everything.
    for r in rows {
        _ = writeln!(
            text,
            "{} on {}: {} atoms, {} bricks, {} triangles, {:.1} MB: prepare {:.1}, ready {:.1} ({:.1}), read {:.1} ({:.1}); {}",
            r.case,
            r.devices,
            r.atoms,
            r.bricks,
            r.triangles,
            r.bytes as f64 * 1e-6,
            r.prepare_ms.median,
            r.ready_ms.median,
            r.ready_ms.min,
            r.read_ms.median,
            r.read_ms.min,
            if r.same { "the same bytes as on one" } else { "OTHER BYTES THAN ON ONE" },
        );
        for (k, part) in r.by.iter().enumerate() {
            let stages: Vec<String> =
                part.stages.iter().map(|(stage, ms)| format!("{stage} {:.3}", ms.median)).collect();
            let stages = if stages.is_empty() { "no timestamps".to_owned() } else { stages.join(", ") };
            _ = writeln!(text, "  part {k}, {}: {stages}; summed {:.3}", part.device, part.stages_ms.median);
        }
    }
    text
}
