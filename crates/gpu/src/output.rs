//! Second half of a job: its output, in pieces that fit a binding, each in a readback buffer. A piece is submitted
//! before the previous one is collected.

use molmesh_surface::Stage;

use super::buffers::BufferId;
use super::engine::Engine;
use super::error::GpuError;
use super::job_state::{ChunkCounts, JobState, PendingOutput, counters};
use super::output_layout::{
    OutputPiece, OutputRows, ReadbackLayout, ReadbackRows, TRIANGLE_BYTES, VertexBytes, narrow, pieces,
};
use super::pipelines::stage_index;
use super::plan::layout::Params;
use super::workspace::BufferSizes;

impl Engine {
    /// Counts every chunk and submits its vertices and sheets, because the next chunk overwrites its densities.
    /// Triangles need the vertex numbers of all chunks. Calls `accept` with the index of each counted chunk; its output
    /// is computed if `accept` returns true.
    pub(super) fn count_chunks(
        &mut self,
        state: &mut JobState,
        mut accept: impl FnMut(&Self, &JobState, usize) -> Result<bool, GpuError>,
    ) -> Result<Vec<ChunkCounts>, GpuError> {
        let n_chunks = state.loaded.chunks.len();
        let mut all = Vec::with_capacity(n_chunks);
        for chunk in 0..n_chunks {
            state.loaded.job.check()?;
            // The device transfers the vertices of the previous chunk while it counts this one.
            let submission = match state.counting.take() {
                Some(submission) => submission,
                None => self.submit_count(state, chunk)?,
            };
            self.collect_output(state)?;
            let counts = self.wait_for_counts(state, chunk, submission)?;
            if accept(self, state, chunk)? {
                // Measures first, so that sheets that do not fit are computed again before the next chunk overwrites
                // the densities.
                self.make_output(state, &[(chunk, &counts)], Stage::Measure)?;
                self.make_output(state, &[(chunk, &counts)], Stage::Interpolate)?;
            }
            all.push(counts);
        }
        Ok(all)
    }

    /// Computes the triangles of all chunks. The caller collects the last piece with [`Self::collect_output`].
    pub(super) fn make_triangles(&mut self, state: &mut JobState, counts: &[ChunkCounts]) -> Result<(), GpuError> {
        let all: Vec<_> = counts.iter().enumerate().collect();
        self.make_output(state, &all, Stage::Emit)
    }

    /// Submits the output of `stage` for chunks, given with their indices, and collects all pieces but the last. The
    /// densities of the first chunk must be present for vertices and sheets.
    pub(super) fn make_output(
        &mut self,
        state: &mut JobState,
        counts: &[(usize, &ChunkCounts)],
        stage: Stage,
    ) -> Result<(), GpuError> {
        let pieces = self.pieces(state, counts);
        self.ensure_capacity(state, &pieces)?;
        let chunk = counts.first().map_or(0, |(chunk, _)| *chunk);
        for piece in &pieces {
            state.loaded.job.check()?;
            let pending = self.submit_piece(state, chunk, piece, stage)?;
            self.collect_output(state)?;
            state.pending = Some(pending);
        }
        Ok(())
    }

    /// Cuts the output of chunks into pieces that fit a binding.
    fn pieces(&self, state: &JobState, counts: &[(usize, &ChunkCounts)]) -> Vec<OutputPiece> {
        let max = self.max_rows(state.loaded.vertex);
        let cut = |&(chunk, counts): &(usize, &ChunkCounts)| {
            let own = &state.loaded.chunks[chunk];
            let sheet_words = self.budget.sheet_words_per_brick;
            pieces([own.first_brick, own.n_own], &counts.groups, counts.first, max, sheet_words)
        };
        counts.iter().flat_map(cut).collect()
    }

    /// Maximum number of vertices and triangles of a piece.
    fn max_rows(&self, vertex: VertexBytes) -> [u64; 2] {
        let bytes = self.budget.piece_bytes.min(self.budget.readback_bytes / 4);
        [bytes / vertex.positions, bytes / TRIANGLE_BYTES]
    }

    /// Grows the output buffers to the largest of `pieces`.
    fn ensure_capacity(&mut self, state: &mut JobState, pieces: &[OutputPiece]) -> Result<(), GpuError> {
        let max = |of: fn(&OutputPiece) -> u64| pieces.iter().map(of).max().unwrap_or_default();
        let capacity = OutputRows {
            vertices: max(|p| p.n_vertices),
            triangles: max(|p| p.n_triangles),
            sheet_words: max(|p| p.sheet_words),
        };
        let loaded = &mut state.loaded;
        let sizes = BufferSizes::new(&loaded.job.prepared.plan, &loaded.chunks, loaded.vertex, capacity);
        self.grow(loaded, &sizes)
    }

    /// Submits `stage` for a piece and the copies of its output.
    fn submit_piece(
        &self,
        state: &JobState,
        chunk: usize,
        piece: &OutputPiece,
        stage: Stage,
    ) -> Result<PendingOutput, GpuError> {
        let loaded = &state.loaded;
        let none = OutputRows::default();
        let rows = match stage {
            Stage::Emit => OutputRows { triangles: piece.n_triangles, ..none },
            Stage::Measure => OutputRows { sheet_words: piece.sheet_words, ..none },
            _ => OutputRows { vertices: piece.n_vertices, ..none },
        };
        let params = Params {
            piece_brick: piece.brick,
            piece_bricks: piece.n_bricks,
            piece_vertex: narrow(piece.vertex)?,
            piece_triangle: narrow(piece.triangle & u64::from(u32::MAX))?,
            vertex_capacity: narrow(piece.n_vertices)?,
            triangle_capacity: narrow(piece.n_triangles)?,
            sheet_capacity: narrow(piece.sheet_words)?,
            ..loaded.chunks[chunk].params(&loaded.params)
        };
        self.write_params(&loaded.workspace, 1, &params);
        let layout = ReadbackLayout::new(rows, loaded.vertex);
        let readback = self.readback.acquire(&self.device, layout.end);
        let target = &readback.buffer;
        let mut recording = self.recording();
        recording.encoder.clear_buffer(loaded.workspace.buffer(BufferId::Counters), 0, None);
        recording.stage(stage, &[loaded.dispatch(1, piece.n_bricks)]);
        recording.copy_output(&loaded.workspace, loaded.vertex, rows, target, &layout);
        recording.copy_timestamps(target);
        recording.copy_counters(&loaded.workspace, target);
        let submission = self.submit(recording, vec![(readback, layout.end)]);
        Ok(PendingOutput { submission, layout, rows, stage, chunk, piece: *piece })
    }

    /// Waits for the pending output, if any, and adds it to the job. Computes sheets again if they did not fit.
    pub(super) fn collect_output(&mut self, state: &mut JobState) -> Result<(), GpuError> {
        while let Some(PendingOutput { submission, layout, mut rows, stage, chunk, piece }) = state.pending.take() {
            let readback = self.wait_one(submission)?;
            let counters = counters(&readback)?;
            self.add_times(&mut state.times, &readback, stage_index(stage)..stage_index(stage) + 1)?;
            let made =
                if stage == Stage::Measure { u64::from(piece.n_bricks) + u64::from(counters.sheet_words) } else { 0 };
            if made > rows.sheet_words {
                let piece = OutputPiece { sheet_words: made, ..piece };
                self.ensure_capacity(state, &[piece])?;
                state.pending = Some(self.submit_piece(state, chunk, &piece, stage)?);
                continue;
            }
            rows.sheet_words = made;
            state.add_counters(&counters);
            let made = ReadbackRows { readback, layout, rows };
            match stage {
                Stage::Emit => state.triangles.push(made),
                Stage::Measure => state.sheets.push((piece.n_bricks, made)),
                _ => state.vertices.push(made),
            }
        }
        Ok(())
    }
}
