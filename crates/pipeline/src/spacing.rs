//! Choice of the grid spacing: a given value, a level of detail, or a maximum number of triangles.

use molmesh_surface::SurfaceParams;

/// Finest automatic spacing, Å. Finer grids resolve the blending of spheres, but no more details of the molecule. A
/// given spacing may be finer.
pub const FINEST: f64 = 0.25;
/// Coarsest automatic spacing, Å. Coarser grids miss whole atoms.
pub const COARSEST: f64 = 4.0;
/// Spacings by level of detail, Å. Each level has about twice the triangles of the level before.
pub const DETAILS: [f64; 7] = [2.0, 1.4, 1.0, 0.7, 0.5, 0.35, FINEST];
/// Number of atoms up to which [`DETAILS`] applies unchanged.
pub const DETAIL_ATOMS: f64 = 10_000.0;
/// Minimum limit on triangles: no closed mesh on a grid has fewer.
pub const MIN_TRIANGLE_LIMIT: u32 = 8;
/// Maximum limit on triangles.
pub const MAX_TRIANGLE_LIMIT: u32 = u32::MAX;

/// Approximate surface area per atom, Å²: heavy atoms of a protein with the default parameters.
const AREA_PER_ATOM: f64 = 7.5;

/// Method that chooses the grid spacing.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Spacing {
    /// [`SurfaceParams::resolution`], unchanged.
    #[default]
    Given,
    /// Level of detail from 0 to 6, adapted to the number of atoms.
    Detail(u8),
    /// Finest spacing whose mesh has at most this many triangles.
    MaxTriangles(u64),
}

impl Spacing {
    /// Returns the name of the parameter that selects this method.
    #[must_use]
    pub const fn parameter(self) -> &'static str {
        match self {
            Self::Given => "resolution",
            Self::Detail(_) => "detail",
            Self::MaxTriangles(_) => "max_triangles",
        }
    }

    /// Returns the level of detail, if one is set.
    #[must_use]
    pub const fn detail(self) -> Option<u8> {
        match self {
            Self::Detail(level) => Some(level),
            Self::Given | Self::MaxTriangles(_) => None,
        }
    }

    /// Returns the limit on triangles, if one is set.
    #[must_use]
    pub const fn max_triangles(self) -> Option<u64> {
        match self {
            Self::MaxTriangles(limit) => Some(limit),
            Self::Given | Self::Detail(_) => None,
        }
    }

    /// Returns the expected spacing for a number of atoms, Å. It is exact unless it depends on the mesh.
    #[must_use]
    pub fn expected(self, params: &SurfaceParams, atoms: f64) -> f64 {
        match self {
            Self::Given => params.resolution,
            Self::Detail(level) => of_detail(level, atoms),
            Self::MaxTriangles(limit) => of_area(AREA_PER_ATOM * atoms, limit).clamp(FINEST, COARSEST),
        }
    }
}

/// Returns the spacing of a level of detail, Å, a multiple of 0.01. Beyond [`DETAIL_ATOMS`] it grows with the cube root
/// of the number of atoms, so that a level has the same number of cells across large structures.
#[must_use]
pub fn of_detail(level: u8, atoms: f64) -> f64 {
    let base = DETAILS[usize::from(level).min(DETAILS.len() - 1)];
    let spacing = base * (atoms / DETAIL_ATOMS).cbrt().max(1.0);
    ((spacing * 100.0).round() / 100.0).min(COARSEST)
}

/// Returns the spacing h, Å, at which a surface of the given area A, Å², has about 3 A/h² = `triangles` triangles.
pub(super) fn of_area(area: f64, triangles: u64) -> f64 {
    (3.0 * area / triangles as f64).sqrt()
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "equal hundredths round to equal numbers")]
mod tests {
    use super::*;

    #[test]
    fn detail_levels_grow_with_the_cube_root_beyond_ten_thousand_atoms() {
        for (level, spacing) in (0..).zip(DETAILS) {
            for atoms in [1.0, 454.0, 10_000.0] {
                assert_eq!(of_detail(level, atoms), spacing);
            }
            assert_eq!(of_detail(level, 80_000.0), (2.0 * spacing).min(COARSEST));
        }
        assert_eq!([of_detail(4, 335_722.0), of_detail(0, 1e7), of_detail(6, 1e7)], [1.61, 4.0, 2.5]);
    }

    #[test]
    fn spacing_falls_with_the_level_and_never_falls_with_size() {
        for atoms in [1.0, 9e3, 3e4, 2e5, 1e6] {
            let levels: Vec<f64> = (0..7).map(|level| of_detail(level, atoms)).collect();
            assert!(levels.is_sorted_by(|a, b| a > b || *a == COARSEST && *b == COARSEST), "{levels:?}");
            assert!(levels.iter().all(|h| (FINEST..=COARSEST).contains(h)));
            assert!((0..7).all(|level| of_detail(level, 1.3 * atoms) >= of_detail(level, atoms)));
        }
    }
}
