//! How the first pass is shared out: whole tiles, or slabs of those that would keep one thread busy when the others have
//! nothing left.
//!
//! What comes out is the same, as a slab finds what the tile would have found in its layers, and slabs are joined in order.

use std::cmp::Reverse;
use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use rustc_hash::FxHashMap;

use super::bin::{SIDE, Tiles};
use super::classify::Found;
use super::{NO_BRICK, Tile};
use crate::surface::lattice::BRICK_SAMPLES;

/// Layers of a tile's bricks that one thread samples in one go.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Slab {
    /// The tile.
    pub(super) tile: usize,
    /// Which of its eight layers.
    pub(super) layers: Range<usize>,
}

/// Slabs of a tile at most: each has to evaluate one layer of samples beyond its own.
const MAX_SLABS: usize = 4;

/// Cuts the tiles for so many threads that have nothing else to do: cut for sixteen, the first pass over a small
/// structure takes a fifth to two fifths more of their time, which belongs to others where there are any. The largest
/// comes first, so that none is left over at the end for one thread alone.
pub(super) fn cut(tiles: &Tiles, threads: usize) -> Vec<Slab> {
    let atoms = |t: usize| tiles.atoms(t).len();
    let all = (0..tiles.len()).map(atoms).sum();
    let mut slabs = Vec::with_capacity(tiles.len());
    for t in 0..tiles.len() {
        let n = pieces(atoms(t), all, threads);
        let depth = (SIDE - 1) / n;
        slabs.extend((0..n).map(|i| (atoms(t) / n, Slab { tile: t, layers: i * depth..(i + 1) * depth })));
    }
    slabs.sort_by_key(|(atoms, _)| Reverse(*atoms));
    slabs.into_iter().map(|(_, slab)| slab).collect()
}

/// Slabs of a tile with `own` of `all` atoms: several if it is more than one of the threads' share, each some two thirds
/// of a share then.
fn pieces(own: usize, all: usize, threads: usize) -> usize {
    if own * threads <= all { 1 } else { (3 * own * threads).div_ceil(2 * all).next_power_of_two().min(MAX_SLABS) }
}

/// Tiles of which some slabs were sampled and others were not.
#[derive(Default)]
pub(super) struct Unfinished(Mutex<FxHashMap<usize, Vec<(usize, Tile)>>>);

impl Unfinished {
    /// Puts `tile`, with what was found in `slab`, to the tile's other slabs. Returns the whole tile when this was the last:
    /// whoever finishes it joins it, while others are at work.
    pub(super) fn add(&self, slab: &Slab, tile: Tile) -> Option<Tile> {
        if slab.layers.len() == SIDE - 1 {
            return Some(tile);
        }
        let mut parts = {
            // A panic elsewhere ends the run; what is here is still good.
            let mut unfinished = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            let parts = unfinished.entry(slab.tile).or_default();
            parts.push((slab.layers.start, tile));
            let complete = parts.len() * slab.layers.len() == SIDE - 1;
            complete.then(|| unfinished.remove(&slab.tile)).flatten()?
        };
        parts.sort_unstable_by_key(|(layer, _)| *layer);
        let all: Vec<&Found> = parts.iter().map(|(_, tile)| &tile.found).collect();
        let mut found = Found::with_room_for(&all);
        let mut bricks = vec![NO_BRICK; BRICK_SAMPLES];
        for (_, part) in &parts {
            let before = found.bricks.len();
            for (to, from) in bricks.iter_mut().zip(&part.bricks).filter(|(_, from)| **from != NO_BRICK) {
                // A tile has 512 bricks.
                *to = u16::try_from(before + usize::from(*from)).unwrap_or(NO_BRICK);
            }
            found.append(&part.found);
        }
        let (_, tile) = parts.pop()?;
        Some(Tile { found, bricks, ..tile })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::control::Control;
    use crate::surface::cpu::{Means, Scanned, scan};
    use crate::surface::params::{SurfaceLimits, SurfaceParams};
    use crate::surface::spheres::Spheres;

    #[test]
    fn a_tile_is_cut_where_it_is_more_than_a_threads_share() {
        // One tile alone; a quarter of all; hardly any.
        assert_eq!([1, 2, 3, 16].map(|threads| pieces(100, 100, threads)), [1, 4, 4, 4]);
        assert_eq!([1, 4, 5, 8, 16].map(|threads| pieces(25, 100, threads)), [1, 1, 2, 4, 4]);
        assert_eq!([1, 16, 64].map(|threads| pieces(1, 100, threads)), [1, 1, 1]);
    }

    /// Spheres in a box over eight tiles, some of which hold much more than others.
    fn scanned(free_threads: usize) -> Scanned {
        let column = |step: f64| (0..900).map(|i| 6.0 + 40.0 * (f64::from(i) * step).fract()).collect::<Vec<_>>();
        let spheres = Spheres::new(column(0.37), column(0.713), column(0.271), vec![1.6; 900]).unwrap();
        let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
        let means = Means { params: &params, limits: &limits, control: &Control::default(), free_threads };
        scan(&spheres, means).unwrap()
    }

    #[test]
    fn slabs_cover_every_layer_once_and_the_largest_come_first() {
        let tiles = scanned(1).tiles;
        for threads in [1, 2, 5, 16] {
            let slabs = cut(&tiles, threads);
            for t in 0..tiles.len() {
                let mut layers: Vec<usize> =
                    slabs.iter().filter(|s| s.tile == t).flat_map(|s| s.layers.clone()).collect();
                layers.sort_unstable();
                assert_eq!(layers, (0..8).collect::<Vec<_>>(), "tile {t} on {threads} threads");
            }
            let atoms = |slab: &Slab| tiles.atoms(slab.tile).len() * slab.layers.len() / 8;
            assert!(slabs.is_sorted_by_key(|slab| Reverse(atoms(slab))), "{threads} threads");
            assert_eq!(slabs.len() > tiles.len(), threads > 2, "{threads} threads: {} of {}", slabs.len(), tiles.len());
        }
    }

    #[test]
    fn what_slabs_find_is_what_the_tile_finds() {
        let told = |scanned: &Scanned| (format!("{:?}", scanned.done), format!("{:?}", scanned.grid));
        let whole = scanned(1);
        let expected = told(&whole);
        assert!(
            whole.done.iter().any(|tile| !tile.found.sheets.is_empty()),
            "bricks with several sheets are among them"
        );
        for threads in [3, 8, 16] {
            assert!(told(&scanned(threads)) == expected, "{threads} threads");
        }
    }
}
