//! What comes back from a device: which rows of output are computed together, and where they lie when they arrive.

use std::sync::Arc;

use bytemuck::Pod;

use super::landing::Landing;
use super::record::CLOCK_BYTES;
use crate::surface::SurfaceParams;
use crate::surface::layout::{GROUP, Tally};

/// Where the counters lie in a landing, behind the timestamps.
pub(super) const TALLY_AT: u64 = 128;
/// Where everything else begins.
pub(super) const BODY_AT: u64 = 256;
const _: () = assert!(CLOCK_BYTES <= TALLY_AT && TALLY_AT + size_of::<Tally>() as u64 <= BODY_AT);

/// A run of bricks whose output is computed at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Piece {
    pub(super) brick: u32,
    pub(super) n_bricks: u32,
    /// Vertices before it in the mesh.
    pub(super) vertex: u64,
    pub(super) n_vertices: u64,
    pub(super) triangle: u64,
    pub(super) n_triangles: u64,
}

/// Cuts a chunk into pieces of at most so many vertices and triangles, by the sums of its groups of bricks. A group
/// never is more than a device can hold.
pub(super) fn pieces(
    [first_brick, n_bricks]: [u32; 2],
    groups: &[[u32; 4]],
    [vertex, triangle]: [u64; 2],
    [most_vertices, most_triangles]: [u64; 2],
) -> Vec<Piece> {
    let mut pieces: Vec<Piece> = Vec::new();
    let mut at = Piece { brick: first_brick, vertex, triangle, ..Piece::default() };
    let mut left = n_bricks;
    for &[v, t, ..] in groups {
        let (v, t, n) = (u64::from(v), u64::from(t), left.min(GROUP));
        if at.n_vertices + v > most_vertices || at.n_triangles + t > most_triangles {
            pieces.extend(Some(at).filter(|p| p.n_bricks > 0));
            at = Piece {
                brick: at.brick + at.n_bricks,
                vertex: at.vertex + at.n_vertices,
                triangle: at.triangle + at.n_triangles,
                ..Piece::default()
            };
        }
        at.n_bricks += n;
        at.n_vertices += v;
        at.n_triangles += t;
        left -= n;
    }
    pieces.extend(Some(at).filter(|p| p.n_bricks > 0));
    pieces
}

/// Bytes of a vertex in each column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct VertexBytes {
    pub(super) positions: u64,
    pub(super) normals: u64,
    /// 0 where nearest atoms are not asked for.
    pub(super) sources: u64,
}

impl VertexBytes {
    /// As a job wants its vertices.
    pub(super) const fn of(params: &SurfaceParams) -> Self {
        let (positions, normals) = if params.quantize.is_some() { (8, 4) } else { (12, 12) };
        Self { positions, normals, sources: if params.atom_ids { 4 } else { 0 } }
    }
}

/// Bytes of a triangle.
pub(super) const TRIANGLE_BYTES: u64 = 12;

/// Where the columns of some pieces lie in a landing: byte offsets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Places {
    pub(super) positions: u64,
    pub(super) normals: u64,
    pub(super) sources: u64,
    pub(super) triangles: u64,
    /// Bytes of the landing.
    pub(super) end: u64,
}

impl Places {
    /// Places for so many rows.
    pub(super) fn new(n_vertices: u64, n_triangles: u64, vertex: VertexBytes) -> Self {
        let positions = BODY_AT;
        let normals = positions + vertex.positions * n_vertices;
        let sources = normals + vertex.normals * n_vertices;
        let triangles = sources + vertex.sources * n_vertices;
        // A mapped range is a multiple of 8 bytes.
        let end = (triangles + TRIANGLE_BYTES * n_triangles).next_multiple_of(8);
        Self { positions, normals, sources, triangles, end }
    }
}

/// A submission's results in host memory.
#[derive(Debug, Clone)]
pub(super) struct Arrived {
    pub(super) landing: Arc<Landing>,
    pub(super) places: Places,
    pub(super) n_vertices: u64,
    pub(super) n_triangles: u64,
}

/// `n` values at `offset` of a landing.
pub(super) fn values<T: Pod>(bytes: &[u8], offset: u64, n: u64) -> Result<&[T], String> {
    let from = usize::try_from(offset).map_err(|e| e.to_string())?;
    let len = usize::try_from(n).map_err(|e| e.to_string())? * size_of::<T>();
    let range = bytes.get(from..from + len).ok_or_else(|| format!("{len} bytes at {from} of {}", bytes.len()))?;
    bytemuck::try_cast_slice(range).map_err(|e| e.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Step;

    #[test]
    fn rounded_vertices_take_half_the_place() {
        let single = SurfaceParams::default();
        let rounded = SurfaceParams { quantize: Some(Step::covering(9.0)), ..single.clone() };
        for atom_ids in [false, true] {
            let [single, rounded] = [&single, &rounded]
                .map(|params| VertexBytes::of(&SurfaceParams { atom_ids, ..params.clone() }))
                .map(|vertex| Places::new(1000, 2001, vertex));
            assert_eq!(single.triangles - rounded.triangles, 12 * 1000);
            assert_eq!(single.end - rounded.end, 12 * 1000);
            let columns = [rounded.positions, rounded.normals, rounded.sources, rounded.triangles];
            let n_ids = if atom_ids { 4000 } else { 0 };
            assert_eq!(columns.map(|at| at - BODY_AT), [0, 8000, 12_000, 12_000 + n_ids]);
        }
    }

    #[test]
    fn pieces_cover_every_group_once_and_keep_to_the_limits() {
        let groups: Vec<[u32; 4]> = (0..37).map(|i| [100 + 17 * (i % 5), 200 + 31 * (i % 7), 9, 0]).collect();
        let n_bricks = 36 * GROUP + 5;
        for most in [[168, 386], [500, 1000], [1 << 20, 1 << 20]] {
            let cut = pieces([7, n_bricks], &groups, [11, 13], most);
            let mut at = (7, 11, 13);
            for p in &cut {
                assert_eq!((p.brick, p.vertex, p.triangle), at);
                assert!(p.n_vertices <= most[0] && p.n_triangles <= most[1]);
                at = (at.0 + p.n_bricks, at.1 + p.n_vertices, at.2 + p.n_triangles);
            }
            let sums = groups.iter().fold((0, 0), |s, g| (s.0 + u64::from(g[0]), s.1 + u64::from(g[1])));
            assert_eq!(at, (7 + n_bricks, 11 + sums.0, 13 + sums.1));
        }
        assert_eq!(pieces([0, n_bricks], &groups, [0, 0], [1 << 20, 1 << 20]).len(), 1);
        assert!(pieces([0, n_bricks], &groups, [0, 0], [168, 386]).len() > 18);
    }
}
