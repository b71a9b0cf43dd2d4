//! The only place that picks a backend, and gives the reason in words.

use molmesh::surface::Backend;
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::reference::ReferenceBackend;

use super::args::BackendName;
use super::error::CliError;

/// A backend and why it was taken.
pub(crate) struct Picked {
    /// The backend.
    pub(crate) backend: Box<dyn Backend>,
    /// Why, in words.
    pub(crate) reason: String,
}

/// A backend that could be asked for, as `doctor` and the banner show it.
pub(crate) struct Candidate {
    /// What `--backend` calls it.
    pub(crate) name: &'static str,
    /// What it would run on, or why it is not there.
    pub(crate) state: Result<String, String>,
}

/// What a backend is picked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Use {
    /// One mesh, by the calling thread.
    Once,
    /// Many, by the threads of a service.
    Service,
}

/// Picks a backend.
///
/// # Errors
/// [`CliError::NoBackend`] says why the one that was asked for is not there.
pub(crate) fn pick(asked: BackendName, threads: Option<usize>, use_: Use) -> Result<Picked, CliError> {
    if threads == Some(0) {
        return Err(CliError::usage("parameter `threads`: 0 is not allowed; expected a number from 1"));
    }
    Ok(match asked {
        BackendName::Auto => Picked { backend: cpu(threads, use_)?, reason: format!("auto: no GPU, as {}", no_gpu()) },
        BackendName::Cpu => Picked { backend: cpu(threads, use_)?, reason: "asked for".to_owned() },
        BackendName::Reference => Picked { backend: Box::new(ReferenceBackend), reason: "asked for".to_owned() },
        BackendName::Gpu => return Err(CliError::NoBackend { asked: "gpu", why: no_gpu().to_owned() }),
        BackendName::Paper => return Err(CliError::NoBackend { asked: "paper", why: no_paper() }),
    })
}

/// A backend's name and what it runs on.
pub(crate) fn describe(backend: &dyn Backend) -> String {
    format!("{}: {}", backend.name(), backend.describe())
}

/// Every backend and its state.
pub(crate) fn survey() -> Vec<Candidate> {
    vec![
        Candidate { name: "cpu", state: CpuBackend::new(None).map(|cpu| cpu.describe()) },
        Candidate { name: "reference", state: Ok(ReferenceBackend.describe()) },
        Candidate { name: "gpu", state: Err(no_gpu().to_owned()) },
        Candidate { name: "paper", state: Err(no_paper()) },
    ]
}

fn cpu(threads: Option<usize>, use_: Use) -> Result<Box<dyn Backend>, CliError> {
    let backend = match use_ {
        Use::Once => CpuBackend::on_this_thread(threads),
        Use::Service => CpuBackend::new(threads),
    };
    let backend = backend.map_err(|why| CliError::NoBackend { asked: "cpu", why })?;
    Ok(Box::new(backend))
}

/// Why no GPU can be used.
fn no_gpu() -> &'static str {
    #[cfg(feature = "gpu")]
    return molmesh::gpu::unavailable();
    #[cfg(not(feature = "gpu"))]
    return "this build has no GPU support";
}

fn no_paper() -> String {
    format!("the 2010 program runs on a GPU, and {}", no_gpu())
}
