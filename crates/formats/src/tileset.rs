//! Documents of a tileset: 3D Tiles 1.1 with implicit tiling by an octree.
//!
//! In 3D Tiles, z points up, and clients rotate glTF, in which y points up, accordingly. The transform of the root
//! reverses this rotation, so that positions in the tileset are those of the structure. Tile addresses refer to the
//! rotated axes.

use serde_json::{Value, json};

use super::GENERATOR;

/// Maximum number of levels: enough for the largest coordinates at the finest spacing.
pub const MAX_LEVELS: u32 = 24;
/// Transform of the root, by columns: its inverse rotates y up to z up, as clients do with glTF.
const AXES: [i32; 16] = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1];
/// Maximum number of levels of a subtree: its bits then have at most 42 KB.
const MAX_SUBTREE_LEVELS: u32 = 6;

/// Address of a tile: its level, 0 for the root, and its coordinates in tiles of that level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TileAddress {
    /// Level.
    pub level: u32,
    /// Coordinates x, y and z, from 0 to 2^level − 1.
    pub at: [u32; 3],
}

impl TileAddress {
    /// Root of all tiles.
    pub const ROOT: Self = Self { level: 0, at: [0; 3] };

    /// Returns the tile of the previous level that contains this one; `None` for the root.
    #[must_use]
    pub fn parent(self) -> Option<Self> {
        Some(Self { level: self.level.checked_sub(1)?, at: self.at.map(|c| c / 2) })
    }

    /// Returns the path of the tile within a folder: level, x, y and z, separated by slashes.
    #[must_use]
    pub fn path(self) -> String {
        let Self { level, at: [x, y, z] } = self;
        format!("{level}/{x}/{y}/{z}")
    }

    /// Parses the path of a tile; `None` for any other text.
    #[must_use]
    pub fn parse(text: &str) -> Option<Self> {
        let numbers: Vec<u32> = text.split('/').map_while(|part| part.parse().ok()).collect();
        let [level, x, y, z] = numbers[..] else { return None };
        let address = Self { level, at: [x, y, z] };
        // Equal tiles have equal paths.
        (address.is_valid(MAX_LEVELS) && address.path() == text).then_some(address)
    }

    /// Returns true if its level is below `levels` and it lies in the cube of that level.
    #[must_use]
    pub fn is_valid(self, levels: u32) -> bool {
        self.level < levels && self.at.iter().all(|c| *c < 1 << self.level)
    }

    /// Returns the tile `levels` deeper whose position in Morton order among all tiles there is `index`.
    fn descendant(self, levels: u32, index: u32) -> Self {
        let coordinate = |k: u32| (0..levels).fold(0, |c, bit| c | (index >> (3 * bit + k) & 1) << bit);
        let [x, y, z] = self.at.map(|c| c << levels);
        Self { level: self.level + levels, at: [x | coordinate(0), y | coordinate(1), z | coordinate(2)] }
    }
}

/// Bounding cube and levels of a tileset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TilesetBounds {
    /// Centre of the cube in the coordinates of the structure, Å.
    pub centre: [f64; 3],
    /// Edge length, Å.
    pub side: f64,
    /// Number of levels.
    pub levels: u32,
    /// Geometric error of the root, Å. Each level has half the error of the level before.
    pub error: f64,
}

impl TilesetBounds {
    /// Returns the number of levels of a subtree. All subtrees have about the same number.
    #[must_use]
    pub const fn subtree_levels(&self) -> u32 {
        self.levels.div_ceil(self.levels.div_ceil(MAX_SUBTREE_LEVELS))
    }
}

/// Templates of the URIs of tiles and subtrees, relative to `tileset.json`. The text `{level}/{x}/{y}/{z}` stands for
/// the address of a tile.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TilesetUris {
    /// GLB of a tile.
    pub content: String,
    /// Subtree below a tile.
    pub subtrees: String,
}

/// Returns `tileset.json`.
#[must_use]
pub fn tileset_document(bounds: &TilesetBounds, uris: &TilesetUris) -> Value {
    let TilesetBounds { centre: [x, y, z], side, levels, error } = *bounds;
    let half = 0.5 * side;
    json!({
        "asset": { "version": "1.1", "generator": GENERATOR },
        // Error of showing nothing.
        "geometricError": side,
        "root": {
            "transform": AXES,
            "boundingVolume": { "box": [x, -z, y, half, 0, 0, 0, half, 0, 0, 0, half] },
            "geometricError": error,
            "refine": "REPLACE",
            "content": { "uri": uris.content },
            "implicitTiling": {
                "subdivisionScheme": "OCTREE",
                "availableLevels": levels,
                "subtreeLevels": bounds.subtree_levels(),
                "subtrees": { "uri": uris.subtrees },
            },
        },
    })
}

/// Tileset of a unit that another tileset repeats.
#[derive(Debug, Clone)]
pub struct RepeatedTileset {
    /// URI of its `tileset.json`.
    pub uri: String,
    /// Bounds in the coordinates of the unit.
    pub bounds: TilesetBounds,
    /// Placements: rows of matrices with the translation in Å in the last column.
    pub placements: Vec<[[f64; 4]; 3]>,
}

/// Returns the `tileset.json` of an assembly: the mesh at `root`, which the tilesets of the units at all placements
/// replace. There is at least one placement.
#[must_use]
pub fn assembly_document(root: &str, units: &[RepeatedTileset]) -> Value {
    let (mut children, mut corners) = (Vec::new(), [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]]);
    for RepeatedTileset { uri, bounds: TilesetBounds { centre: [x, y, z], side, error, .. }, placements } in units {
        let half = 0.5 * side;
        for rows in placements {
            for (k, [a, b, c, t]) in rows.iter().enumerate() {
                let (middle, reach) = (a * x + b * y + c * z + t, half * (a.abs() + b.abs() + c.abs()));
                corners[0][k] = corners[0][k].min(middle - reach);
                corners[1][k] = corners[1][k].max(middle + reach);
            }
            // Relative to the axes of the root.
            let rows = [rows[0], rows[2].map(|v| -v), rows[1]];
            let column = |k: usize| rows.map(|row| row[k]).into_iter().chain([f64::from(u8::from(k == 3))]);
            children.push(json!({
                "transform": (0..4).flat_map(column).collect::<Vec<f64>>(),
                "boundingVolume": { "box": [x, y, z, half, 0, 0, 0, half, 0, 0, 0, half] },
                "geometricError": error,
                "content": { "uri": uri },
            }));
        }
    }
    let [low, high] = corners;
    let [x, y, z] = [0, 1, 2].map(|k| 0.5 * (low[k] + high[k]));
    let [a, b, c] = [0, 1, 2].map(|k| 0.5 * (high[k] - low[k]));
    json!({
        "asset": { "version": "1.1", "generator": GENERATOR },
        // Error of showing nothing.
        "geometricError": 2.0 * a.max(b).max(c),
        "root": {
            "transform": AXES,
            "boundingVolume": { "box": [x, -z, y, a, 0, 0, 0, c, 0, 0, 0, b] },
            "geometricError": units.iter().fold(0.0, |most: f64, unit| most.max(unit.bounds.error)),
            "refine": "REPLACE",
            "content": { "uri": root },
            "children": children,
        },
    })
}

/// Returns the binary file of the subtree with this number of levels at `root`. `tile` returns true for tiles of the
/// tileset, `content` for those with a file.
#[must_use]
pub fn subtree(
    root: TileAddress,
    levels: u32,
    tile: impl Fn(TileAddress) -> bool,
    content: impl Fn(TileAddress) -> bool,
) -> Vec<u8> {
    let inner: Vec<TileAddress> = (0..levels).flat_map(|level| all(root, level)).collect();
    let children: Vec<TileAddress> = all(root, levels).collect();
    let (mut views, mut buffer) = (Vec::new(), Vec::new());
    let mut availability = |tiles: &[TileAddress], is_available: &dyn Fn(TileAddress) -> bool| {
        let mut bits = vec![0_u8; tiles.len().div_ceil(8)];
        let mut count = 0;
        for (i, _) in tiles.iter().enumerate().filter(|(_, address)| is_available(**address)) {
            bits[i / 8] |= 1 << (i % 8);
            count += 1;
        }
        if count == 0 || count == tiles.len() {
            return json!({ "constant": u8::from(count > 0) });
        }
        let view = json!({ "buffer": 0, "byteOffset": buffer.len(), "byteLength": bits.len() });
        buffer.extend(&bits);
        buffer.resize(buffer.len().next_multiple_of(8), 0);
        views.push(view);
        json!({ "bitstream": views.len() - 1, "availableCount": count })
    };
    let mut document = json!({
        "tileAvailability": availability(&inner, &tile),
        "contentAvailability": [availability(&inner, &content)],
        "childSubtreeAvailability": availability(&children, &tile),
    });
    if !buffer.is_empty() {
        document["buffers"] = json!([{ "byteLength": buffer.len() }]);
        document["bufferViews"] = views.into();
    }
    let mut json = document.to_string().into_bytes();
    json.resize(json.len().next_multiple_of(8), b' ');
    let lengths = [json.len() as u64, buffer.len() as u64].map(u64::to_le_bytes);
    [b"subt", &1_u32.to_le_bytes()[..], &lengths.concat(), &json, &buffer].concat()
}

/// Returns all tiles `levels` below a root, in Morton order.
fn all(root: TileAddress, levels: u32) -> impl Iterator<Item = TileAddress> {
    (0..1_u32 << (3 * levels)).map(move |index| root.descendant(levels, index))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_are_in_morton_order_of_each_level() {
        let marked = TileAddress { level: 2, at: [1, 2, 3] };
        let file = subtree(TileAddress::ROOT, 5, |tile| tile.level < 3, |tile| tile == marked);
        let json_bytes = usize::try_from(u64::from_le_bytes(file[8..16].try_into().unwrap())).unwrap();
        assert_eq!((&file[..8], file.len() % 8, json_bytes % 8), (&b"subt\x01\0\0\0"[..], 0, 0));
        let json: Value = serde_json::from_slice(&file[24..24 + json_bytes]).unwrap();
        assert_eq!(json["tileAvailability"]["availableCount"], 1 + 8 + 64);
        assert_eq!(json["childSubtreeAvailability"], json!({ "constant": 0 }));
        let number = |value: &Value| usize::try_from(value.as_u64().unwrap()).unwrap();
        let view = &json["bufferViews"][number(&json["contentAvailability"][0]["bitstream"])];
        let bits = &file[24 + json_bytes + number(&view["byteOffset"])..];
        // Levels 0 and 1 have 9 bits. The bits of x, y and z alternate: 1, 2, 3 are 101 and 110 from the lowest bit on.
        let index = 9 + 0b110_101;
        let set: Vec<usize> = (0..bits.len() * 8).filter(|i| bits[i / 8] >> (i % 8) & 1 == 1).collect();
        assert_eq!(set, [index]);
    }

    #[test]
    fn descendants_have_their_ancestors() {
        let root = TileAddress { level: 3, at: [4, 0, 7] };
        for tile in all(root, 2) {
            assert_eq!(tile.parent().and_then(TileAddress::parent), Some(root));
        }
        assert_eq!(all(root, 2).collect::<std::collections::HashSet<_>>().len(), 64);
        assert_eq!(TileAddress::ROOT.parent(), None);
    }
}
