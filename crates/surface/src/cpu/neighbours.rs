//! Vertices of the neighbours towards +x, +y, +z that a brick's cells use.

use super::Tile;
use super::bin::{SIDE, Tiles, slot_brick};
use super::classify::SurfaceBrick;
use super::edge::Edge;

/// A surface brick with the numbers of its vertices.
#[derive(Clone, Copy)]
pub(super) struct NumberedBrick<'a> {
    /// The brick.
    pub(super) brick: &'a SurfaceBrick,
    /// Global id of its first vertex.
    pub(super) first: u32,
    /// Parameters of its vertices along their edges.
    pub(super) t: &'a [f32],
    /// Those edges.
    pub(super) edges: &'a [Edge],
}

/// First columns and rows of a layer's word.
const X0: u64 = 0x0101_0101_0101_0101;
const Y0: u64 = 0xff;

/// The first column of a layer's word: bit y.
#[inline(always)]
fn column(word: u64) -> u64 {
    // Moves bit 8·y to 56 + y; no two meet on the way.
    (word & X0).wrapping_mul(0x0102_0408_1020_4080) >> 56
}

/// Calls `each(bit)` for the bits that are set.
#[inline(always)]
fn bits(mut word: u64, mut each: impl FnMut(usize)) {
    while word != 0 {
        each(word.trailing_zeros() as usize);
        word &= word - 1;
    }
}

/// Combines the words of an axis after `take`, `shift` bits from layer to layer.
#[inline(always)]
fn layers(crossing: &[u64; 24], axis: usize, shift: usize, take: impl Fn(u64) -> u64) -> u64 {
    (0..8).fold(0, |word, z| word | take(crossing[3 * z + axis]) << (shift * z))
}

/// Calls `each(layer, bit, axis)` for the crossing edges of the neighbour `n` (bits: 0 x, 1 y, 2 z, but not 0) on the
/// face, edge or corner that it shares with a brick; other edges belong to other cells. Layers with few edges are
/// combined into one word, which reduces branch mispredictions.
#[inline(always)]
fn shared_edges(crossing: &[u64; 24], n: usize, mut each: impl FnMut(usize, usize, usize)) {
    match n {
        1 => [1, 2].iter().for_each(|&axis| bits(layers(crossing, axis, 8, column), |b| each(b / 8, b % 8 * 8, axis))),
        2 => [0, 2].iter().for_each(|&axis| bits(layers(crossing, axis, 8, |w| w & Y0), |b| each(b / 8, b % 8, axis))),
        3 => bits(layers(crossing, 2, 1, |w| w & 1), |z| each(z, 0, 2)),
        4 => [0, 1].iter().for_each(|&axis| bits(crossing[axis], |b| each(0, b, axis))),
        5 => bits(crossing[1] & X0, |b| each(0, b, 1)),
        6 => bits(crossing[0] & Y0, |b| each(0, b, 0)),
        // All eight share a single grid point and no edge.
        _ => {}
    }
}

/// Returns the offset of the neighbour `n` (bits: 0 x, 1 y, 2 z), in grid points.
#[inline(always)]
pub(super) fn far(n: usize) -> [usize; 3] {
    [8 * (n & 1), 8 * (n >> 1 & 1), 8 * (n >> 2 & 1)]
}

/// A vertex of a neighbour.
#[derive(Clone, Copy)]
pub(super) struct NeighbourVertex {
    /// Rank among the neighbour's vertices.
    pub(super) rank: u32,
    /// Its edge in the neighbour.
    pub(super) edge: Edge,
    /// Index among the grid edges of the brick itself.
    pub(super) index: usize,
}

/// Calls `each` for the vertices of the neighbour `n` (bits: 0 x, 1 y, 2 z, but not 0) that a brick's cells use.
#[inline(always)]
pub(super) fn shared_vertices(of: &NumberedBrick<'_>, n: usize, mut each: impl FnMut(NeighbourVertex)) {
    let SurfaceBrick { crossing, before, .. } = of.brick;
    let far = far(n);
    shared_edges(crossing, n, |z, bit, axis| {
        let w = 3 * z + axis;
        let below = crossing[w] & !(u64::MAX << (bit & 63));
        let rank = u32::from(before[w]) + below.count_ones();
        let edge = Edge::new(z, bit, axis);
        each(NeighbourVertex { rank, edge, index: edge.index_from(far) });
    });
}

/// Returns the slot of the neighbour `n` (bits: 0 x, 1 y, 2 z) of the brick in `slot`, and per axis whether it lies
/// beyond the tile.
#[inline(always)]
pub(super) fn neighbour_slot(slot: usize, n: usize) -> (usize, [usize; 3]) {
    let brick = slot_brick(slot);
    let moved: [usize; 3] = std::array::from_fn(|k| brick[k] + (n >> k & 1));
    let beyond = moved.map(|m| m / 8);
    let [x, y, z] = moved.map(|m| m % 8);
    ((z * SIDE + y) * SIDE + x, beyond)
}

/// A tile and its neighbours towards +x, +y, +z.
pub(super) struct TileNeighbours<'a> {
    tiles: [Option<(usize, &'a Tile)>; 8],
}

impl<'a> TileNeighbours<'a> {
    pub(super) fn new(tiles: &Tiles, done: &'a [Tile], coord: [i32; 3]) -> Self {
        Self {
            tiles: std::array::from_fn(|n| {
                let coord = std::array::from_fn(|k| coord[k] + i32::from(n >> k & 1 == 1));
                tiles.index.get(&coord).map(|&t| (t as usize, &done[t as usize]))
            }),
        }
    }

    /// The neighbour `n` (bits: 0 x, 1 y, 2 z; 0 is the brick itself) of the brick in `slot`, if the surface intersects
    /// it: the index of its tile, its index in the tile, and the brick.
    #[inline(always)]
    pub(super) fn of(&self, slot: usize, n: usize) -> Option<(usize, usize, NumberedBrick<'a>)> {
        let (slot, beyond) = neighbour_slot(slot, n);
        let (t, tile) = self.tiles[beyond[0] | beyond[1] << 1 | beyond[2] << 2]?;
        let (ix, numbered) = tile.numbered(slot)?;
        Some((t, ix, numbered))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn shared_edges_are_those_whose_ends_are_shared(crossing in prop::array::uniform24(any::<u64>()), n in 1_usize..8) {
            let mut found = Vec::new();
            shared_edges(&crossing, n, |z, bit, axis| found.push((z, bit, axis)));
            let mut expected = Vec::new();
            for (z, bit, axis) in (0..8 * 64 * 3).map(|i| (i / 192, i / 3 % 64, i % 3)) {
                let at = [bit % 8, bit / 8, z];
                // Both ends lie on the first layer along every axis on which the neighbour is beyond.
                let shared = (0..3).filter(|k| n >> k & 1 == 1).all(|k| at[k] == 0 && axis != k);
                if shared && crossing[3 * z + axis] >> bit & 1 == 1 {
                    expected.push((z, bit, axis));
                }
            }
            found.sort_unstable();
            expected.sort_unstable();
            prop_assert_eq!(found, expected);
        }
    }
}
