//! Times of jobs that are divided among several devices.

use std::fmt::Write as _;
use std::time::Instant;

use molmesh::gpu::{CompletedJob, GpuBackend, PoolSettings};
use molmesh::surface::{DeviceChoice, Spheres, Step, SurfaceParams};
use serde::Serialize;
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

use super::cases::Case;
use super::measure::byte_columns;
use super::{WARM_UP, on_more_devices, prepare};
use crate::error::{Error, Result};
use crate::print;
use crate::stats::Summary;

/// Measurements of a case on several devices. Times are in ms.
#[derive(Debug, Serialize)]
struct CaseOnDevices {
    case: &'static str,
    devices: usize,
    atoms: usize,
    bricks: usize,
    triangles: usize,
    /// Quantization step of the vertices, Å.
    step: Option<f32>,
    /// Size of the mesh, bytes.
    bytes: u64,
    /// Preparation on the host: lattice and plan.
    prepare_ms: Summary,
    /// Time from spheres to a mesh in host memory.
    ready_ms: Summary,
    /// Parts by device.
    by: Vec<Part>,
    /// True if the mesh has the same bytes as on a single device.
    same: bool,
}

/// Part of one device.
#[derive(Debug, Serialize)]
struct Part {
    device: String,
    /// Device time by stage, ms.
    stages: Vec<(&'static str, Summary)>,
    stages_ms: Summary,
}

/// Measures `cases` on 1, 2, 4, … devices of `choice`, with at least `min_bricks` bricks per device.
pub(super) fn run(
    choice: &DeviceChoice,
    min_bricks: u64,
    cases: &[(Case, Spheres, SurfaceParams)],
    runs: usize,
) -> Result<Value> {
    print("one structure at a time; ms, medians (minima)\n")?;
    let (mut rows, mut digests) = (Vec::new(), vec![None; cases.len()]);
    let settings = PoolSettings { min_partition_bricks: Some(min_bricks), ..PoolSettings::default() };
    on_more_devices(choice, &settings, |backend, devices| {
        for ((case, spheres, params), first) in cases.iter().zip(&mut digests) {
            let (row, digest) = measure(backend, spheres, params, runs)?;
            let same = *first.get_or_insert_with(|| digest.clone()) == digest;
            let row = CaseOnDevices { case: case.name, devices, same, ..row };
            print(&text(&row))?;
            rows.push(row);
        }
        Ok(())
    })?;
    Ok(json!({ "spread": rows, "runs": runs }))
}

/// Measures a case on the devices of `backend`. Also returns the SHA-256 digest of its mesh.
fn measure(
    backend: &GpuBackend,
    spheres: &Spheres,
    params: &SurfaceParams,
    runs: usize,
) -> Result<(CaseOnDevices, Vec<u8>)> {
    let [mut prepare_ms, mut ready_ms] = [const { Vec::new() }; 2];
    let mut all: Vec<CompletedJob> = Vec::with_capacity(runs);
    let mut last = None;
    for run in 0..WARM_UP + runs {
        // Drop the previous mesh first, so that its memory is reused.
        drop(last.take());
        let start = Instant::now();
        let job = prepare(spheres, params)?;
        let prepared_at = start.elapsed().as_secs_f64() * 1e3;
        let mut ran = backend.pool().run(&job).map_err(Error::failed)?;
        let ready_at = start.elapsed().as_secs_f64() * 1e3;
        let mesh = std::mem::take(&mut ran.finished.meshed.mesh);
        if run >= WARM_UP {
            prepare_ms.push(prepared_at);
            ready_ms.push(ready_at);
            all.push(ran);
        }
        last = Some((job, mesh));
    }
    let (job, mesh) = last.ok_or_else(|| Error::failed("no run"))?;
    let row = CaseOnDevices {
        case: "",
        devices: 0,
        atoms: spheres.len(),
        bricks: job.prepared.plan.bricks.len(),
        triangles: mesh.n_triangles(),
        step: params.quantize.map(Step::length),
        bytes: mesh.bytes(),
        prepare_ms: Summary::of(prepare_ms),
        ready_ms: Summary::of(ready_ms),
        by: parts(&all),
        same: false,
    };
    let digest = byte_columns(&mesh).into_iter().fold(Sha256::new(), Sha256::chain_update);
    Ok((row, digest.finalize().to_vec()))
}

/// Summarizes each part over all runs. The parts are the same in all runs, but idle devices take them in any order.
fn parts(all: &[CompletedJob]) -> Vec<Part> {
    let n = all.iter().map(|ran| ran.devices.len()).min().unwrap_or_default();
    let part = |k: usize| {
        let ms = |ns: u64| ns as f64 * 1e-6;
        let first = &all[0].devices[k];
        let stage =
            |i: usize| all.iter().filter_map(move |ran| ran.devices[k].stages.get(i)).map(move |(_, ns)| ms(*ns));
        Part {
            device: first.device.clone(),
            stages: (0..first.stages.len()).map(|i| (first.stages[i].0.name(), Summary::of(stage(i)))).collect(),
            stages_ms: Summary::of(all.iter().map(|ran| ran.devices[k].stages.iter().map(|(_, ns)| ms(*ns)).sum())),
        }
    };
    (0..n).map(part).collect()
}

fn text(r: &CaseOnDevices) -> String {
    let mut text = format!(
        "{} on {}: {} atoms, {} bricks, {} triangles, {:.1} MB: prepare {:.1}, ready {:.1} ({:.1}); {}\n",
        r.case,
        r.devices,
        r.atoms,
        r.bricks,
        r.triangles,
        r.bytes as f64 * 1e-6,
        r.prepare_ms.median,
        r.ready_ms.median,
        r.ready_ms.min,
        if r.same { "the same bytes as on one device" } else { "OTHER BYTES THAN ON ONE DEVICE" },
    );
    for (k, part) in r.by.iter().enumerate() {
        let stages: Vec<String> = part.stages.iter().map(|(stage, ms)| format!("{stage} {:.3}", ms.median)).collect();
        // Writing to a string does not fail.
        _ = writeln!(text, "  part {k}, {}: {}; sum {:.3}", part.device, stages.join(", "), part.stages_ms.median);
    }
    text
}
