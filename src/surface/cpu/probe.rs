//! Intermediate results of the stages of this backend, brick by brick: reference and input for tests of a device's
//! stages. Meshing does not use it.

use super::bin::{Bricks, NORMAL_ONLY, SIDE, SLOTS, Tiles, slot_brick, slot_origin};
use super::classify::{self, SurfaceBrick};
use super::field::{self, Constants, SampleRange, Samples};
use super::{RunContext, Tile, write};
use crate::surface::control::Control;
use crate::surface::error::SurfaceError;
use crate::surface::lattice::{BRICK, BRICK_SAMPLES, Lattice, to_f32};
use crate::surface::mesh::Mesh;
use crate::surface::params::{SurfaceLimits, SurfaceParams};

/// A brick with candidates.
#[derive(Debug, Clone)]
pub struct ProbedBrick {
    /// Coordinates in bricks from the lattice's origin.
    pub coord: [i32; 3],
    /// Atoms that reach one of its samples, ascending.
    pub reaching: Vec<u32>,
    /// Atoms that reach only the gap up to its neighbours' first samples, ascending.
    pub gap_only: Vec<u32>,
    /// Densities, x fastest.
    pub samples: Samples,
    /// Samples inside: word z, bit `8·y + x`.
    pub inside: [u64; 8],
}

/// A brick that the surface intersects.
#[derive(Debug, Clone)]
pub struct ProbedSurface {
    /// Coordinates in bricks from the lattice's origin.
    pub coord: [i32; 3],
    /// Crossing edges: word `3·z + axis`, bit `8·y + x` of the owning sample.
    pub crossing: [u64; 24],
    /// Vertices of the brick before each word.
    pub before: [u16; 24],
    /// First vertex and triangle in the mesh.
    pub first: [u32; 2],
    /// Vertices and triangles.
    pub count: [u32; 2],
}

/// Intermediate results of all stages.
#[derive(Debug, Clone)]
pub struct Probe {
    /// Bricks with candidates, tile by tile.
    pub bricks: Vec<ProbedBrick>,
    /// Bricks with surface, in the order of the mesh.
    pub surface: Vec<ProbedSurface>,
    /// The mesh.
    pub mesh: Mesh,
}

/// Runs every stage and keeps the intermediate results.
///
/// # Errors
/// Any [`SurfaceError`].
pub fn probe(lattice: &Lattice, params: &SurfaceParams, limits: &SurfaceLimits) -> Result<Probe, SurfaceError> {
    let control = Control::default();
    let tiles = Tiles::new(lattice, limits, &control)?;
    let constants = Constants::new(&lattice.profile, lattice.spacing);
    let iso = to_f32(params.isovalue);
    let mut bricks = Vec::new();
    for t in 0..tiles.len() {
        let mut tile = Bricks::default();
        tile.fill(lattice, tiles.coords[t], &(0..SIDE - 1), tiles.atoms(t), |_| Ok(()))?;
        for slot in (0..SLOTS).filter(|&slot| slot_brick(slot).iter().all(|&b| b < 8) && !tile.of(slot).is_empty()) {
            let origin = slot_origin(tiles.coords[t], slot);
            let mut samples = [0.0; BRICK_SAMPLES];
            let whole = SampleRange { y_pairs: 4, z_layers: 8 };
            field::evaluate(&constants, &lattice.atoms, tile.of(slot), origin, whole, &mut samples);
            let (gap_only, reaching) = tile.of(slot).iter().partition::<Vec<u32>, _>(|&c| c & NORMAL_ONLY != 0);
            bricks.push(ProbedBrick {
                coord: origin.map(|c| c.div_euclid(BRICK)),
                reaching,
                gap_only: gap_only.iter().map(|c| c & !NORMAL_ONLY).collect(),
                inside: classify::inside_bits(&samples, iso),
                samples,
            });
        }
    }
    let scanned =
        super::scan_lattice(lattice.clone(), RunContext { params, limits, control: &control, free_threads: 1 })?;
    let mesh = write::write(&scanned, params.atom_ids, &control, None)?.mesh;
    Ok(Probe { bricks, surface: scanned.done.iter().flat_map(surface_of).collect(), mesh })
}

fn surface_of(tile: &Tile) -> Vec<ProbedSurface> {
    let found = &tile.found;
    let ends = found.bricks.iter().skip(1).map(|b| [b.vertex, b.triangle]).chain([[found.vertices, found.triangles]]);
    let first = |v: usize, of_brick: u32| u32::try_from(v).unwrap_or(u32::MAX) + of_brick;
    let probed = |(brick, end): (&SurfaceBrick, [u32; 2])| ProbedSurface {
        coord: slot_origin(tile.coord, usize::from(brick.slot)).map(|c| c.div_euclid(BRICK)),
        crossing: brick.crossing,
        before: brick.before,
        first: [first(tile.first_vertex, brick.vertex), first(tile.first_triangle, brick.triangle)],
        count: [end[0] - brick.vertex, end[1] - brick.triangle],
    };
    found.bricks.iter().zip(ends).map(probed).collect()
}
