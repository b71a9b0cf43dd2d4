//! Device pool with real engines on software Vulkan: discovery, shared submissions, loss and rebuilding.

use crate::gpu_fakes::wait_for;
use crate::gpu_support;

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use molmesh::gpu::{
    DevicePool, DiscoveryMode, Engine, Executor, GpuBackend, GpuError, PoolDevice, PoolSettings, discover,
};
use molmesh::pipeline::AutoBackend;
use molmesh::surface::{Backend, Control, CpuBackend, MeshOutput, SurfaceError, SurfaceLimits, SurfaceParams};

fn run(backend: &dyn Backend) -> Result<MeshOutput, SurfaceError> {
    let params = SurfaceParams::default();
    backend.run(&gpu_support::sample("4pti.pdb"), &params, &SurfaceLimits::default(), &Control::default())
}

#[test]
fn a_discovered_device_gives_the_mesh_of_the_cpu() {
    let choice = "software".parse().unwrap();
    let backend = GpuBackend::start(&discover(&choice, DiscoveryMode::Thorough), &PoolSettings::default()).unwrap();
    backend.warm_up().unwrap();
    let (cpu, gpu) = (run(&CpuBackend::new(None).unwrap()).unwrap(), run(&backend).unwrap());
    assert_eq!(gpu.mesh.n_triangles(), cpu.mesh.n_triangles());
    let made_by = gpu.made_by.unwrap();
    assert_eq!((made_by.backend, made_by.fallback_reason), ("gpu", None));
    assert_eq!(made_by.device, backend.describe());
    let status = backend.devices().remove(0);
    assert_eq!((status.finished, status.failed, status.down), (2, 0, None));
    assert!(status.held_bytes > 0);
}

#[test]
fn callers_share_submissions_and_get_the_mesh_of_a_single_job() {
    let choice = "software".parse().unwrap();
    let backend = GpuBackend::start(&discover(&choice, DiscoveryMode::Thorough), &PoolSettings::default()).unwrap();
    let alone = run(&backend).unwrap().mesh;
    std::thread::scope(|scope| {
        for _ in 0..12 {
            scope.spawn(|| assert!(run(&backend).unwrap().mesh == alone, "another mesh"));
        }
    });
    let status = backend.devices().remove(0);
    assert_eq!(status.finished, 13);
    assert!(status.shared > 0, "{status:?}");
}

/// Starts a backend whose device is destroyed before each of the first `n_losses` jobs.
fn losing(n_losses: usize) -> GpuBackend {
    /// Engine whose device is destroyed before its next job.
    struct LosingEngine(Engine, Mutex<Option<wgpu::Device>>);
    impl Executor for LosingEngine {
        fn run(&mut self, jobs: &[molmesh::gpu::GpuJob]) -> Vec<Result<molmesh::gpu::Finished, GpuError>> {
            if let Some(device) = self.1.lock().unwrap().take() {
                device.destroy();
            }
            self.0.run(jobs)
        }
        fn held_bytes(&self) -> u64 {
            self.0.held_bytes()
        }
    }
    let builds = AtomicUsize::new(0);
    let build = move || {
        let loses = builds.fetch_add(1, Ordering::SeqCst) < n_losses;
        let (device, queue) = gpu_support::device();
        let engine = Engine::new(device.clone(), queue)?;
        Ok(Box::new(LosingEngine(engine, Mutex::new(loses.then_some(device)))) as Box<dyn Executor>)
    };
    let device = PoolDevice { number: 0, name: "losing".to_owned(), build: Box::new(build) };
    GpuBackend::with_pool(DevicePool::start(vec![device], &PoolSettings::default()).unwrap())
}

#[test]
fn a_lost_device_is_rebuilt_and_gives_the_same_mesh() {
    let working = losing(0);
    let expected = run(&working).unwrap().mesh;
    assert_eq!(working.devices()[0].rebuilds, 0);
    let backend = losing(1);
    assert!(run(&backend).unwrap().mesh == expected, "another mesh");
    let status = backend.devices().remove(0);
    assert_eq!((status.finished, status.failed, status.rebuilds, status.down), (1, 1, 1, None));
}

#[test]
fn the_cpu_replaces_a_device_that_is_lost_permanently() {
    let cpu = run(&CpuBackend::new(None).unwrap()).unwrap().mesh;
    let backend = AutoBackend::new(Box::new(CpuBackend::new(None).unwrap()), Box::new(losing(usize::MAX)));
    for _ in 0..3 {
        let meshed = run(&backend).unwrap();
        assert!(meshed.mesh == cpu, "not the CPU's mesh");
        assert!(meshed.made_by.unwrap().fallback_reason.unwrap().contains("the GPU failed"));
    }
    let why = backend.devices().remove(0).down.unwrap();
    assert!(why.contains("down after 3 rebuilds") && !why.contains('\n'), "{why}");
}

/// Keeps a device busy for about eight seconds with a loop, longer than the limit of a first job. Small dispatches are
/// measured first.
fn occupy(device: &wgpu::Device, queue: &wgpu::Queue) {
    const SHADER: &str = "
        @group(0) @binding(0) var<storage, read_write> out: array<u32>;
        @compute @workgroup_size(1) fn main() {
            var x = out[0];
            for (var i = 0u; i < 40000u; i++) { x = x * 1664525u + (x >> 3u) + 1013904223u; }
            out[0] = x;
        }";
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: None,
        source: wgpu::ShaderSource::Wgsl(SHADER.into()),
    });
    let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: None,
        layout: None,
        module: &module,
        entry_point: None,
        compilation_options: wgpu::PipelineCompilationOptions::default(),
        cache: None,
    });
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: 4,
        usage: wgpu::BufferUsages::STORAGE,
        mapped_at_creation: false,
    });
    let bindings = device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &pipeline.get_bind_group_layout(0),
        entries: &[wgpu::BindGroupEntry { binding: 0, resource: buffer.as_entire_binding() }],
    });
    let run = |workgroups: u32| {
        let begun = Instant::now();
        let mut encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            pass.set_pipeline(&pipeline);
            pass.set_bind_group(0, &bindings, &[]);
            pass.dispatch_workgroups(workgroups, 1, 1);
        }
        queue.submit([encoder.finish()]);
        device.poll(wgpu::PollType::Wait { submission_index: None, timeout: None }).unwrap();
        begun.elapsed().as_secs_f64()
    };
    run(1);
    let n = 256.0 * 8.0 / run(256);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most the largest dispatch")]
    run(n.clamp(256.0, 65_535.0) as u32);
}

#[test]
fn a_device_in_a_long_loop_is_hung_and_used_again() {
    /// Engine whose device runs a long loop before its next job.
    struct Looping(Engine, Option<(wgpu::Device, wgpu::Queue)>);
    impl Executor for Looping {
        fn run(&mut self, jobs: &[molmesh::gpu::GpuJob]) -> Vec<Result<molmesh::gpu::Finished, GpuError>> {
            if let Some((device, queue)) = self.1.take() {
                occupy(&device, &queue);
            }
            self.0.run(jobs)
        }
        fn held_bytes(&self) -> u64 {
            self.0.held_bytes()
        }
    }
    let (device, queue) = gpu_support::device();
    let engine = Engine::new(device.clone(), queue.clone()).unwrap();
    // Built in advance, because compiling the pipelines for software Vulkan may take longer than the limit.
    let looping = Mutex::new(Some(Looping(engine, Some((device, queue)))));
    let build = move || {
        if let Some(looping) = looping.lock().unwrap().take() {
            return Ok(Box::new(looping) as Box<dyn Executor>);
        }
        let (device, queue) = gpu_support::device();
        Ok(Box::new(Engine::new(device, queue)?) as Box<dyn Executor>)
    };
    let device = PoolDevice { number: 0, name: "looping".to_owned(), build: Box::new(build) };
    let times = [1000, 100].map(Duration::from_millis);
    let settings = PoolSettings { hang_timeout: times[0], cool_down: times[1], ..PoolSettings::default() };
    let gpu = GpuBackend::with_pool(DevicePool::start(vec![device], &settings).unwrap());
    let cpu = CpuBackend::new(None).unwrap();
    let expected = run(&cpu).unwrap().mesh;
    let backend = AutoBackend::new(Box::new(cpu), Box::new(gpu));
    let meshed = run(&backend).unwrap();
    assert!(meshed.mesh == expected, "not the CPU's mesh");
    let why = meshed.made_by.unwrap().fallback_reason.unwrap();
    assert!(why.contains("the device hung"), "{why}");
    // On a busy machine, software Vulkan may take longer than the limit again.
    wait_for("a mesh of the device", || run(&backend).unwrap().made_by.unwrap().backend == "gpu");
    let status = backend.devices().remove(0);
    assert!(status.hung >= 1 && status.finished >= 1 && status.down.is_none(), "{status:?}");
}
