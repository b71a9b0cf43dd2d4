//! How jobs go through the engine: small ones together in one submission, large ones alone.

use std::sync::Arc;

use wgpu::Buffer;

use super::engine::{Engine, Loaded, check, scaled};
use super::error::GpuError;
use super::executor::{Finished, GpuJob};
use super::flight::{Arrived, BODY_AT, Piece, Places, TALLY_AT, pieces};
use super::landing::Landing;
use super::pipelines::N_STAGES;
use super::progress::{Counted, Progress};
use super::record::{Dispatch, Recording};
use super::workspace::{Needs, OutputRows, Workspace};
use crate::surface::Stage;
use crate::surface::chunks::Chunk;
use crate::surface::layout::{GROUP, Params, Tally};

/// Rows of parameters: the chunk's, and those of the pieces of a submission.
const PARAM_ROWS: usize = 64;
/// Stages before the output is sized.
const FRONT: usize = 4;

fn failed(why: String) -> GpuError {
    GpuError::Failed(why)
}

/// `n` rows as 32 bits; buffers are smaller than that.
fn narrow(n: u64) -> Result<u32, GpuError> {
    u32::try_from(n).map_err(|e| failed(format!("{n} rows: {e}")))
}

/// Bytes of a chunk's groups.
fn group_bytes(chunk: &Chunk) -> u64 {
    16 * u64::from(chunk.n_own.div_ceil(GROUP))
}

/// Copies counters, and the groups to where they shall lie.
fn copy_counts(recording: &mut Recording<'_>, workspace: &Workspace, target: &Buffer, groups: Option<(u64, u64)>) {
    let encoder = &mut recording.encoder;
    encoder.copy_buffer_to_buffer(workspace.buffer("tally"), 0, target, TALLY_AT, size_of::<Tally>() as u64);
    if let Some((at, bytes)) = groups {
        encoder.copy_buffer_to_buffer(workspace.buffer("groups"), 0, target, at, bytes);
    }
}

/// Copies the first `n` rows of 12 bytes, or of `each` bytes, of a buffer.
fn copy_rows(recording: &mut Recording<'_>, from: &Buffer, target: &Buffer, at: u64, bytes: u64) {
    if bytes > 0 {
        recording.encoder.copy_buffer_to_buffer(from, 0, target, at, bytes);
    }
}

/// Copies the vertices in the workspace to their columns, `skip` rows in.
fn copy_vertices(recording: &mut Recording<'_>, loaded: &Loaded<'_>, target: &Buffer, places: &Places, rows: [u64; 2]) {
    let ([skip, n], workspace) = (rows, &loaded.workspace);
    copy_rows(recording, workspace.buffer("positions"), target, places.positions + 12 * skip, 12 * n);
    copy_rows(recording, workspace.buffer("normals"), target, places.normals + 12 * skip, 12 * n);
    if loaded.variant.nearest {
        copy_rows(recording, workspace.buffer("sources"), target, places.sources + 4 * skip, 4 * n);
    }
}

impl Loaded<'_> {
    fn dispatch(&self, row: u64, workgroups: u32) -> Dispatch<'_> {
        Dispatch { workspace: &self.workspace, row, workgroups, variant: self.variant }
    }
}

impl Engine {
    /// The rows that a small job's buffers should hold, if it is one.
    pub(super) fn small_rows(&self, job: &GpuJob, chunks: &[Chunk]) -> Option<OutputRows> {
        // Small lattices cross a brick more often than large ones.
        let n = job.prepared.plan.bricks.len() as u64 + 8;
        let [vertices, triangles] = self.budget.rows_per_brick.map(|each| each * n);
        let bytes = Places::new(vertices, triangles, job.prepared.params.atom_ids).end;
        let fits = 12 * vertices.max(triangles) <= self.budget.piece_bytes && bytes <= self.budget.landing_bytes;
        let small = chunks.len() == 1 && bytes <= self.budget.small_bytes && fits;
        small.then_some(OutputRows { vertices, triangles, params: PARAM_ROWS as u64 })
    }

    /// The rows that a job's buffers hold before its output is counted.
    pub(super) fn no_rows() -> OutputRows {
        OutputRows { vertices: 0, triangles: 0, params: PARAM_ROWS as u64 }
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
            let places = Places::new(rows.vertices, rows.triangles, loaded.variant.nearest);
            let groups = group_bytes(&loaded.chunks[0]);
            let landing = self.landings.get(&self.device, places.end + groups);
            let target = landing.buffer().map_err(failed)?;
            recording.read_clock(target);
            copy_counts(&mut recording, &loaded.workspace, target, Some((places.end, groups)));
            copy_vertices(&mut recording, loaded, target, &places, [0, rows.vertices]);
            let triangles = loaded.workspace.buffer("triangles");
            copy_rows(&mut recording, triangles, target, places.triangles, 12 * rows.triangles);
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
        let places = Places::new(rows.vertices, rows.triangles, progress.loaded.variant.nearest);
        let counted = progress.count(landing, 0, places.end)?;
        progress.complete()?;
        progress.times = self.times(landing, 0..N_STAGES)?.map(|ns| scaled(ns, share));
        let (n_vertices, n_triangles) = (counted.n_vertices, counted.n_triangles);
        if n_vertices > rows.vertices || n_triangles > rows.triangles {
            self.output(progress, &[counted])?;
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
        let mut counted = Vec::with_capacity(n_chunks);
        for chunk in 0..n_chunks {
            check(progress.loaded.job)?;
            let count = self.count(progress, chunk)?;
            if n_chunks > 1 {
                // The chunk's samples are there now and not later; its triangles need its neighbours' vertices.
                let pieces = self.pieces(progress, &[(chunk, &count)]);
                self.make_room(progress, &pieces)?;
                self.fly_pieces(progress, chunk, &pieces, [true, false])?;
            }
            counted.push(count);
        }
        progress.complete()?;
        if n_chunks > 1 {
            let all: Vec<_> = counted.iter().enumerate().collect();
            let pieces = self.pieces(progress, &all);
            self.make_room(progress, &pieces)?;
            self.fly_pieces(progress, 0, &pieces, [false, true])?;
        } else {
            self.output(progress, &counted)?;
        }
        progress.finish()
    }

    /// A chunk's stages up to `scan`.
    fn count(&self, progress: &mut Progress<'_>, chunk: usize) -> Result<Counted, GpuError> {
        let loaded = &progress.loaded;
        let own = &loaded.chunks[chunk];
        let [first_vertex, first_triangle] = progress.total;
        let params = Params {
            first_vertex: narrow(first_vertex)?,
            first_triangle: narrow(first_triangle & u64::from(u32::MAX))?,
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
        let landings = self.fly(recording, vec![(landing, bytes)])?;
        let [landing] = &landings[..] else { return Err(failed("a submission without its landing".to_owned())) };
        self.add_times(progress, landing, 0..FRONT)?;
        progress.count(landing, chunk, BODY_AT)
    }

    fn add_times(
        &self,
        progress: &mut Progress<'_>,
        landing: &Landing,
        stages: std::ops::Range<usize>,
    ) -> Result<(), GpuError> {
        let times = self.times(landing, stages)?;
        progress.times.iter_mut().zip(times).for_each(|(sum, ns)| *sum += ns);
        Ok(())
    }

    /// Vertices and triangles of a job's only chunk.
    fn output(&mut self, progress: &mut Progress<'_>, counted: &[Counted]) -> Result<(), GpuError> {
        let all: Vec<_> = counted.iter().enumerate().collect();
        let pieces = self.pieces(progress, &all);
        self.make_room(progress, &pieces)?;
        self.fly_pieces(progress, 0, &pieces, [true, true])
    }

    /// Pieces of output of some chunks, each small enough for a binding.
    fn pieces(&self, progress: &Progress<'_>, counted: &[(usize, &Counted)]) -> Vec<Piece> {
        let most = self.budget.piece_bytes.min(self.budget.landing_bytes / 4) / 12;
        let cut = |&(chunk, counted): &(usize, &Counted)| {
            let own = &progress.loaded.chunks[chunk];
            pieces([own.first_brick, own.n_own], &counted.groups, counted.first, [most, most])
        };
        counted.iter().flat_map(cut).collect()
    }

    /// Output buffers for the largest of some pieces.
    fn make_room(&mut self, progress: &mut Progress<'_>, pieces: &[Piece]) -> Result<(), GpuError> {
        let rows = OutputRows {
            vertices: pieces.iter().map(|p| p.n_vertices).max().unwrap_or_default(),
            triangles: pieces.iter().map(|p| p.n_triangles).max().unwrap_or_default(),
            ..Self::no_rows()
        };
        let loaded = &mut progress.loaded;
        let needs = Needs::new(&loaded.job.prepared.plan, &loaded.chunks, loaded.variant.nearest, rows);
        self.grow(loaded, &needs)
    }

    /// Makes the vertices, the triangles or both of some pieces, in as few submissions as landings allow.
    fn fly_pieces(
        &self,
        progress: &mut Progress<'_>,
        chunk: usize,
        pieces: &[Piece],
        [vertices, triangles]: [bool; 2],
    ) -> Result<(), GpuError> {
        let nearest = progress.loaded.variant.nearest;
        let mut rest = pieces;
        while !rest.is_empty() {
            check(progress.loaded.job)?;
            // As many pieces as a landing holds, one at least.
            let (mut n, mut rows) = (0, [0, 0]);
            let mut places = Places::new(0, 0, nearest);
            for piece in rest.iter().take(PARAM_ROWS - 1) {
                let more = [
                    rows[0] + piece.n_vertices * u64::from(vertices),
                    rows[1] + piece.n_triangles * u64::from(triangles),
                ];
                let larger = Places::new(more[0], more[1], nearest);
                if n > 0 && larger.end > self.budget.landing_bytes {
                    break;
                }
                (n, rows, places) = (n + 1, more, larger);
            }
            let (now, later) = rest.split_at(n);
            let landing = self.fly_some(&progress.loaded, chunk, now, [vertices, triangles], &places)?;
            progress.note_flat(&landing)?;
            let first = if vertices { FRONT } else { FRONT + 1 };
            self.add_times(progress, &landing, first..FRONT + 1 + usize::from(triangles))?;
            let arrived = Arrived { landing, places, n_vertices: rows[0], n_triangles: rows[1] };
            progress.vertices.extend(vertices.then(|| arrived.clone()));
            progress.triangles.extend(triangles.then_some(arrived));
            rest = later;
        }
        Ok(())
    }

    fn fly_some(
        &self,
        loaded: &Loaded<'_>,
        chunk: usize,
        pieces: &[Piece],
        [vertices, triangles]: [bool; 2],
        places: &Places,
    ) -> Result<Arc<Landing>, GpuError> {
        let landing = self.landings.get(&self.device, places.end);
        let target = landing.buffer().map_err(failed)?;
        let base = loaded.chunks[chunk].params(&loaded.params);
        for (row, piece) in (1..).zip(pieces) {
            let params = Params {
                piece_brick: piece.brick,
                piece_bricks: piece.n_bricks,
                piece_vertex: narrow(piece.vertex)?,
                piece_triangle: narrow(piece.triangle & u64::from(u32::MAX))?,
                vertex_capacity: narrow(piece.n_vertices)?,
                triangle_capacity: narrow(piece.n_triangles)?,
                ..base
            };
            self.write_params(&loaded.workspace, row, &params);
        }
        let mut recording = self.recording();
        let ends = |i: usize| [i == 0, i + 1 == pieces.len()];
        let (mut n_vertices, mut n_triangles) = (0, 0);
        for (i, piece) in pieces.iter().enumerate().filter(|_| vertices) {
            let [first, last] = ends(i);
            recording.part(Stage::Interpolate, &[loaded.dispatch(i as u64 + 1, piece.n_bricks)], first, last);
            copy_vertices(&mut recording, loaded, target, places, [n_vertices, piece.n_vertices]);
            n_vertices += piece.n_vertices;
        }
        for (i, piece) in pieces.iter().enumerate().filter(|_| triangles) {
            let [first, last] = ends(i);
            recording.part(Stage::Emit, &[loaded.dispatch(i as u64 + 1, piece.n_bricks)], first, last);
            let at = places.triangles + 12 * n_triangles;
            copy_rows(&mut recording, loaded.workspace.buffer("triangles"), target, at, 12 * piece.n_triangles);
            n_triangles += piece.n_triangles;
        }
        recording.read_clock(target);
        copy_counts(&mut recording, &loaded.workspace, target, None);
        let mut landings = self.fly(recording, vec![(landing, places.end)])?;
        landings.pop().ok_or_else(|| failed("a submission without its landing".to_owned()))
    }
}
