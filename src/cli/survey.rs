//! Backends and devices with their states, for the banner and `doctor`.

use molmesh::surface::Backend;
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::reference::ReferenceBackend;

use super::backend::SelectedBackend;

/// State of a backend or of one of its devices.
pub(crate) struct Availability {
    /// Value of `--backend`, for a device followed by its number.
    pub(crate) name: String,
    /// Hardware, or the reason why it cannot be used.
    pub(crate) state: Result<String, String>,
}

impl Availability {
    /// Returns true for a device of a backend.
    pub(crate) fn is_device(&self) -> bool {
        self.name.contains(' ')
    }
}

/// Formats a backend's name and hardware.
pub(crate) fn describe(backend: &dyn Backend) -> String {
    format!("{}: {}", backend.name(), backend.describe())
}

/// Returns all backends and the unused devices, with their states.
pub(crate) fn survey(selected: &SelectedBackend) -> Vec<Availability> {
    let candidate = |name: &str, state| Availability { name: name.to_owned(), state };
    let gpu = selected.no_gpu.clone().map_or_else(|| Ok(selected.backend.describe()), Err);
    let mut survey = vec![
        candidate("cpu", CpuBackend::new(None).map(|cpu| cpu.describe())),
        candidate("reference", Ok(ReferenceBackend.describe())),
    ];
    // The reasons of the devices follow, one per line.
    let gpu = gpu.map_err(|why| if selected.devices.is_empty() { why } else { "no device is used".to_owned() });
    survey.push(candidate("gpu", gpu));
    let left = selected.devices.iter().filter(|device| !device.taken);
    survey
        .extend(left.map(|d| candidate(&format!("gpu {}", d.number), Err(format!("{}: {}", d.facts.name, d.reason)))));
    survey
}
