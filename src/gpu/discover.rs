//! Asks the drivers what there is: adapters to facts, facts to verdicts.

use std::panic::catch_unwind;

use wgpu::{Adapter, Backends, DeviceType, Features, Instance, InstanceDescriptor, InstanceFlags};

use super::error::GpuError;
use super::{choose, device, hardware};
use crate::surface::{DeviceChoice, DeviceFacts, DeviceKind, FoundDevice};

/// How thoroughly to look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Look {
    /// Ask no driver where there is no sign of hardware and nothing else was asked for.
    Quick,
    /// Ask every driver, so that everything that is there can be listed.
    Thorough,
}

/// What was found.
#[derive(Debug)]
pub struct Discovery {
    /// Every device in the order of its number, taken or not.
    pub devices: Vec<FoundDevice>,
    /// The adapters of `devices`, in the same order.
    pub(super) adapters: Vec<Adapter>,
    /// What was looked at, where nothing was found.
    pub looked: String,
}

impl Discovery {
    fn nothing(looked: String) -> Self {
        Self { devices: Vec::new(), adapters: Vec::new(), looked }
    }

    /// The devices that are taken.
    pub fn taken(&self) -> impl Iterator<Item = &FoundDevice> {
        self.devices.iter().filter(|device| device.taken)
    }

    /// Opens the taken device with this number, with all that its limits allow and timestamps where it has them.
    ///
    /// # Errors
    /// [`GpuError::NoDevice`] if no taken device has the number; [`GpuError::Failed`] if the driver refuses.
    pub fn open(&self, number: usize) -> Result<(wgpu::Device, wgpu::Queue), GpuError> {
        let mut all = self.devices.iter().zip(&self.adapters);
        match all.find(|(device, _)| device.taken && device.number == number) {
            Some((_, adapter)) => device::open(adapter),
            None => Err(GpuError::NoDevice(format!("no usable device has number {number}"))),
        }
    }

    /// Why no device is taken, on one line; `None` if one is.
    #[must_use]
    pub fn why_none(&self) -> Option<String> {
        if self.taken().next().is_some() {
            return None;
        }
        if self.devices.is_empty() {
            return Some(self.looked.clone());
        }
        let each = |d: &FoundDevice| format!("{} {}: {}", d.number, d.facts.name, d.reason);
        Some(self.devices.iter().map(each).collect::<Vec<_>>().join("; "))
    }

    /// The devices that were asked for and do not exist, in words.
    #[must_use]
    pub fn missing(&self, choice: &DeviceChoice) -> Vec<String> {
        choose::missing(&self.devices, choice)
    }
}

/// Looks for devices and judges each by `choice`. Never fails: what goes wrong is a reason.
#[must_use]
pub fn discover(choice: &DeviceChoice, look: Look) -> Discovery {
    let signs = hardware::signs();
    // Software and numbered devices are what only drivers know of.
    let named = matches!(choice, DeviceChoice::These(_));
    match (look, &signs) {
        (Look::Quick, _) if *choice == DeviceChoice::Cpu => {
            return Discovery::nothing("the CPU was asked for".to_owned());
        }
        (Look::Quick, Err(why)) if !named => return Discovery::nothing(why.clone()),
        _ => {}
    }
    let Ok(mut adapters) = catch_unwind(adapters) else {
        return Discovery::nothing("the drivers could not be asked: one of them panicked".to_owned());
    };
    // The order in which drivers answer changes with their versions; kind, place on the bus and name do not.
    adapters.sort_by_cached_key(|adapter| {
        let facts = facts(adapter);
        (facts.kind, facts.bus, facts.name, facts.api)
    });
    let looked = format!(
        "no driver offers an adapter (asked: {}; hardware: {})",
        if cfg!(target_vendor = "apple") { "Metal" } else { "every Vulkan driver that a Vulkan loader finds" },
        signs.unwrap_or_else(|why| why),
    );
    let devices = choose::judge(adapters.iter().map(facts).collect(), choice);
    Discovery { devices, adapters, looked }
}

/// Every adapter of the interfaces that we can use.
fn adapters() -> Vec<Adapter> {
    let instance = Instance::new(InstanceDescriptor {
        backends: Backends::VULKAN | Backends::METAL,
        // Validation is for whoever writes shaders, and they are validated when they are built in.
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
