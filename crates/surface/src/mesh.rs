//! Output of the core: an indexed triangle mesh with normals.

use std::ops::Range;

use bytemuck::Pod;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::column::Column;
use super::control::Control;
use super::error::SurfaceError;
use super::lattice::{to_f32, to_u32};
use super::quantize::{self, Step};
use super::sink::Vertices;
use super::vector::{add, area_vector, joined_bounds, length, unit};

/// Rows per task.
const ROWS: usize = 1 << 16;

/// An indexed triangle mesh. Vertex `i` lies at `centre + position(i)`, in Å.
///
/// Vertices are stored either in `positions` and `normals`, or in `quantized`; the others are empty.
///
/// Invariants of every mesh that a backend returns: each index is in range, normals have length 1 and point
/// outwards, triangles wind counter-clockwise seen from outside, and the surface is closed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Mesh {
    /// Origin of the positions in the structure file's coordinates, Å.
    pub centre: [f64; 3],
    /// Vertex positions relative to `centre`, Å.
    pub positions: Column<[f32; 3]>,
    /// Unit normals, one per vertex, pointing out of the molecule.
    pub normals: Column<[f32; 3]>,
    /// Vertices as small integers. If present, `positions` and `normals` are empty.
    pub quantized: Option<Quantized>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Column<[u32; 3]>,
    /// Index of the nearest sphere of the input for each vertex, if requested.
    pub atom_ids: Option<Column<u32>>,
    /// Per vertex an sRGB colour with alpha, if the caller set one. Backends leave it empty.
    pub colors: Option<Column<[u8; 4]>>,
    /// Parts with their own vertices. They cover all rows in order. Empty if the mesh is not divided.
    pub parts: Vec<PartRange>,
    /// True if the mesh, or each of its parts, was cut out of a closed surface and has a boundary. Backends leave it
    /// false.
    pub cut: bool,
    /// Placements of the parts; `None` if each part is placed once, where it is. Backends leave it empty.
    pub placements: Option<Placements>,
}

/// Rotations and translations that place instances of parts: a position p relative to the mesh's centre is placed at
/// the rotated p plus the translation, relative to the same centre.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Placements {
    /// Translations, Å.
    pub translations: Column<[f32; 3]>,
    /// Rotations as unit quaternions (x, y, z, w), one for each translation.
    pub rotations: Column<[f32; 4]>,
}

/// Rows of a part of a mesh, and its measures. Its triangles refer to its own vertices only.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PartRange {
    /// Name.
    pub name: String,
    /// Rows of its vertices.
    pub vertices: Range<usize>,
    /// Rows of its triangles; may be empty.
    pub triangles: Range<usize>,
    /// Area, Å².
    pub area: f64,
    /// Enclosed volume, Å³; `None` if the part is not closed on its own.
    pub volume: Option<f64>,
    /// Lowest and highest position relative to the mesh's centre, per axis, Å; zeros without vertices.
    pub bounds: [[f32; 3]; 2],
    /// Rows of its placements; empty if the mesh has none.
    pub placements: Range<usize>,
}

/// Vertices in 12 bytes. The fourth number of a row is 0.
#[derive(Debug, Clone, PartialEq)]
pub struct Quantized {
    /// Length of a unit of the positions.
    pub step: Step,
    /// Positions relative to the mesh's centre, in steps; [`BEYOND`](quantize::BEYOND) where a coordinate is out of
    /// reach.
    pub positions: Column<[i16; 4]>,
    /// Unit normals, one per position, in units of 1/127.
    pub normals: Column<[i8; 4]>,
}

impl Quantized {
    /// `n` rows of zeros.
    #[must_use]
    pub fn zeroed(step: Step, n: usize) -> Self {
        Self { step, positions: Column::zeroed(n), normals: Column::zeroed(n) }
    }

    /// Returns the lowest and highest position per axis, in steps; `None` without rows.
    #[must_use]
    pub fn bounds(&self) -> Option<[[i16; 3]; 2]> {
        self.positions.pieces().filter_map(bounds_of).reduce(joined_bounds)
    }
}

/// Returns the minimum and maximum of the first three columns; `None` without rows.
pub fn bounds_of<T: Copy + PartialOrd + Send + Sync, const N: usize>(rows: &[[T; N]]) -> Option<[[T; 3]; 2]> {
    let of = |rows: &[[T; N]]| {
        // Four rows at a time fill whole vectors, with each axis always in the same lanes.
        let (fours, rest) = rows.as_chunks::<4>();
        let [mut low, mut high] = [[*rows.first()?; 4]; 2];
        for four in fours {
            for (row, (low, high)) in four.iter().zip(low.iter_mut().zip(&mut high)) {
                for k in 0..N {
                    low[k] = if row[k] < low[k] { row[k] } else { low[k] };
                    high[k] = if row[k] > high[k] { row[k] } else { high[k] };
                }
            }
        }
        let lanes = low.into_iter().zip(high).chain(rest.iter().map(|&row| (row, row)));
        lanes.map(|rows| <[_; 2]>::from(rows).map(|row| [row[0], row[1], row[2]])).reduce(joined_bounds)
    };
    if rows.len() <= ROWS { of(rows) } else { rows.par_chunks(ROWS).filter_map(of).reduce_with(joined_bounds) }
}

/// Converts a position to a row.
#[inline]
#[must_use]
pub(crate) fn position_row(step: Step, position: [f32; 3]) -> [i16; 4] {
    let [x, y, z] = step.position(position);
    [x, y, z, 0]
}

/// Converts a unit normal or zero to a row.
#[inline]
#[must_use]
pub(crate) fn normal_row(normal: [f32; 3]) -> [i8; 4] {
    let [x, y, z] = quantize::normal(normal);
    [x, y, z, 0]
}

impl Mesh {
    /// Number of vertices.
    #[must_use]
    pub fn n_vertices(&self) -> usize {
        self.quantized.as_ref().map_or(self.positions.len(), |quantized| quantized.positions.len())
    }

    /// Number of triangles.
    #[must_use]
    pub fn n_triangles(&self) -> usize {
        self.triangles.len()
    }

    /// All vertices, each column in one piece.
    #[must_use]
    pub fn vertices(&self) -> Vertices<'_> {
        match &self.quantized {
            None => Vertices::Single { positions: &self.positions, normals: &self.normals },
            Some(Quantized { step, positions, normals }) => Vertices::Quantized { step: *step, positions, normals },
        }
    }

    /// The position of vertex `i` relative to `centre`, Å.
    ///
    /// # Panics
    /// Panics if there is no such vertex.
    #[must_use]
    pub fn position(&self, i: usize) -> [f32; 3] {
        self.relative_positions()(i)
    }

    /// Returns [`Self::position`] as a function that borrows the columns once, for loops over many vertices.
    pub(crate) fn relative_positions(&self) -> impl Fn(usize) -> [f32; 3] + Sync {
        let quantized = self.quantized.as_ref().map(|quantized| (quantized.step, &quantized.positions[..]));
        let positions = &self.positions[..];
        move |i| match quantized {
            None => positions[i],
            Some((step, rows)) => {
                let [x, y, z, _] = rows[i];
                step.decoded([x, y, z])
            }
        }
    }

    /// Lowest and highest relative position per axis; zeros for an empty mesh.
    #[must_use]
    pub fn bounds(&self) -> [[f32; 3]; 2] {
        match &self.quantized {
            Some(quantized) => quantized.bounds().unwrap_or_default().map(|row| quantized.step.decoded(row)),
            None => self.positions.pieces().filter_map(bounds_of).reduce(joined_bounds).unwrap_or_default(),
        }
    }

    /// Rounds the vertices to integers. A mesh that already has this step is unchanged. Returns true if the mesh
    /// changed.
    pub fn quantize(&mut self, step: Step) -> bool {
        if self.quantized.as_ref().is_some_and(|quantized| quantized.step == step) {
            return false;
        }
        let mut rounded = Quantized::zeroed(step, self.n_vertices());
        {
            let position = self.relative_positions();
            rounded.positions.par_chunks_mut(ROWS).enumerate().for_each(|(chunk, out)| {
                out.iter_mut().zip(chunk * ROWS..).for_each(|(out, i)| *out = position_row(step, position(i)));
            });
        }
        if let Some(quantized) = self.quantized.take() {
            // Another step: normals have none.
            rounded.normals = quantized.normals;
        } else {
            let normals = rounded.normals.par_chunks_mut(ROWS).zip(self.normals.par_chunks(ROWS));
            normals.for_each(|(out, normals)| {
                out.iter_mut().zip(normals).for_each(|(out, normal)| *out = normal_row(*normal));
            });
        }
        (self.positions, self.normals) = (Column::default(), Column::default());
        self.quantized = Some(rounded);
        true
    }

    /// Makes positions and triangles contiguous, as measuring needs random access to them.
    pub fn make_geometry_contiguous(&mut self) {
        self.positions.make_contiguous();
        self.triangles.make_contiguous();
        if let Some(quantized) = &mut self.quantized {
            quantized.positions.make_contiguous();
        }
    }

    /// Makes positions, normals and triangles contiguous.
    pub fn make_contiguous(&mut self) {
        self.make_geometry_contiguous();
        self.normals.make_contiguous();
        if let Some(quantized) = &mut self.quantized {
            quantized.normals.make_contiguous();
        }
    }

    /// Adds the rows of `next` without a copy. Its triangles already refer to the joined vertices. The mesh takes the
    /// centre of `next` and, if it is empty, its representation.
    pub fn append(&mut self, next: Self) {
        self.centre = next.centre;
        self.positions.append(next.positions);
        self.normals.append(next.normals);
        self.triangles.append(next.triangles);
        match (&mut self.quantized, next.quantized) {
            (Some(own), Some(next)) => {
                own.positions.append(next.positions);
                own.normals.append(next.normals);
            }
            (own, next) => *own = own.take().or(next),
        }
        match (&mut self.atom_ids, next.atom_ids) {
            (Some(own), Some(next)) => own.append(next),
            (own, next) => *own = own.take().or(next),
        }
    }

    /// Replaces the vertices with those of `rows`, in order. The triangles must already refer to the new ones. All
    /// columns must be contiguous.
    pub fn take_vertices(&mut self, rows: &[u32]) {
        match &mut self.quantized {
            None => {
                self.positions = taken(&self.positions, rows);
                self.normals = taken(&self.normals, rows);
            }
            Some(quantized) => {
                quantized.positions = taken(&quantized.positions, rows);
                quantized.normals = taken(&quantized.normals, rows);
            }
        }
        self.atom_ids = self.atom_ids.take().map(|column| taken(&column, rows));
        self.colors = self.colors.take().map(|column| taken(&column, rows));
    }

    /// Drops the vertices that no triangle uses, and numbers the others in their order. Returns the old numbers of the
    /// vertices that remain. All columns must be contiguous.
    ///
    /// # Errors
    /// [`SurfaceError::Memory`], [`SurfaceError::Cancelled`].
    pub fn drop_unused_vertices(&mut self, control: &Control<'_>) -> Result<Vec<u32>, SurfaceError> {
        /// Triangles between two checks of the cancellation flag: a few milliseconds.
        const PER_CHECK: usize = 1 << 16;
        let _memory = control.reserve(8 * self.n_vertices() as u64)?;
        let mut numbers = vec![0_u32; self.n_vertices()];
        for some in self.triangles.chunks(PER_CHECK) {
            control.check()?;
            some.as_flattened().iter().for_each(|v| numbers[*v as usize] = 1);
        }
        let mut rows = Vec::new();
        for (row, number) in (0..).zip(&mut numbers).filter(|(_, used)| **used == 1) {
            *number = to_u32(rows.len());
            rows.push(row);
        }
        self.triangles.par_chunks_mut(PER_CHECK).try_for_each(|some| {
            control.check()?;
            some.as_flattened_mut().iter_mut().for_each(|v| *v = numbers[*v as usize]);
            Ok::<_, SurfaceError>(())
        })?;
        self.take_vertices(&rows);
        Ok(rows)
    }

    /// Vertices whose normal is zero.
    fn flat_vertices(&self) -> Vec<u32> {
        // Half a unit of a component is far below every unit vector's longest one.
        match &self.quantized {
            None => indices_of(&self.normals, |n: &[f32; 3]| n.iter().all(|c| c.abs() < 0.5)),
            Some(quantized) => indices_of(&quantized.normals, |n: &[i8; 4]| *n == [0; 4]),
        }
    }

    /// Sets every zero normal to the area-weighted mean normal of the vertex's triangles: at a saddle of the density
    /// the gradient vanishes and has no direction.
    pub fn fill_flat_normals(&mut self) {
        let flat: FxHashMap<u32, usize> = self.flat_vertices().into_iter().zip(0..).collect();
        let mut sums = vec![[0.0_f64; 3]; flat.len()];
        for t in &self.triangles {
            for v in t {
                if let Some(&i) = flat.get(v) {
                    sums[i] = add(sums[i], self.face_normal(*t));
                }
            }
        }
        let mut order: Vec<_> = flat.into_iter().collect();
        order.sort_unstable();
        for (v, i) in order {
            // A vertex whose triangles cancel to nothing still needs a unit vector.
            let unit = if length(sums[i]) > 0.0 { unit(sums[i]) } else { [0.0, 0.0, 1.0] }.map(to_f32);
            match &mut self.quantized {
                None => self.normals[v as usize] = unit,
                Some(quantized) => quantized.normals[v as usize] = normal_row(unit),
            }
        }
    }

    /// Twice the area of a triangle times its unit normal, Å².
    #[must_use]
    pub fn face_normal(&self, triangle: [u32; 3]) -> [f64; 3] {
        area_vector(triangle.map(|v| self.position(v as usize).map(f64::from)))
    }

    /// Frees all columns of vertices and triangles. Centre, parts and placements remain.
    pub fn drop_columns(&mut self) {
        let Self { positions, normals, quantized, triangles, atom_ids, colors, .. } = self;
        (*positions, *normals, *triangles) = (Column::default(), Column::default(), Column::default());
        (*quantized, *atom_ids, *colors) = (None, None, None);
    }

    /// Bytes of positions, normals and indices.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        Self::bytes_for(self.n_vertices() as u64, self.n_triangles() as u64, self.quantized.is_some())
    }

    /// Bytes of positions, normals and indices of a mesh with these numbers of vertices and triangles; `u64::MAX` if
    /// there are more.
    #[must_use]
    pub fn bytes_for(n_vertices: u64, n_triangles: u64, quantized: bool) -> u64 {
        let of_vertex = if quantized { 12 } else { 24 };
        n_triangles.saturating_mul(12).saturating_add(n_vertices.saturating_mul(of_vertex))
    }
}

/// Returns the `rows` of a column.
fn taken<T: Pod + Send + Sync>(column: &[T], rows: &[u32]) -> Column<T> {
    let mut taken = Column::zeroed(rows.len());
    let chunks = taken.par_chunks_mut(ROWS).zip(rows.par_chunks(ROWS));
    chunks.for_each(|(out, rows)| out.iter_mut().zip(rows).for_each(|(out, &row)| *out = column[row as usize]));
    taken
}

/// Returns the indices of the rows for which `holds` is true.
fn indices_of<T>(rows: &[T], holds: impl Fn(&T) -> bool) -> Vec<u32> {
    (0_u32..).zip(rows).filter(|(_, row)| holds(row)).map(|(v, _)| v).collect()
}

#[cfg(test)]
#[expect(clippy::float_cmp, reason = "rounded numbers and multiples of powers of two are exact")]
mod tests {
    use super::*;

    /// A fan of triangles around vertex 0, which has no normal, at the height `z`.
    fn fan(z: f32) -> Mesh {
        let rim = [[1.0, 0.0, z], [0.0, 1.0, z], [-1.0, 0.0, z], [0.0, -1.0, z]];
        Mesh {
            positions: std::iter::once([0.0, 0.0, z]).chain(rim).collect(),
            normals: std::iter::once([0.0; 3]).chain([[0.0, 0.6, 0.8]; 4]).collect(),
            triangles: (1..=4).map(|i| [0, i, i % 4 + 1]).collect(),
            ..Mesh::default()
        }
    }

    #[test]
    fn a_mesh_is_rounded_once_and_reports_its_packing() {
        let (mut mesh, step) = (fan(0.3), Step::covering(1.0));
        let single = mesh.clone();
        assert_eq!((mesh.bytes(), mesh.n_vertices()), (5 * 24 + 4 * 12, 5));
        assert!(mesh.quantize(step) && !mesh.quantize(step), "the second time there is nothing to do");
        assert_eq!((mesh.bytes(), mesh.n_vertices()), (5 * 12 + 4 * 12, 5));
        assert!(mesh.positions.is_empty() && mesh.normals.is_empty());
        let half = 0.5 * step.length();
        for (i, position) in single.positions.iter().enumerate() {
            let found = mesh.position(i);
            assert!((0..3).all(|k| (found[k] - position[k]).abs() <= half), "{found:?} {position:?}");
            assert_eq!(found, step.decoded(step.position(*position)));
        }
        assert_eq!(mesh.bounds(), single.bounds().map(|row| step.decoded(step.position(row))));
        // A coarser step rounds the decoded integers.
        let coarse = Step::covering(100.0);
        assert!(mesh.quantize(coarse));
        assert_eq!(mesh.position(1)[0], 1.0, "a multiple of both");
        assert_eq!(mesh.quantized.as_ref().unwrap().normals[1], normal_row([0.0, 0.6, 0.8]));
        assert_eq!(Mesh { quantized: Some(Quantized::zeroed(step, 0)), ..Mesh::default() }.bounds(), [[0.0; 3]; 2]);
    }

    #[test]
    fn bounds_include_every_row_of_every_chunk() {
        let step = Step::covering(1.0);
        for n in [1, 4, 5, 6, 7, 8, ROWS, 2 * ROWS + 3] {
            for row in [0, n / 2, n.saturating_sub(2), n - 1] {
                let mut rows = vec![[1, 2, 3, 0]; n];
                rows[row] = [-7, 9, quantize::BEYOND, 0];
                let cut = n / 3;
                let pieces = vec![Column::from(rows[..cut].to_vec()), Column::from(rows[cut..].to_vec())];
                let quantized = Quantized { positions: Column::from_chunks(pieces), ..Quantized::zeroed(step, 0) };
                let [low, high] = [[-7, 2, quantize::BEYOND], [1, 9, 3]];
                let expected = if n == 1 { [[-7, 9, quantize::BEYOND]; 2] } else { [low, high] };
                assert_eq!(quantized.bounds(), Some(expected), "{row} of {n}");
                let single: Vec<[f32; 3]> = rows.iter().map(|&[x, y, z, _]| [x, y, z].map(f32::from)).collect();
                assert_eq!(bounds_of(&single), Some(expected.map(|row| row.map(f32::from))), "{row} of {n}");
            }
        }
    }

    #[test]
    fn a_vertex_without_a_gradient_gets_the_normal_of_its_triangles_either_way() {
        for quantized in [false, true] {
            let mut mesh = fan(0.25);
            if quantized {
                mesh.quantize(Step::covering(2.0));
            }
            mesh.fill_flat_normals();
            match mesh.vertices() {
                Vertices::Single { normals, .. } => assert_eq!(normals[..2], [[0.0, 0.0, 1.0], [0.0, 0.6, 0.8]]),
                Vertices::Quantized { normals, .. } => {
                    assert_eq!(normals[..2], [[0, 0, 127, 0], normal_row([0.0, 0.6, 0.8])]);
                }
            }
        }
    }
}
