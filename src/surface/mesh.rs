//! The output of the core: an indexed triangle mesh with normals.

/// An indexed triangle mesh. Vertex `i` lies at `centre + positions[i]`, in Å.
///
/// Invariants of every mesh that a backend returns: each index is in range, normals have length 1 and point
/// outwards, triangles wind counter-clockwise seen from outside, and the surface is closed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// What to add to a position to get the structure file's own coordinates, Å.
    pub centre: [f64; 3],
    /// Vertex positions relative to `centre`, Å.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals, one per vertex, pointing out of the molecule.
    pub normals: Vec<[f32; 3]>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Per vertex the index of the nearest sphere in the input, if it was asked for.
    pub atom_ids: Option<Vec<u32>>,
    /// Per vertex an sRGB colour with alpha, if the caller set one. Backends leave it empty.
    pub colors: Option<Vec<[u8; 4]>>,
}

impl Mesh {
    /// Number of vertices.
    #[must_use]
    pub fn n_vertices(&self) -> usize {
        self.positions.len()
    }

    /// Number of triangles.
    #[must_use]
    pub fn n_triangles(&self) -> usize {
        self.triangles.len()
    }

    /// Lowest and highest relative position per axis; zeros for an empty mesh.
    #[must_use]
    pub fn bounds(&self) -> [[f32; 3]; 2] {
        let Some(&first) = self.positions.first() else { return [[0.0; 3]; 2] };
        self.positions.iter().fold([first, first], |[lo, hi], p| {
            [std::array::from_fn(|k| lo[k].min(p[k])), std::array::from_fn(|k| hi[k].max(p[k]))]
        })
    }

    /// Bytes of positions, normals and indices for so many vertices and triangles.
    #[must_use]
    pub fn bytes_for(n_vertices: u64, n_triangles: u64) -> u64 {
        24 * n_vertices + 12 * n_triangles
    }
}
