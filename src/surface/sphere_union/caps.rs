//! Caps of a sphere: the parts of its surface that lie within other spheres.

/// Tolerance of all covering tests, Å: a cap covers only what lies this far inside it. Points where caps meet are then
/// exposed. That moves the surface at most by the tolerance, whereas losing such a point would move it farther.
pub(super) const TOLERANCE: f64 = 1e-6;

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

pub(super) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Fills `caps` with the caps on the sphere of number `own` that no other cap contains, largest first.
pub(super) fn caps(own: u32, radius: f64, neighbours: &[Neighbour], tolerance: f64, caps: &mut Vec<Cap>) -> Cover {
    caps.clear();
    for other in neighbours {
        let distance2 = dot(other.to, other.to);
        let (sum, difference) = (radius + other.radius, radius - other.radius);
        if other.index == own || distance2 >= sum * sum {
            continue;
        }
        if distance2 <= difference * difference {
            // One contains the other. Of equal spheres, the one with the lowest number remains.
            if difference < 0.0 || difference == 0.0 && other.index < own {
                return Cover::Whole;
            }
            continue;
        }
        let distance = distance2.sqrt();
        let height = (distance2 + sum * difference) / (2.0 * distance * radius);
        caps.push(Cap { axis: other.to.map(|c| c / distance), height, index: other.index });
    }
    caps.sort_unstable_by(|a, b| a.height.total_cmp(&b.height).then(a.index.cmp(&b.index)));
    let mut kept = 0;
    for i in 0..caps.len() {
        let cap = caps[i];
        match caps[..kept].iter().find(|larger| larger.covers_edge(&cap, tolerance / radius)) {
            None => {
                caps[kept] = cap;
                kept += 1;
            }
            // The smaller cap covers the rest of the sphere.
            Some(larger) if -dot(larger.axis, cap.axis) > cap.height => return Cover::Whole,
            Some(_) => {}
        }
    }
    caps.truncate(kept);
    Cover::Caps
}

impl Cap {
    /// Returns true if this cap, reduced by `tolerance`, contains the edge of another one.
    fn covers_edge(&self, other: &Self, tolerance: f64) -> bool {
        let cos = dot(self.axis, other.axis);
        // On the edge of the other cap, n·axis is at least height·cos − sin·sin.
        let over = other.height * cos - self.height - tolerance;
        over >= 0.0 && over * over >= (1.0 - other.height * other.height) * (1.0 - cos * cos)
    }
}
