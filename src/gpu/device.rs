//! Opens adapters and builds the executors on them.

use wgpu::{Adapter, Device, DeviceDescriptor, ExperimentalFeatures, Features, MemoryHints, Queue, Trace};

use super::engine::Engine;
use super::error::GpuError;
use super::executor::Executor;
use super::paper::Paper;

/// Features that are used if the device has them.
const WANTED: Features = Features::TIMESTAMP_QUERY.union(Features::SUBGROUP);

/// Program that runs on a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Program {
    /// The stages of this crate.
    Stages,
    /// The 2010 program, for comparison.
    Paper,
}

impl Program {
    /// Name of the backend that runs the program.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Stages => "gpu",
            Self::Paper => "paper",
        }
    }
}

/// Opens `adapter` and builds the engine on it.
///
/// # Errors
/// [`GpuError::Failed`] if the driver rejects the request; those of [`Engine::new`].
pub(super) fn engine(adapter: &Adapter) -> Result<Engine, GpuError> {
    let (device, queue) = open(adapter)?;
    Engine::new(device, queue)
}

/// Opens `adapter` and builds the executor of `program` on it.
///
/// # Errors
/// Those of [`engine`] and of the program.
pub(super) fn build(adapter: &Adapter, program: Program) -> Result<Box<dyn Executor>, GpuError> {
    let engine = engine(adapter)?;
    Ok(match program {
        Program::Stages => Box::new(engine),
        Program::Paper => Box::new(Paper::new(engine)?),
    })
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
