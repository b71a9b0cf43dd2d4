//! Checks a mesh before it is written: rejects meshes that no format can hold, and computes the bounds.
//!
//! The columns are read once, in chunks on rayon's pool: the mesh of a large structure has hundreds of megabytes, and a
//! file cannot be withdrawn halfway.

use rayon::prelude::*;

use super::error::FormatError;
use super::format::Format;
use crate::surface::Mesh;

/// Rows per task; smaller meshes are checked on the calling thread.
const CHUNK_ROWS: usize = 1 << 16;

/// Maximum component of a unit vector, with tolerance for rounding.
const MAX_NORMAL: f32 = 1.001;

/// Returns true if the writer requires valid indices: STL looks up vertices, and glTF narrows indices to 16 bits.
fn needs_indices(format: Format, n_vertices: usize) -> bool {
    match format {
        Format::Stl => true,
        Format::Glb | Format::Gltf => u16::try_from(n_vertices).is_ok(),
        Format::Ply | Format::PlyText | Format::Obj | Format::Png => false,
    }
}

/// Properties of a valid mesh that the formats need.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Summary {
    /// Lowest and highest relative position per axis, Å; zeros without vertices.
    pub(super) bounds: [[f32; 3]; 2],
    /// Largest atom index, if the mesh has atom indices.
    pub(super) max_atom: Option<u32>,
    /// True if a colour is not opaque.
    pub(super) translucent: bool,
}

/// Checks that all columns have the same length, and that the values that the writer of `format` relies on are finite
/// and in range. Columns that are copied unchanged are not read.
pub(super) fn check(mesh: &Mesh, format: Format) -> Result<Summary, FormatError> {
    let n = mesh.n_vertices();
    let n_normals = mesh.quantized.as_ref().map_or(mesh.normals.len(), |quantized| quantized.normals.len());
    let lengths = [
        ("normals", Some(n_normals)),
        ("atom_ids", mesh.atom_ids.as_ref().map(|c| c[..].len())),
        ("colors", mesh.colors.as_ref().map(|c| c[..].len())),
    ];
    for (column, len) in lengths {
        if let Some(len) = len.filter(|&len| len != n) {
            return Err(FormatError::ColumnLength { column, len: len as u64, vertices: n as u64 });
        }
    }
    if let Some((axis, &value)) = mesh.centre.iter().enumerate().find(|(_, v)| !v.is_finite()) {
        return Err(FormatError::NotFinite { column: "centre", row: axis as u64, value });
    }
    let bounds = match &mesh.quantized {
        // A coordinate out of range or not finite lies beyond the step, which the encoder rejects.
        Some(_) => mesh.bounds().map(|row| row.map(|v| v + 0.0)),
        None => extent("position", &mesh.positions[..])?.unwrap_or_default(),
    };
    if matches!(format, Format::PlyText | Format::Obj) {
        // The writer relies on a bounded length of lines.
        check_normals(&mesh.normals[..])?;
    }
    if needs_indices(format, n) {
        in_range(&mesh.triangles[..], n)?;
    }
    check_parts(mesh, n)?;
    Ok(Summary {
        bounds,
        max_atom: mesh.atom_ids.as_ref().map(|ids| maximum(&ids[..]).unwrap_or(0)),
        translucent: mesh.colors.as_ref().is_some_and(|colors| colors.iter().any(|c| c[3] != u8::MAX)),
    })
}

/// Rejects parts that do not cover the mesh in order and parts whose triangles refer to vertices of other parts.
fn check_parts(mesh: &Mesh, n_vertices: usize) -> Result<(), FormatError> {
    let mut end = [0, 0];
    for part in &mesh.parts {
        let (vertices, triangles) = (&part.vertices, &part.triangles);
        let follows = [vertices.start, triangles.start] == end;
        end = [vertices.end, triangles.end];
        let own = |index: &u32| vertices.contains(&(*index as usize));
        let is_own = |rows: &[[u32; 3]]| rows.par_iter().with_min_len(CHUNK_ROWS).all(|row| row.iter().all(own));
        if !follows || !mesh.triangles.get(triangles.clone()).is_some_and(is_own) {
            return Err(FormatError::BadPart { part: part.name.clone() });
        }
    }
    if mesh.parts.is_empty() || end == [n_vertices, mesh.triangles.len()] {
        return Ok(());
    }
    Err(FormatError::BadPart { part: mesh.parts.last().map(|part| part.name.clone()).unwrap_or_default() })
}

/// Rejects normals that are longer than unit vectors.
fn check_normals(normals: &[[f32; 3]]) -> Result<(), FormatError> {
    let longest = extent("normal", normals)?.unwrap_or_default();
    let beyond = longest.as_flattened().iter().find(|v| v.abs() > MAX_NORMAL);
    beyond.map_or(Ok(()), |&value| Err(FormatError::NotUnit { value }))
}

/// Returns the lowest and highest value per axis; `None` without rows. Rejects numbers that are not finite.
fn extent(column: &'static str, rows: &[[f32; 3]]) -> Result<Option<[[f32; 3]; 2]>, FormatError> {
    let join = |a: Extent, b: Extent| a.join(&b);
    let all = if rows.len() <= CHUNK_ROWS {
        Extent::of(rows)
    } else {
        rows.par_chunks(CHUNK_ROWS).map(Extent::of).reduce(Extent::default, join)
    };
    if all.poison.iter().any(|p| p.is_nan()) {
        let found = rows.iter().enumerate().find_map(|(i, r)| r.iter().find(|v| !v.is_finite()).map(|&v| (i, v)));
        let (row, value) = found.unwrap_or((0, f32::NAN));
        return Err(FormatError::NotFinite { column, row: row as u64, value: f64::from(value) });
    }
    // Adding zero turns −0 into 0; JSON would distinguish them.
    Ok((!rows.is_empty()).then(|| [all.low.map(|v| v + 0.0), all.high.map(|v| v + 0.0)]))
}

/// Running extremes of three axes. `poison` is NaN as soon as one value is not finite, because 0 · ∞ and 0 · NaN are
/// NaN.
#[derive(Debug, Clone, Copy)]
struct Extent {
    low: [f32; 3],
    high: [f32; 3],
    poison: [f32; 3],
}

impl Default for Extent {
    fn default() -> Self {
        Self { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3], poison: [0.0; 3] }
    }
}

impl Extent {
    /// Reads four rows at a time: twelve lanes are three vectors, with each axis always in the same lanes.
    fn of(rows: &[[f32; 3]]) -> Self {
        let (quads, rest) = rows.as_chunks::<4>();
        let (mut low, mut high, mut poison) = ([f32::INFINITY; 12], [f32::NEG_INFINITY; 12], [0.0_f32; 12]);
        for quad in quads {
            let quad: &[f32; 12] = bytemuck::must_cast_ref(quad);
            for k in 0..12 {
                let v = quad[k];
                low[k] = if v < low[k] { v } else { low[k] };
                high[k] = if v > high[k] { v } else { high[k] };
                poison[k] += v * 0.0;
            }
        }
        let lanes = (0..4).map(|q| Self {
            low: std::array::from_fn(|k| low[3 * q + k]),
            high: std::array::from_fn(|k| high[3 * q + k]),
            poison: std::array::from_fn(|k| poison[3 * q + k]),
        });
        let rest = rest.iter().map(|&r| Self { low: r, high: r, poison: r.map(|v| v * 0.0) });
        lanes.chain(rest).fold(Self::default(), |a, b| a.join(&b))
    }

    fn join(&self, other: &Self) -> Self {
        Self {
            low: std::array::from_fn(|k| if other.low[k] < self.low[k] { other.low[k] } else { self.low[k] }),
            high: std::array::from_fn(|k| if other.high[k] > self.high[k] { other.high[k] } else { self.high[k] }),
            poison: std::array::from_fn(|k| self.poison[k] + other.poison[k]),
        }
    }
}

/// Largest value; `None` without values.
fn maximum(values: &[u32]) -> Option<u32> {
    let of = |chunk: &[u32]| chunk.iter().copied().max();
    if values.len() <= CHUNK_ROWS { of(values) } else { values.par_chunks(CHUNK_ROWS).map(of).max().flatten() }
}

/// Rejects triangles with the index of a vertex that does not exist.
fn in_range(triangles: &[[u32; 3]], n_vertices: usize) -> Result<(), FormatError> {
    let beyond = |index: u32| index as usize >= n_vertices;
    if !maximum(triangles.as_flattened()).is_some_and(beyond) {
        return Ok(());
    }
    let first = triangles.iter().enumerate().find_map(|(i, t)| t.iter().find(|&&v| beyond(v)).map(|&v| (i, v)));
    let (triangle, index) = first.unwrap_or_default();
    Err(FormatError::IndexOutOfRange { triangle: triangle as u64, index, vertices: n_vertices as u64 })
}

#[cfg(test)]
#[expect(clippy::cast_precision_loss, reason = "small integers are exact")]
mod tests {
    use super::*;
    use crate::formats::Step;

    /// Rows with known extremes: a ramp with one low and one high outlier.
    fn rows(n: usize) -> Vec<[f32; 3]> {
        let mut rows: Vec<[f32; 3]> = (0..n).map(|i| [i as f32, -(i as f32), 0.5]).collect();
        rows[n / 3][2] = -7.0;
        rows[2 * n / 3][2] = 9.0;
        rows
    }

    #[test]
    fn extent_is_exact_for_every_remainder_and_beyond_one_chunk() {
        for n in [3, 4, 5, 6, 7, 8, 101, CHUNK_ROWS, CHUNK_ROWS + 1, 3 * CHUNK_ROWS + 2] {
            let high = (n - 1) as f32;
            assert_eq!(extent("position", &rows(n)), Ok(Some([[0.0, -high, -7.0], [high, 0.0, 9.0]])), "{n}");
        }
        assert_eq!(extent("position", &[]), Ok(None));
    }

    #[test]
    fn non_finite_numbers_are_found_in_any_row() {
        for n in [1, 5, 2 * CHUNK_ROWS + 3] {
            for row in [0, n / 2, n - 1] {
                for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                    let mut rows = vec![[1.0; 3]; n];
                    rows[row][row % 3] = value;
                    match extent("normal", &rows) {
                        Err(FormatError::NotFinite { column: "normal", row: found, .. }) => {
                            assert_eq!(found, row as u64);
                        }
                        other => panic!("{value} in row {row} of {n}: {other:?}"),
                    }
                }
            }
        }
    }

    #[test]
    fn bounds_have_no_negative_zero() {
        let found = extent("position", &[[-0.0; 3]]).unwrap().unwrap();
        assert!(found.as_flattened().iter().all(|v| v.is_sign_positive()));
    }

    #[test]
    fn indices_are_checked_to_the_last_one() {
        let mut triangles = vec![[0, 1, 2]; CHUNK_ROWS + 7];
        assert_eq!(in_range(&triangles, 3), Ok(()));
        *triangles.last_mut().unwrap() = [0, 3, 2];
        let triangle = triangles.len() as u64 - 1;
        assert_eq!(in_range(&triangles, 3), Err(FormatError::IndexOutOfRange { triangle, index: 3, vertices: 3 }));
        assert_eq!(in_range(&[], 0), Ok(()));
    }

    #[test]
    fn columns_of_different_lengths_are_rejected() {
        let whole =
            Mesh { positions: vec![[0.0; 3]; 2].into(), normals: vec![[0.0, 0.0, 1.0]; 2].into(), ..Mesh::default() };
        assert!(check(&whole, Format::Glb).is_ok());
        let broken = [
            ("normals", Mesh { normals: vec![[0.0; 3]].into(), ..whole.clone() }),
            ("atom_ids", Mesh { atom_ids: Some(vec![1].into()), ..whole.clone() }),
            ("colors", Mesh { colors: Some(vec![[0; 4]; 3].into()), ..whole.clone() }),
        ];
        for (name, mesh) in broken {
            assert!(
                matches!(
                    check(&mesh, Format::Glb),
                    Err(FormatError::ColumnLength { column, vertices: 2, .. }) if column == name
                ),
                "{name}"
            );
        }
        let long = Mesh { normals: vec![[0.0, 0.0, 1.5]; 2].into(), ..whole.clone() };
        assert_eq!(check(&long, Format::Obj), Err(FormatError::NotUnit { value: 1.5 }));
        assert!(check(&long, Format::Glb).is_ok());
        let mut rounded = whole.clone();
        rounded.quantize(Step::covering(1.0));
        assert!(check(&rounded, Format::Glb).is_ok());
        if let Some(quantized) = &mut rounded.quantized {
            quantized.normals.edit().pop();
            assert!(matches!(check(&rounded, Format::Glb), Err(FormatError::ColumnLength { column: "normals", .. })));
        }
        let adrift = Mesh { centre: [0.0, f64::NAN, 0.0], ..whole };
        assert!(matches!(check(&adrift, Format::Ply), Err(FormatError::NotFinite { column: "centre", row: 1, .. })));
    }
}
