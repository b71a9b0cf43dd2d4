//! Places to write to: a folder that goes away, and a file in memory that takes bytes anywhere.

use std::path::PathBuf;
use std::sync::Mutex;
use std::{fs, io};

use molmesh::formats::{GlbSink, PlaceBytes};
use molmesh::surface::{Mesh, MeshPart, MeshSink, Vertices};
use tempfile::TempDir;

/// Files in a folder that goes away.
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

/// A file in memory that takes bytes anywhere.
#[derive(Default)]
pub struct Anywhere(Mutex<Vec<u8>>);

impl Anywhere {
    pub fn bytes(&self) -> Vec<u8> {
        self.0.lock().unwrap().clone()
    }
}

impl PlaceBytes for Anywhere {
    fn place(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        let (mut file, start) = (self.0.lock().unwrap(), usize::try_from(offset).unwrap());
        let len = file.len().max(start + bytes.len());
        file.resize(len, 0xee);
        file[start..start + bytes.len()].copy_from_slice(bytes);
        Ok(())
    }
}

/// Hands a mesh on in parts, from the last to the first.
pub fn pour(sink: &GlbSink<'_>, mesh: &Mesh, n_parts: usize) {
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
        // Whoever made the sink asks it why.
        if sink.part(&MeshPart { first_vertex, vertices, first_triangle, triangles }).is_err() {
            return;
        }
    }
}
