//! Blocks of sheets that the stage `measure` writes on a device, and the measures of the mesh computed from them.

use std::ops::Range;

use molmesh_surface::join::{self, BrickSheets, SharedVertex, Sheet, SheetSums};
use molmesh_surface::lattice::to_u32;
use molmesh_surface::{Column, Measures};

use super::error::GpuError;
use super::plan::Plan;
use super::plan::layout::NONE;

/// Number of words of a block before its sheets, and of a sheet; as in `measure.wgsl`.
const HEADER: usize = 5;
const SHEET: usize = 12;
/// Number of bricks that a task reads.
const RUN: usize = 1024;

/// Sheets and checksum of a mesh or partition.
#[derive(Debug, Clone, Default)]
pub struct SheetBlocks {
    /// Blocks of all bricks, in pieces in the order of the bricks.
    pub(super) pieces: Vec<SheetPiece>,
    /// Sum of the shares of all directed edges.
    pub(super) checksum: u64,
    /// True if a triangle has a corner twice.
    pub(super) degenerate: bool,
}

/// Blocks of a run of bricks.
#[derive(Debug, Clone)]
pub(super) struct SheetPiece {
    pub(super) n_bricks: u32,
    /// Table of the offset of each brick's block, [`NONE`] if the surface does not intersect the brick; followed by the
    /// blocks in any order.
    pub(super) words: Column<u32>,
}

/// Block of one brick.
struct SheetBlock<'a> {
    origin: [i32; 3],
    sheets: &'a [[u32; SHEET]],
    /// Vertices that the brick shares with other bricks; empty unless it has several sheets.
    vertices: &'a [u32],
}

impl SheetBlocks {
    /// Returns the blocks of `n_bricks` bricks that the surface does not intersect: those of an empty mesh.
    #[must_use]
    pub fn without_surface(n_bricks: usize) -> Self {
        let piece = SheetPiece { n_bricks: to_u32(n_bricks), words: vec![NONE; n_bricks].into() };
        Self { pieces: vec![piece], checksum: 0, degenerate: false }
    }

    /// Adds the blocks of the next partition.
    pub(super) fn append(&mut self, next: Self) {
        self.pieces.extend(next.pieces);
        self.checksum = self.checksum.wrapping_add(next.checksum);
        self.degenerate |= next.degenerate;
    }

    /// Returns the measures of a mesh of `plan` with the given numbers of vertices and triangles; `None` if it is not
    /// closed. `unit` is the length of the unit of the sums, Å.
    ///
    /// # Errors
    /// [`GpuError::Failed`] if the blocks contradict each other or the mesh.
    pub(super) fn measures(&self, plan: &Plan, unit: f64, size: [usize; 2]) -> Result<Option<Measures>, GpuError> {
        let n_bricks = plan.bricks.len();
        let n_listed: usize = self.pieces.iter().map(|piece| piece.n_bricks as usize).sum();
        if n_listed != n_bricks {
            return Err(GpuError::Failed(format!("found sheets of {n_listed} bricks, expected {n_bricks}")));
        }
        let run = |n: usize| self.sums(n * RUN..n_bricks.min((n + 1) * RUN));
        let runs = join::each(n_bricks.div_ceil(RUN), run);
        let mut runs: Vec<(SheetSums, [usize; 2])> = runs.into_iter().collect::<Result<_, GpuError>>()?;
        let found = runs.iter().fold([0; 2], |sum, (_, size)| [sum[0] + size[0], sum[1] + size[1]]);
        if found != size {
            return Err(GpuError::Failed(format!(
                "the sheets have {found:?} vertices and triangles, the mesh {size:?}"
            )));
        }
        if let Some((first, _)) = runs.first_mut() {
            (first.checksum, first.degenerate) = (self.checksum, self.degenerate);
        }
        let near = |run: usize| {
            move |brick: usize, n: usize| {
                let other = plan.neighbour(plan.bricks[run * RUN + brick], to_u32(n))? as usize;
                Some((other / RUN, other % RUN))
            }
        };
        let runs: Vec<&SheetSums> = runs.iter().map(|(sums, _)| sums).collect();
        Ok(join::measures(&runs, near, unit, size))
    }

    /// Sums of a run of bricks, with its numbers of vertices and triangles.
    fn sums(&self, bricks: Range<usize>) -> Result<(SheetSums, [usize; 2]), GpuError> {
        let (mut sums, mut size) = (SheetSums::default(), [0; 2]);
        sums.bricks.reserve_exact(bricks.len());
        let mut first = 0;
        for SheetPiece { n_bricks, words } in &self.pieces {
            let end = first + *n_bricks as usize;
            for brick in bricks.start.max(first)..bricks.end.min(end) {
                match words.get(brick - first) {
                    Some(&NONE) => add(&mut sums, None)?,
                    Some(&at) => add(&mut sums, Some(SheetBlock::read(words, brick, at)?))?,
                    None => return Err(GpuError::Failed(format!("the table of sheets lacks brick {brick}"))),
                }
            }
            first = end;
        }
        for sheet in &sums.sheets {
            size[0] += sheet.vertices as usize;
            size[1] += sheet.triangles as usize;
        }
        Ok((sums, size))
    }
}

impl<'a> SheetBlock<'a> {
    /// Reads the block of `brick`, which begins at `at`.
    fn read(words: &'a [u32], brick: usize, at: u32) -> Result<Self, GpuError> {
        let block = words.get(at as usize..).and_then(|words| {
            let (&[found, counts, x, y, z], rest) = words.split_first_chunk::<HEADER>()?;
            let [n_sheets, n_vertices] = [counts & 0xffff, counts >> 16].map(|n| n as usize);
            let (sheets, rest) = rest.split_at_checked(SHEET * n_sheets)?;
            let vertices = rest.get(..n_vertices)?;
            let sheets = sheets.as_chunks().0;
            let block = Self { origin: [x, y, z].map(u32::cast_signed), sheets, vertices };
            (found as usize == brick && n_sheets > 0).then_some(block)
        });
        block.ok_or_else(|| GpuError::Failed(format!("no block of brick {brick} at word {at} of {}", words.len())))
    }
}

/// Adds the next brick.
fn add(sums: &mut SheetSums, block: Option<SheetBlock<'_>>) -> Result<(), GpuError> {
    let SheetBlock { origin, sheets, vertices } =
        block.unwrap_or(SheetBlock { origin: [0; 3], sheets: &[], vertices: &[] });
    let n = narrow(to_u32(sheets.len()))?;
    let start = sums.near.len();
    let [first, near, far] = [sums.sheets.len(), start, sums.far.len()].map(to_u32);
    sums.bricks.push(BrickSheets { first, n, near, far });
    sums.sheets.extend(sheets.iter().map(|words| sheet(origin, words)));
    for word in vertices {
        let [owner, ..] = (word & 7).to_le_bytes();
        let (key, sheet) = (narrow(word >> 3 & 0x7ff)?, narrow(word >> 14)?);
        if sheet >= n {
            return Err(GpuError::Failed(format!("a vertex lies on sheet {sheet}, its brick has {n} sheets")));
        }
        let column = if owner == 0 { &mut sums.near } else { &mut sums.far };
        column.push(SharedVertex { owner, key, sheet });
    }
    // Devices order vertices by axis first. A stable sort merges these three ascending runs.
    sums.near[start..].sort_by_key(|vertex| vertex.key);
    Ok(())
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

    /// Number of components of a mesh of three bricks in two pieces, with the given numbers of vertices and triangles.
    /// `offsets` is the table of the bricks' blocks.
    fn components(
        offsets: [u32; 3],
        blocks: &[Vec<u32>],
        checksum: u64,
        size: [usize; 2],
    ) -> Result<Option<usize>, GpuError> {
        let plan = Plan { bricks: vec![0, 1, 2], ..Plan::default() };
        let piece = |offsets: &[u32]| SheetPiece {
            n_bricks: to_u32(offsets.len()),
            words: [offsets, &blocks.concat()].concat().into(),
        };
        let pieces = vec![piece(&offsets[..1]), piece(&offsets[1..])];
        let sheets = SheetBlocks { pieces, checksum, degenerate: false };
        Ok(sheets.measures(&plan, 1.0, size)?.map(|measures| measures.components.len()))
    }

    #[test]
    fn blocks_that_contradict_each_other_or_the_mesh_are_rejected() {
        let block_2 = 2 + to_u32(HEADER + SHEET);
        assert_eq!(components([1, NONE, block_2], &[block(0), block(2)], 0, [8, 8]), Ok(Some(2)));
        assert_eq!(components([NONE, NONE, 2], &[block(2)], 7, [4, 4]), Ok(None), "not closed");
        let mut on_another_sheet = block(1);
        on_another_sheet[1] |= 1 << 16;
        on_another_sheet.push(1 << 14);
        for (what, offset, block, size) in [
            ("the block of another brick", 2, block(2), [4, 4]),
            ("a block beyond the end", 40, block(1), [4, 4]),
            ("a short block", 2, block(1)[..HEADER + SHEET - 1].to_vec(), [4, 4]),
            ("a block without sheets", 2, vec![1, 0, 0, 0, 0], [0, 0]),
            ("another number of triangles", 2, block(1), [4, 5]),
            ("a vertex on another sheet", 2, on_another_sheet, [4, 4]),
        ] {
            let found = components([NONE, offset, NONE], &[block], 0, size);
            assert!(matches!(found, Err(GpuError::Failed(_))), "{what}: {found:?}");
        }
        let plan = Plan { bricks: vec![0], ..Plan::default() };
        let found = SheetBlocks::default().measures(&plan, 1.0, [0, 0]);
        assert!(matches!(found, Err(GpuError::Failed(_))), "no entries: {found:?}");
    }
}
