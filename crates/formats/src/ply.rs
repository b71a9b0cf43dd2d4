//! PLY, binary little-endian: a text header, then packed vertex records, then packed faces. [`super::ply_text`] writes
//! the variant whose records are text.

use std::io::{self, Write};

use molmesh_surface::Mesh;

use super::block::{Placement, put_floats, write_records};
use super::{Meta, Normals, Storage, text};

/// Bytes of a face: the count 3, then three indices.
const FACE_BYTES: usize = 13;

/// Layout of a PLY file.
#[derive(Debug)]
pub(super) struct PlyPlan {
    header: String,
    pub(super) len: u64,
    storage: Storage,
}

impl PlyPlan {
    pub(super) fn new(mesh: &Mesh, storage: Storage, meta: &Meta) -> Self {
        let header = header(mesh, storage, meta, "binary_little_endian", None);
        let (n_vertices, n_triangles) = (mesh.positions.len() as u64, mesh.triangles.len() as u64);
        let vertex = vertex_bytes(mesh, storage.normals) as u64;
        let len = header.len() as u64 + vertex * n_vertices + FACE_BYTES as u64 * n_triangles;
        Self { header, len, storage }
    }

    pub(super) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(self.header.as_bytes())?;
        match vertex_bytes(mesh, self.storage.normals) {
            12 => vertices::<12>(mesh, self.storage, out),
            16 => vertices::<16>(mesh, self.storage, out),
            20 => vertices::<20>(mesh, self.storage, out),
            24 => vertices::<24>(mesh, self.storage, out),
            28 => vertices::<28>(mesh, self.storage, out),
            _ => vertices::<32>(mesh, self.storage, out),
        }?;
        let triangles = &mesh.triangles[..];
        write_records::<FACE_BYTES>(out, triangles.len(), |range, records| {
            for (record, triangle) in records.iter_mut().zip(&triangles[range]) {
                record[0] = 3;
                for (word, index) in record[1..].as_chunks_mut::<4>().0.iter_mut().zip(triangle) {
                    *word = index.to_le_bytes();
                }
            }
        })
    }
}

/// Returns the length of a vertex record, bytes: position, then normal, colour and atom if present.
fn vertex_bytes(mesh: &Mesh, normals: Normals) -> usize {
    let normal = if normals == Normals::Smooth { 12 } else { 0 };
    12 + normal + 4 * usize::from(mesh.colors.is_some()) + 4 * usize::from(mesh.atom_ids.is_some())
}

/// Writes vertex records of `N` bytes.
fn vertices<const N: usize>(mesh: &Mesh, storage: Storage, out: &mut dyn Write) -> io::Result<()> {
    let placement = Placement::new(mesh, storage.units);
    let positions = &mesh.positions[..];
    let normals = (storage.normals == Normals::Smooth).then_some(&mesh.normals[..]);
    let (colors, ids) = (mesh.colors.as_deref(), mesh.atom_ids.as_deref());
    write_records::<N>(out, positions.len(), |range, records| {
        for (record, i) in records.iter_mut().zip(range) {
            let (floats, _) = record.as_chunks_mut::<12>();
            put_floats(&mut floats[0], placement.absolute(positions[i]));
            let mut at = 12;
            if let Some(normals) = normals {
                put_floats(&mut floats[1], normals[i]);
                at = 24;
            }
            if let Some(colors) = colors {
                record[at..at + 4].copy_from_slice(&colors[i]);
                at += 4;
            }
            if let Some(ids) = ids {
                record[at..at + 4].copy_from_slice(&ids[i].to_le_bytes());
            }
        }
    })
}

/// Returns the header of a file whose records have this encoding. `precision` is the unit of the last decimal.
pub(super) fn header(mesh: &Mesh, storage: Storage, meta: &Meta, encoding: &str, precision: Option<&str>) -> String {
    let mut lines = vec!["ply".to_owned(), format!("format {encoding} 1.0")];
    lines.extend(text::facts(mesh, meta, storage.units, precision).into_iter().map(|fact| format!("comment {fact}")));
    lines.push(format!("element vertex {}", mesh.positions.len()));
    let floats: &[&str] = match storage.normals {
        Normals::Smooth => &["x", "y", "z", "nx", "ny", "nz"],
        Normals::None => &["x", "y", "z"],
    };
    lines.extend(floats.iter().map(|name| format!("property float {name}")));
    if mesh.colors.is_some() {
        lines.extend(["red", "green", "blue", "alpha"].map(|name| format!("property uchar {name}")));
    }
    if mesh.atom_ids.is_some() {
        lines.push("property uint atom".to_owned());
    }
    lines.push(format!("element face {}", mesh.triangles.len()));
    lines.push("property list uchar uint vertex_indices".to_owned());
    lines.push("end_header\n".to_owned());
    lines.join("\n")
}
