//! Recording of a submission: dispatches, copies and timestamps, in order.

use std::ops::Range;

use molmesh_surface::Stage;
use wgpu::{Buffer, BufferUsages, CommandEncoder, Device, QuerySet, Queue};

use super::buffers::{BufferId, buffer};
use super::output_layout::{COUNTERS_OFFSET, OutputRows, ReadbackLayout, TRIANGLE_BYTES, VertexBytes};
use super::pipelines::{N_STAGES, Pipelines, TIMESTAMP_BYTES, Variant, stage_index};
use super::plan::layout::{Counters, GROUP, Params};
use super::readback::ReadbackBuffer;
use super::workspace::{ROW, Workspace};

/// Maximum number of workgroups along one dimension of a dispatch that every device supports.
const MAX_WORKGROUPS: u32 = 65_535;

/// Dispatch of a stage.
#[derive(Clone, Copy)]
pub(super) struct Dispatch<'a> {
    pub(super) workspace: &'a Workspace,
    /// Row of parameters.
    pub(super) row: u64,
    /// Number of workgroups.
    pub(super) workgroups: u32,
    pub(super) variant: Variant,
}

/// Timestamp queries around the stages.
#[derive(Debug)]
pub(super) struct StageTimer {
    queries: QuerySet,
    resolved: Buffer,
    /// Nanoseconds per tick.
    pub(super) period: f64,
}

impl StageTimer {
    /// Creates the queries. `None` if the device has no timestamps.
    pub(super) fn new(device: &Device, queue: &Queue) -> Option<Self> {
        let usage = BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC;
        device.features().contains(wgpu::Features::TIMESTAMP_QUERY).then(|| Self {
            queries: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("molmesh.timestamps"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * query_number(N_STAGES),
            }),
            resolved: buffer(device, "molmesh.timestamps", TIMESTAMP_BYTES, usage),
            period: f64::from(queue.get_timestamp_period()),
        })
    }
}

/// Converts timestamp ticks of `period` ns to ns.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "float-to-int casts saturate, as intended")]
pub(super) fn ticks_to_ns(ticks: u64, period: f64) -> u64 {
    (ticks as f64 * period) as u64
}

fn query_number(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// Submission that was sent to the device and has not been waited for.
pub(super) struct PendingSubmission {
    pub(super) index: wgpu::SubmissionIndex,
    /// Readback buffers, each with the number of bytes to map.
    pub(super) readbacks: Vec<(ReadbackBuffer, u64)>,
}

/// Submission that is being recorded.
pub(super) struct Recording<'a> {
    pub(super) encoder: CommandEncoder,
    pipelines: &'a Pipelines,
    timer: Option<&'a StageTimer>,
    /// Range of the recorded stages.
    timed: Option<Range<usize>>,
}

impl<'a> Recording<'a> {
    pub(super) fn new(device: &Device, pipelines: &'a Pipelines, timer: Option<&'a StageTimer>) -> Self {
        let encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("molmesh") });
        Self { encoder, pipelines, timer, timed: None }
    }

    /// Records a stage of one or several jobs. Dispatches without dependencies may overlap on the device; together they
    /// have one time in the submission.
    pub(super) fn stage(&mut self, stage: Stage, dispatches: &[Dispatch<'_>]) {
        let index = stage_index(stage);
        let query = 2 * query_number(index);
        let timestamp_writes = self.timer.map(|timer| wgpu::ComputePassTimestampWrites {
            query_set: &timer.queries,
            beginning_of_pass_write_index: Some(query),
            end_of_pass_write_index: Some(query + 1),
        });
        let timed = self.timed.get_or_insert(index..index + 1);
        *timed = timed.start.min(index)..timed.end.max(index + 1);
        let mut pass = self
            .encoder
            .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(stage.name()), timestamp_writes });
        let mut current = None;
        for dispatch in dispatches {
            if current != Some(dispatch.variant) {
                pass.set_pipeline(self.pipelines.pipeline(stage, dispatch.variant));
                current = Some(dispatch.variant);
            }
            let offset = u32::try_from(dispatch.row * ROW).unwrap_or_default();
            pass.set_bind_group(0, dispatch.workspace.bind_group(stage, dispatch.variant), &[offset]);
            let n = dispatch.workgroups;
            pass.dispatch_workgroups(n.min(MAX_WORKGROUPS), n.div_ceil(MAX_WORKGROUPS), 1);
        }
    }

    /// Records the stages `bin` to `refine` of one chunk per job; the parameters are those of the chunks.
    pub(super) fn count_stages(&mut self, jobs: &[(Dispatch<'_>, Params)]) {
        for (job, _) in jobs {
            self.encoder.clear_buffer(job.workspace.buffer(BufferId::Counters), 0, None);
            self.encoder.clear_buffer(job.workspace.buffer(BufferId::Groups), 0, None);
        }
        for stage in [Stage::Bin, Stage::Field, Stage::Classify, Stage::Scan, Stage::Refine] {
            let dispatches: Vec<_> =
                jobs.iter().map(|(job, params)| Dispatch { workgroups: workgroups(stage, params), ..*job }).collect();
            self.stage(stage, &dispatches);
        }
    }

    /// Copies the timestamps of the recorded stages to the start of `target`.
    pub(super) fn copy_timestamps(&mut self, target: &Buffer) {
        let (Some(timer), Some(timed)) = (self.timer, self.timed.clone()) else { return };
        let bytes = |stages: usize| 16 * stages as u64;
        let [first, end] = [timed.start, timed.end].map(|stage| 2 * query_number(stage));
        self.encoder.resolve_query_set(&timer.queries, first..end, &timer.resolved, 0);
        self.encoder.copy_buffer_to_buffer(&timer.resolved, 0, target, bytes(timed.start), bytes(timed.len()));
    }

    /// Copies the counters.
    pub(super) fn copy_counters(&mut self, workspace: &Workspace, target: &Buffer) {
        let from = workspace.buffer(BufferId::Counters);
        self.copy_start(from, target, COUNTERS_OFFSET, size_of::<Counters>() as u64);
    }

    /// Copies the first rows of the output buffers to their columns.
    pub(super) fn copy_output(
        &mut self,
        workspace: &Workspace,
        vertex: VertexBytes,
        rows: OutputRows,
        target: &Buffer,
        layout: &ReadbackLayout,
    ) {
        for (id, offset, bytes) in [
            (BufferId::Positions, layout.positions, vertex.positions * rows.vertices),
            (BufferId::Normals, layout.normals, vertex.normals * rows.vertices),
            (BufferId::Sources, layout.sources, vertex.sources * rows.vertices),
            (BufferId::Triangles, layout.triangles, TRIANGLE_BYTES * rows.triangles),
            (BufferId::Sheets, layout.sheets, 4 * rows.sheet_words),
        ] {
            self.copy_start(workspace.buffer(id), target, offset, bytes);
        }
    }

    /// Copies the first `bytes` bytes of a buffer.
    pub(super) fn copy_start(&mut self, from: &Buffer, target: &Buffer, offset: u64, bytes: u64) {
        if bytes > 0 {
            self.encoder.copy_buffer_to_buffer(from, 0, target, offset, bytes);
        }
    }
}

/// Number of workgroups of `stage`.
pub(super) fn workgroups(stage: Stage, params: &Params) -> u32 {
    match stage {
        Stage::Bin => params.n_kinds * (params.n_own + params.n_halo),
        Stage::Field | Stage::Refine => params.n_own + params.n_halo,
        Stage::Classify => params.n_own.div_ceil(4),
        Stage::Scan => params.n_own.div_ceil(GROUP),
        _ => params.piece_bricks,
    }
}
