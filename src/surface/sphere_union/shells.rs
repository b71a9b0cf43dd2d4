//! Connected components of the boundary with their measures, spheres and bounds.

use super::components::{Components, add};
use super::exact::ComponentMeasures;
use crate::surface::control::Control;
use crate::surface::error::SurfaceError;
use crate::surface::lattice::to_u32;
use crate::surface::params::SurfaceLimits;

/// Connected component of the boundary. Lengths are in Å.
#[derive(Debug, Clone)]
pub(in crate::surface) struct Shell {
    /// Number of the component.
    pub(in crate::surface) number: u32,
    pub(in crate::surface) measures: ComponentMeasures,
    /// Numbers of the spheres with a face in it, ascending.
    pub(in crate::surface) spheres: Vec<u32>,
    /// Lowest and highest coordinates of its arcs. A cavity lies within them: its faces bulge inwards.
    pub(in crate::surface) bounds: [[f64; 3]; 2],
}

impl Components<'_> {
    /// Returns all components with their measures, spheres and bounds. The atoms are on a lattice with a spacing of 1
    /// Å, and their radii include that of the `probe`, Å.
    ///
    /// # Errors
    /// [`SurfaceError::TooManyOverlaps`], [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(in crate::surface) fn shells(
        &self,
        probe: f64,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<Vec<Shell>, SurfaceError> {
        let shell = |(number, measures)| Shell {
            number,
            measures,
            spheres: Vec::new(),
            bounds: [[f64::MAX; 3], [f64::MIN; 3]],
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
            let [low, high] = &mut shells[*set as usize].bounds;
            for k in 0..3 {
                let c = self.atoms[arc.spheres[0] as usize].position(k) + centre[k];
                (low[k], high[k]) = (low[k].min(c - reach), high[k].max(c + reach));
            }
        }
        Ok(shells)
    }
}
