//! Stage `emit`: triangle indices, and sheets and sums while their corners are in cache.
//!
//! A brick's cells use vertices of the brick itself and of its seven neighbours towards +x, +y, +z. All these vertices
//! are first entered into a small table, by grid edge. Each corner of a triangle is then a look-up in the table.

use std::sync::LazyLock;

use super::edge::{EDGES, Edge};
use super::neighbours::NumberedBrick;
use super::sheets::Sheets;
use super::table::{BrickTable, ROW, Rounding};
use crate::cases::{CASES, cell_edge};
use crate::simd::dispatched;

/// Number of edges that the fast path processes for every cell, without a check of their number.
const FAST_EDGES: usize = 6;

/// A case as offsets from a cell's own entry in the table.
struct CaseRow {
    /// True for a single loop of at most six edges; other cases use the slow path.
    fast: bool,
    /// Triangles.
    n_triangles: usize,
    /// Their corners; those beyond repeat one that is in range.
    corners: [u16; ROW],
    /// Edges loop by loop, the last one repeated to the end.
    edges: [u16; 12],
    /// End of each loop in `edges`.
    loop_ends: [u8; 4],
    n_loops: usize,
}

static ROWS: LazyLock<Vec<CaseRow>> = LazyLock::new(|| (0..=255).map(CaseRow::new).collect());

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
        // The triangles of a loop are consecutive, and each but the first shares a corner with an earlier one.
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

impl BrickTable {
    /// Writes the corners of the triangles of the active cells, in order. If `JOIN`, unites the sheets of vertices that
    /// a loop connects.
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
                let cell = u16::try_from(Edge::new(z, bit as usize, 0).index()).unwrap_or_default();
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
}

dispatched! {
/// Writes the triangles of a brick. `cases` are the cases of its active cells in order. `own_sheets` are the cells of
/// each sheet, if there are several and they are known. Stores the inputs of the sums in `table` and `sheets`, with
/// vertices rounded by `rounding`.
pub(super) fn emit(
    table: &mut BrickTable,
    sheets: &mut Sheets,
    around: &[Option<NumberedBrick<'_>>; 8],
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
            if n.get() > 1 {
                table.spread(around, own_sheets);
            }
        }
    }
    for (id, corner) in out.as_flattened_mut().iter_mut().zip(table.corners.iter()) {
        *id = table.ids[usize::from(*corner) % EDGES];
    }
}
}
