//! What a device is to do, worked out without one: which bricks exist, where their atoms are, how the work is cut into
//! chunks that fit. Pure, and equal to what the CPU's stage `bin` finds.
//!
//! Bricks are numbered by tile (z, y, x), then by `z·64 + y·8 + x` within the tile: the order of the atoms, so the atoms
//! of a run of bricks are one range. A brick exists where an atom reaches one of its samples, or the gap up to its
//! neighbours' first samples: cells live there too.

use rayon::prelude::*;

use super::candidates;
use super::column::Column;
use super::control::Control;
use super::cpu::{self, Constants, SlopeConstants};
use super::error::SurfaceError;
use super::lattice::{BRICK, Lattice, LatticeAtom, TILE, tile_of, tile_order, to_f32, to_u32, to_u64};
use super::layout::{NONE, Params, Tile, halves};
use super::marks::{Bits, Marked, local_of, mark_run, merge, runs, starts};
use super::params::{SurfaceLimits, SurfaceParams};
use super::quantize::Step;

/// More tiles than this in all runs together, and the grid is looked at before it is built.
const MANY_TILES: f64 = 1e6;

/// The bricks of a job.
#[derive(Debug, Clone, Default)]
pub struct Plan {
    /// Tiles with bricks, in order.
    pub tiles: Vec<Tile>,
    /// Per brick its tile, shifted by 9, and its place within the tile.
    pub bricks: Column<u32>,
    /// Per brick its first atom; one more entry than bricks.
    pub first_atoms: Column<u32>,
    /// Per atom how far it reaches, in spacings, with a little slack for rounding.
    pub reaches: Column<f32>,
    /// Per tile the entries of its bricks' candidate lists.
    pub candidates: Vec<u64>,
    /// Bricks with a sample in reach of an atom.
    pub occupied: u64,
    /// Pairs of such a brick and an atom that reaches one of its samples.
    pub pairs: u64,
    /// The longest reach.
    pub reach: f32,
}

/// How far an atom reaches, in spacings, a little more than its support: rounding must not lose a pair, and a pair too
/// many adds zero.
fn reach_of(lattice: &Lattice, atom: &LatticeAtom) -> f32 {
    to_f32(lattice.reach(atom) * (1.0 + 1e-5)) + 1e-3
}

impl Plan {
    /// Finds the bricks of `lattice`.
    ///
    /// # Errors
    /// [`SurfaceError::GridTooLarge`] and [`SurfaceError::TooManyCandidates`] before memory is allocated beyond what
    /// the limits allow, [`SurfaceError::BadParameter`] for more atoms than 31 bits number, and
    /// [`SurfaceError::Cancelled`].
    pub fn new(lattice: &Lattice, limits: &SurfaceLimits, control: &Control<'_>) -> Result<Self, SurfaceError> {
        let atoms = &lattice.atoms;
        if atoms.len() > cpu::MAX_ATOMS {
            return Err(cpu::too_many_atoms(atoms.len()));
        }
        let starts = starts(atoms);
        let runs = runs(&starts, atoms.len());
        let mut reaches = Column::zeroed(atoms.len());
        let part = |(reaches, atoms): (&mut [f32], &[LatticeAtom])| {
            reaches.iter_mut().zip(atoms).for_each(|(reach, atom)| *reach = reach_of(lattice, atom));
            reaches.iter().copied().fold(0.0, f32::max)
        };
        let parts = reaches.par_chunks_mut(4096).zip(atoms.par_chunks(4096));
        let longest = parts.map(part).reduce(|| 0.0, f32::max);
        refuse_early(lattice, runs.len(), longest, limits)?;
        control.check()?;
        let marked_by = |&(start, end): &(usize, usize)| {
            control.check()?;
            Ok(mark_run(&atoms[start..end], &reaches[start..end], longest))
        };
        let marks: Vec<Vec<Marked>> = runs.par_iter().map(marked_by).collect::<Result<_, SurfaceError>>()?;
        let marked = merge(&marks);
        control.check()?;
        let occupied = marked.iter().map(|m| ones(&m.reached)).sum::<u64>();
        if occupied.saturating_mul(512) > limits.max_samples {
            return Err(cpu::grid_too_large(lattice, occupied * 512, limits));
        }
        let candidates = marked.iter().map(|m| m.candidates).sum();
        if candidates > candidates::limit(limits) {
            return Err(candidates::exceeded(lattice, candidates, limits));
        }
        let mut plan = Self {
            reach: longest,
            reaches,
            candidates: marked.iter().map(|m| m.candidates).collect(),
            occupied,
            pairs: marked.iter().map(|m| m.pairs).sum(),
            ..Self::default()
        };
        plan.number(&marked).ok_or_else(|| cpu::grid_too_large(lattice, u64::from(u32::MAX) * 512, limits))?;
        plan.place(&marked, atoms, &starts);
        Ok(plan)
    }

    /// Numbers tiles and bricks. `None` where 32 bits do not.
    fn number(&mut self, marked: &[Marked]) -> Option<()> {
        if marked.len() >= 1 << 23 {
            return None;
        }
        let mut base = 0_u32;
        let mut bases = Vec::with_capacity(marked.len());
        for m in marked {
            bases.push(base);
            base = base.checked_add(u32::try_from(ones(&m.occupied)).ok()?)?;
        }
        let tile = |(m, &base): (&Marked, &u32)| {
            let mut tile = Tile { coord: m.tile, base, bricks: [[0; 2]; 8], before: [0; 8], around: [NONE; 28] };
            let mut before = 0;
            for (z, word) in m.occupied.iter().enumerate() {
                tile.bricks[z] = halves(*word);
                tile.before[z] = before;
                before += word.count_ones();
            }
            for (row, entries) in (0_i32..9).zip(tile.around.chunks_exact_mut(3)) {
                // The three tiles of a row follow each other, as far as they exist.
                let first = [m.tile[0] - 1, m.tile[1] + row % 3 - 1, m.tile[2] + row / 3 - 1];
                let at = marked.partition_point(|m| tile_order(m.tile) < tile_order(first));
                for (t, there) in (at..).zip(marked[at..].iter().take(3)) {
                    let step = there.tile[0].abs_diff(first[0]) as usize;
                    if there.tile[1..] == first[1..] && step < 3 {
                        entries[step] = to_u32(t);
                    }
                }
            }
            tile
        };
        self.tiles = marked.par_iter().zip(&bases).map(tile).collect();
        self.bricks = Column::zeroed(base as usize);
        self.first_atoms = Column::zeroed(base as usize + 1);
        Some(())
    }

    /// Lists the bricks and finds their first atoms; `starts` tells where each tile's atoms begin.
    fn place(&mut self, marked: &[Marked], atoms: &[LatticeAtom], starts: &[usize]) {
        let mut parts = Vec::with_capacity(marked.len());
        let (mut bricks, mut firsts) = (&mut self.bricks[..], &mut self.first_atoms[..]);
        for (t, m) in (0_u32..).zip(marked) {
            let n = usize::try_from(ones(&m.occupied)).unwrap_or_default();
            let ((own, more), (first, rest)) = (bricks.split_at_mut(n), firsts.split_at_mut(n));
            parts.push((t, m, own, first));
            (bricks, firsts) = (more, rest);
        }
        firsts.fill(to_u32(atoms.len()));
        parts.into_par_iter().for_each(|(t, m, own, firsts)| {
            let before = |&start: &usize| tile_order(tile_of(atoms[start].cell)) < tile_order(m.tile);
            let tile = starts.partition_point(before);
            let [mut at, next] = [tile, tile + 1].map(|t| starts.get(t).copied().unwrap_or(atoms.len()));
            // Of a tile without atoms the next one's are found: they are behind all its bricks.
            let end = if atoms.get(at).is_some_and(|atom| tile_of(atom.cell) == m.tile) { next } else { at };
            for ((local, brick), first) in set_bits(&m.occupied).zip(own).zip(firsts) {
                (*brick, *first) = (t << 9 | local, to_u32(at));
                // Every atom's own brick exists, so none is passed over.
                at += atoms[at..end].iter().take_while(|atom| local_of(atom) == local).count();
            }
        });
    }

    /// What every dispatch of the job has in common.
    #[must_use]
    pub fn params(&self, lattice: &Lattice, params: &SurfaceParams) -> Params {
        let field = Constants::new(&lattice.profile, lattice.spacing);
        let slope = SlopeConstants::new(&lattice.profile, lattice.spacing);
        // Atoms lie at most half a spacing outside their brick's samples.
        let bricks = |reach: f32| u32::try_from(to_u64(f64::from(reach) / f64::from(BRICK))).unwrap_or(u32::MAX);
        Params {
            centre: lattice.centre,
            spacing: to_f32(lattice.spacing),
            isovalue: to_f32(params.isovalue),
            support: field.support,
            share: field.share,
            rate: field.rate,
            tail_share: field.tail_share,
            tail_rate: field.tail_rate,
            tail_end: field.tail_end,
            amplitude: field.amplitude,
            u_min: field.u_min,
            slope_offset: slope.offset,
            slope_tail: slope.tail,
            reach: self.reach,
            back: bricks(self.reach + 7.51),
            ahead: bricks(self.reach + 8.51),
            n_tiles: to_u32(self.tiles.len()),
            n_bricks: to_u32(self.bricks.len()),
            steps_per_angstrom: params.quantize.map_or(0.0, Step::per_angstrom),
            ..bytemuck::Zeroable::zeroed()
        }
    }
}

/// Refuses a mesh of so many vertices and triangles that the limits do not allow, and one of none.
///
/// # Errors
/// [`SurfaceError::MeshTooLarge`], also where 32 bits do not number the vertices; [`SurfaceError::NoSurface`].
pub fn check_totals(
    lattice: &Lattice,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    n_vertices: u64,
    n_triangles: u64,
) -> Result<(), SurfaceError> {
    if n_triangles == 0 {
        return Err(SurfaceError::NoSurface { isovalue: params.isovalue });
    }
    let bytes = params.mesh_bytes(n_vertices, n_triangles);
    let most = limits.max_mesh_bytes.min(params.mesh_bytes(u64::from(u32::MAX), 0));
    if bytes <= most { Ok(()) } else { Err(cpu::mesh_too_large(bytes, lattice.spacing, most)) }
}

/// Refuses a grid that is certain to exceed the limit before any of it is computed.
fn refuse_early(lattice: &Lattice, n_runs: usize, longest: f32, limits: &SurfaceLimits) -> Result<(), SurfaceError> {
    // Tiles that the runs will hold: few, unless spheres are huge in spacings.
    let along = 2.0 * (f64::from(longest) + 2.0) / f64::from(TILE) + 3.0;
    if along.powi(3) * n_runs as f64 <= MANY_TILES || along < 6.0 {
        return Ok(());
    }
    let least = to_u64(cpu::samples_at_least(lattice));
    if least > limits.max_samples { Err(cpu::grid_too_large(lattice, least, limits)) } else { Ok(()) }
}

fn ones(bits: &Bits) -> u64 {
    bits.iter().map(|word| u64::from(word.count_ones())).sum()
}

/// Positions of the set bits, ascending.
fn set_bits(bits: &Bits) -> impl Iterator<Item = u32> + '_ {
    (0_u32..).zip(bits).flat_map(|(z, &word)| {
        let mut rest = word;
        std::iter::from_fn(move || {
            let bit = (rest != 0).then(|| rest.trailing_zeros());
            rest &= rest.wrapping_sub(1);
            bit.map(|bit| z << 6 | bit)
        })
    })
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;
    use crate::surface::params::SurfaceOptions;
    use crate::surface::spheres::Spheres;

    fn lattice(n: u32, side: f64, resolution: f64) -> Lattice {
        let mut state = 3_u64;
        let mut next = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        };
        let mut column = || (0..n).map(|_| side * (next() - 0.5)).collect::<Vec<_>>();
        let (x, y, z) = (column(), column(), column());
        let radii = (0..n).map(|i| 1.2 + 0.1 * (i % 7) as f32).collect();
        let options = SurfaceOptions { resolution: Some(resolution), ..SurfaceOptions::default() };
        Lattice::new(&Spheres::new(x, y, z, radii).unwrap(), &SurfaceParams::new(&options).unwrap()).unwrap()
    }

    fn plan(lattice: &Lattice) -> Plan {
        Plan::new(lattice, &SurfaceLimits::default(), &Control::default()).unwrap()
    }

    /// Place of each brick, in bricks.
    fn coords(plan: &Plan) -> Vec<[i32; 3]> {
        let place = |&b: &u32| {
            let local = [0, 3, 6].map(|shift| i32::try_from(b >> shift & 7).unwrap());
            let tile = plan.tiles[(b >> 9) as usize].coord;
            std::array::from_fn(|k| 8 * tile[k] + local[k])
        };
        plan.bricks.iter().map(place).collect()
    }

    #[test]
    fn bricks_are_in_order_and_hold_their_atoms() {
        // From bricks much larger than atoms, of which some reach nothing of their own, to much smaller ones.
        for resolution in [20.0, 3.0, 0.5, 0.15, 0.066, 0.0655, 0.05] {
            let lattice = lattice(200, 60.0, resolution);
            let plan = plan(&lattice);
            assert!(plan.bricks.windows(2).all(|pair| pair[0] < pair[1]));
            assert!(plan.tiles.windows(2).all(|pair| tile_order(pair[0].coord) < tile_order(pair[1].coord)));
            let coords = coords(&plan);
            let mut seen = 0;
            for (i, place) in coords.iter().enumerate() {
                let [from, to] = [plan.first_atoms[i], plan.first_atoms[i + 1]];
                assert_eq!(from, seen);
                seen = to;
                for atom in &lattice.atoms[from as usize..to as usize] {
                    assert_eq!(atom.cell.map(|c| c.div_euclid(BRICK)), *place);
                }
            }
            assert_eq!(seen, 200);
        }
    }

    #[test]
    fn a_brick_exists_where_an_atom_is_near_and_nowhere_else() {
        let lattice = lattice(60, 25.0, 0.6);
        let plan = plan(&lattice);
        let exists: HashMap<[i32; 3], usize> = coords(&plan).into_iter().zip(0..).collect();
        let (mut there, mut pairs) = (0, 0);
        for z in -8..8 {
            for y in -8..8 {
                for x in -8..8 {
                    // In double precision, with the slack that atoms have and a little less.
                    let near = |beyond: f64, slack: f64| {
                        let gap = |c: f64, b: i32| {
                            let lo = f64::from(b * BRICK);
                            (lo - c).max(c - lo - beyond).max(0.0)
                        };
                        let reaches = |atom: &&LatticeAtom| {
                            let d = [gap(atom.position(0), x), gap(atom.position(1), y), gap(atom.position(2), z)];
                            d.iter().map(|d| d * d).sum::<f64>().sqrt() <= lattice.reach(atom) + slack
                        };
                        lattice.atoms.iter().filter(reaches).count()
                    };
                    let found = exists.contains_key(&[x, y, z]);
                    assert!(near(8.0, 0.0) == 0 || found, "{x} {y} {z} is missing");
                    assert!(near(8.0, 2e-3) > 0 || !found, "{x} {y} {z} is too many");
                    there += usize::from(found);
                    pairs += near(7.0, 1e-3);
                }
            }
        }
        assert_eq!((there, there > 100), (plan.bricks.len(), true));
        assert!(pairs.abs_diff(usize::try_from(plan.pairs).unwrap()) <= 2, "{pairs} {}", plan.pairs);
    }

    #[test]
    fn a_grid_beyond_the_limit_is_refused_with_one_that_fits() {
        let lattice = lattice(300, 80.0, 0.5);
        let samples = plan(&lattice).occupied * 512;
        let with = |max_samples| {
            Plan::new(&lattice, &SurfaceLimits { max_samples, ..SurfaceLimits::default() }, &Control::default())
        };
        assert!(with(samples).is_ok());
        match with(samples - 1) {
            Err(SurfaceError::GridTooLarge { samples: n, limit, suggested_resolution, .. }) => {
                assert_eq!((n, limit), (samples, samples - 1));
                assert!(suggested_resolution >= 0.5);
            }
            other => panic!("{:?}", other.map(|p| p.occupied)),
        }
        let control = Control::default();
        control.cancel.cancel();
        assert_eq!(Plan::new(&lattice, &SurfaceLimits::default(), &control).err(), Some(SurfaceError::Cancelled));
    }
}
