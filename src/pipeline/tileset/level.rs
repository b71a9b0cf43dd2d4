//! Spheres of a level of detail, with an index by tile.

use std::ops::Range;
use std::sync::Arc;

use rustc_hash::FxHashMap;

use crate::surface::{Control, Spheres, SurfaceError, SurfaceParams};

/// Spacing above which atoms are grouped, Å: a coarser grid misses single atoms, and all atoms would be too many for
/// its few cells.
const GROUP_ABOVE: f64 = 2.5;
/// Radius below which a group of atoms moves to a grid point, in spacings. Groups in the interior of a protein have
/// about 0.65.
const SMALL: f64 = 0.5;
/// Memory of a sphere in the index, bytes: its number, and its share of the buckets.
const INDEX_BYTES: u64 = 12;
/// Memory of a group of atoms, bytes: the columns of its sphere, and its row.
const GROUP_BYTES: u64 = 32;
/// Memory of an atom while the index is sorted, bytes.
const SORT_BYTES: u64 = 32;
/// Spheres between two checks of the cancellation flag: a few milliseconds.
const PER_CHECK: usize = 1 << 14;

/// Spheres of a level.
#[derive(Debug)]
pub(super) struct TilesetLevel {
    pub(super) spheres: Arc<Spheres>,
    /// Atom that represents each sphere, as a row of the selected atoms; `None` if sphere and row are the same.
    rows: Option<Vec<u32>>,
    /// Edge length of the buckets of the index, Å.
    side: f64,
    /// Range in `order` of the spheres of each bucket.
    buckets: FxHashMap<[i64; 3], Range<usize>>,
    order: Vec<u32>,
}

impl TilesetLevel {
    /// Prepares a level with the grid spacing `spacing` and tiles with the edge length `side`, Å. A coarse level has
    /// one sphere for all atoms in a cell of its grid, with their total volume.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`], [`SurfaceError::BadParameter`] for the radii.
    pub(super) fn new(
        atoms: &Arc<Spheres>,
        params: &SurfaceParams,
        [spacing, side]: [f64; 2],
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let _sorting = control.reserve(SORT_BYTES * atoms.len() as u64)?;
        let (spheres, rows) = if spacing <= GROUP_ABOVE {
            (Arc::clone(atoms), None)
        } else {
            let (spheres, rows) = grouped(atoms, params, spacing, control)?;
            control.memory.grow(GROUP_BYTES * spheres.len() as u64)?;
            (Arc::new(spheres), Some(rows))
        };
        control.memory.grow(INDEX_BYTES * spheres.len() as u64)?;
        let mut keys = Vec::with_capacity(spheres.len());
        for i in 0..spheres.len() {
            if i.is_multiple_of(PER_CHECK) {
                control.check()?;
            }
            keys.push((cube(spheres.centre(i), side), u32::try_from(i).unwrap_or(u32::MAX)));
        }
        keys.sort_unstable();
        let mut buckets = FxHashMap::default();
        let mut first = 0;
        for group in keys.chunk_by(|a, b| a.0 == b.0) {
            buckets.insert(group[0].0, first..first + group.len());
            first += group.len();
        }
        Ok(Self { spheres, rows, side, buckets, order: keys.into_iter().map(|(_, i)| i).collect() })
    }

    /// Returns the spheres whose centres are at most `margin` away from a box along each axis, ascending. Lengths are
    /// in Å.
    pub(super) fn near(&self, [low, high]: [[f64; 3]; 2], margin: f64) -> Vec<u32> {
        let [low, high] = [low.map(|c| c - margin), high.map(|c| c + margin)];
        let [from, to] = [cube(low, self.side), cube(high, self.side)];
        let columns = (from[2]..=to[2]).flat_map(|z| (from[1]..=to[1]).map(move |y| [y, z]));
        let buckets = columns.flat_map(|[y, z]| (from[0]..=to[0]).map(move |x| [x, y, z]));
        let all = buckets.filter_map(|at| self.buckets.get(&at)).flat_map(|range| &self.order[range.clone()]);
        let within = |i: &u32| {
            let c = self.spheres.centre(*i as usize);
            (0..3).all(|k| (low[k]..=high[k]).contains(&c[k]))
        };
        let mut found: Vec<u32> = all.copied().filter(within).collect();
        found.sort_unstable();
        found
    }

    /// Returns the row of the atom that represents a sphere.
    pub(super) fn row(&self, sphere: u32) -> u32 {
        self.rows.as_ref().map_or(sphere, |rows| rows[sphere as usize])
    }
}

/// Returns the cube of edge length `side`, Å, that contains a point.
#[expect(clippy::cast_possible_truncation, reason = "coordinates are limited")]
fn cube(c: [f64; 3], side: f64) -> [i64; 3] {
    c.map(|c| (c / side).floor() as i64)
}

/// Returns a sphere for the atoms in each cell of a grid, Å: at the mean of their centres, with their total volume. A
/// small sphere lies at the nearest grid point instead.
/// Also returns the atom nearest to this mean.
fn grouped(
    atoms: &Spheres,
    params: &SurfaceParams,
    spacing: f64,
    control: &Control<'_>,
) -> Result<(Spheres, Vec<u32>), SurfaceError> {
    let mut keys = Vec::with_capacity(atoms.len());
    for i in 0..atoms.len() {
        if i.is_multiple_of(PER_CHECK) {
            control.check()?;
        }
        keys.push((cube(atoms.centre(i), spacing), i));
    }
    keys.sort_unstable();
    let effective = |radius: f32| f64::from(radius) * params.radius_scale + params.radius_offset;
    #[expect(clippy::cast_possible_truncation, reason = "radii have single precision")]
    let given = |effective: f64| ((effective - params.radius_offset) / params.radius_scale) as f32;
    let [mut x, mut y, mut z] = [const { Vec::new() }; 3];
    let (mut radii, mut rows) = (Vec::new(), Vec::new());
    for (n, group) in keys.chunk_by(|a, b| a.0 == b.0).enumerate() {
        if n.is_multiple_of(PER_CHECK) {
            control.check()?;
        }
        let centres = group.iter().map(|(_, i)| atoms.centre(*i));
        let mean: [f64; 3] = std::array::from_fn(|k| centres.clone().map(|c| c[k]).sum::<f64>() / group.len() as f64);
        let distance2 = |i: usize| (0..3).map(|k| (atoms.centre(i)[k] - mean[k]).powi(2)).sum::<f64>();
        let nearest = group.iter().map(|(_, i)| *i).min_by(|a, b| distance2(*a).total_cmp(&distance2(*b)));
        let cubes = group.iter().map(|(_, i)| effective(atoms.radius(*i)).powi(3)).sum::<f64>();
        let radius = cubes.cbrt();
        // The grid would miss a small sphere between its points.
        let centre = if radius < SMALL * spacing { mean.map(|c| (c / spacing).round() * spacing) } else { mean };
        x.push(centre[0]);
        y.push(centre[1]);
        z.push(centre[2]);
        radii.push(given(radius));
        rows.push(u32::try_from(nearest.unwrap_or_default()).unwrap_or(u32::MAX));
    }
    Ok((Spheres::new(x, y, z, radii)?, rows))
}
