//! Decoder of compressed GLB files, by the library that encodes them. Other decoders are in `decode_meshopt.mjs`.

use serde_json::Value;

use super::readers::{Glb, split_glb};

/// Name of the extension.
pub const EXTENSION: &str = "EXT_meshopt_compression";

pub fn number(value: &Value) -> usize {
    usize::try_from(value.as_u64().unwrap_or(0)).unwrap()
}

/// Decodes a compressed GLB. Returns its document and its decoded buffers, or the error of a broken stream.
pub fn decoded(bytes: &[u8]) -> Result<(Value, [Vec<u8>; 2]), meshopt::Error> {
    let Glb { json, bin, .. } = split_glb(bytes);
    assert_eq!(json["buffers"].as_array().unwrap().len(), 2);
    assert_eq!(json["buffers"][1]["extensions"][EXTENSION]["fallback"], true);
    let mut buffer = vec![0; number(&json["buffers"][1]["byteLength"])];
    let mut end = [0, 0];
    for view in json["bufferViews"].as_array().unwrap() {
        let Some(packed) = view.get("extensions").map(|extensions| &extensions[EXTENSION]) else { continue };
        assert_eq!((number(&view["buffer"]), number(&packed["buffer"])), (1, 0));
        let [start, source] = [view, packed].map(|range| number(&range["byteOffset"]));
        // Views follow each other in both buffers, at multiples of 4.
        assert_eq!([start, source], end.map(|end: usize| end.next_multiple_of(4)));
        let [bytes, len] = [view, packed].map(|range| number(&range["byteLength"]));
        end = [start + bytes, source + len];
        let (stride, count) = (number(&packed["byteStride"]), number(&packed["count"]));
        assert_eq!(bytes, stride * count);
        assert!(view.get("byteStride").is_none_or(|own| number(own) == stride));
        let rows = stream(packed, &bin[source..source + len], stride, count)?;
        buffer[start..start + bytes].copy_from_slice(&rows);
    }
    Ok((json, [bin, buffer]))
}

/// Decodes a view.
fn stream(packed: &Value, data: &[u8], stride: usize, count: usize) -> Result<Vec<u8>, meshopt::Error> {
    if packed["mode"] == "TRIANGLES" {
        assert_eq!(data[0], 0xe1, "version 1 of the index codec");
        let indices = meshopt::decode_index_buffer::<u32>(data, count)?;
        return Ok(indices.iter().flat_map(|index| index.to_le_bytes()[..stride].to_vec()).collect());
    }
    assert_eq!((&packed["mode"], data[0]), (&"ATTRIBUTES".into(), 0xa0), "version 0 of the vertex codec");
    Ok(match (stride, packed.get("filter").and_then(Value::as_str)) {
        (4, Some("OCTAHEDRAL")) => {
            let mut rows = meshopt::decode_vertex_buffer::<[i8; 4]>(data, count)?;
            meshopt::decode_filter_oct(&mut rows);
            rows.as_flattened().iter().map(|v| v.cast_unsigned()).collect()
        }
        (4, None) => meshopt::decode_vertex_buffer::<[u8; 4]>(data, count)?.into_flattened(),
        (8, None) => meshopt::decode_vertex_buffer::<[u8; 8]>(data, count)?.into_flattened(),
        other => panic!("{other:?}"),
    })
}

/// Corner of a triangle as in the file, except for its normal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Corner {
    pub position: [i16; 3],
    pub color: Vec<u8>,
    pub atom: Vec<u8>,
    /// In units of 1/127.
    pub normal: [i8; 3],
}

/// Returns the order of a corner, without the normal, which compression changes.
fn key(corner: &Corner) -> ([i16; 3], &[u8], &[u8]) {
    (corner.position, &corner.color, &corner.atom)
}

/// Triangle whose lowest corner is the first.
pub type Triangle = [Corner; 3];

/// Reads all triangles of each mesh of a document with quantized vertices, sorted, with the number of its primitives.
/// The bounds of each primitive must be exact.
pub fn triangles(json: &Value, buffers: &[&[u8]]) -> Vec<(usize, Vec<Triangle>)> {
    let of_mesh = |mesh: &Value| {
        let primitives = mesh["primitives"].as_array().unwrap();
        let mut all: Vec<Triangle> =
            primitives.iter().flat_map(|primitive| of_primitive(json, buffers, primitive)).collect();
        all.sort_by(|a, b| a.each_ref().map(key).cmp(&b.each_ref().map(key)));
        (primitives.len(), all)
    };
    json["meshes"].as_array().unwrap().iter().map(of_mesh).collect()
}

fn of_primitive(json: &Value, buffers: &[&[u8]], primitive: &Value) -> Vec<Triangle> {
    let rows = |index: &Value, bytes: usize| -> Vec<&[u8]> {
        let accessor = &json["accessors"][number(index)];
        let view = &json["bufferViews"][number(&accessor["bufferView"])];
        let stride = view.get("byteStride").map_or(bytes, number);
        let start = number(&view["byteOffset"]) + number(&accessor["byteOffset"]);
        let row = |i: usize| &buffers[number(&view["buffer"])][start + stride * i..][..bytes];
        (0..number(&accessor["count"])).map(row).collect()
    };
    let attributes = &primitive["attributes"];
    let optional = |name: &str, bytes: usize| attributes.get(name).map(|index| rows(index, bytes));
    let positions: Vec<[i16; 3]> = rows(&attributes["POSITION"], 6)
        .iter()
        .map(|row| std::array::from_fn(|k| i16::from_le_bytes([row[2 * k], row[2 * k + 1]])))
        .collect();
    let (normals, colors, atoms) = (optional("NORMAL", 3), optional("COLOR_0", 8), optional("_ATOM", 4));
    let accessor = &json["accessors"][number(&attributes["POSITION"])];
    for k in 0..3 {
        let values = || positions.iter().map(|row| i64::from(row[k]));
        assert_eq!(accessor["min"][k].as_i64(), values().min());
        assert_eq!(accessor["max"][k].as_i64(), values().max());
    }
    let width = match number(&json["accessors"][number(&primitive["indices"])]["componentType"]) {
        5121 => 1,
        5123 => 2,
        _ => 4,
    };
    let index = |row: &&[u8]| row.iter().rev().fold(0, |all, &byte| all << 8 | usize::from(byte));
    let indices: Vec<usize> = rows(&primitive["indices"], width).iter().map(index).collect();
    let optional = |column: &Option<Vec<&[u8]>>, i: usize| column.as_ref().map_or(Vec::new(), |rows| rows[i].to_vec());
    let corner = |&i: &usize| Corner {
        position: positions[i],
        color: optional(&colors, i),
        atom: optional(&atoms, i),
        normal: normals.as_ref().map_or([0; 3], |rows| std::array::from_fn(|k| rows[i][k].cast_signed())),
    };
    let triangle = |three: &[usize; 3]| {
        let mut corners = three.each_ref().map(corner);
        let lowest = (0..3).min_by_key(|&k| [0, 1, 2].map(|j| key(&corners[(k + j) % 3]))).unwrap();
        corners.rotate_left(lowest);
        corners
    };
    indices.as_chunks::<3>().0.iter().map(triangle).collect()
}
