//! What lies in a device's buffers, as the shaders declare it. Lengths are in spacings of the lattice unless said
//! otherwise. The build reflects the shaders' structs, and a test compares every field with these.

use bytemuck::{Pod, Zeroable};

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
    /// Unused.
    pub pad: [u32; 2],
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
/// Words of the case table: the number of triangles of each case, then five triangles of each, four bits a corner.
pub const CASE_WORDS: usize = 256 + 5 * 256;

/// The case table as the shaders read it.
#[must_use]
pub fn case_table() -> Vec<u32> {
    use super::cases::CASES;
    let counts = CASES.count.iter().map(|&n| u32::from(n));
    let corners = |t: &[u8; 3]| t.iter().rev().fold(0, |word, &edge| word << 4 | u32::from(edge));
    counts.chain(CASES.triangles.iter().flatten().map(corners)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::cases::CASES;

    #[test]
    fn the_case_table_unpacks_to_the_cases() {
        let table = case_table();
        assert_eq!(table.len(), CASE_WORDS);
        for case in 0..=255_u8 {
            let at = usize::from(case);
            let n = table[at] as usize;
            let unpack = |word: u32| [0, 4, 8].map(|shift| u8::try_from(word >> shift & 15).unwrap());
            let rows: Vec<[u8; 3]> = table[256 + 5 * at..][..n].iter().map(|&word| unpack(word)).collect();
            assert_eq!(rows, CASES.of(case), "case {case}");
        }
    }
}
