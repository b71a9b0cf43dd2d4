//! Caps of a sphere: the parts of its surface that lie within other spheres.

use crate::candidates::Comparisons;
use crate::error::SurfaceError;
use crate::vector::{cross, dot};

/// Tolerance of the covering tests for meshes and components, Å: a cap covers only points that lie farther than this
/// inside it. Points at which caps meet are then exposed, which moves the surface by the tolerance at most. Without
/// such a point, the surface would move farther.
pub(super) const TOLERANCE: f64 = 1e-6;

/// Caps that are sorted without a check of the cancellation flag: a few milliseconds.
const SORTED_AT_ONCE: usize = 1 << 15;

/// Sphere relative to the centre of another one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Neighbour {
    pub(super) to: [f64; 3],
    pub(super) radius: f64,
    /// Number of the sphere.
    pub(super) index: u32,
}

/// Cap on the unit sphere: the directions n with n·`axis` > `height`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cap {
    /// Unit vector to the other sphere's centre.
    pub(super) axis: [f64; 3],
    /// Cosine of the cap's half-angle.
    pub(super) height: f64,
    /// Number of the other sphere.
    pub(super) index: u32,
}

/// Extent of the caps of a sphere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cover {
    /// One other sphere contains the whole sphere.
    Whole,
    /// The listed caps cover a part of the sphere, or together all of it.
    Caps,
}

/// Returns the squared sine of the angle between two unit vectors, whose product is `cos`.
pub(super) fn sin2(a: [f64; 3], b: [f64; 3], cos: f64) -> f64 {
    // The difference loses all digits for vectors that are nearly parallel.
    if cos.abs() < 0.999 {
        return 1.0 - cos * cos;
    }
    let normal = cross(a, b);
    dot(normal, normal)
}

/// Fills `caps` with the caps on the sphere of number `own` that no other cap contains, largest first.
///
/// # Errors
/// Returns the errors of [`Comparisons::add`].
pub(super) fn caps(
    own: u32,
    radius: f64,
    neighbours: &[Neighbour],
    tolerance: f64,
    caps: &mut Vec<Cap>,
    comparisons: &mut Comparisons<'_>,
) -> Result<Cover, SurfaceError> {
    caps.clear();
    match add_caps(own, radius, neighbours, caps) {
        Cover::Whole => Ok(Cover::Whole),
        Cover::Caps => prune(caps, tolerance / radius, comparisons),
    }
}

/// Adds the caps of all `neighbours` on the sphere of number `own`.
fn add_caps(own: u32, radius: f64, neighbours: &[Neighbour], caps: &mut Vec<Cap>) -> Cover {
    for other in neighbours {
        let distance2 = dot(other.to, other.to);
        let (sum, difference) = (radius + other.radius, radius - other.radius);
        if other.index == own || distance2 >= sum * sum {
            continue;
        }
        if distance2 <= difference * difference {
            // One sphere contains the other. Of equal spheres, the one with the lowest number remains.
            if difference < 0.0 || difference == 0.0 && other.index < own {
                return Cover::Whole;
            }
            continue;
        }
        let distance = distance2.sqrt();
        let height = (distance2 + sum * difference) / (2.0 * distance * radius);
        caps.push(Cap { axis: other.to.map(|c| c / distance), height, index: other.index });
    }
    Cover::Caps
}

/// Removes each cap that a larger one contains, and sorts the others, largest first. `tolerance` reduces the larger
/// cap; a negative one enlarges it.
///
/// # Errors
/// Returns the errors of [`Comparisons::add`].
pub(super) fn prune(
    caps: &mut Vec<Cap>,
    tolerance: f64,
    comparisons: &mut Comparisons<'_>,
) -> Result<Cover, SurfaceError> {
    sort(caps, comparisons)?;
    let mut kept = 0;
    for i in 0..caps.len() {
        let cap = caps[i];
        comparisons.add(kept)?;
        match caps[..kept].iter().find(|larger| larger.covers_edge(&cap, tolerance)) {
            None => {
                caps[kept] = cap;
                kept += 1;
            }
            // The smaller cap covers the rest of the sphere.
            Some(larger) if -dot(larger.axis, cap.axis) > cap.height => return Ok(Cover::Whole),
            Some(_) => {}
        }
    }
    caps.truncate(kept);
    Ok(Cover::Caps)
}

/// Sorts caps by height and number. Halves a long list first, with a check of the cancellation flag at each half.
fn sort(caps: &mut [Cap], comparisons: &mut Comparisons<'_>) -> Result<(), SurfaceError> {
    let order = |a: &Cap, b: &Cap| a.height.total_cmp(&b.height).then(a.index.cmp(&b.index));
    if caps.len() <= SORTED_AT_ONCE {
        caps.sort_unstable_by(order);
        return Ok(());
    }
    comparisons.count()?;
    let (lower, _, upper) = caps.select_nth_unstable_by(caps.len() / 2, order);
    sort(lower, comparisons)?;
    sort(upper, comparisons)
}

impl Cap {
    /// Returns true if this cap, reduced by `tolerance`, contains the edge of another cap.
    fn covers_edge(&self, other: &Self, tolerance: f64) -> bool {
        let cos = dot(self.axis, other.axis);
        // On the edge of the other cap, n·axis is at least height·cos − sin·sin.
        let over = other.height * cos - self.height - tolerance;
        over >= 0.0 && over * over >= (1.0 - other.height * other.height) * sin2(self.axis, other.axis, cos)
    }
}
