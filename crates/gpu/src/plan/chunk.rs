//! Chunks of a plan: runs of tiles that fit a device, each with its halo: the bricks behind it that hold grid points of
//! its cells. A halo brick is computed twice: in this chunk, and in the chunk that owns it.

use std::ops::Range;

use molmesh_surface::lattice::to_u32;

use super::Plan;
use super::layout::{GROUP, NONE, Params};

/// Capacity of a device for one chunk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ChunkLimits {
    /// Maximum number of bricks with densities.
    pub bricks: u64,
    /// Maximum number of entries in candidate lists.
    pub candidates: u64,
}

/// Run of bricks that is computed at once.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Chunk {
    /// First brick.
    pub first_brick: u32,
    /// Number of own bricks.
    pub n_own: u32,
    /// Halo: later bricks that hold grid points of the chunk's cells, ascending.
    pub halo: Vec<u32>,
    /// Upper bound of the entries in the candidate lists.
    pub candidates: u64,
}

impl Chunk {
    /// Number of bricks with densities: own bricks and halo.
    #[must_use]
    pub fn n_slots(&self) -> u64 {
        u64::from(self.n_own) + self.halo.len() as u64
    }

    /// Returns the number of groups of own bricks. The counts of a group take 16 bytes.
    #[must_use]
    pub fn n_groups(&self) -> u64 {
        u64::from(self.n_own.div_ceil(GROUP))
    }

    /// Contents of the `halo` buffer: the halo bricks, then the slot (or [`NONE`]) of each brick behind the chunk up to
    /// the last halo brick.
    #[must_use]
    pub fn halo_table(&self) -> Vec<u32> {
        let end = self.first_brick + self.n_own;
        let mut table = self.halo.clone();
        table.resize(self.halo.len() + self.n_halo_slots() as usize, NONE);
        for (slot, &brick) in (self.n_own..).zip(&self.halo) {
            table[self.halo.len() + (brick - end) as usize] = slot;
        }
        table
    }

    /// Number of entries of [`Self::halo_table`].
    #[must_use]
    pub fn halo_table_len(&self) -> u64 {
        self.halo.len() as u64 + u64::from(self.n_halo_slots())
    }

    fn n_halo_slots(&self) -> u32 {
        self.halo.last().map_or(0, |last| last - (self.first_brick + self.n_own) + 1)
    }

    /// Parameters of the job with those of this chunk filled in.
    #[must_use]
    pub fn params(&self, params: &Params) -> Params {
        Params {
            first_brick: self.first_brick,
            n_own: self.n_own,
            n_halo: to_u32(self.halo.len()),
            n_halo_slots: self.n_halo_slots(),
            list_capacity: u32::try_from(self.candidates).unwrap_or(u32::MAX),
            ..*params
        }
    }
}

impl Plan {
    /// Cuts a run of tiles into chunks. `None` if a single tile exceeds the limits.
    #[must_use]
    pub fn chunks(&self, tiles: Range<usize>, limits: ChunkLimits) -> Option<Vec<Chunk>> {
        let mut chunks = Vec::new();
        let mut from = tiles.start;
        while from < tiles.end {
            // Takes as many tiles as fit without their halo, then fewer until the halo fits too.
            let mut to = from;
            let (mut bricks, mut candidates) = (0, 0);
            while to < tiles.end {
                bricks += u64::from(self.tile_start(to + 1) - self.tiles[to].base);
                candidates += self.candidates[to];
                if bricks > limits.bricks || candidates > limits.candidates {
                    break;
                }
                to += 1;
            }
            let chunk = loop {
                if to == from {
                    return None;
                }
                let chunk = self.chunk(from, to);
                if chunk.n_slots() <= limits.bricks && chunk.candidates <= limits.candidates {
                    break chunk;
                }
                to -= (to - from).div_ceil(8);
            };
            chunks.push(chunk);
            from = to;
        }
        Some(chunks)
    }

    fn chunk(&self, from: usize, to: usize) -> Chunk {
        let (first, end) = (self.tile_start(from), self.tile_start(to));
        let halo = self.halo(first..end);
        let mut halo_tiles: Vec<u32> = halo.iter().map(|&b| self.bricks[b as usize] >> 9).collect();
        halo_tiles.dedup();
        let candidates = self.candidates[from..to].iter().sum::<u64>()
            + halo_tiles.iter().map(|&t| self.candidates[t as usize]).sum::<u64>();
        Chunk { first_brick: first, n_own: end - first, halo, candidates }
    }

    /// Bricks behind a run of whole tiles' bricks that hold grid points of its cells, ascending.
    pub(super) fn halo(&self, bricks: Range<u32>) -> Vec<u32> {
        let mut halo = Vec::new();
        if (bricks.end as usize) < self.bricks.len() {
            for brick in &self.bricks[bricks.start as usize..bricks.end as usize] {
                if [7, 7 << 3, 7 << 6].iter().any(|face| brick & face == *face) {
                    halo.extend((1..8).filter_map(|n| self.neighbour(*brick, n)).filter(|&b| b >= bricks.end));
                }
            }
            halo.sort_unstable();
            halo.dedup();
        }
        halo
    }

    /// Neighbour of a brick, given as in [`Plan::bricks`], towards +x (bit 0 of `n`), +y (bit 1) and +z (bit 2).
    pub(crate) fn neighbour(&self, brick: u32, n: u32) -> Option<u32> {
        let (tile, local) = (&self.tiles[(brick >> 9) as usize], brick & 511);
        let moved = [0, 3, 6].map(|shift| (local >> shift & 7) + (n >> (shift / 3) & 1));
        let around = 13 + 9 * (moved[2] >> 3) + 3 * (moved[1] >> 3) + (moved[0] >> 3);
        let there = self.tiles.get(tile.around[around as usize] as usize)?;
        let [x, y, z] = moved.map(|m| m & 7);
        let (half, bit) = (usize::from(y >= 4), (y & 3) << 3 | x);
        let words = there.bricks[z as usize];
        let below = (1_u32 << bit) - 1;
        let low = if half == 1 { words[0].count_ones() } else { 0 };
        let rank = there.before[z as usize] + low + (words[half] & below).count_ones();
        (words[half] >> bit & 1 == 1).then_some(there.base + rank)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::{BTreeSet, HashMap};

    use molmesh_surface::lattice::Lattice;
    use molmesh_surface::{Control, Spheres, SurfaceLimits, SurfaceParams};

    use super::*;

    fn plan() -> Plan {
        let at = |i: u32, k: f64| 55.0 * (f64::from(i) * k).sin();
        let column = |k: f64| (0..900).map(|i| at(i, k)).collect::<Vec<_>>();
        let spheres = Spheres::new(column(0.37), column(1.13), column(2.71), vec![1.6; 900]).unwrap();
        let lattice = Lattice::new(&spheres, &SurfaceParams::default(), &Control::default()).unwrap();
        Plan::new(&lattice, &SurfaceLimits::default(), &Control::default()).unwrap()
    }

    /// Returns the first defect of `chunks`.
    fn defect(plan: &Plan, chunks: &[Chunk], limits: ChunkLimits) -> Option<String> {
        let coords = |b: usize| {
            let local = [0, 3, 6].map(|shift| i32::try_from(plan.bricks[b] >> shift & 7).unwrap());
            let tile = plan.tiles[(plan.bricks[b] >> 9) as usize].coord;
            std::array::from_fn::<i32, 3, _>(|k| 8 * tile[k] + local[k])
        };
        let index: HashMap<[i32; 3], u32> = (0..plan.bricks.len()).map(|b| (coords(b), to_u32(b))).collect();
        let mut next = 0;
        for chunk in chunks {
            if chunk.first_brick != next || chunk.n_own == 0 || chunk.n_slots() > limits.bricks {
                return Some(format!("chunk at {} of {}", chunk.first_brick, chunk.n_slots()));
            }
            next += chunk.n_own;
            let mut needed = BTreeSet::new();
            for own in chunk.first_brick..next {
                let at = coords(own as usize);
                for n in 1..8 {
                    let there = std::array::from_fn(|k| at[k] + (n >> k & 1));
                    needed.extend(index.get(&there).copied().filter(|&b| b >= next));
                }
            }
            if !needed.iter().eq(&chunk.halo) {
                return Some(format!("{} halo bricks, {} needed", chunk.halo.len(), needed.len()));
            }
            let table = chunk.halo_table();
            for (slot, brick) in (chunk.n_own..).zip(&chunk.halo) {
                if table[chunk.halo.len() + (brick - next) as usize] != slot {
                    return Some(format!("brick {brick} is not in slot {slot}"));
                }
            }
            if table.len() as u64 != chunk.halo_table_len() {
                return Some("wrong length of the table".to_owned());
            }
        }
        (next as usize != plan.bricks.len()).then(|| format!("{next} bricks"))
    }

    #[test]
    fn chunks_cover_all_bricks_and_have_the_halo_that_they_need() {
        let plan = plan();
        let limits = |bricks| ChunkLimits { bricks, candidates: 1 << 30 };
        for bricks in [700, 1500, 4000, 1 << 20] {
            let chunks = plan.chunks(0..plan.tiles.len(), limits(bricks)).unwrap();
            assert_eq!(defect(&plan, &chunks, limits(bricks)), None, "{bricks}");
            assert_eq!(chunks.len() == 1, bricks == 1 << 20);
        }
        // A small limit of candidates gives small chunks too.
        let few = ChunkLimits { bricks: 1 << 20, candidates: plan.candidates.iter().sum::<u64>() / 2 };
        assert!(plan.chunks(0..plan.tiles.len(), few).unwrap().len() > 2);
        assert!(plan.chunks(0..plan.tiles.len(), limits(100)).is_none());
        // Negative controls.
        let good = plan.chunks(0..plan.tiles.len(), limits(1500)).unwrap();
        let mut bad = good.clone();
        bad[0].halo.pop();
        assert!(defect(&plan, &bad, limits(1500)).is_some());
        bad = good.clone();
        bad.remove(1);
        assert!(defect(&plan, &bad, limits(1500)).is_some());
        assert!(defect(&plan, &good, limits(800)).is_some());
    }
}
