//! Stage `emit`: triangle indices.
//!
//! A brick's cells use vertices of the brick itself and of its seven neighbours towards +x, +y, +z. Their ids are
//! written into a small table by grid edge first; each triangle is then three look-ups.

use std::sync::LazyLock;

use super::bin::SIDE;
use super::classify::SurfaceBrick;
use crate::surface::cases::{CASES, MAX_TRIANGLES, cell_edge};
use crate::surface::simd::dispatched;

/// Samples along a brick's edge with the neighbours' first layer.
const EDGE: usize = 9;
/// Entries of the id table: three edges per sample.
const IDS: usize = 3 * EDGE * EDGE * EDGE;

/// Vertex ids by grid edge: `3·((z·9 + y)·9 + x) + axis`. Entries of edges that do not cross are stale.
pub(super) struct IdTable([u32; IDS]);

impl Default for IdTable {
    fn default() -> Self {
        Self([0; IDS])
    }
}

/// The case table with edges as offsets into [`IdTable`] from the cell's own entry.
static OFFSETS: LazyLock<Vec<[[u16; 3]; MAX_TRIANGLES]>> = LazyLock::new(|| {
    let offset = |e: u8| {
        let edge = cell_edge(e);
        let [x, y, z] = edge.offset.map(u16::from);
        3 * ((z * 9 + y) * 9 + x) + u16::from(edge.axis)
    };
    CASES.triangles.iter().map(|row| row.map(|t| t.map(offset))).collect()
});

/// A neighbour: the brick and the global id of its first vertex.
pub(super) type Numbered<'a> = Option<(&'a SurfaceBrick, u32)>;

/// First columns and rows of a layer's word.
const X0: u64 = 0x0101_0101_0101_0101;
const Y0: u64 = 0xff;

impl IdTable {
    /// Writes the ids of the edges in `mask` of word `(z, axis)` of `brick`, shifted by `far` (0 or 8 per axis).
    #[inline(always)]
    fn put(&mut self, (brick, first): (&SurfaceBrick, u32), z: usize, axis: usize, mask: u64, far: [usize; 3]) {
        let w = 3 * z + axis;
        let word = brick.crossing[w];
        let base = first + u32::from(brick.before[w]);
        let origin = 3 * (((z + far[2]) * EDGE + far[1]) * EDGE + far[0]) + axis;
        let mut edges = word & mask;
        while edges != 0 {
            let bit = edges.trailing_zeros();
            let rank = (word & ((1 << bit) - 1)).count_ones();
            edges &= edges - 1;
            let at = origin + 3 * ((bit as usize >> 3) * EDGE + (bit as usize & 7));
            self.0[at % IDS] = base + rank;
        }
    }

    /// Writes the ids of all edges that the brick's cells use. Index bits of `around`: 0 x, 1 y, 2 z.
    #[inline(always)]
    fn fill(&mut self, around: &[Numbered<'_>; 8]) {
        // Per neighbour: the layers, the mask and the axes of the edges on the shared face, edge or corner.
        for (n, brick) in around.iter().enumerate() {
            let Some(brick) = *brick else { continue };
            let (x, y, z) = (n & 1, n >> 1 & 1, n >> 2 & 1);
            let mask = if x == 1 { X0 } else { u64::MAX } & if y == 1 { Y0 } else { u64::MAX };
            let layers = if z == 1 { 1 } else { 8 };
            let far = [8 * x, 8 * y, 8 * z];
            for layer in 0..layers {
                for axis in 0..3 {
                    // Edges that leave the shared face belong to other cells.
                    if [x, y, z][axis] == 0 {
                        self.put(brick, layer, axis, mask, far);
                    }
                }
            }
        }
    }
}

dispatched! {
/// Writes the triangles of a brick. `cases` are those of its active cells in order.
pub(super) fn emit(ids: &mut IdTable, around: &[Numbered<'_>; 8], cases: &[u8], out: &mut [[u32; 3]]) {
    ids.fill(around);
    let Some((brick, _)) = around[0] else { return };
    let (offsets, count) = (&**OFFSETS, &CASES.count);
    let mut cases = cases.iter();
    let mut out = out.iter_mut();
    for (z, &word) in brick.active.iter().enumerate() {
        let mut cells = word;
        while cells != 0 {
            let bit = cells.trailing_zeros() as usize;
            cells &= cells - 1;
            let Some(&case) = cases.next() else { return };
            let cell = 3 * ((z * EDGE + (bit >> 3)) * EDGE + (bit & 7));
            let triangles = &offsets[usize::from(case)][..usize::from(count[usize::from(case)])];
            // The table's row comes first: a zip asks its first iterator first, and must not swallow an output row.
            for (triangle, row) in triangles.iter().zip(out.by_ref()) {
                *row = triangle.map(|offset| ids.0[(cell + usize::from(offset)) % IDS]);
            }
        }
    }
}
}

/// The slot of the neighbour `n` (bits: 0 x, 1 y, 2 z) of the brick in `slot`, and whether it lies beyond the
/// tile, per axis.
pub(super) fn neighbour_slot(slot: usize, n: usize) -> (usize, [usize; 3]) {
    let brick = super::bin::slot_brick(slot);
    let moved: [usize; 3] = std::array::from_fn(|k| brick[k] + (n >> k & 1));
    let beyond = moved.map(|m| m / 8);
    let [x, y, z] = moved.map(|m| m % 8);
    ((z * SIDE + y) * SIDE + x, beyond)
}
