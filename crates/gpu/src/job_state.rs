//! State of a job between its submissions, and the resulting mesh. The columns of the mesh stay in the readback buffers
//! and are not copied.

use bytemuck::Pod;
use molmesh_surface::vector::joined_bounds;
use molmesh_surface::{Column, GridStats, Mesh, MeshOutput, Quantized, Stage, Step};

use super::engine::LoadedJob;
use super::error::GpuError;
use super::job::{Finished, JobResult};
use super::output_layout::{
    COUNTERS_OFFSET, OutputPiece, OutputRows, ReadbackLayout, ReadbackRows, byte_range, values,
};
use super::pipelines::{N_STAGES, STAGES};
use super::plan::layout::{self, Counters};
use super::readback::ReadbackBuffer;
use super::recording::PendingSubmission;
use super::sheets::{SheetBlocks, SheetPiece};
use super::submit::StageTimes;

/// Counts of a chunk.
#[derive(Debug, Default)]
pub(super) struct ChunkCounts {
    /// Per group of bricks: number of vertices, of triangles, and of bricks with triangles; the fourth word is unused.
    pub(super) groups: Vec<[u32; 4]>,
    /// Number of vertices and triangles before the chunk.
    pub(super) first: [u64; 2],
}

/// Output piece that was submitted and has not been collected.
pub(super) struct PendingOutput {
    pub(super) submission: PendingSubmission,
    pub(super) layout: ReadbackLayout,
    /// Rows that the readback buffer holds.
    pub(super) rows: OutputRows,
    /// Stage that computes the piece: `interpolate`, `emit` or `measure`.
    pub(super) stage: Stage,
    pub(super) chunk: usize,
    pub(super) piece: OutputPiece,
}

/// State of a job.
pub(super) struct JobState {
    pub(super) loaded: LoadedJob,
    /// Submission that counts the first chunk, if it was made while the previous job ran.
    pub(super) counting: Option<PendingSubmission>,
    pub(super) times: StageTimes,
    /// True if some vertex has no gradient.
    pub(super) has_flat_vertices: bool,
    pub(super) vertices: Vec<ReadbackRows>,
    pub(super) triangles: Vec<ReadbackRows>,
    /// Blocks of sheets in pieces, each with its number of bricks.
    pub(super) sheets: Vec<(u32, ReadbackRows)>,
    checksum: u64,
    degenerate: bool,
    /// Bounds of the positions, in Å or steps.
    bounds: Option<[[f32; 3]; 2]>,
    /// Output that was submitted last.
    pub(super) pending: Option<PendingOutput>,
    surface_bricks: u64,
    /// Number of vertices and triangles counted so far.
    pub(super) total: [u64; 2],
}

impl JobState {
    pub(super) fn new(loaded: LoadedJob) -> Self {
        Self {
            loaded,
            counting: None,
            times: [0; N_STAGES],
            has_flat_vertices: false,
            vertices: Vec::new(),
            triangles: Vec::new(),
            sheets: Vec::new(),
            checksum: 0,
            degenerate: false,
            bounds: None,
            pending: None,
            surface_bricks: 0,
            total: [0; 2],
        }
    }

    /// Adds the counts of a chunk, whose groups lie at `offset` of the readback buffer.
    ///
    /// # Errors
    /// [`GpuError::Failed`] if the counters contradict each other.
    pub(super) fn add_counts(
        &mut self,
        readback: &ReadbackBuffer,
        chunk: usize,
        offset: u64,
    ) -> Result<ChunkCounts, GpuError> {
        let chunk = &self.loaded.chunks[chunk];
        let counters = counters(readback)?;
        if u64::from(counters.list_end) > chunk.candidates {
            let why = format!("found {} candidates, expected at most {}", counters.list_end, chunk.candidates);
            return Err(GpuError::Failed(why));
        }
        let groups: Vec<[u32; 4]> = values(readback.as_ref(), offset, chunk.n_groups())?.to_vec();
        let first = self.total;
        for &[vertices, triangles, bricks, _] in &groups {
            self.total[0] += u64::from(vertices);
            self.total[1] += u64::from(triangles);
            self.surface_bricks += u64::from(bricks);
        }
        let end = [counters.vertices, counters.triangles].map(u64::from);
        if end != self.total.map(|n| n & u64::from(u32::MAX)) {
            return Err(GpuError::Failed(format!(
                "the scan counts {end:?} vertices and triangles, the groups {:?}",
                self.total
            )));
        }
        Ok(ChunkCounts { groups, first })
    }

    /// Checks the counts so far against the limits.
    pub(super) fn check_limits(&self) -> Result<(), GpuError> {
        Ok(self.loaded.job.prepared.check_size(self.total)?)
    }

    /// Checks the counts of all chunks against the limits and rejects an empty mesh.
    pub(super) fn check_complete(&self) -> Result<(), GpuError> {
        Ok(self.loaded.job.prepared.check_mesh(self.total)?)
    }

    /// Adds the counters of a finished output.
    pub(super) fn add_counters(&mut self, counters: &Counters) {
        let [low, high] = counters.checksum.map(u64::from);
        self.has_flat_vertices |= counters.flat > 0;
        self.checksum = self.checksum.wrapping_add(high << 32 | low);
        self.degenerate |= counters.degenerate > 0;
        self.bounds = self.bounds.into_iter().chain(counters.position_bounds()).reduce(joined_bounds);
    }

    /// Assembles the mesh and computes the normals of vertices without a gradient.
    ///
    /// # Errors
    /// [`GpuError::Failed`] if a column does not fit its readback buffer.
    pub(super) fn finish(&mut self) -> JobResult {
        let mut finished = self.assemble()?;
        if self.has_flat_vertices {
            finished.meshed.mesh.fill_flat_normals();
        }
        Ok(finished)
    }

    /// Assembles the mesh, or its partition. Keeps the normals of the device, which are zero where the gradient
    /// vanishes.
    ///
    /// # Errors
    /// Those of [`Self::finish`].
    pub(super) fn assemble(&mut self) -> JobResult {
        let mesh = self.mesh()?;
        let piece = |(n_bricks, rows): &(u32, ReadbackRows)| {
            let words = column(std::slice::from_ref(rows), |r| (r.layout.sheets, r.rows.sheet_words))?;
            Ok(SheetPiece { n_bricks: *n_bricks, words })
        };
        let pieces = self.sheets.iter().map(piece).collect::<Result<_, GpuError>>()?;
        let sheets = SheetBlocks { pieces, checksum: self.checksum, degenerate: self.degenerate };
        let (plan, lattice) = (&self.loaded.job.prepared.plan, &self.loaded.job.prepared.lattice);
        let grid = GridStats {
            bricks: plan.n_reached,
            surface_bricks: self.surface_bricks,
            grid_points: plan.n_reached * layout::BRICK_POINTS,
            box_cells: lattice.box_cells,
            candidates: plan.pairs,
            overlaps: plan.arcs.n_overlaps(),
        };
        let timed = self.times.iter().any(|&ns| ns > 0);
        let stages = if timed { STAGES.into_iter().zip(self.times).collect() } else { Vec::new() };
        let unit = self.loaded.job.prepared.params.quantize.map_or(1.0, Step::length);
        let bounds = self.bounds.map(|bounds| bounds.map(|corner| corner.map(|c| c * unit)));
        Ok(Finished { meshed: MeshOutput { bounds, ..MeshOutput::new(mesh, grid) }, stages, sheets })
    }

    fn mesh(&mut self) -> Result<Mesh, GpuError> {
        let prepared = &self.loaded.job.prepared;
        let params = &prepared.params;
        let vertices = &self.vertices;
        let of_vertices =
            |offset: fn(&ReadbackLayout) -> u64| move |r: &ReadbackRows| (offset(&r.layout), r.rows.vertices);
        let (positions, normals) = (of_vertices(|layout| layout.positions), of_vertices(|layout| layout.normals));
        let sources = of_vertices(|layout| layout.sources);
        let mut mesh = Mesh {
            centre: prepared.lattice.centre(),
            triangles: column(&self.triangles, |r| (r.layout.triangles, r.rows.triangles))?,
            atom_ids: params.atom_ids.then(|| column(vertices, sources)).transpose()?,
            ..Mesh::default()
        };
        if let Some(step) = params.quantize {
            let (positions, normals) = (column(vertices, positions)?, column(vertices, normals)?);
            mesh.quantized = Some(Quantized { step, positions, normals });
        } else {
            (mesh.positions, mesh.normals) = (column(vertices, positions)?, column(vertices, normals)?);
        }
        Ok(mesh)
    }
}

/// Column of `pieces`; `range` returns the byte offset and the number of rows of a piece.
fn column<T: Pod>(pieces: &[ReadbackRows], range: impl Fn(&ReadbackRows) -> (u64, u64)) -> Result<Column<T>, GpuError> {
    let piece = |rows: &ReadbackRows| {
        let (offset, n) = range(rows);
        let bytes = byte_range::<T>(offset, n)?;
        Column::shared(rows.readback.clone(), bytes.clone())
            .ok_or_else(|| GpuError::Failed(format!("bytes {bytes:?} are not a column")))
    };
    pieces.iter().map(piece).collect::<Result<_, GpuError>>().map(Column::from_chunks)
}

/// Counters in a readback buffer.
pub(super) fn counters(readback: &ReadbackBuffer) -> Result<Counters, GpuError> {
    let rows: &[Counters] = values(readback.as_ref(), COUNTERS_OFFSET, 1)?;
    rows.first().copied().ok_or_else(|| GpuError::Failed("a readback buffer without counters".to_owned()))
}
