//! GPU backend: reported device, fallback and errors, with fake devices; and discovery with the drivers of this
//! machine.

use crate::gpu_fakes;
use crate::tools;

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use gpu_fakes::Step::{Block, Finish, Hang, Lose, OutOfMemory};
use gpu_fakes::{FakeDevice, SETTINGS, devices, lack_of_memory, spheres};
use molmesh::gpu::{DevicePool, DiscoveryMode, GpuBackend, GpuError, PoolSettings, discover};
use molmesh::pipeline::AutoBackend;
use molmesh::surface::{
    Backend, CancelToken, Control, CpuBackend, DeviceChoice, DeviceKind, MeshOutput, Observer, Stage, Step,
    SurfaceError, SurfaceLimits, SurfaceParams,
};

fn gpu(fakes: &[Arc<FakeDevice>]) -> GpuBackend {
    GpuBackend::with_pool(DevicePool::start(devices(fakes), &SETTINGS).unwrap())
}

/// Returns devices with the CPU as fallback.
fn gpu_and_cpu(fakes: &[Arc<FakeDevice>]) -> AutoBackend {
    AutoBackend::new(Box::new(CpuBackend::new(None).unwrap()), Box::new(gpu(fakes)))
}

fn run(backend: &dyn Backend, control: &Control<'_>) -> Result<MeshOutput, SurfaceError> {
    backend.run(&spheres(2), &SurfaceParams::default(), &SurfaceLimits::default(), control)
}

#[test]
fn the_device_of_a_job_is_reported() {
    let backend = gpu_and_cpu(&[FakeDevice::new(&[]), FakeDevice::new(&[])]);
    let made_by: Vec<_> = (0..2).map(|_| run(&backend, &Control::default()).unwrap().made_by.unwrap()).collect();
    assert_eq!([&made_by[0].device, &made_by[1].device], ["fake 0", "fake 1"]);
    // Results of different devices have different keys. A look-up tries all of them and that of the CPU.
    assert_eq!(made_by[0].arithmetic, backend.arithmetic());
    assert_ne!(made_by[0].arithmetic, made_by[1].arithmetic);
    let cpu = CpuBackend::new(None).unwrap().arithmetic();
    assert_eq!(backend.arithmetics(), [made_by[0].arithmetic.clone(), made_by[1].arithmetic.clone(), cpu]);
    assert_eq!((backend.name(), backend.describe().as_str()), ("gpu", "2 devices: fake 0, fake 1"));
}

#[test]
fn the_cpu_is_the_fallback_and_is_reported() {
    let fake = FakeDevice::new(&[Lose]);
    let backend = gpu_and_cpu(std::slice::from_ref(&fake));
    let cpu = run(&CpuBackend::new(None).unwrap(), &Control::default()).unwrap();
    // The device fails the first two jobs; then it is given up.
    for n in 0..4 {
        let meshed = run(&backend, &Control::default()).unwrap();
        assert_eq!(meshed.mesh, cpu.mesh);
        let made_by = meshed.made_by.unwrap();
        let why = made_by.fallback_reason.unwrap();
        assert_eq!((made_by.backend, &made_by.arithmetic), ("cpu", &CpuBackend::new(None).unwrap().arithmetic()));
        // While the device is up, look-ups use its key.
        assert_eq!(backend.arithmetic() == made_by.arithmetic, backend.devices()[0].down.is_some(), "{n}");
        assert!(
            made_by.device.contains("native CPU") && why.contains("the GPU failed") && why.contains("scripted"),
            "{why}"
        );
        assert_eq!(why.contains("no device is up"), n >= 2, "{n}: {why}");
    }
    assert_eq!(backend.describe(), "no device is up");
    // The fallback quantizes vertices too.
    let small = SurfaceParams { quantize: Some(Step::covering(8.0)), ..SurfaceParams::default() };
    let fallback = backend.run(&spheres(2), &small, &SurfaceLimits::default(), &Control::default()).unwrap();
    assert!(fallback.mesh.quantized.is_some() && fallback.measures.is_some());
    // Negative control: a device that works.
    let working = run(&gpu_and_cpu(&[FakeDevice::new(&[])]), &Control::default()).unwrap().made_by.unwrap();
    assert_eq!((working.backend, working.fallback_reason), ("gpu", None));
}

#[test]
fn without_a_fallback_the_failure_is_an_error() {
    let error = run(&gpu(&[FakeDevice::new(&[Lose])]), &Control::default()).unwrap_err();
    let SurfaceError::Device { why } = error else { panic!("{error}") };
    assert!(why.contains("scripted"), "{why}");
}

#[test]
fn a_lack_of_memory_is_an_error_with_numbers_and_without_fallback() {
    let error = run(&gpu_and_cpu(&[FakeDevice::new(&[OutOfMemory])]), &Control::default()).unwrap_err();
    assert_eq!(error, lack_of_memory().error());
}

#[test]
fn deadline_and_cancellation_reach_the_device() {
    let fake = FakeDevice::new(&[Block]);
    let backend = gpu_and_cpu(std::slice::from_ref(&fake));
    let deadline = Some(Instant::now() + std::time::Duration::from_millis(30));
    assert_eq!(
        run(&backend, &Control { deadline, ..Control::default() }).map(|_| ()).unwrap_err(),
        SurfaceError::Deadline
    );
    let cancel = CancelToken::default();
    // On a busy machine the deadline may pass before the job reaches the device.
    let before = fake.calls().len();
    let cancelled = std::thread::scope(|scope| {
        let running = scope.spawn(|| run(&backend, &Control { cancel: cancel.clone(), ..Control::default() }));
        gpu_fakes::wait_for("the job to run", || fake.calls().len() > before);
        cancel.cancel();
        running.join().unwrap()
    });
    assert_eq!(cancelled.map(|_| ()).unwrap_err(), SurfaceError::Cancelled);
    // A job that is cancelled from the start does not reach the device.
    let before = fake.calls().len();
    assert!(run(&backend, &Control { cancel, ..Control::default() }).is_err());
    assert_eq!(fake.calls().len(), before);
}

#[test]
fn the_observer_receives_stage_times() {
    #[derive(Default)]
    struct Watch {
        told: Mutex<Vec<(Stage, u64)>>,
        binned: AtomicBool,
    }
    impl Observer for Watch {
        fn span(&self, stage: Stage, work: &mut dyn FnMut()) {
            work();
            self.binned.fetch_or(stage == Stage::Bin, Ordering::Relaxed);
        }
        fn elapsed(&self, stage: Stage, ns: u64) {
            self.told.lock().unwrap().push((stage, ns));
        }
    }
    let watch = Watch::default();
    run(&gpu_and_cpu(&[FakeDevice::new(&[])]), &Control { observer: &watch, ..Control::default() }).unwrap();
    assert_eq!(*watch.told.lock().unwrap(), [(Stage::Field, 2_000), (Stage::Emit, 1_000)]);
    assert!(watch.binned.into_inner());
}

#[test]
fn warm_runs_every_device_and_gives_up_those_that_fail() {
    let fakes = [FakeDevice::new(&[Finish]), FakeDevice::new(&[Lose]), FakeDevice::new(&[Finish])];
    let backend = gpu(&fakes);
    backend.warm_up().unwrap();
    assert_eq!(fakes.each_ref().map(|fake| fake.calls().len()), [1, 2, 1]);
    let down: Vec<bool> = backend.devices().iter().map(|device| device.down.is_some()).collect();
    assert_eq!(down, [false, true, false]);
    assert!(backend.devices()[1].down.as_deref().unwrap().contains("first mesh failed"));
    // A device that hangs is taken out as well.
    let fakes = [FakeDevice::new(&[Hang]), FakeDevice::new(&[])];
    let settings = PoolSettings { hang_timeout: std::time::Duration::from_millis(50), ..SETTINGS };
    let hung = GpuBackend::with_pool(DevicePool::start(devices(&fakes), &settings).unwrap());
    hung.warm_up().unwrap();
    assert!(hung.devices()[0].down.as_deref().unwrap().contains("hung") && hung.devices()[1].down.is_none());
    fakes[0].release();
    // Without a device the fallback must work; without a fallback warming up fails.
    gpu_and_cpu(&[FakeDevice::new(&[Lose])]).warm_up().unwrap();
    assert!(matches!(gpu(&[FakeDevice::new(&[Lose])]).warm_up(), Err(SurfaceError::Device { .. })));
}

#[test]
fn many_callers_share_one_device() {
    let fake = FakeDevice::new(&[]);
    let backend = gpu(std::slice::from_ref(&fake));
    let (done, grid_points) = (AtomicUsize::new(0), AtomicU64::new(0));
    std::thread::scope(|scope| {
        for _ in 0..16 {
            scope.spawn(|| {
                for _ in 0..20 {
                    let meshed = run(&backend, &Control::default()).unwrap();
                    grid_points.fetch_add(meshed.grid.grid_points, Ordering::Relaxed);
                    done.fetch_add(1, Ordering::Relaxed);
                }
            });
        }
    });
    assert_eq!((done.into_inner(), grid_points.into_inner()), (320, 320 * 7));
    assert_eq!(fake.calls().iter().sum::<usize>(), 320);
    assert_eq!(backend.devices()[0].finished, 320);
}

/// Number of the software Vulkan device (`mesa-vulkan-drivers`). CI has it; elsewhere the test is skipped without it.
fn software() -> Option<usize> {
    let found = discover(&DeviceChoice::All, DiscoveryMode::Thorough);
    let software = found.devices.iter().find(|device| device.facts.kind == DeviceKind::Software);
    if software.is_none() {
        return tools::skip(&format!("no software Vulkan; install mesa-vulkan-drivers ({found:?})"));
    }
    software.map(|device| device.number)
}

#[test]
fn software_is_found_and_selected_only_if_requested() {
    let Some(number) = software() else { return };
    for (choice, taken) in [("auto", false), ("all", false), ("software", true), (&number.to_string(), true)] {
        let found = discover(&choice.parse().unwrap(), DiscoveryMode::Thorough);
        let device = &found.devices[number];
        assert_eq!((device.number, device.selected), (number, taken), "{choice}: {}", device.reason);
        assert!(!device.reason.is_empty() && !device.facts.name.is_empty() && !device.facts.driver.is_empty());
        assert!(device.facts.binding_bytes >= 128 << 20 && device.facts.workgroup_size >= 256, "{device:?}");
        assert_eq!(found.no_device_reason().is_none(), found.selected().next().is_some(), "{choice}");
    }
}

#[test]
fn devices_keep_their_numbers() {
    let names = || {
        let found = discover(&DeviceChoice::All, DiscoveryMode::Thorough);
        found.devices.into_iter().map(|d| (d.number, d.facts)).collect::<Vec<_>>()
    };
    assert_eq!(names(), names());
}

#[test]
fn a_missing_device_is_reported_and_cannot_be_started() {
    let choice: DeviceChoice = "77".parse().unwrap();
    let found = discover(&choice, DiscoveryMode::Quick);
    assert_eq!(found.missing(&choice), ["there is no device 77"]);
    let Err(GpuError::NoDevice(why)) = GpuBackend::start(&found, &SETTINGS) else { panic!("it started") };
    assert!(!why.is_empty());
    let quick = discover(&DeviceChoice::Cpu, DiscoveryMode::Quick);
    assert_eq!((quick.devices.len(), quick.no_device_reason().as_deref()), (0, Some("the CPU was requested")));
}
