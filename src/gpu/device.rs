//! From an adapter to what runs jobs on it.

use wgpu::{Adapter, Device, DeviceDescriptor, ExperimentalFeatures, Features, MemoryHints, Queue, Trace};

use super::engine::Engine;
use super::error::GpuError;
use super::executor::Executor;
use super::paper::Paper;

/// Features that are used where a device has them.
const WANTED: Features = Features::TIMESTAMP_QUERY.union(Features::SUBGROUP);

/// Which program runs on a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Program {
    /// Ours.
    Stages,
    /// The one of 2010, to compare with.
    Paper,
}

impl Program {
    /// The name of the backend that runs it.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Stages => "gpu",
            Self::Paper => "paper",
        }
    }
}

/// Opens `adapter` and builds the stages on it: the one place where a device meets them.
///
/// # Errors
/// [`GpuError::Failed`] where the driver refuses, and those of the stages.
pub(super) fn engine(adapter: &Adapter) -> Result<Engine, GpuError> {
    let (device, queue) = open(adapter)?;
    Engine::new(device, queue)
}

/// Likewise, with a program on top.
///
/// # Errors
/// As [`engine`], and those of the program.
pub(super) fn build(adapter: &Adapter, program: Program) -> Result<Box<dyn Executor>, GpuError> {
    let engine = engine(adapter)?;
    Ok(match program {
        Program::Stages => Box::new(engine),
        Program::Paper => Box::new(Paper::new(engine)?),
    })
}

/// Opens `adapter` with all that its limits allow.
///
/// # Errors
/// [`GpuError::Failed`] where the driver refuses.
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
