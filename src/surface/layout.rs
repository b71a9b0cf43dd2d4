//! What lies in a device's buffers, as the shaders declare it. Lengths are in spacings of the lattice unless said
//! otherwise. The build reflects the shaders' structs, and a test compares every field with these.

use bytemuck::{Pod, Zeroable};

use super::cases::{CASES, CellEdge, cell_edge};

/// Marks a tile or brick that does not exist.
pub const NONE: u32 = u32::MAX;

/// What a dispatch needs to know.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Params {
    /// The sample that positions are relative to.
    pub centre: [i32; 3],
    /// Spacing, Å.
    pub spacing: f32,
    /// The density of the surface.
    pub isovalue: f32,
    /// u from which on the density is 0.
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
    /// Inverse square: least u, per 1/ρ².
    pub u_min: f32,
    /// Gaussian: the slope is `2^(slope_offset − rate·u) − slope_tail` up to a factor.
    pub slope_offset: f32,
    /// Gaussian: see `slope_offset`.
    pub slope_tail: f32,
    /// The longest reach of an atom.
    pub reach: f32,
    /// Bricks before a brick, per axis, in which atoms that reach it can live.
    pub back: u32,
    /// Bricks behind it.
    pub ahead: u32,
    /// Tiles of the job.
    pub n_tiles: u32,
    /// Bricks of the job.
    pub n_bricks: u32,
    /// First brick of the chunk.
    pub first_brick: u32,
    /// Its bricks.
    pub n_own: u32,
    /// Bricks of later chunks whose samples it needs.
    pub n_halo: u32,
    /// Entries of the table from bricks behind the chunk to its slots.
    pub n_halo_slots: u32,
    /// Entries that its candidate lists may take.
    pub list_capacity: u32,
    /// Vertices before the chunk.
    pub first_vertex: u32,
    /// Triangles before the chunk.
    pub first_triangle: u32,
    /// First brick of the piece of output at hand.
    pub piece_brick: u32,
    /// Bricks of the piece.
    pub piece_bricks: u32,
    /// Vertices before the piece.
    pub piece_vertex: u32,
    /// Triangles before the piece.
    pub piece_triangle: u32,
    /// Vertices that the piece's buffers hold.
    pub vertex_capacity: u32,
    /// Triangles that the piece's buffer holds.
    pub triangle_capacity: u32,
    /// 0, which the shaders' compiler must not know.
    pub zero: u32,
    /// Vertices before the first that the device's own numbers count: those of other devices' parts.
    pub base_vertex: u32,
    /// What positions are multiplied by before they are rounded, 1/Å; 0: vertices are single-precision numbers.
    pub steps_per_angstrom: f32,
}

/// A tile: 8 × 8 × 8 bricks, of which those with a set bit exist.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Tile {
    /// Coordinates, in tiles.
    pub coord: [i32; 3],
    /// Bricks of all tiles before.
    pub base: u32,
    /// Word z, lower half first; bit `8·y + x`.
    pub bricks: [[u32; 2]; 8],
    /// Bricks of the tile before each word.
    pub before: [u32; 8],
    /// Tiles around, or [`NONE`]: entry `9·(z + 1) + 3·(y + 1) + (x + 1)`; the last is unused.
    pub around: [u32; 28],
}

/// What `classify` keeps of a brick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
#[repr(C)]
pub struct Record {
    /// Crossing edges: half-word `2·(3·z + axis) + half` of 32 bits; bit `8·y + x` of the owning sample, the upper half
    /// from y = 4 on. Vertices are numbered in this order.
    pub crossing: [u32; 48],
    /// Per layer the vertices before it (16 bits), those of its x edges (8) and of its y edges (8).
    pub layers: [u32; 8],
    /// The brick and its neighbours towards +x (bit 0), +y (1), +z (2), or [`NONE`].
    pub near: [u32; 8],
}

/// Counters that the host reads back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Pod, Zeroable)]
#[repr(C)]
pub struct Tally {
    /// Entries that the candidate lists take, or would.
    pub list_end: u32,
    /// Vertices up to the end of the chunk.
    pub vertices: u32,
    /// Triangles likewise.
    pub triangles: u32,
    /// Vertices without a gradient.
    pub flat: u32,
}

/// Samples of a brick.
pub const SAMPLES: u64 = 512;
/// Bricks of a group, whose counts `classify` adds up for `scan`.
pub const GROUP: u32 = 1024;
/// Words of the case table: the number of triangles of each case; the same, eight cases a word; the twelve edges of a
/// cell, and four words of nothing; then two words a case, four bits a corner of its triangles.
pub const CASE_WORDS: usize = 256 + 32 + 16 + 2 * 256;

/// The case table as the shaders read it.
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

/// An edge of a cell as a step from the cell's sample to its own: 1 along x, 16 along y. Behind four rows begins another
/// word of edges, worth 64; a layer has 3 of them, with the first row of the brick behind, and an axis 9 layers.
fn edge_code(edge: u8) -> u32 {
    let CellEdge { offset, axis } = cell_edge(edge);
    let [x, y, z] = offset.map(u32::from);
    x + 16 * y + 64 * (3 * z + 27 * u32::from(axis))
}

/// The lower and the upper 32 bits.
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
        assert_eq!(table.len(), CASE_WORDS);
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
