//! Boundary of a union of spheres in the layout of the shaders, with its arcs assigned to the bricks of a plan.

use super::{Plan, first_of_bricks};
use crate::surface::lattice::{BRICK, Lattice, LatticeAtom, tile_of, tile_order, to_u32};
use crate::surface::occupancy::Occupancy;
use crate::surface::sphere_union::SphereUnion;
use crate::surface::{Control, SurfaceError, SurfaceLimits, checked_sort};

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
    /// Rows of the boundary, as `shaders/shared/sphere_union.wgsl` describes them.
    pub rows: Vec<[u32; 4]>,
    /// Number of ordered pairs of overlapping spheres.
    pub n_overlaps: u64,
}

impl Arcs {
    /// Prepares the arcs of `union`, given with their bounding spheres, and adds their candidates to those of `plan`.
    ///
    /// # Errors
    /// Those of [`Occupancy::new`].
    pub(crate) fn new(
        union: &SphereUnion,
        bounds: &[LatticeAtom],
        lattice: &Lattice,
        plan: &mut Plan,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let n_atoms = plan.n_atoms();
        let n_caps: usize = (0..n_atoms).filter_map(|i| union.caps(i)).map(Iterator::count).sum();
        let n_rows = n_atoms + 5 * bounds.len() + n_caps;
        let per_arc = size_of::<LatticeAtom>() + size_of::<f32>() + size_of::<u32>();
        let bytes = per_arc * bounds.len() + size_of::<[u32; 4]>() * n_rows + size_of::<u32>() * plan.bricks.len();
        control.memory.grow(bytes as u64)?;
        let mut order: Vec<u32> = (0..to_u32(bounds.len())).collect();
        let key = |i: &u32| brick_order(&bounds[*i as usize]);
        checked_sort::sort(&mut order, |a, b| key(a).cmp(&key(b)).then(a.cmp(b)), control)?;
        let sorted: Vec<LatticeAtom> = order.iter().map(|i| bounds[*i as usize]).collect();
        let sorted = Lattice { atoms: sorted.into(), ..lattice.clone() };
        let occupancy = Occupancy::new(&sorted, limits, control)?;
        let mut counted = occupancy.tiles.iter().peekable();
        for (tile, candidates) in plan.tiles.iter().zip(&mut plan.candidates) {
            while counted.next_if(|other| tile_order(other.tile) < tile_order(tile.coord)).is_some() {}
            *candidates += counted.next_if(|other| other.tile == tile.coord).map_or(0, |other| other.candidates);
        }
        let first = first_of_bricks(&plan.tiles, &plan.bricks, &occupancy.atom_bricks, to_u32(n_atoms));
        debug_assert_eq!(first.last().map(|end| *end as usize), Some(n_atoms + bounds.len()), "every arc has a brick");
        Ok(Self {
            rows: rows(union, n_atoms, &order),
            bounds: sorted.atoms.to_vec(),
            max_reach: occupancy.max_reach,
            reaches: occupancy.reaches,
            first,
            n_overlaps: union.n_overlaps,
        })
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

/// Returns the sort key of the tile and the brick of an atom.
fn brick_order(atom: &LatticeAtom) -> ([i32; 3], [i32; 3]) {
    let [x, y, z] = atom.cell.map(|c| c.div_euclid(BRICK));
    (tile_order(tile_of(atom.cell)), [z, y, x])
}

/// Returns the rows of the boundary, with the arcs in the given order.
fn rows(union: &SphereUnion, n_atoms: usize, order: &[u32]) -> Vec<[u32; 4]> {
    let n_heads = n_atoms + order.len();
    let mut rows = vec![[0; 4]; n_heads];
    for i in 0..n_atoms {
        let first = to_u32(rows.len());
        let caps = union.caps(i);
        let head = if caps.is_some() { first } else { COVERED };
        rows.extend(caps.into_iter().flatten().map(|row| row.map(f32::to_bits)));
        rows[i] = [head, to_u32(rows.len()), 0, 0];
    }
    for (i, arc) in (n_atoms..).zip(order) {
        rows[i] = [to_u32(rows.len()), 0, 0, 0];
        rows.extend(union.arc(*arc).rows().map(|row| row.map(f32::to_bits)));
    }
    rows
}
