//! Opens adapters and builds engines on them.

use wgpu::{Adapter, Device, DeviceDescriptor, ExperimentalFeatures, Features, MemoryHints, Queue, Trace};

use super::engine::Engine;
use super::error::GpuError;

/// Features that are used if the device has them.
const WANTED: Features = Features::TIMESTAMP_QUERY.union(Features::SUBGROUP);

/// Opens `adapter` and builds the engine on it.
///
/// # Errors
/// [`GpuError::Failed`] if the driver rejects the request; those of [`Engine::new`].
pub(super) fn engine(adapter: &Adapter) -> Result<Engine, GpuError> {
    let (device, queue) = open(adapter)?;
    Engine::new(device, queue)
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
