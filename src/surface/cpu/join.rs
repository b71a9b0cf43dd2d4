//! The sheets of all bricks joined into components.

use std::convert::Infallible;

use super::build::{Near, Written};
use super::tally::{Sheet, Tally};
use super::{PIECE_BRICKS, Piece, Scanned, threads};
use crate::surface::lattice::to_u32;
use crate::surface::measure::{Component, Measures};
use crate::surface::simd::dispatched;

/// Fewer pieces are not worth waking a thread for.
const FEW: usize = 64;

/// The measures of the mesh that the pieces make up; `None` if it is not closed, which the tallies cannot explain.
pub(super) fn measures(scanned: &Scanned, written: &[Written]) -> Option<Measures> {
    let Scanned { lattice, totals, pieces, .. } = scanned;
    let tallies: Vec<&Tally> = written.iter().map(|part| &part.tally).collect();
    let checksum = tallies.iter().fold(0_u64, |sum, tally| sum.wrapping_add(tally.checksum));
    if checksum != 0 || tallies.iter().any(|tally| tally.degenerate) {
        return None;
    }
    // Sheets are counted per piece: number them through.
    let mut n = 0;
    let first: Vec<usize> = tallies
        .iter()
        .map(|tally| {
            let first = n;
            n += tally.sheets.len();
            first
        })
        .collect();
    let pairs_of = |p: usize| Ok(pairs_of(scanned, &tallies, &first, p));
    let pairs = if pieces.len() < FEW {
        (0..pieces.len()).map(pairs_of).collect::<Result<Vec<_>, Infallible>>()
    } else {
        threads::each(pieces.len(), pairs_of)
    };
    let Ok(pairs) = pairs;
    let mut equal: Vec<u32> = (0..to_u32(n)).collect();
    let mut label = Vec::with_capacity(pieces.iter().map(|piece| piece.bricks.len()).sum());
    for (tally, first) in tallies.iter().zip(&first) {
        label.extend(tally.bricks.iter().map(|brick| to_u32(*first) + brick.first));
    }
    for (tally, first) in tallies.iter().zip(&first) {
        for [sheet, brick] in &tally.lone {
            unite(&mut equal, to_u32(*first) + sheet, label[*brick as usize]);
        }
    }
    for [a, b] in pairs.into_iter().flatten() {
        unite(&mut equal, a, b);
    }
    let mut components = vec![Component::default(); n];
    let sheets: Vec<&Sheet> = tallies.iter().flat_map(|tally| &tally.sheets).collect();
    for (label, sheet) in sheets.iter().enumerate() {
        // Ascending: the lower label that this one equals is final already.
        let of = equal[equal[label] as usize];
        equal[label] = of;
        sheet.add_to(&mut components[of as usize], sheets[of as usize], lattice.spacing);
    }
    for (component, sheet) in components.iter_mut().zip(&sheets) {
        sheet.refer_moment(component, lattice.centre, lattice.spacing);
    }
    Some(Measures::balanced(components, totals.vertices as u64, totals.triangles as u64))
}

dispatched! {
/// The pairs of sheets that the bricks of piece `p` share with their neighbours; `first` is each piece's first sheet.
fn pairs_of(scanned: &Scanned, tallies: &[&Tally], first: &[usize], p: usize) -> Vec<[u32; 2]> {
    let Scanned { tiles, done, pieces, .. } = scanned;
    let Piece { tile, bricks } = &pieces[p];
    let near = Near::new(tiles, done, done[*tile].coord);
    let mut pairs = Vec::new();
    let neighbour = |brick: usize, n: usize| {
        let slot = done[*tile].found.bricks[bricks.start + brick].slot;
        let (other, ix, numbered) = near.of(usize::from(slot), n)?;
        let piece = done[other].first_piece + ix / PIECE_BRICKS;
        Some((numbered, tallies[piece], (piece, ix % PIECE_BRICKS)))
    };
    tallies[p].pairs(neighbour, |own, (other, sheet)| {
        pairs.push([to_u32(first[p]) + own, to_u32(first[other]) + sheet]);
    });
    pairs
}
}

/// Makes two labels equal to the lower one's root.
fn unite(equal: &mut [u32], a: u32, b: u32) {
    let mut find = |mut label: u32| {
        while equal[label as usize] != label {
            // Every second entry on the way is shortened: paths stay short without a second pass.
            let above = equal[equal[label as usize] as usize];
            equal[label as usize] = above;
            label = above;
        }
        label
    };
    let (a, b) = (find(a), find(b));
    equal[a.max(b) as usize] = a.min(b);
}
