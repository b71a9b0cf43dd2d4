//! Multi-device jobs: the mesh has the same bytes as that of one device, and failures of devices are handled. Two
//! engines on the software adapter serve as two devices.

use crate::gpu_support;

use std::collections::HashMap;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use gpu_support::{Random, SURFACES, engine, job, params, quantized, run, sample, spheres};
use molmesh::gpu::{
    CompletedJob, DeviceLimits, DevicePool, Engine, Executor, Finished, GpuBackend, GpuError, GpuJob, PartitionHandle,
    PoolDevice, PoolSettings,
};
use molmesh::surface::{
    Backend, Control, Limit, Measures, Mesh, MeshOutput, Quantized, Spheres, Step, SurfaceError, SurfaceKind,
    SurfaceLimits, SurfaceOptions, SurfaceParams, Validation,
};

/// Runs every job on all devices if possible.
const SETTINGS: PoolSettings = PoolSettings {
    queue: 64,
    batch: 16,
    rebuild_pause: Duration::ZERO,
    idle: Duration::from_secs(5),
    hang_timeout: Duration::MAX,
    cool_down: Duration::MAX,
    readback_bytes: None,
    min_partition_bricks: Some(1),
};

/// Starts a pool of `n` software devices, each with the budget as modified by `change`.
fn pool(n: usize, change: fn(&mut DeviceLimits), settings: PoolSettings) -> DevicePool {
    let device = |number| {
        let build = move || Ok(Box::new(gpu_support::engine_with(change)) as Box<dyn Executor>);
        PoolDevice { number, name: format!("device {number}"), build: Box::new(build) }
    };
    DevicePool::start((0..n).map(device).collect(), &settings).unwrap()
}

/// Returns the first column whose bytes differ.
fn difference(a: &Mesh, b: &Mesh) -> Option<&'static str> {
    fn bytes<T: bytemuck::Pod>(rows: &[T]) -> &[u8] {
        bytemuck::cast_slice(rows)
    }
    let ids = |mesh: &Mesh| mesh.atom_ids.as_ref().map(|ids| bytes(ids).to_vec());
    let steps = |mesh: &Mesh| mesh.quantized.as_ref().map(|q| (q.step, bytes(&q.positions).to_vec()));
    let units = |mesh: &Mesh| mesh.quantized.as_ref().map(|q| bytes(&q.normals).to_vec());
    [
        ("quantized positions", steps(a) == steps(b)),
        ("quantized normals", units(a) == units(b)),
        ("positions", bytes(&a.positions) == bytes(&b.positions)),
        ("normals", bytes(&a.normals) == bytes(&b.normals)),
        ("triangles", bytes(&a.triangles) == bytes(&b.triangles)),
        ("atom ids", ids(a) == ids(b)),
        ("centre", bytes(&a.centre) == bytes(&b.centre)),
    ]
    .into_iter()
    .find_map(|(what, same)| (!same).then_some(what))
}

/// Asserts that `devices` devices made the mesh and that one device gives the same bytes. Returns the mesh.
#[track_caller]
fn assert_same(ran: &CompletedJob, job: &GpuJob, devices: usize, what: &str) -> Mesh {
    let alone = run(&mut engine(), job).unwrap().meshed;
    assert_equals(ran, &alone, job, devices, what)
}

/// The same, with the mesh of one device.
#[track_caller]
fn assert_equals(ran: &CompletedJob, alone: &MeshOutput, job: &GpuJob, devices: usize, what: &str) -> Mesh {
    let mut together = ran.finished.clone();
    together.measure(&job.prepared).unwrap();
    assert!(alone.measures.is_some());
    assert_eq!((&together.meshed.measures, together.meshed.bounds), (&alone.measures, alone.bounds), "{what}");
    assert_eq!(ran.devices.len(), devices, "{what}");
    assert_eq!(difference(&ran.finished.meshed.mesh, &alone.mesh), None, "{what}");
    assert_eq!(ran.finished.meshed.grid, alone.grid, "{what}");
    ran.finished.meshed.mesh.clone()
}

/// Random atoms around the corner of eight tiles.
fn crowd(n: usize) -> Spheres {
    let cloud = Random(11).cloud(n, 60.0);
    spheres(&cloud.iter().map(|[x, y, z, r]| [x - 20.0, y + 3.0, z - 40.0, *r]).collect::<Vec<_>>())
}

fn with_ids(surface: SurfaceKind, resolution: f64) -> SurfaceParams {
    let (surface, resolution) = (Some(surface), Some(resolution));
    SurfaceParams::new(&SurfaceOptions { surface, resolution, atom_ids: true, ..SurfaceOptions::default() }).unwrap()
}

/// Number of triangles with vertices of several partitions.
fn n_across(mesh: &Mesh, job: &GpuJob, n: usize) -> usize {
    let (plan, lattice) = (&job.prepared.plan, &job.prepared.lattice);
    let parts = plan.partitions(n);
    let partition = |brick: u32| parts.iter().position(|part| part.bricks.contains(&brick)).unwrap();
    let coord = |brick: u32| {
        let tile = plan.tiles[(brick >> 9) as usize].coord;
        std::array::from_fn(|k| 8 * tile[k] + (brick >> (3 * k) & 7).cast_signed())
    };
    let of_brick: HashMap<[i32; 3], usize> =
        plan.bricks.iter().zip(0..).map(|(brick, id)| (coord(*brick), partition(id))).collect();
    // A vertex belongs to the brick of the last grid point before it.
    #[expect(clippy::cast_possible_truncation, reason = "a few grid points")]
    let of_vertex = |v: u32| {
        let p = mesh.positions[v as usize].map(|c| (f64::from(c) / lattice.spacing + 1e-4).floor() as i32);
        of_brick[&std::array::from_fn(|k| (p[k] + lattice.centre[k]).div_euclid(8))]
    };
    let across = |t: &&[u32; 3]| t.iter().any(|v| of_vertex(*v) != of_vertex(t[0]));
    mesh.triangles.iter().filter(across).count()
}

#[test]
fn a_multi_device_mesh_has_the_bytes_of_one_device() {
    let pools = [2, 3].map(|n| (n, pool(n, |_| (), SETTINGS)));
    let far = spheres(&[[-400.0, 300.0, 20.0, 1.2], [500.0, -200.0, 900.0, 1.9]]);
    let cases = [
        ("4pti", sample("4pti.pdb"), 0.45),
        ("a crowd", crowd(500), 0.6),
        ("a coarse crowd", crowd(900), 1.4),
        ("two atoms far apart", far, 0.5),
    ];
    for (name, spheres, resolution) in cases {
        for (i, surface) in SURFACES.into_iter().enumerate() {
            // Nearest atoms in one case of three.
            let ids = (name.len() + i) % 3 == 1;
            let params = if ids { with_ids(surface, resolution) } else { params(surface, resolution) };
            // Quantized vertices in two cases of three.
            let small = !(name.len() + i).is_multiple_of(3);
            let job = job(&spheres, &if small { quantized(&spheres, &params) } else { params });
            let alone = run(&mut engine(), &job).unwrap().meshed;
            for (n, pool) in &pools {
                let parts = job.prepared.plan.partitions(*n);
                let what = format!("{name} {surface} on {n}");
                let ran = pool.run(&job).unwrap();
                let mesh = assert_equals(&ran, &alone, &job, parts.len(), &what);
                assert_eq!((mesh.atom_ids.is_some(), mesh.quantized.is_some()), (ids, small));
                let measures = Measures::of(&ran.finished.meshed.mesh, Validation::Exact, &Control::default()).unwrap();
                assert!(measures.closed && measures.manifold, "{what}");
            }
        }
    }
    for (n, pool) in &pools {
        assert!(
            pool.status().iter().all(|device| device.partitions >= 9 && device.failed == 0),
            "{n}: {:?}",
            pool.status()
        );
    }
}

#[test]
fn control_the_comparison_finds_differences_and_partitions_depend_on_each_other() {
    let job = job(&crowd(300), &with_ids(SURFACES[0], 0.8));
    let ran = pool(2, |_| (), SETTINGS).run(&job).unwrap();
    let good = assert_same(&ran, &job, 2, "two");
    assert!(n_across(&good, &job, 2) > 20, "the boundary does not cross the surface");
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
    assert_eq!(changed(&|q| q.positions[3][1] ^= 1), Some("quantized positions"));
    assert_eq!(changed(&|q| q.step = Step::covering(1.0)), Some("quantized positions"));
    assert_eq!(changed(&|q| q.normals[3][0] ^= 1), Some("quantized normals"));
}

#[test]
fn a_partition_may_have_no_surface() {
    // A molecule, and atoms behind it that are too small for the grid.
    let mut rows: Vec<[f64; 4]> = Random(3).cloud(60, 20.0);
    rows.extend((0..60).map(|i| [1.0, 1.0, 301.0 + 100.0 * f64::from(i), 0.3]));
    let job = job(&spheres(&rows), &params(SURFACES[1], 2.0));
    for n in [2, 3] {
        let parts = job.prepared.plan.partitions(n);
        let last = &job.prepared.plan.tiles[parts[n - 1].tiles.start];
        assert!(last.coord[2] > 1, "{:?} begins with the molecule", last.coord);
        let mesh = assert_same(&pool(n, |_| (), SETTINGS).run(&job).unwrap(), &job, n, "empty partitions");
        assert!(mesh.n_triangles() > 100);
    }
}

/// Change of a budget.
type Change = fn(&mut DeviceLimits);

#[test]
fn partitions_in_chunks_pieces_and_readback_buffers_have_the_same_bytes() {
    let crowd = crowd(900);
    let plain = with_ids(SURFACES[0], 0.5);
    let jobs = [job(&crowd, &plain), job(&crowd, &quantized(&crowd, &plain))];
    let alone = jobs.each_ref().map(|job| run(&mut engine(), job).unwrap().meshed);
    let cut: [(&str, Change); 3] = [
        ("chunks", |b| b.chunk_bricks = 900),
        ("readback buffers", |b| b.readback_bytes = 1 << 20),
        ("both", |b| (b.chunk_bricks, b.piece_bytes, b.readback_bytes) = (1200, 1 << 20, 2 << 20)),
    ];
    for (what, change) in cut {
        let pool = pool(2, change, SETTINGS);
        for i in [0, 0, 1, 1, 0] {
            // Later runs reuse buffers that hold the previous job.
            assert_equals(&pool.run(&jobs[i]).unwrap(), &alone[i], &jobs[i], 2, what);
        }
    }
}

#[test]
fn the_number_of_devices_depends_on_settings_and_job_size() {
    let job = job(&crowd(300), &params(SURFACES[0], 1.0));
    let bricks = job.prepared.plan.bricks.len() as u64;
    let by = |n, min_partition_bricks| {
        let pool = pool(n, |_| (), PoolSettings { min_partition_bricks, ..SETTINGS });
        pool.run(&job).unwrap().devices.len()
    };
    assert_eq!((by(2, Some(bricks / 2)), by(2, Some(bricks / 2 + 1)), by(2, None), by(1, Some(1))), (2, 1, 1, 1));
    // Three devices, but bricks for two partitions only.
    assert_eq!(by(3, Some(bricks / 2)), 2);
}

#[test]
fn all_devices_are_reported() {
    let backend = GpuBackend::with_pool(pool(2, |_| (), SETTINGS));
    let meshed =
        backend.run(&crowd(200), &params(SURFACES[0], 1.0), &SurfaceLimits::default(), &Control::default()).unwrap();
    assert_eq!(meshed.made_by.unwrap().device, "2 devices: device 0, device 1");
    assert!(backend.devices().iter().all(|device| (device.finished, device.partitions) == (1, 1)));
}

#[test]
fn errors_are_those_of_one_device() {
    let two = pool(2, |_| (), SETTINGS);
    let refused = |job: &GpuJob| {
        let alone = run(&mut engine(), job).map(drop).unwrap_err();
        assert_eq!(two.run(job).map(drop).unwrap_err(), alone);
        alone
    };
    let crowd = crowd(300);
    let none = SurfaceOptions { isovalue: Some(1e6), ..SurfaceOptions::default() };
    let error = refused(&job(&crowd, &SurfaceParams::new(&none).unwrap()));
    assert!(matches!(error, GpuError::Surface(SurfaceError::NoSurface { .. })), "{error}");
    let whole = run(&mut engine(), &job(&crowd, &params(SURFACES[0], 0.8))).unwrap().meshed.mesh;
    let bytes = whole.bytes();
    // Limits above and below the size of a partition.
    for max_mesh_bytes in [bytes - 1, bytes / 10] {
        let limits = SurfaceLimits { max_mesh_bytes, ..SurfaceLimits::default() };
        let prepared =
            molmesh::gpu::Prepared::new(&crowd, &params(SURFACES[0], 0.8), &limits, &Control::default()).unwrap();
        let error = refused(&GpuJob { prepared: Arc::new(prepared), ..job(&crowd, &params(SURFACES[0], 0.8)) });
        assert!(matches!(&error, GpuError::Surface(error) if error.exceeded(Limit::MeshBytes).is_some()), "{error}");
    }
    assert!(two.status().iter().all(|device| device.failed == 0));
}

#[test]
fn concurrent_callers_neither_deadlock_nor_mix_partitions() {
    let three = pool(3, |_| (), SETTINGS);
    let jobs: Vec<GpuJob> =
        (1..=4).map(|i| job(&crowd(100 * i), &params(SURFACES[i % 3], 1.4 + 0.1 * i as f64))).collect();
    let alone: Vec<Mesh> = jobs.iter().map(|job| run(&mut engine(), job).unwrap().meshed.mesh).collect();
    std::thread::scope(|scope| {
        for (job, mesh) in jobs.iter().zip(&alone) {
            let three = &three;
            scope.spawn(move || {
                for _ in 0..3 {
                    assert_eq!(difference(&three.run(job).unwrap().finished.meshed.mesh, mesh), None);
                }
            });
        }
    });
    assert!(three.status().iter().all(|device| device.failed == 0 && device.waiting == 0));
}

/// Behaviour of a device in its first partition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    /// The device is lost before it begins.
    LostAtOnce,
    /// The device is lost after it has published its counts.
    LostHalfWay,
    Panics,
    /// The device does nothing until the job is cancelled or late.
    Idles,
}

fn over(job: &GpuJob) -> bool {
    job.cancel.is_cancelled() || job.deadline.is_some_and(|deadline| deadline <= Instant::now())
}

/// Gate that one device opens for another.
#[derive(Default)]
struct Gate(Mutex<bool>, Condvar);

impl Gate {
    fn open(&self) {
        *self.0.lock().unwrap() = true;
        self.1.notify_all();
    }

    /// Waits until the gate is open or the job is cancelled or late.
    fn pass(&self, job: &GpuJob) {
        let mut open = self.0.lock().unwrap();
        while !*open && !over(job) {
            open = self.1.wait_timeout(open, Duration::from_millis(1)).unwrap().0;
        }
    }
}

/// Engine with a scripted fault, or one that waits for the fault of another.
struct FaultyEngine {
    engine: Engine,
    device: wgpu::Device,
    fault: Option<Fault>,
    gate: Arc<Gate>,
    waits: bool,
}

impl Executor for FaultyEngine {
    fn run(&mut self, jobs: &[GpuJob]) -> Vec<Result<Finished, GpuError>> {
        self.engine.run(jobs)
    }

    fn run_partition(&mut self, job: &GpuJob, partition: &PartitionHandle) -> Result<Finished, GpuError> {
        if self.waits {
            self.gate.pass(job);
        }
        match self.fault.take() {
            None => {}
            Some(Fault::Panics) => {
                self.gate.open();
                panic!("scripted panic");
            }
            Some(Fault::LostAtOnce) => {
                self.device.destroy();
                self.gate.open();
            }
            Some(Fault::LostHalfWay) => {
                let (device, partition, gate) = (self.device.clone(), partition.clone(), Arc::clone(&self.gate));
                std::thread::spawn(move || {
                    while !partition.is_waiting() {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    // It waits for the other partition now, which waits for the gate.
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
        self.engine.run_partition(job, partition)
    }

    fn held_bytes(&self) -> u64 {
        self.engine.held_bytes()
    }
}

/// Two devices: the first has `fault` and can be built `good_builds` times; the second begins after the fault.
fn faulty_pool(fault: Fault, good_builds: usize) -> (DevicePool, Arc<Gate>) {
    let gate = Arc::new(Gate::default());
    let device = |number: usize| {
        let (gate, builds) = (Arc::clone(&gate), AtomicUsize::new(0));
        let build = move || {
            let n = builds.fetch_add(1, Ordering::SeqCst);
            if number == 0 && n >= good_builds {
                return Err(GpuError::Failed("scripted build failure".to_owned()));
            }
            let (device, queue) = gpu_support::device();
            let engine = Engine::new(device.clone(), queue)?;
            let fault = Some(fault).filter(|_| number == 0 && n == 0);
            let waits = number == 1;
            Ok(Box::new(FaultyEngine { engine, device, fault, gate: Arc::clone(&gate), waits }) as Box<dyn Executor>)
        };
        PoolDevice { number, name: format!("device {number}"), build: Box::new(build) }
    };
    let pool = DevicePool::start(vec![device(0), device(1)], &SETTINGS).unwrap();
    (pool, gate)
}

#[test]
fn a_job_is_retried_on_one_device_if_another_fails() {
    let (crowd, params) = (crowd(300), params(SURFACES[0], 0.9));
    let job = job(&crowd, &quantized(&crowd, &params));
    for fault in [Fault::LostHalfWay, Fault::LostAtOnce, Fault::Panics] {
        let (pool, _gate) = faulty_pool(fault, usize::MAX);
        assert_same(&pool.run(&job).unwrap(), &job, 1, &format!("{fault:?}"));
        let status = pool.status();
        assert_eq!((status[0].failed, status[0].rebuilds, status[1].failed), (1, 1, 0), "{fault:?} {status:?}");
        // The rebuilt device takes a partition again.
        assert_same(&pool.run(&job).unwrap(), &job, 2, &format!("after {fault:?}"));
    }
}

#[test]
fn a_device_that_is_lost_permanently_leaves_jobs_to_the_other() {
    let job = job(&crowd(300), &params(SURFACES[0], 0.9));
    let (pool, _gate) = faulty_pool(Fault::LostHalfWay, 1);
    let ran = pool.run(&job).unwrap();
    assert_same(&ran, &job, 1, "lost for good");
    assert_eq!(ran.device(), "device 1");
    let ran = pool.run(&job).unwrap();
    assert_same(&ran, &job, 1, "with one device");
    assert!(pool.status()[0].down.is_some());
}

#[test]
fn cancellation_and_deadline_end_a_wait_for_other_partitions() {
    let started = Instant::now();
    let fresh = || job(&crowd(300), &params(SURFACES[0], 0.9));
    let (pool, _gate) = faulty_pool(Fault::Idles, usize::MAX);
    let mut late = fresh();
    late.deadline = Some(started + Duration::from_millis(1500));
    assert_eq!(pool.run(&late).map(drop).unwrap_err(), GpuError::Surface(SurfaceError::Deadline));
    let (pool, gate) = faulty_pool(Fault::Idles, usize::MAX);
    let cancelled = fresh();
    let error = std::thread::scope(|scope| {
        let running = scope.spawn(|| pool.run(&cancelled).map(drop));
        // The gate opens when the first device idles in this job.
        gate.pass(&cancelled);
        cancelled.cancel.cancel();
        running.join().unwrap().unwrap_err()
    });
    assert_eq!(error, GpuError::Surface(SurfaceError::Cancelled));
    // The devices are idle again and have not failed.
    while pool.status().iter().any(|device| device.waiting > 0) {
        assert!(started.elapsed() < Duration::from_mins(1), "{:?}", pool.status());
        std::thread::sleep(Duration::from_millis(1));
    }
    let job = fresh();
    assert_same(&pool.run(&job).unwrap(), &job, 2, "afterwards");
    assert!(pool.status().iter().all(|device| (device.failed, device.rebuilds) == (0, 0)));
}
