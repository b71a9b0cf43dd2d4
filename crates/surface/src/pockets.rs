//! Pockets: regions outside the molecule that a small probe can enter and a large one cannot.
//!
//! The definition is that of `KVFinder` (Oliveira et al., BMC Bioinformatics 15, 2014; Guerra et al., BMC
//! Bioinformatics 22, 2021), evaluated on a grid. It has four sets of grid points:
//!
//! - the points outside the molecule, within the radius of the small probe from a place where its centre can be,
//! - the points that the large probe covers, which are found in the same way,
//! - these points and their neighbourhood, a cube,
//! - the pockets: the first set without the third. Their connected regions are listed if they are large enough.

mod bits;
mod regions;

use std::f64::consts::PI;
use std::sync::Arc;

use rayon::prelude::*;

use self::bits::{BitGrid, Element};
use self::regions::Regions;
use super::control::Control;
use super::cpu::LATTICE_BYTES;
use super::error::SurfaceError;
use super::lattice::{Lattice, LatticeAtom, to_i32, to_u64};
use super::limit::{Exceeded, Limit};
use super::memory::Reservation;
use super::params::{SurfaceKind, SurfaceLimits, SurfaceParams};
use super::spheres::Spheres;

/// Default radius of the large probe, Å.
pub const DEFAULT_POCKET_PROBE: f64 = 4.0;
/// Smallest and largest radius of the large probe, Å. The time grows with its square.
pub const POCKET_PROBES: [f64; 2] = [1.0, 20.0];
/// Spacing of the grid, Å.
pub const SPACING: f64 = 0.6;
/// Distance along each axis from the points that the large probe covers within which points belong to no pocket, Å.
const REMOVED: f64 = 2.4;
/// Volume of the smallest pocket, Å³.
const MIN_VOLUME: f64 = 5.0;
/// Largest distance of a vertex from a pocket that it lines, Å.
const LINING: f64 = 1.2;
/// Maximum number of grid points: rows, runs and regions have numbers of 32 bits.
const MAX_GRID_POINTS: u64 = 1 << 32;
/// Memory of a sphere that is sorted by height, bytes.
const BALL_BYTES: u64 = 40;
/// Rows of grid points within reach of a probe that count as one candidate pair: both take about 0.2 µs of one core.
const ROWS_PER_PAIR: u64 = 5;
/// Spheres of a task.
const BALLS: usize = 256;

/// Pocket of a molecule.
#[derive(Debug, Clone, PartialEq)]
pub struct Pocket {
    /// Volume, Å³.
    pub volume: f64,
    /// Area of the boundary between the pocket and the molecule, Å².
    pub area: f64,
    /// Largest distance of a point of the pocket from the nearest point of an opening, Å; 0 without openings.
    pub depth: f64,
    /// Centroid, Å.
    pub centre: [f64; 3],
    /// Number of connected regions where the pocket borders on other points outside the molecule.
    pub openings: u32,
    /// Indices of the spheres that are at most the radius of the small probe away from a grid point of the pocket,
    /// ascending.
    pub lining: Vec<u32>,
}

/// Pockets of a molecule.
#[derive(Debug)]
pub struct Pockets {
    /// Pockets, largest volume first.
    pub list: Vec<Pocket>,
    regions: Regions,
    /// Spacing of the grid, Å.
    spacing: f64,
    /// First point of the grid, in spacings.
    origin: [i32; 3],
    _memory: Arc<Reservation>,
}

impl Pockets {
    /// Returns the index of the pocket that a point of a surface lines, Å: that of the nearest grid point in a pocket,
    /// at most 1.2 Å away.
    pub fn lined_at(&self, point: [f64; 3]) -> Option<u32> {
        let local = std::array::from_fn(|k| point[k] / self.spacing - f64::from(self.origin[k]));
        self.regions.nearest(local, LINING / self.spacing)
    }
}

/// Sphere without a probe, in spacings from the first point of the grid.
#[derive(Debug, Clone, Copy)]
struct Ball {
    centre: [f64; 3],
    radius: f64,
    /// Index in the input.
    source: u32,
}

/// Grid around a molecule.
struct Grid {
    /// Spheres by their height.
    balls: Vec<Ball>,
    largest: f64,
    size: [usize; 3],
    origin: [i32; 3],
    /// Number of rows within reach of the probes.
    rows: u64,
}

/// Finds the pockets of `spheres` with the radii and the probe of `params` and a large probe of the radius
/// `pocket_probe`, Å.
///
/// # Errors
/// [`SurfaceError::NoSpheres`], [`SurfaceError::BadParameter`] for a radius, [`SurfaceError::Limit`],
/// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
pub fn find(
    spheres: &Spheres,
    params: &SurfaceParams,
    pocket_probe: f64,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<Pockets, SurfaceError> {
    find_at(SPACING, spheres, params, pocket_probe, limits, control)
}

/// Finds pockets on a grid of this spacing, Å.
fn find_at(
    spacing: f64,
    spheres: &Spheres,
    params: &SurfaceParams,
    pocket_probe: f64,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<Pockets, SurfaceError> {
    let (metered, memory) = control.with_reservation();
    let control = &Control { observer: &(), ..metered };
    let params = params_at(spacing, params);
    let [small, large] = [params.probe, pocket_probe].map(|probe| probe / spacing);
    let grid = Grid::around(spheres, &params, pocket_probe, limits, control)?;
    control.memory.grow(BALL_BYTES * grid.balls.len() as u64)?;
    let outside = grid.reached(small, control)?;
    let mut pocket = grid.reached(large, control)?.dilated(&Element::cube(REMOVED / spacing), control)?;
    pocket.combine(&outside, |removed, outside| outside & !removed);
    let cell = spacing.powi(3);
    let regions = Regions::new(&pocket, MIN_VOLUME / cell, control)?;
    let measured = regions.measure(&outside, pocket, control)?;
    let mut lining = vec![Vec::new(); measured.len()];
    for (pocket, source) in grid.lining(small, &regions, control)? {
        lining[pocket as usize].push(source);
    }
    let list = measured.into_iter().zip(lining).map(|(region, mut lining)| {
        lining.sort_unstable();
        Pocket {
            volume: region.points as f64 * cell,
            area: region.area * spacing * spacing,
            depth: (region.depth2 as f64).sqrt() * spacing,
            centre: std::array::from_fn(|k| {
                (region.sums[k] as f64 / region.points as f64 + f64::from(grid.origin[k])) * spacing
            }),
            openings: region.openings,
            lining,
        }
    });
    let (list, origin) = (list.collect(), grid.origin);
    Ok(Pockets { list, regions, spacing, origin, _memory: memory })
}

/// Counts the rows of grid points that [`find`] passes over, without a search.
///
/// # Errors
/// Those errors of [`find`] that end it before the search.
pub fn count_rows(
    spheres: &Spheres,
    params: &SurfaceParams,
    pocket_probe: f64,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<u64, SurfaceError> {
    let control = &control.metered();
    control.memory.grow(BALL_BYTES * spheres.len() as u64)?;
    Ok(Grid::around(spheres, &params_at(SPACING, params), pocket_probe, limits, control)?.rows)
}

/// Returns the parameters of the surface that the centre of the small probe reaches, on a grid of this spacing, Å.
fn params_at(spacing: f64, params: &SurfaceParams) -> SurfaceParams {
    SurfaceParams { surface: SurfaceKind::Sas, resolution: spacing, atom_ids: false, quantize: None, ..params.clone() }
}

/// Returns the number of rows of grid points that the search passes over for a sphere of this radius. All lengths are
/// in spacings.
#[must_use]
pub fn rows_in_reach(radius: f64, small: f64, large: f64) -> f64 {
    // With the small probe twice: to find where it fits, and to find which pockets the sphere lines.
    PI * (2.0 * (radius + small).powi(2) + (radius + large).powi(2))
}

impl Grid {
    /// Returns the grid around spheres, with the spacing and the small probe of `params`.
    fn around(
        spheres: &Spheres,
        params: &SurfaceParams,
        pocket_probe: f64,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let control = &control.metered();
        control.memory.grow(LATTICE_BYTES * spheres.len() as u64)?;
        let [small, large] = [params.probe, pocket_probe].map(|probe| probe / params.resolution);
        Self::new(&Lattice::new(spheres, params, control)?, small, large, limits)
    }

    /// Returns the grid around atoms whose radii include the small probe. The large probe fits between the atoms and
    /// the sides of the grid. Probes are in spacings.
    fn new(lattice: &Lattice, small: f64, large: f64, limits: &SurfaceLimits) -> Result<Self, SurfaceError> {
        let atoms = &lattice.atoms;
        let radius = |atom: &LatticeAtom| f64::from(atom.inv_length2).sqrt().recip() - small;
        let largest = atoms.iter().map(radius).fold(0.0, f64::max);
        let margin = largest + large.max(small) + 1.0;
        let end = |k: usize, pick: fn(f64, f64) -> f64| atoms.iter().map(|atom| atom.position(k)).reduce(pick);
        let low = [0, 1, 2].map(|k| (end(k, f64::min).unwrap_or(0.0) - margin).floor());
        let high = [0, 1, 2].map(|k| (end(k, f64::max).unwrap_or(0.0) + margin).ceil());
        let sides = [0, 1, 2].map(|k| high[k] - low[k] + 1.0);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "casts saturate, as wanted")]
        let (grid_points, size) = (sides.iter().product::<f64>() as u64, sides.map(|side| side as usize));
        let too_large = Exceeded::capped(Limit::PocketPoints, limits.max_grid_points, MAX_GRID_POINTS);
        if grid_points > too_large.max {
            return Err(Exceeded { actual: Some(grid_points), ..too_large }.error());
        }
        let ball = |atom: &LatticeAtom| Ball {
            centre: [0, 1, 2].map(|k| atom.position(k) - low[k]),
            radius: radius(atom),
            source: atom.source,
        };
        let mut balls: Vec<Ball> = atoms.iter().map(ball).collect();
        let rows = to_u64(balls.iter().map(|ball| rows_in_reach(ball.radius, small, large)).sum());
        let limit = ROWS_PER_PAIR.saturating_mul(limits.max_candidates);
        if rows > limit {
            return Err(Exceeded { actual: Some(rows), ..Exceeded::new(Limit::PocketRows, limit) }.error());
        }
        balls.par_sort_by(|a, b| a.centre[2].total_cmp(&b.centre[2]));
        Ok(Self { balls, largest, size, origin: low.map(to_i32), rows })
    }

    /// Returns the points that a probe covers that does not overlap the spheres.
    fn reached(&self, probe: f64, control: &Control<'_>) -> Result<BitGrid, SurfaceError> {
        let mut centres = BitGrid::new(self.size, control)?;
        let reach = self.largest + probe;
        centres.fill_layers(control, |z, add| {
            let z = z as f64;
            let first = self.balls.partition_point(|ball| ball.centre[2] < z - reach);
            for ball in self.balls[first..].iter().take_while(|ball| ball.centre[2] <= z + reach) {
                for (y, range) in self.rows(ball, ball.radius + probe, z) {
                    add(y, range);
                }
            }
        })?;
        centres.invert();
        centres.dilated(&Element::ball(probe), control)
    }

    /// Returns the rows of a layer that a ball of this radius reaches, with their first and last points.
    fn rows(&self, ball: &Ball, radius: f64, z: f64) -> impl Iterator<Item = (usize, [usize; 2])> {
        let [cx, cy, cz] = ball.centre;
        let of_layer = radius * radius - (z - cz).powi(2);
        let width = self.size[0];
        let half = if of_layer > 0.0 { of_layer.sqrt() } else { -1.0 };
        range(cy, half, self.size[1]).filter_map(move |y| {
            let of_row = of_layer - (y as f64 - cy).powi(2);
            let mut points = range(cx, if of_row > 0.0 { of_row.sqrt() } else { -1.0 }, width);
            let first = points.next()?;
            Some((y, [first, points.next_back().unwrap_or(first)]))
        })
    }

    /// Returns pairs of a pocket and the index of a sphere that lines it, each once.
    fn lining(&self, probe: f64, regions: &Regions, control: &Control<'_>) -> Result<Vec<(u32, u32)>, SurfaceError> {
        let of_balls = |balls: &[Ball]| {
            control.check()?;
            let mut found = Vec::new();
            for ball in balls {
                let start = found.len();
                let radius = ball.radius + probe;
                for z in range(ball.centre[2], radius, self.size[2]) {
                    for (y, ends) in self.rows(ball, radius, z as f64) {
                        for pocket in regions.touched(z * self.size[1] + y, ends) {
                            if !found[start..].contains(&(pocket, ball.source)) {
                                found.push((pocket, ball.source));
                            }
                        }
                    }
                }
            }
            Ok(found)
        };
        let found = self.balls.par_chunks(BALLS).map(of_balls).collect::<Result<Vec<_>, SurfaceError>>()?;
        Ok(found.into_iter().flatten().collect())
    }
}

/// Returns the points of an axis with `n` points that are at most `half` from `centre`; none if `half` is negative.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "casts saturate, as wanted")]
fn range(centre: f64, half: f64, n: usize) -> std::ops::Range<usize> {
    if half < 0.0 {
        return 0..0;
    }
    let (first, end) = ((centre - half).ceil().max(0.0) as usize, (centre + half).floor() + 1.0);
    first..(end.max(0.0) as usize).min(n)
}

#[cfg(test)]
mod tests;
