//! State of a job between its submissions, and the mesh that results. The columns of the mesh stay in the readback
//! buffers; nothing is copied.

use bytemuck::Pod;

use super::engine::LoadedJob;
use super::error::GpuError;
use super::job::{Finished, JobResult};
use super::output_layout::{COUNTERS_OFFSET, ReadbackLayout, ReadbackRows, byte_range, values};
use super::pipelines::{N_STAGES, STAGES};
use super::plan::layout::{self, Counters};
use super::readback::ReadbackBuffer;
use super::submit::{PendingSubmission, StageTimes};
use crate::surface::{Column, GridStats, Mesh, MeshOutput, Quantized, Stage};

/// Counts of a chunk.
#[derive(Debug, Default)]
pub(super) struct ChunkCounts {
    /// Number of vertices, triangles and bricks with any of them, per group of bricks.
    pub(super) groups: Vec<[u32; 4]>,
    /// Number of vertices and triangles before the chunk.
    pub(super) first: [u64; 2],
}

/// Output piece that was submitted and has not been collected.
pub(super) struct PendingOutput {
    pub(super) submission: PendingSubmission,
    pub(super) layout: ReadbackLayout,
    /// Number of vertices and triangles, one of which is 0.
    pub(super) rows: [u64; 2],
    /// Stage that makes the piece: `interpolate` or `emit`.
    pub(super) stage: Stage,
}

/// State of a job.
pub(super) struct JobState<'a> {
    pub(super) loaded: LoadedJob<'a>,
    pub(super) times: StageTimes,
    /// True if some vertex has no gradient.
    pub(super) has_flat_vertices: bool,
    pub(super) vertices: Vec<ReadbackRows>,
    pub(super) triangles: Vec<ReadbackRows>,
    /// Output that was submitted last.
    pub(super) pending: Option<PendingOutput>,
    /// First vertex and first triangle of each group of bricks.
    parts: Vec<(usize, usize)>,
    surface_bricks: u64,
    /// Number of vertices and triangles counted so far.
    pub(super) total: [u64; 2],
}

impl<'a> JobState<'a> {
    pub(super) fn new(loaded: LoadedJob<'a>) -> Self {
        Self {
            loaded,
            times: [0; N_STAGES],
            has_flat_vertices: false,
            vertices: Vec::new(),
            triangles: Vec::new(),
            pending: None,
            parts: Vec::new(),
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
            let why = format!("{} candidates where {} were planned", counters.list_end, chunk.candidates);
            return Err(GpuError::Failed(why));
        }
        let groups: Vec<[u32; 4]> = values(readback.as_ref(), offset, chunk.n_groups())?.to_vec();
        let first = self.total;
        for &[vertices, triangles, bricks, _] in &groups {
            if let [Ok(vertex), Ok(triangle)] = self.total.map(usize::try_from) {
                self.parts.push((vertex, triangle));
            }
            self.total[0] += u64::from(vertices);
            self.total[1] += u64::from(triangles);
            self.surface_bricks += u64::from(bricks);
        }
        let end = [counters.vertices, counters.triangles].map(u64::from);
        if end != self.total.map(|n| n & u64::from(u32::MAX)) {
            return Err(GpuError::Failed(format!("the scan ends at {end:?}, the groups at {:?}", self.total)));
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

    /// Reads the counters of a finished output.
    pub(super) fn note_flat_vertices(&mut self, readback: &ReadbackBuffer) -> Result<(), GpuError> {
        self.has_flat_vertices |= counters(readback)?.flat > 0;
        Ok(())
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

    /// Assembles the mesh, or its partition, as the device made it: normals are zero where the gradient vanishes.
    ///
    /// # Errors
    /// Those of [`Self::finish`].
    pub(super) fn assemble(&mut self) -> JobResult {
        let mesh = self.mesh()?;
        let (plan, lattice) = (&self.loaded.job.prepared.plan, &self.loaded.job.prepared.lattice);
        let grid = GridStats {
            bricks: plan.n_reached,
            surface_bricks: self.surface_bricks,
            samples: plan.n_reached * layout::SAMPLES,
            box_cells: lattice.box_cells,
            candidates: plan.pairs,
        };
        let timed = self.times.iter().any(|&ns| ns > 0);
        let stages = if timed { STAGES.into_iter().zip(self.times).collect() } else { Vec::new() };
        Ok(Finished { meshed: MeshOutput::new(mesh, grid), stages })
    }

    fn mesh(&mut self) -> Result<Mesh, GpuError> {
        let prepared = &self.loaded.job.prepared;
        let params = &prepared.params;
        let vertices = &self.vertices;
        let of_vertices =
            |offset: fn(&ReadbackLayout) -> u64| move |r: &ReadbackRows| (offset(&r.layout), r.n_vertices);
        let (positions, normals) = (of_vertices(|layout| layout.positions), of_vertices(|layout| layout.normals));
        let sources = of_vertices(|layout| layout.sources);
        let mut mesh = Mesh {
            centre: prepared.lattice.centre(),
            triangles: column(&self.triangles, |r| (r.layout.triangles, r.n_triangles))?,
            atom_ids: params.atom_ids.then(|| column(vertices, sources)).transpose()?,
            parts: std::mem::take(&mut self.parts),
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

/// Column of `pieces`; `place` returns the offset and the number of rows of a piece.
fn column<T: Pod>(pieces: &[ReadbackRows], place: impl Fn(&ReadbackRows) -> (u64, u64)) -> Result<Column<T>, GpuError> {
    let piece = |rows: &ReadbackRows| {
        let (offset, n) = place(rows);
        let bytes = byte_range::<T>(offset, n)?;
        Column::shared(rows.readback.clone(), bytes.clone())
            .ok_or_else(|| GpuError::Failed(format!("bytes {bytes:?} are not a column")))
    };
    pieces.iter().map(piece).collect::<Result<_, GpuError>>().map(Column::from_chunks)
}

/// Counters in a readback buffer.
fn counters(readback: &ReadbackBuffer) -> Result<Counters, GpuError> {
    let rows: &[Counters] = values(readback.as_ref(), COUNTERS_OFFSET, 1)?;
    rows.first().copied().ok_or_else(|| GpuError::Failed("a readback buffer without counters".to_owned()))
}
