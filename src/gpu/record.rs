//! Recording: the dispatches and copies of a submission, in order.

use wgpu::{Buffer, CommandEncoder, Device, QuerySet, Queue};

use super::pipelines::{N_STAGES, Pipelines, Variant, number};
use super::workspace::{ROW, Workspace};
use crate::surface::Stage;
use crate::surface::layout::{GROUP, Params};

/// Workgroups along a dispatch's first dimension: the most that every device takes.
const MOST_WORKGROUPS: u32 = 65_535;
/// Bytes of the timestamps: begin and end of every stage.
pub(super) const CLOCK_BYTES: u64 = 16 * N_STAGES as u64;

/// A dispatch: whose buffers, which row of parameters, how many workgroups.
#[derive(Clone, Copy)]
pub(super) struct Dispatch<'a> {
    pub(super) workspace: &'a Workspace,
    pub(super) row: u64,
    pub(super) workgroups: u32,
    pub(super) variant: Variant,
}

/// Timestamps around stages, where the device has them.
#[derive(Debug)]
pub(super) struct Clock {
    queries: QuerySet,
    resolved: Buffer,
    /// Nanoseconds a tick.
    pub(super) period: f32,
}

impl Clock {
    /// A clock on `device`, if it has timestamps.
    pub(super) fn new(device: &Device, queue: &Queue) -> Option<Self> {
        device.features().contains(wgpu::Features::TIMESTAMP_QUERY).then(|| Self {
            queries: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("molmesh.clock"),
                ty: wgpu::QueryType::Timestamp,
                count: 2 * u32::try_from(N_STAGES).unwrap_or_default(),
            }),
            resolved: device.create_buffer(&wgpu::BufferDescriptor {
                label: Some("molmesh.clock"),
                size: CLOCK_BYTES,
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
            period: queue.get_timestamp_period(),
        })
    }
}

/// A submission in the making.
pub(super) struct Recording<'a> {
    pub(super) encoder: CommandEncoder,
    pipelines: &'a Pipelines,
    clock: Option<&'a Clock>,
    timed: Vec<Stage>,
}

impl<'a> Recording<'a> {
    pub(super) fn new(device: &Device, pipelines: &'a Pipelines, clock: Option<&'a Clock>) -> Self {
        let encoder = device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("molmesh") });
        Self { encoder, pipelines, clock, timed: Vec::new() }
    }

    /// Has the times of `stages` read here that ran in the submission before.
    pub(super) fn timed_before(&mut self, stages: &[Stage]) {
        self.timed.extend(stages);
    }

    /// One stage, for one job or for several: dispatches without anything between them overlap on the device as far as
    /// their buffers allow. It has one time in a submission.
    pub(super) fn stage(&mut self, stage: Stage, dispatches: &[Dispatch<'_>]) {
        let at = 2 * u32::try_from(number(stage)).unwrap_or_default();
        let timestamp_writes = self.clock.map(|clock| wgpu::ComputePassTimestampWrites {
            query_set: &clock.queries,
            beginning_of_pass_write_index: Some(at),
            end_of_pass_write_index: Some(at + 1),
        });
        self.timed.push(stage);
        let mut pass = self
            .encoder
            .begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(stage.name()), timestamp_writes });
        let mut current = None;
        for dispatch in dispatches {
            if current != Some(dispatch.variant) {
                pass.set_pipeline(self.pipelines.pipeline(stage, dispatch.variant));
                current = Some(dispatch.variant);
            }
            let row = u32::try_from(dispatch.row * ROW).unwrap_or_default();
            pass.set_bind_group(0, dispatch.workspace.group(stage), &[row]);
            let n = dispatch.workgroups;
            pass.dispatch_workgroups(n.min(MOST_WORKGROUPS), n.div_ceil(MOST_WORKGROUPS), 1);
        }
    }

    /// `bin` to `scan` of a chunk per job; `params` are the chunks'.
    pub(super) fn front(&mut self, jobs: &[(Dispatch<'_>, Params)]) {
        for (job, _) in jobs {
            self.encoder.clear_buffer(job.workspace.buffer("tally"), 0, None);
            self.encoder.clear_buffer(job.workspace.buffer("groups"), 0, None);
        }
        let sized = |workgroups: &dyn Fn(&Params) -> u32| -> Vec<Dispatch<'_>> {
            jobs.iter().map(|(job, params)| Dispatch { workgroups: workgroups(params), ..*job }).collect()
        };
        self.stage(Stage::Bin, &sized(&|p| p.n_own + p.n_halo));
        self.stage(Stage::Field, &sized(&|p| p.n_own + p.n_halo));
        self.stage(Stage::Classify, &sized(&|p| p.n_own.div_ceil(4)));
        self.stage(Stage::Scan, &sized(&|p| p.n_own.div_ceil(GROUP)));
    }

    /// Copies the stages' times to the start of `target`. The unwritten ones of the clock are left out.
    pub(super) fn read_clock(&mut self, target: &Buffer) {
        let Some(clock) = self.clock else { return };
        let at = |stage: &Stage| u32::try_from(number(*stage)).unwrap_or_default();
        let (Some(first), Some(last)) = (self.timed.iter().map(at).min(), self.timed.iter().map(at).max()) else {
            return;
        };
        let bytes = 16 * u64::from(last - first + 1);
        self.encoder.resolve_query_set(&clock.queries, 2 * first..2 * last + 2, &clock.resolved, 0);
        self.encoder.copy_buffer_to_buffer(&clock.resolved, 0, target, 16 * u64::from(first), bytes);
    }
}
