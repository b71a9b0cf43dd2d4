//! Colours of the vertices of a mesh: those of the nearest atoms, or of properties of the vertices.

use super::super::JobError;
use super::vertex::{self, VertexProperty};
use super::{AtomColors, ColorBlend, ColorReport, Coloring, Palette, Scheme};
use super::{extremes, of_vertices, round, scaled, stops};
use crate::structure::Structure;
use crate::surface::{Control, Mesh, SurfaceError};

/// Memory of a colour, bytes.
const COLOR_BYTES: u64 = 4;

/// Colours of a job, before its mesh exists.
pub(in super::super) struct MeshColors {
    coloring: Coloring,
    source: ColorSource,
}

enum ColorSource {
    /// Colour of each sphere, and the finished report.
    Atoms { of_spheres: Vec<[u8; 4]>, report: ColorReport },
    /// Property of a vertex, and the centroid of the atoms.
    Vertices { property: VertexProperty, centroid: [f64; 3] },
}

impl MeshColors {
    /// Prepares the colours of the `selected` atoms.
    ///
    /// # Errors
    /// Returns [`JobError::Color`] if the file lacks the values of the scheme, and the errors of memory.
    pub(in super::super) fn new(
        structure: &Structure,
        selected: &[u32],
        coloring: Coloring,
        control: &Control<'_>,
    ) -> Result<Self, JobError> {
        let source = if let Scheme::Vertex(property) = coloring.scheme {
            ColorSource::Vertices { property, centroid: centroid(structure, selected) }
        } else {
            control.memory.grow(COLOR_BYTES * selected.len() as u64).map_err(SurfaceError::from)?;
            let colors = AtomColors::new(structure, selected, &coloring)?;
            let of_spheres = selected.iter().map(|&i| colors.of(i as usize)).collect();
            ColorSource::Atoms { of_spheres, report: colors.report(selected) }
        };
        Ok(Self { coloring, source })
    }

    /// Sets the colours of the vertices. `resolution` is the grid spacing, Å. Returns the report.
    ///
    /// # Errors
    /// Returns the errors of memory and cancellation.
    pub(in super::super) fn apply(
        self,
        mesh: &mut Mesh,
        resolution: f64,
        control: &Control<'_>,
    ) -> Result<ColorReport, SurfaceError> {
        control.check()?;
        control.memory.grow(COLOR_BYTES * mesh.n_vertices() as u64)?;
        let Coloring { scheme, palette, range, blend } = self.coloring;
        if matches!(scheme, Scheme::Vertex(_)) || blend == ColorBlend::Smooth {
            mesh.make_geometry_contiguous();
        }
        let (mut colors, mut report) = match self.source {
            ColorSource::Atoms { of_spheres, report } => {
                (mesh.atom_ids.as_deref().map(|ids| of_vertices(ids, |id| of_spheres[id as usize])), report)
            }
            ColorSource::Vertices { property, centroid } => {
                let values = vertex::values(mesh, property, centroid, control)?;
                let palette = palette.or(scheme.palette()).unwrap_or(Palette::Viridis);
                let of_values = || extremes(values.iter().copied()).map(round);
                let range = range.or(scheme.range()).unwrap_or_else(of_values);
                let color = |value: f32| {
                    let [_, r, g, b] = scaled(palette, range, f64::from(value)).to_be_bytes();
                    [r, g, b, u8::MAX]
                };
                let report = ColorReport {
                    scheme: scheme.to_string(),
                    palette: Some(palette.name()),
                    range: Some(range),
                    blend: None,
                    source: None,
                    legend: stops(palette, range),
                };
                (Some(of_vertices(&values, color)), report)
            }
        };
        if let Some(colors) = colors.as_mut().filter(|_| blend == ColorBlend::Smooth) {
            vertex::blend(colors, &mesh.triangles, resolution, control)?;
            report.blend = Some(blend.name());
        }
        mesh.colors = colors;
        Ok(report)
    }
}

/// Returns the mean position of the `selected` atoms, Å.
fn centroid(structure: &Structure, selected: &[u32]) -> [f64; 3] {
    [&structure.x, &structure.y, &structure.z]
        .map(|column| selected.iter().map(|&i| column[i as usize]).sum::<f64>() / selected.len().max(1) as f64)
}
