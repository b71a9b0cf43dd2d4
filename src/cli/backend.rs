//! Selection of the backend, with the reason.

use std::num::NonZero;
use std::sync::{Arc, Mutex, PoisonError};

use molmesh::config::DevicesConfig;
#[cfg(feature = "gpu")]
use molmesh::config::JOBS_PER_DEVICE;
#[cfg(feature = "gpu")]
use molmesh::picture::CpuRenderer;
use molmesh::picture::SelectedRenderer;
#[cfg(feature = "gpu")]
use molmesh::pipeline::AutoBackend;
use molmesh::pipeline::SelectedBackend;
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::reference::ReferenceBackend;
use molmesh::surface::{Backend, DeviceChoice, FoundDevice};

use super::args::{BackendName, JobArgs};
use super::error::CliError;

/// Work of a command up to which `--backend auto` takes the CPU, in the units of
/// [`estimate_work`](molmesh::pipeline::estimate_work): 4 s on two cores. A GPU takes up to a second to start.
const MAX_CPU_WORK: f64 = 1e6;
/// Maximum value of `--threads` and `--jobs`: more than any machine has cores.
const MAX_THREADS: usize = 1024;

/// Requested backend and devices.
#[derive(Debug)]
pub(crate) struct BackendRequest<'a> {
    pub(crate) backend: BackendName,
    /// Devices that the backend may use.
    pub(crate) devices: &'a DeviceChoice,
    /// Threads of the CPU backend.
    pub(crate) threads: Option<usize>,
    /// Estimated work of a command's job, if its input is known.
    pub(crate) work: Option<f64>,
    pub(crate) purpose: Purpose,
}

/// Purpose of a backend.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Purpose {
    /// Meshes.
    Mesh,
    /// Meshes and their pictures.
    Picture,
    /// A service, with the size of the readback buffers of each GPU, bytes.
    #[cfg_attr(not(feature = "gpu"), expect(dead_code, reason = "only GPUs have buffers"))]
    Service(u64),
}

impl<'a> BackendRequest<'a> {
    /// Creates the request of a command's job of unknown work.
    pub(crate) fn for_command(args: &'a JobArgs, purpose: Purpose) -> Self {
        let (backend, devices, threads) = (args.backend, &args.devices.devices, args.run.threads);
        Self { backend, devices, threads, work: None, purpose }
    }

    /// Creates the request of a service.
    pub(crate) fn for_service(backend: BackendName, config: &'a DevicesConfig) -> Self {
        let purpose = Purpose::Service(config.readback_bytes);
        Self { backend, devices: &config.choice, threads: None, work: None, purpose }
    }

    fn is_command(&self) -> bool {
        matches!(self.purpose, Purpose::Mesh | Purpose::Picture)
    }

    /// Returns true if a GPU may be used.
    pub(crate) fn may_use_gpu(&self) -> bool {
        let names_gpu = matches!(self.backend, BackendName::Auto | BackendName::Gpu);
        names_gpu && *self.devices != DeviceChoice::Cpu && !self.is_too_small()
    }

    /// Returns true if the user leaves the choice of a command's backend to its work, and a GPU would not be faster.
    fn is_too_small(&self) -> bool {
        let is_free = self.backend == BackendName::Auto && *self.devices == DeviceChoice::Auto;
        is_free && self.work.is_some_and(|work| work <= MAX_CPU_WORK)
    }
}

/// Backend that is selected when a job first needs one. Later jobs share it, so all requests must be equal except for
/// their work.
#[derive(Default)]
pub(crate) struct SharedBackend(Mutex<Option<Arc<SelectedBackend>>>);

impl SharedBackend {
    /// Returns the backend.
    ///
    /// # Errors
    /// Returns the errors of [`select`].
    pub(crate) fn get(&self, requested: &BackendRequest<'_>) -> Result<Arc<SelectedBackend>, CliError> {
        let mut selected = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(selected) = &*selected {
            return Ok(Arc::clone(selected));
        }
        Ok(Arc::clone(selected.insert(Arc::new(select(requested)?))))
    }
}

/// Returns the number of threads of a command.
pub(crate) fn n_threads(threads: Option<usize>) -> usize {
    threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, NonZero::get))
}

/// Checks a number of threads, the value of the flag `name`.
///
/// # Errors
/// Returns [`CliError::Usage`].
pub(crate) fn check_threads(name: &str, threads: Option<usize>) -> Result<(), CliError> {
    let Some(n) = threads.filter(|n| !(1..=MAX_THREADS).contains(n)) else { return Ok(()) };
    let message = format!("parameter `{name}`: {n} is not allowed; expected a number from 1 to {MAX_THREADS}");
    Err(CliError::usage(message))
}

/// Rejects flags that contradict each other.
///
/// # Errors
/// Returns [`CliError::Usage`] if they do.
pub(crate) fn check(requested: &BackendRequest<'_>) -> Result<(), CliError> {
    check_threads("threads", requested.threads)?;
    if requested.backend == BackendName::Gpu && *requested.devices == DeviceChoice::Cpu {
        return Err(CliError::usage("parameter `devices`: cpu is not allowed with --backend gpu; expected a GPU"));
    }
    Ok(())
}

/// Selects and starts a backend.
///
/// # Errors
/// Returns [`CliError::Usage`] if flags contradict each other, and [`CliError::NoBackend`] with the reason if the
/// requested backend is not available.
pub(crate) fn select(requested: &BackendRequest<'_>) -> Result<SelectedBackend, CliError> {
    check(requested)?;
    let backend: Arc<dyn Backend> = match requested.backend {
        BackendName::Cpu => cpu(requested)?,
        BackendName::Reference => Arc::new(ReferenceBackend),
        BackendName::Auto | BackendName::Gpu => return gpu_or_cpu(requested),
    };
    Ok(SelectedBackend {
        backend,
        reason: "requested".to_owned(),
        renderer: SelectedRenderer::cpu("a backend other than the GPU was requested"),
        devices: Vec::new(),
        no_gpu: Some("no discovery: another backend was requested".to_owned()),
    })
}

/// Selects a GPU, or the CPU if the request allows any backend.
fn gpu_or_cpu(requested: &BackendRequest<'_>) -> Result<SelectedBackend, CliError> {
    if requested.is_too_small() {
        let why = "a GPU is not expected to be faster".to_owned();
        return instead_of_gpu(requested, format!("auto: {why}"), NoGpu { why, devices: Vec::new() });
    }
    let auto = requested.backend == BackendName::Auto;
    let listed = matches!(requested.devices, DeviceChoice::Listed(_));
    match gpu(requested) {
        Ok(mut selected) => {
            selected.reason = if listed {
                format!("--devices {}", requested.devices)
            } else if auto {
                format!("auto: {}", selected.reason)
            } else {
                "requested".to_owned()
            };
            Ok(selected)
        }
        // A request for a specific device fails instead of falling back to the CPU.
        Err(NoGpu { why, .. }) if !auto || listed => {
            Err(CliError::NoBackend { requested: "gpu", why: format!("no GPU can be used: {why}") })
        }
        Err(none) => {
            let reason = if *requested.devices == DeviceChoice::Cpu {
                "--devices cpu".to_owned()
            } else {
                format!("auto: no GPU: {}", none.why)
            };
            instead_of_gpu(requested, reason, none)
        }
    }
}

fn instead_of_gpu(requested: &BackendRequest<'_>, reason: String, none: NoGpu) -> Result<SelectedBackend, CliError> {
    let renderer = SelectedRenderer::cpu(&reason);
    Ok(SelectedBackend { backend: cpu(requested)?, reason, renderer, devices: none.devices, no_gpu: Some(none.why) })
}

fn cpu(requested: &BackendRequest<'_>) -> Result<Arc<dyn Backend>, CliError> {
    let threads = requested.threads.or_else(|| requested.is_command().then(|| n_threads(None)));
    let backend = CpuBackend::new(threads).map_err(|why| CliError::NoBackend { requested: "cpu", why })?;
    Ok(Arc::new(backend))
}

/// Reason why no GPU is used, with the discovered devices.
struct NoGpu {
    why: String,
    devices: Vec<FoundDevice>,
}

#[cfg(not(feature = "gpu"))]
fn gpu(_requested: &BackendRequest<'_>) -> Result<SelectedBackend, NoGpu> {
    Err(NoGpu { why: "this build has no GPU support".to_owned(), devices: Vec::new() })
}

/// Discovers GPUs and starts the backend and the renderer on those that may be used.
#[cfg(feature = "gpu")]
fn gpu(requested: &BackendRequest<'_>) -> Result<SelectedBackend, NoGpu> {
    use molmesh::gpu::{DiscoveryMode, GpuBackend, GpuError, PoolSettings, discover};

    let auto = requested.backend == BackendName::Auto;
    // For a single mesh, skip drivers without a device, unless a GPU was requested.
    let mode = if requested.is_command() && auto { DiscoveryMode::Quick } else { DiscoveryMode::Thorough };
    let mut discovery = discover(requested.devices, mode);
    let missing = discovery.missing(requested.devices);
    if !missing.is_empty() {
        let detail = discovery.no_device_reason().map(|why| format!(" ({why})")).unwrap_or_default();
        return Err(NoGpu { why: format!("{}{detail}", missing.join(", ")), devices: discovery.devices });
    }
    if let Some(why) = discovery.no_device_reason() {
        return Err(NoGpu { why, devices: discovery.devices });
    }
    let settings = match requested.purpose {
        Purpose::Service(readback_bytes) => {
            PoolSettings { queue: JOBS_PER_DEVICE, readback_bytes: Some(readback_bytes), ..PoolSettings::default() }
        }
        _ => PoolSettings::default(),
    };
    let backend = match GpuBackend::start(&discovery, &settings) {
        Ok(backend) => backend,
        Err(error) => {
            let why = match error {
                GpuError::NoDevice(why) => why,
                error => error.to_string(),
            };
            let mut devices = discovery.devices;
            for device in devices.iter_mut().filter(|device| device.selected) {
                (device.selected, device.reason) = (false, format!("the pipelines could not be built: {why}"));
            }
            return Err(NoGpu { why, devices });
        }
    };
    for status in backend.devices() {
        let found = discovery.devices.iter_mut().find(|found| found.number == status.number);
        if let (Some(found), Some(why)) = (found, status.down) {
            (found.selected, found.reason) = (false, why);
        }
    }
    let renderer = match renderer(requested, &discovery, &settings) {
        Ok(renderer) => renderer,
        Err(why) => return Err(NoGpu { why, devices: discovery.devices }),
    };
    let devices = discovery.devices;
    let up: Vec<&str> = devices.iter().filter(|d| d.selected).map(|d| d.reason.as_str()).collect();
    let reason = match up[..] {
        [one] => format!("a GPU ({one})"),
        _ => format!("{} GPUs", up.len()),
    };
    // A request for the GPU has no fallback.
    let cpu = if auto { CpuBackend::new(requested.threads).ok() } else { None };
    let backend: Arc<dyn Backend> = match cpu {
        Some(cpu) => Arc::new(AutoBackend::new(Box::new(cpu), Box::new(backend))),
        None => Arc::new(backend),
    };
    Ok(SelectedBackend { backend, reason, renderer, devices, no_gpu: None })
}

/// Starts the renderer on one of the GPUs that make the meshes. With `--backend auto`, falls back to the CPU with the
/// reason.
#[cfg(feature = "gpu")]
fn renderer(
    requested: &BackendRequest<'_>,
    discovery: &molmesh::gpu::Discovery,
    settings: &molmesh::gpu::PoolSettings,
) -> Result<SelectedRenderer, String> {
    use molmesh::gpu::GpuRenderer;

    if matches!(requested.purpose, Purpose::Mesh) {
        return Ok(SelectedRenderer::cpu("no pictures were requested"));
    }
    let auto = requested.backend == BackendName::Auto;
    match GpuRenderer::start(discovery, settings, auto.then_some(CpuRenderer)) {
        Ok(renderer) => {
            let reason = "the device that makes the meshes".to_owned();
            Ok(SelectedRenderer { renderer: Arc::new(renderer), reason })
        }
        Err(error) if auto => Ok(SelectedRenderer::cpu(&format!("the GPU cannot render: {error}"))),
        Err(error) => Err(format!("it cannot render: {error}")),
    }
}
