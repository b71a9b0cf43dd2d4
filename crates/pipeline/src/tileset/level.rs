//! Spheres of a level of detail, with an index by tile.

use std::sync::Arc;

use molmesh_surface::groups::{GroupCounts, Groups};
use molmesh_surface::spheres::MAX_COORDINATE;
use molmesh_surface::vector::squared_distance;
use molmesh_surface::{Control, Spheres, SurfaceError, SurfaceParams};
use rustc_hash::FxHashMap;

/// Spacing above which atoms are grouped, Å: a coarser grid misses single atoms, and all atoms would be too many for
/// its few cells.
pub(super) const GROUP_ABOVE: f64 = 2.5;
/// Minimum edge length of the buckets of the atoms, Å: with smaller ones, tiles of coarse levels would look up many.
pub(super) const MIN_BUCKET: f64 = 32.0;
/// Radius below which a group of atoms moves to a grid point, in spacings. Groups in the interior of a protein have
/// about 0.65.
const SMALL: f64 = 0.5;
/// Memory of a sphere in the index, bytes: its number.
const INDEX_BYTES: u64 = 4;
/// Memory of a bucket of the index, bytes.
const BUCKET_BYTES: u64 = 64;
/// Memory of a group of atoms, bytes: the columns of its sphere, and its row.
const GROUP_BYTES: u64 = 32;
/// Memory of an atom while it is grouped, bytes.
const SORT_BYTES: u64 = 32;
/// Spheres between two checks of the cancellation flag: a few milliseconds.
const PER_CHECK: usize = 1 << 14;

/// Spheres of a level.
#[derive(Debug)]
pub(super) struct TilesetLevel {
    pub(super) spheres: Arc<Spheres>,
    /// Atom that represents each sphere, as a row of the selected atoms; `None` if sphere and row are the same.
    rows: Option<Vec<u32>>,
    /// Buckets of the spheres. Levels whose spheres are the atoms share them.
    buckets: Arc<Buckets>,
}

/// Spheres by the cube that contains their centres.
#[derive(Debug)]
pub(super) struct Buckets {
    /// Edge length of the cubes, Å.
    side: f64,
    numbers: FxHashMap<[i64; 3], u32>,
    spheres: Groups,
}

impl Buckets {
    /// Sorts spheres into cubes with the edge length `side`, Å. Sorts by counting, without memory besides the result.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(super) fn new(spheres: &Spheres, side: f64, control: &Control<'_>) -> Result<Self, SurfaceError> {
        control.memory.grow(INDEX_BYTES * spheres.len() as u64)?;
        let mut numbers = FxHashMap::default();
        let mut counts = GroupCounts::new(0);
        // Successive atoms mostly lie in one bucket.
        let mut last = ([i64::MIN; 3], 0);
        for i in 0..spheres.len() {
            control.check_every(i, PER_CHECK)?;
            let at = cube(spheres.centre(i), side);
            if at != last.0 {
                let next = u32::try_from(numbers.len()).unwrap_or(u32::MAX);
                last = (at, *numbers.entry(at).or_insert(next));
                if last.1 == next {
                    control.memory.grow(BUCKET_BYTES)?;
                    counts.push_group();
                }
            }
            counts.add(last.1 as usize);
        }
        let mut groups = counts.groups();
        let mut last = ([i64::MIN; 3], 0);
        for (i, row) in (0..spheres.len()).zip(0_u32..) {
            control.check_every(i, PER_CHECK)?;
            let at = cube(spheres.centre(i), side);
            if at != last.0 {
                last = (at, numbers[&at] as usize);
            }
            groups.push(last.1, row);
        }
        Ok(Self { side, numbers, spheres: groups })
    }

    /// Returns each bucket with its cell of a grid, sorted by cell. A cell is a union of buckets; cells smaller than a
    /// bucket are joined up to its size.
    fn by_cell(&self, spacing: f64) -> Vec<([i64; 3], u32)> {
        let cell = |at: &[i64; 3]| grid_cell(*at, self.side, spacing);
        let mut cells: Vec<_> = self.numbers.iter().map(|(at, number)| (cell(at), *number)).collect();
        cells.sort_unstable();
        cells
    }

    /// Returns the spheres in a cube.
    fn at(&self, cube: [i64; 3]) -> &[u32] {
        self.numbers.get(&cube).map_or(&[], |number| self.spheres.get(*number as usize))
    }
}

impl TilesetLevel {
    /// Prepares a level with the grid spacing `spacing` and tiles with the edge length `side`, Å. A coarse level has
    /// one sphere for all atoms in a cell of its grid, with their total volume. `buckets` are those of the atoms.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`], [`SurfaceError::BadParameter`] for the radii.
    pub(super) fn new(
        atoms: &Arc<Spheres>,
        buckets: &Arc<Buckets>,
        params: &SurfaceParams,
        [spacing, side]: [f64; 2],
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        if spacing <= GROUP_ABOVE {
            return Ok(Self { spheres: Arc::clone(atoms), rows: None, buckets: Arc::clone(buckets) });
        }
        let (spheres, rows) = grouped(atoms, buckets, params, spacing, control)?;
        let buckets = Arc::new(Buckets::new(&spheres, side, control)?);
        Ok(Self { spheres: Arc::new(spheres), rows: Some(rows), buckets })
    }

    /// Returns the spheres whose centres are at most `margin` away from a box along each axis, ascending. Lengths are
    /// in Å.
    pub(super) fn near(&self, [low, high]: [[f64; 3]; 2], margin: f64) -> Vec<u32> {
        let [low, high] = [low.map(|c| c - margin), high.map(|c| c + margin)];
        let [from, to] = [low, high].map(|corner| cube(corner, self.buckets.side));
        let columns = (from[2]..=to[2]).flat_map(|z| (from[1]..=to[1]).map(move |y| [y, z]));
        let cubes = columns.flat_map(|[y, z]| (from[0]..=to[0]).map(move |x| [x, y, z]));
        let within = |i: &u32| {
            let c = self.spheres.centre(*i as usize);
            (0..3).all(|k| (low[k]..=high[k]).contains(&c[k]))
        };
        let mut found: Vec<u32> = cubes.flat_map(|cube| self.buckets.at(cube)).copied().filter(within).collect();
        found.sort_unstable();
        found
    }

    /// Returns the row of the atom that represents a sphere.
    pub(super) fn row(&self, sphere: u32) -> u32 {
        self.rows.as_ref().map_or(sphere, |rows| rows[sphere as usize])
    }
}

/// Returns the edge length of the buckets of a level, Å: the first doubling of `side` that is not too short. Buckets
/// determine the order of groups of atoms.
pub(super) fn bucket_side(mut side: f64) -> f64 {
    while side < MIN_BUCKET {
        side *= 2.0;
    }
    side
}

/// Returns the cube of edge length `side`, Å, that contains a point.
#[expect(clippy::cast_possible_truncation, reason = "coordinates are limited")]
pub(super) fn cube(c: [f64; 3], side: f64) -> [i64; 3] {
    c.map(|c| (c / side).floor() as i64)
}

/// Returns the cell of a grid that contains a cube of edge length `side`. Cells smaller than a cube are joined up to
/// its size. Lengths are in Å.
pub(super) fn grid_cell(at: [i64; 3], side: f64, spacing: f64) -> [i64; 3] {
    cube(at.map(|c| (c as f64 + 0.5) * side), spacing.max(side))
}

/// Returns the nearest coordinate of the grid that a sphere can have, Å.
fn grid_point(c: f64, spacing: f64) -> f64 {
    let nearest = (c / spacing).round() * spacing;
    if nearest.abs() > MAX_COORDINATE { (c / spacing).trunc() * spacing } else { nearest }
}

/// Returns a sphere for the atoms in each cell of a grid, Å: at the mean of their centres, with their total volume. A
/// small sphere lies at the nearest grid point instead. Also returns the atom nearest to this mean. `buckets` limit the
/// memory of sorting.
fn grouped(
    atoms: &Spheres,
    buckets: &Buckets,
    params: &SurfaceParams,
    spacing: f64,
    control: &Control<'_>,
) -> Result<(Spheres, Vec<u32>), SurfaceError> {
    let [mut x, mut y, mut z] = [const { Vec::new() }; 3];
    let (mut radii, mut rows) = (Vec::new(), Vec::new());
    for run in buckets.by_cell(spacing).chunk_by(|a, b| a.0 == b.0) {
        control.check()?;
        let run = run.iter().map(|(_, number)| buckets.spheres.get(*number as usize));
        let _sorting = control.reserve(SORT_BYTES * run.clone().map(<[u32]>::len).sum::<usize>() as u64)?;
        let key = |i: &u32| (cube(atoms.centre(*i as usize), spacing), *i as usize);
        let mut keys: Vec<_> = run.flatten().map(key).collect();
        keys.sort_unstable();
        let before = rows.len();
        for group in keys.chunk_by(|a, b| a.0 == b.0) {
            let sphere = |i: usize| (atoms.centre(group[i].1), atoms.radius(group[i].1));
            let (centre, radius, nearest) = group_of(group.len(), sphere, params, spacing);
            x.push(centre[0]);
            y.push(centre[1]);
            z.push(centre[2]);
            radii.push(radius);
            rows.push(u32::try_from(group[nearest].1).unwrap_or(u32::MAX));
        }
        control.memory.grow(GROUP_BYTES * (rows.len() - before) as u64)?;
    }
    Ok((Spheres::new(x, y, z, radii)?, rows))
}

/// Returns centre and radius, Å, of the sphere of a group of `n` atoms, and the number of the atom nearest to the mean
/// of their centres. `atom` returns centre and radius of each.
pub(super) fn group_of(
    n: usize,
    atom: impl Fn(usize) -> ([f64; 3], f32),
    params: &SurfaceParams,
    spacing: f64,
) -> ([f64; 3], f32, usize) {
    let effective = |radius: f32| f64::from(radius) * params.radius_scale + params.radius_offset;
    #[expect(clippy::cast_possible_truncation, reason = "radii have single precision")]
    let given = |effective: f64| ((effective - params.radius_offset) / params.radius_scale) as f32;
    let mean: [f64; 3] = std::array::from_fn(|k| (0..n).map(|i| atom(i).0[k]).sum::<f64>() / n as f64);
    let distance2 = |i: usize| squared_distance(atom(i).0, mean);
    let nearest = (0..n).min_by(|a, b| distance2(*a).total_cmp(&distance2(*b)));
    let radius = (0..n).map(|i| effective(atom(i).1).powi(3)).sum::<f64>().cbrt();
    // The grid would miss a small sphere between its points.
    let centre = if radius < SMALL * spacing { mean.map(|c| grid_point(c, spacing)) } else { mean };
    (centre, given(radius), nearest.unwrap_or_default())
}
