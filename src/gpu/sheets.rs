//! Blocks of the stage `measure`, as devices write them, and the measures of the mesh that they give.

use rayon::prelude::*;

use super::error::GpuError;
use super::plan::Plan;
use super::plan::layout::NONE;
use crate::surface::join::{self, BrickSheets, SharedVertex, Sheet, SheetSums};
use crate::surface::lattice::to_u32;
use crate::surface::{Column, Measures};

/// Words of a block before its sheets, and words of a sheet; as in `measure.wgsl`.
const HEADER: usize = 5;
const SHEET: usize = 12;
/// Bricks that are joined with their neighbours at once.
const RUN: usize = 1024;

/// Sheets and checksum of a mesh or partition.
#[derive(Debug, Clone, Default)]
pub struct SheetBlocks {
    /// Blocks of the bricks that the surface intersects, in any order.
    pub(super) words: Column<u32>,
    /// Sum of the shares of all directed edges.
    pub(super) checksum: u64,
    /// True if a triangle has a corner twice.
    pub(super) degenerate: bool,
}

/// Block of one brick.
#[derive(Clone, Copy)]
struct Block<'a> {
    origin: [i32; 3],
    sheets: &'a [[u32; SHEET]],
    /// Vertices that it shares with other bricks, if it has several sheets.
    vertices: &'a [u32],
}

impl SheetBlocks {
    /// Adds the blocks of the next partition.
    pub(super) fn append(&mut self, next: Self) {
        self.words.append(next.words);
        self.checksum = self.checksum.wrapping_add(next.checksum);
        self.degenerate |= next.degenerate;
    }

    /// Returns the measures of a mesh of `plan` with the given numbers of vertices and triangles; `None` if it is not
    /// closed. `unit` is the length of the unit of the sums, Å.
    ///
    /// # Errors
    /// [`GpuError::Failed`] if the blocks contradict each other or the mesh.
    pub(super) fn measures(&self, plan: &Plan, unit: f64, size: [usize; 2]) -> Result<Option<Measures>, GpuError> {
        let mut blocks = vec![None; plan.bricks.len()];
        for words in self.words.pieces() {
            place(words, &mut blocks)?;
        }
        // Bricks that the surface intersects, and the index of each brick among them.
        let (mut bricks, mut index) = (Vec::with_capacity(blocks.len()), vec![NONE; blocks.len()]);
        for (brick, block) in blocks.into_iter().enumerate() {
            if let Some(block) = block {
                index[brick] = to_u32(bricks.len());
                bricks.push((plan.bricks[brick], block));
            }
        }
        let mut runs: Vec<SheetSums> = bricks.par_chunks(RUN).map(sums).collect::<Result<_, GpuError>>()?;
        if let Some(first) = runs.first_mut() {
            (first.checksum, first.degenerate) = (self.checksum, self.degenerate);
        }
        let sheets = || runs.iter().flat_map(|run| &run.sheets);
        let found: [usize; 2] =
            [sheets().map(|s| s.vertices as usize).sum(), sheets().map(|s| s.triangles as usize).sum()];
        if found != size {
            return Err(GpuError::Failed(format!(
                "the sheets have {found:?} vertices and triangles, the mesh {size:?}"
            )));
        }
        let near = |run: usize| {
            let (bricks, index) = (&bricks[run * RUN..], &index);
            move |brick: usize, n: usize| {
                let other = plan.neighbour(bricks[brick].0, to_u32(n))?;
                let at = index[other as usize];
                (at != NONE).then_some((at as usize / RUN, at as usize % RUN))
            }
        };
        Ok(join::measures(&runs.iter().collect::<Vec<_>>(), near, unit, size))
    }
}

/// Stores the blocks in `words` at the indices of their bricks.
fn place<'a>(mut words: &'a [u32], blocks: &mut [Option<Block<'a>>]) -> Result<(), GpuError> {
    while let Some((&[brick, counts, x, y, z], rest)) = words.split_first_chunk::<HEADER>() {
        let [n_sheets, n_vertices] = [counts & 0xffff, counts >> 16].map(|n| n as usize);
        let parts = rest.split_at_checked(SHEET * n_sheets).and_then(|(sheets, rest)| {
            let (vertices, rest) = rest.split_at_checked(n_vertices)?;
            Some((sheets.as_chunks().0, vertices, rest))
        });
        let (place, (sheets, vertices, rest)) = match (blocks.get_mut(brick as usize), parts) {
            (Some(place @ None), Some(parts)) if n_sheets > 0 => (place, parts),
            _ => {
                return Err(GpuError::Failed(format!("no block of brick {brick} with {n_sheets} sheets was expected")));
            }
        };
        *place = Some(Block { origin: [x, y, z].map(u32::cast_signed), sheets, vertices });
        words = rest;
    }
    if words.is_empty() { Ok(()) } else { Err(GpuError::Failed(format!("{} words after the last block", words.len()))) }
}

/// Sums of a run of bricks.
fn sums(bricks: &[(u32, Block<'_>)]) -> Result<SheetSums, GpuError> {
    let mut sums = SheetSums::default();
    for (_, Block { origin, sheets, vertices }) in bricks {
        let n = narrow(to_u32(sheets.len()))?;
        let start = sums.near.len();
        let [first, near, far] = [sums.sheets.len(), start, sums.far.len()].map(to_u32);
        sums.bricks.push(BrickSheets { first, n, near, far });
        sums.sheets.extend(sheets.iter().map(|words| sheet(*origin, words)));
        for word in *vertices {
            let [owner, ..] = (word & 7).to_le_bytes();
            let (key, sheet) = (narrow(word >> 3 & 0x7ff)?, narrow(word >> 14)?);
            if sheet >= n {
                return Err(GpuError::Failed(format!("a vertex on sheet {sheet} of {n}")));
            }
            let column = if owner == 0 { &mut sums.near } else { &mut sums.far };
            column.push(SharedVertex { owner, key, sheet });
        }
        // Devices order vertices by axis first. A stable sort merges these three ascending runs.
        sums.near[start..].sort_by_key(|vertex| vertex.key);
    }
    Ok(sums)
}

fn narrow(n: u32) -> Result<u16, GpuError> {
    u16::try_from(n).map_err(|e| GpuError::Failed(format!("{n} in a block: {e}")))
}

/// Converts the words of a sheet, as `measure.wgsl` writes them.
fn sheet(origin: [i32; 3], words: &[u32; SHEET]) -> Sheet {
    let [counts, near, sums @ ..] = words;
    let [area, x, y, z, px, py, pz, mx, my, mz] = sums.map(|word| f64::from(f32::from_bits(word)));
    let [above, below, ..] = near.to_le_bytes();
    let (triangles, vertices) = (counts & 0xffff, counts >> 16);
    let (vector, product, moment) = ([x, y, z], [px, py, pz], [mx, my, mz]);
    Sheet { origin, triangles, vertices, above, below, area, vector, product, moment }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Block of a closed sheet with four vertices and triangles.
    fn block(brick: u32) -> Vec<u32> {
        let mut words = vec![brick, 1, 0, 0, 0, 4 | 4 << 16];
        words.resize(HEADER + SHEET, 0);
        words
    }

    /// Number of components of a mesh of three bricks and the given numbers of vertices and triangles.
    fn components(blocks: &[Vec<u32>], checksum: u64, size: [usize; 2]) -> Result<Option<usize>, GpuError> {
        let plan = Plan { bricks: vec![0, 1, 2], ..Plan::default() };
        let sheets = SheetBlocks { words: blocks.concat().into(), checksum, degenerate: false };
        Ok(sheets.measures(&plan, 1.0, size)?.map(|measures| measures.components.len()))
    }

    #[test]
    fn blocks_that_contradict_each_other_or_the_mesh_are_rejected() {
        assert_eq!(components(&[block(2), block(0)], 0, [8, 8]), Ok(Some(2)));
        assert_eq!(components(&[block(2)], 7, [4, 4]), Ok(None), "not closed");
        let mut on_another_sheet = block(1);
        on_another_sheet[1] |= 1 << 16;
        on_another_sheet.push(1 << 14);
        for (what, blocks, size) in [
            ("two blocks of a brick", vec![block(2), block(2)], [8, 8]),
            ("no such brick", vec![block(3)], [4, 4]),
            ("a short block", vec![block(1)[..HEADER + SHEET - 1].to_vec()], [4, 4]),
            ("a block without sheets", vec![vec![1, 0, 0, 0, 0]], [0, 0]),
            ("a word too many", vec![block(1), vec![5]], [4, 4]),
            ("another number of triangles", vec![block(1)], [4, 5]),
            ("a vertex on another sheet", vec![on_another_sheet], [4, 4]),
        ] {
            let found = components(&blocks, 0, size);
            assert!(matches!(found, Err(GpuError::Failed(_))), "{what}: {found:?}");
        }
    }
}
