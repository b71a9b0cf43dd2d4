//! Exact areas and volumes of surfaces of spheres, in closed form from the exposed arcs.
//!
//! The contact part of a solvent-excluded surface on a sphere is the exposed part of the enlarged sphere, scaled to the
//! radius of the sphere. A toroidal part belongs to an arc, a concave part to a vertex. A concave part is the polygon
//! that the planes of the vertex's arcs bound on the sphere of the probe, without the parts within the probe at other
//! vertices (Quan and Stamm, J. Comput. Phys. 322, 2016).

use std::sync::Arc;

use rayon::prelude::*;

use super::caps::{self, Cap, Cover, Neighbour, TOLERANCE, dot};
use super::cells::Cells;
use super::circle::Uncovered;
use super::region::{EdgeArc, Region};
use super::torus::ProbePath;
use super::{CELLS_PER_PART, radius};
use crate::surface::candidates::{Comparisons, OverlapCount};
use crate::surface::control::Control;
use crate::surface::error::SurfaceError;
use crate::surface::kernel::Shape;
use crate::surface::lattice::{LatticeAtom, effective_radius, to_f32, to_i32, to_u32};
use crate::surface::memory::Reservation;
use crate::surface::params::{SurfaceKind, SurfaceLimits, SurfaceParams, bad};
use crate::surface::spheres::Spheres;

/// Exact measures of a surface of spheres.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ExactMeasures {
    /// Area of the part of the surface on each sphere, Å², in the order of the spheres: the exposed part of a van der
    /// Waals or solvent-accessible surface, the contact part of a solvent-excluded one.
    pub of_spheres: Vec<f64>,
    /// Area of the toroidal parts of a solvent-excluded surface, Å²; 0 for other surfaces.
    pub toroidal: f64,
    /// Area of the concave parts of a solvent-excluded surface, Å²; 0 for other surfaces.
    pub concave: f64,
    /// Enclosed volume, Å³.
    pub volume: f64,
}

/// Spheres that are converted between two checks of the cancellation flag.
const PER_CHECK: usize = 1 << 14;

/// End of an arc: a vertex of the boundary.
struct ArcEnd {
    /// Sphere of the probe at the vertex, in Å.
    probe: LatticeAtom,
    /// Unit vector along the arc, away from the vertex.
    tangent: [f64; 3],
}

/// Measures of the spheres, or of the vertices, of some cells.
#[derive(Default)]
struct PartMeasures {
    /// Area of each sphere, by number.
    of_spheres: Vec<(u32, f64)>,
    toroidal: f64,
    concave: f64,
    /// Integral of x·n over the surface, Å³: three times the volume.
    flux: f64,
    ends: Vec<ArcEnd>,
}

/// Buffers that a thread reuses.
#[derive(Default)]
struct Scratch {
    neighbours: Vec<Neighbour>,
    caps: Vec<Cap>,
    uncovered: Uncovered,
}

/// Search for the exposed parts of spheres.
struct FaceSearch<'a> {
    atoms: &'a [LatticeAtom],
    /// Radius of the probe of a solvent-excluded surface, Å.
    probe: Option<f64>,
    /// Point to which the integrals of x·n refer.
    origin: [i32; 3],
    overlaps: OverlapCount,
    control: &'a Control<'a>,
}

impl ExactMeasures {
    /// Measures the surface of `spheres`. The memory of the result remains charged to `control`.
    ///
    /// # Errors
    /// [`SurfaceError::TooManyOverlaps`], [`SurfaceError::BadParameter`] for an isosurface or if scale and offset leave
    /// a radius that is too small, [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
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
        control.memory.grow((size_of::<f64>() * spheres.len()) as u64)?;
        // All other memory is released at the end.
        let memory = Arc::new(Reservation::new(&control.memory));
        let control = &Control { memory, ..control.clone() };
        control.memory.grow(((size_of::<LatticeAtom>() + size_of::<(u32, f64)>()) * spheres.len()) as u64)?;
        let mut atoms = Vec::with_capacity(spheres.len());
        for i in 0..spheres.len() {
            if i.is_multiple_of(PER_CHECK) {
                control.check()?;
            }
            let length = effective_radius(spheres.radius(i), params) + enlarged;
            atoms.push(on_lattice(spheres.centre(i), length, i));
        }
        let search = FaceSearch {
            atoms: &atoms,
            probe: (params.surface == SurfaceKind::Ses && enlarged > 0.0).then_some(enlarged),
            origin: std::array::from_fn(|k| to_i32((0.5 * (low[k] + high[k])).round())),
            overlaps: OverlapCount::new(limits),
            control,
        };
        search.run()
    }

    /// Returns the area of the whole surface, Å².
    #[must_use]
    pub fn area(&self) -> f64 {
        self.of_spheres.iter().sum::<f64>() + self.toroidal + self.concave
    }
}

/// Places a sphere on the lattice with a spacing of 1 Å.
fn on_lattice(centre: [f64; 3], radius: f64, number: usize) -> LatticeAtom {
    let cell = centre.map(f64::round);
    LatticeAtom {
        cell: cell.map(to_i32),
        inv_length2: to_f32(radius.powi(-2)),
        frac: std::array::from_fn(|k| to_f32(centre[k] - cell[k])),
        source: to_u32(number),
    }
}

impl FaceSearch<'_> {
    fn run(&self) -> Result<ExactMeasures, SurfaceError> {
        let mut measures = ExactMeasures { of_spheres: vec![0.0; self.atoms.len()], ..ExactMeasures::default() };
        let mut flux = 0.0;
        let mut ends = Vec::new();
        let cells = Cells::new(self.atoms, self.control)?;
        let faces = self.each(&cells, |own, scratch, part, comparisons| self.face(own, scratch, part, comparisons))?;
        for part in faces {
            part.of_spheres.iter().for_each(|&(sphere, area)| measures.of_spheres[sphere as usize] = area);
            measures.toroidal += part.toroidal;
            flux += part.flux;
            ends.extend(part.ends);
        }
        if let Some(probe) = self.probe.filter(|_| !ends.is_empty()) {
            self.control.memory.grow((size_of::<LatticeAtom>() * ends.len()) as u64)?;
            let probes: Vec<LatticeAtom> = ends.iter().map(|end| end.probe).collect();
            let vertices = Vertices { ends: &ends, probe, search: self };
            let cells = Cells::new(&probes, self.control)?;
            let concave = |own, scratch: &mut Scratch, part: &mut PartMeasures, comparisons: &mut Comparisons<'_>| {
                vertices.concave(own, scratch, part, comparisons)
            };
            for part in self.each(&cells, concave)? {
                measures.concave += part.concave;
                flux += part.flux;
            }
        }
        measures.volume = flux / 3.0;
        Ok(measures)
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
                    let before = part.ends.len();
                    around.neighbours(own, &mut scratch.neighbours);
                    self.overlaps.add(scratch.neighbours.len() as u64)?;
                    measure(own, scratch, &mut part, &mut comparisons)?;
                    // The capacity of a growing list is up to twice its length. The third part is its copy.
                    self.control.memory.grow((3 * size_of::<ArcEnd>() * (part.ends.len() - before)) as u64)?;
                }
            }
            comparisons.count()?;
            Ok(part)
        };
        (0..cells.len().div_ceil(CELLS_PER_PART)).into_par_iter().map_init(Scratch::default, part).collect()
    }

    /// Returns the centre of a sphere relative to the origin.
    fn centre(&self, atom: &LatticeAtom) -> [f64; 3] {
        std::array::from_fn(|k| f64::from(atom.cell[k] - self.origin[k]) + f64::from(atom.frac[k]))
    }

    /// Measures the face of sphere `own`, and the toroidal parts between it and spheres with higher numbers.
    fn face(
        &self,
        own: u32,
        Scratch { neighbours, caps, uncovered }: &mut Scratch,
        part: &mut PartMeasures,
        comparisons: &mut Comparisons<'_>,
    ) -> Result<(), SurfaceError> {
        let atom = &self.atoms[own as usize];
        let length = radius(atom);
        // Equal edges must not bound the face twice: of caps that differ by less than the tolerance, one remains.
        if caps::caps(own, length, neighbours, -TOLERANCE, caps, comparisons)? == Cover::Whole {
            return Ok(());
        }
        let centre = self.centre(atom);
        let region = Region::outside(caps, uncovered, comparisons, |cap, arc| {
            if let Some(probe) = self.probe.filter(|_| cap.index > own) {
                self.toroidal(centre, length, probe, cap, arc, part);
            }
        })?;
        let contact = length - self.probe.unwrap_or_default();
        part.of_spheres.push((atom.source, contact * contact * region.solid_angle));
        part.flux += contact * contact * (contact * region.solid_angle + dot(centre, region.vector));
        Ok(())
    }

    /// Adds the toroidal part of an arc, and the ends of the arc. The arc is part of the edge of a cap on the sphere
    /// around `centre` with the radius `length`.
    fn toroidal(&self, centre: [f64; 3], length: f64, probe: f64, cap: &Cap, arc: &EdgeArc, part: &mut PartMeasures) {
        let to_plane = length * cap.height;
        let edge = length * (1.0 - cap.height * cap.height).max(0.0).sqrt();
        let other = self.centre(&self.atoms[cap.index as usize]);
        let distance = dot(cap.axis, std::array::from_fn(|k| other[k] - centre[k]));
        let middle: [f64; 3] = std::array::from_fn(|k| centre[k] + to_plane * cap.axis[k]);
        let offsets = [to_plane, distance - to_plane];
        let path = ProbePath { arc, axis: cap.axis, centre: middle, radius: edge, offsets, probe };
        let [area, flux] = path.measure();
        part.toroidal += area;
        part.flux += flux;
        // The ends of a very short arc are one vertex, and its planes cancel each other.
        if arc.is_circle() || 2.0 * edge * arc.half_angle < TOLERANCE {
            return;
        }
        let [cos, sin] = arc.half;
        for side in [1.0, -1.0] {
            let at = std::array::from_fn(|k| {
                middle[k] + f64::from(self.origin[k]) + edge * (cos * arc.middle[k] - side * sin * arc.along[k])
            });
            let tangent = std::array::from_fn(|k| sin * arc.middle[k] + side * cos * arc.along[k]);
            part.ends.push(ArcEnd { probe: on_lattice(at, probe, part.ends.len()), tangent });
        }
    }
}

/// Vertices of the boundary, each as the ends of its arcs.
struct Vertices<'a> {
    ends: &'a [ArcEnd],
    /// Radius of the probe, Å.
    probe: f64,
    search: &'a FaceSearch<'a>,
}

impl Vertices<'_> {
    /// Measures the concave part of a vertex if `own` is the first of its ends.
    fn concave(
        &self,
        own: u32,
        Scratch { neighbours, caps, uncovered }: &mut Scratch,
        part: &mut PartMeasures,
        comparisons: &mut Comparisons<'_>,
    ) -> Result<(), SurfaceError> {
        let is_same = |other: &Neighbour| dot(other.to, other.to) < TOLERANCE * TOLERANCE;
        if neighbours.iter().any(|other| other.index < own && is_same(other)) {
            return Ok(());
        }
        caps.clear();
        // The part lies on the other side of the plane of each arc. Fewer than three planes bound no polygon.
        let planes = neighbours.iter().filter(|other| is_same(other));
        caps.extend(planes.map(|end| Cap {
            axis: self.ends[end.index as usize].tangent,
            height: 0.0,
            index: end.index,
        }));
        if caps.len() < 3 {
            return Ok(());
        }
        neighbours.retain(|other| !is_same(other));
        let covered = caps::add_caps(own, self.probe, neighbours, caps) == Cover::Whole
            || caps::prune(caps, -TOLERANCE / self.probe, comparisons)? == Cover::Whole;
        if covered {
            return Ok(());
        }
        let Region { solid_angle, vector } = Region::outside(caps, uncovered, comparisons, |_, _| {})?;
        let centre = self.search.centre(&self.ends[own as usize].probe);
        let area = self.probe * self.probe;
        part.concave += area * solid_angle;
        // The outward normal points to the centre of the probe.
        part.flux -= area * (self.probe * solid_angle + dot(centre, vector));
        Ok(())
    }
}
