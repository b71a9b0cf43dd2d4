//! A job's output: in pieces that a binding holds, each in a landing that the host can read. The next one is made while the
//! one before is on its way.

use wgpu::Buffer;

use super::engine::{Engine, Loaded, check};
use super::error::GpuError;
use super::flight::{Arrived, Piece, Places, TALLY_AT, TRIANGLE_BYTES, VertexBytes, pieces};
use super::progress::{Counted, Progress, Sent};
use super::record::{Dispatch, Recording};
use super::run::FRONT;
use super::workspace::{Needs, OutputRows, Workspace};
use crate::surface::Stage;
use crate::surface::layout::{Params, Tally};

/// Rows of parameters: the chunk's and a piece's.
pub(super) const PARAM_ROWS: u64 = 2;
/// Output is made before it is counted where the buffers hold the estimate for a small job over this: a ball of 60,000
/// atoms at 0.5 Å needs a sixth of the estimate, and what is less solid needs more.
const LIKELY: u64 = 8;

pub(super) fn failed(why: String) -> GpuError {
    GpuError::Failed(why)
}

/// `n` rows as 32 bits; buffers are smaller than that.
pub(super) fn narrow(n: u64) -> Result<u32, GpuError> {
    u32::try_from(n).map_err(|e| failed(format!("{n} rows: {e}")))
}

/// Copies counters, and the groups to where they shall lie.
pub(super) fn copy_counts(
    recording: &mut Recording<'_>,
    workspace: &Workspace,
    target: &Buffer,
    groups: Option<(u64, u64)>,
) {
    let encoder = &mut recording.encoder;
    encoder.copy_buffer_to_buffer(workspace.buffer("tally"), 0, target, TALLY_AT, size_of::<Tally>() as u64);
    if let Some((at, bytes)) = groups {
        encoder.copy_buffer_to_buffer(workspace.buffer("groups"), 0, target, at, bytes);
    }
}

/// Copies the first `bytes` bytes of a buffer.
pub(super) fn copy_rows(recording: &mut Recording<'_>, from: &Buffer, target: &Buffer, at: u64, bytes: u64) {
    if bytes > 0 {
        recording.encoder.copy_buffer_to_buffer(from, 0, target, at, bytes);
    }
}

/// Copies the first `n` vertices in the workspace to their columns.
pub(super) fn copy_vertices(
    recording: &mut Recording<'_>,
    loaded: &Loaded<'_>,
    target: &Buffer,
    places: &Places,
    n: u64,
) {
    let workspace = &loaded.workspace;
    let VertexBytes { positions, normals, sources } = loaded.vertex;
    copy_rows(recording, workspace.buffer("positions"), target, places.positions, positions * n);
    copy_rows(recording, workspace.buffer("normals"), target, places.normals, normals * n);
    copy_rows(recording, workspace.buffer("sources"), target, places.sources, sources * n);
}

impl Loaded<'_> {
    pub(super) fn dispatch(&self, row: u64, workgroups: u32) -> Dispatch<'_> {
        Dispatch { workspace: &self.workspace, row, workgroups, variant: self.variant }
    }
}

impl Engine {
    /// Vertices, triangles or both of all chunks; vertices of one only, the first.
    pub(super) fn output(
        &mut self,
        progress: &mut Progress<'_>,
        counted: &[Counted],
        columns: [bool; 2],
    ) -> Result<(), GpuError> {
        let all: Vec<_> = counted.iter().enumerate().collect();
        let pieces = self.pieces(progress, &all);
        self.make_room(progress, &pieces)?;
        self.send_pieces(progress, 0, &pieces, columns)?;
        self.settle(progress)
    }

    /// Pieces of output of some chunks, each small enough for a binding.
    pub(super) fn pieces(&self, progress: &Progress<'_>, counted: &[(usize, &Counted)]) -> Vec<Piece> {
        let most = self.most_rows(progress.loaded.vertex);
        let cut = |&(chunk, counted): &(usize, &Counted)| {
            let own = &progress.loaded.chunks[chunk];
            pieces([own.first_brick, own.n_own], &counted.groups, counted.first, most)
        };
        counted.iter().flat_map(cut).collect()
    }

    /// Vertices and triangles of the largest piece of output.
    fn most_rows(&self, vertex: VertexBytes) -> [u64; 2] {
        let most = self.budget.piece_bytes.min(self.budget.landing_bytes / 4);
        [most / vertex.positions, most / TRIANGLE_BYTES]
    }

    /// Output buffers for the largest of some pieces.
    pub(super) fn make_room(&mut self, progress: &mut Progress<'_>, pieces: &[Piece]) -> Result<(), GpuError> {
        let rows = OutputRows {
            vertices: pieces.iter().map(|p| p.n_vertices).max().unwrap_or_default(),
            triangles: pieces.iter().map(|p| p.n_triangles).max().unwrap_or_default(),
            ..Self::no_rows()
        };
        let loaded = &mut progress.loaded;
        let needs = Needs::new(&loaded.job.prepared.plan, &loaded.chunks, loaded.vertex, rows);
        self.grow(loaded, &needs)
    }

    /// Makes the vertices, the triangles or both of some pieces. Each is sent before the one before it has landed; the last
    /// is left on its way.
    pub(super) fn send_pieces(
        &self,
        progress: &mut Progress<'_>,
        chunk: usize,
        pieces: &[Piece],
        columns: [bool; 2],
    ) -> Result<(), GpuError> {
        for piece in pieces {
            check(progress.loaded.job)?;
            let flight = self.send_piece(&progress.loaded, chunk, piece, columns)?;
            self.settle(progress)?;
            progress.sent = Some(flight);
        }
        Ok(())
    }

    /// Takes the output that is on its way, if any is.
    pub(super) fn settle(&self, progress: &mut Progress<'_>) -> Result<(), GpuError> {
        let Some(Sent { flight, places, rows, columns: [vertices, triangles] }) = progress.sent.take() else {
            return Ok(());
        };
        let landing = self.land(flight)?.pop().ok_or_else(|| failed("a submission without its landing".to_owned()))?;
        progress.note_flat(&landing)?;
        let first = if vertices { FRONT } else { FRONT + 1 };
        self.add_times(progress, &landing, first..FRONT + 1 + usize::from(triangles))?;
        let arrived = Arrived { landing, places, n_vertices: rows[0], n_triangles: rows[1] };
        progress.vertices.extend(vertices.then(|| arrived.clone()));
        progress.triangles.extend(triangles.then_some(arrived));
        Ok(())
    }

    /// A submission of its own for each piece: stages have one time a submission, which holds no copies then.
    fn send_piece(
        &self,
        loaded: &Loaded<'_>,
        chunk: usize,
        piece: &Piece,
        columns: [bool; 2],
    ) -> Result<Sent, GpuError> {
        let [vertices, triangles] = columns;
        let rows = [piece.n_vertices * u64::from(vertices), piece.n_triangles * u64::from(triangles)];
        let places = Places::new(rows[0], rows[1], loaded.vertex);
        let landing = self.landings.get(&self.device, places.end);
        let target = landing.buffer().map_err(failed)?;
        let params = Params {
            piece_brick: piece.brick,
            piece_bricks: piece.n_bricks,
            piece_vertex: narrow(piece.vertex)?,
            piece_triangle: narrow(piece.triangle & u64::from(u32::MAX))?,
            vertex_capacity: narrow(piece.n_vertices)?,
            triangle_capacity: narrow(piece.n_triangles)?,
            ..loaded.chunks[chunk].params(&loaded.params)
        };
        self.write_params(&loaded.workspace, 1, &params);
        let mut recording = self.recording();
        let dispatch = [loaded.dispatch(1, piece.n_bricks)];
        if vertices {
            recording.stage(Stage::Interpolate, &dispatch);
            copy_vertices(&mut recording, loaded, target, &places, rows[0]);
        }
        if triangles {
            recording.stage(Stage::Emit, &dispatch);
            let buffer = loaded.workspace.buffer("triangles");
            copy_rows(&mut recording, buffer, target, places.triangles, TRIANGLE_BYTES * rows[1]);
        }
        recording.read_clock(target);
        copy_counts(&mut recording, &loaded.workspace, target, None);
        let flight = self.launch(recording, vec![(landing, places.end)])?;
        Ok(Sent { flight, places, rows, columns })
    }

    /// Submits the whole output of a job's only chunk before it is counted, into the buffers as they are. Returns the
    /// vertices and triangles that they hold: what is more than that is not written. None where they are so small that
    /// it would be.
    pub(super) fn tail_ahead(&self, progress: &Progress<'_>) -> Result<Option<[u64; 2]>, GpuError> {
        let loaded = &progress.loaded;
        let [most_vertices, most_triangles] = self.most_rows(loaded.vertex);
        let hold = |name: &str, each: u64| loaded.workspace.buffer(name).size().checked_div(each).unwrap_or(u64::MAX);
        let VertexBytes { positions, normals, sources } = loaded.vertex;
        let columns = [hold("positions", positions), hold("normals", normals), hold("sources", sources)];
        let vertices = columns.into_iter().fold(most_vertices, u64::min);
        let triangles = hold("triangles", TRIANGLE_BYTES).min(most_triangles);
        let n_bricks = u64::from(loaded.params.n_bricks);
        let few = self.budget.rows_per_brick.map(|each| each * n_bricks / LIKELY);
        if vertices < few[0] || triangles < few[1] {
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
        let tail = [loaded.dispatch(1, params.n_bricks)];
        recording.stage(Stage::Interpolate, &tail);
        recording.stage(Stage::Emit, &tail);
        self.launch(recording, Vec::new())?;
        Ok(Some([vertices, triangles]))
    }

    /// Copies the output that was submitted ahead, if the buffers had room for it and a landing has. Whether they had.
    pub(super) fn copy_tail(
        &self,
        progress: &mut Progress<'_>,
        counted: &Counted,
        room: Option<[u64; 2]>,
    ) -> Result<bool, GpuError> {
        let (rows, loaded) = ([counted.n_vertices, counted.n_triangles], &progress.loaded);
        let places = Places::new(rows[0], rows[1], loaded.vertex);
        let fits = room.is_some_and(|room| rows[0] <= room[0] && rows[1] <= room[1]);
        if !fits || places.end > self.budget.landing_bytes {
            return Ok(false);
        }
        let landing = self.landings.get(&self.device, places.end);
        let target = landing.buffer().map_err(failed)?;
        let mut recording = self.recording();
        copy_vertices(&mut recording, loaded, target, &places, rows[0]);
        copy_rows(
            &mut recording,
            loaded.workspace.buffer("triangles"),
            target,
            places.triangles,
            TRIANGLE_BYTES * rows[1],
        );
        recording.timed_before(&[Stage::Interpolate, Stage::Emit]);
        recording.read_clock(target);
        copy_counts(&mut recording, &loaded.workspace, target, None);
        let flight = self.launch(recording, vec![(landing, places.end)])?;
        progress.sent = Some(Sent { flight, places, rows, columns: [true, true] });
        self.settle(progress)?;
        Ok(true)
    }
}
