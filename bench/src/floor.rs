//! Lower bound of the time of a stage on a device: the longer of memory traffic and arithmetic at the measured rates.
//!
//! Each byte counts once, as with perfect caches. Arithmetic counts only the pairs of a grid point and an atom in
//! bricks that the atom reaches.
//!
//! | stage | reads | writes | arithmetic |
//! |---|---|---|---|
//! | bin | 36 B per atom, 212 B per tile, 8 B per brick | 4 B per list entry, 16 B per brick | – |
//! | field | the lists, 32 B per atom | 2 KiB per brick | 2 multiply-adds per pair of grid point and atom |
//! | classify | 2 KiB per brick | 292 B per brick | – |
//! | scan | 4 B per brick | 8 B per brick | – |
//! | refine | 2 KiB, 64 B and the lists of a brick with surface, 32 B per atom | 4 B per vertex | 10 per vertex and atom that reaches the vertex's brick |
//! | interpolate | 2 KiB, 248 B, 4 B per vertex and the lists of a brick with surface, 32 B per atom | 24 B per vertex, quantized 12 B | 10 per vertex and atom that reaches the vertex's brick |
//! | emit | 300 B per brick with surface | 12 B per triangle | – |
//! | measure | 96 B per brick with surface, 4 B per vertex | 68 B per brick with surface | – |

use molmesh::gpu::Prepared;
use molmesh::surface::{MeshOutput, Stage};

use crate::rates::Rates;

/// Minimum work of a stage.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Work {
    /// Bytes read and written.
    pub(crate) bytes: f64,
    /// Number of multiply-adds.
    pub(crate) fmas: f64,
}

impl Work {
    /// Computes the work of `stage` in a finished job.
    pub(crate) fn of(stage: Stage, job: &Prepared, meshed: &MeshOutput) -> Self {
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
            Stage::Refine | Stage::Interpolate => {
                let lists = 4.0 * entries * surface / bricks.max(1.0);
                let (brick, vertex) = match stage {
                    Stage::Refine => (2048.0 + 64.0, 4.0),
                    _ if meshed.mesh.quantized.is_some() => (2048.0 + 248.0, 4.0 + 12.0),
                    _ => (2048.0 + 248.0, 4.0 + 24.0),
                };
                let reach = pairs / job.plan.n_reached.max(1) as f64;
                (brick * surface + lists + 32.0 * atoms + vertex * vertices, 10.0 * vertices * reach)
            }
            Stage::Emit => (300.0 * surface + 12.0 * triangles, 0.0),
            Stage::Measure => ((64.0 + 32.0 + 68.0) * surface + 4.0 * vertices, 0.0),
            Stage::Write | Stage::Improve => (0.0, 0.0),
        };
        Self { bytes, fmas }
    }

    /// Returns the lower bound of the time, s.
    pub(crate) fn seconds(self, rates: &Rates) -> f64 {
        (self.bytes / rates.memory).max(self.fmas / rates.fma)
    }
}
