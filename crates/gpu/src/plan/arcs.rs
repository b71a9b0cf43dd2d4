//! Boundary of a union of spheres for the shaders, with its arcs listed by brick.

use molmesh_surface::lattice::{BRICK, Lattice, LatticeAtom, tile_of, tile_order, to_u32};
use molmesh_surface::occupancy::{self, Occupancy};
use molmesh_surface::sphere_union::SphereUnion;
use molmesh_surface::{Control, SurfaceError, SurfaceLimits, checked_sort};
use rayon::prelude::*;

use super::{Plan, first_of_bricks};

/// Marks a sphere without a face.
const COVERED: u32 = u32::MAX;

/// Arcs and caps of a boundary; empty if the surface needs none.
#[derive(Debug, Clone, Default)]
pub struct Arcs {
    /// Bounding sphere of each arc, by brick.
    pub bounds: Vec<LatticeAtom>,
    /// Per arc: its reach in spacings.
    pub reaches: Vec<f32>,
    /// Maximum of `reaches`.
    pub max_reach: f32,
    /// Per brick: its first arc, numbered behind the atoms. The last entry is the number of atoms and arcs.
    pub first: Vec<u32>,
    /// Rows of spheres and arcs, as `shaders/shared/sphere_union.wgsl` describes them. The caps follow them.
    pub rows: Vec<[u32; 4]>,
    /// Boundary, which holds the caps.
    union: SphereUnion,
}

/// Rows of a group of caps.
const GROUP_ROWS: u32 = 8;
/// Arcs or spheres per task.
const PART: usize = 1 << 12;

impl Arcs {
    /// Prepares the arcs of `union`, given with their bounding spheres, and adds their candidates to those of `plan`.
    ///
    /// # Errors
    /// Those of [`Occupancy::new`].
    pub(crate) fn new(
        union: SphereUnion,
        bounds: &[LatticeAtom],
        lattice: &Lattice,
        plan: &mut Plan,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let n_atoms = plan.n_atoms();
        let per_arc = size_of::<LatticeAtom>() + size_of::<BrickOrder>() + size_of::<f32>() + 5 * size_of::<[u32; 4]>();
        let bytes = per_arc * bounds.len() + size_of::<u32>() * plan.bricks.len() + size_of::<[u32; 4]>() * n_atoms;
        control.memory.grow(bytes as u64)?;
        let mut order: Vec<BrickOrder> = bounds.par_iter().zip(0..to_u32(bounds.len())).map(brick_order).collect();
        checked_sort::sort(&mut order, Ord::cmp, control)?;
        let sorted: Vec<LatticeAtom> = order.par_iter().map(|(.., i)| bounds[*i as usize]).collect();
        let sorted = Lattice { atoms: sorted.into(), ..lattice.clone() };
        occupancy::check_pairs(&[lattice, &sorted], limits, control)?;
        let occupancy = Occupancy::new(&sorted, limits, control)?;
        let mut counted = occupancy.tiles.iter().peekable();
        for (tile, candidates) in plan.tiles.iter().zip(&mut plan.candidates) {
            while counted.next_if(|other| tile_order(other.tile) < tile_order(tile.coord)).is_some() {}
            *candidates += counted.next_if(|other| other.tile == tile.coord).map_or(0, |other| other.candidates);
        }
        let first = first_of_bricks(&plan.tiles, &plan.bricks, &occupancy.atom_bricks, to_u32(n_atoms));
        debug_assert_eq!(first.last().map(|end| *end as usize), Some(n_atoms + bounds.len()), "every arc has a brick");
        Ok(Self {
            rows: rows(&union, n_atoms, &order),
            bounds: sorted.atoms.to_vec(),
            max_reach: occupancy.max_reach,
            reaches: occupancy.reaches,
            first,
            union,
        })
    }

    /// Returns the caps in the layout of the shaders, bytes.
    #[must_use]
    pub fn caps(&self) -> &[u8] {
        self.union.cap_bytes()
    }

    /// Returns the number of ordered pairs of overlapping spheres.
    #[must_use]
    pub fn n_overlaps(&self) -> u64 {
        self.union.n_overlaps
    }

    /// Returns the number of arcs.
    #[must_use]
    pub fn len(&self) -> usize {
        self.bounds.len()
    }

    /// Returns true if there are no arcs.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.bounds.is_empty()
    }
}

/// Sort key of an arc: its tile, its brick within the tile, and its index.
type BrickOrder = ([i32; 3], u32, u32);

fn brick_order((atom, index): (&LatticeAtom, u32)) -> BrickOrder {
    let [x, y, z] = atom.cell.map(|c| (c.div_euclid(BRICK) & 7).unsigned_abs());
    (tile_order(tile_of(atom.cell)), z << 6 | y << 3 | x, index)
}

/// Returns the rows of the spheres and of the arcs in the given order.
fn rows(union: &SphereUnion, n_atoms: usize, order: &[BrickOrder]) -> Vec<[u32; 4]> {
    let n_heads = to_u32(n_atoms + order.len());
    let first_cap = n_heads + 4 * to_u32(order.len());
    let sphere = |i: usize| match union.face(i) {
        Some(groups) => {
            let [first, end] = groups.map(|group| first_cap + GROUP_ROWS * group);
            [first, end, 0, 0]
        }
        None => [COVERED, COVERED, 0, 0],
    };
    let mut rows: Vec<[u32; 4]> = Vec::with_capacity(first_cap as usize);
    rows.par_extend((0..n_atoms).into_par_iter().with_min_len(PART).map(sphere));
    rows.par_extend((0..to_u32(order.len())).into_par_iter().with_min_len(PART).map(|i| [n_heads + 4 * i, 0, 0, 0]));
    let arc = |(.., i): &BrickOrder| union.arc(*i).rows().map(|row| row.map(f32::to_bits));
    rows.par_extend(order.par_iter().with_min_len(PART).flat_map_iter(arc));
    rows
}
