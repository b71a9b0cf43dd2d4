//! A mesh from what arrived: in place where it came in one piece, else joined.

use bytemuck::Pod;
use rayon::prelude::*;

use super::flight::{Arrived, values};
use crate::surface::{Column, Mesh};

/// Rows that one task copies.
const ROWS: usize = 1 << 18;

/// Joins the parts of a mesh, which are in order; vertices and triangles may come in different parts. Positions are
/// relative to `centre`.
///
/// # Errors
/// In words, where a part is not where it should be.
pub(super) fn mesh(
    vertices: &[Arrived],
    triangles: &[Arrived],
    centre: [f64; 3],
    nearest: bool,
    parts: Vec<(usize, usize)>,
) -> Result<Mesh, String> {
    let of_vertices = |place: fn(&Arrived) -> u64| move |a: &Arrived| (place(a), a.n_vertices);
    Ok(Mesh {
        centre,
        positions: column(vertices, of_vertices(|a| a.places.positions))?,
        normals: column(vertices, of_vertices(|a| a.places.normals))?,
        triangles: column(triangles, |a| (a.places.triangles, a.n_triangles))?,
        atom_ids: if nearest { Some(column(vertices, of_vertices(|a| a.places.sources))?) } else { None },
        colors: None,
        parts,
    })
}

/// One column; `place` tells a part's offset and rows.
fn column<T: Pod + Send + Sync>(
    parts: &[Arrived],
    place: impl Fn(&Arrived) -> (u64, u64),
) -> Result<Column<T>, String> {
    if let [only] = parts {
        let (offset, n) = place(only);
        let from = usize::try_from(offset).map_err(|e| e.to_string())?;
        let bytes = usize::try_from(n).map_err(|e| e.to_string())? * size_of::<T>();
        return Column::foreign(only.landing.clone(), from..from + bytes)
            .ok_or_else(|| format!("{bytes} bytes at {from} are no column"));
    }
    let sources: Vec<&[T]> = parts
        .iter()
        .map(|part| {
            let (offset, n) = place(part);
            values((*part.landing).as_ref(), offset, n)
        })
        .collect::<Result<_, _>>()?;
    let mut column = Column::zeroed(sources.iter().map(|s| s.len()).sum());
    let mut rest = &mut column[..];
    let mut copies = Vec::new();
    for source in sources {
        let (target, tail) = std::mem::take(&mut rest).split_at_mut(source.len());
        copies.extend(target.chunks_mut(ROWS).zip(source.chunks(ROWS)));
        rest = tail;
    }
    copies.into_par_iter().for_each(|(target, source)| target.copy_from_slice(source));
    Ok(column)
}
