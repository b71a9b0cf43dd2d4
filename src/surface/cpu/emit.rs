//! Stage `emit`: triangle indices, and while their corners are at hand, sheets and sums.
//!
//! A brick's cells use vertices of the brick itself and of its seven neighbours towards +x, +y, +z. They are entered
//! into a small table by grid edge first; each corner of a triangle is then a look-up.

use std::sync::LazyLock;

use glam::Vec3A;

use super::bin::SIDE;
use super::classify::SurfaceBrick;
use super::interpolate::position;
use super::sheets::{self, Sheets};
use crate::surface::cases::{CASES, MAX_TRIANGLES, cell_edge};
use crate::surface::lattice::to_f32;
use crate::surface::quantize::Step;
use crate::surface::simd::dispatched;

/// Samples along a brick's edge with the neighbours' first layer.
pub(super) const EDGE: usize = 9;
/// Room for the grid edges of a brick with those layers, three per sample: a power of two, so that a mask bounds an index.
pub(super) const EDGES: usize = (3 * EDGE * EDGE * EDGE).next_power_of_two();
/// Room for the corners of a brick's triangles: five triangles a cell, and what a cell writes beyond its own.
const CORNERS: usize = 512 * 3 * MAX_TRIANGLES + ROW;
/// Corners that every cell writes, as whole vectors: those beyond its triangles are overwritten by the next cell.
const ROW: usize = 16;

/// The brick at hand: its vertices by grid edge, `3·((z·9 + y)·9 + x) + axis`, and its triangles. Entries of edges that
/// do not cross are stale. Kept and refilled from brick to brick.
pub(super) struct BrickTable {
    /// Global vertex ids.
    ids: Box<[u32; EDGES]>,
    /// Positions in spacings from the brick's first sample.
    at: Box<[Vec3A; EDGES]>,
    /// The sheet that a vertex belongs to, before sheets that met are made one.
    sheet: Box<[u16; EDGES]>,
    /// Corners of the triangles as grid edges.
    corners: Box<[u16; CORNERS]>,
    /// Triangles.
    triangles: usize,
}

/// A table on the heap, without passing through the stack.
fn boxed<T: Copy>(value: T) -> Box<[T; EDGES]> {
    match vec![value; EDGES].into_boxed_slice().try_into() {
        Ok(table) => table,
        Err(_) => unreachable!("it has just this length"),
    }
}

impl Default for BrickTable {
    fn default() -> Self {
        Self { ids: boxed(0), at: boxed(Vec3A::ZERO), sheet: boxed(0), corners: Box::new([0; CORNERS]), triangles: 0 }
    }
}

/// Edges that the straight path handles for every cell, without asking how many there are.
const FAST_EDGES: usize = 6;

/// A case as offsets from a cell's own entry in the table.
struct CaseRow {
    /// One loop of six edges at most; all others take the careful path.
    fast: bool,
    /// Triangles.
    n_triangles: usize,
    /// Their corners; those beyond repeat one that is in range.
    corners: [u16; ROW],
    /// Edges loop by loop, the last one repeated to the end.
    edges: [u16; 12],
    /// Where each loop ends in `edges`.
    loop_ends: [u8; 4],
    n_loops: usize,
}

static ROWS: LazyLock<Vec<CaseRow>> = LazyLock::new(|| (0..=255).map(CaseRow::new).collect());

/// Makes the table of cases.
pub(super) fn warm() {
    LazyLock::force(&ROWS);
}

impl CaseRow {
    fn new(case: u8) -> Self {
        let offset = |e: u8| {
            let edge = cell_edge(e);
            let [x, y, z] = edge.offset.map(u16::from);
            3 * ((z * 9 + y) * 9 + x) + u16::from(edge.axis)
        };
        let triangles = CASES.of(case);
        let mut edges: Vec<u8> = Vec::new();
        let mut loop_ends = [0; 4];
        let mut n_loops = 0;
        // A loop's triangles follow each other, and each but the first has a corner with an earlier one in common.
        for triangle in triangles {
            if !triangle.iter().any(|e| edges.contains(e)) {
                n_loops += 1;
            }
            for e in triangle {
                if !edges.contains(e) {
                    edges.push(*e);
                }
            }
            loop_ends[n_loops - 1] = u8::try_from(edges.len()).unwrap_or(u8::MAX);
        }
        let last = edges.last().map_or(0, |&e| offset(e));
        let mut row = Self {
            fast: n_loops <= 1 && edges.len() <= FAST_EDGES,
            n_triangles: triangles.len(),
            corners: [last; ROW],
            edges: [last; 12],
            loop_ends,
            n_loops,
        };
        for (to, from) in row.corners.iter_mut().zip(triangles.as_flattened()) {
            *to = offset(*from);
        }
        for (to, from) in row.edges.iter_mut().zip(&edges) {
            *to = offset(*from);
        }
        row
    }
}

/// A surface brick whose vertices have their global ids.
#[derive(Clone, Copy)]
pub(super) struct Numbered<'a> {
    /// The brick.
    pub(super) brick: &'a SurfaceBrick,
    /// Global id of its first vertex.
    pub(super) first: u32,
    /// Parameters of its vertices along their edges.
    pub(super) t: &'a [f32],
}

/// First columns and rows of a layer's word.
const X0: u64 = 0x0101_0101_0101_0101;
const Y0: u64 = 0xff;

/// Calls `each(layer, axis, mask)` for the words of the neighbour `n` (bits: 0 x, 1 y, 2 z) that hold edges on what it
/// shares with a brick; edges that leave the shared face belong to other cells.
#[inline(always)]
fn shared_words(n: usize, mut each: impl FnMut(usize, usize, u64)) {
    let beyond = [n & 1, n >> 1 & 1, n >> 2 & 1];
    let mask = if beyond[0] == 1 { X0 } else { u64::MAX } & if beyond[1] == 1 { Y0 } else { u64::MAX };
    for layer in 0..if beyond[2] == 1 { 1 } else { 8 } {
        for (axis, _) in beyond.iter().enumerate().filter(|(_, far)| **far == 0) {
            each(layer, axis, mask);
        }
    }
}

/// Whether the neighbour `n` holds a vertex that a brick's cells use.
#[inline(always)]
pub(super) fn shares_vertices(near: &SurfaceBrick, n: usize) -> bool {
    let mut words = 0;
    shared_words(n, |z, axis, mask| words |= near.crossing[3 * z + axis] & mask);
    words != 0
}

/// The grid edge of a vertex: of the edge at `bit` of word `(z, axis)` of a brick that lies `far` (0 or 8 per axis) away.
#[inline(always)]
fn edge_at(bit: u32, z: usize, axis: usize, far: [usize; 3]) -> usize {
    let (x, y) = (bit as usize & 7, bit as usize >> 3);
    (3 * (((z + far[2]) * EDGE + far[1] + y) * EDGE + far[0] + x) + axis) % EDGES
}

/// How far the neighbour `n` (bits: 0 x, 1 y, 2 z) lies away, in samples.
#[inline(always)]
pub(super) fn far(n: usize) -> [usize; 3] {
    [8 * (n & 1), 8 * (n >> 1 & 1), 8 * (n >> 2 & 1)]
}

/// Calls `each(rank, grid edge)` for the vertices of the neighbour `n` (0 is the brick itself) that a brick's cells use.
#[inline(always)]
pub(super) fn shared_vertices(of: &Numbered<'_>, n: usize, mut each: impl FnMut(u32, usize)) {
    let far = far(n);
    shared_words(n, |z, axis, mask| {
        let w = 3 * z + axis;
        let word = of.brick.crossing[w];
        let before = u32::from(of.brick.before[w]);
        let mut edges = word & mask;
        while edges != 0 {
            let bit = edges.trailing_zeros();
            let rank = before + (word & ((1 << bit) - 1)).count_ones();
            edges &= edges - 1;
            each(rank, edge_at(bit, z, axis, far));
        }
    });
}

/// Samples' coordinates within a layer, by bit.
static LAYER: [Vec3A; 64] = {
    let mut table = [Vec3A::ZERO; 64];
    let mut bit = 0_u8;
    while bit < 64 {
        table[bit as usize] = Vec3A::new((bit & 7) as f32, (bit >> 3) as f32, 0.0);
        bit += 1;
    }
    table
};

impl BrickTable {
    /// Enters the vertices in `mask` of word `(z, axis)` of a brick that lies `far` away.
    #[inline(always)]
    fn put(&mut self, of: &Numbered<'_>, z: usize, axis: usize, mask: u64, far: [usize; 3]) {
        let w = 3 * z + axis;
        let word = of.brick.crossing[w];
        let before = u32::from(of.brick.before[w]);
        let corner = Vec3A::new(far[0] as f32, far[1] as f32, (far[2] + z) as f32);
        let along = Vec3A::AXES[axis % 3];
        let mut edges = word & mask;
        while edges != 0 {
            let bit = edges.trailing_zeros();
            let rank = before + (word & ((1 << bit) - 1)).count_ones();
            edges &= edges - 1;
            let entry = edge_at(bit, z, axis, far);
            let t = of.t.get(rank as usize).copied().unwrap_or_default();
            self.ids[entry] = of.first + rank;
            self.at[entry] = LAYER[bit as usize % 64] + corner + along * t;
            self.sheet[entry] = sheets::NONE;
        }
    }

    /// Enters all vertices that the brick's cells use.
    #[inline(always)]
    fn fill(&mut self, around: &[Option<Numbered<'_>>; 8]) {
        for (n, near) in around.iter().enumerate() {
            let Some(near) = near else { continue };
            let far = far(n);
            shared_words(n, |z, axis, mask| self.put(near, z, axis, mask, far));
        }
    }

    /// Moves the vertices of a brick that lies `n` away to where they are after rounding.
    #[inline(always)]
    fn round(&mut self, of: &Numbered<'_>, n: usize, rounding: &Rounding) {
        let Rounding { step, spacing, offset } = *rounding;
        let far = far(n);
        // As the vertex's own brick has it: so a vertex is at one place in all bricks that use it.
        let own: [f32; 3] = std::array::from_fn(|k| to_f32(offset[k] + far[k] as f64));
        let (h, length) = (to_f32(spacing), f64::from(step.length()));
        shared_words(n, |z, axis, mask| {
            let w = 3 * z + axis;
            let word = of.brick.crossing[w];
            let (layer, along) = (Vec3A::new(0.0, 0.0, z as f32), Vec3A::AXES[axis % 3]);
            let before = u32::from(of.brick.before[w]);
            let mut edges = word & mask;
            while edges != 0 {
                let bit = edges.trailing_zeros();
                let rank = before + (word & ((1 << bit) - 1)).count_ones();
                edges &= edges - 1;
                let t = of.t.get(rank as usize).copied().unwrap_or_default();
                let place = LAYER[bit as usize % 64] + layer + along * t;
                let steps = step.position(position(own, place.to_array(), h));
                // Double precision, as a large offset is taken off.
                let at: [f32; 3] = std::array::from_fn(|k| to_f32(f64::from(steps[k]) * length / spacing - offset[k]));
                self.at[edge_at(bit, z, axis, far)] = Vec3A::from_array(at);
            }
        });
    }

    /// Corners of the triangles of the active cells, in order. If `JOIN`, vertices that a loop joins come onto one sheet.
    #[inline(always)]
    fn triangulate<const JOIN: bool>(&mut self, active: &[u64; 8], cases: &[u8], sheets: &mut Sheets) {
        let rows = &**ROWS;
        let mut cases = cases.iter();
        self.triangles = 0;
        for (z, &word) in active.iter().enumerate() {
            let mut cells = word;
            while cells != 0 {
                let bit = cells.trailing_zeros();
                cells &= cells - 1;
                let Some(&case) = cases.next() else { return };
                let row = &rows[usize::from(case)];
                let cell = u16::try_from(edge_at(bit, z, 0, [0; 3])).unwrap_or_default();
                if let Some(corners) = self.corners.get_mut(3 * self.triangles..3 * self.triangles + ROW) {
                    for (corner, offset) in corners.iter_mut().zip(row.corners) {
                        *corner = cell + offset;
                    }
                }
                self.triangles += row.n_triangles;
                if !JOIN {
                    continue;
                }
                if row.fast {
                    let edges: [u16; FAST_EDGES] = std::array::from_fn(|k| cell + row.edges[k]);
                    sheets.join(&mut self.sheet, &edges);
                } else {
                    let edges = row.edges.map(|offset| cell + offset);
                    let mut start = 0;
                    for &end in &row.loop_ends[..row.n_loops] {
                        sheets.join(&mut self.sheet, &edges[start..usize::from(end)]);
                        start = usize::from(end);
                    }
                }
            }
        }
    }

    /// Corners of the brick's triangles as grid edges.
    pub(super) fn corners(&self) -> &[[u16; 3]] {
        &self.corners.as_chunks::<3>().0[..self.triangles]
    }

    /// A vertex's position in spacings from the brick's first sample.
    #[inline(always)]
    pub(super) fn position(&self, edge: u16) -> Vec3A {
        self.at[usize::from(edge) % EDGES]
    }

    /// The sheet that a vertex was put on.
    #[inline(always)]
    pub(super) fn sheet(&self, edge: u16) -> u16 {
        self.sheet[usize::from(edge) % EDGES]
    }
}

/// How vertices are rounded.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rounding {
    pub(super) step: Step,
    /// Å.
    pub(super) spacing: f64,
    /// From the mesh's centre to the brick's first sample, in spacings.
    pub(super) offset: [f64; 3],
}

dispatched! {
/// Writes the triangles of a brick. `cases` are those of its active cells in order, `own_sheets` the cells of each sheet
/// if there are several and they are known. Leaves in `table` and `sheets`
/// what the sums need, with vertices where `rounding` puts them.
pub(super) fn emit(
    table: &mut BrickTable,
    sheets: &mut Sheets,
    around: &[Option<Numbered<'_>>; 8],
    cases: &[u8],
    own_sheets: &[[u64; 8]],
    rounding: Option<Rounding>,
    out: &mut [[u32; 3]],
) {
    let Some(own) = around[0] else { return };
    table.fill(around);
    if let Some(rounding) = &rounding {
        for (n, near) in around.iter().enumerate() {
            let Some(near) = near else { continue };
            table.round(near, n, rounding);
        }
    }
    sheets.clear();
    match own.brick.n_sheets {
        None => table.triangulate::<true>(&own.brick.active, cases, sheets),
        Some(n) => {
            sheets.known(n.get());
            table.triangulate::<false>(&own.brick.active, cases, sheets);
            for (n, near) in around.iter().enumerate().filter(|_| n.get() > 1) {
                let Some(near) = near else { continue };
                shared_vertices(near, n, |_, edge| table.sheet[edge] = sheets::of_cell(own_sheets, edge));
            }
        }
    }
    for (id, corner) in out.as_flattened_mut().iter_mut().zip(table.corners.iter()) {
        *id = table.ids[usize::from(*corner) % EDGES];
    }
}
}

/// The slot of the neighbour `n` (bits: 0 x, 1 y, 2 z) of the brick in `slot`, and whether it lies beyond the
/// tile, per axis.
#[inline(always)]
pub(super) fn neighbour_slot(slot: usize, n: usize) -> (usize, [usize; 3]) {
    let brick = super::bin::slot_brick(slot);
    let moved: [usize; 3] = std::array::from_fn(|k| brick[k] + (n >> k & 1));
    let beyond = moved.map(|m| m / 8);
    let [x, y, z] = moved.map(|m| m % 8);
    ((z * SIDE + y) * SIDE + x, beyond)
}
