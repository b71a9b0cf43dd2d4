//! Partitions of a plan for several devices, and the bricks and atoms of other partitions that each needs.
//!
//! A partition is a run of tiles. Its last cells have corners in bricks of later partitions. It computes the grid
//! points of these halo bricks again, as a chunk does, but imports their crossing edges and vertex numbers, which only
//! their owner can compute.

use std::ops::Range;

use molmesh_surface::lattice::{tile_order, to_u32};

use super::Plan;

/// Maximum gap between two runs of bricks or atoms that are joined into one: transferring 64 elements more is cheaper
/// than an additional copy command.
const MAX_GAP: u32 = 64;

/// Run of tiles that one device works on.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Partition {
    /// Indices of its tiles.
    pub tiles: Range<usize>,
    /// Indices of its bricks.
    pub bricks: Range<u32>,
    /// Bricks of later partitions whose records it needs, as ascending runs. A run may contain further bricks, but lies
    /// within one partition.
    pub imports: Vec<Range<u32>>,
}

impl Plan {
    /// Cuts the bricks into `n` partitions of about equal size, or into fewer if there are fewer tiles.
    #[must_use]
    pub fn partitions(&self, n: usize) -> Vec<Partition> {
        let total = self.bricks.len() as u64;
        let n = n.clamp(1, self.tiles.len().max(1)) as u64;
        let mut cuts: Vec<usize> = (1..n)
            .map(|i| {
                // The tile boundary nearest to an equal share.
                let share = to_u32(usize::try_from(total * i / n).unwrap_or(usize::MAX));
                let after = self.tiles.partition_point(|tile| tile.base < share);
                let below = after.saturating_sub(1);
                if share - self.tile_start(below) < self.tile_start(after) - share { below } else { after }
            })
            .filter(|&cut| cut > 0 && cut < self.tiles.len())
            .collect();
        cuts.dedup();
        let ends = cuts.iter().copied().chain([self.tiles.len()]);
        let mut partitions: Vec<Partition> = Vec::with_capacity(cuts.len() + 1);
        for (from, to) in [0].into_iter().chain(cuts.iter().copied()).zip(ends) {
            let bricks = self.tile_start(from)..self.tile_start(to);
            partitions.push(Partition { tiles: from..to, bricks, imports: Vec::new() });
        }
        for k in 0..partitions.len() {
            let halo = self.halo(partitions[k].bricks.clone());
            partitions[k].imports = partitions[k + 1..]
                .iter()
                .flat_map(|owner| {
                    let own = &halo[halo.partition_point(|b| *b < owner.bricks.start)..];
                    join_runs(own[..own.partition_point(|b| *b < owner.bricks.end)].iter().map(|&b| b..b + 1))
                })
                .collect();
        }
        partitions
    }

    /// Atoms that the bricks of `partition` and of its chunks' halos may need, as ascending runs. `back` and `ahead`
    /// are those of [`Params`](super::layout::Params).
    #[must_use]
    pub fn atoms_near(&self, partition: &Partition, [back, ahead]: [u32; 2]) -> Vec<Range<u32>> {
        let tiles = &partition.tiles;
        let (Some(first), Some(last)) = (self.tiles.get(tiles.start), self.tiles[..tiles.end].last()) else {
            return Vec::new();
        };
        let signed = |n: u32| i32::try_from(n).unwrap_or(i32::MAX / 16);
        // A halo brick lies one brick further away.
        let (back, ahead) = (signed(back), signed(ahead).saturating_add(1));
        // Tile order is lexicographic and translation keeps it: no tile before the first tile's furthest neighbour is a
        // neighbour of any tile.
        let far = back.max(ahead).div_euclid(8) + 1;
        let lowest = tile_order(first.coord).map(|c| c.saturating_sub(far));
        let highest = tile_order(last.coord).map(|c| c.saturating_add(far));
        let from = self.tiles.partition_point(|tile| tile_order(tile.coord) < lowest);
        let to = self.tiles.partition_point(|tile| tile_order(tile.coord) <= highest);
        let layers = (8 * first.coord[2]).saturating_sub(back)..=(8 * last.coord[2] + 7).saturating_add(ahead);
        join_runs((from..to).filter_map(|t| {
            // The bricks of a tile are ordered by layer.
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

/// Joins ascending runs with gaps of at most [`MAX_GAP`].
fn join_runs(runs: impl Iterator<Item = Range<u32>>) -> Vec<Range<u32>> {
    let mut joined: Vec<Range<u32>> = Vec::new();
    for run in runs {
        match joined.last_mut() {
            Some(last) if run.start - last.end <= MAX_GAP => last.end = run.end,
            _ => joined.push(run),
        }
    }
    joined
}

/// Number of elements in `runs`.
#[must_use]
pub fn total_len(runs: &[Range<u32>]) -> u64 {
    runs.iter().map(|run| u64::from(run.end - run.start)).sum()
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeSet, HashMap};

    use molmesh_surface::lattice::{BRICK, Lattice};
    use molmesh_surface::{Control, Spheres, SurfaceLimits, SurfaceOptions, SurfaceParams};

    use super::*;

    fn plan(resolution: f64) -> (Lattice, Plan) {
        let at = |i: u32, k: f64| 70.0 * (f64::from(i) * k).sin();
        let column = |k: f64| (0..900).map(|i| at(i, k)).collect::<Vec<_>>();
        let spheres = Spheres::new(column(0.37), column(1.13), column(2.71), vec![1.6; 900]).unwrap();
        let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
        let lattice = Lattice::new(&spheres, &SurfaceParams::new(&options).unwrap(), &Control::default()).unwrap();
        let plan = Plan::new(&lattice, &SurfaceLimits::default(), &Control::default()).unwrap();
        (lattice, plan)
    }

    fn coords(plan: &Plan) -> Vec<[i32; 3]> {
        let coord = |b: &u32| {
            let local = [0, 3, 6].map(|shift| i32::try_from(b >> shift & 7).unwrap());
            let tile = plan.tiles[(b >> 9) as usize].coord;
            std::array::from_fn::<i32, 3, _>(|k| 8 * tile[k] + local[k])
        };
        plan.bricks.iter().map(coord).collect()
    }

    /// Returns the first defect of `partitions`.
    fn defect(plan: &Plan, partitions: &[Partition]) -> Option<String> {
        let coords = coords(plan);
        let index: HashMap<[i32; 3], u32> = coords.iter().copied().zip(0..).collect();
        let (mut tile, mut brick) = (0, 0);
        for part in partitions {
            if (part.tiles.start, part.bricks.start) != (tile, brick) || part.tiles.is_empty() {
                return Some(format!("{part:?} behind tile {tile}"));
            }
            (tile, brick) = (part.tiles.end, part.bricks.end);
            let has: BTreeSet<u32> = part.imports.iter().cloned().flatten().collect();
            for run in &part.imports {
                if !partitions.iter().any(|owner| owner.bricks.start <= run.start && run.end <= owner.bricks.end) {
                    return Some(format!("{run:?} has several owners"));
                }
            }
            for own in part.bricks.clone() {
                let at = coords[own as usize];
                for n in 1..8 {
                    let there = std::array::from_fn(|k| at[k] + (n >> k & 1));
                    if index.get(&there).is_some_and(|b| *b >= brick && !has.contains(b)) {
                        return Some(format!("{own} lacks its neighbour {n}"));
                    }
                }
            }
        }
        ((tile, brick as usize) != (plan.tiles.len(), plan.bricks.len())).then(|| "wrong end".to_owned())
    }

    #[test]
    fn partitions_are_even_and_import_what_they_need() {
        let (_, plan) = plan(0.5);
        for n in [1, 2, 3, 4, 7] {
            let parts = plan.partitions(n);
            assert_eq!((parts.len(), defect(&plan, &parts)), (n, None));
            for part in &parts {
                let (share, tile) = (plan.bricks.len() / n, 512);
                assert!(part.bricks.len().abs_diff(share) <= tile, "{} of {share}", part.bricks.len());
            }
        }
        assert!(plan.partitions(1)[0].imports.is_empty());
        let many = plan.partitions(10_000);
        assert!(many.len() > 1 && many.len() <= plan.tiles.len());
        assert_eq!(defect(&plan, &many), None);
        // Negative controls.
        let good = plan.partitions(3);
        let mut bad = good.clone();
        bad[0].imports.pop();
        assert!(defect(&plan, &bad).is_some());
        bad = good.clone();
        bad.remove(1);
        assert!(defect(&plan, &bad).is_some());
        bad = good;
        let end = bad[1].bricks.end;
        bad[0].imports.push(end - 1..end + 1);
        assert!(defect(&plan, &bad).is_some());
    }

    #[test]
    fn atoms_near_a_partition_are_all_that_its_bricks_need_and_few_others() {
        // From reaches of less than a brick to reaches of several tiles.
        for resolution in [1.0, 0.4, 0.1] {
            let (lattice, plan) = plan(resolution);
            let params = SurfaceParams::default();
            let params = plan.params(&lattice, &params);
            let (back, ahead) = (params.back.cast_signed(), params.ahead.cast_signed());
            let parts = plan.partitions(5);
            let coords = coords(&plan);
            let mut fewest = usize::MAX;
            for part in &parts {
                let near = plan.atoms_near(part, [params.back, params.ahead]);
                assert!(near.windows(2).all(|pair| pair[0].end < pair[1].start));
                let has: BTreeSet<u32> = near.iter().cloned().flatten().collect();
                fewest = fewest.min(has.len());
                let halo = plan.halo(part.bricks.clone());
                let own: Vec<[i32; 3]> = part.bricks.clone().chain(halo).map(|b| coords[b as usize]).collect();
                let lacking = |has: &BTreeSet<u32>| {
                    (0_u32..).zip(&lattice.atoms).any(|(i, atom)| {
                        let own_brick = atom.cell.map(|c| c.div_euclid(BRICK));
                        let close = |at: &&[i32; 3]| (0..3).all(|k| (-back..=ahead).contains(&(own_brick[k] - at[k])));
                        !has.contains(&i) && own.iter().any(|at| close(&at))
                    })
                };
                assert!(!lacking(&has), "{resolution}: partition at {}", part.bricks.start);
                assert!(lacking(&BTreeSet::new()), "control");
            }
            assert!(resolution < 0.5 || fewest < lattice.atoms.len(), "every partition needs all atoms");
        }
    }
}
