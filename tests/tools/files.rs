//! Temporary folder of files, encoded meshes, and a mesh written to a sink in parts.

use std::path::PathBuf;
use std::sync::Mutex;
use std::{fs, io};

use molmesh::formats::{Encoder, Format, GlbSink, Meta, Packing, RandomAccess};
use molmesh::surface::{Mesh, MeshPart, MeshSink, Vertices};
use tempfile::TempDir;

/// Formats that trimesh reads.
pub const FOR_TRIMESH: [Format; 6] =
    [Format::Glb, Format::Gltf, Format::Ply, Format::PlyText, Format::Stl, Format::Obj];

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

/// Returns a mesh as a file.
pub fn encoded(format: Format, mesh: &Mesh, meta: &Meta) -> Vec<u8> {
    let mut bytes = Vec::new();
    Encoder::new(format, Packing::of(mesh), mesh, meta).unwrap().write(&mut bytes).unwrap();
    bytes
}

/// File in memory.
#[derive(Default)]
pub struct MemoryFile(pub Mutex<Vec<u8>>);

impl MemoryFile {
    pub fn into_bytes(self) -> Vec<u8> {
        self.0.into_inner().unwrap()
    }
}

impl RandomAccess for MemoryFile {
    fn write_all_at(&self, bytes: &[u8], offset: u64) -> io::Result<()> {
        let mut file = self.0.lock().unwrap();
        let start = usize::try_from(offset).unwrap();
        let len = file.len().max(start + bytes.len());
        file.resize(len, 0);
        file[start..start + bytes.len()].copy_from_slice(bytes);
        Ok(())
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
