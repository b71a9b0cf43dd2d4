//! What the graphics API complains about. It reports errors to a callback of the device, whenever it finds them; the
//! engine looks here after every step that may fail.

use std::sync::{Arc, Mutex, PoisonError};

/// The first complaints since the last look.
#[derive(Debug, Default)]
pub(super) struct Health(Mutex<Noted>);

#[derive(Debug, Default)]
struct Noted {
    lost: Option<String>,
    out_of_memory: bool,
    failed: Option<String>,
}

/// What was complained about.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Complaint {
    OutOfMemory,
    Lost(String),
    Failed(String),
}

impl Health {
    /// Listens to `device`.
    pub(super) fn of(device: &wgpu::Device) -> Arc<Self> {
        let health = Arc::new(Self::default());
        let (errors, losses) = (health.clone(), health.clone());
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| errors.note(&error)));
        device.set_device_lost_callback(move |reason, message| losses.lose(format!("{reason:?}: {message}")));
        health
    }

    fn note(&self, error: &wgpu::Error) {
        let mut noted = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        match error {
            wgpu::Error::OutOfMemory { .. } => noted.out_of_memory = true,
            other => _ = noted.failed.get_or_insert_with(|| other.to_string()),
        }
    }

    fn lose(&self, why: String) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).lost.get_or_insert(why);
    }

    /// The worst since the last look. A loss stays.
    pub(super) fn complaint(&self) -> Option<Complaint> {
        let mut noted = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let failed = noted.failed.take();
        let out_of_memory = std::mem::take(&mut noted.out_of_memory);
        match (&noted.lost, out_of_memory, failed) {
            (Some(why), ..) => Some(Complaint::Lost(why.clone())),
            (None, true, _) => Some(Complaint::OutOfMemory),
            (None, false, Some(why)) => Some(Complaint::Failed(why)),
            (None, false, None) => None,
        }
    }
}
