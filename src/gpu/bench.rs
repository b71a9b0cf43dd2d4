//! A device for benchmarks: opened by number, in the order in which devices are numbered everywhere.

use wgpu::{Adapter, Backends, DeviceType, Features, Instance, InstanceDescriptor, InstanceFlags};

use super::engine::Engine;
use super::error::GpuError;
use super::meter::Metered;

/// A device that is measured.
#[derive(Debug)]
pub struct Opened {
    /// What runs the stages on it.
    pub engine: Engine,
    /// The adapter's name.
    pub name: String,
    /// Driver and interface, in words.
    pub driver: String,
    /// Whether it is a processor that plays a GPU: its speed says nothing of one.
    pub software: bool,
}

/// Opens adapter number `number`: by kind, place on the bus and name, hardware first.
///
/// # Errors
/// [`GpuError::NoDevice`] names the adapters that are there; [`GpuError::Failed`] where the driver refuses.
pub fn open(number: usize) -> Result<Opened, GpuError> {
    let instance = Instance::new(InstanceDescriptor {
        backends: Backends::VULKAN | Backends::METAL,
        flags: InstanceFlags::empty(),
        ..InstanceDescriptor::new_without_display_handle()
    });
    let mut adapters = pollster::block_on(instance.enumerate_adapters(Backends::VULKAN | Backends::METAL));
    adapters.sort_by_cached_key(|adapter| {
        let info = adapter.get_info();
        (rank(info.device_type), info.device_pci_bus_id, info.name)
    });
    let Some(adapter) = adapters.get(number) else {
        let there: Vec<_> =
            (0..).zip(&adapters).map(|(n, a): (usize, _)| format!("{n} {}", a.get_info().name)).collect();
        let there = if there.is_empty() { "no driver offers any".to_owned() } else { there.join(", ") };
        return Err(GpuError::NoDevice(format!("no adapter has number {number}: {there}")));
    };
    opened(adapter)
}

const fn rank(kind: DeviceType) -> u8 {
    match kind {
        DeviceType::DiscreteGpu => 0,
        DeviceType::VirtualGpu => 1,
        DeviceType::IntegratedGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    }
}

fn opened(adapter: &Adapter) -> Result<Opened, GpuError> {
    let info = adapter.get_info();
    let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
        label: Some("molmesh.bench"),
        required_features: adapter.features() & Features::TIMESTAMP_QUERY,
        required_limits: adapter.limits(),
        memory_hints: wgpu::MemoryHints::Performance,
        ..Default::default()
    }))
    .map_err(|e| GpuError::Failed(format!("the device cannot be opened: {e}")))?;
    Ok(Opened {
        engine: Engine::new(device, queue)?,
        name: info.name,
        driver: format!("{} {} ({})", info.driver, info.driver_info, info.backend.to_str()),
        software: info.device_type == DeviceType::Cpu,
    })
}

impl Engine {
    /// What was counted since the last call.
    pub fn metered(&mut self) -> Metered {
        self.meter.take()
    }
}
