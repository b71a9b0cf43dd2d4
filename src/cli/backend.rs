//! The only place that picks a backend, and gives the reason in words.

use std::num::NonZero;
#[cfg(feature = "gpu")]
use std::sync::Arc;

#[cfg(feature = "server")]
use molmesh::config::DevicesConfig;
#[cfg(feature = "gpu")]
use molmesh::picture::CpuRenderer;
use molmesh::picture::Drawer;
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::reference::ReferenceBackend;
use molmesh::surface::{Backend, DeviceChoice, FoundDevice};

use super::args::{BackendName, JobArgs};
use super::error::CliError;
use super::estimate::Estimate;

/// What was asked for.
#[derive(Debug)]
pub(crate) struct Asked<'a> {
    /// The backend.
    pub(crate) backend: BackendName,
    /// Which devices it may use.
    pub(crate) devices: &'a DeviceChoice,
    /// Threads of the CPU backend.
    pub(crate) threads: Option<usize>,
    /// Estimated work of a command's only job, if there is one and its input is known.
    pub(crate) work: Option<f64>,
}

impl<'a> Asked<'a> {
    /// Flags of a command with a single job, whose work is not known yet.
    pub(crate) fn once(args: &'a JobArgs) -> Self {
        let (backend, devices, threads) = (args.backend, &args.devices.devices, args.threads);
        Self { backend, devices, threads, work: None }
    }

    /// Threads that the CPU backend gets.
    fn n_threads(&self) -> usize {
        self.threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, NonZero::get))
    }
}

/// A backend and why it was taken.
pub(crate) struct Picked {
    /// The backend.
    pub(crate) backend: Box<dyn Backend>,
    /// Why, in words.
    pub(crate) reason: String,
    /// What draws pictures, and why it was taken; the CPU where no pictures are wanted.
    pub(crate) drawer: Drawer,
    /// Every device that was found on the way, taken or not.
    #[cfg_attr(not(feature = "server"), expect(dead_code, reason = "the banner and `doctor` read it"))]
    pub(crate) devices: Vec<FoundDevice>,
    /// Why no GPU runs, if none does.
    #[cfg_attr(not(feature = "server"), expect(dead_code, reason = "the banner and `doctor` read it"))]
    pub(crate) no_gpu: Option<String>,
}

/// What a backend is picked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Use {
    /// One mesh, by the calling thread.
    Once,
    /// One mesh and its picture, likewise.
    Picture,
    /// Many, by the threads of a service.
    #[cfg(feature = "server")]
    Service(DevicesConfig),
}

/// Rejects flags that contradict each other.
///
/// # Errors
/// [`CliError::Usage`].
pub(crate) fn check(asked: &Asked<'_>) -> Result<(), CliError> {
    if asked.threads == Some(0) {
        return Err(CliError::usage("parameter `threads`: 0 is not allowed; expected a number from 1"));
    }
    if asked.backend == BackendName::Gpu && *asked.devices == DeviceChoice::Cpu {
        return Err(CliError::usage("parameter `devices`: cpu is not allowed with --backend gpu; expected a GPU"));
    }
    Ok(())
}

/// Picks a backend.
///
/// # Errors
/// [`CliError::Usage`] for flags that contradict each other; [`CliError::NoBackend`] says why the backend that was asked
/// for is not there.
pub(crate) fn pick(asked: &Asked<'_>, use_: &Use) -> Result<Picked, CliError> {
    check(asked)?;
    let unasked = |backend: Box<dyn Backend>| Picked {
        backend,
        reason: "asked for".to_owned(),
        drawer: Drawer::cpu("as another backend than the GPU was asked for"),
        devices: Vec::new(),
        no_gpu: Some("not looked for, as another backend was asked for".to_owned()),
    };
    match asked.backend {
        BackendName::Cpu => Ok(unasked(cpu(asked, use_)?)),
        BackendName::Reference => Ok(unasked(Box::new(ReferenceBackend))),
        BackendName::Auto | BackendName::Gpu => gpu_or_cpu(asked, use_),
    }
}

/// The estimate of a command whose backend and devices are left to this program.
fn estimate(asked: &Asked<'_>) -> Option<Estimate> {
    let free = asked.backend == BackendName::Auto && *asked.devices == DeviceChoice::Auto;
    asked.work.filter(|_| free).map(|work| Estimate::new(work, asked.n_threads()))
}

/// A GPU, or the CPU where any backend will do.
fn gpu_or_cpu(asked: &Asked<'_>, use_: &Use) -> Result<Picked, CliError> {
    let estimate = estimate(asked);
    if let Some(estimate) = estimate.filter(|estimate| !estimate.favours_gpu()) {
        let why = format!("no GPU was looked for ({estimate})");
        let reason = format!("auto: {why}");
        let drawer = Drawer::cpu(&reason);
        return Ok(Picked { backend: cpu(asked, use_)?, reason, drawer, devices: Vec::new(), no_gpu: Some(why) });
    }
    let Gpu { backend, drawer, devices, mut state } = gpu(asked, use_);
    if let (Some(backend), Some(drawer), Ok(reason)) = (backend, drawer, &state) {
        let reason = match (asked.backend, asked.devices) {
            (_, DeviceChoice::These(_)) => format!("--devices {}", asked.devices),
            (BackendName::Auto, _) => match estimate {
                Some(estimate) => format!("auto: {reason}, {estimate}"),
                None => format!("auto: {reason}"),
            },
            _ => "asked for".to_owned(),
        };
        return Ok(Picked { backend, reason, drawer, devices, no_gpu: None });
    }
    let why = state.as_mut().err().map(std::mem::take).unwrap_or_default();
    // Whoever asks for a device by name does not want to learn from a report that it was not used.
    if asked.backend != BackendName::Auto || matches!(asked.devices, DeviceChoice::These(_)) {
        return Err(CliError::NoBackend { asked: "gpu", why: format!("no GPU can be used: {why}") });
    }
    let reason = match asked.devices {
        DeviceChoice::Cpu => "--devices cpu".to_owned(),
        _ => format!("auto: no GPU, as {why}"),
    };
    let drawer = Drawer::cpu(&reason);
    Ok(Picked { backend: cpu(asked, use_)?, reason, drawer, devices, no_gpu: Some(why) })
}

fn cpu(asked: &Asked<'_>, use_: &Use) -> Result<Box<dyn Backend>, CliError> {
    let backend = match use_ {
        Use::Once | Use::Picture => CpuBackend::new(Some(asked.n_threads())),
        #[cfg(feature = "server")]
        Use::Service(_) => CpuBackend::new(asked.threads),
    };
    let backend = backend.map_err(|why| CliError::NoBackend { asked: "cpu", why })?;
    Ok(Box::new(backend))
}

/// What came of looking for GPUs.
struct Gpu {
    backend: Option<Box<dyn Backend>>,
    drawer: Option<Drawer>,
    devices: Vec<FoundDevice>,
    /// Why it is taken, or why there is none.
    state: Result<String, String>,
}

#[cfg(not(feature = "gpu"))]
fn gpu(_asked: &Asked<'_>, _use: &Use) -> Gpu {
    Gpu { backend: None, drawer: None, devices: Vec::new(), state: Err("this build has no GPU support".to_owned()) }
}

#[cfg(feature = "gpu")]
fn gpu(asked: &Asked<'_>, use_: &Use) -> Gpu {
    use molmesh::gpu::{GpuBackend, GpuError, Look, PoolSettings, discover};

    // One mesh is not worth asking drivers that have nothing to drive; who asks for a GPU wants to know of all.
    let once = matches!(use_, Use::Once | Use::Picture);
    let look = if once && asked.backend == BackendName::Auto { Look::Quick } else { Look::Thorough };
    let discovery = discover(asked.devices, look);
    let none = |devices, why| Gpu { backend: None, drawer: None, devices, state: Err(why) };
    let missing = discovery.missing(asked.devices);
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
    // Whoever asked for the GPU gets it or nothing.
    let fallback = match asked.backend {
        BackendName::Auto => CpuBackend::new(asked.threads).ok().map(|cpu| Box::new(cpu) as Box<dyn Backend>),
        _ => None,
    };
    let started = GpuBackend::start(&discovery, &settings, fallback);
    let drawer = match drawer(asked, use_, &discovery) {
        Ok(drawer) => drawer,
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
            Gpu { backend: Some(Box::new(backend)), drawer: Some(drawer), devices, state: Ok(reason) }
        }
        Err(error) => {
            let why = match error {
                GpuError::NoDevice(why) => why,
                error => error.to_string(),
            };
            for device in devices.iter_mut().filter(|device| device.taken) {
                (device.taken, device.reason) = (false, format!("the stages could not be built: {why}"));
            }
            none(devices, why)
        }
    }
}

/// What draws where a GPU makes the meshes: that GPU. Where it cannot and another backend would do, the CPU, with the reason.
#[cfg(feature = "gpu")]
fn drawer(asked: &Asked<'_>, use_: &Use, discovery: &molmesh::gpu::Discovery) -> Result<Drawer, String> {
    use molmesh::gpu::GpuRenderer;

    if *use_ == Use::Once {
        return Ok(Drawer::cpu("no pictures are wanted"));
    }
    let auto = asked.backend == BackendName::Auto;
    match GpuRenderer::start(discovery, auto.then(CpuRenderer::default)) {
        Ok(renderer) => {
            let reason = "the device that makes meshes draws them".to_owned();
            Ok(Drawer { renderer: Arc::new(renderer), reason })
        }
        Err(error) if auto => Ok(Drawer::cpu(&format!("the GPU cannot draw: {error}"))),
        Err(error) => Err(format!("it cannot draw: {error}")),
    }
}
