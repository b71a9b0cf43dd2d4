//! How jobs go through the engine: small ones together in one submission, large ones alone.

use std::sync::Arc;

use super::engine::{Engine, Loaded, check, scaled};
use super::error::GpuError;
use super::executor::{Finished, GpuJob};
use super::flight::{Arrived, BODY_AT, Places, TRIANGLE_BYTES, VertexBytes};
use super::landing::Landing;
use super::output::{PARAM_ROWS, copy_counts, copy_rows, copy_vertices, failed, narrow};
use super::pipelines::N_STAGES;
use super::progress::{Counted, Progress};
use super::submit::Flight;
use super::workspace::OutputRows;
use crate::surface::Stage;
use crate::surface::chunks::Chunk;
use crate::surface::layout::{GROUP, Params};

/// Stages before the output is sized.
pub(super) const FRONT: usize = 4;

/// Bytes of a chunk's groups.
fn group_bytes(chunk: &Chunk) -> u64 {
    16 * u64::from(chunk.n_own.div_ceil(GROUP))
}

impl Engine {
    /// The rows that a small job's buffers should hold, if it is one.
    pub(super) fn small_rows(&self, job: &GpuJob, chunks: &[Chunk]) -> Option<OutputRows> {
        // Small lattices cross a brick more often than large ones.
        let n = job.prepared.plan.bricks.len() as u64 + 8;
        let [vertices, triangles] = self.budget.rows_per_brick.map(|each| each * n);
        let vertex = VertexBytes::of(&job.prepared.params);
        let bytes = Places::new(vertices, triangles, vertex).end;
        let largest = (vertex.positions * vertices).max(TRIANGLE_BYTES * triangles);
        let fits = largest <= self.budget.piece_bytes && bytes <= self.budget.landing_bytes;
        let small = chunks.len() == 1 && bytes <= self.budget.small_bytes && fits;
        small.then_some(OutputRows { vertices, triangles, params: PARAM_ROWS })
    }

    /// The rows that a job's buffers hold before its output is counted.
    pub(super) fn no_rows() -> OutputRows {
        OutputRows { vertices: 0, triangles: 0, params: PARAM_ROWS }
    }

    /// Runs small jobs in one submission. Answers each with its number.
    pub(super) fn together(
        &mut self,
        jobs: Vec<(usize, Loaded<'_>, OutputRows)>,
    ) -> Vec<(usize, Result<Finished, GpuError>)> {
        if jobs.is_empty() {
            return Vec::new();
        }
        let all = jobs.iter().map(|(_, loaded, _)| f64::from(loaded.params.n_bricks)).sum::<f64>();
        let landings = match self.submit_together(&jobs) {
            Ok(landings) => landings.into_iter().map(Ok).collect(),
            Err(e) => vec![Err(e); jobs.len()],
        };
        let mut results = Vec::with_capacity(jobs.len());
        for ((i, loaded, rows), landing) in jobs.into_iter().zip(landings) {
            // The submission's time is shared out by bricks.
            let share = f64::from(loaded.params.n_bricks) / all;
            let mut progress = Progress::new(loaded);
            let result = landing.and_then(|landing| self.finish_small(&mut progress, rows, &landing, share));
            self.workspaces.push(progress.loaded.workspace);
            results.push((i, result));
        }
        results
    }

    /// All stages of all jobs, and the copies of what they are estimated to make.
    fn submit_together(&self, jobs: &[(usize, Loaded<'_>, OutputRows)]) -> Result<Vec<Arc<Landing>>, GpuError> {
        let mut recording = self.recording();
        let mut fronts = Vec::with_capacity(jobs.len());
        for (_, loaded, rows) in jobs {
            let params = Params {
                piece_bricks: loaded.params.n_bricks,
                vertex_capacity: narrow(rows.vertices)?,
                triangle_capacity: narrow(rows.triangles)?,
                ..loaded.chunks[0].params(&loaded.params)
            };
            self.write_params(&loaded.workspace, 0, &params);
            fronts.push((loaded.dispatch(0, params.n_bricks), params));
        }
        recording.front(&fronts);
        let tails: Vec<_> = fronts.iter().map(|(job, _)| *job).collect();
        recording.stage(Stage::Interpolate, &tails);
        recording.stage(Stage::Emit, &tails);
        let mut landings = Vec::with_capacity(jobs.len());
        for (_, loaded, rows) in jobs {
            let places = Places::new(rows.vertices, rows.triangles, loaded.vertex);
            let groups = group_bytes(&loaded.chunks[0]);
            let landing = self.landings.get(&self.device, places.end + groups);
            let target = landing.buffer().map_err(failed)?;
            recording.read_clock(target);
            copy_counts(&mut recording, &loaded.workspace, target, Some((places.end, groups)));
            copy_vertices(&mut recording, loaded, target, &places, rows.vertices);
            let triangles = loaded.workspace.buffer("triangles");
            copy_rows(&mut recording, triangles, target, places.triangles, TRIANGLE_BYTES * rows.triangles);
            landings.push((landing, places.end + groups));
        }
        self.fly(recording, landings)
    }

    /// A small job's mesh; its tail runs once more where the estimate was too low.
    fn finish_small(
        &mut self,
        progress: &mut Progress<'_>,
        rows: OutputRows,
        landing: &Arc<Landing>,
        share: f64,
    ) -> Result<Finished, GpuError> {
        let places = Places::new(rows.vertices, rows.triangles, progress.loaded.vertex);
        let counted = progress.count(landing, 0, places.end)?;
        progress.within_limits(1)?;
        progress.complete()?;
        progress.times = self.times(landing, 0..N_STAGES)?.map(|ns| scaled(ns, share));
        let (n_vertices, n_triangles) = (counted.n_vertices, counted.n_triangles);
        if n_vertices > rows.vertices || n_triangles > rows.triangles {
            self.output(progress, &[counted], [true, true])?;
        } else {
            progress.note_flat(landing)?;
            let arrived = Arrived { landing: landing.clone(), places, n_vertices, n_triangles };
            progress.vertices.push(arrived.clone());
            progress.triangles.push(arrived);
        }
        progress.finish()
    }

    /// Runs one job, of any size.
    pub(super) fn alone(&mut self, loaded: Loaded<'_>) -> Result<Finished, GpuError> {
        let mut progress = Progress::new(loaded);
        let result = self.run_alone(&mut progress);
        self.workspaces.push(progress.loaded.workspace);
        result
    }

    fn run_alone(&mut self, progress: &mut Progress<'_>) -> Result<Finished, GpuError> {
        let n_chunks = progress.loaded.chunks.len();
        if n_chunks == 1 {
            self.only_chunk(progress)?;
            return progress.finish();
        }
        let mut counted = Vec::with_capacity(n_chunks);
        for chunk in 0..n_chunks {
            check(progress.loaded.job)?;
            // Behind the vertices of the chunk before, which are on their way to the host meanwhile.
            let sent = self.send_count(progress, chunk)?;
            self.settle(progress)?;
            let count = self.take_count(progress, chunk, sent)?;
            progress.within_limits(1)?;
            // The chunk's samples are there now and not later; its triangles need its neighbours' vertices.
            let pieces = self.pieces(progress, &[(chunk, &count)]);
            self.make_room(progress, &pieces)?;
            self.send_pieces(progress, chunk, &pieces, [true, false])?;
            counted.push(count);
        }
        progress.complete()?;
        self.output(progress, &counted, [false, true])?;
        progress.finish()
    }

    /// A job of one chunk. While the host reads what was counted, the device makes the output, where there may be room
    /// for it from an earlier job; what fits is only copied then.
    fn only_chunk(&mut self, progress: &mut Progress<'_>) -> Result<(), GpuError> {
        check(progress.loaded.job)?;
        let sent = self.send_count(progress, 0)?;
        let room = self.tail_ahead(progress)?;
        let count = self.take_count(progress, 0, sent)?;
        progress.within_limits(1)?;
        progress.complete()?;
        check(progress.loaded.job)?;
        if !self.copy_tail(progress, &count, room)? {
            self.output(progress, &[count], [true, true])?;
        }
        Ok(())
    }

    /// Submits a chunk's stages up to `scan`.
    pub(super) fn send_count(&self, progress: &Progress<'_>, chunk: usize) -> Result<Flight, GpuError> {
        let loaded = &progress.loaded;
        let own = &loaded.chunks[chunk];
        let [first_vertex, first_triangle] = progress.total.map(|n| n & u64::from(u32::MAX));
        let params = Params {
            first_vertex: narrow(first_vertex)?,
            first_triangle: narrow(first_triangle)?,
            ..own.params(&loaded.params)
        };
        self.write_params(&loaded.workspace, 0, &params);
        self.write_halo(&loaded.workspace, own);
        let mut recording = self.recording();
        recording.front(&[(loaded.dispatch(0, 0), params)]);
        let bytes = BODY_AT + group_bytes(own);
        let landing = self.landings.get(&self.device, bytes);
        let target = landing.buffer().map_err(failed)?;
        recording.read_clock(target);
        copy_counts(&mut recording, &loaded.workspace, target, Some((BODY_AT, group_bytes(own))));
        self.launch(recording, vec![(landing, bytes)])
    }

    /// What they counted.
    pub(super) fn take_count(
        &self,
        progress: &mut Progress<'_>,
        chunk: usize,
        sent: Flight,
    ) -> Result<Counted, GpuError> {
        let landings = self.land(sent)?;
        let [landing] = &landings[..] else { return Err(failed("a submission without its landing".to_owned())) };
        self.add_times(progress, landing, 0..FRONT)?;
        progress.count(landing, chunk, BODY_AT)
    }

    pub(super) fn add_times(
        &self,
        progress: &mut Progress<'_>,
        landing: &Landing,
        stages: std::ops::Range<usize>,
    ) -> Result<(), GpuError> {
        let times = self.times(landing, stages)?;
        progress.times.iter_mut().zip(times).for_each(|(sum, ns)| *sum += ns);
        Ok(())
    }
}
