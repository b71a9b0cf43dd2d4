//! What there is to run on, taken or not, for the banner and `doctor`.

use molmesh::surface::Backend;
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::reference::ReferenceBackend;

use super::backend::Picked;

/// A backend that could be asked for, or a device of one, as `doctor` and the banner show it.
pub(crate) struct Candidate {
    /// What `--backend` calls it; a device has its number behind that.
    pub(crate) name: String,
    /// What it would run on, or why it is not there.
    pub(crate) state: Result<String, String>,
}

impl Candidate {
    /// Whether this is a device of a backend.
    pub(crate) fn is_device(&self) -> bool {
        self.name.contains(' ')
    }
}

/// A backend's name and what it runs on.
pub(crate) fn describe(backend: &dyn Backend) -> String {
    format!("{}: {}", backend.name(), backend.describe())
}

/// Every backend and its state, and the devices that are not taken.
pub(crate) fn survey(picked: &Picked) -> Vec<Candidate> {
    let candidate = |name: &str, state| Candidate { name: name.to_owned(), state };
    let gpu = picked.no_gpu.clone().map_or_else(|| Ok(picked.backend.describe()), Err);
    let mut survey = vec![
        candidate("cpu", CpuBackend::new(None).map(|cpu| cpu.describe())),
        candidate("reference", Ok(ReferenceBackend.describe())),
    ];
    // The devices' own reasons follow, one a line.
    let gpu = gpu.map_err(|why| if picked.devices.is_empty() { why } else { "no device is taken".to_owned() });
    survey.push(candidate("gpu", gpu));
    let left = picked.devices.iter().filter(|device| !device.taken);
    survey
        .extend(left.map(|d| candidate(&format!("gpu {}", d.number), Err(format!("{}: {}", d.facts.name, d.reason)))));
    survey
}
