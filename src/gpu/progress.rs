//! A job between its submissions: what was counted, what arrived, and the mesh that it becomes.

use super::assemble;
use super::engine::{Loaded, Times};
use super::error::GpuError;
use super::executor::Finished;
use super::flight::{Arrived, Places, TALLY_AT, values};
use super::landing::Landing;
use super::pipelines::{N_STAGES, STAGES};
use super::submit::Flight;
use crate::surface::chunks::Chunk;
use crate::surface::layout::{self, GROUP, Tally};
use crate::surface::plan::check_totals;
use crate::surface::{GridStats, MeshOutput};

/// What a chunk's stages up to `scan` counted.
#[derive(Debug, Default)]
pub(super) struct Counted {
    /// Vertices, triangles and bricks with any, per group of bricks.
    pub(super) groups: Vec<[u32; 4]>,
    /// Vertices and triangles before the chunk.
    pub(super) first: [u64; 2],
    pub(super) n_vertices: u64,
    pub(super) n_triangles: u64,
}

/// Output on its way.
pub(super) struct Sent {
    pub(super) flight: Flight,
    pub(super) places: Places,
    /// Vertices and triangles.
    pub(super) rows: [u64; 2],
    /// Whether it has vertices, and triangles.
    pub(super) columns: [bool; 2],
}

/// A job that is being put together.
pub(super) struct Progress<'a> {
    pub(super) loaded: Loaded<'a>,
    pub(super) times: Times,
    /// Whether some vertex has no gradient.
    pub(super) flat: bool,
    pub(super) vertices: Vec<Arrived>,
    pub(super) triangles: Vec<Arrived>,
    /// The output that was submitted last and has not been looked at.
    pub(super) sent: Option<Sent>,
    parts: Vec<(usize, usize)>,
    surface_bricks: u64,
    /// Vertices and triangles so far.
    pub(super) total: [u64; 2],
}

/// The counters of a landing.
pub(super) fn tally(landing: &Landing) -> Result<Tally, GpuError> {
    let rows: &[Tally] = values(landing.as_ref(), TALLY_AT, 1).map_err(GpuError::Failed)?;
    rows.first().copied().ok_or_else(|| GpuError::Failed("a landing without counters".to_owned()))
}

impl<'a> Progress<'a> {
    pub(super) fn new(loaded: Loaded<'a>) -> Self {
        Self {
            loaded,
            times: [0; N_STAGES],
            flat: false,
            vertices: Vec::new(),
            triangles: Vec::new(),
            sent: None,
            parts: Vec::new(),
            surface_bricks: 0,
            total: [0; 2],
        }
    }

    /// Reads what chunk number `chunk` counted, with its groups at `at` of the landing, and adds it up.
    ///
    /// # Errors
    /// [`GpuError::Failed`] where the counters contradict each other.
    pub(super) fn count(&mut self, landing: &Landing, chunk: usize, at: u64) -> Result<Counted, GpuError> {
        let chunk: &Chunk = &self.loaded.chunks[chunk];
        let tally = tally(landing)?;
        if u64::from(tally.list_end) > chunk.candidates {
            let why = format!("{} candidates where {} were planned", tally.list_end, chunk.candidates);
            return Err(GpuError::Failed(why));
        }
        let n_groups = u64::from(chunk.n_own.div_ceil(GROUP));
        let groups: Vec<[u32; 4]> = values(landing.as_ref(), at, n_groups).map_err(GpuError::Failed)?.to_vec();
        let first = self.total;
        for &[vertices, triangles, bricks, _] in &groups {
            let part = self.total.map(usize::try_from);
            if let [Ok(vertex), Ok(triangle)] = part {
                self.parts.push((vertex, triangle));
            }
            self.total[0] += u64::from(vertices);
            self.total[1] += u64::from(triangles);
            self.surface_bricks += u64::from(bricks);
        }
        let end = [tally.vertices, tally.triangles].map(u64::from);
        if end != self.total.map(|n| n & u64::from(u32::MAX)) {
            return Err(GpuError::Failed(format!("the scan ends at {end:?}, the groups at {:?}", self.total)));
        }
        let [n_vertices, n_triangles] = [self.total[0] - first[0], self.total[1] - first[1]];
        Ok(Counted { groups, first, n_vertices, n_triangles })
    }

    /// Refuses what the limits do not allow; `least` triangles are taken as there: the last chunk tells whether there is
    /// a surface at all.
    pub(super) fn within_limits(&self, least: u64) -> Result<(), GpuError> {
        let job = &self.loaded.job.prepared;
        check_totals(&job.lattice, &job.params, &job.limits, self.total[0], self.total[1].max(least))?;
        Ok(())
    }

    /// Refuses an empty mesh.
    ///
    /// # Errors
    /// [`GpuError::Surface`].
    pub(super) fn complete(&self) -> Result<(), GpuError> {
        self.within_limits(0)
    }

    /// Takes the counters of a finished output.
    pub(super) fn note_flat(&mut self, landing: &Landing) -> Result<(), GpuError> {
        self.flat |= tally(landing)?.flat > 0;
        Ok(())
    }

    /// The mesh.
    ///
    /// # Errors
    /// [`GpuError::Failed`] where a column is not where it should be.
    pub(super) fn finish(&mut self) -> Result<Finished, GpuError> {
        let mut finished = self.assemble()?;
        if self.flat {
            finished.meshed.mesh.fill_flat_normals();
        }
        Ok(finished)
    }

    /// The mesh as the device made it, or its part: where the gradient vanishes, normals are zero.
    ///
    /// # Errors
    /// As [`Self::finish`].
    pub(super) fn assemble(&mut self) -> Result<Finished, GpuError> {
        let (plan, lattice) = (&self.loaded.job.prepared.plan, &self.loaded.job.prepared.lattice);
        let (params, parts) = (&self.loaded.job.prepared.params, std::mem::take(&mut self.parts));
        let mesh = assemble::mesh(&self.vertices, &self.triangles, lattice.centre(), params, parts)
            .map_err(GpuError::Failed)?;
        let grid = GridStats {
            bricks: plan.occupied,
            surface_bricks: self.surface_bricks,
            samples: plan.occupied * layout::SAMPLES,
            box_cells: lattice.box_cells,
            candidates: plan.pairs,
        };
        let timed = self.times.iter().any(|&ns| ns > 0);
        let stages = if timed { STAGES.into_iter().zip(self.times).collect() } else { Vec::new() };
        Ok(Finished { meshed: MeshOutput::new(mesh, grid), stages })
    }
}
