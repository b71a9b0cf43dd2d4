//! PLY, binary little-endian: a text header, then packed vertex records, then packed faces.

use std::io::{self, Write};

use super::block::{absolute, put_floats, write_records};
use super::{Meta, text};
use crate::surface::Mesh;

/// Bytes of a face: the count 3, then three indices.
const FACE_BYTES: usize = 13;

/// A PLY file that is laid out.
#[derive(Debug)]
pub(super) struct PlyPlan {
    header: String,
    len: u64,
}

impl PlyPlan {
    pub(super) fn new(mesh: &Mesh, meta: &Meta) -> Self {
        let header = header(mesh, meta);
        let (n_vertices, n_triangles) = (mesh.positions.len() as u64, mesh.triangles.len() as u64);
        let vertex = 24 + 4 * u64::from(mesh.colors.is_some()) + 4 * u64::from(mesh.atom_ids.is_some());
        let len = header.len() as u64 + vertex * n_vertices + FACE_BYTES as u64 * n_triangles;
        Self { header, len }
    }

    pub(super) fn len(&self) -> u64 {
        self.len
    }

    pub(super) fn write(&self, mesh: &Mesh, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(self.header.as_bytes())?;
        match (mesh.colors.as_deref(), mesh.atom_ids.as_deref()) {
            (None, None) => vertices::<24>(mesh, out, |_, _| {}),
            (Some(colors), None) => vertices::<28>(mesh, out, |i, record| record[24..].copy_from_slice(&colors[i])),
            (None, Some(ids)) => {
                vertices::<28>(mesh, out, |i, record| record[24..].copy_from_slice(&ids[i].to_le_bytes()))
            }
            (Some(colors), Some(ids)) => vertices::<32>(mesh, out, |i, record| {
                record[24..28].copy_from_slice(&colors[i]);
                record[28..].copy_from_slice(&ids[i].to_le_bytes());
            }),
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

/// Writes vertex records of position, normal and whatever `rest` adds.
fn vertices<const N: usize>(mesh: &Mesh, out: &mut dyn Write, rest: impl Fn(usize, &mut [u8; N])) -> io::Result<()> {
    let (centre, positions, normals) = (mesh.centre, &mesh.positions[..], &mesh.normals[..]);
    write_records::<N>(out, positions.len(), |range, records| {
        let rows = positions[range.clone()].iter().zip(&normals[range.clone()]);
        for ((record, (&position, &normal)), i) in records.iter_mut().zip(rows).zip(range) {
            let (floats, _) = record.as_chunks_mut::<12>();
            put_floats(&mut floats[0], absolute(centre, position));
            put_floats(&mut floats[1], normal);
            rest(i, record);
        }
    })
}

fn header(mesh: &Mesh, meta: &Meta) -> String {
    let mut lines = vec!["ply".to_owned(), "format binary_little_endian 1.0".to_owned()];
    lines.extend(text::facts(mesh, meta, None).into_iter().map(|fact| format!("comment {fact}")));
    lines.push(format!("element vertex {}", mesh.positions.len()));
    lines.extend(["x", "y", "z", "nx", "ny", "nz"].map(|name| format!("property float {name}")));
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
