//! `molmesh serve`: starts the service and runs it until a shutdown signal.

use std::io::{self, Write};
use std::num::NonZero;
use std::time::Duration;

use molmesh::config::{Loaded, LogFormat};
use molmesh::http::{ServeError, Server, Stopped, has_viewer, shutdown_signals};
use molmesh::store::LockError;
use molmesh::structure::strict_validator;
use molmesh::telemetry;

use super::args::ServeArgs;
use super::backend::{self, BackendRequest};
use super::banner::{self, Facts};
use super::error::CliError;
use super::style::Style;
use super::survey;

/// Nice value of compute threads. They get a third of a core that they share with an HTTP thread.
#[cfg(target_os = "linux")]
const COMPUTE_NICE: i32 = 5;
/// Time after which an idle thread for blocking work ends. The allocator returns its memory then. Threads take work in
/// turn, so a longer time would keep all threads of a burst alive, each with the memory of a structure.
const IDLE_THREAD: Duration = Duration::from_millis(100);

/// Runs the service until it has been stopped and drained.
pub(super) fn run(args: &ServeArgs) -> Result<(), CliError> {
    hide_new_files();
    let Loaded { config, warnings, .. } = super::config::load(args)?;
    telemetry::init_logs(&config.log).map_err(|e| CliError::usage(e.to_string()))?;
    for warning in warnings {
        tracing::warn!("{warning}");
    }
    let json = config.log.format == LogFormat::Json;
    strict_validator::quiet_panics();
    let selected = backend::select(&BackendRequest::for_service(args.backend, &config.devices))?;
    let others = survey::backends(&selected).into_iter().chain(survey::unused_devices(&selected)).collect();
    let keys = config.access.keys_file.is_some();
    let facts = Facts {
        device: survey::describe(selected.backend.as_ref()),
        reason: selected.reason.clone(),
        others,
        keys,
        viewer: has_viewer(),
    };
    raise_open_files();
    let failed = |e: io::Error| CliError::Service(format!("cannot start the runtime: {e}"));
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(runtime_threads())
        .thread_name("http")
        .thread_keep_alive(IDLE_THREAD)
        .enable_all()
        .build()
        .map_err(failed)?;
    lower_compute_priority();
    let server = runtime.block_on(Server::bind(config, selected)).map_err(|error| match error {
        // Keys and secrets are part of the configuration.
        ServeError::Access(error) => CliError::usage(error.to_string()),
        ServeError::Lock(error @ LockError::Held { .. }) => CliError::InUse(error.to_string()),
        error => CliError::Service(error.to_string()),
    })?;
    if json {
        let metrics = server.metrics_addr().map(|addr| addr.to_string());
        tracing::info!(address = %server.addr(), metrics, device = facts.device, reason = facts.reason, "listening");
    } else {
        let text = banner::text(server.addr(), server.metrics_addr(), &facts, Style::stderr());
        // A closed stderr does not stop the service.
        drop(io::stderr().write_all(text.as_bytes()));
    }

    let stopped =
        runtime.block_on(async { server.run(shutdown_signals()).await }).map_err(|e| CliError::Service(e.to_string()));
    // Do not wait for file reads and jobs that outlast the drain timeout.
    runtime.shutdown_timeout(Duration::from_millis(100));
    check(&stopped?)
}

/// Fails if the stop was not orderly.
fn check(stopped: &Stopped) -> Result<(), CliError> {
    if stopped.is_orderly() {
        return Ok(());
    }
    let mut left = Vec::new();
    if !stopped.requests_finished {
        left.push("every request was finished".to_owned());
    }
    if stopped.jobs_unrecorded > 0 {
        left.push(format!("the state of {} asynchronous jobs was recorded", stopped.jobs_unrecorded));
    }
    Err(CliError::Service(format!("stopped before {}", left.join(" and "))))
}

/// Returns the number of threads of the async runtime: a quarter of the cores, at least two. They serve sockets;
/// hashing and meshing have other threads. With two threads, a service with 32 cores and two GPUs sends half as many
/// meshes per second.
fn runtime_threads() -> usize {
    let cores = std::thread::available_parallelism().map_or(1, NonZero::get);
    (cores / 4).max(2)
}

/// Makes new files and folders accessible to the user of the service only.
fn hide_new_files() {
    #[cfg(target_os = "linux")]
    rustix::process::umask(rustix::fs::Mode::RWXG | rustix::fs::Mode::RWXO);
}

/// Raises the limit of open files to the hard limit.
fn raise_open_files() {
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
        let maximum = getrlimit(Resource::Nofile).maximum;
        if let Err(error) = setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }) {
            tracing::warn!(%error, "cannot raise the limit of open files");
        }
    }
}

/// Lowers the priority of compute threads, so that rejections, cached meshes and probes take milliseconds even while
/// all cores are meshing. Threads inherit their priority: the runtime's threads exist already, the compute threads do
/// not.
fn lower_compute_priority() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::nice(COMPUTE_NICE) {
        tracing::debug!(%error, "compute threads keep the default priority");
    }
    if let Err(error) = rayon::ThreadPoolBuilder::new().build_global() {
        tracing::debug!(%error, "the compute threads exist already");
    }
}
