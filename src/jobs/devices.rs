//! Publishes the status of the devices as metrics and logs changes.

use std::sync::{Mutex, PoisonError};

use metrics::{counter, gauge};

use crate::surface::DeviceStatus;
use crate::telemetry::{
    DEVICE_BUSY, DEVICE_JOBS, DEVICE_LOST, DEVICE_MEMORY, DEVICE_PARTITIONS, DEVICE_REBUILDS, DEVICE_SHARED, DEVICE_UP,
    DEVICE_WAITING,
};

/// State of each device at the last call: number of rebuilds, and true if it was up.
#[derive(Debug, Default)]
pub(super) struct DeviceMonitor(Mutex<Vec<(u64, bool)>>);

impl DeviceMonitor {
    /// Publishes the status of `devices` and logs changes since the last call.
    #[expect(clippy::cast_precision_loss, reason = "gauges are floats; exact up to 8 PiB")]
    pub(super) fn publish(&self, devices: &[DeviceStatus]) {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        known.resize(devices.len(), (0, true));
        for (device, known) in devices.iter().zip(known.iter_mut()) {
            let number = device.number.to_string();
            let up = device.down.is_none();
            gauge!(DEVICE_UP, "device" => number.clone()).set(f64::from(u8::from(up)));
            gauge!(DEVICE_MEMORY, "device" => number.clone()).set(device.held_bytes as f64);
            gauge!(DEVICE_WAITING, "device" => number.clone()).set(device.waiting as f64);
            gauge!(DEVICE_BUSY, "device" => number.clone()).set(device.busy.as_secs_f64());
            for (reason, count) in [("failed", device.lost), ("hung", device.hung)] {
                counter!(DEVICE_LOST, "device" => number.clone(), "reason" => reason).absolute(count);
            }
            counter!(DEVICE_REBUILDS, "device" => number.clone()).absolute(device.rebuilds);
            counter!(DEVICE_SHARED, "device" => number.clone()).absolute(device.shared);
            counter!(DEVICE_PARTITIONS, "device" => number.clone()).absolute(device.partitions);
            for (outcome, count) in [("finished", device.finished), ("failed", device.failed)] {
                counter!(DEVICE_JOBS, "device" => number.clone(), "outcome" => outcome).absolute(count);
            }
            let DeviceStatus { number, name, rebuilds, .. } = device;
            if *rebuilds > known.0 {
                tracing::warn!(device = number, name, rebuilds, "a device failed and was rebuilt");
            }
            match &device.down {
                Some(why) if known.1 => tracing::error!(device = number, name, why, "a device is down"),
                None if !known.1 => tracing::info!(device = number, name, "a device is used again"),
                _ => {}
            }
            *known = (*rebuilds, up);
        }
    }
}
