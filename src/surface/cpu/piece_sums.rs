//! Area, volume and the checksum of directed edges, brick by brick, while the triangles are in the first-level cache.
//!
//! The results equal those of [`Measures::of`](crate::surface::Measures::of) for the finished mesh.

use std::num::NonZeroU16;

use glam::Vec3A;

use super::neighbours::{NumberedBrick, Shared, shared_vertices};
use super::sheets::Sheets;
use super::table::BrickTable;
use crate::surface::lattice::to_u32;
use crate::surface::measure::Component;
use crate::surface::simd::dispatched;
use crate::surface::sums::{edge_shares, sum_lanes};

/// Triangles whose areas are computed together.
const LANES: usize = 32;

/// Sheets of a brick in the numbering of its piece.
#[derive(Debug, Clone, Copy)]
pub(super) struct BrickSheets {
    /// The brick's first sheet.
    pub(super) first: u32,
    /// Number of sheets.
    n: u16,
    /// Neighbours (bit n for neighbour n) that hold vertices of a single sheet and may have several sheets themselves.
    unsettled: u8,
    /// Start of the sheets of its vertices in `of_vertices`, if it has several.
    detail: u32,
}

/// Vertex on a sheet of a brick with several sheets, in a neighbour that may also have several.
#[derive(Debug, Clone, Copy)]
struct FarVertex {
    brick: u32,
    /// Number of the neighbour (bits: 0 x, 1 y, 2 z); `rank` is the vertex's rank in it.
    neighbour: u8,
    rank: u32,
    sheet: u32,
}

/// Sums over one piece.
#[derive(Debug, Default)]
pub(super) struct PieceSums {
    /// Sum of the shares of all directed edges.
    pub(super) checksum: u64,
    /// True if a triangle has a corner twice.
    pub(super) degenerate: bool,
    /// Per sheet of the piece.
    pub(super) sheets: Vec<Sheet>,
    /// Per brick of the piece.
    pub(super) bricks: Vec<BrickSheets>,
    /// A sheet of the piece and the number of a brick that shares vertices with it and has one sheet.
    pub(super) lone: Vec<[u32; 2]>,
    of_vertices: Vec<u16>,
    far: Vec<FarVertex>,
}

/// Sums over the triangles of a sheet, in spacings, with the brick's first sample as the origin.
#[derive(Debug, Default, Clone, Copy)]
pub(super) struct Sheet {
    /// The brick's first sample, in spacings.
    origin: [i32; 3],
    triangles: u64,
    vertices: u64,
    /// Twice the area.
    area: f64,
    /// Sum of the normals n, which have the length of twice the area.
    vector: [f64; 3],
    /// Sum of n (a + b + c) over the corners, per axis: six times the volume, for a closed surface.
    product: [f64; 3],
    /// Sum of n (a² + b² + c² + ab + bc + ca), per axis: 24 times the volume's first moment, for a closed surface.
    moment: [f64; 3],
}

impl Sheet {
    #[inline(always)]
    fn add(&mut self, [vector, product, moment]: [Vec3A; 3]) {
        for k in 0..3 {
            self.vector[k] += f64::from(vector[k]);
            self.product[k] += f64::from(product[k]);
            self.moment[k] += f64::from(moment[k]);
        }
    }

    /// Adds the sheet to its component, which contains `first`. Volumes are relative to the origin of `first`: relative
    /// to a distant origin, small errors of the area vectors would be as large as a molecule.
    pub(super) fn add_to(&self, component: &mut Component, first: &Self, spacing: f64) {
        let h2 = spacing * spacing;
        component.triangles += self.triangles;
        component.vertices += self.vertices;
        component.area += 0.5 * self.area * h2;
        for k in 0..3 {
            // The sums after moving the corners by the offset.
            let offset = f64::from(self.origin[k] - first.origin[k]);
            let product = self.product[k] + 3.0 * offset * self.vector[k];
            let moment = self.moment[k] + offset * (4.0 * self.product[k] + 6.0 * offset * self.vector[k]);
            component.volume += product / 18.0 * h2 * spacing;
            component.moment[k] += moment / 24.0 * h2 * h2;
        }
    }

    /// Moves the reference point of a finished component's moment from the sheet's origin to the sample `centre`.
    pub(super) fn refer_moment(&self, component: &mut Component, centre: [i32; 3], spacing: f64) {
        for ((moment, origin), centre) in component.moment.iter_mut().zip(self.origin).zip(centre) {
            *moment += component.volume * f64::from(origin - centre) * spacing;
        }
    }
}

impl PieceSums {
    /// Returns empty sums with capacity for a typical piece of `bricks` bricks.
    pub(super) fn with_capacity(bricks: usize) -> Self {
        Self {
            bricks: Vec::with_capacity(bricks),
            sheets: Vec::with_capacity(2 * bricks),
            lone: Vec::with_capacity(4 * bricks),
            ..Self::default()
        }
    }

    /// Adds the brick that `emit` has just written.
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
        let n_own = around[0].map_or(0, |own| own.t.len());
        let n = sheets.resolve();
        let (first, detail) = (to_u32(self.sheets.len()), to_u32(self.of_vertices.len()));
        let unsettled = if n == 1 { self.settle(first, table.shared(), around) } else { 0 };
        self.bricks.push(BrickSheets { first, n, unsettled, detail });
        let corners = table.corners();
        if n == 1 {
            self.sheets.push(Sheet { origin, vertices: n_own as u64, ..sum(table, corners) });
            return;
        }
        self.sheets.resize(self.sheets.len() + usize::from(n), Sheet { origin, ..Sheet::default() });
        sum_by_sheet(table, sheets, &mut self.sheets[first as usize..]);
        note_vertices(self, table, sheets, around, first);
    }

    /// Records the neighbours in `shared` that are known to have one sheet, like the brick, whose sheet is `sheet`.
    /// Returns the others.
    #[inline(always)]
    fn settle(&mut self, sheet: u32, shared: u8, around: &[Option<NumberedBrick<'_>>; 8]) -> u8 {
        let mut unsettled = 0;
        for (n, near) in around.iter().enumerate().filter(|(n, _)| shared >> n & 1 == 1) {
            match near {
                Some(near) if has_one_sheet(near) => self.lone.push([sheet, near.id]),
                _ => unsettled |= 1 << n,
            }
        }
        unsettled
    }

    /// Calls `pair` for the pairs of sheets that neighbouring bricks share, beyond those of `lone`. `near(brick,
    /// neighbour)` returns a brick's neighbour, the sums of its piece, its piece, and its index in that piece; `pair`
    /// receives the sheet of this piece, and the other piece and sheet.
    #[inline(always)]
    pub(super) fn pairs<'a>(
        &self,
        near: impl Fn(usize, usize) -> Option<(NumberedBrick<'a>, &'a Self, (usize, usize))>,
        mut pair: impl FnMut(u32, (usize, u32)),
    ) {
        let mut far = self.far.iter().peekable();
        for (ix, brick) in self.bricks.iter().enumerate() {
            // Only vertices of this brick, if it has several sheets, ordered by neighbour.
            while let Some(FarVertex { neighbour, .. }) = far.peek().filter(|f| f.brick as usize == ix) {
                let met = near(ix, usize::from(*neighbour));
                let mut last = None;
                while let Some(at) = far.next_if(|f| f.brick as usize == ix && f.neighbour == *neighbour) {
                    let Some((_, sums, (piece, other))) = met else { continue };
                    let sheets = (at.sheet, sums.sheet_of(other, at.rank));
                    if last.replace(sheets) != Some(sheets) {
                        pair(at.sheet, (piece, sheets.1));
                    }
                }
            }
            for neighbour in (1..8).filter(|n| brick.unsettled >> n & 1 == 1) {
                let Some((of, sums, (piece, other))) = near(ix, neighbour) else { continue };
                if sums.bricks[other].n == 1 {
                    pair(brick.first, (piece, sums.bricks[other].first));
                    continue;
                }
                let mut last = None;
                shared_vertices(&of, neighbour, |Shared { rank, .. }| {
                    let sheet = sums.sheet_of(other, rank);
                    if last.replace(sheet) != Some(sheet) {
                        pair(brick.first, (piece, sheet));
                    }
                });
            }
        }
    }

    /// Returns the sheet of a brick's vertex.
    #[inline(always)]
    fn sheet_of(&self, brick: usize, rank: u32) -> u32 {
        let brick = &self.bricks[brick];
        if brick.n == 1 {
            return brick.first;
        }
        brick.first + u32::from(self.of_vertices[(brick.detail + rank) as usize])
    }
}

dispatched! {
/// Returns the checksum of triangles, and true if one of them has a corner twice.
fn check(triangles: &[[u32; 3]]) -> (u64, bool) {
    edge_shares(triangles)
}
}

dispatched! {
/// Records the sheet, numbered from `first`, of every vertex of a brick with several sheets: its own by rank, and those
/// of its neighbours for the later join of bricks.
fn note_vertices(
    piece: &mut PieceSums,
    table: &BrickTable,
    sheets: &Sheets,
    around: &[Option<NumberedBrick<'_>>; 8],
    first: u32,
) {
    let PieceSums { sheets: sums, bricks, of_vertices, far, lone, .. } = piece;
    let brick = to_u32(bricks.len() - 1);
    let on = |edge: usize| sheets.of(table.sheet(u16::try_from(edge).unwrap_or_default()));
    for (neighbour, near) in (0_u8..).zip(around) {
        let Some(near) = near else { continue };
        if neighbour == 0 {
            of_vertices.extend(near.edges.iter().map(|edge| {
                let sheet = on(edge.index());
                sums[first as usize + usize::from(sheet)].vertices += 1;
                sheet
            }));
            continue;
        }
        let (known, mut last) = (has_one_sheet(near), None);
        shared_vertices(near, usize::from(neighbour), |Shared { rank, index, .. }| {
            let sheet = first + u32::from(on(index));
            if !known {
                far.push(FarVertex { brick, neighbour, rank, sheet });
            } else if last.replace(sheet) != Some(sheet) {
                lone.push([sheet, near.id]);
            }
        });
    }
}
}

/// Returns true if a brick is known to have one sheet before its triangles exist.
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

/// Computes the lengths of normals, padded with zeros: a single square root takes as long as a vector of them.
#[inline(always)]
fn lengths(normals: &[Vec3A]) -> [f32; LANES] {
    let mut lengths = [0.0; LANES];
    lengths.iter_mut().zip(normals).for_each(|(length, n)| *length = n.length());
    lengths
}

dispatched! {
/// As [`sum`], for a brick of several sheets, whose triangles are not ordered by sheet: adds each to its own sheet.
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
/// Returns the sums over triangles given by the grid edges of their corners. Single precision within a brick, where
/// differences of positions are nearly exact; double precision between bricks.
fn sum(table: &BrickTable, corners: &[[u16; 3]]) -> Sheet {
    let mut all = Sheet { triangles: corners.len() as u64, ..Sheet::default() };
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
