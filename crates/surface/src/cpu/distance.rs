//! Van der Waals, solvent-accessible and solvent-excluded surfaces: level sets of the distance to the boundary of a
//! union of spheres, in the stages `field`, `refine` and `interpolate`.
//!
//! Every distance depends on the point and the boundary alone: spheres and arcs out of reach do not affect its bits. As
//! for densities, the signs at the grid points determine the topology. Vertices are then moved along their edges to the
//! exact surface.

use std::ops::Range;

use super::RunContext;
use super::bin::{Bricks, NORMAL_ONLY, Tiles};
use super::field::{BrickField, GridPointRange};
use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::{Lattice, LatticeAtom, to_f32};
use crate::params::{SurfaceKind, SurfaceLimits, SurfaceParams};
use crate::sphere_union::{BrickUnion, Feature, Lanes, SphereUnion};

/// Value at a grid point on the surface. Grid points more than a spacing outside are 0, those more than a spacing
/// inside 2.
pub const SURFACE: f32 = 1.0;

/// Maximum distance of vertices from the surface, Å.
const TOLERANCE: f64 = 1e-4;
/// Minimum of [`TOLERANCE`] in spacings: coordinates within a brick are rounded.
const ROUNDING: f32 = 4e-6;

/// Returns the distance at the surface, spacings.
pub fn level(lattice: &Lattice, params: &SurfaceParams) -> f64 {
    if params.surface == SurfaceKind::Ses { params.probe / lattice.spacing } else { 0.0 }
}

/// Returns the maximum distance of vertices from the surface, spacings.
pub fn tolerance(lattice: &Lattice) -> f32 {
    to_f32(TOLERANCE / lattice.spacing).max(ROUNDING)
}

/// Finds the boundary of the spheres of `lattice` and a bounding sphere of each of its arcs. Returns `None` for
/// surfaces at which the distance to the nearest sphere is exact, and for isosurfaces.
///
/// # Errors
/// [`SurfaceError::Limit`], [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
pub fn boundary(
    lattice: &Lattice,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<Option<(SphereUnion, Vec<LatticeAtom>)>, SurfaceError> {
    let level = level(lattice, params);
    if level == 0.0 {
        return Ok(None);
    }
    // Distances are exact up to a spacing inside the surface.
    SphereUnion::new(&lattice.atoms, lattice.spacing, level + 1.0, limits, control).map(Some)
}

/// Distance to the boundary of a union of spheres.
pub(super) struct DistanceField {
    /// Boundary of the spheres enlarged by the probe. `None` uses the distance to the nearest sphere, which is exact
    /// outside and on the boundary.
    boundary: Option<Boundary>,
    /// Distance at the surface, spacings.
    pub(super) level: f32,
    pub(super) tolerance: f32,
    /// True if the nearest sphere of each vertex is requested.
    pub(super) atom_ids: bool,
}

/// Boundary whose arcs are assigned to tiles by their bounding spheres.
struct Boundary {
    union: SphereUnion,
    bounds: Lattice,
    tiles: Tiles,
}

impl DistanceField {
    /// Prepares the surface of `context`.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`] before memory is allocated beyond the limits, [`SurfaceError::Memory`],
    /// [`SurfaceError::Cancelled`].
    pub(super) fn new(lattice: &Lattice, context: RunContext<'_>) -> Result<Self, SurfaceError> {
        let RunContext { params, limits, control, .. } = context;
        let found = boundary(lattice, params, limits, control)?.map(|(union, bounds)| {
            let bounds = Lattice { atoms: bounds.into(), ..lattice.clone() };
            let tiles = Tiles::new(&bounds, limits, control)?;
            Ok::<_, SurfaceError>(Boundary { union, bounds, tiles })
        });
        Ok(Self {
            boundary: found.transpose()?,
            level: to_f32(level(lattice, params)),
            tolerance: tolerance(lattice),
            atom_ids: params.atom_ids,
        })
    }

    /// Returns the number of ordered pairs of overlapping spheres; 0 if the surface needs no boundary of their union.
    pub(super) fn overlaps(&self) -> u64 {
        self.boundary.as_ref().map_or(0, |boundary| boundary.union.n_overlaps)
    }

    /// Returns the bounding spheres of the arcs.
    pub(super) fn bounds(&self) -> Option<&Lattice> {
        self.boundary().map(|(bounds, _)| bounds)
    }

    /// Returns the bounding spheres of the arcs and their tiles.
    pub(super) fn boundary(&self) -> Option<(&Lattice, &Tiles)> {
        self.boundary.as_ref().map(|boundary| (&boundary.bounds, &boundary.tiles))
    }

    /// Finds the arcs near every brick in `layers` of a tile, and in the layer beyond, as [`Bricks::fill`] finds atoms.
    ///
    /// # Errors
    /// Those of `count`.
    pub(super) fn fill_arcs(
        &self,
        arcs: &mut Bricks,
        tile: [i32; 3],
        layers: &Range<usize>,
        count: impl FnMut(u64) -> Result<(), SurfaceError>,
    ) -> Result<(), SurfaceError> {
        arcs.clear();
        let Some(Boundary { bounds, tiles, .. }) = &self.boundary else { return Ok(()) };
        let Some(t) = tiles.index.get(&tile) else { return Ok(()) };
        arcs.fill(bounds, tile, layers, tiles.atoms(*t as usize), count)
    }

    /// Loads the spheres and arcs near the brick at `origin`.
    pub(super) fn load(
        &self,
        spheres: &mut BrickUnion,
        atoms: &[LatticeAtom],
        candidates: &[u32],
        arcs: &[u32],
        origin: [i32; 3],
    ) {
        let index = |marked: &u32| marked & !NORMAL_ONLY;
        let candidates = candidates.iter().map(|i| (index(i), &atoms[index(i) as usize]));
        let arcs = self.boundary.iter().flat_map(|Boundary { union, bounds, .. }| {
            let bounds = &bounds.atoms[..];
            arcs.iter().map(move |i| (index(i), &bounds[index(i) as usize], union.arc(index(i))))
        });
        spheres.load(origin, candidates, arcs);
    }

    pub(super) fn union(&self) -> Option<&SphereUnion> {
        self.boundary.as_ref().map(|boundary| &boundary.union)
    }

    /// Writes the values at the grid points of the brick that is loaded.
    pub(super) fn evaluate(&self, spheres: &mut BrickUnion, range: GridPointRange, out: &mut BrickField) {
        // In a block of 4 × 2 × 2 grid points, few spheres can be the nearest one.
        for (z, y, x) in blocks(range) {
            let point = |lane: usize| [x + lane % 4, y + lane / 4 % 2, z + lane / 8];
            let points: Lanes = std::array::from_fn(|k| std::array::from_fn(|lane| point(lane)[k] as f32));
            let found = spheres.nearest(self.union(), self.level, &points);
            for (lane, distance) in found.distance.into_iter().enumerate() {
                let [x, y, z] = point(lane);
                let value = (SURFACE + (distance - self.level)).clamp(0.0, 2.0 * SURFACE);
                // Outside all spheres, the distance itself is not needed.
                out[(z * 8 + y) * 8 + x] = if distance > 0.0 { value } else { 0.0 };
            }
        }
    }

    /// Writes outward normals of any length at vertices of the brick at `origin`.
    pub(super) fn normals(
        &self,
        atoms: &[LatticeAtom],
        features: &[Feature],
        origin: [i32; 3],
        p: &[Vec<f32>; 3],
        n: &mut [Vec<f32>; 3],
    ) {
        for (i, feature) in features.iter().enumerate() {
            let x: [f32; 3] = std::array::from_fn(|k| p[k][i]);
            let normal = match (feature.arc(), &self.boundary) {
                (Ok(arc), Some(Boundary { union, bounds, .. })) => {
                    union.arc(arc).toward(&bounds.atoms[arc as usize], origin, x)
                }
                (Ok(sphere) | Err(sphere), _) => {
                    let LatticeAtom { cell, frac, .. } = &atoms[sphere as usize];
                    std::array::from_fn(|k| x[k] - ((cell[k] - origin[k]) as f32 + frac[k]))
                }
            };
            for (column, value) in n.iter_mut().zip(normal) {
                column[i] = value;
            }
        }
    }
}

/// Returns the first grid point (z, y, x) of each block of a brick.
fn blocks(range: GridPointRange) -> impl Iterator<Item = (usize, usize, usize)> {
    let layers = (0..range.z_layers).step_by(2);
    layers.flat_map(move |z| (0..range.y_pairs).flat_map(move |pair| [0, 4].map(move |x| (z, 2 * pair, x))))
}
