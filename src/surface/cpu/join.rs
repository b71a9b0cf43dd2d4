//! Connected components: the sheets of all bricks, joined across the bricks' borders.

use rayon::prelude::*;

use super::piece_sums::{PieceSums, Sheet};
use super::write::{PieceSummary, TileNeighbours};
use super::{PIECE_BRICKS, Piece, Scanned};
use crate::surface::lattice::to_u32;
use crate::surface::measure::{Component, Measures};
use crate::surface::simd::dispatched;
use crate::surface::union_find::UnionFind;

/// Measures of the mesh that the pieces make up; `None` if it is not closed, as its edges then have to be counted.
pub(super) fn measures(scanned: &Scanned, written: &[PieceSummary]) -> Option<Measures> {
    let Scanned { lattice, totals, pieces, .. } = scanned;
    let all_sums: Vec<&PieceSums> = written.iter().map(|piece| &piece.sums).collect();
    let checksum = all_sums.iter().fold(0_u64, |sum, sums| sum.wrapping_add(sums.checksum));
    if checksum != 0 || all_sums.iter().any(|sums| sums.degenerate) {
        return None;
    }
    // Sheets are numbered per piece: these are the first numbers of the pieces in the mesh.
    let mut n = 0;
    let mut first = Vec::with_capacity(all_sums.len());
    for sums in &all_sums {
        first.push(to_u32(n));
        n += sums.sheets.len();
    }
    let pairs: Vec<Vec<[u32; 2]>> =
        (0..pieces.len()).into_par_iter().map(|p| pairs_of(scanned, &all_sums, &first, p)).collect();
    let mut joined = UnionFind::new(n);
    let mut of_brick = Vec::with_capacity(pieces.iter().map(|piece| piece.bricks.len()).sum());
    for (sums, first) in all_sums.iter().zip(&first) {
        of_brick.extend(sums.bricks.iter().map(|brick| first + brick.first));
    }
    for (sums, first) in all_sums.iter().zip(&first) {
        sums.lone.iter().for_each(|[sheet, brick]| joined.union(first + sheet, of_brick[*brick as usize]));
    }
    pairs.into_iter().flatten().for_each(|[a, b]| joined.union(a, b));
    let mut components = vec![Component::default(); n];
    let sheets: Vec<&Sheet> = all_sums.iter().flat_map(|sums| &sums.sheets).collect();
    for (sheet, of) in sheets.iter().zip(joined.into_representatives()) {
        sheet.add_to(&mut components[of as usize], sheets[of as usize], lattice.spacing);
    }
    for (component, sheet) in components.iter_mut().zip(&sheets) {
        sheet.refer_moment(component, lattice.centre, lattice.spacing);
    }
    Some(Measures::balanced(components, totals.vertices as u64, totals.triangles as u64))
}

dispatched! {
/// Pairs of sheets that the bricks of piece `p` share with their neighbours; `first` is the first sheet of each piece.
fn pairs_of(scanned: &Scanned, all_sums: &[&PieceSums], first: &[u32], p: usize) -> Vec<[u32; 2]> {
    let Scanned { tiles, done, pieces, .. } = scanned;
    let Piece { tile, bricks } = &pieces[p];
    let near = TileNeighbours::new(tiles, done, done[*tile].coord);
    let mut pairs = Vec::new();
    let neighbour = |brick: usize, n: usize| {
        let slot = done[*tile].found.bricks[bricks.start + brick].slot;
        let (other, ix, numbered) = near.of(usize::from(slot), n)?;
        let piece = done[other].first_piece + ix / PIECE_BRICKS;
        Some((numbered, all_sums[piece], (piece, ix % PIECE_BRICKS)))
    };
    all_sums[p].pairs(neighbour, |own, (other, sheet)| pairs.push([first[p] + own, first[other] + sheet]));
    pairs
}
}
