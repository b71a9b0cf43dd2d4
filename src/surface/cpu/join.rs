//! The sheets of all bricks joined into components.

use rayon::prelude::*;

use super::Scanned;
use super::build::{Near, Written};
use super::tally::Tally;
use crate::surface::lattice::to_u32;
use crate::surface::measure::{Component, Measures};

/// The measures of the mesh that the tiles wrote; `None` if it is not closed, which the tallies cannot explain.
pub(super) fn measures(scanned: &Scanned, written: &[Written]) -> Option<Measures> {
    let Scanned { tiles, done, totals, .. } = scanned;
    let tallies: Vec<&Tally> = written.iter().map(|part| &part.tally).collect();
    let checksum = tallies.iter().fold(0_u64, |sum, tally| sum.wrapping_add(tally.checksum));
    if checksum != 0 || tallies.iter().any(|tally| tally.degenerate) {
        return None;
    }
    // Sheets are counted per tile: number them through.
    let mut n = 0;
    let first: Vec<usize> = tallies
        .iter()
        .map(|tally| {
            let first = n;
            n += tally.sheets.len();
            first
        })
        .collect();
    let pairs: Vec<Vec<[u32; 2]>> = (0..done.len())
        .into_par_iter()
        .map(|t| {
            let near = Near::new(tiles, done, done[t].coord);
            let mut pairs = Vec::new();
            let neighbour = |brick: usize, n: usize| {
                let (other, ix, numbered) = near.of(usize::from(done[t].found.bricks[brick].slot), n)?;
                Some((numbered, tallies[other], (other, ix)))
            };
            tallies[t].pairs(neighbour, |own, (other, sheet)| {
                pairs.push([to_u32(first[t]) + own, to_u32(first[other]) + sheet]);
            });
            pairs
        })
        .collect();
    let mut equal: Vec<u32> = (0..to_u32(n)).collect();
    for [a, b] in pairs.into_iter().flatten() {
        unite(&mut equal, a, b);
    }
    let mut components = vec![Component::default(); n];
    for (label, sheet) in tallies.iter().flat_map(|tally| &tally.sheets).enumerate() {
        // Ascending: the lower label that this one equals is final already.
        equal[label] = equal[equal[label] as usize];
        let component = &mut components[equal[label] as usize];
        component.triangles += sheet.triangles;
        component.vertices += sheet.vertices;
        component.area += sheet.area;
        component.volume += sheet.volume;
    }
    Some(Measures::balanced(components, totals.vertices as u64, totals.triangles as u64))
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
