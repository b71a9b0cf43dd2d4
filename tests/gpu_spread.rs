//! One structure on several devices: the same bytes as on one, whatever it is and however it is cut; and what becomes of it
//! when a device fails half way. Two engines on the same software adapter are two devices here.
#![cfg(feature = "gpu")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]

mod gpu_support;

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use gpu_support::{KERNELS, Random, engine, job, params, rounded, run, sample, spheres};
use molmesh::gpu::{
    Budget, DevicePool, Engine, Executor, Finished, GpuBackend, GpuError, GpuJob, PoolDevice, PoolSettings, Ran, Share,
};
use molmesh::surface::{
    Backend, Control, Kernel, Measures, Mesh, Quantized, Spheres, Step, SurfaceError, SurfaceLimits, SurfaceOptions,
    SurfaceParams, Validation,
};

/// Every job is spread that can be.
const SETTINGS: PoolSettings =
    PoolSettings { queue: 64, batch: 16, pause: Duration::ZERO, rest: Duration::from_secs(5), spread_bricks: Some(1) };

/// A pool of `n` devices of the software adapter, each within what `change` makes of its budget.
fn pool(n: usize, change: fn(&mut Budget), settings: PoolSettings) -> DevicePool {
    let device = |number| {
        let build = move || Ok(Box::new(gpu_support::engine_with(change)) as Box<dyn Executor>);
        PoolDevice { number, name: format!("device {number}"), build: Box::new(build) }
    };
    DevicePool::start((0..n).map(device).collect(), &settings).unwrap()
}

/// What differs between two meshes, to the byte.
fn difference(a: &Mesh, b: &Mesh) -> Option<&'static str> {
    fn bytes<T: bytemuck::Pod>(rows: &[T]) -> &[u8] {
        bytemuck::cast_slice(rows)
    }
    let ids = |mesh: &Mesh| mesh.atom_ids.as_ref().map(|ids| bytes(ids).to_vec());
    let steps = |mesh: &Mesh| mesh.quantized.as_ref().map(|q| (q.step, bytes(&q.positions).to_vec()));
    let units = |mesh: &Mesh| mesh.quantized.as_ref().map(|q| bytes(&q.normals).to_vec());
    [
        ("rounded positions", steps(a) == steps(b)),
        ("rounded normals", units(a) == units(b)),
        ("positions", bytes(&a.positions) == bytes(&b.positions)),
        ("normals", bytes(&a.normals) == bytes(&b.normals)),
        ("triangles", bytes(&a.triangles) == bytes(&b.triangles)),
        ("atom ids", ids(a) == ids(b)),
        ("centre", bytes(&a.centre) == bytes(&b.centre)),
    ]
    .into_iter()
    .find_map(|(what, same)| (!same).then_some(what))
}

/// Asserts that `ran` is what one device makes of `job`, by so many devices. Returns the mesh, with its own parts.
#[track_caller]
fn assert_same(ran: &Ran, job: &GpuJob, devices: usize, what: &str) -> Mesh {
    let alone = run(&mut engine(), job).unwrap().meshed;
    assert_eq!(ran.by.len(), devices, "{what}");
    assert_eq!(difference(&ran.finished.meshed.mesh, &alone.mesh), None, "{what}");
    assert_eq!(ran.finished.meshed.grid, alone.grid, "{what}");
    ran.finished.meshed.mesh.clone()
}

/// A crowd around the corner of eight tiles.
fn crowd(n: usize) -> Spheres {
    let cloud = Random(11).cloud(n, 60.0);
    spheres(&cloud.iter().map(|[x, y, z, r]| [x - 20.0, y + 3.0, z - 40.0, *r]).collect::<Vec<_>>())
}

fn with_ids(kernel: Kernel, resolution: f64) -> SurfaceParams {
    let (kernel, resolution) = (Some(kernel), Some(resolution));
    SurfaceParams::new(&SurfaceOptions { kernel, resolution, atom_ids: true, ..SurfaceOptions::default() }).unwrap()
}

/// Triangles with a corner behind their part's last vertex: what parts need each other for.
fn n_across(mesh: &Mesh, job: &GpuJob, n: usize) -> usize {
    // Each part of the plan begins a group of bricks, which is a part of the mesh.
    let mut groups = 0;
    let mut across = 0;
    for part in job.prepared.plan.parts(n) {
        groups += part.bricks.len().div_ceil(1024);
        let end = mesh.parts.get(groups).map_or((mesh.n_vertices(), mesh.n_triangles()), |end| *end);
        across += mesh.triangles[..end.1].iter().filter(|t| t.iter().any(|v| *v as usize >= end.0)).count();
    }
    across
}

#[test]
fn a_spread_mesh_is_that_of_one_device_to_the_byte() {
    let pools = [2, 3].map(|n| (n, pool(n, |_| (), SETTINGS)));
    let far = spheres(&[[-400.0, 300.0, 20.0, 1.2], [500.0, -200.0, 900.0, 1.9]]);
    let cases = [
        ("4pti", sample("4pti.pdb"), 0.35),
        ("a crowd", crowd(500), 0.6),
        ("a coarse crowd", crowd(900), 1.4),
        ("two atoms far apart", far, 0.5),
    ];
    for (name, spheres, resolution) in cases {
        for (i, kernel) in KERNELS.into_iter().enumerate() {
            // Nearest atoms with one kernel each.
            let ids = (name.len() + i) % 3 == 1;
            let params = if ids { with_ids(kernel, resolution) } else { params(kernel, resolution) };
            // And rounded vertices with two of three.
            let small = !(name.len() + i).is_multiple_of(3);
            let job = job(&spheres, &if small { rounded(&spheres, &params) } else { params });
            for (n, pool) in &pools {
                let parts = job.prepared.plan.parts(*n);
                let what = format!("{name} {kernel} on {n}");
                let ran = pool.ran(&job).unwrap();
                let mesh = assert_same(&ran, &job, parts.len(), &what);
                assert_eq!((mesh.atom_ids.is_some(), mesh.quantized.is_some()), (ids, small));
                let measures = Measures::of(&ran.finished.meshed.mesh, Validation::Exact, &Control::default()).unwrap();
                assert!(measures.closed && measures.manifold, "{what}");
            }
        }
    }
    for (n, pool) in &pools {
        assert!(
            pool.status().iter().all(|device| device.spread >= 9 && device.failed == 0),
            "{n}: {:?}",
            pool.status()
        );
    }
}

#[test]
fn the_comparison_finds_fault_and_parts_need_each_other() {
    let job = job(&crowd(300), &with_ids(KERNELS[0], 0.8));
    let ran = pool(2, |_| (), SETTINGS).ran(&job).unwrap();
    let good = assert_same(&ran, &job, 2, "two");
    assert!(n_across(&good, &job, 2) > 20, "the border does not pass through the surface");
    let changed = |change: &dyn Fn(&mut Mesh)| {
        let mut mesh = good.clone();
        change(&mut mesh);
        difference(&mesh, &good)
    };
    assert_eq!(changed(&|_| ()), None);
    assert_eq!(changed(&|m| m.triangles[7][1] += 1), Some("triangles"));
    assert_eq!(changed(&|m| m.positions[3][1] = f32::from_bits(m.positions[3][1].to_bits() ^ 1)), Some("positions"));
    assert_eq!(changed(&|m| m.normals[3][0] = -m.normals[3][0]), Some("normals"));
    assert_eq!(changed(&|m| m.atom_ids.as_mut().unwrap()[5] += 1), Some("atom ids"));
    let mut good = good;
    good.quantize(Step::covering(100.0));
    let changed = |change: &dyn Fn(&mut Quantized)| {
        let mut mesh = good.clone();
        change(mesh.quantized.as_mut().unwrap());
        difference(&mesh, &good)
    };
    assert_eq!(changed(&|_| ()), None);
    assert_eq!(changed(&|q| q.positions[3][1] ^= 1), Some("rounded positions"));
    assert_eq!(changed(&|q| q.step = Step::covering(1.0)), Some("rounded positions"));
    assert_eq!(changed(&|q| q.normals[3][0] ^= 1), Some("rounded normals"));
}

#[test]
fn a_part_without_a_surface_is_none_the_worse() {
    // Behind a molecule, atoms too small for the samples to hit.
    let mut rows: Vec<[f64; 4]> = Random(3).cloud(60, 20.0);
    rows.extend((0..60).map(|i| [1.0, 1.0, 301.0 + 100.0 * f64::from(i), 0.3]));
    let job = job(&spheres(&rows), &params(KERNELS[1], 2.0));
    for n in [2, 3] {
        let parts = job.prepared.plan.parts(n);
        let last = &job.prepared.plan.tiles[parts[n - 1].tiles.start];
        assert!(last.coord[2] > 1, "{:?} begins with the molecule", last.coord);
        let mesh = assert_same(&pool(n, |_| (), SETTINGS).ran(&job).unwrap(), &job, n, "empty parts");
        assert!(mesh.n_triangles() > 100);
    }
}

/// Makes a budget smaller.
type Change = fn(&mut Budget);

#[test]
fn parts_in_chunks_pieces_and_landings_are_the_same_bytes() {
    let crowd = crowd(900);
    let plain = with_ids(KERNELS[0], 0.5);
    let jobs = [job(&crowd, &plain), job(&crowd, &rounded(&crowd, &plain))];
    let cut: [(&str, Change); 3] = [
        ("chunks", |b| b.chunk_bricks = 900),
        ("landings", |b| b.landing_bytes = 1 << 20),
        ("both", |b| (b.chunk_bricks, b.piece_bytes, b.landing_bytes) = (1200, 1 << 20, 2 << 20)),
    ];
    for (what, change) in cut {
        let pool = pool(2, change, SETTINGS);
        for job in [&jobs[0], &jobs[0], &jobs[1], &jobs[1], &jobs[0]] {
            // The second time with buffers that still hold the first, and other vertices.
            assert_same(&pool.ran(job).unwrap(), job, 2, what);
        }
    }
}

#[test]
fn what_is_spread_is_up_to_the_settings_and_the_devices() {
    let job = job(&crowd(300), &params(KERNELS[0], 1.0));
    let bricks = job.prepared.plan.bricks.len() as u64;
    let by = |n, spread_bricks| {
        let pool = pool(n, |_| (), PoolSettings { spread_bricks, ..SETTINGS });
        pool.ran(&job).unwrap().by.len()
    };
    assert_eq!((by(2, Some(bricks / 2)), by(2, Some(bricks / 2 + 1)), by(2, None), by(1, Some(1))), (2, 1, 1, 1));
    // Three devices, but enough for two.
    assert_eq!(by(3, Some(bricks / 2)), 2);
}

#[test]
fn who_served_is_all_of_them() {
    let backend = GpuBackend::over(pool(2, |_| (), SETTINGS), None);
    let meshed =
        backend.run(&crowd(200), &params(KERNELS[0], 1.0), &SurfaceLimits::default(), &Control::default()).unwrap();
    assert_eq!(meshed.served.unwrap().device, "2 devices: device 0, device 1");
    assert!(backend.devices().iter().all(|device| (device.finished, device.spread) == (1, 1)));
}

#[test]
fn refusals_are_those_of_one_device() {
    let two = pool(2, |_| (), SETTINGS);
    let refused = |job: &GpuJob| {
        let alone = run(&mut engine(), job).map(drop).unwrap_err();
        assert_eq!(two.ran(job).map(drop).unwrap_err(), alone);
        alone
    };
    let crowd = crowd(300);
    let none = SurfaceOptions { isovalue: Some(1e6), ..SurfaceOptions::default() };
    let error = refused(&job(&crowd, &SurfaceParams::new(&none).unwrap()));
    assert!(matches!(error, GpuError::Surface(SurfaceError::NoSurface { .. })), "{error}");
    let whole = run(&mut engine(), &job(&crowd, &params(KERNELS[0], 0.8))).unwrap().meshed.mesh;
    let bytes = Mesh::bytes_for(whole.n_vertices() as u64, whole.n_triangles() as u64);
    // More than a part has, and less.
    for max_mesh_bytes in [bytes - 1, bytes / 10] {
        let limits = SurfaceLimits { max_mesh_bytes, ..SurfaceLimits::default() };
        let prepared =
            molmesh::gpu::Prepared::new(&crowd, &params(KERNELS[0], 0.8), &limits, &Control::default()).unwrap();
        let error = refused(&GpuJob { prepared: Arc::new(prepared), ..job(&crowd, &params(KERNELS[0], 0.8)) });
        assert!(matches!(error, GpuError::Surface(SurfaceError::MeshTooLarge { .. })), "{error}");
    }
    assert!(two.status().iter().all(|device| device.failed == 0));
}

#[test]
fn callers_at_once_neither_wait_for_each_other_for_ever_nor_mix_their_parts() {
    let three = pool(3, |_| (), SETTINGS);
    let jobs: Vec<GpuJob> =
        (1..=4).map(|i| job(&crowd(100 * i), &params(KERNELS[i % 3], 1.0 + 0.1 * i as f64))).collect();
    let alone: Vec<Mesh> = jobs.iter().map(|job| run(&mut engine(), job).unwrap().meshed.mesh).collect();
    std::thread::scope(|scope| {
        for (job, mesh) in jobs.iter().zip(&alone) {
            let three = &three;
            scope.spawn(move || {
                for _ in 0..3 {
                    assert_eq!(difference(&three.ran(job).unwrap().finished.meshed.mesh, mesh), None);
                }
            });
        }
    });
    assert!(three.status().iter().all(|device| device.failed == 0 && device.waiting == 0));
}

/// What a device does with its first part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    /// Its driver takes the device away before it begins.
    LostAtOnce,
    /// After it has told what it found, while it waits for the others.
    LostHalfWay,
    Panics,
    /// Does nothing until the job is over.
    Idles,
}

fn over(job: &GpuJob) -> bool {
    job.cancel.is_cancelled() || job.deadline.is_some_and(|deadline| deadline <= Instant::now())
}

/// A gate that one device opens for another.
#[derive(Default)]
struct Gate(Mutex<bool>, Condvar);

impl Gate {
    fn open(&self) {
        *self.0.lock().unwrap() = true;
        self.1.notify_all();
    }

    /// Waits for it, as long as somebody wants the job.
    fn pass(&self, job: &GpuJob) {
        let mut open = self.0.lock().unwrap();
        while !*open && !over(job) {
            open = self.1.wait_timeout(open, Duration::from_millis(1)).unwrap().0;
        }
    }
}

/// An engine whose first part goes wrong, or that lets another's go wrong first.
struct Rigged {
    engine: Engine,
    device: wgpu::Device,
    fault: Option<Fault>,
    gate: Arc<Gate>,
    waits: bool,
}

impl Executor for Rigged {
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<Result<Finished, GpuError>> {
        self.engine.run(jobs)
    }

    fn part(&mut self, job: &GpuJob, share: &Share) -> Result<Finished, GpuError> {
        if self.waits {
            self.gate.pass(job);
        }
        match self.fault.take() {
            None => {}
            Some(Fault::Panics) => {
                self.gate.open();
                panic!("as told");
            }
            Some(Fault::LostAtOnce) => {
                self.device.destroy();
                self.gate.open();
            }
            Some(Fault::LostHalfWay) => {
                let (device, share, gate) = (self.device.clone(), share.clone(), Arc::clone(&self.gate));
                std::thread::spawn(move || {
                    while share.n_counted() == 0 {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    // It waits for the other part now, which waits for the gate.
                    device.destroy();
                    gate.open();
                });
            }
            Some(Fault::Idles) => {
                self.gate.open();
                while !over(job) {
                    std::thread::sleep(Duration::from_millis(1));
                }
                return Err(GpuError::Surface(SurfaceError::Cancelled));
            }
        }
        self.engine.part(job, share)
    }

    fn held_bytes(&self) -> u64 {
        self.engine.held_bytes()
    }
}

/// Two devices: the first does as `fault` says, the second begins its first part when that has happened. The first is
/// built so many times.
fn rigged(fault: Fault, good_builds: usize) -> (DevicePool, Arc<Gate>) {
    let gate = Arc::new(Gate::default());
    let device = |number: usize| {
        let (gate, builds) = (Arc::clone(&gate), AtomicUsize::new(0));
        let build = move || {
            let n = builds.fetch_add(1, Ordering::SeqCst);
            if number == 0 && n >= good_builds {
                return Err(GpuError::Failed("no build as told".to_owned()));
            }
            let (device, queue) = gpu_support::device();
            let engine = Engine::new(device.clone(), queue)?;
            let fault = Some(fault).filter(|_| number == 0 && n == 0);
            let waits = number == 1;
            Ok(Box::new(Rigged { engine, device, fault, gate: Arc::clone(&gate), waits }) as Box<dyn Executor>)
        };
        PoolDevice { number, name: format!("device {number}"), build: Box::new(build) }
    };
    let pool = DevicePool::start(vec![device(0), device(1)], &SETTINGS).unwrap();
    (pool, gate)
}

#[test]
fn a_device_that_is_lost_half_way_costs_another_attempt_and_nothing_else() {
    let (crowd, params) = (crowd(300), params(KERNELS[0], 0.9));
    let job = job(&crowd, &rounded(&crowd, &params));
    for fault in [Fault::LostHalfWay, Fault::LostAtOnce, Fault::Panics] {
        let (pool, _gate) = rigged(fault, usize::MAX);
        assert_same(&pool.ran(&job).unwrap(), &job, 1, &format!("{fault:?}"));
        let status = pool.status();
        assert_eq!((status[0].failed, status[0].rebuilds, status[1].failed), (1, 1, 0), "{fault:?} {status:?}");
        // What was rebuilt takes its part again.
        assert_same(&pool.ran(&job).unwrap(), &job, 2, &format!("after {fault:?}"));
    }
}

#[test]
fn a_device_that_is_lost_for_good_leaves_the_job_to_the_other() {
    let job = job(&crowd(300), &params(KERNELS[0], 0.9));
    let (pool, _gate) = rigged(Fault::LostHalfWay, 1);
    let ran = pool.ran(&job).unwrap();
    assert_same(&ran, &job, 1, "lost for good");
    assert_eq!(ran.device(), "device 1");
    let ran = pool.ran(&job).unwrap();
    assert_same(&ran, &job, 1, "with one device");
    assert!(pool.status()[0].down.is_some());
}

#[test]
fn a_part_that_waits_for_another_is_cancelled_and_late_in_time() {
    let started = Instant::now();
    let fresh = || job(&crowd(300), &params(KERNELS[0], 0.9));
    let (pool, _gate) = rigged(Fault::Idles, usize::MAX);
    let mut late = fresh();
    late.deadline = Some(started + Duration::from_millis(1500));
    assert_eq!(pool.ran(&late).map(drop).unwrap_err(), GpuError::Deadline);
    let (pool, gate) = rigged(Fault::Idles, usize::MAX);
    let cancelled = fresh();
    let error = std::thread::scope(|scope| {
        let running = scope.spawn(|| pool.ran(&cancelled).map(drop));
        // Its own part idles by now, and not another job's.
        gate.pass(&cancelled);
        cancelled.cancel.cancel();
        running.join().unwrap().unwrap_err()
    });
    assert_eq!(error, GpuError::Surface(SurfaceError::Cancelled));
    // The devices are free again, and well.
    while pool.status().iter().any(|device| device.waiting > 0) {
        assert!(started.elapsed() < Duration::from_mins(1), "{:?}", pool.status());
        std::thread::sleep(Duration::from_millis(1));
    }
    let job = fresh();
    assert_same(&pool.ran(&job).unwrap(), &job, 2, "afterwards");
    assert!(pool.status().iter().all(|device| (device.failed, device.rebuilds) == (0, 0)));
}
