//! Writer of BinaryCIF files for tests, including invalid ones. `1crn.bcif` was made from `samples/1crn.cif` by
//! `tests/tools/write_bcif.py compressed`.
#![allow(dead_code, reason = "each test binary uses a part")]
#![allow(clippy::unwrap_used, unreachable_pub, reason = "tests fail by panicking")]

/// Crambin written by biotite.
pub const CRAMBIN: &[u8] = include_bytes!("1crn.bcif");

/// MessagePack value.
#[derive(Debug, Clone)]
pub enum Pack {
    Nil,
    Bool(bool),
    Int(i64),
    Real(f64),
    Text(String),
    Bytes(Vec<u8>),
    Array(Vec<Pack>),
    Map(Vec<(&'static str, Pack)>),
}

use Pack::{Array, Bool, Bytes, Int, Map, Nil, Real, Text};
use molmesh::structure::{SourceFormat, Structure};

fn length(out: &mut Vec<u8>, head: u8, n: usize) {
    out.push(head);
    out.extend(u32::try_from(n).unwrap().to_be_bytes());
}

impl Pack {
    /// Encodes the value with numbers of 32 or 64 bits.
    pub fn write(&self, out: &mut Vec<u8>) {
        match self {
            Nil => out.push(0xC0),
            Bool(value) => out.push(0xC2 + u8::from(*value)),
            Int(value) => {
                out.push(0xD3);
                out.extend(value.to_be_bytes());
            }
            Real(value) => {
                out.push(0xCB);
                out.extend(value.to_be_bytes());
            }
            Text(text) => {
                length(out, 0xDB, text.len());
                out.extend(text.as_bytes());
            }
            Bytes(bytes) => {
                length(out, 0xC6, bytes.len());
                out.extend(bytes);
            }
            Array(items) => {
                length(out, 0xDD, items.len());
                for item in items {
                    item.write(out);
                }
            }
            Map(entries) => {
                length(out, 0xDF, entries.len());
                for (key, value) in entries {
                    text(key).write(out);
                    value.write(out);
                }
            }
        }
    }

    /// Returns the map with a key added or replaced.
    pub fn with(self, key: &'static str, value: Pack) -> Self {
        let Map(mut entries) = self else { return self };
        entries.retain(|(k, _)| *k != key);
        entries.push((key, value));
        Map(entries)
    }

    /// Returns the map without a key.
    pub fn without(self, key: &str) -> Self {
        let Map(mut entries) = self else { return self };
        entries.retain(|(k, _)| *k != key);
        Map(entries)
    }

    /// Returns true if this is the column or category of that name.
    pub fn is_named(&self, name: &str) -> bool {
        matches!(self, Map(entries) if entries.iter().any(|(k, v)| *k == "name" && matches!(v, Text(t) if t == name)))
    }
}

pub fn text(text: &str) -> Pack {
    Text(text.to_owned())
}

fn encoding(kind: &str, fields: Vec<(&'static str, Pack)>) -> Pack {
    Map([vec![("kind", text(kind))], fields].concat())
}

/// Types: 1, 2, 3 are signed and 4, 5, 6 unsigned integers of 8, 16, 32 bits; 32 and 33 are real numbers.
pub fn byte_array(code: i64) -> Pack {
    encoding("ByteArray", vec![("type", Int(code))])
}

pub fn fixed_point(factor: f64) -> Pack {
    encoding("FixedPoint", vec![("factor", Real(factor)), ("srcType", Int(33))])
}

pub fn interval(min: f64, max: f64, steps: i64) -> Pack {
    let fields = vec![("min", Real(min)), ("max", Real(max)), ("numSteps", Int(steps)), ("srcType", Int(33))];
    encoding("IntervalQuantization", fields)
}

pub fn run_length(size: i64) -> Pack {
    encoding("RunLength", vec![("srcType", Int(3)), ("srcSize", Int(size))])
}

pub fn delta(origin: i64) -> Pack {
    encoding("Delta", vec![("origin", Int(origin)), ("srcType", Int(3))])
}

pub fn packing(byte_count: i64, unsigned: bool, size: i64) -> Pack {
    let fields = vec![("byteCount", Int(byte_count)), ("isUnsigned", Bool(unsigned)), ("srcSize", Int(size))];
    encoding("IntegerPacking", fields)
}

pub fn string_array(joined: &str, offsets: &[i32], data_chain: Vec<Pack>) -> Pack {
    encoding(
        "StringArray",
        vec![
            ("stringData", text(joined)),
            ("offsets", Bytes(i32s(offsets))),
            ("offsetEncoding", Array(vec![byte_array(3)])),
            ("dataEncoding", Array(data_chain)),
        ],
    )
}

pub fn i32s(values: &[i32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

pub fn i16s(values: &[i16]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

fn encoded(data: Vec<u8>, chain: Vec<Pack>) -> Pack {
    Map(vec![("data", Bytes(data)), ("encoding", Array(chain))])
}

/// Returns a column without a mask.
pub fn column(name: &str, data: Vec<u8>, chain: Vec<Pack>) -> Pack {
    Map(vec![("name", text(name)), ("data", encoded(data, chain)), ("mask", Nil)])
}

pub fn ints(name: &str, values: &[i32]) -> Pack {
    column(name, i32s(values), vec![byte_array(3)])
}

pub fn reals(name: &str, values: &[f64]) -> Pack {
    column(name, values.iter().flat_map(|v| v.to_le_bytes()).collect(), vec![byte_array(33)])
}

/// Returns a column of strings.
pub fn texts(name: &str, values: &[&str]) -> Pack {
    let ends = values.iter().scan(0, |end, value| {
        *end += i32::try_from(value.encode_utf16().count()).unwrap();
        Some(*end)
    });
    let offsets: Vec<i32> = std::iter::once(0).chain(ends).collect();
    let ids: Vec<i32> = (0..i32::try_from(values.len()).unwrap()).collect();
    column(name, i32s(&ids), vec![string_array(&values.concat(), &offsets, vec![byte_array(3)])])
}

/// Adds a mask with one byte per row to a column.
pub fn masked(column: Pack, mask: &[u8]) -> Pack {
    column.with("mask", encoded(mask.to_vec(), vec![byte_array(4)]))
}

pub fn category(name: &str, rows: i64, columns: Vec<Pack>) -> Pack {
    Map(vec![("name", text(name)), ("rowCount", Int(rows)), ("columns", Array(columns))])
}

pub fn block(name: &str, categories: Vec<Pack>) -> Pack {
    Map(vec![("header", text(name)), ("categories", Array(categories))])
}

pub fn file(blocks: Vec<Pack>) -> Vec<u8> {
    let top = vec![("encoder", text("a test")), ("version", text("0.3.0")), ("dataBlocks", Array(blocks))];
    let mut out = Vec::new();
    Map(top).write(&mut out);
    out
}

/// Returns columns with the coordinates of `n` atoms.
pub fn places(n: usize) -> Vec<Pack> {
    let along = |step: f64| (0..n).map(|i| step * f64::from(u32::try_from(i % 1000).unwrap())).collect::<Vec<_>>();
    vec![reals("Cartn_x", &along(1.5)), reals("Cartn_y", &along(0.0)), reals("Cartn_z", &along(-0.25))]
}

/// Returns a file with these columns of `n` atoms. They replace columns of [`places`] with the same name.
pub fn atoms(n: usize, columns: Vec<Pack>) -> Vec<u8> {
    let mut all = places(n);
    for name in ["Cartn_x", "Cartn_y", "Cartn_z"] {
        if columns.iter().any(|column| column.is_named(name)) {
            all.retain(|column| !column.is_named(name));
        }
    }
    all.extend(columns);
    file(vec![block("TEST", vec![category("_atom_site", i64::try_from(n).unwrap(), all)])])
}

/// Returns the structure without the fields that depend on the source format.
pub fn anonymous(structure: &Structure) -> Structure {
    Structure { format: SourceFormat::Pdb, ..structure.clone() }
}
