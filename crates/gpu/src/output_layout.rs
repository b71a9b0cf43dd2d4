//! Layout of a job's output: pieces that are computed at once, and the columns of each piece in a readback buffer.

use std::ops::Range;
use std::sync::Arc;

use bytemuck::Pod;
use molmesh_surface::SurfaceParams;

use super::error::GpuError;
use super::pipelines::TIMESTAMP_BYTES;
use super::plan::layout::{Counters, GROUP};
use super::readback::ReadbackBuffer;

/// Offset of the counters in a readback buffer, behind the timestamps.
pub(super) const COUNTERS_OFFSET: u64 = 128;
/// Offset of everything else.
pub(super) const BODY_OFFSET: u64 = 256;
const _: () =
    assert!(TIMESTAMP_BYTES <= COUNTERS_OFFSET && COUNTERS_OFFSET + size_of::<Counters>() as u64 <= BODY_OFFSET);

/// Run of bricks whose output is computed at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct OutputPiece {
    pub(super) brick: u32,
    pub(super) n_bricks: u32,
    /// Number of vertices before the piece.
    pub(super) vertex: u64,
    pub(super) n_vertices: u64,
    /// Number of triangles before the piece.
    pub(super) triangle: u64,
    pub(super) n_triangles: u64,
    /// Capacity of the blocks of sheets and the table of their offsets, in words.
    pub(super) sheet_words: u64,
}

/// Cuts a chunk into pieces of at most `max_vertices` and `max_triangles`, according to the counts of its groups of
/// bricks. A single group never exceeds the capacity of a device.
pub(super) fn pieces(
    [first_brick, n_bricks]: [u32; 2],
    groups: &[[u32; 4]],
    [vertex, triangle]: [u64; 2],
    [max_vertices, max_triangles]: [u64; 2],
    sheet_words_per_brick: u64,
) -> Vec<OutputPiece> {
    let mut pieces: Vec<OutputPiece> = Vec::new();
    let mut at = OutputPiece { brick: first_brick, vertex, triangle, ..OutputPiece::default() };
    let mut left = n_bricks;
    for &[v, t, b, _] in groups {
        let (v, t, n) = (u64::from(v), u64::from(t), left.min(GROUP));
        if at.n_vertices + v > max_vertices || at.n_triangles + t > max_triangles {
            pieces.extend(Some(at).filter(|p| p.n_bricks > 0));
            at = OutputPiece {
                brick: at.brick + at.n_bricks,
                vertex: at.vertex + at.n_vertices,
                triangle: at.triangle + at.n_triangles,
                ..OutputPiece::default()
            };
        }
        at.n_bricks += n;
        at.n_vertices += v;
        at.n_triangles += t;
        at.sheet_words += u64::from(n) + u64::from(b) * sheet_words_per_brick;
        left -= n;
    }
    pieces.extend(Some(at).filter(|p| p.n_bricks > 0));
    pieces
}

/// Bytes per vertex in each column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct VertexBytes {
    pub(super) positions: u64,
    pub(super) normals: u64,
    /// 0 unless the nearest atoms are requested.
    pub(super) sources: u64,
}

impl VertexBytes {
    /// Bytes per vertex for `params`.
    pub(super) const fn new(params: &SurfaceParams) -> Self {
        let (positions, normals) = if params.quantize.is_some() { (8, 4) } else { (12, 12) };
        Self { positions, normals, sources: if params.atom_ids { 4 } else { 0 } }
    }
}

/// Bytes per triangle.
pub(super) const TRIANGLE_BYTES: u64 = 12;

/// Byte offsets of the columns in a readback buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct ReadbackLayout {
    pub(super) positions: u64,
    pub(super) normals: u64,
    pub(super) sources: u64,
    pub(super) triangles: u64,
    pub(super) sheets: u64,
    /// Total bytes.
    pub(super) end: u64,
}

impl ReadbackLayout {
    /// Layout of the given numbers of rows.
    pub(super) fn new(rows: OutputRows, vertex: VertexBytes) -> Self {
        let OutputRows { vertices: n_vertices, triangles: n_triangles, sheet_words } = rows;
        let positions = BODY_OFFSET;
        let normals = positions + vertex.positions * n_vertices;
        let sources = normals + vertex.normals * n_vertices;
        let triangles = sources + vertex.sources * n_vertices;
        let sheets = triangles + TRIANGLE_BYTES * n_triangles;
        // The size of a mapped range is a multiple of 8 bytes.
        let end = (sheets + 4 * sheet_words).next_multiple_of(8);
        Self { positions, normals, sources, triangles, sheets, end }
    }
}

/// Numbers of output rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct OutputRows {
    pub(super) vertices: u64,
    pub(super) triangles: u64,
    /// Number of words of the blocks of sheets and the table of their offsets.
    pub(super) sheet_words: u64,
}

/// Output in a mapped readback buffer.
#[derive(Clone)]
pub(super) struct ReadbackRows {
    pub(super) readback: Arc<ReadbackBuffer>,
    pub(super) layout: ReadbackLayout,
    pub(super) rows: OutputRows,
}

/// Returns `n` values at byte `offset` of a readback buffer.
pub(super) fn values<T: Pod>(bytes: &[u8], offset: u64, n: u64) -> Result<&[T], GpuError> {
    let range = byte_range::<T>(offset, n)?;
    let values = bytes.get(range.clone()).and_then(|bytes| bytemuck::try_cast_slice(bytes).ok());
    values.ok_or_else(|| GpuError::Failed(format!("no values in bytes {range:?} of {}", bytes.len())))
}

/// Converts a number of rows to 32 bits; buffers are smaller than that.
pub(super) fn narrow(n: u64) -> Result<u32, GpuError> {
    u32::try_from(n).map_err(|e| GpuError::Failed(format!("{n} rows: {e}")))
}

/// Returns the byte range of `n` values at byte `offset`.
pub(super) fn byte_range<T>(offset: u64, n: u64) -> Result<Range<usize>, GpuError> {
    let number = |n: u64| usize::try_from(n).map_err(|e| GpuError::Failed(e.to_string()));
    let from = number(offset)?;
    Ok(from..from + number(n)? * size_of::<T>())
}

#[cfg(test)]
mod tests {
    use molmesh_surface::Step;

    use super::*;

    #[test]
    fn quantized_vertices_take_half_the_bytes() {
        let single = SurfaceParams::default();
        let rounded = SurfaceParams { quantize: Some(Step::covering(9.0)), ..single.clone() };
        for atom_ids in [false, true] {
            let [single, rounded] = [&single, &rounded]
                .map(|params| VertexBytes::new(&SurfaceParams { atom_ids, ..params.clone() }))
                .map(|vertex| {
                    ReadbackLayout::new(OutputRows { vertices: 1000, triangles: 2001, sheet_words: 0 }, vertex)
                });
            assert_eq!(single.triangles - rounded.triangles, 12 * 1000);
            assert_eq!(single.end - rounded.end, 12 * 1000);
            let columns = [rounded.positions, rounded.normals, rounded.sources, rounded.triangles];
            let n_ids = if atom_ids { 4000 } else { 0 };
            assert_eq!(columns.map(|at| at - BODY_OFFSET), [0, 8000, 12_000, 12_000 + n_ids]);
        }
    }

    #[test]
    fn pieces_cover_every_group_once_and_keep_to_the_limits() {
        let groups: Vec<[u32; 4]> = (0..37).map(|i| [100 + 17 * (i % 5), 200 + 31 * (i % 7), 9, 0]).collect();
        let n_bricks = 36 * GROUP + 5;
        for most in [[168, 386], [500, 1000], [1 << 20, 1 << 20]] {
            let cut = pieces([7, n_bricks], &groups, [11, 13], most, 2);
            let mut at = (7, 11, 13);
            for p in &cut {
                assert_eq!((p.brick, p.vertex, p.triangle), at);
                assert!(p.n_vertices <= most[0] && p.n_triangles <= most[1]);
                at = (at.0 + p.n_bricks, at.1 + p.n_vertices, at.2 + p.n_triangles);
            }
            let sums = groups.iter().fold((0, 0), |s, g| (s.0 + u64::from(g[0]), s.1 + u64::from(g[1])));
            assert_eq!(at, (7 + n_bricks, 11 + sums.0, 13 + sums.1));
            assert_eq!(cut.iter().map(|p| p.sheet_words).sum::<u64>(), u64::from(n_bricks) + 2 * 9 * 37);
        }
        assert_eq!(pieces([0, n_bricks], &groups, [0, 0], [1 << 20, 1 << 20], 2).len(), 1);
        assert!(pieces([0, n_bricks], &groups, [0, 0], [168, 386], 2).len() > 18);
    }
}
