//! Stage `measure`: sums of each brick's sheets and the checksum of directed edges, while the triangles are in the
//! first-level cache.
//!
//! The results equal those of [`Measures::of`](crate::Measures::of) for the finished mesh.

use std::num::NonZeroU16;

use glam::Vec3A;

use super::neighbours::{NeighbourVertex, NumberedBrick, TileNeighbours, shared_vertices};
use super::sheets::Sheets;
use super::table::BrickTable;
use super::{PIECE_BRICKS, Piece, Scanned};
use crate::join::{self, BrickSheets, SharedVertex, Sheet, SheetSums};
use crate::lattice::to_u32;
use crate::measure::Measures;
use crate::simd::dispatched;
use crate::sums::{edge_shares, sum_lanes};

/// Triangles whose areas are computed together.
const LANES: usize = 32;

impl Sheet {
    #[inline(always)]
    fn add(&mut self, [vector, product, moment]: [Vec3A; 3]) {
        for k in 0..3 {
            self.vector[k] += f64::from(vector[k]);
            self.product[k] += f64::from(product[k]);
            self.moment[k] += f64::from(moment[k]);
        }
    }
}

impl SheetSums {
    /// Returns empty sums with capacity for a typical piece of `bricks` bricks.
    pub(super) fn with_capacity(bricks: usize) -> Self {
        Self { bricks: Vec::with_capacity(bricks), sheets: Vec::with_capacity(2 * bricks), ..Self::default() }
    }

    /// Adds the brick that `emit` has just written. `origin` is its first grid point relative to the mesh's centre.
    pub(super) fn add(
        &mut self,
        table: &BrickTable,
        sheets: &mut Sheets,
        around: &[Option<NumberedBrick<'_>>; 8],
        origin: [i32; 3],
        written: &[[u32; 3]],
    ) {
        let (shares, degenerate) = check(written);
        self.checksum = self.checksum.wrapping_add(shares);
        self.degenerate |= degenerate;
        let n = sheets.resolve();
        let first = self.sheets.len();
        let [near, far] = [self.near.len(), self.far.len()].map(to_u32);
        self.bricks.push(BrickSheets { first: to_u32(first), n, near, far });
        if n == 1 {
            let vertices = around[0].map_or(0, |own| to_u32(own.t.len()));
            self.sheets.push(Sheet { origin, vertices, above: table.shared, ..sum(table, table.corners()) });
            return;
        }
        self.sheets.resize(first + usize::from(n), Sheet { origin, ..Sheet::default() });
        sum_by_sheet(table, sheets, &mut self.sheets[first..]);
        note_vertices(self, table, sheets, around, first);
    }
}

/// Returns the measures of the mesh that consists of the pieces; `None` if it is not closed.
pub(super) fn of_pieces(scanned: &Scanned, sums: &[SheetSums]) -> Option<Measures> {
    let Scanned { lattice, tiles, done, totals, pieces, .. } = scanned;
    let sums: Vec<&SheetSums> = sums.iter().collect();
    let near = |piece: usize| {
        let Piece { tile, bricks } = &pieces[piece];
        let found = &done[*tile].found.bricks[bricks.clone()];
        let near = TileNeighbours::new(tiles, done, done[*tile].coord);
        move |brick: usize, n: usize| {
            let (other, ix, _) = near.of(usize::from(found[brick].slot), n)?;
            Some((done[other].first_piece + ix / PIECE_BRICKS, ix % PIECE_BRICKS))
        }
    };
    join::measures(&sums, near, lattice.spacing, [totals.vertices, totals.triangles])
}

dispatched! {
/// Returns the checksum of triangles, and true if one of them has a corner twice.
fn check(triangles: &[[u32; 3]]) -> (u64, bool) {
    edge_shares(triangles)
}
}

dispatched! {
/// Counts the vertices of a brick with several sheets, from `first` on, and records those that it shares.
fn note_vertices(
    piece: &mut SheetSums,
    table: &BrickTable,
    sheets: &Sheets,
    around: &[Option<NumberedBrick<'_>>; 8],
    first: usize,
) {
    let SheetSums { sheets: sums, near: own, far, .. } = piece;
    let sums = &mut sums[first..];
    let on = |edge: usize| sheets.of(table.sheet(u16::try_from(edge).unwrap_or_default()));
    for (neighbour, near) in (0_u8..).zip(around) {
        let Some(near) = near else { continue };
        if neighbour == 0 {
            for edge in near.edges {
                let (sheet, users) = (on(edge.index()), USERS[edge.first_layers()]);
                let sum = &mut sums[usize::from(sheet)];
                sum.vertices += 1;
                sum.below |= users;
                if users != 0 {
                    own.push(SharedVertex { owner: 0, key: edge.key(), sheet });
                }
            }
            continue;
        }
        let known = has_one_sheet(near);
        shared_vertices(near, usize::from(neighbour), |NeighbourVertex { edge, index, .. }| {
            let sheet = on(index);
            sums[usize::from(sheet)].above |= 1 << neighbour;
            if !known {
                far.push(SharedVertex { owner: neighbour, key: edge.key(), sheet });
            }
        });
    }
}
}

/// Neighbours that use a vertex, by the axes (bits: 0 x, 1 y, 2 z) along which it lies in the brick's first layer.
/// Bit n stands for the brick that has this one as neighbour n.
const USERS: [u8; 8] = [0, 1 << 1, 1 << 2, 0b1110, 1 << 4, 0b11_0010, 0b101_0100, 0];

/// Returns true if `classify` has found a single sheet in the brick.
#[inline(always)]
fn has_one_sheet(of: &NumberedBrick<'_>) -> bool {
    of.brick.n_sheets == Some(NonZeroU16::MIN)
}

/// A triangle's terms of the sums of a [`Sheet`]: normal, product and moment.
#[inline(always)]
fn terms(table: &BrickTable, edges: [u16; 3]) -> [Vec3A; 3] {
    let [a, b, c] = edges.map(|edge| table.position(edge));
    let n = (b - a).cross(c - a);
    let sum = a + b + c;
    [n, n * sum, n * (a * sum + b * (b + c) + c * c)]
}

/// Computes the lengths of normals. Pads with zeros, because one square root takes as long as a vector of them.
#[inline(always)]
fn lengths(normals: &[Vec3A]) -> [f32; LANES] {
    let mut lengths = [0.0; LANES];
    lengths.iter_mut().zip(normals).for_each(|(length, n)| *length = n.length());
    lengths
}

dispatched! {
/// Adds each triangle to the sums of its sheet. Replaces [`sum`] for a brick of several sheets, whose triangles are not
/// ordered by sheet.
fn sum_by_sheet(table: &BrickTable, sheets: &Sheets, sums: &mut [Sheet]) {
    let (mut normals, mut others) = ([Vec3A::ZERO; LANES], [[Vec3A::ZERO; 2]; LANES]);
    for batch in table.corners().chunks(LANES) {
        for ((normal, others), edges) in normals.iter_mut().zip(&mut others).zip(batch) {
            let [n, product, moment] = terms(table, *edges);
            (*normal, *others) = (n, [product, moment]);
        }
        let area = lengths(&normals[..batch.len()]);
        for (((edges, normal), [product, moment]), area) in batch.iter().zip(&normals).zip(&others).zip(area) {
            let sum = &mut sums[usize::from(sheets.of(table.sheet(edges[0])))];
            sum.triangles += 1;
            sum.area += f64::from(area);
            sum.add([*normal, *product, *moment]);
        }
    }
}
}

dispatched! {
/// Returns the sums over triangles given by the grid edges of their corners. Uses single precision within a brick,
/// where differences of positions are nearly exact; sums over bricks use double precision.
fn sum(table: &BrickTable, corners: &[[u16; 3]]) -> Sheet {
    let mut all = Sheet { triangles: to_u32(corners.len()), ..Sheet::default() };
    let mut normals = [Vec3A::ZERO; LANES];
    for batch in corners.chunks(LANES) {
        let mut sums = [Vec3A::ZERO; 3];
        for (normal, edges) in normals.iter_mut().zip(batch) {
            let terms = terms(table, *edges);
            *normal = terms[0];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
        }
        all.area += sum_lanes(&lengths(&normals[..batch.len()]));
        all.add(sums);
    }
    all
}
}
