//! Backends and devices with their states, for the banner and `doctor`.

use molmesh::pipeline::SelectedBackend;
use molmesh::surface::Backend;
use molmesh::surface::cpu::CpuBackend;
use molmesh::surface::reference::ReferenceBackend;

/// State of a backend or of one of its devices.
pub(crate) struct Availability {
    /// Value of `--backend`, for a device followed by its number.
    pub(crate) name: String,
    /// Hardware, or the reason why it cannot be used.
    pub(crate) state: Result<String, String>,
}

/// Formats a backend's name and hardware.
pub(crate) fn describe(backend: &dyn Backend) -> String {
    format!("{}: {}", backend.name(), backend.describe())
}

/// Returns all backends with their states.
pub(crate) fn backends(selected: &SelectedBackend) -> Vec<Availability> {
    let gpu = match &selected.no_gpu {
        None => Ok(selected.backend.describe()),
        Some(why) if selected.devices.is_empty() => Err(why.clone()),
        // Each device is listed with its own reason.
        Some(_) => Err("no device is used".to_owned()),
    };
    let cpu = CpuBackend::new(None).map(|cpu| cpu.describe());
    [("cpu", cpu), ("reference", Ok(ReferenceBackend.describe())), ("gpu", gpu)]
        .map(|(name, state)| Availability { name: name.to_owned(), state })
        .into()
}

/// Returns the unused devices with their reasons.
pub(crate) fn unused_devices(selected: &SelectedBackend) -> impl Iterator<Item = Availability> {
    selected.devices.iter().filter(|device| !device.selected).map(|device| Availability {
        name: format!("gpu {}", device.number),
        state: Err(format!("{}: {}", device.facts.name, device.reason)),
    })
}
