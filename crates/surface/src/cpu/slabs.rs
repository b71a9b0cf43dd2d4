//! Work items of the first pass: whole tiles, or slabs of large tiles, which would keep one thread busy while the
//! others are idle.
//!
//! The result does not depend on the split: the results of a slab are those of the whole tile in these layers, and
//! slabs are joined in order.

use std::cmp::Reverse;
use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use rustc_hash::FxHashMap;

use super::bin::{SIDE, Tiles};
use super::{NO_BRICK, Tile};

/// Layers of a tile's bricks that one thread evaluates at once.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Slab {
    /// The tile.
    pub(super) tile: usize,
    /// Range among its eight layers.
    pub(super) layers: Range<usize>,
}

/// Maximum number of slabs per tile: each evaluates one extra layer of grid points.
const MAX_SLABS: usize = 4;

/// Splits large tiles into slabs for `threads` idle threads. Splitting a small structure for 16 threads costs 20 to 40
/// % more CPU time in the first pass. The largest items come first, so that no thread works alone at the end.
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

/// Returns the number of slabs of a tile with `own` of `all` atoms: several if it exceeds one thread's share, each
/// about two thirds of a share.
fn pieces(own: usize, all: usize, threads: usize) -> usize {
    if own * threads <= all { 1 } else { (3 * own * threads).div_ceil(2 * all).next_power_of_two().min(MAX_SLABS) }
}

/// Tiles of which only some slabs have been evaluated.
#[derive(Default)]
pub(super) struct PartialTiles(Mutex<FxHashMap<usize, Vec<(usize, Tile)>>>);

impl PartialTiles {
    /// Adds the results of `slab` to the tile's other slabs. Returns the joined tile after the last slab; the calling
    /// thread joins it while others continue.
    pub(super) fn add(&self, slab: &Slab, tile: Tile) -> Option<Tile> {
        if slab.layers.len() == SIDE - 1 {
            return Some(tile);
        }
        let mut parts = {
            // Poisoning is ignored: a panic elsewhere ends the run, and the data stays valid.
            let mut partial_tiles = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            let parts = partial_tiles.entry(slab.tile).or_default();
            parts.push((slab.layers.start, tile));
            let complete = parts.len() * slab.layers.len() == SIDE - 1;
            complete.then(|| partial_tiles.remove(&slab.tile)).flatten()?
        };
        parts.sort_unstable_by_key(|(layer, _)| *layer);
        let mut parts = parts.into_iter().map(|(_, tile)| tile);
        let mut joined = parts.next()?;
        for part in parts {
            let before = joined.found.bricks.len();
            for (to, from) in joined.bricks.iter_mut().zip(&part.bricks).filter(|(_, from)| **from != NO_BRICK) {
                // A tile has 512 bricks.
                *to = u16::try_from(before + usize::from(*from)).unwrap_or(NO_BRICK);
            }
            joined.found.append(&part.found);
        }
        Some(joined)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Control;
    use crate::cpu::{RunContext, Scanned, scan};
    use crate::params::{SurfaceLimits, SurfaceParams};
    use crate::spheres::Spheres;

    #[test]
    fn tiles_above_a_threads_share_are_split() {
        // A single tile; a quarter of all atoms; hardly any.
        assert_eq!([1, 2, 3, 16].map(|threads| pieces(100, 100, threads)), [1, 4, 4, 4]);
        assert_eq!([1, 4, 5, 8, 16].map(|threads| pieces(25, 100, threads)), [1, 1, 2, 4, 4]);
        assert_eq!([1, 16, 64].map(|threads| pieces(1, 100, threads)), [1, 1, 1]);
    }

    /// Scans spheres in a box over eight tiles, some of which hold many more than others.
    fn scanned(free_threads: usize) -> Scanned {
        let column = |step: f64| (0..900).map(|i| 6.0 + 40.0 * (f64::from(i) * step).fract()).collect::<Vec<_>>();
        let spheres = Spheres::new(column(0.37), column(0.713), column(0.271), vec![1.6; 900]).unwrap();
        let (params, limits) = (SurfaceParams::default(), SurfaceLimits::default());
        let context = RunContext { params: &params, limits: &limits, control: &Control::default(), free_threads };
        scan(&spheres, context).unwrap()
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
    fn slabs_find_the_same_as_the_whole_tile() {
        let described = |scanned: &Scanned| (format!("{:?}", scanned.done), format!("{:?}", scanned.grid));
        let whole = scanned(1);
        let expected = described(&whole);
        assert!(
            whole.done.iter().any(|tile| !tile.found.sheets.is_empty()),
            "bricks with several sheets are among them"
        );
        for threads in [3, 8, 16] {
            assert!(described(&scanned(threads)) == expected, "{threads} threads");
        }
    }
}
