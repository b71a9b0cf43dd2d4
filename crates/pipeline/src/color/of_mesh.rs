//! Colours of the vertices of a mesh: those of the nearest atoms, or of properties of the vertices.

use molmesh_structure::Structure;
use molmesh_structure::map::Map;
use molmesh_surface::{Column, Control, Mesh, Pockets, SurfaceError};
use rayon::prelude::*;

use super::super::JobError;
use super::super::pockets::lined_by;
use super::of_map::{significant, symmetric_range};
use super::tables::{OTHER, category};
use super::vertex::{self, MeshedSurface, ValueSource, VertexProperty};
use super::{AtomColors, ColorBlend, ColorError, ColorReport, Coloring, MapReport, Palette, Scheme};
use super::{MAX_ENTRIES, entry, extremes, of_vertices, opaque, round, scaled, stops};

/// Memory of a colour, bytes.
const COLOR_BYTES: u64 = 4;
/// Memory of the number of a pocket, bytes.
const INDEX_BYTES: u64 = 8;

/// Colours of a job, before its mesh exists.
pub(in super::super) struct MeshColors {
    coloring: Coloring,
    source: ColorSource,
}

enum ColorSource {
    /// Colour of each sphere, and the finished report.
    Atoms { of_spheres: Vec<[u8; 4]>, report: ColorReport },
    /// Values of the vertices.
    Vertices(ValueSource),
    /// Pockets that the vertices line.
    Pockets,
}

impl MeshColors {
    /// Prepares the colours of the `selected` atoms. `map` is that of the scheme `map`.
    ///
    /// # Errors
    /// Returns [`JobError::Color`] if the values of the scheme are missing, and the errors of memory.
    pub(in super::super) fn new(
        structure: &Structure,
        selected: &[u32],
        coloring: Coloring,
        map: Option<Map>,
        control: &Control<'_>,
    ) -> Result<Self, JobError> {
        let source = if let Scheme::Vertex(property) = coloring.scheme {
            let vertices = ColorSource::Vertices;
            match property {
                VertexProperty::Curvature => vertices(ValueSource::Curvature),
                VertexProperty::Radial => vertices(ValueSource::Radial(centroid(structure, selected))),
                VertexProperty::Depth => vertices(ValueSource::Depth),
                VertexProperty::Pocket => ColorSource::Pockets,
                VertexProperty::Map => {
                    let map = map.ok_or_else(|| ColorError::without_map(coloring.scheme))?;
                    vertices(ValueSource::Map(Box::new(map), coloring.offset))
                }
            }
        } else {
            control.memory.grow(COLOR_BYTES * selected.len() as u64).map_err(SurfaceError::from)?;
            let colors = AtomColors::new(structure, selected, &coloring)?;
            let of_spheres = selected.iter().map(|&i| colors.of(i as usize)).collect();
            ColorSource::Atoms { of_spheres, report: colors.report(selected) }
        };
        Ok(Self { coloring, source })
    }

    /// Creates the colours of atoms that are given later, by [`Self::of_tile`].
    pub(in super::super) const fn of_report(coloring: Coloring, report: ColorReport) -> Self {
        Self { coloring, source: ColorSource::Atoms { of_spheres: Vec::new(), report } }
    }

    /// Returns the colour of a sphere; opaque black if it is not known.
    pub(in super::super) fn of_sphere(&self, sphere: u32) -> [u8; 4] {
        match &self.source {
            ColorSource::Atoms { of_spheres, .. } => of_spheres.get(sphere as usize).copied(),
            _ => None,
        }
        .unwrap_or([0, 0, 0, u8::MAX])
    }

    /// Returns the colours of the spheres of a tile, with the report of all; `None` for colours of vertices.
    pub(in super::super) fn of_tile(&self, of_spheres: Vec<[u8; 4]>) -> Option<Self> {
        let ColorSource::Atoms { report, .. } = &self.source else { return None };
        let source = ColorSource::Atoms { of_spheres, report: report.clone() };
        Some(Self { coloring: self.coloring, source })
    }

    /// Sets the colours of the vertices of the mesh of `surface`. `pockets` are those of the scheme `pocket`. Returns
    /// the report.
    ///
    /// # Errors
    /// Returns [`JobError::Color`] if the map has no value at any vertex, and the errors of memory and cancellation.
    pub(in super::super) fn apply(
        &self,
        mesh: &mut Mesh,
        surface: &MeshedSurface<'_>,
        pockets: Option<&Pockets>,
        control: &Control<'_>,
    ) -> Result<ColorReport, JobError> {
        control.check()?;
        control.memory.grow(COLOR_BYTES * mesh.n_vertices() as u64).map_err(SurfaceError::from)?;
        let Coloring { scheme, palette, range, blend, .. } = self.coloring;
        if matches!(scheme, Scheme::Vertex(_)) || blend == ColorBlend::Smooth {
            mesh.make_geometry_contiguous();
        }
        let (mut colors, mut report) = match &self.source {
            ColorSource::Atoms { of_spheres, report } => {
                (mesh.atom_ids.as_deref().map(|ids| of_vertices(ids, |id| of_spheres[id as usize])), report.clone())
            }
            ColorSource::Pockets => {
                let pockets = pockets.ok_or_else(|| ColorError::without_pockets(scheme))?;
                let (colors, report) = of_pockets(mesh, pockets, scheme, control)?;
                (Some(colors), report)
            }
            ColorSource::Vertices(source) => {
                let values = vertex::values(mesh, source, surface, control)?;
                let palette = palette.or(scheme.palette()).unwrap_or(Palette::Viridis);
                let (of_values, map) = match source {
                    ValueSource::Map(map, offset) => {
                        let of_values = symmetric_range(&values).ok_or_else(|| outside(scheme, map, *offset))?;
                        (of_values, Some(report_of_map(map, *offset, &values)))
                    }
                    _ => (extremes(values.iter().copied()).map(round), None),
                };
                let range = range.or(scheme.range()).unwrap_or(of_values);
                let color =
                    |value: f32| opaque(if value.is_nan() { OTHER } else { scaled(palette, range, f64::from(value)) });
                // Values of a map may have any scale.
                let legend = match map {
                    Some(_) => stops(palette, range, |value| significant(value, 5)),
                    None => stops(palette, range, round),
                };
                let report = ColorReport {
                    scheme: scheme.to_string(),
                    palette: Some(palette.name()),
                    range: Some(range),
                    map,
                    legend,
                    ..ColorReport::default()
                };
                (Some(of_vertices(&values, color)), report)
            }
        };
        if let Some(colors) = colors.as_mut().filter(|_| blend == ColorBlend::Smooth) {
            vertex::blend(colors, &mesh.triangles, surface.params.resolution, control)?;
            report.blend = Some(blend.name());
        }
        mesh.colors = colors;
        Ok(report)
    }
}

/// Returns the colours of the pockets that the vertices line, and their report. Vertices at no pocket are grey.
fn of_pockets(
    mesh: &Mesh,
    pockets: &Pockets,
    scheme: Scheme,
    control: &Control<'_>,
) -> Result<(Column<[u8; 4]>, ColorReport), SurfaceError> {
    let _memory = control.reserve(INDEX_BYTES * mesh.n_vertices() as u64)?;
    let lined: Vec<Option<u32>> = lined_by(mesh, pockets).collect();
    control.check()?;
    let color = |pocket: Option<u32>| opaque(pocket.map_or(OTHER, category));
    let legend = (0..).zip(&pockets.list).take(MAX_ENTRIES).map(|(i, _)| entry((i + 1).to_string(), category(i)));
    let report = ColorReport { scheme: scheme.to_string(), legend: legend.collect(), ..ColorReport::default() };
    Ok((of_vertices(&lined, color), report))
}

/// Describes a map and counts the vertices without a value.
fn report_of_map(map: &Map, offset: f64, values: &[f32]) -> MapReport {
    let vertices_outside = values.iter().filter(|value| value.is_nan()).count() as u64;
    MapReport { format: map.format().name(), size: map.size(), offset, vertices_outside }
}

/// Returns the error of a mesh that lies outside the map.
fn outside(scheme: Scheme, map: &Map, offset: f64) -> ColorError {
    let [low, high] = map.bounds().map(|end| end.map(|v| format!("{v:.1}")).join(", "));
    let why =
        format!("the map has no value {offset} Å from the surface anywhere; it extends from ({low}) to ({high}) Å");
    ColorError { scheme: scheme.to_string(), why }
}

/// Returns the mean position of the `selected` atoms, Å.
fn centroid(structure: &Structure, selected: &[u32]) -> [f64; 3] {
    [&structure.x, &structure.y, &structure.z]
        .map(|column| selected.iter().map(|&i| column[i as usize]).sum::<f64>() / selected.len().max(1) as f64)
}
