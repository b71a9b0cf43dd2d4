//! How the grid's spacing is chosen: it is given, or follows from a level of detail, or from how many triangles there may be.

use crate::surface::SurfaceParams;

/// The finest spacing that is chosen for somebody, Å: finer ones show how spheres are blended, nothing of a molecule. Whoever
/// names a spacing may go below.
pub const FINEST: f64 = 0.25;
/// The coarsest spacing that is chosen for somebody, Å: beyond it atoms fall through the grid.
pub const COARSEST: f64 = 4.0;
/// Spacings by level of detail, Å: each has about twice the triangles of the one before.
pub const DETAILS: [f64; 7] = [2.0, 1.4, 1.0, 0.7, 0.5, 0.35, FINEST];
/// Atoms up to which [`DETAILS`] holds as it stands.
pub const DETAIL_ATOMS: f64 = 10_000.0;
/// The least bound on triangles: no closed mesh on a grid has fewer.
pub const LEAST_TRIANGLES: u32 = 8;
/// The largest bound on triangles.
pub const MOST_TRIANGLES: u32 = u32::MAX;

/// Area of a surface per atom, Å², about: heavy atoms of a protein with the default parameters.
const AREA_PER_ATOM: f64 = 7.5;

/// What decides the grid's spacing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Spacing {
    /// [`SurfaceParams::resolution`], as it stands.
    #[default]
    Given,
    /// A level from 0 to 6, and how many atoms there are.
    Detail(u8),
    /// The finest spacing whose mesh has at most so many triangles.
    MaxTriangles(u64),
}

impl Spacing {
    /// The parameter that asked for it.
    #[must_use]
    pub const fn parameter(self) -> &'static str {
        match self {
            Self::Given => "resolution",
            Self::Detail(_) => "detail",
            Self::MaxTriangles(_) => "max_triangles",
        }
    }

    /// The level of detail, if one was asked for.
    #[must_use]
    pub const fn detail(self) -> Option<u8> {
        match self {
            Self::Detail(level) => Some(level),
            Self::Given | Self::MaxTriangles(_) => None,
        }
    }

    /// The bound on triangles, if one was set.
    #[must_use]
    pub const fn max_triangles(self) -> Option<u64> {
        match self {
            Self::MaxTriangles(most) => Some(most),
            Self::Given | Self::Detail(_) => None,
        }
    }

    /// The spacing that so many atoms will have, about, Å: exact where it does not hang on the mesh.
    #[must_use]
    pub fn expected(self, params: &SurfaceParams, atoms: f64) -> f64 {
        match self {
            Self::Given => params.resolution,
            Self::Detail(level) => of_detail(level, atoms),
            Self::MaxTriangles(most) => of_area(AREA_PER_ATOM * atoms, most).clamp(FINEST, COARSEST),
        }
    }
}

/// The spacing of a level of detail, Å, a multiple of 0.01. Up to [`DETAIL_ATOMS`] it is that of [`DETAILS`]; beyond, it
/// grows with the structure's length, the cube root of its atoms, so that a level means as many cells across, whatever the size.
#[must_use]
pub fn of_detail(level: u8, atoms: f64) -> f64 {
    let base = DETAILS[usize::from(level).min(DETAILS.len() - 1)];
    let spacing = base * (atoms / DETAIL_ATOMS).cbrt().max(1.0);
    ((spacing * 100.0).round() / 100.0).min(COARSEST)
}

/// The spacing at which a surface of so much area, Å², has so many triangles, Å: about 3 A/h² of them.
pub(super) fn of_area(area: f64, triangles: u64) -> f64 {
    (3.0 * area / triangles as f64).sqrt()
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "hundredths are rounded to the same number")]
mod tests {
    use super::*;

    #[test]
    fn details_are_the_tables_up_to_ten_thousand_atoms_and_grow_with_the_cube_root() {
        for (level, spacing) in (0..).zip(DETAILS) {
            for atoms in [1.0, 454.0, 10_000.0] {
                assert_eq!(of_detail(level, atoms), spacing);
            }
            assert_eq!(of_detail(level, 80_000.0), (2.0 * spacing).min(COARSEST));
        }
        assert_eq!([of_detail(4, 335_722.0), of_detail(0, 1e7), of_detail(6, 1e7)], [1.61, 4.0, 2.5]);
    }

    #[test]
    fn finer_levels_are_finer_and_larger_structures_are_no_finer() {
        for atoms in [1.0, 9e3, 3e4, 2e5, 1e6] {
            let levels: Vec<f64> = (0..7).map(|level| of_detail(level, atoms)).collect();
            assert!(levels.is_sorted_by(|a, b| a > b || *a == COARSEST && *b == COARSEST), "{levels:?}");
            assert!(levels.iter().all(|h| (FINEST..=COARSEST).contains(h)));
            assert!((0..7).all(|level| of_detail(level, 1.3 * atoms) >= of_detail(level, atoms)));
        }
    }
}
