//! Intermediate results of the stages of this backend, brick by brick. Tests of a device's stages use them as input and
//! as reference.

use super::bin::{Bricks, NORMAL_ONLY, SIDE, SLOTS, Tiles, slot_brick, slot_origin};
use super::classify::{self, SurfaceBrick};
use super::field::{self, BrickField, GridPointRange};
use super::write::{self, Destination};
use super::{Field, RunContext, Tile};
use crate::control::Control;
use crate::error::SurfaceError;
use crate::join::Sheet;
use crate::lattice::{BRICK, BRICK_POINTS, Lattice, LatticeAtom};
use crate::mesh::Mesh;
use crate::params::{SurfaceLimits, SurfaceParams};
use crate::sink::{MeshPart, MeshSink, SinkFailed};
use crate::sphere_union::BrickUnion;
use crate::sums::edge_shares;

/// A brick with candidates.
#[derive(Debug, Clone)]
pub struct BrickResults {
    /// Coordinates in bricks from the lattice's origin.
    pub coord: [i32; 3],
    /// Atoms that reach one of its grid points, ascending.
    pub reaching: Vec<u32>,
    /// Atoms that reach only the gap up to its neighbours' first grid points, ascending.
    pub gap_only: Vec<u32>,
    /// Bounding spheres of the arcs in reach.
    pub arcs: Vec<LatticeAtom>,
    /// Densities or distances to the surface, x fastest.
    pub field: BrickField,
    /// Grid points inside: word z, bit `8·y + x`.
    pub inside: [u64; 8],
}

/// A brick that the surface intersects.
#[derive(Debug, Clone)]
pub struct SurfaceResults {
    /// Coordinates in bricks from the lattice's origin.
    pub coord: [i32; 3],
    /// Crossing edges: word `3·z + axis`, bit `8·y + x` of the owning grid point.
    pub crossing: [u64; 24],
    /// Vertices of the brick before each word.
    pub before: [u16; 24],
    /// First vertex and triangle in the mesh.
    pub first: [u32; 2],
    /// Vertices and triangles.
    pub count: [u32; 2],
    /// Sheets.
    pub sheets: Vec<SheetResults>,
    /// Key and sheet of each vertex that other bricks use, if there are several sheets.
    pub shared: Vec<[u16; 2]>,
}

/// Sums over the triangles of a sheet, in spacings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SheetResults {
    /// Offset of the origin from the mesh's centre.
    pub origin: [i32; 3],
    /// Triangles, and vertices of the brick itself.
    pub count: [u32; 2],
    /// Neighbours that share vertices: those that own them, and those that use them.
    pub near: [u8; 2],
    /// Twice the area, then three components each of the vector, product and moment.
    pub sums: [f64; 10],
}

impl SheetResults {
    fn new(sheet: &Sheet) -> Self {
        let Sheet { origin, triangles, vertices, above, below, area, vector, product, moment } = *sheet;
        let [[x, y, z], [px, py, pz], [mx, my, mz]] = [vector, product, moment];
        let sums = [area, x, y, z, px, py, pz, mx, my, mz];
        Self { origin, count: [triangles, vertices], near: [above, below], sums }
    }
}

/// Sink that discards all rows.
struct Discard;

impl MeshSink for Discard {
    fn begin(&self, _: usize, _: usize) -> Result<(), SinkFailed> {
        Ok(())
    }

    fn part(&self, _: &MeshPart<'_>) -> Result<(), SinkFailed> {
        Ok(())
    }
}

/// Returns the checksum of the directed edges of `triangles`.
#[must_use]
pub fn checksum(triangles: &[[u32; 3]]) -> u64 {
    edge_shares(triangles).0
}

/// Intermediate results of all stages.
#[derive(Debug, Clone)]
pub struct StageResults {
    /// Bricks with candidates, tile by tile.
    pub bricks: Vec<BrickResults>,
    /// Bricks with surface, in the order of the mesh.
    pub surface: Vec<SurfaceResults>,
    /// The mesh.
    pub mesh: Mesh,
    /// Parameter of each vertex along its edge.
    pub t: Vec<f32>,
}

/// Runs every stage and keeps the intermediate results.
///
/// # Errors
/// Any [`SurfaceError`].
pub fn run_stages(
    lattice: &Lattice,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
) -> Result<StageResults, SurfaceError> {
    let control = Control::default();
    let tiles = Tiles::new(lattice, limits, &control)?;
    let context = RunContext { params, limits, control: &control, free_threads: 1 };
    let field = Field::new(lattice, context)?;
    let iso = field.level(params);
    let bounds = field.bounds().map_or(&[][..], |bounds| &bounds.atoms[..]);
    let (mut arcs, mut union) = (Bricks::default(), BrickUnion::default());
    let mut bricks = Vec::new();
    for t in 0..tiles.len() {
        let mut tile = Bricks::default();
        tile.fill(lattice, tiles.coords[t], &(0..SIDE - 1), tiles.atoms(t), |_| Ok(()))?;
        if let Field::Distance(distance) = &field {
            distance.fill_arcs(&mut arcs, tiles.coords[t], &(0..SIDE - 1), |_| Ok(()))?;
        }
        for slot in (0..SLOTS).filter(|&slot| slot_brick(slot).iter().all(|&b| b < 8) && !tile.of(slot).is_empty()) {
            let origin = slot_origin(tiles.coords[t], slot);
            let mut values = [0.0; BRICK_POINTS];
            let whole = GridPointRange { y_pairs: 4, z_layers: 8 };
            match &field {
                Field::Density(constants) => {
                    field::evaluate(constants, &lattice.atoms, tile.of(slot), origin, whole, &mut values);
                }
                Field::Distance(distance) => {
                    distance.load(&mut union, &lattice.atoms, tile.of(slot), arcs.of(slot), origin);
                    distance.evaluate(&mut union, whole, &mut values);
                }
            }
            let (gap_only, reaching) = tile.of(slot).iter().partition::<Vec<u32>, _>(|&c| c & NORMAL_ONLY != 0);
            bricks.push(BrickResults {
                coord: origin.map(|c| c.div_euclid(BRICK)),
                reaching,
                gap_only: gap_only.iter().map(|c| c & !NORMAL_ONLY).collect(),
                arcs: arcs.of(slot).iter().map(|i| bounds[(i & !NORMAL_ONLY) as usize]).collect(),
                inside: classify::inside_bits(&values, iso),
                field: values,
            });
        }
    }
    let mesh = write::write(super::scan_lattice(lattice.clone(), context)?, context, &control, None)?.mesh;
    let mut scanned = super::scan_lattice(lattice.clone(), context)?;
    let mut surface: Vec<SurfaceResults> = scanned.done.iter().flat_map(surface_of).collect();
    let written = write::write_pieces(&mut scanned, &control, &Destination::Sink(&Discard))?;
    let runs = written.sums.iter().flat_map(|sums| (0..sums.bricks.len()).map(move |ix| (sums, ix)));
    for (result, (sums, ix)) in surface.iter_mut().zip(runs) {
        let brick = &sums.bricks[ix];
        let sheets = &sums.sheets[brick.first as usize..][..usize::from(brick.n)];
        result.sheets = sheets.iter().map(SheetResults::new).collect();
        result.shared = sums.shared_by(ix)[0].iter().map(|vertex| [vertex.key, vertex.sheet]).collect();
    }
    let t = scanned.done.into_iter().flat_map(|tile| tile.found.t).collect();
    Ok(StageResults { bricks, surface, mesh, t })
}

fn surface_of(tile: &Tile) -> Vec<SurfaceResults> {
    let found = &tile.found;
    let ends = found.bricks.iter().skip(1).map(|b| [b.vertex, b.triangle]).chain([[found.vertices, found.triangles]]);
    let first = |v: usize, of_brick: u32| u32::try_from(v).unwrap_or(u32::MAX) + of_brick;
    let result = |(brick, end): (&SurfaceBrick, [u32; 2])| SurfaceResults {
        coord: slot_origin(tile.coord, usize::from(brick.slot)).map(|c| c.div_euclid(BRICK)),
        crossing: brick.crossing,
        before: brick.before,
        first: [first(tile.first_vertex, brick.vertex), first(tile.first_triangle, brick.triangle)],
        count: [end[0] - brick.vertex, end[1] - brick.triangle],
        sheets: Vec::new(),
        shared: Vec::new(),
    };
    found.bricks.iter().zip(ends).map(result).collect()
}
