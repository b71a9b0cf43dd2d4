//! `molmesh serve`: flags to a configuration, a runtime, a banner, and the service until it is told to stop.

use std::io::{self, Write};
use std::sync::Arc;
use std::time::Duration;

use molmesh::config::Loaded;
use molmesh::http::{Chosen, ServeError, Server, has_viewer, shutdown_signals};
use molmesh::store::LockError;
use molmesh::structure::referee;
use molmesh::surface::Backend;
use molmesh::telemetry;

use super::args::ServeArgs;
use super::backend::{self, Asked, Picked};
use super::banner::{self, Facts};
use super::error::CliError;
use super::style::Style;
use super::survey;

/// How much nicer threads that compute are than those that answer: their share of a busy core is a third.
#[cfg(target_os = "linux")]
const COMPUTING: i32 = 5;
/// Threads of the runtime: they read and write sockets; meshing has its own.
const RUNTIME_THREADS: usize = 2;

/// Runs the command: returns when the service was stopped and has finished what it was doing.
pub(super) fn run(args: &ServeArgs) -> Result<(), CliError> {
    let Loaded { config, warnings, .. } = super::config::load(args)?;
    telemetry::init_logs(&config.log).map_err(|e| CliError::usage(e.to_string()))?;
    for warning in warnings {
        tracing::warn!("{warning}");
    }
    referee::quiet_panics();
    let asked = Asked { backend: args.backend, devices: &config.devices.choice, threads: None, work: None };
    let picked = backend::pick(&asked, &backend::Use::Service(config.devices.clone()))?;
    let others = survey::survey(&picked);
    let Picked { backend, reason, drawer, devices, .. } = picked;
    let backend: Arc<dyn Backend> = Arc::from(backend);
    let keys = config.access.keys_file.is_some();
    let facts = Facts {
        device: survey::describe(backend.as_ref()),
        reason: reason.clone(),
        others,
        keys,
        viewer: has_viewer(),
    };
    raise_open_files();
    let failed = |e: io::Error| CliError::Service(format!("cannot start the runtime: {e}"));
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(RUNTIME_THREADS)
        .thread_name("http")
        .enable_all()
        .build()
        .map_err(failed)?;
    give_way();
    let server = runtime.block_on(Server::bind(config, Chosen { backend, reason, drawer, devices })).map_err(
        |error| match error {
            // Keys and secrets are the caller's, as the rest of the configuration is.
            ServeError::Access(error) => CliError::usage(error.to_string()),
            ServeError::Lock(error @ LockError::Held { .. }) => CliError::InUse(error.to_string()),
            error => CliError::Service(error.to_string()),
        },
    )?;
    let text = banner::text(server.addr(), server.metrics_addr(), &facts, Style::stderr());
    // The service runs whether or not somebody reads its banner.
    drop(io::stderr().write_all(text.as_bytes()));

    let drained =
        runtime.block_on(async { server.run(shutdown_signals()).await }).map_err(|e| CliError::Service(e.to_string()));
    // What still reads a file or computes after the drain timeout is not waited for.
    runtime.shutdown_timeout(Duration::from_millis(100));
    if drained? { Ok(()) } else { Err(CliError::Service("stopped before every request was finished".to_owned())) }
}

/// Raises the limit of open files to the hard limit.
fn raise_open_files() {
    #[cfg(target_os = "linux")]
    {
        use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
        let maximum = getrlimit(Resource::Nofile).maximum;
        if let Err(error) = setrlimit(Resource::Nofile, Rlimit { current: maximum, maximum }) {
            tracing::warn!(%error, "the limit of open files stays as it was");
        }
    }
}

/// Lets computing give way to answering: a refusal, a cached mesh and a probe are due in milliseconds also while every
/// core meshes. Threads take their priority from the one that starts them: those of the runtime are there already, those that
/// compute are not.
fn give_way() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::nice(COMPUTING) {
        tracing::debug!(%error, "computing has the priority of answering");
    }
    if let Err(error) = rayon::ThreadPoolBuilder::new().build_global() {
        tracing::debug!(%error, "the threads that compute were there already");
    }
}
