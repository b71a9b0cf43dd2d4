//! A mesh from what arrived, where it arrived: its columns are not copied, in however many pieces they came.

use bytemuck::Pod;

use super::flight::Arrived;
use crate::surface::{Column, Mesh, Quantized, SurfaceParams};

/// A mesh of its parts, which are in order; vertices and triangles may come in different parts. Positions are
/// relative to `centre`, in the layout that `params` ask for.
///
/// # Errors
/// In words, where a part is not where it should be.
pub(super) fn mesh(
    vertices: &[Arrived],
    triangles: &[Arrived],
    centre: [f64; 3],
    params: &SurfaceParams,
    parts: Vec<(usize, usize)>,
) -> Result<Mesh, String> {
    let of_vertices = |place: fn(&Arrived) -> u64| move |a: &Arrived| (place(a), a.n_vertices);
    let (positions, normals) = (of_vertices(|a| a.places.positions), of_vertices(|a| a.places.normals));
    let mut mesh = Mesh {
        centre,
        triangles: column(triangles, |a| (a.places.triangles, a.n_triangles))?,
        atom_ids: params.atom_ids.then(|| column(vertices, of_vertices(|a| a.places.sources))).transpose()?,
        parts,
        ..Mesh::default()
    };
    if let Some(step) = params.quantize {
        let (positions, normals) = (column(vertices, positions)?, column(vertices, normals)?);
        mesh.quantized = Some(Quantized { step, positions, normals });
    } else {
        (mesh.positions, mesh.normals) = (column(vertices, positions)?, column(vertices, normals)?);
    }
    Ok(mesh)
}

/// One column; `place` tells a part's offset and rows.
fn column<T: Pod>(parts: &[Arrived], place: impl Fn(&Arrived) -> (u64, u64)) -> Result<Column<T>, String> {
    let piece = |part: &Arrived| {
        let (offset, n) = place(part);
        let from = usize::try_from(offset).map_err(|e| e.to_string())?;
        let bytes = usize::try_from(n).map_err(|e| e.to_string())? * size_of::<T>();
        Column::shared(part.landing.clone(), from..from + bytes)
            .ok_or_else(|| format!("{bytes} bytes at {from} are no column"))
    };
    parts.iter().map(piece).collect::<Result<_, String>>().map(Column::from_chunks)
}
