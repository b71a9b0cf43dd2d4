#![allow(clippy::pedantic, clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::io::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use molmesh_surface::{CancelToken, Exceeded, Limit, MemoryMeter};

use super::*;

/// Map with the value `x + 10·y + 100·z` of its positions.
fn dx() -> String {
    let mut text = "# Data from a test\nobject 1 class gridpositions counts 3 4 5\norigin 1 2 3\n".to_owned();
    text += "delta 0.5 0 0\ndelta 0 1 0\ndelta 0 0 2\nobject 2 class gridconnections counts 3 4 5\n";
    text += "object 3 class array type double rank 0 items 60 data follows\n";
    let mut n = 0;
    for i in 0..3 {
        for j in 0..4 {
            for k in 0..5 {
                let (x, y, z) = (1.0 + 0.5 * f64::from(i), 2.0 + f64::from(j), 3.0 + 2.0 * f64::from(k));
                n += 1;
                text += &format!("{:e}{}", x + 10.0 * y + 100.0 * z, if n % 3 == 0 { "\n" } else { " " });
            }
        }
    }
    text + "attribute \"dep\" string \"positions\"\nobject \"regular\" class field\n"
}

fn of(bytes: &[u8]) -> Result<Map, MapError> {
    read(bytes, &MapLimits::default(), &Control::default())
}

fn linear([x, y, z]: [f64; 3]) -> f64 {
    x + 10.0 * y + 100.0 * z
}

/// Header and values of a CCP4 map.
struct Ccp4 {
    big: bool,
    mode: i32,
    size: [i32; 3],
    start: [i32; 3],
    intervals: [i32; 3],
    cell: [f32; 6],
    axes: [i32; 3],
    origin: [f32; 3],
    extended: i32,
    values: Vec<f32>,
}

impl Ccp4 {
    /// Orthogonal map of 4 columns along x, 3 rows along y and 2 sections along z, with the value `x + 10·y + 100·z`.
    fn plain() -> Self {
        let mut values = Vec::new();
        for (s, r, c) in (0..2).flat_map(|s| (0..3).flat_map(move |r| (0..4).map(move |c| (s, r, c)))) {
            values.push(linear([c, r, s].map(f64::from)) as f32);
        }
        Self {
            big: false,
            mode: 2,
            size: [4, 3, 2],
            start: [0; 3],
            intervals: [10, 20, 30],
            cell: [10.0, 20.0, 30.0, 90.0, 90.0, 90.0],
            axes: [1, 2, 3],
            origin: [0.0; 3],
            extended: 0,
            values,
        }
    }

    fn bytes(&self) -> Vec<u8> {
        let mut words = vec![[0_u8; 4]; 256];
        let int = |n: i32| if self.big { n.to_be_bytes() } else { n.to_le_bytes() };
        let float = |v: f32| if self.big { v.to_be_bytes() } else { v.to_le_bytes() };
        for k in 0..3 {
            words[k] = int(self.size[k]);
            words[4 + k] = int(self.start[k]);
            words[7 + k] = int(self.intervals[k]);
            words[16 + k] = int(self.axes[k]);
            words[49 + k] = float(self.origin[k]);
        }
        (0..6).for_each(|k| words[10 + k] = float(self.cell[k]));
        (words[3], words[22], words[23]) = (int(self.mode), int(1), int(self.extended));
        (words[52], words[53]) = (*b"MAP ", if self.big { [0x11, 0x11, 0, 0] } else { [0x44, 0x44, 0, 0] });
        let mut bytes: Vec<u8> = words.concat();
        bytes.extend(vec![0; self.extended.max(0) as usize]);
        for value in &self.values {
            match self.mode {
                0 => bytes.push((*value as i8).cast_unsigned()),
                1 | 6 => {
                    let n = if self.mode == 1 { (*value as i16).cast_unsigned() } else { *value as u16 };
                    bytes.extend(if self.big { n.to_be_bytes() } else { n.to_le_bytes() });
                }
                _ => bytes.extend(float(*value)),
            }
        }
        bytes
    }
}

#[test]
fn a_linear_function_is_interpolated_exactly() {
    for map in [of(dx().as_bytes()).unwrap(), of(&Ccp4::plain().bytes()).unwrap()] {
        let ([low, high], name) = (map.bounds(), map.format().name());
        let at = |parts: [f64; 3]| std::array::from_fn(|k| low[k] + parts[k] * (high[k] - low[k]));
        for parts in [[0.1, 0.2, 0.3], [0.99, 0.5, 0.01], [0.5, 0.999, 0.77], [0.25, 0.25, 0.999]] {
            let found = map.at(at(parts)).unwrap();
            assert!((found - linear(at(parts))).abs() < 1e-3, "{name} {parts:?}: {found}");
        }
        for parts in [[-0.01, 0.5, 0.5], [0.5, 1.01, 0.5], [0.5, 0.5, f64::NAN]] {
            assert_eq!(map.at(at(parts)), None, "{name}");
        }
    }
    let map = of(dx().as_bytes()).unwrap();
    assert_eq!((map.size(), map.bounds()), ([3, 4, 5], [[1.0, 2.0, 3.0], [2.0, 5.0, 11.0]]));
    // Negative control: a map with exchanged steps has other values.
    let wrong = of(dx().replace("delta 0.5 0 0", "delta 0 0.5 0").replace("delta 0 1 0", "delta 1 0 0").as_bytes());
    assert!((wrong.unwrap().at([2.5, 2.25, 4.0]).unwrap() - linear([2.5, 2.25, 4.0])).abs() > 1.0);
}

#[test]
fn ccp4_maps_of_every_kind_have_the_same_values() {
    let expected = |map: &Map| map.at([1.25, 0.5, 0.75]);
    let plain = of(&Ccp4::plain().bytes()).unwrap();
    assert!((expected(&plain).unwrap() - 81.25).abs() < 1e-9);
    for (mode, big) in [(2, true), (0, false), (1, false), (1, true), (6, false), (6, true)] {
        let mut map = Ccp4 { mode, big, ..Ccp4::plain() };
        if mode == 0 {
            map.values.iter_mut().for_each(|v| *v -= 100.0);
        }
        let found = expected(&of(&map.bytes()).unwrap()).unwrap();
        let shift = if mode == 0 { 100.0 } else { 0.0 };
        assert!((found + shift - 81.25).abs() < 1e-6, "{mode} {big}: {found}");
    }
    let extended = Ccp4 { extended: 80, ..Ccp4::plain() };
    assert_eq!(expected(&of(&extended.bytes()).unwrap()), expected(&plain));
    // A wrong machine stamp, and axes that are left out.
    let mut stamped = Ccp4 { axes: [0; 3], ..Ccp4::plain() }.bytes();
    stamped[212] = 0x11;
    assert_eq!(expected(&of(&stamped).unwrap()), expected(&plain));
    // An origin replaces the first column, row and section.
    let moved = Ccp4 { origin: [5.0, 6.0, 7.0], start: [3, 3, 3], ..Ccp4::plain() };
    assert!((of(&moved.bytes()).unwrap().at([6.25, 6.5, 7.75]).unwrap() - 81.25).abs() < 1e-5);
    let started = Ccp4 { start: [2, 3, 4], ..Ccp4::plain() };
    assert!((of(&started.bytes()).unwrap().at([3.25, 3.5, 4.75]).unwrap() - 81.25).abs() < 1e-5);
    // Columns along z, rows along x, sections along y.
    let turned = Ccp4 { axes: [3, 1, 2], ..Ccp4::plain() };
    assert!((of(&turned.bytes()).unwrap().at([0.5, 0.75, 1.25]).unwrap() - 81.25).abs() < 1e-5);
    // A monoclinic cell: the point at half of the way along each axis.
    let skewed = Ccp4 { cell: [10.0, 20.0, 30.0, 90.0, 120.0, 90.0], ..Ccp4::plain() };
    let (half, root) = (0.5 * -0.5, 0.5 * 0.75_f64.sqrt());
    let found = of(&skewed.bytes()).unwrap().at([0.5 + half, 0.5, root]).unwrap();
    assert!((found - 55.5).abs() < 1e-4, "{found}");
}

#[test]
fn halves_are_those_of_ieee_754() {
    let half = |bits: u16| {
        let mut bytes = Ccp4 { mode: 12, ..Ccp4::plain() }.bytes();
        bytes.truncate(1024);
        bytes.extend(std::iter::repeat_n(bits.to_le_bytes(), 24).flatten());
        of(&bytes).unwrap().at([0.5; 3])
    };
    for (bits, value) in
        [(0x3C00, 1.0), (0xC000, -2.0), (0x7BFF, 65504.0), (0x0001, 2_f64.powi(-24)), (0x3555, 0.333_251_953_125)]
    {
        assert_eq!(half(bits), Some(value), "{bits:x}");
    }
    assert_eq!([half(0x7C00), half(0x7E00)], [None, None], "no finite number");
}

#[test]
fn bad_maps_name_the_location() {
    let malformed = |bytes: &[u8]| match of(bytes) {
        Err(MapError::Malformed { location, found, expected }) => format!("{location}: {found}, {expected}"),
        other => panic!("{other:?}"),
    };
    let with = |from: &str, to: &str| malformed(dx().replace(from, to).as_bytes());
    for (from, to, words) in [
        ("counts 3 4 5\norigin", "counts 3 4\norigin", "line 2: `object 1 class gridpositions counts 3 4`, `counts`"),
        ("counts 3 4 5\norigin", "counts 1 12 5\norigin", "line 2: 1 × 12 × 5 points, at least 2"),
        ("origin 1 2 3", "origin 1 2 x", "line 3: `origin 1 2 x`, `origin` and three numbers"),
        ("delta 0 1 0", "delta 1 0 0", "line 8: `delta` in one plane"),
        ("delta 0 1 0\n", "", "three lines `delta` before it"),
        ("origin 1 2 3\n", "", "`origin` before it"),
        ("rank 0", "rank 1 shape 3", "`rank 0`"),
        ("items 60", "items 59", "line 8: 59 items, 60 for 3 × 4 × 5 points"),
        ("data follows", "lsb ieee data follows", "with the numbers as text"),
        ("class array", "class field", "`class gridpositions`"),
        ("7.21e2", "7.21f2", "line 9: `7.21f2`, number 3 of 60"),
    ] {
        let found = with(from, to);
        assert!(found.contains(words), "{from}: {found}");
    }
    let cut = dx();
    let cut = &cut[..cut.find("attribute").unwrap() - 9];
    assert!(
        malformed(cut.as_bytes()).contains("the end of the file, number 60 of 60"),
        "{}",
        malformed(cut.as_bytes())
    );
    assert!(malformed(b"object 1 class gridpositions counts 2 2 2\n").contains("the end of the file"));
    let huge = "object 1 class gridpositions counts 400 400 400\norigin 0 0 0\ndelta 1 0 0\ndelta 0 1 0\ndelta 0 0 1\n\
                object 3 class array type double rank 0 items 64000000 data follows\n1 2 3\n";
    assert!(malformed(huge.as_bytes()).contains("6 bytes to the end of the file, 64000000 numbers"));

    let broken = |change: &dyn Fn(&mut Ccp4)| {
        let mut map = Ccp4::plain();
        change(&mut map);
        malformed(&map.bytes())
    };
    assert!(broken(&|map| map.mode = 4).contains("mode (word 4, byte 12): 4, 0, 1, 2, 6 or 12"));
    assert!(broken(&|map| map.size[1] = -3).contains("columns, rows and sections (words 1 to 3, byte 0): -3"));
    assert!(broken(&|map| map.size[2] = 1).contains("4 × 3 × 1 points"));
    assert!(broken(&|map| map.axes = [1, 1, 3]).contains("axes (words 17 to 19, byte 64): 1, 1, 3"));
    assert!(broken(&|map| map.intervals[0] = 0).contains("intervals of the cell"));
    assert!(broken(&|map| map.cell[0] = -1.0).contains("cell (words 11 to 16, byte 40)"));
    assert!(broken(&|map| map.cell[3..].fill(179.0)).contains("the angles of a cell"));
    assert!(broken(&|map| map.origin[0] = f32::NAN).contains("origin (words 50 to 52, byte 196)"));
    assert!(broken(&|map| map.extended = -4).contains("extended header (word 24, byte 92): -4"));
    assert!(broken(&|map| map.values.truncate(23)).contains("1116 bytes, 1120 bytes"));
    let mut skewed = Ccp4::plain().bytes();
    skewed[96] = 1;
    assert!(malformed(&skewed).contains("skew transformations are not supported"));
    for bytes in [&b""[..], b"HEADER", b"\x89PNG\r\n\x1a\n", &[0; 2000]] {
        assert!(matches!(of(bytes), Err(MapError::UnknownFormat { .. })));
    }
}

#[test]
fn values_that_are_not_finite_have_no_neighbourhood() {
    let map = of(dx().replacen("3.21e2", "nan", 1).as_bytes()).unwrap();
    assert_eq!(map.at([1.1, 2.1, 3.1]), None);
    assert!(map.at([1.6, 3.1, 5.1]).is_some());
}

#[derive(Debug, Default)]
struct Meter {
    now: AtomicU64,
    most: AtomicU64,
    limit: u64,
}

impl MemoryMeter for Meter {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let held = self.now.fetch_add(bytes, Ordering::SeqCst) + bytes;
        if held > self.limit {
            self.now.fetch_sub(bytes, Ordering::SeqCst);
            return Err(OutOfMemory::Limit { needed: held, limit: self.limit });
        }
        self.most.fetch_max(held, Ordering::SeqCst);
        Ok(())
    }

    fn shrink(&self, bytes: u64) {
        self.now.fetch_sub(bytes, Ordering::SeqCst);
    }
}

#[test]
fn maps_are_limited_charged_and_cancelled() {
    let text = dx();
    let limited = |max_points| {
        let limits = MapLimits { max_points, ..MapLimits::default() };
        [text.clone().into_bytes(), Ccp4::plain().bytes()].map(|bytes| read(&bytes, &limits, &Control::default()).err())
    };
    assert_eq!(limited(60), [None, None]);
    let error = |points, max| Exceeded { actual: Some(points), ..Exceeded::new(Limit::MapPoints, max) }.error();
    assert_eq!(limited(23), [60, 24].map(|points| Some(error(points, 23))));
    let huge = Ccp4 { size: [i32::MAX; 3], ..Ccp4::plain() }.bytes();
    assert_eq!(of(&huge).err(), Some(error(u64::MAX, MapLimits::default().max_points)));
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(text.as_bytes()).unwrap();
    let packed = packed.finish().unwrap();
    assert_eq!(of(&packed).unwrap().at([1.1, 2.2, 3.3]), of(text.as_bytes()).unwrap().at([1.1, 2.2, 3.3]));
    let limits = MapLimits { max_inflated_bytes: 100, ..MapLimits::default() };
    let error = read(&packed, &limits, &Control::default()).unwrap_err();
    assert_eq!(error, Exceeded::new(Limit::MapBytes, 100).error());
    assert!(matches!(of(&packed[..packed.len() / 2]), Err(MapError::Decompress { encoding: "gzip", .. })));

    let meter = Arc::new(Meter { limit: 240, ..Meter::default() });
    let control = Control { memory: Arc::<Meter>::clone(&meter), ..Control::default() };
    let map = read(text.as_bytes(), &MapLimits::default(), &control).unwrap();
    assert_eq!([&meter.now, &meter.most].map(|n| n.load(Ordering::SeqCst)), [240, 240], "4 bytes for each value");
    drop(map);
    assert_eq!(meter.now.load(Ordering::SeqCst), 0);
    let control = Control { memory: Arc::new(Meter { limit: 239, ..Meter::default() }), ..Control::default() };
    assert!(matches!(read(text.as_bytes(), &MapLimits::default(), &control), Err(MapError::Memory(_))));
    let cancelled = Control { cancel: CancelToken::default(), ..Control::default() };
    cancelled.cancel.cancel();
    assert_eq!(read(text.as_bytes(), &MapLimits::default(), &cancelled).unwrap_err(), MapError::Cancelled);
}
