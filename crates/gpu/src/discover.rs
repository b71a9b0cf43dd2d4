//! Discovery of devices: lists the adapters of all drivers, selects devices by the user's choice, and opens and
//! describes them.

use std::panic::catch_unwind;

use molmesh_surface::{DeviceChoice, DeviceFacts, DeviceKind, FoundDevice};
use wgpu::{
    Adapter, Backends, Device, DeviceDescriptor, DeviceType, ExperimentalFeatures, Features, Instance,
    InstanceDescriptor, InstanceFlags, MemoryHints, Queue, Trace,
};

use super::error::GpuError;
use super::shaders::SHADERS_HASH;
use super::{choose, hardware};

/// Features that are requested if the device has them.
const WANTED: Features = Features::TIMESTAMP_QUERY.union(Features::SUBGROUP);

/// Effort of a discovery.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DiscoveryMode {
    /// Load no driver if no device node of a GPU exists, unless devices were requested by name.
    Quick,
    /// Load every driver, to list all devices.
    Thorough,
}

/// Result of a discovery.
#[derive(Debug)]
pub struct Discovery {
    /// All devices by number, selected or not.
    pub devices: Vec<FoundDevice>,
    /// Adapters of `devices`, in the same order.
    pub(super) adapters: Vec<Adapter>,
    /// Reason for an empty list.
    pub empty_reason: String,
}

impl Discovery {
    fn nothing(empty_reason: String) -> Self {
        Self { devices: Vec::new(), adapters: Vec::new(), empty_reason }
    }

    /// Returns the selected devices.
    pub fn selected(&self) -> impl Iterator<Item = &FoundDevice> {
        self.devices.iter().filter(|device| device.selected)
    }

    /// Returns the selected devices with their adapters.
    pub(super) fn selected_adapters(&self) -> impl Iterator<Item = (&FoundDevice, &Adapter)> {
        self.devices.iter().zip(&self.adapters).filter(|(device, _)| device.selected)
    }

    /// Opens the selected device with this number, with its own limits and, if supported, timestamps.
    ///
    /// # Errors
    /// Returns [`GpuError::NoDevice`] if no selected device has the number, and [`GpuError::Failed`] if the driver
    /// rejects the request.
    pub fn open(&self, number: usize) -> Result<(Device, Queue), GpuError> {
        match self.selected_adapters().find(|(device, _)| device.number == number) {
            Some((_, adapter)) => open(adapter),
            None => Err(GpuError::NoDevice(format!("no usable device has number {number}"))),
        }
    }

    /// Reason why no device is selected, on one line; `None` if one is.
    #[must_use]
    pub fn no_device_reason(&self) -> Option<String> {
        if self.selected().next().is_some() {
            return None;
        }
        if self.devices.is_empty() {
            return Some(self.empty_reason.clone());
        }
        let each = |d: &FoundDevice| format!("{} {}: {}", d.number, d.facts.name, d.reason);
        Some(self.devices.iter().map(each).collect::<Vec<_>>().join("; "))
    }

    /// Messages for the requested devices that do not exist.
    #[must_use]
    pub fn missing(&self, choice: &DeviceChoice) -> Vec<String> {
        choose::missing(&self.devices, choice)
    }
}

/// Lists all devices and selects some by `choice`. Failures become reasons in the result.
#[must_use]
pub fn discover(choice: &DeviceChoice, mode: DiscoveryMode) -> Discovery {
    let nodes = hardware::device_nodes();
    // Only drivers know software devices and device numbers.
    let named = matches!(choice, DeviceChoice::Listed(_));
    match (mode, &nodes) {
        (DiscoveryMode::Quick, _) if *choice == DeviceChoice::Cpu => {
            return Discovery::nothing("the CPU was requested".to_owned());
        }
        (DiscoveryMode::Quick, Err(why)) if !named => return Discovery::nothing(why.clone()),
        _ => {}
    }
    let Ok(mut adapters) = catch_unwind(adapters) else {
        return Discovery::nothing("a driver panicked during discovery".to_owned());
    };
    // The order in which drivers list adapters varies with their versions; kind, bus address and name do not.
    adapters.sort_by_cached_key(|adapter| {
        let facts = facts(adapter);
        (facts.kind, facts.bus, facts.name, facts.api)
    });
    let empty_reason = format!(
        "no driver offers an adapter (searched: {}; hardware: {})",
        if cfg!(target_vendor = "apple") { "Metal" } else { "all Vulkan drivers that the loader finds" },
        nodes.unwrap_or_else(|why| why),
    );
    let devices = choose::select(adapters.iter().map(facts).collect(), choice);
    Discovery { devices, adapters, empty_reason }
}

/// All Vulkan and Metal adapters.
fn adapters() -> Vec<Adapter> {
    let instance = Instance::new(InstanceDescriptor {
        backends: Backends::VULKAN | Backends::METAL,
        // The build validates the shaders; the validation layers are not needed.
        flags: InstanceFlags::empty(),
        ..InstanceDescriptor::new_without_display_handle()
    });
    pollster::block_on(instance.enumerate_adapters(Backends::VULKAN | Backends::METAL))
}

fn facts(adapter: &Adapter) -> DeviceFacts {
    let (info, limits, features) = (adapter.get_info(), adapter.limits(), adapter.features());
    let driver = [info.driver.as_str(), info.driver_info.as_str()];
    DeviceFacts {
        kind: match info.device_type {
            DeviceType::DiscreteGpu => DeviceKind::Discrete,
            DeviceType::VirtualGpu => DeviceKind::Virtual,
            DeviceType::IntegratedGpu => DeviceKind::Integrated,
            DeviceType::Cpu => DeviceKind::Software,
            DeviceType::Other => DeviceKind::Unknown,
        },
        name: info.name,
        api: info.backend.to_str(),
        driver: driver.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(" "),
        bus: info.device_pci_bus_id,
        binding_bytes: limits.max_storage_buffer_binding_size,
        buffer_bytes: limits.max_buffer_size,
        workgroup_bytes: limits.max_compute_workgroup_storage_size.into(),
        workgroup_size: limits.max_compute_invocations_per_workgroup.into(),
        storage_buffers: limits.max_storage_buffers_per_shader_stage.into(),
        timestamps: features.contains(Features::TIMESTAMP_QUERY),
        subgroups: features.contains(Features::SUBGROUP).then_some([info.subgroup_min_size, info.subgroup_max_size]),
    }
}

/// Opens `adapter` with its own limits.
///
/// # Errors
/// [`GpuError::Failed`] if the driver rejects the request.
pub(super) fn open(adapter: &Adapter) -> Result<(Device, Queue), GpuError> {
    let descriptor = DeviceDescriptor {
        label: Some("molmesh"),
        required_features: adapter.features() & WANTED,
        required_limits: adapter.limits(),
        experimental_features: ExperimentalFeatures::disabled(),
        memory_hints: MemoryHints::Performance,
        trace: Trace::Off,
    };
    pollster::block_on(adapter.request_device(&descriptor))
        .map_err(|error| GpuError::Failed(format!("the device cannot be opened: {error}")))
}

/// Identifies the arithmetic of a device: model, driver, shaders, and the processor, which prepares jobs and measures
/// meshes.
pub(super) fn arithmetic(name: &str, device: &str) -> String {
    format!("{name} {device} {SHADERS_HASH} {}", molmesh_surface::arithmetic())
}

/// Describes a device and its driver, for display.
pub(super) fn describe(facts: &DeviceFacts) -> String {
    let DeviceFacts { name, kind, api, driver, .. } = facts;
    let driver = if driver.is_empty() { String::new() } else { format!(", {driver}") };
    format!("{name} ({}, {api}{driver})", kind.name())
}

#[cfg(test)]
mod tests {
    use molmesh_surface::DeviceKind;

    use super::*;

    #[test]
    fn the_arithmetic_names_model_driver_and_processor() {
        let facts = |name: &str, driver: &str| DeviceFacts {
            name: name.to_owned(),
            kind: DeviceKind::Discrete,
            api: "vulkan",
            driver: driver.to_owned(),
            bus: String::new(),
            binding_bytes: 0,
            buffer_bytes: 0,
            workgroup_bytes: 0,
            workgroup_size: 0,
            storage_buffers: 0,
            timestamps: false,
            subgroups: None,
        };
        let arithmetic_of = |name, driver| arithmetic("gpu", &describe(&facts(name, driver)));
        assert_eq!(arithmetic_of("card", "driver 1"), arithmetic_of("card", "driver 1"));
        assert_ne!(arithmetic_of("card", "driver 1"), arithmetic_of("card", "driver 2"));
        assert_ne!(arithmetic_of("card", "driver 1"), arithmetic_of("other card", "driver 1"));
        assert!(arithmetic_of("card", "driver 1").ends_with(&molmesh_surface::arithmetic()), "without the processor");
    }
}
