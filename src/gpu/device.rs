//! From an adapter to what runs jobs on it.

use wgpu::{Adapter, Device, DeviceDescriptor, ExperimentalFeatures, Features, MemoryHints, Queue, Trace};

use super::engine::Engine;
use super::error::GpuError;
use super::executor::Executor;

/// Features that are used where a device has them.
const WANTED: Features = Features::TIMESTAMP_QUERY.union(Features::SUBGROUP);

/// Opens `adapter` and builds the stages on it: the one place where a device meets them.
///
/// # Errors
/// [`GpuError::Failed`] where the driver refuses, and those of the stages.
pub(super) fn build(adapter: &Adapter) -> Result<Box<dyn Executor>, GpuError> {
    let (device, queue) = open(adapter)?;
    Ok(Box::new(Engine::new(device, queue)?))
}

/// Opens `adapter` with all that its limits allow.
///
/// # Errors
/// [`GpuError::Failed`] where the driver refuses.
fn open(adapter: &Adapter) -> Result<(Device, Queue), GpuError> {
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
