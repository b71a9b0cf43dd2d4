//! Contents of a device's buffers, as the shaders declare them. Lengths are in spacings of the lattice unless said
//! otherwise. The build reflects the structs of the shaders, and a test compares every field with these.

use bytemuck::{Pod, Zeroable};
use molmesh_surface::cases::{CASES, CellEdge, cell_edge};
use molmesh_surface::lattice;

/// Marks a tile or brick that does not exist.
pub const NONE: u32 = u32::MAX;

/// Parameters of a dispatch.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Params {
    /// Grid point that positions are relative to.
    pub centre: [i32; 3],
    /// Spacing, Å.
    pub spacing: f32,
    /// Density at the surface.
    pub isovalue: f32,
    /// Squared relative distance u from which on the density is 0.
    pub support: f32,
    /// Gaussian: the exponent of 2 is `share − rate·u` per axis; three shares carry the amplitude.
    pub share: f32,
    /// Gaussian: see `share`.
    pub rate: f32,
    /// Gaussian: the cut-off's linear term is `tail_share + tail_rate·u` per axis.
    pub tail_share: f32,
    /// Gaussian: see `tail_share`.
    pub tail_rate: f32,
    /// Gaussian: the linear term at the support.
    pub tail_end: f32,
    /// Soft object, inverse square: factor of the density.
    pub amplitude: f32,
    /// Inverse square: minimum u, per 1/ρ².
    pub u_min: f32,
    /// Gaussian: the slope is `2^(slope_offset − rate·u) − slope_tail` up to a factor.
    pub slope_offset: f32,
    /// Gaussian: see `slope_offset`.
    pub slope_tail: f32,
    /// Maximum reach of an atom.
    pub reach: f32,
    /// Number of bricks before a brick, per axis, whose atoms may reach it.
    pub back: u32,
    /// Number of bricks behind a brick, per axis, whose atoms may reach it.
    pub ahead: u32,
    /// Number of tiles of the job.
    pub n_tiles: u32,
    /// Capacity of the blocks of sheets and the table of their offsets, in words.
    pub sheet_capacity: u32,
    /// First brick of the chunk.
    pub first_brick: u32,
    /// Number of the chunk's own bricks.
    pub n_own: u32,
    /// Number of halo bricks.
    pub n_halo: u32,
    /// Number of entries of the table that maps bricks behind the chunk to slots.
    pub n_halo_slots: u32,
    /// Capacity of the candidate lists, in entries.
    pub list_capacity: u32,
    /// Number of vertices before the chunk.
    pub first_vertex: u32,
    /// Number of triangles before the chunk.
    pub first_triangle: u32,
    /// First brick of the output piece.
    pub piece_brick: u32,
    /// Number of bricks of the output piece.
    pub piece_bricks: u32,
    /// Number of vertices before the output piece.
    pub piece_vertex: u32,
    /// Number of triangles before the output piece.
    pub piece_triangle: u32,
    /// Capacity of the vertex buffers.
    pub vertex_capacity: u32,
    /// Capacity of the triangle buffer.
    pub triangle_capacity: u32,
    /// Always 0, but unknown to the shader compiler; see `rounded` in `bin.wgsl`.
    pub zero: u32,
    /// Number of vertices in earlier partitions, which other devices compute.
    pub base_vertex: u32,
    /// Factor of positions before rounding to integers, 1/Å; 0 for vertices in single precision.
    pub steps_per_angstrom: f32,
    /// −dF/du is the slope times this.
    pub slope_scale: f32,
    /// Number of bricks of the job.
    pub n_bricks: u32,
    /// Surfaces of spheres: distance at the surface.
    pub level: f32,
    /// Surfaces of spheres: maximum distance of vertices from the surface.
    pub tolerance: f32,
    /// Number of kinds of candidates: 2 with the arcs of a boundary, else 1 (atoms).
    pub n_kinds: u32,
    /// Maximum reach of an arc.
    pub arc_reach: f32,
    /// Number of bricks before a brick, per axis, whose arcs may reach it.
    pub arc_back: u32,
    /// Number of bricks behind a brick, per axis, whose arcs may reach it.
    pub arc_ahead: u32,
}

/// Tile: 8 × 8 × 8 bricks, and one bit for each, set if the brick exists.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Tile {
    /// Coordinates, in tiles.
    pub coord: [i32; 3],
    /// Number of bricks in all earlier tiles.
    pub base: u32,
    /// Word z, lower half first; bit `8·y + x`.
    pub bricks: [[u32; 2]; 8],
    /// Number of bricks of the tile before each word.
    pub before: [u32; 8],
    /// Adjacent tiles, or [`NONE`]: entry `9·(z + 1) + 3·(y + 1) + (x + 1)`; the last is unused.
    pub around: [u32; 28],
}

/// Result of `classify` for a brick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct BrickRecord {
    /// Crossing edges: half-word `2·(3·z + axis) + half` of 32 bits; bit `8·y + x` of the owning grid point, the upper
    /// half from y = 4 on. Vertices are numbered in this order.
    pub crossing: [u32; 48],
    /// Per layer: number of vertices before it (16 bits), on its x edges (8 bits) and on its y edges (8 bits).
    pub layers: [u32; 8],
    /// Brick and its neighbours towards +x (bit 0), +y (bit 1) and +z (bit 2), or [`NONE`].
    pub neighbours: [u32; 8],
}

/// Counters that the stages update and the host reads back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct Counters {
    /// Number of entries in the candidate lists, including those beyond the capacity.
    pub list_end: u32,
    /// Number of vertices up to the end of the chunk.
    pub vertices: u32,
    /// Number of triangles up to the end of the chunk.
    pub triangles: u32,
    /// Number of vertices without a gradient.
    pub flat: u32,
    /// Sum of the shares of all directed edges, lower half first.
    pub checksum: [u32; 2],
    /// Number of triangles with a corner twice.
    pub degenerate: u32,
    /// Number of words of the blocks of sheets without the table of offsets, including those beyond the capacity.
    pub sheet_words: u32,
    /// Keys of the highest position per axis, and of the highest negative position: integers with the order of the
    /// numbers, in Å or steps.
    pub bounds: [u32; 6],
}

impl Counters {
    /// Returns the lowest and highest position per axis; `None` without vertices.
    #[must_use]
    pub fn position_bounds(&self) -> Option<[[f32; 3]; 2]> {
        let number = |key: u32| f32::from_bits(key ^ if key >> 31 == 1 { 1 << 31 } else { u32::MAX });
        let [x, y, z, low_x, low_y, low_z] = self.bounds.map(number);
        // Every number has a key above 0.
        self.bounds.iter().all(|&key| key > 0).then_some([[-low_x, -low_y, -low_z], [x, y, z]])
    }
}

/// Number of grid points of a brick.
pub const BRICK_POINTS: u64 = lattice::BRICK_POINTS as u64;
/// Bytes of the vertices' parameters on the edges of a brick: the largest buffer that grows with the bricks of a chunk.
pub const CROSSING_BYTES: u64 = 3 * 4 * BRICK_POINTS;
/// Number of bricks of a group; `classify` adds up the counts of each group for `scan`.
pub const GROUP: u32 = 1024;

/// Returns the case table in the layout of the shaders: the triangle count of each case, one per word; the same counts,
/// eight per word; the twelve edges of a cell and four unused words; and two words per case, with four bits per
/// triangle corner.
#[must_use]
pub fn case_table() -> Vec<u32> {
    let counts = || CASES.count.iter().map(|&n| u32::from(n));
    let eight: Vec<u32> = counts().collect();
    let packed = eight.chunks(8).map(|counts| counts.iter().rev().fold(0, |word, n| word << 4 | n));
    let edges = (0..16).map(|e| if e < 12 { edge_code(e) } else { 0 });
    let rows = CASES.triangles.iter().flat_map(|row| {
        let corners = row.as_flattened().iter().rev().fold(0_u64, |row, &edge| row << 4 | u64::from(edge));
        halves(corners)
    });
    counts().chain(packed).chain(edges).chain(rows).collect()
}

/// Offset of a cell's edge from the cell's grid point: 1 along x and 16 along y. Each group of four rows is a word of
/// edges, with an offset of 64; a layer has 3 words, including the first row of the next brick, and an axis has 9
/// layers.
fn edge_code(edge: u8) -> u32 {
    let CellEdge { offset, axis } = cell_edge(edge);
    let [x, y, z] = offset.map(u32::from);
    x + 16 * y + 64 * (3 * z + 27 * u32::from(axis))
}

/// Returns the lower and the upper 32 bits.
pub(super) fn halves(word: u64) -> [u32; 2] {
    let part = |v: u64| u32::try_from(v & u64::from(u32::MAX)).unwrap_or_default();
    [part(word), part(word >> 32)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_case_table_unpacks_to_the_cases() {
        let table = case_table();
        assert_eq!(table.len(), 256 + 32 + 16 + 2 * 256);
        for (e, &code) in (0..12).zip(&table[288..]) {
            let CellEdge { offset, axis } = cell_edge(e);
            let steps = [code & 15, code >> 4 & 3, (code >> 6) % 27 / 3].map(|step| u8::try_from(step).unwrap());
            assert_eq!((steps, code / (64 * 27)), (offset, u32::from(axis)), "edge {e}");
        }
        for case in 0..=255_u8 {
            let at = usize::from(case);
            let n = table[at] as usize;
            assert_eq!(table[256 + at / 8] as usize >> (4 * (at % 8)) & 15, n);
            let row = u64::from(table[304 + 2 * at]) | u64::from(table[305 + 2 * at]) << 32;
            let corners: Vec<u8> = (0..3 * n).map(|i| u8::try_from(row >> (4 * i) & 15).unwrap()).collect();
            assert_eq!(corners, CASES.of(case).as_flattened(), "case {case}");
        }
    }
}
