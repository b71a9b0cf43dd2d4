//! Plan of a device's job, computed on the host without a device: tiles, bricks, their atoms, and how the bricks are
//! cut into chunks that fit a device and partitions for several devices.
//!
//! Bricks are numbered by tile (z, y, x) and within a tile by `64·z + 8·y + x`. Atoms have the same order, so the atoms
//! of a run of bricks are one range.

pub mod arcs;
pub mod chunk;
pub mod layout;
pub mod partition;

use molmesh_surface::cpu::distance;
use molmesh_surface::cpu::field::Constants;
use molmesh_surface::kernel::Shape;
use molmesh_surface::lattice::{BRICK, BRICK_POINTS, Lattice, tile_order, to_f32, to_u32, to_u64};
use molmesh_surface::limit::{Exceeded, Limit, slightly_coarser};
use molmesh_surface::occupancy::{AtomBrick, BrickBits, Occupancy, TileOccupancy, count_ones};
use molmesh_surface::{Control, Step, SurfaceError, SurfaceLimits, SurfaceParams};
use rayon::prelude::*;

pub use self::arcs::Arcs;
pub use self::chunk::{Chunk, ChunkLimits};
use self::layout::{NONE, Params, Tile, halves};
pub use self::partition::Partition;

/// Bricks of a job.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// Tiles with bricks, in order.
    pub tiles: Vec<Tile>,
    /// Per brick: its tile, shifted by 9 bits, and its index within the tile.
    pub bricks: Vec<u32>,
    /// Per brick: its first atom. The last entry is the number of atoms.
    pub first_atoms: Vec<u32>,
    /// Per atom: its reach in spacings, with slack for rounding.
    pub reaches: Vec<f32>,
    /// Per tile: number of entries in the candidate lists of its bricks.
    pub candidates: Vec<u64>,
    /// Number of bricks with a grid point in reach of an atom.
    pub n_reached: u64,
    /// Number of pairs of such a brick and an atom that reaches one of its grid points.
    pub pairs: u64,
    /// Maximum of `reaches`.
    pub max_reach: f32,
    /// Arcs of the boundary; empty unless the surface needs them.
    pub arcs: Arcs,
}

impl Plan {
    /// Plans the bricks of `lattice`.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`] before memory is allocated beyond the limits, [`SurfaceError::Cancelled`].
    pub fn new(lattice: &Lattice, limits: &SurfaceLimits, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let occupancy = Occupancy::new(lattice, limits, control)?;
        let (bases, n_bricks) = tile_bases(&occupancy.tiles).ok_or_else(|| too_many_bricks(lattice.spacing))?;
        let occupied = &occupancy.tiles;
        let per_tile = size_of::<Tile>() + size_of::<u32>() + size_of::<u64>();
        let rows = per_tile * occupied.len() + 2 * size_of::<u32>() * (n_bricks + 1);
        control.memory.grow((rows + size_of::<f32>() * occupancy.reaches.len()) as u64)?;
        let tiles: Vec<Tile> = occupied.par_iter().zip(&bases).map(|(own, &base)| tile(occupied, own, base)).collect();
        let bricks = list_bricks(&occupancy, n_bricks);
        let first_atoms = first_of_bricks(&tiles, &bricks, &occupancy.atom_bricks, 0);
        Ok(Self {
            tiles,
            bricks,
            first_atoms,
            candidates: occupied.iter().map(|tile| tile.candidates).collect(),
            n_reached: occupancy.n_reached(),
            pairs: occupancy.n_pairs(),
            max_reach: occupancy.max_reach,
            reaches: occupancy.reaches,
            arcs: Arcs::default(),
        })
    }

    /// Number of atoms.
    #[must_use]
    pub fn n_atoms(&self) -> usize {
        self.reaches.len()
    }

    /// Number of candidate lists per brick: 2 with a boundary, for atoms and arcs, else 1. A boundary without arcs also
    /// has two, because its caps are needed.
    #[must_use]
    pub fn n_kinds(&self) -> u32 {
        if self.arcs.first.is_empty() { 1 } else { 2 }
    }

    /// First brick of tile `t`, or the number of bricks if `t` is the number of tiles.
    fn tile_start(&self, t: usize) -> u32 {
        self.tiles.get(t).map_or(to_u32(self.bricks.len()), |tile| tile.base)
    }

    /// Parameters that all dispatches of the job have in common.
    #[must_use]
    pub fn params(&self, lattice: &Lattice, params: &SurfaceParams) -> Params {
        // An atom lies at most half a spacing before the grid points of its brick, an arc at most a spacing behind.
        let bricks = |reach: f32| u32::try_from(to_u64(f64::from(reach) / f64::from(BRICK))).unwrap_or(u32::MAX);
        let of_field = match &lattice.shape {
            Shape::Density(profile) => density_params(&Constants::new(profile, lattice.spacing), params),
            Shape::Sphere { .. } => distance_params(lattice, params),
        };
        Params {
            centre: lattice.centre,
            spacing: to_f32(lattice.spacing),
            reach: self.max_reach,
            back: bricks(self.max_reach + 8.01),
            ahead: bricks(self.max_reach + 8.51),
            arc_reach: self.arcs.max_reach,
            arc_back: bricks(self.arcs.max_reach + 8.01),
            arc_ahead: bricks(self.arcs.max_reach + 8.51),
            n_kinds: self.n_kinds(),
            n_tiles: to_u32(self.tiles.len()),
            n_bricks: to_u32(self.bricks.len()),
            steps_per_angstrom: params.quantize.map_or(0.0, Step::per_angstrom),
            ..of_field
        }
    }
}

/// Parameters of an isosurface; all others are 0.
fn density_params(field: &Constants, params: &SurfaceParams) -> Params {
    Params {
        isovalue: to_f32(params.isovalue),
        support: field.support,
        share: field.share,
        rate: field.rate,
        tail_share: field.tail_share,
        tail_rate: field.tail_rate,
        tail_end: field.tail_end,
        amplitude: field.amplitude,
        u_min: field.u_min,
        slope_offset: field.slope_offset,
        slope_tail: field.slope_tail,
        slope_scale: field.slope_amplitude,
        ..bytemuck::Zeroable::zeroed()
    }
}

/// Parameters of a surface of spheres; all others are 0.
fn distance_params(lattice: &Lattice, params: &SurfaceParams) -> Params {
    Params {
        isovalue: distance::SURFACE,
        support: 1.0,
        level: to_f32(distance::level(lattice, params)),
        tolerance: distance::tolerance(lattice),
        ..bytemuck::Zeroable::zeroed()
    }
}

/// Returns the error of a grid with more tiles or bricks than the shaders can number. No configured limit changes that.
fn too_many_bricks(spacing: f64) -> SurfaceError {
    let max = u64::from(u32::MAX) * BRICK_POINTS as u64;
    let error = Exceeded {
        actual: Some(max + BRICK_POINTS as u64),
        is_fixed: true,
        hint: Some("the backend cpu".into()),
        resolution: Some(spacing),
        ..Exceeded::new(Limit::GridPoints, max)
    };
    error.suggest(slightly_coarser(spacing)).error()
}

/// First brick of each tile, and the number of bricks. `None` if there are more tiles or bricks than the shaders can
/// number.
fn tile_bases(tiles: &[TileOccupancy]) -> Option<(Vec<u32>, usize)> {
    if tiles.len() >= 1 << 23 {
        return None;
    }
    let mut next = 0_u32;
    let mut bases = Vec::with_capacity(tiles.len());
    for tile in tiles {
        bases.push(next);
        next = next.checked_add(u32::try_from(count_ones(&tile.occupied)).ok()?)?;
    }
    Some((bases, next as usize))
}

/// Entry of the tile table for `own`, whose first brick is `base`.
fn tile(tiles: &[TileOccupancy], own: &TileOccupancy, base: u32) -> Tile {
    let mut tile = Tile { coord: own.tile, base, bricks: [[0; 2]; 8], before: [0; 8], around: [NONE; 28] };
    let mut before = 0;
    for (z, word) in own.occupied.iter().enumerate() {
        tile.bricks[z] = halves(*word);
        tile.before[z] = before;
        before += word.count_ones();
    }
    for (row, entries) in (0_i32..9).zip(tile.around.chunks_exact_mut(3)) {
        // The tiles of a row along x are adjacent in tile order.
        let first = [own.tile[0] - 1, own.tile[1] + row % 3 - 1, own.tile[2] + row / 3 - 1];
        let at = tiles.partition_point(|tile| tile_order(tile.tile) < tile_order(first));
        for (t, neighbour) in (at..).zip(tiles[at..].iter().take(3)) {
            let step = neighbour.tile[0].abs_diff(first[0]) as usize;
            if neighbour.tile[1..] == first[1..] && step < 3 {
                entries[step] = to_u32(t);
            }
        }
    }
    tile
}

/// Column [`Plan::bricks`].
fn list_bricks(occupancy: &Occupancy, n_bricks: usize) -> Vec<u32> {
    let mut bricks = Vec::with_capacity(n_bricks);
    for (t, own) in (0..).zip(&occupancy.tiles) {
        bricks.extend(set_bits(&own.occupied).map(|local| t << 9 | local));
    }
    bricks
}

/// First atom of each brick, counted from `at`, and the end of the last one. Requires that `bricks` contains every
/// brick of `atom_bricks`: a brick that holds an atom is occupied.
fn first_of_bricks(tiles: &[Tile], bricks: &[u32], atom_bricks: &[AtomBrick], mut at: u32) -> Vec<u32> {
    let mut first = Vec::with_capacity(bricks.len() + 1);
    let mut atom_bricks = atom_bricks.iter().peekable();
    for brick in bricks {
        first.push(at);
        let (tile, local) = (tiles[(brick >> 9) as usize].coord, brick & 511);
        while let Some(brick) = atom_bricks.next_if(|brick| brick.local == local && brick.tile == tile) {
            at += brick.n_atoms;
        }
    }
    first.push(at);
    first
}

/// Positions of the set bits, ascending.
fn set_bits(bits: &BrickBits) -> impl Iterator<Item = u32> + '_ {
    (0_u32..).zip(bits).flat_map(|(z, &word)| {
        let mut rest = word;
        std::iter::from_fn(move || {
            let bit = (rest != 0).then(|| rest.trailing_zeros());
            rest &= rest.wrapping_sub(1);
            bit.map(|bit| z << 6 | bit)
        })
    })
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use molmesh_surface::lattice::LatticeAtom;
    use molmesh_surface::{Spheres, SurfaceOptions};

    use super::*;

    fn lattice(n: u32, side: f64, resolution: f64) -> Lattice {
        let mut state = 3_u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        };
        let mut column = || (0..n).map(|_| side * (next() - 0.5)).collect::<Vec<_>>();
        let (x, y, z) = (column(), column(), column());
        let radii = (0..n).map(|i| 1.2 + 0.1 * (i % 7) as f32).collect();
        let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
        let (spheres, params) = (Spheres::new(x, y, z, radii).unwrap(), SurfaceParams::new(&options).unwrap());
        Lattice::new(&spheres, &params, &Control::default()).unwrap()
    }

    fn plan(lattice: &Lattice) -> Plan {
        Plan::new(lattice, &SurfaceLimits::default(), &Control::default()).unwrap()
    }

    /// Coordinates of each brick, in bricks.
    fn coords(plan: &Plan) -> Vec<[i32; 3]> {
        let coords = |&b: &u32| {
            let local = [0, 3, 6].map(|shift| i32::try_from(b >> shift & 7).unwrap());
            let tile = plan.tiles[(b >> 9) as usize].coord;
            std::array::from_fn(|k| 8 * tile[k] + local[k])
        };
        plan.bricks.iter().map(coords).collect()
    }

    #[test]
    fn bricks_are_in_order_and_hold_their_atoms() {
        // From bricks much larger than atoms, some of which reach no grid point, to much smaller bricks.
        for resolution in [20.0, 3.0, 0.5, 0.15, 0.066, 0.0655, 0.05] {
            let lattice = lattice(200, 60.0, resolution);
            let plan = plan(&lattice);
            assert!(plan.bricks.windows(2).all(|pair| pair[0] < pair[1]));
            assert!(plan.tiles.windows(2).all(|pair| tile_order(pair[0].coord) < tile_order(pair[1].coord)));
            let coords = coords(&plan);
            let mut seen = 0;
            for (i, brick) in coords.iter().enumerate() {
                let [from, to] = [plan.first_atoms[i], plan.first_atoms[i + 1]];
                assert_eq!(from, seen);
                seen = to;
                for atom in &lattice.atoms[from as usize..to as usize] {
                    assert_eq!(atom.cell.map(|c| c.div_euclid(BRICK)), *brick);
                }
            }
            assert_eq!(seen, 200);
        }
    }

    #[test]
    fn bricks_exist_exactly_where_an_atom_is_in_reach() {
        let lattice = lattice(60, 25.0, 0.6);
        let plan = plan(&lattice);
        let exists: HashMap<[i32; 3], usize> = coords(&plan).into_iter().zip(0..).collect();
        let (mut there, mut pairs) = (0, 0);
        for z in -8..8 {
            for y in -8..8 {
                for x in -8..8 {
                    // In double precision, with the slack of the reaches and with a little less.
                    let near = |beyond: f64, slack: f64| {
                        let gap = |c: f64, b: i32| {
                            let lo = f64::from(b * BRICK);
                            (lo - c).max(c - lo - beyond).max(0.0)
                        };
                        let reaches = |atom: &&LatticeAtom| {
                            let d = [gap(atom.position(0), x), gap(atom.position(1), y), gap(atom.position(2), z)];
                            d.iter().map(|d| d * d).sum::<f64>().sqrt() <= lattice.reach(atom) + slack
                        };
                        lattice.atoms.iter().filter(reaches).count()
                    };
                    let found = exists.contains_key(&[x, y, z]);
                    assert!(near(8.0, 0.0) == 0 || found, "{x} {y} {z} is missing");
                    assert!(near(8.0, 2e-3) > 0 || !found, "{x} {y} {z} is too many");
                    there += usize::from(found);
                    pairs += near(7.0, 1e-3);
                }
            }
        }
        assert_eq!((there, there > 100), (plan.bricks.len(), true));
        assert!(pairs.abs_diff(usize::try_from(plan.pairs).unwrap()) <= 2, "{pairs} {}", plan.pairs);
    }

    #[test]
    fn a_grid_beyond_the_limit_is_rejected_with_a_spacing_that_fits() {
        let lattice = lattice(300, 80.0, 0.5);
        let grid_points = plan(&lattice).n_reached * 512;
        let with = |max_grid_points| {
            Plan::new(&lattice, &SurfaceLimits { max_grid_points, ..SurfaceLimits::default() }, &Control::default())
        };
        assert!(with(grid_points).is_ok());
        let error = with(grid_points - 1).err().unwrap();
        let exceeded = error.exceeded(Limit::GridPoints).unwrap();
        assert_eq!((exceeded.actual, exceeded.max), (Some(grid_points), grid_points - 1));
        assert!(exceeded.suggested_resolution.unwrap() >= 0.5);
        let control = Control::default();
        control.cancel.cancel();
        assert_eq!(Plan::new(&lattice, &SurfaceLimits::default(), &control).err(), Some(SurfaceError::Cancelled));
    }
}
