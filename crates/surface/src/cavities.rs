//! Cavities: regions that the centre of a probe sphere can occupy, without a way out.
//!
//! They follow from the spheres and the probe alone, and not from a mesh: the boundary of the union of the spheres
//! enlarged by the probe has one connected component around each cavity, whose enclosed volume is negative. Islands,
//! which are outer components within a cavity, also bound it.

use std::cmp::Ordering;
use std::collections::BinaryHeap;
use std::f64::consts::PI;

use rayon::prelude::*;

use super::control::Control;
use super::cpu::LATTICE_BYTES;
use super::error::SurfaceError;
use super::lattice::{Lattice, LatticeAtom};
use super::measure::{Component, components_of};
use super::memory::{MemoryMeter, Reservation};
use super::mesh::Mesh;
use super::params::{SurfaceKind, SurfaceLimits, SurfaceParams};
use super::sphere_union::{Components, Shell, rounded};
use super::spheres::Spheres;
use super::vector::{cross, dot, joined_bounds, length, sub, unit};

/// Maximum error of the radius of the largest sphere in a cavity, Å.
const RADIUS_ERROR: f64 = 1e-3;

/// Spheres that are rounded between two checks of the cancellation flag.
const PER_CHECK: usize = 1 << 14;

/// Number of steps between the radius of the probe and 0 in the search for openings.
const OPENING_STEPS: u32 = 16;

/// Cavity that holds a probe.
#[derive(Debug, Clone, PartialEq)]
pub struct Cavity {
    /// Area of the boundary of the region of the probe's centre, Å².
    pub accessible_area: f64,
    /// Volume of the region of the probe's centre, Å³.
    pub accessible_volume: f64,
    /// Area of the solvent-excluded surface: of the boundary of the region that the probe covers, Å².
    pub area: f64,
    /// Volume of the region that the probe covers, Å³.
    pub volume: f64,
    /// Radius of the largest sphere that fits, Å.
    pub radius: f64,
    /// Centre of this sphere, Å.
    pub centre: [f64; 3],
    /// Radius of the largest probe that can enter from outside, Å, rounded down to a multiple of 1/16 of the radius of
    /// the probe.
    pub opening_radius: f64,
    /// Indices of the spheres that a probe in the cavity can touch, ascending.
    pub lining: Vec<u32>,
}

/// Finds the cavities of `spheres` with the radii and the probe of `params`, largest accessible volume first.
///
/// # Errors
/// [`SurfaceError::NoSpheres`], [`SurfaceError::BadParameter`] for a radius, [`SurfaceError::Limit`],
/// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
pub fn find(
    spheres: &Spheres,
    params: &SurfaceParams,
    limits: &SurfaceLimits,
    control: &Control<'_>,
) -> Result<Vec<Cavity>, SurfaceError> {
    let params =
        SurfaceParams { surface: SurfaceKind::Sas, resolution: 1.0, atom_ids: false, quantize: None, ..params.clone() };
    let boundary = Boundary { spheres, params: &params, limits, control };
    let mut cavities = boundary.cavities()?;
    boundary.find_openings(&mut cavities)?;
    Ok(cavities)
}

/// Boundary of the spheres enlarged by a probe.
struct Boundary<'a> {
    spheres: &'a Spheres,
    /// Parameters of a solvent-accessible surface with a grid spacing of 1 Å.
    params: &'a SurfaceParams,
    limits: &'a SurfaceLimits,
    control: &'a Control<'a>,
}

impl Boundary<'_> {
    /// Returns a control whose memory is released when it is dropped, and the spheres enlarged by `probe`, Å.
    fn enlarged(&self, probe: f64) -> Result<(Control<'_>, Lattice), SurfaceError> {
        let control = Control { observer: &(), ..self.control.metered() };
        control.memory.grow(LATTICE_BYTES * self.spheres.len() as u64)?;
        let params = SurfaceParams { probe, ..self.params.clone() };
        let mut lattice = Lattice::new(self.spheres, &params, &control)?;
        // Copies of an atom on an axis of symmetry then coincide or are far enough apart, as in exact measures.
        for atoms in lattice.atoms.chunks_mut(PER_CHECK) {
            control.check()?;
            atoms.iter_mut().flat_map(|atom| &mut atom.frac).for_each(|offset| *offset = rounded(f64::from(*offset)));
        }
        Ok((control, lattice))
    }

    /// Returns the cavities, without their openings.
    fn cavities(&self) -> Result<Vec<Cavity>, SurfaceError> {
        let probe = self.params.probe;
        let (control, lattice) = &self.enlarged(probe)?;
        // Lengths are in spacings, that is in Å.
        let components = Components::new(&lattice.atoms, lattice.spacing, self.limits, control)?;
        let shells = cavity_shells(&components, components.shells(probe, self.limits, control)?, control)?;
        let measure = |shell: &Shell| {
            let atoms = &lattice.atoms;
            let search = DepthSearch { components: &components, atoms, shell, cubes: BinaryHeap::new(), best: None };
            let Some((depth, centre)) = search.run(control)? else { return Ok(None) };
            let mut lining: Vec<u32> = shell.spheres.iter().map(|i| atoms[*i as usize].source).collect();
            lining.sort_unstable();
            Ok(Some(Cavity {
                accessible_area: shell.measures.accessible_area,
                accessible_volume: -shell.measures.accessible_volume,
                area: shell.measures.area,
                volume: -shell.measures.volume,
                radius: depth + probe,
                centre,
                opening_radius: 0.0,
                lining,
            }))
        };
        let found = shells.par_iter().map(measure).collect::<Result<Vec<_>, SurfaceError>>()?;
        let mut found: Vec<Cavity> = found.into_iter().flatten().collect();
        found.sort_by(|a, b| b.accessible_volume.total_cmp(&a.accessible_volume));
        Ok(found)
    }

    /// Sets the opening radii of `cavities`: tries smaller and smaller probes until all of them are open.
    fn find_openings(&self, cavities: &mut [Cavity]) -> Result<(), SurfaceError> {
        let mut closed: Vec<&mut Cavity> = cavities.iter_mut().collect();
        for step in (1..OPENING_STEPS).rev() {
            let probe = self.params.probe * f64::from(step) / f64::from(OPENING_STEPS);
            if closed.is_empty() || probe <= 0.0 {
                break;
            }
            let centres: Vec<[f64; 3]> = closed.iter().map(|cavity| cavity.centre).collect();
            let is_closed = self.is_closed(probe, &centres)?;
            let mut remaining = Vec::new();
            for (cavity, is_closed) in closed.into_iter().zip(is_closed) {
                if is_closed {
                    remaining.push(cavity);
                } else {
                    cavity.opening_radius = probe;
                }
            }
            closed = remaining;
        }
        Ok(())
    }

    /// Returns true for each point that a probe of radius `probe`, Å, cannot reach from outside: a component encloses
    /// it. The points lie outside the spheres enlarged by the probe.
    fn is_closed(&self, probe: f64, points: &[[f64; 3]]) -> Result<Vec<bool>, SurfaceError> {
        let (control, lattice) = &self.enlarged(probe)?;
        let components = Components::new(&lattice.atoms, lattice.spacing, self.limits, control)?;
        Ok(components.around(points, control)?.iter().map(|around| !around.is_empty()).collect())
    }
}

/// Returns the boundaries of the cavities: inner components, each with its islands. An island is an outer component
/// within a cavity.
fn cavity_shells(
    components: &Components<'_>,
    shells: Vec<Shell>,
    control: &Control<'_>,
) -> Result<Vec<Shell>, SurfaceError> {
    let (mut inner, outer): (Vec<Shell>, Vec<Shell>) =
        shells.into_iter().partition(|shell| shell.measures.accessible_volume < 0.0);
    let within = |point: [f64; 3], [low, high]: [[f64; 3]; 2]| (0..3).all(|k| (low[k]..=high[k]).contains(&point[k]));
    let mut islands = Vec::new();
    for shell in outer {
        control.check()?;
        if inner.iter().any(|cavity| within(shell.point, cavity.bounds)) {
            islands.push(shell);
        }
    }
    let points: Vec<[f64; 3]> = islands.iter().map(|island| island.point).collect();
    let numbers: Vec<u32> = inner.iter().map(|cavity| cavity.components[0]).collect();
    for (island, around) in islands.iter().zip(components.around(&points, control)?) {
        let enclosing = around.iter().filter_map(|number| numbers.binary_search(number).ok());
        // The smallest one, if they are nested: its bounds lie within those of the others.
        let size = |i: &usize| (0..3).map(|k| inner[*i].bounds[1][k] - inner[*i].bounds[0][k]).product::<f64>();
        if let Some(cavity) = enclosing.min_by(|a, b| size(a).total_cmp(&size(b))) {
            inner[cavity].add(island);
        }
    }
    for cavity in &mut inner {
        control.check()?;
        cavity.spheres.sort_unstable();
        cavity.spheres.dedup();
        cavity.components.sort_unstable();
    }
    Ok(inner)
}

/// Components of a mesh that enclose space outside the molecule.
pub struct InnerComponents {
    /// All components.
    pub(crate) components: Vec<Component>,
    /// Component of each vertex.
    pub of_vertex: Vec<u32>,
    /// Triangles of components with negative volume, by component.
    triangles: Vec<(u32, [u32; 3])>,
    /// Lowest and highest positions of these components, relative to the centre of the mesh, Å.
    bounds: Vec<[[f32; 3]; 2]>,
    _memory: Reservation,
}

impl InnerComponents {
    /// Finds the components of `mesh`.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub fn new(mesh: &mut Mesh, control: &Control<'_>) -> Result<Self, SurfaceError> {
        mesh.make_geometry_contiguous();
        let memory = control.reserve(8 * mesh.n_vertices() as u64)?;
        let (components, of_vertex) = components_of(mesh, control)?;
        let component = |triangle: &[u32; 3]| of_vertex[triangle[0] as usize];
        let is_inner = |triangle: &&[u32; 3]| components[component(triangle) as usize].volume < 0.0;
        memory.grow(16 * components.iter().filter(|c| c.volume < 0.0).map(|c| c.triangles).sum::<u64>())?;
        let mut triangles: Vec<_> = mesh.triangles.iter().filter(is_inner).map(|t| (component(t), *t)).collect();
        triangles.sort_by_key(|(component, _)| *component);
        let bounds = triangles.chunk_by(|a, b| a.0 == b.0).map(|of| bounds(mesh, of)).collect();
        Ok(Self { components, of_vertex, triangles, bounds, _memory: memory })
    }

    /// Returns the inner component of `mesh` that encloses `point`, Å.
    pub fn around(&self, mesh: &Mesh, point: [f64; 3]) -> Option<u32> {
        let within = |[low, high]: &[[f32; 3]; 2]| {
            (0..3).all(|k| (f64::from(low[k])..=f64::from(high[k])).contains(&(point[k] - mesh.centre[k])))
        };
        let near = self.triangles.chunk_by(|a, b| a.0 == b.0).zip(&self.bounds).filter(|(_, bounds)| within(bounds));
        let around = near.filter(|(of, _)| solid_angle(mesh, of, point).abs() > 2.0 * PI).map(|(of, _)| of[0].0);
        // The smallest one, if several enclose the point.
        around.max_by(|a, b| {
            let volume = |number: &u32| self.components[*number as usize].volume;
            volume(a).total_cmp(&volume(b))
        })
    }
}

/// Returns the lowest and highest positions of triangles, relative to the centre of the mesh, Å.
fn bounds(mesh: &Mesh, triangles: &[(u32, [u32; 3])]) -> [[f32; 3]; 2] {
    let corners = triangles.iter().flat_map(|(_, triangle)| *triangle).map(|v| mesh.position(v as usize));
    corners.fold([[f32::MAX; 3], [f32::MIN; 3]], |bounds, p| joined_bounds(bounds, [p; 2]))
}

/// Returns the solid angle of triangles seen from `point`, Å: ±4π within a closed surface, 0 outside (Van Oosterom and
/// Strackee 1983).
fn solid_angle(mesh: &Mesh, triangles: &[(u32, [u32; 3])], point: [f64; 3]) -> f64 {
    let from = sub(point, mesh.centre);
    let angle = |triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(|v| sub(mesh.position(v as usize).map(f64::from), from));
        let [la, lb, lc] = [a, b, c].map(length);
        2.0 * dot(a, cross(b, c)).atan2(la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb)
    };
    triangles.iter().map(|(_, triangle)| angle(triangle)).sum()
}

/// Cube of a search, with the spheres that can be nearest to one of its points.
struct Cube {
    centre: [f64; 3],
    half: f64,
    /// Upper bound of the distance of its points from the spheres.
    bound: f64,
    near: Vec<u32>,
}

impl PartialEq for Cube {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Cube {}

impl PartialOrd for Cube {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Cube {
    fn cmp(&self, other: &Self) -> Ordering {
        let key = |cube: &Self| [cube.centre[0], cube.centre[1], cube.centre[2]];
        let places = key(self).into_iter().zip(key(other)).map(|(a, b)| a.total_cmp(&b));
        self.bound.total_cmp(&other.bound).then_with(|| places.fold(Ordering::Equal, Ordering::then))
    }
}

/// Search for the point of a cavity that is farthest from the spheres, by branch and bound.
struct DepthSearch<'a> {
    components: &'a Components<'a>,
    atoms: &'a [LatticeAtom],
    shell: &'a Shell,
    cubes: BinaryHeap<Cube>,
    /// Distance and place of the deepest point so far, Å.
    best: Option<(f64, [f64; 3])>,
}

impl DepthSearch<'_> {
    /// Returns the distance that points must exceed, Å.
    fn depth(&self) -> f64 {
        self.best.map_or(0.0, |(depth, _)| depth)
    }

    /// Adds a cube unless no point in it can be deeper. The spheres `near` include the nearest one of each point.
    fn add(&mut self, centre: [f64; 3], half: f64, near: &[u32]) {
        let diagonal = half * 3.0_f64.sqrt();
        let distances = near.iter().map(|&i| (distance(&self.atoms[i as usize], centre), i));
        let distances: Vec<(f64, u32)> = distances.collect();
        let Some(&(depth, sphere)) = distances.iter().min_by(|a, b| a.0.total_cmp(&b.0)) else { return };
        if depth > 0.0 && (depth > self.depth() || diagonal <= depth) {
            let own = &self.atoms[sphere as usize];
            let component = self.components.at(sphere, unit(sub(centre, own.centre())));
            let inside = component.is_some_and(|component| self.shell.components.binary_search(&component).is_ok());
            if !inside && diagonal <= depth {
                // No sphere lies between the centre and any point of the cube.
                return;
            }
            if inside && depth > self.depth() {
                self.best = Some((depth, centre));
            }
        }
        let bound = depth + diagonal;
        if bound > self.depth() + RADIUS_ERROR {
            let near = distances.iter().filter(|(distance, _)| *distance <= depth + 2.0 * diagonal);
            self.cubes.push(Cube { centre, half, bound, near: near.map(|(_, i)| *i).collect() });
        }
    }

    /// Returns the distance and the point, Å; `None` if no point lies in the cavity.
    fn run(mut self, control: &Control<'_>) -> Result<Option<(f64, [f64; 3])>, SurfaceError> {
        let [low, high] = self.shell.bounds;
        let half = (0..3).map(|k| 0.5 * (high[k] - low[k])).fold(0.0, f64::max);
        let all: Vec<u32> = (0..).take(self.atoms.len()).collect();
        self.add(std::array::from_fn(|k| 0.5 * (low[k] + high[k])), half, &all);
        while let Some(Cube { centre, half, bound, near }) = self.cubes.pop() {
            control.check()?;
            if bound <= self.depth() + RADIUS_ERROR {
                break;
            }
            for corner in 0..8_u8 {
                let sign = |k: usize| if corner >> k & 1 == 0 { -0.5 } else { 0.5 };
                self.add(std::array::from_fn(|k| centre[k] + sign(k) * half), 0.5 * half, &near);
            }
        }
        Ok(self.best)
    }
}

/// Returns the distance of a point from a sphere, negative within it, Å.
fn distance(atom: &LatticeAtom, point: [f64; 3]) -> f64 {
    length(sub(point, atom.centre())) - f64::from(atom.inv_length2).sqrt().recip()
}

#[cfg(test)]
mod tests;
