//! Concave parts of a solvent-excluded surface: the probe touches three or more spheres at a vertex.

use std::cmp::Ordering;

use super::caps::{self, Cap, Cover, Neighbour};
use super::cells::on_lattice;
use super::exact::{AreaParts, EQUAL_CAPS, FaceSearch, Integrals, PER_CHECK, PartMeasures, Scratch};
use super::region::Region;
use crate::candidates::Comparisons;
use crate::checked_sort;
use crate::error::SurfaceError;
use crate::lattice::{LatticeAtom, to_u32};
use crate::vector::{cross, dot, length, squared_distance, sub, unit};

/// Distance within which vertices coincide, Å. Where more than three spheres meet, rounding decides which triples
/// become vertices, and their polygons may overlap.
pub(super) const COINCIDENT: f64 = 1e-12;

/// Distance up to which probes at two vertices do not cut each other, Å: their polygons only touch, and the direction
/// between them is inaccurate.
const TOUCHING: f64 = 1e-8;

/// Probe that touches three spheres: a vertex of the boundary, at which arcs end.
#[derive(Debug, Clone, Copy)]
pub(super) struct Vertex {
    /// Cell of a sphere that the probe touches, and the centre of the probe relative to it, Å.
    cell: [i32; 3],
    at: [f64; 3],
    /// Spheres that the probe touches, counter-clockwise as seen from its centre, from the lowest number.
    spheres: [u32; 3],
    /// Component of the arcs.
    component: u32,
}

impl Vertex {
    /// Returns the vertex at `at`, relative to `cell`, where the probe touches `spheres`, counter-clockwise as seen
    /// from its centre.
    pub(super) fn new(cell: [i32; 3], at: [f64; 3], mut spheres: [u32; 3], component: u32) -> Self {
        let lowest = (0..3).min_by_key(|k| spheres[*k]).unwrap_or(0);
        spheres.rotate_left(lowest);
        Self { cell, at, spheres, component }
    }

    /// Returns the vector from the probe to the point `at`, relative to `cell`. Its rounding does not grow with the
    /// distance from the origin.
    fn to(&self, cell: [i32; 3], at: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|k| f64::from(cell[k] - self.cell[k]) + (at[k] - self.at[k]))
    }
}

/// All vertices of the boundary, each once.
pub(super) struct Vertices<'a> {
    all: Vec<Vertex>,
    /// Radius of the probe, Å.
    probe: f64,
    search: &'a FaceSearch<'a>,
}

impl<'a> Vertices<'a> {
    /// Joins the ends of arcs at which the probe touches the same spheres.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(super) fn new(mut ends: Vec<Vertex>, probe: f64, search: &'a FaceSearch<'a>) -> Result<Self, SurfaceError> {
        // The ends of a vertex differ by rounding: the same one must remain in every run.
        let order = |a: &Vertex, b: &Vertex| {
            let by_position = || (0..3).map(|k| a.at[k].total_cmp(&b.at[k])).fold(Ordering::Equal, Ordering::then);
            a.spheres.cmp(&b.spheres).then(a.cell.cmp(&b.cell)).then_with(by_position)
        };
        checked_sort::sort(&mut ends, order, search.control)?;
        ends.dedup_by_key(|end| end.spheres);
        Ok(Self { all: ends, probe, search })
    }

    /// Returns the probes at the vertices, on a lattice with a spacing of 1 Å.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(super) fn probes(&self) -> Result<Vec<LatticeAtom>, SurfaceError> {
        self.search.control.memory.grow((size_of::<LatticeAtom>() * self.all.len()) as u64)?;
        let mut probes = Vec::with_capacity(self.all.len());
        for vertices in self.all.chunks(PER_CHECK) {
            self.search.control.check()?;
            probes.extend(vertices.iter().zip(probes.len()..).map(|(Vertex { cell, at, .. }, i)| {
                on_lattice(std::array::from_fn(|k| f64::from(cell[k]) + at[k]), self.probe, i)
            }));
        }
        Ok(probes)
    }

    /// Adds to `part` the measures of the concave part at vertex `own`. Coincident vertices, directly or through
    /// others, share one concave part; the one with the lowest number adds it.
    ///
    /// # Errors
    /// Returns the errors of [`Comparisons::add`].
    pub(super) fn concave(
        &self,
        own: u32,
        Scratch { neighbours, caps, contacts, of_contact, uncovered, regions }: &mut Scratch,
        part: &mut PartMeasures,
        comparisons: &mut Comparisons<'_>,
    ) -> Result<(), SurfaceError> {
        let vertex = self.all[own as usize];
        let (component, [a, b, c]) = (vertex.component, vertex.spheres);
        // Cells hold rounded positions; these are the exact ones.
        for other in neighbours.iter_mut() {
            let Vertex { cell, at, .. } = self.all[other.index as usize];
            other.to = vertex.to(cell, at);
        }
        let Some(n_coincident) = coincident_vertices(own, neighbours, comparisons)? else { return Ok(()) };
        contacts.clear();
        for other in &neighbours[..n_coincident] {
            for sphere in self.all[other.index as usize].spheres {
                if contacts.iter().all(|(contact, _)| *contact != sphere) {
                    let LatticeAtom { cell, frac, .. } = self.search.atoms[sphere as usize];
                    contacts.push((sphere, unit(vertex.to(cell, frac.map(f64::from)))));
                }
            }
        }
        caps.clear();
        polygon(contacts, to_u32(self.all.len()), caps, comparisons)?;
        if caps.is_empty() {
            return Ok(());
        }
        for Neighbour { to, index, .. } in &neighbours[n_coincident..] {
            let other = &self.all[*index as usize];
            let distance = length(*to);
            let height = distance / (2.0 * self.probe);
            // The probe on the other side of the same spheres covers nearly the whole polygon.
            let touches = distance <= TOUCHING && other.spheres != [a, c, b];
            if other.component == component && height < 1.0 && !touches {
                caps.push(Cap { axis: to.map(|c| c / distance), height, index: *index });
            }
        }
        let at: [f64; 3] = std::array::from_fn(|k| f64::from(vertex.cell[k] - self.search.origin[k]) + vertex.at[k]);
        for (sphere, contact) in &*contacts {
            // Measures the points that are nearer to this point of contact than to any other.
            of_contact.clone_from(caps);
            for (other, direction) in &*contacts {
                let difference = sub(*direction, *contact);
                if dot(difference, difference) > 0.0 {
                    of_contact.push(Cap { axis: unit(difference), height: 0.0, index: u32::MAX - other });
                }
            }
            if caps::prune(of_contact, -EQUAL_CAPS / self.probe, comparisons)? == Cover::Whole {
                continue;
            }
            Region::outside(of_contact, 0, uncovered, comparisons, regions, |_, _| 0)?;
            for (_, Region { solid_angle, vector }) in &*regions {
                let area = self.probe * self.probe;
                let concave = area * solid_angle;
                part.of_spheres.push((*sphere, AreaParts { concave, ..AreaParts::default() }));
                // The outward normal points to the centre of the probe.
                let excluded = [concave, -area * (self.probe * solid_angle + dot(at, *vector))];
                part.of_components.push((component, Integrals { excluded, ..Integrals::default() }));
            }
        }
        Ok(())
    }
}

/// Moves the vertices that coincide with `own` to the front of its neighbours, and returns their number; `None` if one
/// of them has a lower number.
fn coincident_vertices(
    own: u32,
    neighbours: &mut [Neighbour],
    comparisons: &mut Comparisons<'_>,
) -> Result<Option<usize>, SurfaceError> {
    let (mut found, mut next) = (0, 0);
    if let Some(at) = neighbours.iter().position(|other| other.index == own) {
        neighbours.swap(0, at);
        found = 1;
    }
    while next < found {
        comparisons.add(neighbours.len())?;
        let (from, first) = (neighbours[next].to, found);
        for i in first..neighbours.len() {
            if squared_distance(neighbours[i].to, from) < COINCIDENT * COINCIDENT {
                if neighbours[i].index < own {
                    return Ok(None);
                }
                neighbours.swap(found, i);
                found += 1;
            }
        }
        next += 1;
    }
    Ok(Some(found))
}

/// Adds the hemispheres outside the spherical convex hull of the points of contact, numbered from `number`; none if the
/// points surround the centre of the probe.
fn polygon(
    contacts: &[(u32, [f64; 3])],
    number: u32,
    caps: &mut Vec<Cap>,
    comparisons: &mut Comparisons<'_>,
) -> Result<(), SurfaceError> {
    const ROUNDING: f64 = 10.0 * COINCIDENT;
    let outward = |a: [f64; 3], b: [f64; 3]| {
        let normal = cross(b, a);
        (length(normal) > 0.0).then(|| unit(normal))
    };
    let mut add = |axis| caps.push(Cap { axis, height: 0.0, index: number + to_u32(caps.len()) });
    if let [(_, a), (_, b), (_, c)] = *contacts {
        // The order of three points tells the side, even where they lie on one great circle up to rounding.
        [(a, b), (b, c), (c, a)].into_iter().filter_map(|(a, b)| outward(a, b)).for_each(add);
        return Ok(());
    }
    for (_, a) in contacts {
        for (_, b) in contacts {
            comparisons.add(contacts.len())?;
            let axis = outward(*a, *b);
            axis.filter(|axis| contacts.iter().all(|(_, c)| dot(*c, *axis) <= ROUNDING)).map(&mut add);
        }
    }
    Ok(())
}
