//! Check of a mesh before it is written: rejects meshes that the format cannot hold, and computes the bounds.
//!
//! The whole mesh is checked first, because a file that is partly sent cannot be withdrawn. The columns are read once,
//! in parallel: the mesh of a large structure has hundreds of megabytes.

use molmesh_surface::Mesh;
use rayon::prelude::*;

use super::error::FormatError;
use super::format::Format;

/// Rows per task; smaller meshes are checked on the calling thread.
const CHUNK_ROWS: usize = 1 << 16;

/// Maximum component of a unit vector, with tolerance for rounding.
const MAX_NORMAL: f32 = 1.001;

/// Returns true if the writer requires valid indices: STL looks up vertices, and glTF narrows indices to 16 bits.
fn needs_indices(format: Format, n_vertices: usize) -> bool {
    match format {
        Format::Stl => true,
        Format::Glb | Format::Gltf => u16::try_from(n_vertices).is_ok(),
        Format::Ply | Format::PlyText | Format::Obj | Format::Vtp | Format::Vert | Format::Face | Format::Png => false,
    }
}

/// Lowest and highest position relative to the mesh's centre, per axis, Å.
pub(super) type Bounds = [[f32; 3]; 2];

/// Properties of a valid mesh that the formats need.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Summary {
    /// Bounds; zeros without vertices.
    pub(super) bounds: Bounds,
    /// Largest atom index, if the mesh has atom indices.
    pub(super) max_atom: Option<u32>,
    /// True if a colour is not opaque.
    pub(super) translucent: bool,
    /// True if the mesh is cut open, so that its inside can be seen.
    pub(super) open: bool,
}

/// Checks that all columns have the same length, and that the values that the writer of `format` relies on are finite
/// and in range. Columns that are copied unchanged are not read, nor are positions whose `bounds` are known.
pub(super) fn check(mesh: &Mesh, format: Format, bounds: Option<Bounds>) -> Result<Summary, FormatError> {
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
    if bounds.is_none() {
        // A quantized coordinate out of range or not finite lies beyond the step, which the encoder rejects.
        check_finite("position", &mesh.positions[..])?;
    }
    // Adding zero turns −0 into 0. JSON distinguishes them.
    let bounds = bounds.unwrap_or_else(|| mesh.bounds()).map(|row| row.map(|v| v + 0.0));
    if matches!(format, Format::PlyText | Format::Obj | Format::Vert) {
        // The writer relies on a maximum length of lines.
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
        open: mesh.cut,
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
    check_finite("normal", normals)?;
    let beyond = normals.iter().flatten().find(|v| v.abs() > MAX_NORMAL);
    beyond.map_or(Ok(()), |&value| Err(FormatError::NotUnit { value }))
}

/// Rejects numbers that are not finite.
fn check_finite(column: &'static str, rows: &[[f32; 3]]) -> Result<(), FormatError> {
    let bad = |row: &[f32; 3]| row.iter().any(|v| !v.is_finite());
    let found = match rows.len() {
        0..=CHUNK_ROWS => rows.iter().position(bad),
        _ => rows.par_iter().with_min_len(CHUNK_ROWS).position_first(bad),
    };
    let Some(row) = found else { return Ok(()) };
    let value = rows[row].iter().find(|v| !v.is_finite()).map_or(f64::NAN, |&v| f64::from(v));
    Err(FormatError::NotFinite { column, row: row as u64, value })
}

/// Largest value; `None` without values.
fn maximum(values: &[u32]) -> Option<u32> {
    let of = |chunk: &[u32]| chunk.iter().copied().max();
    if values.len() <= CHUNK_ROWS { of(values) } else { values.par_chunks(CHUNK_ROWS).map(of).max().flatten() }
}

/// Rejects triangles with the index of a vertex that does not exist.
pub(super) fn in_range(triangles: &[[u32; 3]], n_vertices: usize) -> Result<(), FormatError> {
    let beyond = |index: u32| index as usize >= n_vertices;
    if !maximum(triangles.as_flattened()).is_some_and(beyond) {
        return Ok(());
    }
    let first = triangles.iter().enumerate().find_map(|(i, t)| t.iter().find(|&&v| beyond(v)).map(|&v| (i, v)));
    let (triangle, index) = first.unwrap_or_default();
    Err(FormatError::IndexOutOfRange { triangle: triangle as u64, index, vertices: n_vertices as u64 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Step;

    #[test]
    fn non_finite_numbers_are_found_in_any_row() {
        for n in [1, 5, 2 * CHUNK_ROWS + 3] {
            for row in [0, n / 2, n - 1] {
                for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                    let mut rows = vec![[1.0; 3]; n];
                    rows[row][row % 3] = value;
                    match check_finite("normal", &rows) {
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
        let mesh = Mesh { positions: vec![[-0.0; 3]].into(), normals: vec![[0.0, 0.0, 1.0]].into(), ..Mesh::default() };
        for known in [None, Some([[-0.0; 3]; 2])] {
            let found = check(&mesh, Format::Glb, known).unwrap().bounds;
            assert!(found.as_flattened().iter().all(|v| v.is_sign_positive()));
        }
    }

    #[test]
    fn positions_with_known_bounds_are_not_read() {
        let mesh = Mesh {
            positions: vec![[1.0, f32::NAN, 3.0]].into(),
            normals: vec![[0.0, 0.0, 1.0]].into(),
            ..Mesh::default()
        };
        let bounds = [[-1.0; 3], [2.0; 3]];
        for format in [Format::Glb, Format::Obj] {
            assert_eq!(check(&mesh, format, Some(bounds)).map(|summary| summary.bounds), Ok(bounds));
            // Control: without bounds, the number is found.
            assert!(matches!(check(&mesh, format, None), Err(FormatError::NotFinite { column: "position", .. })));
        }
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
        assert!(check(&whole, Format::Glb, None).is_ok());
        let broken = [
            ("normals", Mesh { normals: vec![[0.0; 3]].into(), ..whole.clone() }),
            ("atom_ids", Mesh { atom_ids: Some(vec![1].into()), ..whole.clone() }),
            ("colors", Mesh { colors: Some(vec![[0; 4]; 3].into()), ..whole.clone() }),
        ];
        for (name, mesh) in broken {
            assert!(
                matches!(
                    check(&mesh, Format::Glb, None),
                    Err(FormatError::ColumnLength { column, vertices: 2, .. }) if column == name
                ),
                "{name}"
            );
        }
        let long = Mesh { normals: vec![[0.0, 0.0, 1.5]; 2].into(), ..whole.clone() };
        assert_eq!(check(&long, Format::Obj, None), Err(FormatError::NotUnit { value: 1.5 }));
        assert!(check(&long, Format::Glb, None).is_ok());
        let mut rounded = whole.clone();
        rounded.quantize(Step::covering(1.0));
        assert!(check(&rounded, Format::Glb, None).is_ok());
        if let Some(quantized) = &mut rounded.quantized {
            quantized.normals.edit().pop();
            assert!(matches!(
                check(&rounded, Format::Glb, None),
                Err(FormatError::ColumnLength { column: "normals", .. })
            ));
        }
        let adrift = Mesh { centre: [0.0, f64::NAN, 0.0], ..whole };
        assert!(matches!(
            check(&adrift, Format::Ply, None),
            Err(FormatError::NotFinite { column: "centre", row: 1, .. })
        ));
    }
}
