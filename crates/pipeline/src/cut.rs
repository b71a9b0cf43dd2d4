//! Cuts a finished surface into parts. With `context=whole`, only the triangles of the selected atoms remain.
//!
//! A triangle belongs to the part to which two or three of its vertices belong. A vertex belongs to the part of its
//! nearest atom (that of `_ATOM`), or with `split=pocket` to the pocket that it lines. A vertex on the border of
//! several parts is stored in each of them.

use molmesh_structure::{AtomPart, Selected};
use molmesh_surface::cpu::scan;
use molmesh_surface::vector::joined_bounds;
use molmesh_surface::{
    Column, Component, Control, Measures, Mesh, MeshOutput, PartRange, Pockets, Stage, SurfaceError, SurfaceLimits,
    SurfaceParams, Validation,
};
use rayon::prelude::*;

use super::pockets::lined_by;

/// Rows per task, and triangles between two checks for cancellation.
const ROWS: usize = 1 << 16;
/// Marker: part of an atom or triangle that is not selected, and number of a vertex that has none yet.
const NONE: u32 = u32::MAX;

/// Rule that assigns vertices to parts.
enum Rule<'a> {
    /// Part of each sphere, or [`NONE`].
    NearestAtom(Vec<u32>),
    /// Pocket that the vertex lines. The last part has the vertices that line none.
    Pocket(&'a Pockets),
}

/// Division of a surface by the parts of its vertices.
pub(super) struct Cut<'a> {
    rule: Rule<'a>,
    /// Names of the parts; empty for a mesh without parts.
    names: Vec<String>,
    /// Validation of a surface from which the cut removes nothing.
    validation: Validation,
}

impl<'a> Cut<'a> {
    /// Returns the division into `parts`, or without parts into one part of all selected atoms. With `pockets`, `parts`
    /// are these pockets. Returns `None` if the surface is not cut: without pockets and without
    /// [`Context::Whole`](molmesh_structure::Context::Whole).
    ///
    /// # Errors
    /// Returns the errors of memory.
    pub(super) fn of(
        selected: &Selected,
        parts: Option<&[AtomPart]>,
        pockets: Option<&'a Pockets>,
        validation: Validation,
        control: &Control<'_>,
    ) -> Result<Option<Self>, SurfaceError> {
        let names = parts.unwrap_or_default().iter().map(|part| part.name.clone()).collect();
        if let Some(pockets) = pockets {
            return Ok(Some(Self { rule: Rule::Pocket(pockets), names, validation }));
        }
        if selected.marks.is_none() {
            return Ok(None);
        }
        let n = selected.atoms.len();
        control.memory.grow((size_of::<u32>() * n) as u64)?;
        let part_of = match parts {
            None => selected.atoms.iter().map(|&i| if selected.has(i) { 0 } else { NONE }).collect(),
            Some(parts) => {
                let mut part_of = vec![NONE; n];
                for (number, part) in (0..).zip(parts) {
                    part.rows.iter().for_each(|&row| part_of[row as usize] = number);
                }
                part_of
            }
        };
        Ok(Some(Self { rule: Rule::NearestAtom(part_of), names, validation }))
    }

    /// Returns true if the mesh needs atom indices.
    pub(super) const fn needs_atom_ids(&self) -> bool {
        matches!(self.rule, Rule::NearestAtom(_))
    }

    /// Returns the area of the triangles that remain, Å². `mesh` has atom indices if the cut needs them.
    pub(super) fn area(&self, mesh: &Mesh) -> f64 {
        let of_vertices = self.parts_of_vertices(mesh);
        let of_chunk = |chunk: &[[u32; 3]]| {
            let kept = chunk.iter().filter(|triangle| part(**triangle, &of_vertices) != NONE);
            kept.map(|triangle| area_of(mesh, *triangle)).sum::<f64>()
        };
        ordered_sum(&mesh.triangles, of_chunk)
    }

    /// Returns the part of each vertex. The result is empty if the mesh lacks atom indices that the cut needs.
    fn parts_of_vertices(&self, mesh: &Mesh) -> Vec<u32> {
        match &self.rule {
            Rule::NearestAtom(part_of) => {
                let ids = mesh.atom_ids.as_deref().unwrap_or_default();
                ids.par_iter().with_min_len(ROWS).map(|id| part_of[*id as usize]).collect()
            }
            Rule::Pocket(pockets) => {
                let rest = u32::try_from(pockets.list.len()).unwrap_or(NONE);
                lined_by(mesh, pockets).map(|pocket| pocket.unwrap_or(rest)).collect()
            }
        }
    }

    /// Cuts the mesh of `whole`, which has atom indices if the cut needs them. `params` are those of the result, whose
    /// memory is added to the meter of `control`.
    ///
    /// # Errors
    /// Returns [`SurfaceError::NoPatch`] if no triangle remains, [`SurfaceError::Limit`], and the errors of memory and
    /// cancellation.
    pub(super) fn apply(
        &self,
        mut whole: MeshOutput,
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<MeshOutput, SurfaceError> {
        let was_closed = whole.measure(control)?.closed;
        let mesh = &mut whole.mesh;
        mesh.make_contiguous();
        let _parts = control.reserve(4 * (mesh.n_triangles() + mesh.n_vertices()) as u64)?;
        let parts = control.span(Stage::Emit, || self.parts_of_triangles(mesh))?;
        control.check()?;
        let n_kept = parts.iter().filter(|part| **part != NONE).count();
        let is_whole = n_kept == parts.len();
        if n_kept == 0 {
            return Err(SurfaceError::NoPatch);
        }
        if is_whole && self.names.is_empty() {
            control.memory.grow(mesh.bytes() + 4 * mesh.n_vertices() as u64)?;
            return whole.validated(self.validation, control);
        }
        let mut measures = match whole.measures.take() {
            Some(measures) if is_whole => Some(measures.validated(self.validation, &mesh.triangles, control)?),
            _ => None,
        };
        control.memory.grow(12 * n_kept as u64)?;
        let ranges = control.span(Stage::Emit, || self.group(mesh, &parts, n_kept));
        drop(parts);
        if measures.is_none() {
            // The checksum would not tell the boundary of the cut from a defect.
            let exact = control.span(Stage::Measure, || Measures::of(mesh, Validation::Exact, control));
            measures = Some(exact?);
        }
        let is_closed = measures.as_ref().is_some_and(|measures| measures.closed);
        self.renumber(mesh, &ranges, params, limits, control)?;
        mesh.cut = was_closed && !(is_closed && self.names.is_empty());
        let bounds = Some(mesh.bounds());
        Ok(MeshOutput { measures, bounds, ..whole })
    }

    /// Returns the part of each triangle.
    fn parts_of_triangles(&self, mesh: &Mesh) -> Result<Vec<u32>, SurfaceError> {
        if self.needs_atom_ids() && mesh.atom_ids.is_none() {
            return Err(SurfaceError::Device { why: "the mesh has no atom indices".into() });
        }
        let of_vertices = self.parts_of_vertices(mesh);
        Ok(mesh.triangles.par_iter().with_min_len(ROWS).map(|triangle| part(*triangle, &of_vertices)).collect())
    }

    /// Keeps the triangles that belong to a part, ordered by part. Returns the rows of each part's triangles.
    fn group(&self, mesh: &mut Mesh, parts: &[u32], n_kept: usize) -> Vec<std::ops::Range<usize>> {
        let mut ends = vec![0; self.names.len().max(1)];
        parts.iter().filter(|part| **part != NONE).for_each(|part| ends[*part as usize] += 1);
        let mut next = 0;
        for end in &mut ends {
            next += std::mem::replace(end, next);
        }
        let mut grouped = Column::zeroed(n_kept);
        for (triangle, part) in mesh.triangles.iter().zip(parts).filter(|(_, part)| **part != NONE) {
            let end: &mut usize = &mut ends[*part as usize];
            grouped[*end] = *triangle;
            *end += 1;
        }
        mesh.triangles = grouped;
        let starts = std::iter::once(0).chain(ends.iter().copied());
        starts.zip(&ends).map(|(start, end)| start..*end).collect()
    }

    /// Numbers the vertices of each part in order of their first triangles, drops the others and records the parts.
    fn renumber(
        &self,
        mesh: &mut Mesh,
        ranges: &[std::ops::Range<usize>],
        params: &SurfaceParams,
        limits: &SurfaceLimits,
        control: &Control<'_>,
    ) -> Result<(), SurfaceError> {
        let (n_vertices, n_triangles) = (mesh.n_vertices(), mesh.n_triangles());
        // Parts share few vertices, but a part of single triangles may have three for each.
        let most = if self.names.is_empty() { n_vertices.min(3 * n_triangles) } else { 3 * n_triangles };
        let _numbers = control.reserve(4 * (n_vertices + most) as u64)?;
        let mut numbers = vec![NONE; n_vertices];
        let mut rows: Vec<u32> = Vec::new();
        let mut vertices = Vec::with_capacity(ranges.len());
        for range in ranges {
            let first = rows.len();
            for chunk in mesh.triangles[range.clone()].chunks_mut(ROWS) {
                control.check()?;
                for vertex in chunk.as_flattened_mut() {
                    let number = &mut numbers[*vertex as usize];
                    // Numbers of earlier parts are lower.
                    if *number == NONE || (*number as usize) < first {
                        *number = u32::try_from(rows.len()).unwrap_or(NONE);
                        rows.push(*vertex);
                    }
                    *vertex = *number;
                }
            }
            vertices.push(first..rows.len());
        }
        scan::check_size(params, limits, rows.len() as u64, n_triangles as u64)?;
        let bytes = Mesh::bytes_for(rows.len() as u64, 0, mesh.quantized.is_some());
        control.memory.grow(bytes + 4 * rows.len() as u64)?;
        mesh.take_vertices(&rows);
        let parts = self.names.iter().zip(vertices).zip(ranges).map(|((name, vertices), triangles)| PartRange {
            name: name.clone(),
            area: ordered_sum(&mesh.triangles[triangles.clone()], |chunk| {
                chunk.iter().map(|triangle| area_of(mesh, *triangle)).sum()
            }),
            volume: None,
            bounds: bounds_of(mesh, vertices.clone()),
            vertices,
            triangles: triangles.clone(),
            placements: 0..0,
        });
        mesh.parts = parts.collect();
        Ok(())
    }
}

/// Returns the part of a triangle.
fn part(triangle: [u32; 3], of_vertices: &[u32]) -> u32 {
    owner(triangle.map(|v| of_vertices[v as usize]))
}

/// Returns the part of a triangle whose vertices belong to these parts: that of two vertices. If all three differ, the
/// lowest one, unless two vertices are not selected.
fn owner([a, b, c]: [u32; 3]) -> u32 {
    if a == b || a == c {
        a
    } else if b == c {
        b
    } else {
        a.min(b).min(c)
    }
}

/// Returns the area of a triangle, Å².
fn area_of(mesh: &Mesh, triangle: [u32; 3]) -> f64 {
    let mut one = Component::default();
    one.add(triangle.map(|v| mesh.position(v as usize).map(f64::from)));
    one.area
}

/// Returns the sum over all chunks, which does not depend on the number of threads.
fn ordered_sum(triangles: &[[u32; 3]], of_chunk: impl Fn(&[[u32; 3]]) -> f64 + Send + Sync) -> f64 {
    let sums: Vec<f64> = triangles.par_chunks(ROWS).map(of_chunk).collect();
    sums.iter().sum()
}

/// Returns the lowest and highest position of the vertices, per axis; zeros without vertices.
fn bounds_of(mesh: &Mesh, vertices: std::ops::Range<usize>) -> [[f32; 3]; 2] {
    let bounds = vertices.into_par_iter().with_min_len(ROWS).map(|v| [mesh.position(v); 2]);
    bounds.reduce_with(joined_bounds).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_vertices_decide_and_the_order_of_vertices_does_not() {
        for (parts, expected) in [
            ([4, 4, 4], 4),
            ([4, 4, 1], 4),
            ([4, 4, NONE], 4),
            ([4, NONE, NONE], NONE),
            ([NONE, NONE, NONE], NONE),
            // Two vertices are selected, but belong to different parts.
            ([4, 2, NONE], 2),
            ([4, 2, 3], 2),
        ] {
            for [i, j, k] in [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]] {
                assert_eq!(owner([parts[i], parts[j], parts[k]]), expected, "{parts:?}");
            }
        }
    }
}
