//! A device for benchmarks: an engine without a pool around it.

use super::device;
use super::discover::{Look, discover};
use super::engine::Engine;
use super::error::GpuError;
use super::meter::Metered;
use super::shaders::{PAPER, SHADERS, Shader};
use crate::surface::{DeviceChoice, DeviceKind, DeviceName};

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

/// Opens the device that `molmesh doctor` gives this number.
///
/// # Errors
/// [`GpuError::NoDevice`] names the devices that are there; [`GpuError::Failed`] where the driver refuses.
pub fn open(number: usize) -> Result<Opened, GpuError> {
    let found = discover(&DeviceChoice::These(vec![DeviceName::Number(number)]), Look::Thorough);
    let taken = found.devices.iter().zip(&found.adapters).find(|(device, _)| device.taken);
    let Some((device, adapter)) = taken else {
        let why = found.why_none().unwrap_or_default();
        return Err(GpuError::NoDevice(format!("no device has number {number}: {why}")));
    };
    let facts = &device.facts;
    Ok(Opened {
        engine: device::engine(adapter)?,
        name: facts.name.clone(),
        driver: format!("{} ({})", facts.driver, facts.api),
        software: facts.kind == DeviceKind::Software,
    })
}

/// A stage as the build reflected its shader.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StageShape {
    /// Whether it belongs to the 2010 program.
    pub paper: bool,
    /// Its name.
    pub stage: &'static str,
    /// Threads of a workgroup.
    pub workgroup_size: u32,
    /// Bytes that a workgroup shares.
    pub workgroup_bytes: u32,
}

/// The shapes of our stages, then of the 2010 program's, in the order in which they run.
#[must_use]
pub fn shapes() -> Vec<StageShape> {
    fn shape<B>(paper: bool, shader: &Shader<B>) -> StageShape {
        StageShape {
            paper,
            stage: shader.stage,
            workgroup_size: shader.workgroup_size,
            workgroup_bytes: shader.workgroup_bytes,
        }
    }
    SHADERS.iter().map(|s| shape(false, s)).chain(PAPER.iter().map(|s| shape(true, s))).collect()
}

impl Engine {
    /// What was counted since the last call.
    pub fn metered(&mut self) -> Metered {
        self.meter.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shapes_are_those_of_the_shaders() {
        let shapes = shapes();
        let of = |paper, stage| *shapes.iter().find(|s| s.paper == paper && s.stage == stage).unwrap();
        // As shaders/paper/field.wgsl and classify.wgsl have it.
        assert_eq!((of(true, "field").workgroup_size, of(true, "field").workgroup_bytes), (64, 0));
        assert_eq!(of(true, "classify").workgroup_size, 256);
        assert!(of(false, "field").workgroup_bytes > 0 && of(true, "scan").workgroup_bytes > 0);
        let sources = SHADERS.iter().map(|s| s.source).chain(PAPER.iter().map(|s| s.source));
        for (shape, source) in shapes.iter().zip(sources) {
            // Sizes that are written as numbers.
            if let Some((_, rest)) = source.split_once("@workgroup_size(")
                && let Some(size) = rest.split(')').next().and_then(|n| n.trim_end_matches('u').parse::<u32>().ok())
            {
                assert_eq!(shape.workgroup_size, size, "{}", shape.stage);
            }
        }
    }
}
