//! Concave parts of a solvent-excluded surface: the probe touches three or more spheres at a vertex.

use super::caps::{self, Cap, Cover, Neighbour, TOLERANCE, dot};
use super::components::unit;
use super::exact::{AreaParts, FaceSearch, Integrals, PartMeasures, Scratch};
use super::region::Region;
use crate::surface::candidates::Comparisons;
use crate::surface::error::SurfaceError;
use crate::surface::lattice::LatticeAtom;

/// End of an arc: a vertex of the boundary.
pub(super) struct ArcEnd {
    /// Probe at the vertex, on a lattice with a spacing of 1 Å.
    pub(super) probe: LatticeAtom,
    /// Unit vector along the arc, away from the vertex.
    pub(super) tangent: [f64; 3],
    /// Spheres that the probe touches on the arc.
    pub(super) spheres: [u32; 2],
    /// Component of the arc.
    pub(super) component: u32,
}

/// Vertices of the boundary. Each is represented by the ends of all arcs that meet there.
pub(super) struct Vertices<'a> {
    pub(super) ends: &'a [ArcEnd],
    /// Radius of the probe, Å.
    pub(super) probe: f64,
    pub(super) search: &'a FaceSearch<'a>,
}

impl Vertices<'_> {
    /// Adds to `part` the measures of the concave part at the vertex of end `own`, if it is the first end of the
    /// vertex.
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
        let is_same = |other: &Neighbour| dot(other.to, other.to) < TOLERANCE * TOLERANCE;
        if neighbours.iter().any(|other| other.index < own && is_same(other)) {
            return Ok(());
        }
        caps.clear();
        contacts.clear();
        let centre = self.search.centre(&self.ends[own as usize].probe);
        // The plane of each arc through the probe's centre bounds the part, which lies on the side away from the arc.
        // Fewer than three planes bound no polygon.
        for other in neighbours.iter().filter(|other| is_same(other)) {
            let end = &self.ends[other.index as usize];
            caps.push(Cap { axis: end.tangent, height: 0.0, index: other.index });
            for sphere in end.spheres {
                if contacts.iter().all(|(contact, _)| *contact != sphere) {
                    let to = self.search.centre(&self.search.atoms[sphere as usize]);
                    contacts.push((sphere, unit(std::array::from_fn(|k| to[k] - centre[k]))));
                }
            }
        }
        if caps.len() < 3 {
            return Ok(());
        }
        let component = self.ends[own as usize].component;
        neighbours.retain(|other| !is_same(other) && self.ends[other.index as usize].component == component);
        if caps::add_caps(own, self.probe, neighbours, caps) == Cover::Whole {
            return Ok(());
        }
        for (sphere, contact) in &*contacts {
            // Measures the points that are nearer to this point of contact than to any other.
            of_contact.clone_from(caps);
            for (other, direction) in &*contacts {
                let difference: [f64; 3] = std::array::from_fn(|k| direction[k] - contact[k]);
                if dot(difference, difference) > 0.0 {
                    of_contact.push(Cap { axis: unit(difference), height: 0.0, index: u32::MAX - other });
                }
            }
            if caps::prune(of_contact, -TOLERANCE / self.probe, comparisons)? == Cover::Whole {
                continue;
            }
            Region::outside(of_contact, 0, uncovered, comparisons, regions, |_, _| 0)?;
            for (_, Region { solid_angle, vector }) in &*regions {
                let area = self.probe * self.probe;
                let concave = area * solid_angle;
                part.of_spheres.push((*sphere, AreaParts { concave, ..AreaParts::default() }));
                // The outward normal points to the centre of the probe.
                let excluded = [concave, -area * (self.probe * solid_angle + dot(centre, *vector))];
                part.of_components.push((component, Integrals { excluded, ..Integrals::default() }));
            }
        }
        Ok(())
    }
}
