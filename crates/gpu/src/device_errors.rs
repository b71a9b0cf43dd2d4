//! Errors that the graphics API reports through callbacks, at any time. Callers check for them after every operation
//! that may fail.

use std::sync::{Arc, Mutex, PoisonError};

use super::error::GpuError;

/// First error of each kind since the last check.
#[derive(Debug, Default)]
pub(super) struct DeviceErrors(Mutex<Reported>);

#[derive(Debug, Default)]
struct Reported {
    lost: Option<String>,
    out_of_memory: bool,
    failed: Option<String>,
}

impl DeviceErrors {
    /// Registers the callbacks of `device`.
    pub(super) fn listen(device: &wgpu::Device) -> Arc<Self> {
        let all = Arc::new(Self::default());
        let (errors, losses) = (Arc::clone(&all), Arc::clone(&all));
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| errors.report(&error)));
        device.set_device_lost_callback(move |reason, message| {
            let mut reported = losses.0.lock().unwrap_or_else(PoisonError::into_inner);
            reported.lost.get_or_insert(format!("{reason:?}: {message}"));
        });
        all
    }

    fn report(&self, error: &wgpu::Error) {
        let mut reported = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match error {
            wgpu::Error::OutOfMemory { .. } => reported.out_of_memory = true,
            other => _ = reported.failed.get_or_insert_with(|| other.to_string()),
        }
    }

    /// Returns and clears the most severe error since the last check; a lost device stays lost. `out_of_memory` creates
    /// the error for a failed allocation.
    ///
    /// # Errors
    /// [`GpuError::Lost`], `out_of_memory`, [`GpuError::Failed`], in this order.
    pub(super) fn check(&self, out_of_memory: impl FnOnce() -> GpuError) -> Result<(), GpuError> {
        let mut reported = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let failed = reported.failed.take();
        let no_memory = std::mem::take(&mut reported.out_of_memory);
        match (&reported.lost, no_memory, failed) {
            (Some(why), ..) => Err(GpuError::Lost(why.clone())),
            (None, true, _) => Err(out_of_memory()),
            (None, false, Some(why)) => Err(GpuError::Failed(why)),
            (None, false, None) => Ok(()),
        }
    }
}
