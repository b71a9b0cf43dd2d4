//! A device for benchmarks: an engine without a pool around it.

use super::device;
use super::discover::{Look, discover};
use super::engine::Engine;
use super::error::GpuError;
use super::meter::Metered;
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

impl Engine {
    /// What was counted since the last call.
    pub fn metered(&mut self) -> Metered {
        self.meter.take()
    }
}
