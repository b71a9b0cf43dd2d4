//! Boundary of a union of spheres: its faces, given by the caps that bound them, and its arcs.
//!
//! A face is the part of a sphere that lies in no other sphere. An arc is a part of the circle of two spheres that lies
//! in no third sphere; its ends are vertices of the boundary. Let x be a point inside the union. The boundary point
//! nearest to x lies in a face or on an arc, or is a vertex. If it lies in the face of sphere i, then i is the sphere
//! in which x lies deepest. So it is enough to test one point of that sphere for all faces.
//!
//! Lengths are in grid spacings. References: M. Connolly, J. Appl. Cryst. 16, 1983; C. Quan, B. Stamm, J. Comput.
//! Phys. 322, 2016.

mod caps;
mod cells;
mod circle;
mod components;
mod concave;
mod distance;
mod exact;
mod great_circle;
mod rays;
mod region;
mod shells;
#[cfg(test)]
mod tests;
mod torus;

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use self::caps::{Cap, Cover, Neighbour, TOLERANCE};
use self::cells::Cells;
pub(super) use self::cells::rounded;
use self::circle::{Exposed, Uncovered};
pub(super) use self::components::Components;
pub(super) use self::distance::{BrickUnion, Feature, Lanes, Nearest};
pub use self::exact::{AreaParts, ExactMeasures};
pub(super) use self::shells::Shell;
use super::candidates::{Comparisons, OverlapCount};
use super::control::{Control, Stage};
use super::error::SurfaceError;
use super::lattice::{LatticeAtom, to_f32, to_i32, to_u32};
use super::params::SurfaceLimits;
use super::vector::{cross, dot};

/// Exposed part of the circle of two spheres.
#[derive(Debug, Clone, Copy)]
pub struct Arc {
    /// Centre of the circle, relative to the cell of the arc's bounding sphere.
    centre: [f32; 3],
    /// Unit vector along the axis of the circle.
    axis: [f32; 3],
    /// Unit vector to the middle of the arc.
    middle: [f32; 3],
    /// Unit vector perpendicular to both.
    side: [f32; 3],
    radius: f32,
    /// Cosine and sine of the half-angle.
    half: [f32; 2],
}

impl Arc {
    /// Returns the arc in the layout of the shaders: centre and radius, axis and cosine, middle and sine, side.
    #[must_use]
    pub fn rows(&self) -> [[f32; 4]; 4] {
        let row = |[x, y, z]: [f32; 3], w| [x, y, z, w];
        let [cos, sin] = self.half;
        [row(self.centre, self.radius), row(self.axis, cos), row(self.middle, sin), row(self.side, 0.0)]
    }
}

/// Cells whose boundary is found by one task. Few lists are freed quickly.
const CELLS_PER_PART: usize = 32;
/// Parts between two reports of progress: about 2,000 atoms.
const PARTS_PER_REPORT: usize = 4;

/// Caps per group: one vector.
const GROUP: usize = 8;

/// Caps of a sphere, column by column: axis and height. Unused lanes cover nothing.
type CapGroup = [[f32; GROUP]; 4];

/// Boundary of a union of spheres.
#[derive(Debug, Clone, Default)]
pub struct SphereUnion {
    /// First group of caps of each sphere, and the one after its last; `None` if no part of the sphere is exposed.
    faces: Vec<Option<[u32; 2]>>,
    caps: Vec<CapGroup>,
    arcs: Vec<Arc>,
    /// Number of ordered pairs of overlapping spheres, including the pairs that stand for comparisons of caps.
    pub n_overlaps: u64,
}

/// Boundary of the spheres of some cells.
#[derive(Default)]
struct CellsBoundary {
    /// Exposed spheres, each with its number of groups of caps.
    faces: Vec<(u32, u32)>,
    caps: Vec<CapGroup>,
    arcs: Vec<Arc>,
    bounds: Vec<LatticeAtom>,
}

impl CellsBoundary {
    fn bytes(&self) -> usize {
        size_of_val(&*self.caps) + size_of_val(&*self.arcs) + size_of_val(&*self.bounds) + size_of_val(&*self.faces)
    }
}

/// Buffers that a thread reuses.
#[derive(Default)]
struct CapScratch {
    neighbours: Vec<Neighbour>,
    caps: Vec<Cap>,
    uncovered: Uncovered,
}

impl SphereUnion {
    /// Finds the boundary of the spheres of `atoms`, whose radius is the length scale. Also returns a bounding sphere
    /// of each arc, enlarged by `reach`.
    ///
    /// # Errors
    /// [`SurfaceError::Limit`] if more pairs of spheres overlap than candidate pairs are allowed;
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub(crate) fn new(
        atoms: &[LatticeAtom],
        spacing: f64,
        reach: f64,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<(Self, Vec<LatticeAtom>), SurfaceError> {
        let cells = Cells::new(atoms, control)?;
        let overlaps = OverlapCount::new(limits);
        let done = AtomicUsize::new(0);
        let tolerance = TOLERANCE / spacing;
        let n_parts = cells.len().div_ceil(CELLS_PER_PART);
        let part = |scratch: &mut CapScratch, number: usize| {
            let mut part = CellsBoundary::default();
            let mut comparisons = Comparisons::new(&overlaps, control);
            for cell in (number * CELLS_PER_PART..cells.len()).take(CELLS_PER_PART) {
                let around = cells.around(cell);
                for &own in cells.of(cell) {
                    control.check()?;
                    around.neighbours(own, &mut scratch.neighbours);
                    overlaps.add(scratch.neighbours.len() as u64)?;
                    let from = Sphere { atom: &atoms[own as usize], index: own, radius: radius(&atoms[own as usize]) };
                    let before = part.bytes();
                    from.boundary(scratch, tolerance, reach, &mut part, &mut comparisons)?;
                    // The capacity of a growing list is up to twice its length. The third part is its copy in the
                    // result.
                    control.memory.grow(3 * (part.bytes() - before) as u64)?;
                }
            }
            comparisons.count()?;
            let n = done.fetch_add(1, Ordering::Relaxed) + 1;
            if n.is_multiple_of(PARTS_PER_REPORT) {
                control.observer.progress(Stage::Bin, n, n_parts);
            }
            Ok(part)
        };
        let parts: Vec<CellsBoundary> =
            (0..n_parts).into_par_iter().map_init(CapScratch::default, part).collect::<Result<_, SurfaceError>>()?;
        control.memory.grow((size_of::<Option<[u32; 2]>>() * atoms.len()) as u64)?;
        let mut whole = Self { faces: vec![None; atoms.len()], n_overlaps: overlaps.total(), ..Self::default() };
        let mut bounds = Vec::with_capacity(parts.iter().map(|part| part.arcs.len()).sum());
        whole.arcs.reserve_exact(bounds.capacity());
        whole.caps.reserve_exact(parts.iter().map(|part| part.caps.len()).sum());
        let mut first = 0;
        for part in &parts {
            control.check()?;
            for &(sphere, groups) in &part.faces {
                whole.faces[sphere as usize] = Some([first, first + groups]);
                first += groups;
            }
            whole.caps.extend_from_slice(&part.caps);
            whole.arcs.extend_from_slice(&part.arcs);
            bounds.extend_from_slice(&part.bounds);
        }
        Ok((whole, bounds))
    }

    /// Returns arc `i`.
    #[must_use]
    pub fn arc(&self, i: u32) -> &Arc {
        &self.arcs[i as usize]
    }

    /// Returns the first group of caps of sphere `i`, and the one after its last; `None` if no part of the sphere is
    /// exposed.
    #[must_use]
    pub fn face(&self, i: usize) -> Option<[u32; 2]> {
        self.faces[i]
    }

    /// Returns the groups of caps as bytes: the columns of a group are axis x, y, z and height.
    #[must_use]
    pub fn cap_bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.caps)
    }

    /// Returns true if the point of sphere `i` in the direction `n`, a unit vector, lies in no other sphere.
    #[inline(always)]
    fn is_exposed(&self, i: u32, n: [f32; 3]) -> bool {
        let Some([first, end]) = self.faces[i as usize] else { return false };
        for [x, y, z, height] in &self.caps[first as usize..end as usize] {
            let mut covered = false;
            for k in 0..GROUP {
                covered |= n[0] * x[k] + n[1] * y[k] + n[2] * z[k] > height[k];
            }
            if covered {
                return false;
            }
        }
        true
    }
}

/// Returns the radius of an atom's sphere.
fn radius(atom: &LatticeAtom) -> f64 {
    f64::from(atom.inv_length2).sqrt().recip()
}

/// Sphere whose part of the boundary is computed.
struct Sphere<'a> {
    atom: &'a LatticeAtom,
    index: u32,
    radius: f64,
}

impl Sphere<'_> {
    /// Adds the face of this sphere, and its arcs with spheres of higher numbers.
    fn boundary(
        &self,
        scratch: &mut CapScratch,
        tolerance: f64,
        reach: f64,
        part: &mut CellsBoundary,
        comparisons: &mut Comparisons<'_>,
    ) -> Result<(), SurfaceError> {
        let CapScratch { neighbours, caps, uncovered } = scratch;
        if caps::caps(self.index, self.radius, neighbours, tolerance, caps, comparisons)? == Cover::Whole {
            return Ok(());
        }
        let before = part.arcs.len();
        // An arc is stored for the sphere with the lower number. Circles with spheres of lower numbers are only
        // searched until an exposed part proves that this sphere has a face.
        let mut exposed = caps.is_empty();
        for cap in caps.iter().filter(|cap| cap.index > self.index) {
            let circle = Circle::new(self.radius, cap);
            circle.uncover(cap, caps, tolerance / self.radius, uncovered, comparisons)?;
            uncovered.arcs(|arc| self.add_arc(&circle, &arc, reach, part));
        }
        exposed |= part.arcs.len() > before;
        for cap in caps.iter().filter(|cap| cap.index < self.index) {
            if exposed {
                break;
            }
            Circle::new(self.radius, cap).uncover(cap, caps, tolerance / self.radius, uncovered, comparisons)?;
            exposed = !uncovered.is_empty();
        }
        if exposed {
            part.faces.push((self.index, to_u32(caps.len().div_ceil(GROUP))));
            part.caps.extend(caps.chunks(GROUP).map(group));
        }
        Ok(())
    }

    fn add_arc(&self, circle: &Circle, arc: &Exposed, reach: f64, part: &mut CellsBoundary) {
        let along = |[x, y]: [f64; 2]| std::array::from_fn(|k| x * circle.first[k] + y * circle.second[k]);
        let [x, y] = arc.middle;
        let (middle, side): ([f64; 3], [f64; 3]) = (along([x, y]), along([-y, x]));
        let [cos, sin] = arc.half;
        // Bounding sphere: around the chord of an arc of up to half a circle, else around the whole circle.
        let (shift, bound) = if cos > 0.0 { (circle.radius * cos, circle.radius * sin) } else { (0.0, circle.radius) };
        let centre: [f64; 3] = std::array::from_fn(|k| circle.centre[k] + f64::from(self.atom.frac[k]));
        let of_bound: [f64; 3] = std::array::from_fn(|k| centre[k] + shift * middle[k]);
        // The brick of this grid point contains the centre, which lies within the sphere: devices have this brick.
        let cell = of_bound.map(|c| to_i32(c.floor()));
        part.bounds.push(LatticeAtom {
            cell: std::array::from_fn(|k| self.atom.cell[k] + cell[k]),
            inv_length2: to_f32((bound + reach).powi(-2)),
            frac: std::array::from_fn(|k| to_f32(of_bound[k] - f64::from(cell[k]))),
            source: self.atom.source,
        });
        part.arcs.push(Arc {
            centre: std::array::from_fn(|k| to_f32(centre[k] - f64::from(cell[k]))),
            axis: circle.axis.map(to_f32),
            middle: middle.map(to_f32),
            side: side.map(to_f32),
            radius: to_f32(circle.radius),
            half: arc.half.map(to_f32),
        });
    }
}

/// Edge of a cap, relative to the sphere's centre.
struct Circle {
    centre: [f64; 3],
    axis: [f64; 3],
    /// Unit vectors that span its plane.
    first: [f64; 3],
    second: [f64; 3],
    radius: f64,
    /// Its radius on the unit sphere.
    sin: f64,
}

impl Circle {
    fn new(radius: f64, cap: &Cap) -> Self {
        let [x, y, z] = cap.axis;
        // Perpendicular to the axis, and to the coordinate axis most inclined to it.
        let (vector, length2) = if x.abs() <= y.abs() && x.abs() <= z.abs() {
            ([0.0, -z, y], y * y + z * z)
        } else if y.abs() <= z.abs() {
            ([z, 0.0, -x], x * x + z * z)
        } else {
            ([-y, x, 0.0], x * x + y * y)
        };
        let first = vector.map(|c| c / length2.sqrt());
        let second = cross(cap.axis, first);
        let sin = (1.0 - cap.height * cap.height).max(0.0).sqrt();
        let centre = cap.axis.map(|c| c * cap.height * radius);
        Self { centre, axis: cap.axis, first, second, radius: radius * sin, sin }
    }

    /// Finds the parts of this circle, the edge of cap `own`, that no other cap covers.
    fn uncover(
        &self,
        own: &Cap,
        caps: &[Cap],
        tolerance: f64,
        uncovered: &mut Uncovered,
        comparisons: &mut Comparisons<'_>,
    ) -> Result<(), SurfaceError> {
        uncovered.reset();
        for cap in caps.iter().filter(|cap| cap.index != own.index) {
            comparisons.add(uncovered.len())?;
            let cos = dot(cap.axis, own.axis);
            let bound = cap.height + tolerance - own.height * cos;
            // No point of the circle lies within the cap.
            if bound >= 0.0 && bound * bound >= self.sin * self.sin * caps::sin2(cap.axis, own.axis, cos) {
                continue;
            }
            let toward = [dot(cap.axis, self.first), dot(cap.axis, self.second)].map(|c| c * self.sin);
            uncovered.cover(toward, bound, cap.index);
            if uncovered.is_empty() {
                break;
            }
        }
        Ok(())
    }
}

/// Packs up to [`GROUP`] caps.
fn group(caps: &[Cap]) -> CapGroup {
    let mut group = [[0.0; GROUP], [0.0; GROUP], [0.0; GROUP], [f32::INFINITY; GROUP]];
    for (k, cap) in caps.iter().enumerate() {
        for (column, value) in group.iter_mut().zip([cap.axis[0], cap.axis[1], cap.axis[2], cap.height]) {
            column[k] = to_f32(value);
        }
    }
    group
}
