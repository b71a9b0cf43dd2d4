//! Second half of a job: its output, in pieces that fit a binding, each in a readback buffer. A piece is submitted
//! before the previous one is collected.

use super::buffers::BufferId;
use super::count::{N_COUNT_STAGES, narrow};
use super::engine::Engine;
use super::error::GpuError;
use super::job_state::{ChunkCounts, JobState, PendingOutput};
use super::output_layout::{OutputPiece, ReadbackLayout, ReadbackRows, TRIANGLE_BYTES, VertexBytes, pieces};
use super::plan::layout::Params;
use super::workspace::{BufferSizes, OutputCapacity};
use crate::surface::Stage;

/// Rows of parameters: one for the chunk and one for the output piece.
pub(super) const PARAM_ROWS: u64 = 2;
/// Output is submitted before the counts are known if the buffers hold at least 1/8 of the small-job estimate. A ball
/// of 60,000 atoms at 0.5 Å needs 1/6, and less compact structures need more. This hides one round trip to the host,
/// 0.14 ms on an H200.
const SPECULATION_DIVISOR: u64 = 8;
/// Capacity of the buffers before the output is counted.
pub(super) const NO_OUTPUT: OutputCapacity = OutputCapacity { vertices: 0, triangles: 0, params: PARAM_ROWS };

impl Engine {
    /// Counts every chunk and submits its vertices, because its samples are overwritten by the next chunk; triangles
    /// need the vertex numbers of all chunks. `accept` is called with the index of each counted chunk and returns
    /// whether to make its vertices.
    pub(super) fn count_chunks(
        &mut self,
        state: &mut JobState<'_>,
        mut accept: impl FnMut(&Self, &JobState<'_>, usize) -> Result<bool, GpuError>,
    ) -> Result<Vec<ChunkCounts>, GpuError> {
        let n_chunks = state.loaded.chunks.len();
        let mut all = Vec::with_capacity(n_chunks);
        for chunk in 0..n_chunks {
            state.loaded.job.check()?;
            // The vertices of the previous chunk are read back meanwhile.
            let submission = self.submit_count(state, chunk)?;
            self.collect_output(state)?;
            let counts = self.wait_for_counts(state, chunk, submission)?;
            if accept(self, state, chunk)? {
                let pieces = self.pieces(state, &[(chunk, &counts)]);
                self.ensure_capacity(state, &pieces)?;
                self.submit_pieces(state, chunk, &pieces, [true, false])?;
            }
            all.push(counts);
        }
        Ok(all)
    }

    /// Makes the vertices, the triangles or both of all chunks; vertices only if there is a single chunk.
    pub(super) fn output(
        &mut self,
        state: &mut JobState<'_>,
        counts: &[ChunkCounts],
        columns: [bool; 2],
    ) -> Result<(), GpuError> {
        let all: Vec<_> = counts.iter().enumerate().collect();
        let pieces = self.pieces(state, &all);
        self.ensure_capacity(state, &pieces)?;
        self.submit_pieces(state, 0, &pieces, columns)?;
        self.collect_output(state)
    }

    /// Cuts the output of chunks into pieces that fit a binding.
    fn pieces(&self, state: &JobState<'_>, counts: &[(usize, &ChunkCounts)]) -> Vec<OutputPiece> {
        let max = self.max_rows(state.loaded.vertex);
        let cut = |&(chunk, counts): &(usize, &ChunkCounts)| {
            let own = &state.loaded.chunks[chunk];
            pieces([own.first_brick, own.n_own], &counts.groups, counts.first, max)
        };
        counts.iter().flat_map(cut).collect()
    }

    /// Maximum number of vertices and triangles of a piece.
    fn max_rows(&self, vertex: VertexBytes) -> [u64; 2] {
        let bytes = self.budget.piece_bytes.min(self.budget.readback_bytes / 4);
        [bytes / vertex.positions, bytes / TRIANGLE_BYTES]
    }

    /// Grows the output buffers to the largest of `pieces`.
    fn ensure_capacity(&mut self, state: &mut JobState<'_>, pieces: &[OutputPiece]) -> Result<(), GpuError> {
        let capacity = OutputCapacity {
            vertices: pieces.iter().map(|p| p.n_vertices).max().unwrap_or_default(),
            triangles: pieces.iter().map(|p| p.n_triangles).max().unwrap_or_default(),
            ..NO_OUTPUT
        };
        let loaded = &mut state.loaded;
        let sizes = BufferSizes::new(&loaded.job.prepared.plan, &loaded.chunks, loaded.vertex, capacity);
        self.grow(loaded, &sizes)
    }

    /// Submits the vertices, the triangles or both of `pieces`, and collects all but the last.
    fn submit_pieces(
        &self,
        state: &mut JobState<'_>,
        chunk: usize,
        pieces: &[OutputPiece],
        columns: [bool; 2],
    ) -> Result<(), GpuError> {
        for piece in pieces {
            state.loaded.job.check()?;
            let params = Params {
                piece_brick: piece.brick,
                piece_bricks: piece.n_bricks,
                piece_vertex: narrow(piece.vertex)?,
                piece_triangle: narrow(piece.triangle & u64::from(u32::MAX))?,
                vertex_capacity: narrow(piece.n_vertices)?,
                triangle_capacity: narrow(piece.n_triangles)?,
                ..state.loaded.chunks[chunk].params(&state.loaded.params)
            };
            let rows = [piece.n_vertices * u64::from(columns[0]), piece.n_triangles * u64::from(columns[1])];
            let pending = self.submit_output(state, Some(&params), rows, columns)?;
            self.collect_output(state)?;
            state.pending = Some(pending);
        }
        Ok(())
    }

    /// Submits the stages of an output piece with `params`, or none if they ran before, and the copies of its `rows`.
    /// Each piece is a submission of its own, because a stage has one time per submission.
    fn submit_output(
        &self,
        state: &JobState<'_>,
        params: Option<&Params>,
        rows: [u64; 2],
        columns: [bool; 2],
    ) -> Result<PendingOutput, GpuError> {
        let loaded = &state.loaded;
        let layout = ReadbackLayout::new(rows, loaded.vertex);
        let readback = self.readback.acquire(&self.device, layout.end);
        let target = readback.buffer().map_err(GpuError::Failed)?;
        let mut recording = self.recording();
        if let Some(params) = params {
            self.write_params(&loaded.workspace, 1, params);
        }
        for (stage, _) in [Stage::Interpolate, Stage::Emit].into_iter().zip(columns).filter(|(_, wanted)| *wanted) {
            match params {
                Some(params) => recording.stage(stage, &[loaded.dispatch(1, params.piece_bricks)]),
                None => recording.include_time(stage),
            }
        }
        recording.copy_output(&loaded.workspace, loaded.vertex, rows, target, &layout);
        recording.copy_timestamps(target);
        recording.copy_counters(&loaded.workspace, target);
        let submission = self.submit(recording, vec![(readback, layout.end)])?;
        Ok(PendingOutput { submission, layout, rows, columns })
    }

    /// Waits for the pending output, if any, and adds it to the job.
    pub(super) fn collect_output(&self, state: &mut JobState<'_>) -> Result<(), GpuError> {
        let Some(PendingOutput { submission, layout, rows, columns: [vertices, triangles] }) = state.pending.take()
        else {
            return Ok(());
        };
        let readback = self.wait_one(submission)?;
        state.note_flat_vertices(&readback)?;
        let first = if vertices { N_COUNT_STAGES } else { N_COUNT_STAGES + 1 };
        let end = N_COUNT_STAGES + 1 + usize::from(triangles);
        self.add_times(&mut state.times, &readback, first..end)?;
        let rows = ReadbackRows { readback, layout, n_vertices: rows[0], n_triangles: rows[1] };
        state.vertices.extend(vertices.then(|| rows.clone()));
        state.triangles.extend(triangles.then_some(rows));
        Ok(())
    }

    /// Submits the output of a job's only chunk into the buffers as they are, before it is counted. Returns the number
    /// of vertices and triangles that the buffers hold (the stages write no more), or `None` without a submission if
    /// the buffers are probably too small; see [`SPECULATION_DIVISOR`].
    pub(super) fn submit_speculative_output(&self, state: &JobState<'_>) -> Result<Option<[u64; 2]>, GpuError> {
        let loaded = &state.loaded;
        let [max_vertices, max_triangles] = self.max_rows(loaded.vertex);
        let rows = |id: BufferId, each: u64| loaded.workspace.buffer(id).size().checked_div(each).unwrap_or(u64::MAX);
        let VertexBytes { positions, normals, sources } = loaded.vertex;
        let columns = [(BufferId::Positions, positions), (BufferId::Normals, normals), (BufferId::Sources, sources)];
        let vertices = columns.into_iter().map(|(id, each)| rows(id, each)).fold(max_vertices, u64::min);
        let triangles = rows(BufferId::Triangles, TRIANGLE_BYTES).min(max_triangles);
        let n_bricks = u64::from(loaded.params.n_bricks);
        let likely = self.budget.rows_per_brick.map(|each| each * n_bricks / SPECULATION_DIVISOR);
        if vertices < likely[0] || triangles < likely[1] {
            return Ok(None);
        }
        let params = Params {
            piece_bricks: loaded.params.n_bricks,
            vertex_capacity: narrow(vertices)?,
            triangle_capacity: narrow(triangles)?,
            ..loaded.chunks[0].params(&loaded.params)
        };
        self.write_params(&loaded.workspace, 1, &params);
        let mut recording = self.recording();
        for stage in [Stage::Interpolate, Stage::Emit] {
            recording.stage(stage, &[loaded.dispatch(1, params.piece_bricks)]);
        }
        self.submit(recording, Vec::new())?;
        Ok(Some([vertices, triangles]))
    }

    /// Reads back the speculative output if it fits `capacity` and a readback buffer. Returns whether it did.
    pub(super) fn collect_speculative_output(
        &self,
        state: &mut JobState<'_>,
        counts: &ChunkCounts,
        capacity: Option<[u64; 2]>,
    ) -> Result<bool, GpuError> {
        let rows = [counts.n_vertices, counts.n_triangles];
        let fits = capacity.is_some_and(|capacity| rows[0] <= capacity[0] && rows[1] <= capacity[1]);
        if !fits || ReadbackLayout::new(rows, state.loaded.vertex).end > self.budget.readback_bytes {
            return Ok(false);
        }
        state.pending = Some(self.submit_output(state, None, rows, [true, true])?);
        self.collect_output(state)?;
        Ok(true)
    }
}
