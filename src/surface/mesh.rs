//! The output of the core: an indexed triangle mesh with normals.

use rustc_hash::FxHashMap;

use super::column::Column;
use super::lattice::to_f32;

/// An indexed triangle mesh. Vertex `i` lies at `centre + positions[i]`, in Å.
///
/// Invariants of every mesh that a backend returns: each index is in range, normals have length 1 and point
/// outwards, triangles wind counter-clockwise seen from outside, and the surface is closed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// What to add to a position to get the structure file's own coordinates, Å.
    pub centre: [f64; 3],
    /// Vertex positions relative to `centre`, Å.
    pub positions: Column<[f32; 3]>,
    /// Unit normals, one per vertex, pointing out of the molecule.
    pub normals: Column<[f32; 3]>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Column<[u32; 3]>,
    /// Per vertex the index of the nearest sphere in the input, if it was asked for.
    pub atom_ids: Option<Column<u32>>,
    /// Per vertex an sRGB colour with alpha, if the caller set one. Backends leave it empty.
    pub colors: Option<Column<[u8; 4]>>,
    /// Where the mesh falls into parts that hang together, as (first vertex, first triangle), ascending from (0, 0):
    /// most triangles of a part use vertices of the part. A hint for parallel work; empty is always right.
    pub parts: Vec<(usize, usize)>,
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

    /// Gives every vertex whose normal is zero the area-weighted mean normal of its triangles: at a saddle of the
    /// density the gradient vanishes and has no direction.
    pub(crate) fn fill_flat_normals(&mut self) {
        let flat: FxHashMap<u32, usize> = (0_u32..)
            .zip(&self.normals)
            .filter(|(_, n)| n.iter().all(|c| c.abs() < 0.5))
            .zip(0..)
            .map(|((v, _), i)| (v, i))
            .collect();
        let mut sums = vec![[0.0_f64; 3]; flat.len()];
        for t in &self.triangles {
            for v in t {
                if let Some(&i) = flat.get(v) {
                    let normal = self.face_normal(*t);
                    (0..3).for_each(|k| sums[i][k] += normal[k]);
                }
            }
        }
        let mut order: Vec<_> = flat.into_iter().collect();
        order.sort_unstable();
        for (v, i) in order {
            let length = sums[i].iter().map(|c| c * c).sum::<f64>().sqrt();
            // A vertex whose triangles cancel to nothing still needs a unit vector.
            let unit = if length > 0.0 { sums[i].map(|c| c / length) } else { [0.0, 0.0, 1.0] };
            self.normals[v as usize] = unit.map(to_f32);
        }
    }

    /// Twice the area of a triangle times its unit normal, Å².
    #[must_use]
    pub fn face_normal(&self, triangle: [u32; 3]) -> [f64; 3] {
        let [a, b, c] = triangle.map(|v| self.positions[v as usize].map(f64::from));
        let (u, v): ([f64; 3], [f64; 3]) = (std::array::from_fn(|k| b[k] - a[k]), std::array::from_fn(|k| c[k] - a[k]));
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    }

    /// Bytes of positions, normals and indices for so many vertices and triangles.
    #[must_use]
    pub fn bytes_for(n_vertices: u64, n_triangles: u64) -> u64 {
        24 * n_vertices + 12 * n_triangles
    }
}
