//! Field of a run at any point near the surface: depth, normal and nearest sphere.

use super::bin::Tiles;
use super::brick_atoms::{BrickAtoms, nearest_atoms};
use super::curvature;
use super::interpolate::sums;
use super::{Field, RunContext, checked_field};
use crate::candidates;
use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::{Lattice, LatticeAtom, TILE};
use crate::params::{SurfaceLimits, SurfaceParams};
use crate::simd::LANES;
use crate::sphere_union::{BrickUnion, Lanes};
use crate::spheres::Spheres;
use crate::vector::length;

/// Margin for rounding in the selection of spheres, spacings.
const MARGIN: f64 = 0.01;

/// Field of a run, prepared for evaluation at any point.
pub(crate) struct PointField {
    lattice: Lattice,
    field: Field,
    tiles: Tiles,
    /// Value of the density on an isosurface.
    level: f32,
}

/// Spheres and arcs that affect a box.
#[derive(Default)]
pub(crate) struct NearbySpheres {
    /// Grid point to which coordinates are relative.
    origin: [i32; 3],
    candidates: Vec<u32>,
    atoms: BrickAtoms,
    union: BrickUnion,
}

/// Field at a point.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct PointSample {
    /// Distance to the surface to first order, positive inside, spacings.
    pub(crate) depth: f32,
    /// Outward unit normal of the level set. Not finite where the gradient vanishes.
    pub(crate) normal: [f32; 3],
}

impl PointField {
    /// Prepares the field of `spheres`.
    ///
    /// # Errors
    /// Those of a run on the CPU, before the field is evaluated.
    pub(crate) fn new(
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        candidates::check(spheres, params, limits)?;
        control.memory.grow(super::LATTICE_BYTES * spheres.len() as u64)?;
        let lattice = Lattice::new(spheres, params, control)?;
        let field = checked_field(&lattice, RunContext { params, limits, control, free_threads: 1 })?;
        let tiles = Tiles::new(&lattice, limits, control)?;
        let level = field.level(params);
        Ok(Self { lattice, field, tiles, level })
    }

    /// Returns the grid point to which the positions of the mesh are relative.
    pub(crate) const fn centre(&self) -> [i32; 3] {
        self.lattice.centre
    }

    /// Returns the spheres and arcs that affect the box between two grid points.
    pub(crate) fn near(&self, [low, high]: [[i32; 3]; 2]) -> NearbySpheres {
        let mut near = NearbySpheres { origin: low, ..NearbySpheres::default() };
        near.candidates = reaching(&self.lattice, &self.tiles, [low, high]);
        match &self.field {
            Field::Density(_) => near.atoms.fill(&self.lattice.atoms, &near.candidates, low),
            Field::Distance(distance) => {
                let arcs = distance.boundary().map(|(bounds, tiles)| reaching(bounds, tiles, [low, high]));
                let arcs = arcs.unwrap_or_default();
                distance.load(&mut near.union, &self.lattice.atoms, &near.candidates, &arcs, low);
            }
        }
        near
    }

    /// Evaluates the field at `points`, in spacings relative to the origin of `near`. Points that follow each other
    /// should be close together.
    pub(crate) fn evaluate(&self, near: &mut NearbySpheres, points: &[[f32; 3]]) -> Vec<PointSample> {
        let mut samples = Vec::with_capacity(points.len());
        for chunk in points.chunks(LANES) {
            let lanes = lanes(chunk);
            match &self.field {
                Field::Density(constants) => {
                    let p = lanes.map(|lane| lane.to_vec());
                    let mut n: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; LANES]);
                    let mut density = vec![0.0; LANES];
                    sums(constants, &mut near.atoms, &p, &mut n, &mut density);
                    samples.extend((0..chunk.len()).map(|i| {
                        // The sum is half of −∇F over the amplitude of the slope.
                        let gradient = [n[0][i], n[1][i], n[2][i]].map(|c| 2.0 * constants.slope_amplitude * c);
                        let value = constants.amplitude * density[i];
                        // As in `interpolate`: Newton's method on ln F.
                        let log = 2.0 * (value - self.level) / (value + self.level);
                        PointSample::new(|length| log * value / length, gradient)
                    }));
                }
                Field::Distance(distance) => {
                    let found = near.union.nearest(distance.union(), distance.level, &lanes);
                    samples.extend((0..chunk.len()).map(|i| {
                        let depth = found.distance[i] - distance.level;
                        PointSample::new(|_| depth, near.union.outward(&found, &lanes, i))
                    }));
                }
            }
        }
        samples
    }

    /// Returns the mean curvature of the level set of the density through each point, per spacing; not finite where the
    /// gradient vanishes, and for surfaces of spheres.
    pub(crate) fn mean_curvatures(&self, near: &mut NearbySpheres, points: &[[f32; 3]]) -> Vec<f32> {
        let Field::Density(constants) = &self.field else { return vec![f32::NAN; points.len()] };
        let mut found = Vec::with_capacity(points.len());
        for chunk in points.chunks(LANES) {
            let curvatures = curvature::mean_curvatures(constants, &mut near.atoms, &lanes(chunk));
            found.extend_from_slice(&curvatures[..chunk.len()]);
        }
        found
    }

    /// Returns the nearest sphere of each point, in the caller's numbering.
    pub(crate) fn nearest_spheres(&self, near: &mut NearbySpheres, points: &[[f32; 3]]) -> Vec<u32> {
        let mut ids = vec![0; points.len()];
        for (ids, chunk) in ids.chunks_mut(LANES).zip(points.chunks(LANES)) {
            let lanes = lanes(chunk);
            match &self.field {
                Field::Density(constants) => {
                    let (atoms, p) = (&self.lattice.atoms, lanes.map(|lane| lane.to_vec()));
                    nearest_atoms(atoms, constants.radius_per_length, &near.candidates, near.origin, &p, ids);
                }
                Field::Distance(distance) => {
                    let found = near.union.nearest(distance.union(), distance.level, &lanes);
                    for (i, id) in ids.iter_mut().enumerate() {
                        *id = self.lattice.atoms[near.union.sphere(&found, i) as usize].source;
                    }
                }
            }
        }
        ids
    }
}

impl PointSample {
    fn new(depth: impl FnOnce(f32) -> f32, outward: [f32; 3]) -> Self {
        let length = length(outward);
        Self { depth: depth(length), normal: outward.map(|c| c / length) }
    }

    /// Returns false where the gradient vanishes.
    pub(crate) fn is_finite(&self) -> bool {
        self.depth.is_finite() && self.normal.iter().all(|c| c.is_finite())
    }
}

/// Returns the coordinates of a chunk of points. Unused lanes repeat the last point.
fn lanes(chunk: &[[f32; 3]]) -> Lanes {
    std::array::from_fn(|k| std::array::from_fn(|i| chunk[i.min(chunk.len() - 1)][k]))
}

/// Returns the atoms of `lattice` that reach the box between two grid points, ascending.
fn reaching(lattice: &Lattice, tiles: &Tiles, [low, high]: [[i32; 3]; 2]) -> Vec<u32> {
    let range = |k: usize| low[k].div_euclid(TILE)..=high[k].div_euclid(TILE);
    let coords = range(2).flat_map(|z| range(1).flat_map(move |y| range(0).map(move |x| [x, y, z])));
    let reaches = |i: &&u32| {
        let atom: &LatticeAtom = &lattice.atoms[**i as usize];
        let gap = |k: usize| {
            let c = atom.position(k);
            (f64::from(low[k]) - c).max(c - f64::from(high[k])).max(0.0)
        };
        (0..3).map(|k| gap(k).powi(2)).sum::<f64>() <= (lattice.reach(atom) + MARGIN).powi(2)
    };
    let of_tiles = coords.filter_map(|tile| tiles.index.get(&tile)).flat_map(|t| tiles.atoms(*t as usize));
    let mut found: Vec<u32> = of_tiles.filter(reaches).copied().collect();
    found.sort_unstable();
    found.dedup();
    found
}
