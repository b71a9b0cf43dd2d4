//! Maps: CCP4, MRC and `OpenDX`.

use molmesh::structure::map::{Map, MapLimits, read};
use molmesh::surface::Control;

use super::assert_short;

/// Words of `OpenDX` files, and of headers of CCP4 files.
pub(super) const WORDS: &[&str] = &[
    "object 1 class gridpositions counts 2 2 2\n",
    "object 2 class gridconnections counts 2 2 2\n",
    "object 3 class array type double rank 0 items 8 data follows\n",
    "origin 0 0 0\n",
    "delta 1 0 0\n",
    "delta 0 1 0\n",
    "delta 0 0 1\n",
    "delta 1e300 1e-300 0\n",
    "attribute \"dep\" string \"positions\"\n",
    "nan ",
    "1e39 ",
    "# ",
    "MAP ",
    "\u{2}\0\0\0",
    "\0\0\0\u{2}",
    "DD\0\0",
    "\u{11}\u{11}\0\0",
];

const LIMITS: MapLimits = MapLimits { max_points: 1 << 16, max_inflated_bytes: 1 << 20 };

/// Reads a map and samples it inside and around its bounds.
pub(super) fn sample(bytes: &[u8]) {
    let map = match read(bytes, &LIMITS, &Control::default()) {
        Ok(map) => map,
        Err(error) => return assert_short(&error.to_string()),
    };
    let points: usize = map.size().iter().product();
    assert!(points as u64 <= LIMITS.max_points && map.size().iter().all(|side| *side >= 2), "{map:?}");
    let [low, high] = map.bounds();
    for n in 0..343 {
        let at = [n % 7, n / 7 % 7, n / 49];
        assert_sound(&map, std::array::from_fn(|k| low[k] + (f64::from(at[k]) - 1.0) / 4.0 * (high[k] - low[k])));
    }
    for odd in [f64::NAN, f64::INFINITY, f64::MIN, 0.0] {
        assert_sound(&map, [odd; 3]);
    }
}

/// Asserts that a value is a finite number if there is one.
fn assert_sound(map: &Map, position: [f64; 3]) {
    assert!(map.at(position).is_none_or(f64::is_finite), "{position:?} of {map:?}");
}
