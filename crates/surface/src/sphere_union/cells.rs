//! Uniform grid of cells, each with the spheres whose centres it contains.

use std::cmp::Ordering;

use rayon::prelude::*;
use rustc_hash::{FxBuildHasher, FxHashMap};

use super::caps::Neighbour;
use super::radius;
use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::{LatticeAtom, to_f32, to_i32, to_u32};
use crate::vector::dot;

/// Maximum memory per sphere, bytes: its cell while sorting, its number and its entry in the index.
const BYTES: u64 = 64;

/// Spheres or cells between two checks of the cancellation flag: a few milliseconds.
const PER_CHECK: usize = 1 << 16;

/// Step to which centres are rounded, Å: the precision of [`LatticeAtom`] half-way between grid points. Two centres
/// then coincide or are far enough apart to define the plane of their circle.
const COORDINATE_STEP: f64 = 1.0 / (1_u32 << 25) as f64;

/// Cells with the diameter of the largest sphere as edge length: spheres that overlap lie in neighbouring cells.
pub(super) struct Cells<'a> {
    atoms: &'a [LatticeAtom],
    /// Index in `starts` of each occupied cell, by coordinates.
    index: FxHashMap<[i32; 3], u32>,
    coords: Vec<[i32; 3]>,
    /// Index in `order` of the first sphere of each cell; the last element is the number of spheres.
    starts: Vec<u32>,
    order: Vec<u32>,
}

/// Spheres of a cell and its neighbours, relative to a reference cell of the lattice.
pub(super) struct Around<'a> {
    atoms: &'a [LatticeAtom],
    base: [i32; 3],
    order: Vec<u32>,
    /// Centres and radii, column by column.
    columns: [Vec<f64>; 4],
}

impl<'a> Cells<'a> {
    pub(super) fn new(atoms: &'a [LatticeAtom], control: &Control<'_>) -> Result<Self, SurfaceError> {
        control.memory.grow(BYTES * atoms.len() as u64)?;
        // Slightly more than the diameter: rounding must not separate spheres that touch.
        let side = 2.001 * atoms.iter().map(radius).fold(0.0, f64::max) + 1.0;
        let cell = |atom: &LatticeAtom| atom.centre().map(|c| to_i32((c / side).floor()));
        let mut keys: Vec<([i32; 3], u32)> = Vec::with_capacity(atoms.len());
        for some in atoms.chunks(PER_CHECK) {
            control.check()?;
            keys.extend(some.iter().zip(to_u32(keys.len())..).map(|(atom, i)| (cell(atom), i)));
        }
        // Equal keys need no sorting, so that a cancelled sort ends after one pass over its current parts.
        let order = |a: &([i32; 3], u32), b: &([i32; 3], u32)| {
            if control.cancel.is_cancelled() { Ordering::Equal } else { a.cmp(b) }
        };
        keys.par_sort_unstable_by(order);
        control.check()?;
        let (mut coords, mut starts): (Vec<[i32; 3]>, Vec<u32>) = (Vec::new(), Vec::new());
        for (i, (cell, _)) in keys.iter().enumerate() {
            if coords.last() != Some(cell) {
                coords.push(*cell);
                starts.push(to_u32(i));
            }
        }
        starts.push(to_u32(keys.len()));
        let mut index = FxHashMap::with_capacity_and_hasher(coords.len(), FxBuildHasher);
        for (some, first) in coords.chunks(PER_CHECK).zip((0..).step_by(PER_CHECK)) {
            control.check()?;
            index.extend(some.iter().copied().zip(first..));
        }
        Ok(Self { atoms, index, coords, starts, order: keys.into_iter().map(|(_, i)| i).collect() })
    }

    /// Returns the number of occupied cells.
    pub(super) fn len(&self) -> usize {
        self.coords.len()
    }

    /// Returns the spheres of a cell, ascending.
    pub(super) fn of(&self, cell: usize) -> &[u32] {
        &self.order[self.starts[cell] as usize..self.starts[cell + 1] as usize]
    }

    /// Collects the spheres of a cell and its neighbours.
    pub(super) fn around(&self, cell: usize) -> Around<'a> {
        let [x, y, z] = self.coords[cell];
        let near =
            (-1..=1).flat_map(|dz| (-1..=1).flat_map(move |dy| (-1..=1).map(move |dx| [x + dx, y + dy, z + dz])));
        let cells = near.filter_map(|near| self.index.get(&near));
        let order: Vec<u32> = cells.flat_map(|&cell| self.of(cell as usize)).copied().collect();
        let base = self.of(cell).first().map_or([0; 3], |&i| self.atoms[i as usize].cell);
        let mut around = Around { atoms: self.atoms, base, order, columns: Default::default() };
        for (k, column) in around.columns.iter_mut().enumerate().take(3) {
            column.extend(around.order.iter().map(|&i| coordinate(&self.atoms[i as usize], base, k)));
        }
        around.columns[3].extend(around.order.iter().map(|&i| radius(&self.atoms[i as usize])));
        around
    }
}

/// Returns coordinate `k` of an atom relative to a cell of the lattice.
fn coordinate(atom: &LatticeAtom, base: [i32; 3], k: usize) -> f64 {
    f64::from(atom.cell[k] - base[k]) + f64::from(atom.frac[k])
}

impl Around<'_> {
    /// Fills `found` with the spheres that overlap sphere `own`, including `own` itself.
    pub(super) fn neighbours(&self, own: u32, found: &mut Vec<Neighbour>) {
        let atom = &self.atoms[own as usize];
        let [cx, cy, cz]: [f64; 3] = std::array::from_fn(|k| coordinate(atom, self.base, k));
        let r = radius(atom);
        let [x, y, z, radii] = &self.columns;
        found.clear();
        for ((((x, y), z), radius), index) in x.iter().zip(y).zip(z).zip(radii).zip(&self.order) {
            let to = [x - cx, y - cy, z - cz];
            let reach = r + radius;
            if dot(to, to) < reach * reach {
                found.push(Neighbour { to, radius: *radius, index: *index });
            }
        }
    }
}

/// Rounds the offset of a centre from its cell to [`COORDINATE_STEP`].
pub(crate) fn rounded(offset: f64) -> f32 {
    to_f32((offset / COORDINATE_STEP).round() * COORDINATE_STEP)
}

/// Places a sphere on the lattice with a spacing of 1 Å, and rounds its centre to [`COORDINATE_STEP`].
pub(super) fn on_lattice(centre: [f64; 3], radius: f64, number: usize) -> LatticeAtom {
    let cell = centre.map(f64::round);
    LatticeAtom {
        cell: cell.map(to_i32),
        inv_length2: to_f32(radius.powi(-2)),
        frac: std::array::from_fn(|k| rounded(centre[k] - cell[k])),
        source: to_u32(number),
    }
}
