//! Software Vulkan device for tests. Tests fail if it is missing.

#![allow(dead_code, reason = "every test binary uses some of it")]

use std::sync::{Arc, Mutex, MutexGuard, OnceLock};

pub(crate) use crate::tools::shapes::Random;

use molmesh::gpu::{DeviceLimits, Engine, Executor, Finished, GpuError, GpuJob, Prepared};
use molmesh::surface::{
    CancelToken, Control, Measures, MeshOutput, Spheres, Step, SurfaceKind, SurfaceLimits, SurfaceOptions,
    SurfaceParams, Validation,
};

/// Maximum relative difference of densities of two backends; of densities below 0.1, relative to 0.1.
pub(crate) const FIELD_BOUND: f32 = 1e-5;
/// Maximum distance of vertices of two backends along an axis, Å. Densities that differ by [`FIELD_BOUND`] move a
/// vertex by up to spacing · 2 · `FIELD_BOUND` / s, if the densities at the ends of its edge differ by s isovalues: for
/// a spacing of 0.5 Å and flat edges (s = 0.04), 2.5e-4 Å. Six roundings of coordinates below 64 Å (3.8e-6 Å each) add
/// a tenth of that.
pub(crate) const POSITION_BOUND: f32 = 0.5 * 2.0 * FIELD_BOUND / 0.04 + 6.0 * 3.8e-6;

pub(crate) const SURFACES: [SurfaceKind; 6] = [
    SurfaceKind::Gaussian,
    SurfaceKind::SoftObject,
    SurfaceKind::InverseSquare,
    SurfaceKind::Vdw,
    SurfaceKind::Sas,
    SurfaceKind::Ses,
];

/// Opens a Vulkan device with the limits of its adapter.
pub(crate) fn device() -> (wgpu::Device, wgpu::Queue) {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::VULKAN;
    let instance = wgpu::Instance::new(descriptor);
    let adapter = pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default()))
        .expect("a Vulkan adapter: install Mesa's lavapipe");
    let features = adapter.features() & wgpu::Features::TIMESTAMP_QUERY;
    pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
        label: Some("molmesh.test"),
        required_features: features,
        required_limits: adapter.limits(),
        ..Default::default()
    }))
    .expect("a device")
}

/// Returns the engine that all tests of a binary share, because compiling it takes longer than most tests.
pub(crate) fn engine() -> MutexGuard<'static, Engine> {
    static ENGINE: OnceLock<Mutex<Engine>> = OnceLock::new();
    let make = || {
        let (device, queue) = device();
        Mutex::new(Engine::new(device, queue).expect("the stages compile"))
    };
    ENGINE.get_or_init(make).lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Creates an engine with the budget of the device as modified by `change`.
pub(crate) fn engine_with(change: impl FnOnce(&mut DeviceLimits)) -> Engine {
    let (device, queue) = device();
    let mut budget = DeviceLimits::of(&device.limits());
    change(&mut budget);
    Engine::with_budget(device, queue, budget).expect("the stages compile")
}

pub(crate) fn job(spheres: &Spheres, params: &SurfaceParams) -> GpuJob {
    let prepared = Prepared::new(spheres, params, &SurfaceLimits::default(), &Control::default()).expect("prepared");
    GpuJob { prepared: Arc::new(prepared), cancel: CancelToken::default(), deadline: None }
}

/// Runs jobs together and measures their meshes.
pub(crate) fn run_all(engine: &mut Engine, jobs: &[GpuJob]) -> Vec<Result<Finished, GpuError>> {
    let measured = |(result, job): (Result<Finished, GpuError>, &GpuJob)| {
        let mut finished = result?;
        finished.measure(&job.prepared)?;
        Ok(finished)
    };
    engine.run(jobs).into_iter().zip(jobs).map(measured).collect()
}

pub(crate) fn run(engine: &mut Engine, job: &GpuJob) -> Result<Finished, GpuError> {
    run_all(engine, std::slice::from_ref(job)).pop().expect("one answer")
}

pub(crate) fn mesh_of(engine: &mut Engine, spheres: &Spheres, params: &SurfaceParams) -> MeshOutput {
    run(engine, &job(spheres, params)).expect("a mesh").meshed
}

pub(crate) fn spheres(rows: &[[f64; 4]]) -> Spheres {
    let column = |k: usize| rows.iter().map(|row| row[k]).collect();
    #[expect(clippy::cast_possible_truncation, reason = "radii of tests")]
    let radii = rows.iter().map(|row| row[3] as f32).collect();
    Spheres::new(column(0), column(1), column(2), radii).expect("usable spheres")
}

pub(crate) fn params(surface: SurfaceKind, resolution: f64) -> SurfaceParams {
    let options = SurfaceOptions { surface: Some(surface), resolution: Some(resolution), ..SurfaceOptions::default() };
    SurfaceParams::new(&options).expect("valid")
}

/// Returns the parameters with vertices quantized to the smallest step that covers them.
pub(crate) fn quantized(spheres: &Spheres, params: &SurfaceParams) -> SurfaceParams {
    let step = Step::covering(molmesh::surface::lattice::extent(spheres, params));
    SurfaceParams { quantize: Some(step), ..params.clone() }
}

pub(crate) fn measures(meshed: &MeshOutput) -> Measures {
    Measures::of(&meshed.mesh, Validation::Exact, &Control::default()).expect("not cancelled")
}

/// Returns the spheres of a structure in `samples/`.
pub(crate) fn sample(name: &str) -> Spheres {
    use molmesh::structure;
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("samples").join(name);
    let bytes = std::fs::read(path).expect("a sample");
    let structure = structure::read(&bytes, &structure::ReadLimits::default()).expect("readable");
    structure::select(&structure, &structure::Selection::default())
        .expect("atoms")
        .spheres(&structure)
        .expect("spheres")
}
