//! Cube of a tileset: its levels, and the boxes of its tiles.

use molmesh_formats::tileset::{MAX_LEVELS, TileAddress, TilesetBounds};

/// Cells of the grid along the edge of a tile. A tile in a protein then has about 40,000 triangles.
pub(super) const CELLS: f64 = 64.0;
/// Distance between the coarsest spheres and the faces of the cube, in spacings of the root.
const MARGIN: f64 = 2.0;

/// Cube that is divided into tiles. Its faces are planes of the grids of all levels.
#[derive(Debug, Clone, Copy)]
pub(super) struct Layout {
    /// Lowest corner, Å.
    low: [f64; 3],
    /// Grid spacing of the root, Å.
    pub(super) spacing: f64,
    pub(super) levels: u32,
}

impl Layout {
    /// Returns the smallest cube around spheres with centres between `low` and `high` whose last level has the grid
    /// spacing `finest`. Their surface is at most `reach` away from the centres. Lengths are in Å.
    pub(super) fn new([low, high]: [[f64; 3]; 2], reach: f64, finest: f64) -> Self {
        let half = (0..3).map(|k| 0.5 * (high[k] - low[k])).fold(0.0, f64::max);
        // The centre of the cube is a grid point, at most a spacing from the middle of the spheres.
        let fits = |levels: &u32| {
            0.5 * CELLS * spacing(*levels, finest) >= half + reach + (MARGIN + 1.0) * spacing(*levels, finest)
        };
        let levels = (1..MAX_LEVELS).find(fits).unwrap_or(MAX_LEVELS);
        let spacing = spacing(levels, finest);
        let corner = |k: usize| ((0.5 * (low[k] + high[k]) / spacing).floor() - 0.5 * CELLS) * spacing;
        Self { low: std::array::from_fn(corner), spacing, levels }
    }

    /// Returns the grid spacing of a level, Å.
    pub(super) fn spacing(&self, level: u32) -> f64 {
        self.spacing / f64::from(1_u32 << level)
    }

    /// Returns the edge length of the tiles of a level, Å.
    pub(super) fn side(&self, level: u32) -> f64 {
        CELLS * self.spacing(level)
    }

    /// Returns cube, levels and geometric error.
    pub(super) fn bounds(&self) -> TilesetBounds {
        let side = self.side(0);
        let centre = self.low.map(|c| c + 0.5 * side);
        TilesetBounds { centre, side, levels: self.levels, error: self.spacing }
    }

    /// Returns the lowest and the highest corner of a tile, Å.
    pub(super) fn tile(&self, TileAddress { level, at: [x, y, z] }: TileAddress) -> [[f64; 3]; 2] {
        let side = self.side(level);
        // The axes of the tileset are x, −z and y of the structure.
        let along = [x, z, (1 << level) - 1 - y].map(f64::from);
        [0.0, 1.0].map(|end| std::array::from_fn(|k| self.low[k] + side * (along[k] + end)))
    }

    /// Returns the lowest and the highest coordinates, along the axes of the structure, of the tiles of a level that a
    /// box from `low` to `high`, Å, touches.
    pub(super) fn touched(&self, level: u32, [low, high]: [[f64; 3]; 2]) -> [[u32; 3]; 2] {
        let (side, last) = (self.side(level), (1_u32 << level) - 1);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "clamped to the tiles of the level"
        )]
        let tile = |c: f64, k: usize| ((c - self.low[k]) / side).floor().clamp(0.0, f64::from(last)) as u32;
        [low, high].map(|corner| std::array::from_fn(|k| tile(corner[k], k)))
    }

    /// Returns the tiles of a level between these coordinates, inclusive.
    pub(super) fn between(level: u32, [low, high]: [[u32; 3]; 2]) -> impl Iterator<Item = TileAddress> {
        let last = (1_u32 << level) - 1;
        let [x, y, z] = [0, 1, 2].map(|k| low[k]..=high[k]);
        let columns = z.flat_map(move |z| y.clone().map(move |y| [y, z]));
        columns.flat_map(move |[y, z]| x.clone().map(move |x| TileAddress { level, at: [x, last - z, y] }))
    }
}

/// Returns the grid spacing of the root, Å.
fn spacing(levels: u32, finest: f64) -> f64 {
    finest * f64::from(1_u32 << (levels - 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_divide_the_cube_and_contain_what_touches_them() {
        let spheres = [[-40.0, 3.0, 10.0], [70.0, 31.0, 77.5]];
        for finest in [0.35, 0.5, 2.0] {
            let layout = Layout::new(spheres, 4.0, finest);
            assert!((layout.spacing(layout.levels - 1) - finest).abs() < 1e-12);
            let [low, high] = layout.tile(TileAddress::ROOT);
            assert!(
                (0..3).all(|k| low[k] + 4.0 <= spheres[0][k] && high[k] - 4.0 >= spheres[1][k]),
                "{low:?} {high:?}"
            );
            for level in 0..layout.levels.min(4) {
                let touched =
                    |bounds| Layout::between(level, layout.touched(level, bounds)).collect::<Vec<TileAddress>>();
                let all = touched([low, high.map(|c| c - 1e-6)]);
                assert_eq!(all.len(), 8_usize.pow(level));
                for tile in all {
                    let [from, to] = layout.tile(tile);
                    let inner = [from.map(|c| c + 1e-6), to.map(|c| c - 1e-6)];
                    assert_eq!(touched(inner), [tile]);
                    if let Some(parent) = tile.parent() {
                        let [low, high] = layout.tile(parent);
                        assert!((0..3).all(|k| low[k] <= from[k] && to[k] <= high[k]), "{tile:?} in {parent:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn small_structures_have_one_level() {
        assert_eq!(Layout::new([[0.0; 3], [10.0; 3]], 4.0, 0.5).levels, 1);
        assert_eq!(Layout::new([[0.0; 3], [30.0; 3]], 4.0, 0.5).levels, 2);
    }
}
