//! Exact areas and volumes of surfaces of spheres, in closed form from the exposed arcs.
//!
//! The contact part of a solvent-excluded surface on a sphere is the exposed part of the enlarged sphere, scaled to the
//! radius of the sphere. A toroidal part belongs to an arc, a concave part to a vertex. A concave part is the spherical
//! convex hull of the points of contact on the sphere of the probe, without the parts within the probe at other
//! vertices (Quan and Stamm, J. Comput. Phys. 322, 2016). A point of a toroidal or concave part counts for the sphere
//! whose point of contact with the probe is nearest.

use std::ops::AddAssign;

use rayon::prelude::*;

use super::caps::{self, Cap, Cover, Neighbour};
use super::cells::{Cells, on_lattice};
use super::circle::Uncovered;
use super::components::Components;
use super::concave::{COINCIDENT, Vertex, Vertices};
use super::region::{EdgeArc, Region};
use super::torus::ProbePath;
use super::{CELLS_PER_PART, radius};
use crate::candidates::{Comparisons, OverlapCount};
use crate::control::Control;
use crate::error::SurfaceError;
use crate::kernel::Shape;
use crate::lattice::{LatticeAtom, effective_radius, to_i32};
use crate::params::{SurfaceKind, SurfaceLimits, SurfaceParams, bad};
use crate::spheres::Spheres;
use crate::vector::{dot, sub};

/// Areas of the parts of a surface of spheres, Å².
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct AreaParts {
    /// Exposed part of a van der Waals or solvent-accessible surface; part of a solvent-excluded surface where the
    /// probe touches one sphere.
    pub contact: f64,
    /// Part of a solvent-excluded surface where the probe touches two spheres; 0 for other surfaces.
    pub toroidal: f64,
    /// Part of a solvent-excluded surface where the probe touches three or more spheres; 0 for other surfaces.
    pub concave: f64,
}

impl AreaParts {
    /// Returns the sum of all parts, Å².
    #[must_use]
    pub fn total(&self) -> f64 {
        self.contact + self.toroidal + self.concave
    }
}

impl AddAssign for AreaParts {
    fn add_assign(&mut self, other: Self) {
        self.contact += other.contact;
        self.toroidal += other.toroidal;
        self.concave += other.concave;
    }
}

/// Exact measures of a surface of spheres.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ExactMeasures {
    /// Areas of each sphere, in the order of the spheres.
    pub of_spheres: Vec<AreaParts>,
    /// Enclosed volume, Å³.
    pub volume: f64,
}

/// Exact measures of a component of the boundary, and of the solvent-excluded surface that the probe makes with its
/// centre on this component, without regard to probes on other components.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct ComponentMeasures {
    /// Area of the boundary, Å².
    pub(crate) accessible_area: f64,
    /// Volume that the boundary encloses, Å³; negative for a cavity.
    pub(crate) accessible_volume: f64,
    /// Area of the solvent-excluded surface, Å².
    pub(crate) area: f64,
    /// Volume that the solvent-excluded surface encloses, Å³; negative for a cavity.
    pub(crate) volume: f64,
}

impl AddAssign for ComponentMeasures {
    fn add_assign(&mut self, other: Self) {
        self.accessible_area += other.accessible_area;
        self.accessible_volume += other.accessible_volume;
        self.area += other.area;
        self.volume += other.volume;
    }
}

/// Tolerance within which a larger cap contains a smaller one, Å. Of caps that are equal up to rounding one remains,
/// because a common edge would bound the face twice.
pub(super) const EQUAL_CAPS: f64 = 1e-12;

/// Spheres that are converted between two checks of the cancellation flag.
pub(super) const PER_CHECK: usize = 1 << 14;

/// Measures of the spheres, or of the probes at vertices, of a run of cells.
#[derive(Default)]
pub(super) struct PartMeasures {
    /// Areas of spheres, by number. A sphere may have several entries.
    pub(super) of_spheres: Vec<(u32, AreaParts)>,
    /// Integrals of components, by number. A component may have several entries.
    pub(super) of_components: Vec<(u32, Integrals)>,
    /// Ends of arcs; a vertex occurs once per arc.
    pub(super) arc_ends: Vec<Vertex>,
}

impl PartMeasures {
    /// Returns the memory of all entries, bytes.
    fn bytes(&self) -> usize {
        size_of_val(&*self.of_spheres) + size_of_val(&*self.of_components) + size_of_val(&*self.arc_ends)
    }
}

/// Integrals over a surface: its area, Å², and the integral of x·n, Å³, where n is the outward normal at x. The latter
/// is three times the enclosed volume.
#[derive(Clone, Copy, Default)]
pub(super) struct Integrals {
    /// Those of the boundary of the spheres.
    pub(super) accessible: [f64; 2],
    /// Those of the solvent-excluded surface; without a probe, those of the boundary.
    pub(super) excluded: [f64; 2],
}

/// Buffers that a thread reuses.
#[derive(Default)]
pub(super) struct Scratch {
    pub(super) neighbours: Vec<Neighbour>,
    pub(super) caps: Vec<Cap>,
    /// Spheres that the probe touches at a vertex, and the directions of the points of contact.
    pub(super) contacts: Vec<(u32, [f64; 3])>,
    /// Caps outside which the points of a concave part are nearest to one point of contact.
    pub(super) of_contact: Vec<Cap>,
    pub(super) regions: Vec<(u32, Region)>,
    pub(super) uncovered: Uncovered,
}

/// Measurement of the exposed parts of spheres.
pub(super) struct FaceSearch<'a> {
    pub(super) atoms: &'a [LatticeAtom],
    /// Components of the boundary; `None` to measure it as one.
    pub(super) components: Option<&'a Components<'a>>,
    /// Radius of the probe of a solvent-excluded surface, Å.
    pub(super) probe: Option<f64>,
    /// Point to which the integrals of x·n refer.
    pub(super) origin: [i32; 3],
    pub(super) overlaps: OverlapCount,
    pub(super) control: &'a Control<'a>,
}

impl ExactMeasures {
    /// Measures the surface of `spheres`. The memory of the result remains charged to `control`.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`], [`SurfaceError::BadParameter`] for an isosurface or if scale and offset leave a radius
    /// that is too small, [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub fn of(
        spheres: &Spheres,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Self, SurfaceError> {
        let Shape::Sphere { enlarged } = Shape::new(params) else {
            return Err(bad("surface", format!("`{}`", params.surface), "vdw, sas or ses, which have exact areas"));
        };
        let Some([low, high]) = spheres.bounds() else { return Ok(Self::default()) };
        params.check_radius(spheres.radius_range().0)?;
        control.memory.grow((size_of::<AreaParts>() * spheres.len()) as u64)?;
        // All other memory is released at the end.
        let control = &control.metered();
        control.memory.grow((size_of::<LatticeAtom>() * spheres.len()) as u64)?;
        let mut atoms = Vec::with_capacity(spheres.len());
        for i in 0..spheres.len() {
            control.check_every(i, PER_CHECK)?;
            let length = effective_radius(spheres.radius(i), params) + enlarged;
            atoms.push(on_lattice(spheres.centre(i), length, i));
        }
        let search = FaceSearch {
            atoms: &atoms,
            components: None,
            probe: (params.surface == SurfaceKind::Ses && enlarged > 0.0).then_some(enlarged),
            origin: std::array::from_fn(|k| to_i32((0.5 * (low[k] + high[k])).round())),
            overlaps: OverlapCount::new(limits),
            control,
        };
        let (of_spheres, of_components) = search.run()?;
        Ok(Self { of_spheres, volume: of_components[0].excluded[1] / 3.0 })
    }

    /// Returns the areas of the parts of the whole surface.
    #[must_use]
    pub fn parts(&self) -> AreaParts {
        let mut sum = AreaParts::default();
        self.of_spheres.iter().for_each(|parts| sum += *parts);
        sum
    }

    /// Returns the area of the whole surface, Å².
    #[must_use]
    pub fn area(&self) -> f64 {
        self.parts().total()
    }
}

impl Components<'_> {
    /// Measures all components, whose atoms are on a lattice with a spacing of 1 Å and have radii that include `probe`.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`], [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(super) fn measure(
        &self,
        probe: f64,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Vec<ComponentMeasures>, SurfaceError> {
        let control = &control.metered();
        control.memory.grow((size_of::<AreaParts>() * self.atoms.len()) as u64)?;
        let search = FaceSearch {
            atoms: self.atoms,
            components: Some(self),
            probe: Some(probe).filter(|probe| *probe > 0.0),
            origin: self.atoms.first().map_or([0; 3], |atom| atom.cell),
            overlaps: OverlapCount::new(limits),
            control,
        };
        let measures = |Integrals { accessible, excluded }| ComponentMeasures {
            accessible_area: accessible[0],
            accessible_volume: accessible[1] / 3.0,
            area: excluded[0],
            volume: excluded[1] / 3.0,
        };
        Ok(search.run()?.1.into_iter().map(measures).collect())
    }
}

impl FaceSearch<'_> {
    /// Returns the areas of each sphere and the integrals of each component.
    fn run(&self) -> Result<(Vec<AreaParts>, Vec<Integrals>), SurfaceError> {
        let mut areas = vec![AreaParts::default(); self.atoms.len()];
        let mut integrals = vec![Integrals::default(); self.components.map_or(1, |components| components.n as usize)];
        let mut add = |part: &PartMeasures| {
            part.of_spheres.iter().for_each(|(sphere, parts)| areas[*sphere as usize] += *parts);
            for (component, part) in &part.of_components {
                let sum = &mut integrals[*component as usize];
                for k in 0..2 {
                    sum.accessible[k] += part.accessible[k];
                    sum.excluded[k] += part.excluded[k];
                }
            }
        };
        let mut arc_ends = Vec::new();
        let cells = Cells::new(self.atoms, self.control)?;
        for part in self.each(&cells, |own, scratch, part, comparisons| self.face(own, scratch, part, comparisons))? {
            add(&part);
            arc_ends.extend(part.arc_ends);
        }
        if let Some(probe) = self.probe.filter(|_| !arc_ends.is_empty()) {
            let vertices = Vertices::new(arc_ends, probe, self)?;
            let probes = vertices.probes()?;
            let cells = Cells::new(&probes, self.control)?;
            let concave = |own, scratch: &mut Scratch, part: &mut PartMeasures, comparisons: &mut Comparisons<'_>| {
                vertices.concave(own, scratch, part, comparisons)
            };
            self.each(&cells, concave)?.iter().for_each(add);
        }
        Ok((areas, integrals))
    }

    /// Calls `measure` for each sphere with its neighbours, in parallel by groups of cells. Returns the results in the
    /// order of the cells.
    fn each(
        &self,
        cells: &Cells<'_>,
        measure: impl Fn(u32, &mut Scratch, &mut PartMeasures, &mut Comparisons<'_>) -> Result<(), SurfaceError> + Sync,
    ) -> Result<Vec<PartMeasures>, SurfaceError> {
        let part = |scratch: &mut Scratch, number: usize| {
            let mut part = PartMeasures::default();
            let mut comparisons = Comparisons::new(&self.overlaps, self.control);
            for cell in (number * CELLS_PER_PART..cells.len()).take(CELLS_PER_PART) {
                let around = cells.around(cell);
                for &own in cells.of(cell) {
                    self.control.check()?;
                    let before = part.bytes();
                    around.neighbours(own, &mut scratch.neighbours);
                    self.overlaps.add(scratch.neighbours.len() as u64)?;
                    measure(own, scratch, &mut part, &mut comparisons)?;
                    // The capacity of a growing list is up to twice its length. The third part is its copy.
                    self.control.memory.grow(3 * (part.bytes() - before) as u64)?;
                }
            }
            comparisons.count()?;
            Ok(part)
        };
        (0..cells.len().div_ceil(CELLS_PER_PART)).into_par_iter().map_init(Scratch::default, part).collect()
    }

    /// Returns the centre of a sphere relative to the origin.
    pub(super) fn centre(&self, atom: &LatticeAtom) -> [f64; 3] {
        std::array::from_fn(|k| f64::from(atom.cell[k] - self.origin[k]) + f64::from(atom.frac[k]))
    }

    /// Returns the component of an exposed arc of the edge of a cap on sphere `own`.
    fn component(&self, own: u32, cap: &Cap, arc: &EdgeArc) -> u32 {
        let Some(components) = self.components else { return 0 };
        let sin = (1.0 - cap.height * cap.height).max(0.0).sqrt();
        components.nearest(own, std::array::from_fn(|k| cap.height * cap.axis[k] + sin * arc.middle[k]))
    }

    /// Measures the faces of sphere `own`, and the toroidal parts between it and spheres with higher numbers.
    fn face(
        &self,
        own: u32,
        Scratch { neighbours, caps, uncovered, regions, .. }: &mut Scratch,
        part: &mut PartMeasures,
        comparisons: &mut Comparisons<'_>,
    ) -> Result<(), SurfaceError> {
        let length = radius(&self.atoms[own as usize]);
        let Some(first) = self.components.map_or(Some(0), |components| components.first(own)) else { return Ok(()) };
        if caps::caps(own, length, neighbours, -EQUAL_CAPS, caps, comparisons)? == Cover::Whole {
            return Ok(());
        }
        Region::outside(caps, first, uncovered, comparisons, regions, |cap, arc| {
            let component = self.component(own, cap, arc);
            if let Some(probe) = self.probe.filter(|_| cap.index > own) {
                self.toroidal([own, cap.index], component, probe, cap, arc, part);
            }
            component
        })?;
        let centre = self.centre(&self.atoms[own as usize]);
        let contact = length - self.probe.unwrap_or_default();
        for (component, Region { solid_angle, vector }) in &*regions {
            let [accessible, excluded] = [length, contact].map(|r| {
                let area = r * r;
                [area * solid_angle, area * (r * solid_angle + dot(centre, *vector))]
            });
            part.of_spheres.push((own, AreaParts { contact: excluded[0], ..AreaParts::default() }));
            part.of_components.push((*component, Integrals { accessible, excluded }));
        }
        Ok(())
    }

    /// Adds to `part` the toroidal part of an arc, and the ends of the arc. The arc lies on the edge of `cap`, which
    /// the second of the `spheres` covers on the first one.
    fn toroidal(
        &self,
        spheres: [u32; 2],
        component: u32,
        probe: f64,
        cap: &Cap,
        arc: &EdgeArc,
        part: &mut PartMeasures,
    ) {
        let [first, second] = spheres.map(|sphere| &self.atoms[sphere as usize]);
        let (length, centre, other) = (radius(first), self.centre(first), self.centre(second));
        let to_plane = length * cap.height;
        let edge = length * (1.0 - cap.height * cap.height).max(0.0).sqrt();
        let distance = dot(cap.axis, sub(other, centre));
        let middle: [f64; 3] = std::array::from_fn(|k| centre[k] + to_plane * cap.axis[k]);
        let offsets = [to_plane, distance - to_plane];
        let path = ProbePath { arc, axis: cap.axis, centre: middle, radius: edge, offsets, probe };
        let (areas, flux) = path.measure();
        for (sphere, toroidal) in spheres.into_iter().zip(areas) {
            part.of_spheres.push((sphere, AreaParts { toroidal, ..AreaParts::default() }));
        }
        let excluded = [areas[0] + areas[1], flux];
        part.of_components.push((component, Integrals { excluded, ..Integrals::default() }));
        let Some([before, after]) = arc.end_caps else { return };
        // Both ends of an arc this short are one vertex; longer arcs end there as well.
        if 2.0 * edge * arc.half_angle < COINCIDENT {
            return;
        }
        let [cos, sin] = arc.half;
        let middle: [f64; 3] = std::array::from_fn(|k| f64::from(first.frac[k]) + to_plane * cap.axis[k]);
        // At the start of the arc, the spheres are clockwise as seen from the probe, so they change places.
        for (side, spheres) in [(-1.0, [spheres[1], spheres[0], before]), (1.0, [spheres[0], spheres[1], after])] {
            let at = std::array::from_fn(|k| middle[k] + edge * (cos * arc.middle[k] + side * sin * arc.along[k]));
            part.arc_ends.push(Vertex::new(first.cell, at, spheres, component));
        }
    }
}
