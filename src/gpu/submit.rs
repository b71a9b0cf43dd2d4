//! Submissions: sent off, waited for, read. One may be sent before another has come back: the device runs them in order,
//! and begins the next without waiting for the host.

use std::sync::Arc;

use super::engine::{Engine, Times, scaled};
use super::error::GpuError;
use super::flight::values;
use super::landing::Landing;
use super::pipelines::N_STAGES;
use super::record::Recording;

/// A submission on its way.
pub(super) struct Flight {
    index: wgpu::SubmissionIndex,
    landings: Vec<(Landing, u64)>,
}

impl Engine {
    /// Submits, and asks for the landings' first bytes.
    pub(super) fn launch(&self, recording: Recording<'_>, landings: Vec<(Landing, u64)>) -> Result<Flight, GpuError> {
        let index = self.queue.submit([recording.encoder.finish()]);
        for (landing, bytes) in &landings {
            landing.request(*bytes).map_err(GpuError::Failed)?;
        }
        self.submissions.update(|n| n + 1);
        Ok(Flight { index, landings })
    }

    /// Waits for a submission and all before it, and returns the landings' first bytes.
    pub(super) fn land(&self, flight: Flight) -> Result<Vec<Arc<Landing>>, GpuError> {
        let Flight { index, landings } = flight;
        let waited = self.device.poll(wgpu::PollType::Wait { submission_index: Some(index), timeout: None });
        if waited.is_err() {
            // A loss is told by a callback, which a device that cannot wait any more has not run yet.
            _ = self.device.poll(wgpu::PollType::Poll);
        }
        self.healthy()?;
        waited.map_err(|e| GpuError::Failed(e.to_string()))?;
        landings.into_iter().map(|(landing, bytes)| landing.look(bytes).map_err(GpuError::Failed)).collect()
    }

    /// Submits, waits, and returns the landings' first bytes.
    pub(super) fn fly(
        &self,
        recording: Recording<'_>,
        landings: Vec<(Landing, u64)>,
    ) -> Result<Vec<Arc<Landing>>, GpuError> {
        self.land(self.launch(recording, landings)?)
    }

    pub(super) fn recording(&self) -> Recording<'_> {
        Recording::new(&self.device, &self.pipelines, self.clock.as_ref())
    }

    /// The times of the stages from `first` to `last` in a landing.
    pub(super) fn times(&self, landing: &Landing, stages: std::ops::Range<usize>) -> Result<Times, GpuError> {
        let mut times = [0; N_STAGES];
        if let Some(clock) = &self.clock {
            let ticks: &[u64] = values(landing.as_ref(), 0, 2 * N_STAGES as u64).map_err(GpuError::Failed)?;
            for s in stages {
                times[s] = scaled(ticks[2 * s + 1].saturating_sub(ticks[2 * s]), f64::from(clock.period));
            }
        }
        Ok(times)
    }
}
