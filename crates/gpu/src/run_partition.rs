//! Run of one partition of a multi-device job. The counts of its bricks and its vertices do not depend on the other
//! partitions; its triangles need the vertex numbers of later partitions.

use std::ops::Range;

use super::buffers::BufferId;
use super::engine::{Engine, LoadedJob};
use super::error::GpuError;
use super::job::{GpuJob, JobResult};
use super::job_state::JobState;
use super::output_layout::{OutputRows, narrow, values};
use super::partition_handle::{Import, PartitionCounts, PartitionHandle};
use super::plan::layout::BrickRecord;
use super::plan::partition::total_len;
use super::recording::PendingSubmission;

/// Bytes that are exported per brick: its record, and its first vertex and triangle.
const RECORD: u64 = size_of::<BrickRecord>() as u64;
const OFFSET: u64 = 8;

/// Size of the exported `runs`, rounded up for mapping: a mapped range is a multiple of 8 bytes and not empty.
fn export_bytes(runs: &[Range<u32>]) -> u64 {
    (total_len(runs) * (RECORD + OFFSET)).next_multiple_of(8).max(8)
}

impl Engine {
    /// Runs the partition of `handle`.
    pub(super) fn run_partition_of(&mut self, job: &GpuJob, handle: &PartitionHandle) -> JobResult {
        job.check()?;
        self.discard_begun();
        let chunks = self.chunks(job, Some(handle.partition()))?;
        let loaded = self.load(job, Some(handle.partition()), chunks, OutputRows::default())?;
        let mut state = JobState::new(loaded);
        let result = self.run_loaded_partition(&mut state, handle);
        self.workspaces.push(state.loaded.workspace);
        result
    }

    fn run_loaded_partition(&mut self, state: &mut JobState, handle: &PartitionHandle) -> JobResult {
        let job = state.loaded.job.clone();
        let last = state.loaded.chunks.len().saturating_sub(1);
        let mut export = None;
        let counts = self.count_chunks(state, |engine, state, chunk| {
            handle.check()?;
            if chunk == last {
                export = Some(engine.submit_export(&state.loaded, handle));
            }
            // A partition beyond the limits is rejected below with the counts of the whole mesh.
            Ok(state.check_limits().is_ok())
        })?;
        let export = export.ok_or_else(|| GpuError::Failed("a partition without bricks".to_owned()))?;
        let exported = self.wait_one(export)?;
        let [vertices, triangles] = state.total;
        handle.publish(PartitionCounts { vertices, triangles, exported });
        // The device transfers the vertices while this partition waits for the counts of the others.
        let numbering = handle.await_counts(&job)?;
        job.prepared.check_mesh(numbering.total)?;
        let base = narrow(numbering.first[0])?;
        for import in &numbering.imports {
            self.write_import(&state.loaded, import, base)?;
        }
        state.loaded.params.base_vertex = base;
        self.make_triangles(state, &counts)?;
        self.collect_output(state)?;
        if state.has_flat_vertices {
            handle.set_flat_vertices();
        }
        state.assemble()
    }

    /// Submits the copies of the records and offsets that earlier partitions import.
    fn submit_export(&self, loaded: &LoadedJob, handle: &PartitionHandle) -> PendingSubmission {
        let runs = handle.exports();
        let bytes = export_bytes(&runs);
        let readback = self.readback.acquire(&self.device, bytes);
        let target = &readback.buffer;
        let mut recording = self.recording();
        let columns = [(BufferId::Records, RECORD, 0), (BufferId::Offsets, OFFSET, RECORD * total_len(&runs))];
        for (id, each, mut at) in columns {
            for run in &runs {
                let (from, n) = (each * u64::from(run.start), each * u64::from(run.end - run.start));
                recording.encoder.copy_buffer_to_buffer(loaded.workspace.buffer(id), from, target, at, n);
                at += n;
            }
        }
        self.submit(recording, vec![(readback, bytes)])
    }

    /// Writes the imported records and offsets. `base` is the number of vertices before this partition.
    fn write_import(&self, loaded: &LoadedJob, import: &Import, base: u32) -> Result<(), GpuError> {
        let Import { bricks, position, n_exported, exported, first_vertex } = import;
        let (n, first) = (u64::from(bricks.end - bricks.start), u64::from(bricks.start));
        let exported: &[u8] = (**exported).as_ref();
        let records: &[u8] = values(exported, RECORD * position, RECORD * n)?;
        let offsets: &[[u32; 2]] = values(exported, RECORD * n_exported + OFFSET * position, n)?;
        // The shader adds the base, which undoes the wrapping subtraction.
        let shift = narrow(*first_vertex)?.wrapping_sub(base);
        let offsets: Vec<[u32; 2]> = offsets.iter().map(|[v, t]| [v.wrapping_add(shift), *t]).collect();
        for (id, at, bytes) in [
            (BufferId::Records, RECORD * first, records),
            (BufferId::Offsets, OFFSET * first, bytemuck::cast_slice(&offsets)),
        ] {
            self.queue.write_buffer(loaded.workspace.buffer(id), at, bytes);
        }
        Ok(())
    }
}
