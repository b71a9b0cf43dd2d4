//! Vertices of the current brick by grid edge, for the creation of its triangles.

use glam::Vec3A;

use super::edge::{self, EDGES, Edge};
use super::interpolate::position;
use super::neighbours::{NeighbourVertex, NumberedBrick, far, shared_vertices};
use super::sheets::NONE;
use crate::cases::MAX_TRIANGLES;
use crate::lattice::{BRICK_POINTS, to_f32};
use crate::quantize::Step;

/// Capacity for the corners of a brick's triangles: five triangles per cell, and the padding of a cell's row.
const CORNERS: usize = 512 * 3 * MAX_TRIANGLES + ROW;
/// Number of corners that every cell writes: whole vectors. The next cell overwrites those beyond the cell's triangles.
pub(super) const ROW: usize = 16;

/// Vertices of the current brick by grid edge, `3·((z·9 + y)·9 + x) + axis`, and its triangles. Entries of edges that
/// do not cross are stale. Reused from brick to brick.
pub(super) struct BrickTable {
    /// Global vertex ids.
    pub(super) ids: Box<[u32; EDGES]>,
    /// Positions in spacings from the brick's first grid point.
    at: Box<[Vec3A; EDGES]>,
    /// Sheet of a vertex, before sheets that meet are united.
    pub(super) sheet: Box<[u16; EDGES]>,
    /// Sheet of each cell of the brick, if there are several and they are known.
    cells: Box<[u16; BRICK_POINTS]>,
    /// Corners of the triangles as grid edges.
    pub(super) corners: Box<[u16; CORNERS]>,
    /// Triangles.
    pub(super) triangles: usize,
    /// Neighbours that hold vertices of the brick's triangles: bit n for neighbour n.
    pub(super) shared: u8,
}

/// Allocates a table on the heap, without a copy on the stack.
fn boxed<T: Copy>(value: T) -> Box<[T; EDGES]> {
    match vec![value; EDGES].into_boxed_slice().try_into() {
        Ok(table) => table,
        Err(_) => unreachable!("it has just this length"),
    }
}

impl Default for BrickTable {
    fn default() -> Self {
        Self {
            ids: boxed(0),
            at: boxed(Vec3A::ZERO),
            sheet: boxed(0),
            cells: Box::new([0; BRICK_POINTS]),
            corners: Box::new([0; CORNERS]),
            triangles: 0,
            shared: 0,
        }
    }
}

/// Coordinates of grid points within a layer, by bit.
static LAYER: [Vec3A; 64] = {
    let mut table = [Vec3A::ZERO; 64];
    let mut bit = 0_u8;
    while bit < 64 {
        table[bit as usize] = Vec3A::new((bit & 7) as f32, (bit >> 3) as f32, 0.0);
        bit += 1;
    }
    table
};

/// Offsets of layers along z.
static LAYERS: [Vec3A; 8] = {
    let mut table = [Vec3A::ZERO; 8];
    let mut z = 0_u8;
    while z < 8 {
        table[z as usize] = Vec3A::new(0.0, 0.0, z as f32);
        z += 1;
    }
    table
};

/// Directions by axis; the last one is zero.
static ALONG: [Vec3A; 4] = [Vec3A::X, Vec3A::Y, Vec3A::Z, Vec3A::ZERO];

/// Returns a vertex's position in its own brick, in spacings from the first grid point of that brick.
#[inline(always)]
fn in_own_brick(edge: Edge, t: f32) -> Vec3A {
    corner(edge) + along(edge, t)
}

#[inline(always)]
fn corner(edge: Edge) -> Vec3A {
    LAYER[edge.grid_point() % 64] + LAYERS[edge.grid_point() / 64]
}

#[inline(always)]
fn along(edge: Edge, t: f32) -> Vec3A {
    ALONG[usize::from(edge.axis())] * t
}

impl BrickTable {
    /// Enters a vertex.
    #[inline(always)]
    fn put(&mut self, index: usize, id: u32, at: Vec3A) {
        let index = index % EDGES;
        self.ids[index] = id;
        self.at[index] = at;
        self.sheet[index] = NONE;
    }

    /// Enters all vertices that the brick's cells use.
    #[inline(always)]
    pub(super) fn fill(&mut self, around: &[Option<NumberedBrick<'_>>; 8]) {
        if let Some(own) = &around[0] {
            for ((edge, t), id) in own.edges.iter().zip(own.t).zip(own.first..) {
                self.put(edge.index(), id, in_own_brick(*edge, *t));
            }
        }
        self.shared = 0;
        for (n, near) in around.iter().enumerate().skip(1) {
            let Some(near) = near else { continue };
            let beyond = Vec3A::from_array(far(n).map(|k| k as f32));
            shared_vertices(near, n, |NeighbourVertex { rank, edge, index }| {
                let t = near.t.get(rank as usize).copied().unwrap_or_default();
                self.put(index, near.first + rank, (corner(edge) + beyond) + along(edge, t));
                self.shared |= 1 << n;
            });
        }
    }

    /// Puts all vertices on the sheets of their cells.
    #[inline(always)]
    pub(super) fn spread(&mut self, around: &[Option<NumberedBrick<'_>>; 8], sheets: &[[u64; 8]]) {
        for (sheet, cells) in (0..).zip(sheets) {
            for (z, word) in cells.iter().enumerate() {
                let mut left = *word;
                while left != 0 {
                    self.cells[z * 64 + left.trailing_zeros() as usize] = sheet;
                    left &= left - 1;
                }
            }
        }
        for (n, near) in around.iter().enumerate() {
            let Some(near) = near else { continue };
            if n == 0 {
                near.edges.iter().for_each(|edge| self.sheet[edge.index()] = self.cells[edge.grid_point()]);
                continue;
            }
            shared_vertices(near, n, |NeighbourVertex { index, .. }| {
                self.sheet[index] = self.cells[usize::from(edge::CELL_OF[index]) % BRICK_POINTS];
            });
        }
    }

    /// Moves the vertices of the neighbour `n` to their rounded positions.
    #[inline(always)]
    pub(super) fn round(&mut self, of: &NumberedBrick<'_>, n: usize, rounding: &Rounding) {
        let Rounding { step, spacing, offset } = *rounding;
        let far = far(n);
        // Computed as in the vertex's own brick, so that all bricks get the same position.
        let own: [f32; 3] = std::array::from_fn(|k| to_f32(offset[k] + far[k] as f64));
        let (h, length) = (to_f32(spacing), f64::from(step.length()));
        let mut put = |index: usize, edge: Edge, t: f32| {
            let steps = step.position(position(own, in_own_brick(edge, t).to_array(), h));
            // Double precision, as a large offset is subtracted.
            let at: [f32; 3] = std::array::from_fn(|k| to_f32(f64::from(steps[k]) * length / spacing - offset[k]));
            self.at[index] = Vec3A::from_array(at);
        };
        if n == 0 {
            of.edges.iter().zip(of.t).for_each(|(edge, t)| put(edge.index(), *edge, *t));
            return;
        }
        shared_vertices(of, n, |NeighbourVertex { rank, edge, index }| {
            put(index, edge, of.t.get(rank as usize).copied().unwrap_or_default());
        });
    }

    /// Corners of the brick's triangles as grid edges.
    pub(super) fn corners(&self) -> &[[u16; 3]] {
        &self.corners.as_chunks::<3>().0[..self.triangles]
    }

    /// Returns a vertex's position in spacings from the brick's first grid point.
    #[inline(always)]
    pub(super) fn position(&self, edge: u16) -> Vec3A {
        self.at[usize::from(edge) % EDGES]
    }

    /// Returns the sheet of a vertex.
    #[inline(always)]
    pub(super) fn sheet(&self, edge: u16) -> u16 {
        self.sheet[usize::from(edge) % EDGES]
    }
}

/// Rounding of vertices.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rounding {
    pub(super) step: Step,
    /// Å.
    pub(super) spacing: f64,
    /// Offset of the brick's first grid point from the mesh's centre, in spacings.
    pub(super) offset: [f64; 3],
}
