//! Strict readers of the mesh formats, written from their specifications. They panic on anything that the product does
//! not write.

#![allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "indices are integers")]

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::Value;

/// Content of a file. Positions are as in the file: relative to `translation` in glTF. Missing normals are empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Contents {
    pub translation: [f64; 3],
    pub positions: Vec<[f32; 3]>,
    pub normals: Vec<[f32; 3]>,
    pub triangles: Vec<[u32; 3]>,
    pub atoms: Option<Vec<u32>>,
    /// As in the file: linear, to 65,535, in glTF; sRGB, to 255, in PLY and OBJ, which has no alpha.
    pub colors: Option<Vec<[u16; 4]>>,
}

/// JSON and binary chunk of a GLB.
pub struct Glb {
    pub json: Value,
    /// Offset of the buffer in the file; the file length if there is none.
    pub bin_at: usize,
    pub bin: Vec<u8>,
}

pub fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap())
}

fn f32x3(bytes: &[u8]) -> [f32; 3] {
    std::array::from_fn(|k| f32::from_bits(u32_at(bytes, 4 * k)))
}

pub fn split_glb(bytes: &[u8]) -> Glb {
    assert_eq!((&bytes[..4], u32_at(bytes, 4)), (&b"glTF"[..], 2));
    assert_eq!(u32_at(bytes, 8) as usize, bytes.len());
    let json_len = u32_at(bytes, 12) as usize;
    assert_eq!((json_len % 4, &bytes[16..20]), (0, &b"JSON"[..]));
    let json: Value = serde_json::from_slice(&bytes[20..20 + json_len]).unwrap();
    let rest = 20 + json_len;
    if rest == bytes.len() {
        return Glb { json, bin_at: rest, bin: Vec::new() };
    }
    let bin_len = u32_at(bytes, rest) as usize;
    assert_eq!((bin_len % 4, &bytes[rest + 4..rest + 8]), (0, &b"BIN\0"[..]));
    assert_eq!(rest + 8 + bin_len, bytes.len());
    let bin = bytes[rest + 8..].to_vec();
    let used = usize::try_from(json["buffers"][0]["byteLength"].as_u64().unwrap()).unwrap();
    assert!(bin_len - used < 4 && bin[used..].iter().all(|&b| b == 0), "padding");
    Glb { json, bin_at: rest + 8, bin }
}

pub fn split_gltf(bytes: &[u8]) -> (Value, Vec<u8>) {
    let json: Value = serde_json::from_slice(bytes).unwrap();
    let Some(uri) = json["buffers"][0]["uri"].as_str() else { return (json, Vec::new()) };
    let bin = STANDARD.decode(uri.strip_prefix("data:application/octet-stream;base64,").unwrap()).unwrap();
    assert_eq!(json["buffers"][0]["byteLength"].as_u64().unwrap(), bin.len() as u64);
    (json, bin)
}

/// Reads the only mesh of a glTF document and its buffer.
pub fn gltf_contents(json: &Value, bin: &[u8]) -> Contents {
    let node = &json["nodes"][0];
    let translation = std::array::from_fn(|k| node["translation"][k].as_f64().unwrap());
    let mut contents = Contents { translation, ..Contents::default() };
    if json.get("meshes").is_none() {
        assert!(node.get("mesh").is_none() && json.get("buffers").is_none() && json.get("accessors").is_none());
        return contents;
    }
    let primitive = &json["meshes"][0]["primitives"][0];
    let attributes = &primitive["attributes"];
    let rows = |accessor: &Value, component: u64, shape: &str, bytes: usize| {
        rows(json, bin, accessor, component, shape, bytes)
    };
    if let Some(scale) = quantized_scale(json) {
        let position =
            |r: &&[u8]| std::array::from_fn(|k| f32::from(i16::from_le_bytes([r[2 * k], r[2 * k + 1]])) * scale);
        let normal = |r: &&[u8]| std::array::from_fn(|k| (f32::from(r[k].cast_signed()) / 127.0).max(-1.0));
        assert!(accessor_of(json, &attributes["POSITION"])["normalized"].as_bool().is_none_or(|n| !n));
        contents.positions = rows(&attributes["POSITION"], 5122, "VEC3", 6).iter().map(position).collect();
        if let Some(accessor) = attributes.get("NORMAL") {
            assert_eq!(accessor_of(json, accessor)["normalized"], true);
            contents.normals = rows(accessor, 5120, "VEC3", 3).iter().map(normal).collect();
        }
    } else {
        contents.positions = rows(&attributes["POSITION"], 5126, "VEC3", 12).iter().map(|r| f32x3(r)).collect();
        if let Some(accessor) = attributes.get("NORMAL") {
            contents.normals = rows(accessor, 5126, "VEC3", 12).iter().map(|r| f32x3(r)).collect();
        }
    }
    if let Some(accessor) = attributes.get("COLOR_0") {
        let float = |r: &&[u8]| std::array::from_fn(|k| (65_535.0 * f32::from_bits(u32_at(r, 4 * k))).round() as u16);
        let integer = |r: &&[u8]| std::array::from_fn(|k| u16::from_le_bytes([r[2 * k], r[2 * k + 1]]));
        let quantized = accessor_of(json, accessor)["componentType"] == 5123;
        assert_eq!(accessor_of(json, accessor)["normalized"].as_bool().unwrap_or(false), quantized);
        contents.colors = Some(if quantized {
            rows(accessor, 5123, "VEC4", 8).iter().map(integer).collect()
        } else {
            rows(accessor, 5126, "VEC4", 16).iter().map(float).collect()
        });
    }
    if let Some(accessor) = attributes.get("_ATOM") {
        contents.atoms = Some(match accessor_of(json, accessor)["componentType"].as_u64().unwrap() {
            5123 => rows(accessor, 5123, "SCALAR", 2)
                .iter()
                .map(|r| u32::from(u16::from_le_bytes((*r).try_into().unwrap())))
                .collect(),
            _ => rows(accessor, 5126, "SCALAR", 4).iter().map(|r| f32::from_bits(u32_at(r, 0)) as u32).collect(),
        });
    }
    let indices: Vec<u32> = match accessor_of(json, &primitive["indices"])["componentType"].as_u64().unwrap() {
        5121 => rows(&primitive["indices"], 5121, "SCALAR", 1).iter().map(|r| u32::from(r[0])).collect(),
        5123 => rows(&primitive["indices"], 5123, "SCALAR", 2)
            .iter()
            .map(|r| u32::from(u16::from_le_bytes([r[0], r[1]])))
            .collect(),
        _ => rows(&primitive["indices"], 5125, "SCALAR", 4).iter().map(|r| u32_at(r, 0)).collect(),
    };
    contents.triangles = indices.as_chunks::<3>().0.to_vec();
    contents
}

/// Returns the scale of the node of a quantized mesh, which is the same for all axes.
fn quantized_scale(json: &Value) -> Option<f32> {
    let node = &json["nodes"][0];
    let [used, required] = ["extensionsUsed", "extensionsRequired"].map(|key| json.get(key));
    assert_eq!(used, required);
    let scaled = used.is_some() || json["asset"]["extras"]["units"] != "angstrom";
    assert_eq!(node.get("scale").is_some(), scaled);
    assert_eq!(used?, &serde_json::json!(["KHR_mesh_quantization"]));
    let scale: Vec<f64> = node["scale"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert_eq!(scale, [scale[0]; 3]);
    Some(scale[0] as f32)
}

pub fn accessor_of<'a>(json: &'a Value, index: &Value) -> &'a Value {
    &json["accessors"][usize::try_from(index.as_u64().unwrap()).unwrap()]
}

/// Returns the offset of an accessor in the buffer.
pub fn accessor_offset(json: &Value, index: &Value) -> usize {
    let view = &json["bufferViews"][usize::try_from(accessor_of(json, index)["bufferView"].as_u64().unwrap()).unwrap()];
    usize::try_from(view["byteOffset"].as_u64().unwrap_or(0)).unwrap()
}

fn rows<'a>(json: &Value, bin: &'a [u8], index: &Value, component: u64, shape: &str, bytes: usize) -> Vec<&'a [u8]> {
    let accessor = accessor_of(json, index);
    assert_eq!((accessor["componentType"].as_u64(), accessor["type"].as_str()), (Some(component), Some(shape)));
    let view = &json["bufferViews"][usize::try_from(accessor["bufferView"].as_u64().unwrap()).unwrap()];
    let number = |value: &Value, default: u64| usize::try_from(value.as_u64().unwrap_or(default)).unwrap();
    let (offset, len) = (number(&view["byteOffset"], 0), number(&view["byteLength"], 0));
    let stride = number(&view["byteStride"], bytes as u64);
    let count = number(&accessor["count"], 0);
    assert_eq!((offset % 4, len), (0, stride * count));
    // 34962 and 34963 are OpenGL's vertex and index buffers. Only vertices require alignment to four bytes.
    let target = view["target"].as_u64().unwrap();
    assert!((target == 34962 && stride.is_multiple_of(4)) || (target == 34963 && stride == bytes));
    let rows: Vec<&[u8]> = bin[offset..offset + len].chunks(stride).collect();
    assert!(rows.iter().all(|r| r[bytes..].iter().all(|&b| b == 0)), "padding between rows");
    rows.into_iter().map(|r| &r[..bytes]).collect()
}

/// Returns the header lines of a PLY and the offset of its data.
pub fn ply_header(bytes: &[u8]) -> (Vec<String>, usize) {
    let end = b"end_header\n";
    let at = bytes.windows(end.len()).position(|w| w == end).unwrap() + end.len();
    assert!(bytes[..at].is_ascii());
    (String::from_utf8(bytes[..at].to_vec()).unwrap().lines().map(str::to_owned).collect(), at)
}

/// Numbers of vertices and faces and the optional columns of a PLY.
struct PlyLayout {
    n: usize,
    m: usize,
    normals: bool,
    colors: bool,
    atoms: bool,
}

/// Reads the header of a PLY with this encoding.
fn ply_layout(header: &[String], encoding: &str) -> PlyLayout {
    assert_eq!(header[..2], ["ply".to_owned(), format!("format {encoding} 1.0")]);
    let count = |what: &str| -> usize {
        let prefix = format!("element {what} ");
        header.iter().find_map(|l| l.strip_prefix(&prefix)).unwrap().parse().unwrap()
    };
    let has = |line: &str| header.iter().any(|l| l == line);
    let lines: Vec<&str> = header[2..].iter().map(String::as_str).filter(|l| !l.starts_with("comment ")).collect();
    let (n, m) = (count("vertex"), count("face"));
    let (colors, atoms) = (has("property uchar alpha"), has("property uint atom"));
    let mut expected = vec![format!("element vertex {n}")];
    let normals = has("property float nx");
    expected.extend(["x", "y", "z"].map(|p| format!("property float {p}")));
    expected.extend(["nx", "ny", "nz"].iter().filter(|_| normals).map(|p| format!("property float {p}")));
    expected.extend(["red", "green", "blue", "alpha"].iter().filter(|_| colors).map(|p| format!("property uchar {p}")));
    expected.extend(atoms.then(|| "property uint atom".to_owned()));
    expected.extend([
        format!("element face {m}"),
        "property list uchar uint vertex_indices".into(),
        "end_header".into(),
    ]);
    assert_eq!(lines, expected);
    PlyLayout { n, m, normals, colors, atoms }
}

pub fn read_ply_text(bytes: &[u8]) -> Contents {
    let (header, at) = ply_header(bytes);
    let PlyLayout { n, m, normals, colors, atoms } = ply_layout(&header, "ascii");
    let mut contents = Contents { colors: colors.then(Vec::new), atoms: atoms.then(Vec::new), ..Contents::default() };
    let mut lines = std::str::from_utf8(&bytes[at..]).unwrap().lines();
    for _ in 0..n {
        let mut words = lines.next().unwrap().split(' ');
        let mut three = || -> [f32; 3] { std::array::from_fn(|_| words.next().unwrap().parse().unwrap()) };
        contents.positions.push(three());
        if normals {
            contents.normals.push(three());
        }
        let mut integer = || -> u32 { words.next().unwrap().parse().unwrap() };
        if let Some(colors) = &mut contents.colors {
            colors.push(std::array::from_fn(|_| u16::from(u8::try_from(integer()).unwrap())));
        }
        if let Some(atoms) = &mut contents.atoms {
            atoms.push(integer());
        }
        assert_eq!(words.next(), None);
    }
    for _ in 0..m {
        let indices: Vec<u32> = lines.next().unwrap().split(' ').map(|word| word.parse().unwrap()).collect();
        assert_eq!((indices.len(), indices[0]), (4, 3));
        contents.triangles.push([indices[1], indices[2], indices[3]]);
    }
    assert_eq!(lines.next(), None);
    contents
}

pub fn read_ply(bytes: &[u8]) -> Contents {
    let (header, mut at) = ply_header(bytes);
    let PlyLayout { n, m, normals, colors, atoms } = ply_layout(&header, "binary_little_endian");
    let mut contents = Contents { colors: colors.then(Vec::new), atoms: atoms.then(Vec::new), ..Contents::default() };
    let mut take = |n: usize| {
        at += n;
        &bytes[at - n..at]
    };
    for _ in 0..n {
        contents.positions.push(f32x3(take(12)));
        if normals {
            contents.normals.push(f32x3(take(12)));
        }
        if let Some(colors) = &mut contents.colors {
            let color: [u8; 4] = take(4).try_into().unwrap();
            colors.push(color.map(u16::from));
        }
        if let Some(atoms) = &mut contents.atoms {
            atoms.push(u32_at(take(4), 0));
        }
    }
    for _ in 0..m {
        let face = take(13);
        assert_eq!(face[0], 3);
        contents.triangles.push(std::array::from_fn(|k| u32_at(face, 1 + 4 * k)));
    }
    assert_eq!(at, bytes.len());
    contents
}

/// Returns normal and corners of each face of an STL.
pub fn read_stl(bytes: &[u8]) -> Vec<[[f32; 3]; 4]> {
    assert!(!bytes.starts_with(b"solid"));
    let (records, rest) = bytes[84..].as_chunks::<50>();
    assert_eq!((u32_at(bytes, 80) as usize, rest.len()), (records.len(), 0));
    records
        .iter()
        .map(|r| {
            assert_eq!(r[48..], [0, 0]);
            std::array::from_fn(|k| f32x3(&r[12 * k..]))
        })
        .collect()
}

/// Reads a VTP: arrays of the XML header by name, then their blocks in file order, each after its length.
pub fn read_vtp(bytes: &[u8]) -> (Contents, Option<Vec<u32>>) {
    let mark = b"<AppendedData encoding=\"raw\">\n_";
    let at = bytes.windows(mark.len()).position(|w| w == mark).unwrap() + mark.len();
    let header = std::str::from_utf8(&bytes[..at]).unwrap();
    assert!(
        header
            .contains("<VTKFile type=\"PolyData\" version=\"1.0\" byte_order=\"LittleEndian\" header_type=\"UInt64\">")
    );
    let attribute = |text: &str, name: &str| -> String {
        let (_, rest) = text.split_once(&format!(" {name}=\"")).unwrap();
        rest.split_once('"').unwrap().0.to_owned()
    };
    let piece = header.lines().find(|line| line.contains("<Piece ")).unwrap();
    let count = |name: &str| -> usize { attribute(piece, name).parse().unwrap() };
    let (n, m) = (count("NumberOfPoints"), count("NumberOfPolys"));
    let mut end = at;
    let mut block = |name: &str, kind: &str, components: usize, bytes_each: usize, rows: usize| -> Option<&[u8]> {
        let line = header.lines().find(|line| line.contains(&format!("Name=\"{name}\"")))?;
        assert_eq!(
            (attribute(line, "type").as_str(), attribute(line, "NumberOfComponents")),
            (kind, components.to_string())
        );
        let start = at + attribute(line, "offset").parse::<usize>().unwrap();
        let len = u64::from_le_bytes(bytes[start..start + 8].try_into().unwrap());
        assert_eq!((start, len as usize), (end, components * bytes_each * rows), "{name}");
        end = start + 8 + len as usize;
        Some(&bytes[start + 8..end])
    };
    let vectors = |block: &[u8]| block.chunks(12).map(f32x3).collect::<Vec<_>>();
    let words = |block: &[u8]| block.chunks(4).map(|word| u32_at(word, 0)).collect::<Vec<_>>();
    let normals = block("Normals", "Float32", 3, 4, n).map(vectors).unwrap_or_default();
    let color = |row: &[u8]| std::array::from_fn(|k| u16::from(row[k]));
    let colors = block("RGBA", "UInt8", 4, 1, n).map(|block| block.chunks(4).map(color).collect());
    let atoms = block("atom", "UInt32", 1, 4, n).map(words);
    let parts = block("part", "UInt32", 1, 4, m).map(words);
    let positions = vectors(block("Points", "Float32", 3, 4, n).unwrap());
    let triangles = words(block("connectivity", "Int32", 1, 4, 3 * m).unwrap()).as_chunks::<3>().0.to_vec();
    let ends: Vec<u32> = (1..=m as u32).map(|i| 3 * i).collect();
    assert_eq!(words(block("offsets", "Int32", 1, 4, m).unwrap()), ends);
    assert_eq!(&bytes[end..], b"\n  </AppendedData>\n</VTKFile>\n");
    (Contents { positions, normals, triangles, atoms, colors, ..Contents::default() }, parts)
}

/// Returns the fields of the rows of an MSMS file. Checks the header: two comments, then number of rows and of spheres,
/// density and probe radius.
fn msms_rows<'a>(bytes: &'a [u8], counted: &str, fields: usize) -> Vec<Vec<&'a str>> {
    let text = std::str::from_utf8(bytes).unwrap();
    let words = |line: &'a str| line.split_whitespace().collect::<Vec<_>>();
    let lines: Vec<Vec<&str>> = text.lines().map(words).collect();
    assert!(lines[0][0] == "#" && lines[0].len() != fields && lines[1] == [counted, "#sphere", "density", "probe_r"]);
    let numbers: Vec<f64> = lines[2].iter().map(|word| word.parse().unwrap()).collect();
    assert_eq!((numbers.len(), numbers[0]), (4, (lines.len() - 3) as f64));
    assert!(lines[3..].iter().all(|line| line.len() == fields));
    lines[3..].to_vec()
}

/// Reads the vertices of MSMS: x y z, normal, analytical face, nearest sphere from 1, type of face. `atoms` holds the
/// spheres.
pub fn read_vert(bytes: &[u8]) -> Contents {
    let mut contents = Contents { atoms: Some(Vec::new()), ..Contents::default() };
    for row in msms_rows(bytes, "#vertex", 9) {
        let three = |at: usize| -> [f32; 3] { std::array::from_fn(|k| row[at + k].parse().unwrap()) };
        contents.positions.push(three(0));
        contents.normals.push(three(3));
        assert_eq!((row[6], row[8]), ("0", "0"));
        contents.atoms.as_mut().unwrap().push(row[7].parse().unwrap());
    }
    contents
}

/// Reads the triangles of MSMS: three vertices from 1, type of face, analytical face.
pub fn read_face(bytes: &[u8]) -> Vec<[u32; 3]> {
    let triangle = |row: Vec<&str>| {
        assert_eq!(row[3..], ["0", "0"]);
        std::array::from_fn(|k| row[k].parse::<u32>().unwrap() - 1)
    };
    msms_rows(bytes, "#faces", 5).into_iter().map(triangle).collect()
}

pub fn read_obj(bytes: &[u8]) -> Contents {
    let mut contents = Contents::default();
    for line in std::str::from_utf8(bytes).unwrap().lines() {
        let (keyword, rest) = line.split_once(' ').unwrap();
        let floats = || -> [f32; 3] {
            let all: Vec<f32> = rest.split(' ').map(|w| w.parse().unwrap()).collect();
            all.try_into().unwrap()
        };
        match keyword {
            "v" if rest.split(' ').count() == 6 => {
                let all: Vec<f32> = rest.split(' ').map(|w| w.parse().unwrap()).collect();
                contents.positions.push([all[0], all[1], all[2]]);
                let level = |k: usize| (all[k] * 255.0).round() as u16;
                contents.colors.get_or_insert_default().push([level(3), level(4), level(5), 255]);
            }
            "v" => contents.positions.push(floats()),
            "vn" => contents.normals.push(floats()),
            "f" => {
                let corners: Vec<u32> = rest
                    .split(' ')
                    .map(|word| {
                        let (vertex, normal) = word.split_once("//").map_or((word, None), |(v, n)| (v, Some(n)));
                        assert_eq!(normal, (!contents.normals.is_empty()).then_some(vertex));
                        vertex.parse::<u32>().unwrap() - 1
                    })
                    .collect();
                contents.triangles.push(corners.try_into().unwrap());
            }
            "#" | "o" => assert!(contents.positions.is_empty()),
            other => panic!("{other} in {line}"),
        }
    }
    contents
}
