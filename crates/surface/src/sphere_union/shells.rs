//! Connected components of the boundary with their measures, spheres and bounds.

use super::components::Components;
use super::exact::ComponentMeasures;
use super::radius;
use crate::control::Control;
use crate::error::SurfaceError;
use crate::lattice::to_u32;
use crate::params::SurfaceLimits;
use crate::vector::add;

/// Connected component of the boundary, or several that bound one region. Lengths are in Å.
#[derive(Debug, Clone)]
pub(crate) struct Shell {
    /// Numbers of the components, ascending.
    pub(crate) components: Vec<u32>,
    pub(crate) measures: ComponentMeasures,
    /// Numbers of the spheres with a face in it, ascending.
    pub(crate) spheres: Vec<u32>,
    /// Lowest and highest coordinates of its arcs, or of its sphere. A cavity lies within them: its faces bulge
    /// inwards.
    pub(crate) bounds: [[f64; 3]; 2],
    /// Point to test for its enclosing components: an end of an arc, or the centre of a sphere without arcs.
    pub(crate) point: [f64; 3],
}

impl Shell {
    /// Adds the components, measures and spheres of another shell. Sorts nothing and keeps the bounds.
    pub(crate) fn add(&mut self, other: &Self) {
        self.components.extend(&other.components);
        self.measures += other.measures;
        self.spheres.extend(&other.spheres);
    }

    /// Extends the bounds to a sphere.
    fn extend(&mut self, centre: [f64; 3], radius: f64) {
        let [low, high] = &mut self.bounds;
        for k in 0..3 {
            (low[k], high[k]) = (low[k].min(centre[k] - radius), high[k].max(centre[k] + radius));
        }
    }
}

impl Components<'_> {
    /// Returns all components with their measures, spheres and bounds. The atoms are on a lattice with a spacing of 1
    /// Å, and their radii include that of the `probe`, Å.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`], [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(crate) fn shells(
        &self,
        probe: f64,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Vec<Shell>, SurfaceError> {
        let shell = |(number, measures)| Shell {
            components: vec![number],
            measures,
            spheres: Vec::new(),
            bounds: [[f64::MAX; 3], [f64::MIN; 3]],
            point: [0.0; 3],
        };
        let mut shells: Vec<Shell> = (0..).zip(self.measure(probe, limits, control)?).map(shell).collect();
        for own in 0..to_u32(self.atoms.len()) {
            let mut sets: Vec<u32> = self.on(own).iter().map(|arc| self.of_arc[*arc as usize]).collect();
            sets.sort_unstable();
            sets.dedup();
            for set in sets {
                shells[set as usize].spheres.push(own);
            }
        }
        for (arc, set) in self.arcs.iter().zip(&self.of_arc) {
            let [from, to, _] = arc.points();
            // Bounding sphere: around the chord of an arc of up to half a circle, else around the whole circle.
            let (centre, reach) = match arc.half {
                [cos, sin] if cos > 0.0 => (add(from, to).map(|c| 0.5 * c), arc.radius * sin),
                _ => (arc.centre, arc.radius),
            };
            let atom = &self.atoms[arc.spheres[0] as usize];
            let shell = &mut shells[*set as usize];
            shell.point = add(atom.centre(), from);
            shell.extend(add(atom.centre(), centre), reach);
        }
        for (&sphere, number) in self.whole.iter().zip(self.first_whole()..) {
            let atom = &self.atoms[sphere as usize];
            let shell = &mut shells[number as usize];
            shell.spheres.push(sphere);
            shell.point = atom.centre();
            shell.extend(shell.point, radius(atom));
        }
        Ok(shells)
    }
}
