//! A plan's bricks cut into parts for several devices, and what one part takes from the others.
//!
//! A part is a run of tiles. Its last cells have corners in bricks of later parts: it computes their samples again, as a
//! chunk does, but which of their edges are crossed, and what the vertices there are called, only their owner knows.

use std::ops::Range;

use super::lattice::{tile_order, to_u32};
use super::plan::Plan;

/// Runs of bricks or atoms with fewer than so many others between them are taken as one: a copy more costs more than
/// those.
const GAP: u32 = 64;

/// A run of tiles that one device works on.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Part {
    /// Its tiles, by their place in the plan.
    pub tiles: Range<usize>,
    /// Its bricks.
    pub bricks: Range<u32>,
    /// Bricks of later parts that it needs the records of, as runs in ascending order. A run may hold others too, but lies
    /// within one part.
    pub borrowed: Vec<Range<u32>>,
}

impl Plan {
    /// Cuts the bricks into `n` parts of about equally many, fewer where there are not as many tiles.
    #[must_use]
    pub fn parts(&self, n: usize) -> Vec<Part> {
        let total = self.bricks.len() as u64;
        let n = n.clamp(1, self.tiles.len().max(1)) as u64;
        let mut cuts: Vec<usize> = (1..n)
            .map(|i| {
                // The tile's border that is nearest to an equal share.
                let share = to_u32(usize::try_from(total * i / n).unwrap_or(usize::MAX));
                let after = self.tiles.partition_point(|tile| tile.base < share);
                let below = after.saturating_sub(1);
                if share - self.tile_start(below) < self.tile_start(after) - share { below } else { after }
            })
            .filter(|&cut| cut > 0 && cut < self.tiles.len())
            .collect();
        cuts.dedup();
        let ends = cuts.iter().copied().chain([self.tiles.len()]);
        let mut parts: Vec<Part> = Vec::with_capacity(cuts.len() + 1);
        for (from, to) in [0].into_iter().chain(cuts.iter().copied()).zip(ends) {
            let bricks = self.tile_start(from)..self.tile_start(to);
            parts.push(Part { tiles: from..to, bricks, borrowed: Vec::new() });
        }
        for k in 0..parts.len() {
            let halo = self.halo(parts[k].bricks.clone());
            parts[k].borrowed = parts[k + 1..]
                .iter()
                .flat_map(|owner| {
                    let own = &halo[halo.partition_point(|b| *b < owner.bricks.start)..];
                    runs(own[..own.partition_point(|b| *b < owner.bricks.end)].iter().map(|&b| b..b + 1))
                })
                .collect();
        }
        parts
    }

    /// Atoms that some brick of `part`, or one borrowed by its chunks, may look at: runs in ascending order. `back` and
    /// `ahead` are those of [`Params`](super::layout::Params).
    #[must_use]
    pub fn atoms_near(&self, part: &Part, [back, ahead]: [u32; 2]) -> Vec<Range<u32>> {
        let (Some(first), Some(last)) = (self.tiles.get(part.tiles.start), self.tiles[..part.tiles.end].last()) else {
            return Vec::new();
        };
        let signed = |n: u32| i32::try_from(n).unwrap_or(i32::MAX / 16);
        // A borrowed brick lies one further on.
        let (back, ahead) = (signed(back), signed(ahead).saturating_add(1));
        // Tiles are in lexicographic order, which a common step does not change: nothing before the first tile's furthest
        // neighbour is a neighbour of any.
        let far = back.max(ahead).div_euclid(8) + 1;
        let lowest = tile_order(first.coord).map(|c| c.saturating_sub(far));
        let highest = tile_order(last.coord).map(|c| c.saturating_add(far));
        let from = self.tiles.partition_point(|tile| tile_order(tile.coord) < lowest);
        let to = self.tiles.partition_point(|tile| tile_order(tile.coord) <= highest);
        let layers = (8 * first.coord[2]).saturating_sub(back)..=(8 * last.coord[2] + 7).saturating_add(ahead);
        runs((from..to).filter_map(|t| {
            // A tile's bricks come layer by layer.
            let tile = &self.tiles[t];
            let below = |layer: i32| match usize::try_from(layer) {
                Err(_) => tile.base,
                Ok(layer) => tile.before.get(layer).map_or(self.tile_start(t + 1), |n| tile.base + n),
            };
            let [lo, hi] = [below(layers.start() - 8 * tile.coord[2]), below(layers.end() - 8 * tile.coord[2] + 1)];
            let atoms = self.first_atoms[lo as usize]..self.first_atoms[hi as usize];
            (!atoms.is_empty()).then_some(atoms)
        }))
    }
}

/// Joins runs, which are in ascending order, where little lies between them.
fn runs(all: impl Iterator<Item = Range<u32>>) -> Vec<Range<u32>> {
    let mut joined: Vec<Range<u32>> = Vec::new();
    for run in all {
        match joined.last_mut() {
            Some(last) if run.start - last.end <= GAP => last.end = run.end,
            _ => joined.push(run),
        }
    }
    joined
}

/// How many there are in some runs.
#[must_use]
pub fn n_in(runs: &[Range<u32>]) -> u64 {
    runs.iter().map(|run| u64::from(run.end - run.start)).sum()
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeSet, HashMap};

    use super::*;
    use crate::surface::control::Control;
    use crate::surface::lattice::{BRICK, Lattice};
    use crate::surface::params::{SurfaceLimits, SurfaceOptions, SurfaceParams};
    use crate::surface::spheres::Spheres;

    fn plan(resolution: f64) -> (Lattice, Plan) {
        let at = |i: u32, k: f64| 70.0 * (f64::from(i) * k).sin();
        let column = |k: f64| (0..900).map(|i| at(i, k)).collect::<Vec<_>>();
        let spheres = Spheres::new(column(0.37), column(1.13), column(2.71), vec![1.6; 900]).unwrap();
        let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
        let lattice = Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap()).unwrap();
        let plan = Plan::new(&lattice, &SurfaceLimits::default(), &Control::default()).unwrap();
        (lattice, plan)
    }

    fn places(plan: &Plan) -> Vec<[i32; 3]> {
        let place = |b: &u32| {
            let local = [0, 3, 6].map(|shift| i32::try_from(b >> shift & 7).unwrap());
            let tile = plan.tiles[(b >> 9) as usize].coord;
            std::array::from_fn::<i32, 3, _>(|k| 8 * tile[k] + local[k])
        };
        plan.bricks.iter().map(place).collect()
    }

    /// What is wrong with `parts`.
    fn wrong(plan: &Plan, parts: &[Part]) -> Option<String> {
        let places = places(plan);
        let index: HashMap<[i32; 3], u32> = places.iter().copied().zip(0..).collect();
        let (mut tile, mut brick) = (0, 0);
        for part in parts {
            if (part.tiles.start, part.bricks.start) != (tile, brick) || part.tiles.is_empty() {
                return Some(format!("{part:?} behind tile {tile}"));
            }
            (tile, brick) = (part.tiles.end, part.bricks.end);
            let has: BTreeSet<u32> = part.borrowed.iter().cloned().flatten().collect();
            for run in &part.borrowed {
                if !parts.iter().any(|owner| owner.bricks.start <= run.start && run.end <= owner.bricks.end) {
                    return Some(format!("{run:?} has several owners"));
                }
            }
            for own in part.bricks.clone() {
                let at = places[own as usize];
                for n in 1..8 {
                    let there = std::array::from_fn(|k| at[k] + (n >> k & 1));
                    if index.get(&there).is_some_and(|b| *b >= brick && !has.contains(b)) {
                        return Some(format!("{own} lacks its neighbour {n}"));
                    }
                }
            }
        }
        ((tile, brick as usize) != (plan.tiles.len(), plan.bricks.len())).then(|| "the end".to_owned())
    }

    #[test]
    fn parts_cover_all_bricks_evenly_and_borrow_what_they_need() {
        let (_, plan) = plan(0.5);
        for n in [1, 2, 3, 4, 7] {
            let parts = plan.parts(n);
            assert_eq!((parts.len(), wrong(&plan, &parts)), (n, None));
            for part in &parts {
                let (share, tile) = (plan.bricks.len() / n, 512);
                assert!(part.bricks.len().abs_diff(share) <= tile, "{} of {share}", part.bricks.len());
            }
        }
        assert!(plan.parts(1)[0].borrowed.is_empty());
        let many = plan.parts(10_000);
        assert!(many.len() > 1 && many.len() <= plan.tiles.len());
        assert_eq!(wrong(&plan, &many), None);
        // Controls.
        let good = plan.parts(3);
        let mut bad = good.clone();
        bad[0].borrowed.pop();
        assert!(wrong(&plan, &bad).is_some());
        bad = good.clone();
        bad.remove(1);
        assert!(wrong(&plan, &bad).is_some());
        bad = good;
        let end = bad[1].bricks.end;
        bad[0].borrowed.push(end - 1..end + 1);
        assert!(wrong(&plan, &bad).is_some());
    }

    #[test]
    fn atoms_near_a_part_are_all_that_its_bricks_may_look_at_and_not_many_more() {
        // From reaches within a brick to reaches over several tiles.
        for resolution in [1.0, 0.4, 0.1] {
            let (lattice, plan) = plan(resolution);
            let params = plan.params(&lattice, &SurfaceParams::default());
            let (back, ahead) = (params.back.cast_signed(), params.ahead.cast_signed());
            let parts = plan.parts(5);
            let places = places(&plan);
            let mut fewest = usize::MAX;
            for part in &parts {
                let near = plan.atoms_near(part, [params.back, params.ahead]);
                assert!(near.windows(2).all(|pair| pair[0].end < pair[1].start));
                let has: BTreeSet<u32> = near.iter().cloned().flatten().collect();
                fewest = fewest.min(has.len());
                let halo = plan.halo(part.bricks.clone());
                let own: Vec<[i32; 3]> = part.bricks.clone().chain(halo).map(|b| places[b as usize]).collect();
                let lacking = |has: &BTreeSet<u32>| {
                    (0_u32..).zip(&lattice.atoms).any(|(i, atom)| {
                        let home = atom.cell.map(|c| c.div_euclid(BRICK));
                        let close = |at: &&[i32; 3]| (0..3).all(|k| (-back..=ahead).contains(&(home[k] - at[k])));
                        !has.contains(&i) && own.iter().any(|at| close(&at))
                    })
                };
                assert!(!lacking(&has), "{resolution}: part at {}", part.bricks.start);
                assert!(lacking(&BTreeSet::new()), "control");
            }
            assert!(resolution < 0.5 || fewest < lattice.atoms.len(), "every part needs all atoms");
        }
    }
}
