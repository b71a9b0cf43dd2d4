//! Maps whose values colour a mesh: gemmi interpolates the same values in CCP4 maps.
#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::process::Command;

use molmesh::structure::map::{Map, MapLimits, read};
use molmesh::surface::Control;

use crate::tools;
use crate::tools::files::Files;

/// Intervals of the cell along a, b and c.
const INTERVALS: [usize; 3] = [8, 10, 12];

/// Returns a map of a whole triclinic cell with varying values, the `axes` (from 1) along columns, rows and sections,
/// and `start` as the first column, row and section.
fn ccp4(axes: [usize; 3], start: [i32; 3], big: bool) -> Vec<u8> {
    let mut words = vec![[0_u8; 4]; 256];
    let int = |n: i32| if big { n.to_be_bytes() } else { n.to_le_bytes() };
    let float = |v: f32| if big { v.to_be_bytes() } else { v.to_le_bytes() };
    for k in 0..3 {
        words[k] = int(INTERVALS[axes[k] - 1] as i32);
        words[4 + k] = int(start[k]);
        words[7 + k] = int(INTERVALS[k] as i32);
        words[16 + k] = int(axes[k] as i32);
    }
    for (k, value) in [11.0, 13.0, 17.0, 80.0, 95.0, 110.0].into_iter().enumerate() {
        words[10 + k] = float(value);
    }
    (words[3], words[22]) = (int(2), int(1));
    (words[52], words[53]) = (*b"MAP ", if big { [0x11, 0x11, 0, 0] } else { [0x44, 0x44, 0, 0] });
    let n: usize = INTERVALS.iter().product();
    let values = (0..n).map(|i| float(((i * 7919) % 101) as f32 - 50.0));
    words.into_iter().chain(values).collect::<Vec<_>>().concat()
}

/// Returns positions between the first and the last points of the map, Å.
fn positions(map: &Map) -> Vec<[f64; 3]> {
    let [low, high] = map.bounds();
    let mut random = 5_u64;
    let mut next = || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (random >> 33) as f64 / f64::from(1_u32 << 31)
    };
    let inside = std::iter::repeat_with(|| std::array::from_fn(|k| low[k] + next() * (high[k] - low[k])));
    inside.filter(|position| map.at(*position).is_some()).take(200).collect()
}

#[test]
fn gemmi_interpolates_the_same_values() {
    let Some(python) = tools::python_interpreter().or_else(|| tools::missing("gemmi")) else { return };
    let theirs = |bytes: &[u8], positions: &[[f64; 3]]| -> Vec<f64> {
        let mut files = Files::new();
        files.add("map.ccp4", bytes);
        let positions = positions.iter().map(|[x, y, z]| format!("{x},{y},{z}"));
        let output =
            Command::new(&python).arg("tests/tools/gemmi_map.py").arg(&files.paths[0]).args(positions).output();
        let output = output.unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap().lines().map(|line| line.parse().unwrap()).collect()
    };
    for (axes, start, big) in [([1, 2, 3], [0; 3], false), ([3, 1, 2], [0; 3], true), ([2, 3, 1], [3, -4, 5], false)] {
        let bytes = ccp4(axes, start, big);
        let map = read(&bytes, &MapLimits::default(), &Control::default()).unwrap();
        let positions = positions(&map);
        let off = |other: &[f64]| {
            let pairs = positions.iter().zip(other);
            pairs.map(|(position, value)| (map.at(*position).unwrap() - value).abs()).fold(0.0, f64::max)
        };
        let found = theirs(&bytes, &positions);
        assert_eq!((positions.len(), found.len()), (200, 200));
        assert!(off(&found) < 2e-3, "{axes:?} {start:?}: {}", off(&found));
        // Negative control: the same values along other axes.
        let other = theirs(&ccp4([axes[1], axes[2], axes[0]], start, big), &positions);
        assert!(off(&other) > 10.0, "{axes:?}: {}", off(&other));
    }
}
