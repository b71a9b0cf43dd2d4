//! First half of a job: the stages that evaluate a chunk and count its vertices and triangles.
//!
//! `scan` is not a single-pass scan, whose workgroups wait for each other: WebGPU does not guarantee that they all make
//! progress, so it could hang. Instead, `classify` adds up the counts of each group of bricks, and every workgroup of
//! `scan` adds up the groups before its own.

use super::buffers::BufferId;
use super::engine::Engine;
use super::error::GpuError;
use super::job_state::{ChunkCounts, JobState};
use super::output_layout::{BODY_OFFSET, narrow};
use super::plan::layout::Params;
use super::recording::PendingSubmission;

/// Number of the stages that run before the size of the output is known: `bin` to `refine`.
pub(super) const N_COUNT_STAGES: usize = 5;

impl Engine {
    /// Submits the stages `bin` to `refine` of a chunk.
    pub(super) fn submit_count(&self, state: &JobState, chunk: usize) -> Result<PendingSubmission, GpuError> {
        let loaded = &state.loaded;
        let own = &loaded.chunks[chunk];
        let [first_vertex, first_triangle] = state.total.map(|n| n & u64::from(u32::MAX));
        let params = Params {
            first_vertex: narrow(first_vertex)?,
            first_triangle: narrow(first_triangle)?,
            ..own.params(&loaded.params)
        };
        self.write_params(&loaded.workspace, 0, &params);
        self.write_halo(&loaded.workspace, own);
        let mut recording = self.recording();
        recording.count_stages(&[(loaded.dispatch(0, 0), params)]);
        let group_bytes = 16 * own.n_groups();
        let bytes = BODY_OFFSET + group_bytes;
        let readback = self.readback.acquire(&self.device, bytes);
        let target = &readback.buffer;
        recording.copy_timestamps(target);
        recording.copy_counters(&loaded.workspace, target);
        recording.copy_start(loaded.workspace.buffer(BufferId::Groups), target, BODY_OFFSET, group_bytes);
        Ok(self.submit(recording, vec![(readback, bytes)]))
    }

    /// Waits for the counts of a chunk.
    pub(super) fn wait_for_counts(
        &self,
        state: &mut JobState,
        chunk: usize,
        submission: PendingSubmission,
    ) -> Result<ChunkCounts, GpuError> {
        let readback = self.wait_one(submission)?;
        self.add_times(&mut state.times, &readback, 0..N_COUNT_STAGES)?;
        state.add_counts(&readback, chunk, BODY_OFFSET)
    }
}
