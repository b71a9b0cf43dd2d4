//! Submissions to the device queue. The host may submit before the previous submission is finished; the device runs
//! them in order.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::engine::Engine;
use super::error::GpuError;
use super::output_layout::values;
use super::pipelines::N_STAGES;
use super::readback::ReadbackBuffer;
use super::recording::{PendingSubmission, Recording, ticks_to_ns};

/// Device time per stage, ns.
pub(super) type StageTimes = [u64; N_STAGES];

impl Engine {
    /// Submits a recording and requests to map the given number of bytes of each readback buffer.
    pub(super) fn submit(&self, recording: Recording<'_>, readbacks: Vec<(ReadbackBuffer, u64)>) -> PendingSubmission {
        let index = self.queue.submit([recording.encoder.finish()]);
        for (readback, bytes) in &readbacks {
            readback.map(*bytes);
        }
        self.submissions.fetch_add(1, Ordering::Relaxed);
        PendingSubmission { index, readbacks }
    }

    /// Waits for a submission and all earlier ones. Returns the mapped readback buffers.
    pub(super) fn wait(&self, submission: PendingSubmission) -> Result<Vec<Arc<ReadbackBuffer>>, GpuError> {
        let PendingSubmission { index, readbacks } = submission;
        let waited = self.device.poll(wgpu::PollType::Wait { submission_index: Some(index), timeout: None });
        if waited.is_err() {
            // The callback that reports a lost device runs only when the device is polled.
            _ = self.device.poll(wgpu::PollType::Poll);
        }
        self.check_errors()?;
        waited.map_err(|e| GpuError::Failed(e.to_string()))?;
        readbacks.into_iter().map(|(readback, bytes)| readback.mapped(bytes)).collect()
    }

    /// Waits for a submission that has one readback buffer.
    pub(super) fn wait_one(&self, submission: PendingSubmission) -> Result<Arc<ReadbackBuffer>, GpuError> {
        let mapped = self.wait(submission)?.pop();
        mapped.ok_or_else(|| GpuError::Failed("a submission without its readback buffer".to_owned()))
    }

    /// Adds the times of `stages` in a readback buffer to `times`.
    pub(super) fn add_times(
        &self,
        times: &mut StageTimes,
        readback: &ReadbackBuffer,
        stages: Range<usize>,
    ) -> Result<(), GpuError> {
        if let Some(timer) = &self.timer {
            let ticks: &[u64] = values(readback.as_ref(), 0, 2 * N_STAGES as u64)?;
            for s in stages {
                times[s] += ticks_to_ns(ticks[2 * s + 1].saturating_sub(ticks[2 * s]), timer.period);
            }
        }
        Ok(())
    }
}
