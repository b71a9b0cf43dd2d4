//! The least time that a stage can take on a device: the bytes that it must move over the measured rate of memory, or
//! its arithmetic over the measured rate of multiply-adds, whichever takes longer.
//!
//! Every byte counts once, as if caches were perfect: a buffer that many workgroups read is read once. Arithmetic is
//! counted for the pairs that matter alone: sample and atom in bricks that the atom reaches.
//!
//! | stage | reads | writes | arithmetic |
//! |---|---|---|---|
//! | bin | 36 B an atom, 212 B a tile, 8 B a brick | 4 B a list entry, 16 B a brick | – |
//! | field | the lists, 32 B an atom | 2 KiB a brick | 2 multiply-adds a pair of sample and atom |
//! | classify | 2 KiB a brick | 292 B a brick | – |
//! | scan | 4 B a brick | 8 B a brick | – |
//! | interpolate | 2 KiB, 248 B and the lists of a brick with surface, 32 B an atom | 24 B a vertex, 12 B a rounded one | 10 an atom that reaches a vertex's brick |
//! | emit | 300 B a brick with surface | 12 B a triangle | – |

use molmesh::gpu::Prepared;
use molmesh::gpu::yardstick::Rates;
use molmesh::surface::{MeshOutput, Stage};

/// What a stage must do at least.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Work {
    pub(super) bytes: f64,
    /// Multiply-adds.
    pub(super) fmas: f64,
}

impl Work {
    /// Of `stage` in a job.
    pub(super) fn of(stage: Stage, job: &Prepared, meshed: &MeshOutput) -> Self {
        let atoms = job.lattice.atoms.len() as f64;
        let (bricks, tiles) = (job.plan.bricks.len() as f64, job.plan.tiles.len() as f64);
        let entries = job.plan.candidates.iter().sum::<u64>() as f64;
        let surface = meshed.grid.surface_bricks as f64;
        let pairs = job.plan.pairs as f64;
        let (vertices, triangles) = (meshed.mesh.n_vertices() as f64, meshed.mesh.n_triangles() as f64);
        let (bytes, fmas) = match stage {
            Stage::Bin => (36.0 * atoms + 212.0 * tiles + 24.0 * bricks + 4.0 * entries, 0.0),
            Stage::Field => (4.0 * entries + 32.0 * atoms + 2048.0 * bricks, 2.0 * 512.0 * pairs),
            Stage::Classify => ((2048.0 + 292.0) * bricks, 0.0),
            Stage::Scan => (12.0 * bricks, 0.0),
            Stage::Interpolate => {
                let lists = 4.0 * entries * surface / bricks.max(1.0);
                let each = if meshed.mesh.quantized.is_some() { 12.0 } else { 24.0 };
                let reach = pairs / job.plan.occupied.max(1) as f64;
                ((2048.0 + 248.0) * surface + lists + 32.0 * atoms + each * vertices, 10.0 * vertices * reach)
            }
            Stage::Emit => (300.0 * surface + 12.0 * triangles, 0.0),
            Stage::Write | Stage::Measure => (0.0, 0.0),
        };
        Self { bytes, fmas }
    }

    /// Seconds at least.
    pub(super) fn seconds(self, rates: &Rates) -> f64 {
        (self.bytes / rates.memory).max(self.fmas / rates.fma)
    }
}
