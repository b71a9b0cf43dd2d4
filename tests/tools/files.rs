//! Temporary folder of files, and a mesh written to a sink in parts.

use std::fs;
use std::path::PathBuf;

use molmesh::formats::GlbSink;
use molmesh::surface::{Mesh, MeshPart, MeshSink, Vertices};
use tempfile::TempDir;

/// Files in a temporary folder, which is removed on drop.
pub struct Files {
    folder: TempDir,
    pub paths: Vec<PathBuf>,
}

impl Files {
    pub fn new() -> Self {
        Self { folder: TempDir::new().unwrap(), paths: Vec::new() }
    }

    pub fn add(&mut self, name: &str, bytes: &[u8]) {
        let path = self.folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        self.paths.push(path);
    }
}

/// Writes a mesh in parts, from the last to the first.
pub fn write_parts(sink: &GlbSink<'_>, mesh: &Mesh, n_parts: usize) {
    let (n, m) = (mesh.n_vertices(), mesh.n_triangles());
    sink.begin(n, m).unwrap();
    for part in (0..n_parts).rev() {
        let cut = |len: usize| part * len / n_parts..(part + 1) * len / n_parts;
        let (v, t) = (cut(n), cut(m));
        let (first_vertex, first_triangle) = (v.start, t.start);
        let vertices = match mesh.vertices() {
            Vertices::Single { positions, normals } => {
                Vertices::Single { positions: &positions[v.clone()], normals: &normals[v] }
            }
            Vertices::Quantized { step, positions, normals } => {
                Vertices::Quantized { step, positions: &positions[v.clone()], normals: &normals[v] }
            }
        };
        let triangles = &mesh.triangles[t];
        // The caller asks the sink for the cause.
        if sink.part(&MeshPart { first_vertex, vertices, first_triangle, triangles }).is_err() {
            return;
        }
    }
}
