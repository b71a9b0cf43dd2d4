//! Selection of the backend, with the reason.

use std::num::NonZero;
#[cfg(feature = "gpu")]
use std::sync::Arc;

#[cfg(feature = "server")]
use molmesh::config::DevicesConfig;
#[cfg(feature = "gpu")]
use molmesh::picture::CpuRenderer;
use molmesh::picture::SelectedRenderer;
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::reference::ReferenceBackend;
use molmesh::surface::{Backend, DeviceChoice, FoundDevice};

use super::args::{BackendName, JobArgs};
use super::error::CliError;
use super::estimate::Estimate;

/// Requested backend and devices.
#[derive(Debug)]
pub(crate) struct BackendRequest<'a> {
    /// Backend.
    pub(crate) backend: BackendName,
    /// Devices that it may use.
    pub(crate) devices: &'a DeviceChoice,
    /// Threads of the CPU backend.
    pub(crate) threads: Option<usize>,
    /// Estimated work of a command's only job, if there is one and its input is known.
    pub(crate) work: Option<f64>,
}

impl<'a> BackendRequest<'a> {
    /// Creates the request of a command with a single job of unknown work.
    pub(crate) fn once(args: &'a JobArgs) -> Self {
        let (backend, devices, threads) = (args.backend, &args.devices.devices, args.threads);
        Self { backend, devices, threads, work: None }
    }

    /// Threads that the CPU backend gets.
    fn n_threads(&self) -> usize {
        self.threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, NonZero::get))
    }
}

/// Selected backend with the reason.
pub(crate) struct SelectedBackend {
    /// Backend.
    pub(crate) backend: Box<dyn Backend>,
    /// Reason of the selection.
    pub(crate) reason: String,
    /// Renderer of pictures with its reason; the CPU if no pictures are needed.
    pub(crate) renderer: SelectedRenderer,
    /// All discovered devices, used or not.
    #[cfg_attr(not(feature = "server"), expect(dead_code, reason = "the banner and `doctor` read it"))]
    pub(crate) devices: Vec<FoundDevice>,
    /// Reason for not using a GPU, if none is used.
    #[cfg_attr(not(feature = "server"), expect(dead_code, reason = "the banner and `doctor` read it"))]
    pub(crate) no_gpu: Option<String>,
}

/// Purpose of a backend.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Use {
    /// One mesh.
    Once,
    /// One mesh and its picture.
    Picture,
    /// A service.
    #[cfg(feature = "server")]
    Service(DevicesConfig),
}

/// Rejects flags that contradict each other.
///
/// # Errors
/// Returns [`CliError::Usage`] if they do.
pub(crate) fn check(requested: &BackendRequest<'_>) -> Result<(), CliError> {
    if requested.threads == Some(0) {
        return Err(CliError::usage("parameter `threads`: 0 is not allowed; expected a number from 1"));
    }
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
pub(crate) fn pick(requested: &BackendRequest<'_>, use_: &Use) -> Result<SelectedBackend, CliError> {
    check(requested)?;
    let without_gpu = |backend: Box<dyn Backend>| SelectedBackend {
        backend,
        reason: "requested".to_owned(),
        renderer: SelectedRenderer::cpu("a backend other than the GPU was requested"),
        devices: Vec::new(),
        no_gpu: Some("no discovery: another backend was requested".to_owned()),
    };
    match requested.backend {
        BackendName::Cpu => Ok(without_gpu(cpu(requested, use_)?)),
        BackendName::Reference => Ok(without_gpu(Box::new(ReferenceBackend))),
        BackendName::Auto | BackendName::Gpu => gpu_or_cpu(requested, use_),
    }
}

/// Returns the estimate for a command if both backend and devices are `auto`.
fn estimate(requested: &BackendRequest<'_>) -> Option<Estimate> {
    let free = requested.backend == BackendName::Auto && *requested.devices == DeviceChoice::Auto;
    requested.work.filter(|_| free).map(|work| Estimate::new(work, requested.n_threads()))
}

/// Selects a GPU, or the CPU if the request allows any backend.
fn gpu_or_cpu(requested: &BackendRequest<'_>, use_: &Use) -> Result<SelectedBackend, CliError> {
    let estimate = estimate(requested);
    if let Some(estimate) = estimate.filter(|estimate| !estimate.favours_gpu()) {
        let why = format!("no GPU discovery ({estimate})");
        let reason = format!("auto: {why}");
        let renderer = SelectedRenderer::cpu(&reason);
        return Ok(SelectedBackend {
            backend: cpu(requested, use_)?,
            reason,
            renderer,
            devices: Vec::new(),
            no_gpu: Some(why),
        });
    }
    let Gpu { backend, renderer, devices, mut state } = gpu(requested, use_);
    if let (Some(backend), Some(renderer), Ok(reason)) = (backend, renderer, &state) {
        let reason = match (requested.backend, requested.devices) {
            (_, DeviceChoice::These(_)) => format!("--devices {}", requested.devices),
            (BackendName::Auto, _) => match estimate {
                Some(estimate) => format!("auto: {reason}, {estimate}"),
                None => format!("auto: {reason}"),
            },
            _ => "requested".to_owned(),
        };
        return Ok(SelectedBackend { backend, reason, renderer, devices, no_gpu: None });
    }
    let why = state.as_mut().err().map(std::mem::take).unwrap_or_default();
    // A request for a specific device fails instead of falling back to the CPU.
    if requested.backend != BackendName::Auto || matches!(requested.devices, DeviceChoice::These(_)) {
        return Err(CliError::NoBackend { requested: "gpu", why: format!("no GPU can be used: {why}") });
    }
    let reason = match requested.devices {
        DeviceChoice::Cpu => "--devices cpu".to_owned(),
        _ => format!("auto: no GPU: {why}"),
    };
    let renderer = SelectedRenderer::cpu(&reason);
    Ok(SelectedBackend { backend: cpu(requested, use_)?, reason, renderer, devices, no_gpu: Some(why) })
}

fn cpu(requested: &BackendRequest<'_>, use_: &Use) -> Result<Box<dyn Backend>, CliError> {
    let backend = match use_ {
        Use::Once | Use::Picture => CpuBackend::new(Some(requested.n_threads())),
        #[cfg(feature = "server")]
        Use::Service(_) => CpuBackend::new(requested.threads),
    };
    let backend = backend.map_err(|why| CliError::NoBackend { requested: "cpu", why })?;
    Ok(Box::new(backend))
}

/// Result of GPU discovery.
struct Gpu {
    backend: Option<Box<dyn Backend>>,
    renderer: Option<SelectedRenderer>,
    devices: Vec<FoundDevice>,
    /// Reason of the selection, or reason for not using a GPU.
    state: Result<String, String>,
}

#[cfg(not(feature = "gpu"))]
fn gpu(_asked: &BackendRequest<'_>, _use: &Use) -> Gpu {
    Gpu { backend: None, renderer: None, devices: Vec::new(), state: Err("this build has no GPU support".to_owned()) }
}

#[cfg(feature = "gpu")]
fn gpu(requested: &BackendRequest<'_>, use_: &Use) -> Gpu {
    use molmesh::gpu::{GpuBackend, GpuError, Look, PoolSettings, discover};

    // For a single mesh, skip drivers without a device, unless a GPU was requested.
    let once = matches!(use_, Use::Once | Use::Picture);
    let look = if once && requested.backend == BackendName::Auto { Look::Quick } else { Look::Thorough };
    let discovery = discover(requested.devices, look);
    let none = |devices, why| Gpu { backend: None, renderer: None, devices, state: Err(why) };
    let missing = discovery.missing(requested.devices);
    if !missing.is_empty() {
        let there = discovery.why_none().map(|why| format!(" ({why})")).unwrap_or_default();
        return none(discovery.devices, format!("{}{there}", missing.join(", ")));
    }
    if let Some(why) = discovery.why_none() {
        return none(discovery.devices, why);
    }
    let settings = match use_ {
        Use::Once | Use::Picture => PoolSettings::default(),
        #[cfg(feature = "server")]
        Use::Service(config) => PoolSettings {
            queue: config.jobs,
            batch: config.batch,
            min_partition_bricks: config.min_partition_bricks,
            ..PoolSettings::default()
        },
    };
    // A request for the GPU has no fallback.
    let fallback = match requested.backend {
        BackendName::Auto => CpuBackend::new(requested.threads).ok().map(|cpu| Box::new(cpu) as Box<dyn Backend>),
        _ => None,
    };
    let started = GpuBackend::start(&discovery, &settings, fallback);
    let renderer = match renderer(requested, use_, &discovery) {
        Ok(renderer) => renderer,
        Err(why) => return none(discovery.devices, why),
    };
    let mut devices = discovery.devices;
    match started {
        Ok(backend) => {
            for status in backend.devices() {
                let found = devices.iter_mut().find(|found| found.number == status.number);
                if let (Some(found), Some(why)) = (found, status.down) {
                    (found.taken, found.reason) = (false, why);
                }
            }
            let up: Vec<&str> = devices.iter().filter(|d| d.taken).map(|d| d.reason.as_str()).collect();
            let reason = match up[..] {
                [one] => format!("a GPU ({one})"),
                _ => format!("{} GPUs", up.len()),
            };
            Gpu { backend: Some(Box::new(backend)), renderer: Some(renderer), devices, state: Ok(reason) }
        }
        Err(error) => {
            let why = match error {
                GpuError::NoDevice(why) => why,
                error => error.to_string(),
            };
            for device in devices.iter_mut().filter(|device| device.taken) {
                (device.taken, device.reason) = (false, format!("the pipelines could not be built: {why}"));
            }
            none(devices, why)
        }
    }
}

/// Starts the renderer on the GPUs that make the meshes. With `--backend auto`, falls back to the CPU with the reason.
#[cfg(feature = "gpu")]
fn renderer(
    requested: &BackendRequest<'_>,
    use_: &Use,
    discovery: &molmesh::gpu::Discovery,
) -> Result<SelectedRenderer, String> {
    use molmesh::gpu::GpuRenderer;

    if *use_ == Use::Once {
        return Ok(SelectedRenderer::cpu("no pictures were requested"));
    }
    let auto = requested.backend == BackendName::Auto;
    match GpuRenderer::start(discovery, auto.then_some(CpuRenderer)) {
        Ok(renderer) => {
            let reason = "the device that makes the meshes".to_owned();
            Ok(SelectedRenderer { renderer: Arc::new(renderer), reason })
        }
        Err(error) if auto => Ok(SelectedRenderer::cpu(&format!("the GPU cannot render: {error}"))),
        Err(error) => Err(format!("it cannot render: {error}")),
    }
}
