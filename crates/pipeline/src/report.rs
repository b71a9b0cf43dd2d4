//! Report of a job: input, grid, mesh, measures and times.

use molmesh_formats::{Storage, Units};
use molmesh_structure::{Selected, Structure};
use molmesh_surface::{BackendIdentity, Component, GridStats, Measures, SurfaceKind, Validation};
use serde::Serialize;
use serde_json::{Map, Value};

use super::areas::ExactReport;
use super::cavities::CavityReport;
use super::color::ColorReport;
use super::components::{ComponentReport, VoidReport};
use super::instances::{AssemblyReport, InstancesReport};
use super::parts::PartReport;
use super::pockets::PocketReport;
use super::shapes::TriangleReport;
use super::{Choice, LeftOut, Options, SimplificationReport, StageClock};

/// Quantization of the vertices in the file.
#[derive(Debug, Clone, Copy, Serialize, utoipa::ToSchema)]
pub struct Quantization {
    /// Step between adjacent coordinates in Å. Rounding moves a vertex by at most half a step along each axis.
    pub step: f32,
}

/// Picture of a mesh and its renderer.
#[derive(Debug, Clone, Serialize, utoipa::ToSchema)]
pub struct PictureReport {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Viewing direction.
    pub view: &'static str,
    /// Rotation of the camera about the vertical axis in degrees, applied to `view`.
    pub azimuth: f64,
    /// Elevation of the camera in degrees, applied after `azimuth`.
    pub elevation: f64,
    /// Background: `transparent` or a colour.
    pub background: String,
    /// Shading style.
    pub style: &'static str,
    /// Width and height of a pixel in Å; the projection is orthographic.
    pub pixel: f64,
    /// Backend that rendered the picture: `cpu` or `gpu`.
    pub renderer: &'static str,
    /// Arithmetic of the renderer, part of the key of the file.
    #[serde(skip)]
    pub arithmetic: String,
    /// Device of the renderer.
    pub device: String,
    /// Reason for the choice of the renderer.
    pub reason: String,
    /// Reason why `renderer` replaced the chosen one; absent if it did not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fallback: Option<String>,
}

/// Report of a job: input, grid, mesh, measures and times.
#[expect(clippy::struct_field_names, reason = "the fields are named like the members of the JSON")]
#[derive(Debug, Clone, Default, Serialize, utoipa::ToSchema)]
pub struct Report {
    /// PDB id or data block name; null if the file has none.
    #[schema(required)]
    pub id: Option<String>,
    /// Title of the structure; null if the file has none.
    #[schema(required)]
    pub title: Option<String>,
    /// Format of the structure file: `pdb`, `mmcif`, `bcif`, `pqr` or `xyz`.
    pub source_format: &'static str,
    /// Meshed atoms, including all copies in an assembly. With `instances`, the atoms of the units.
    pub atoms: u64,
    /// Atoms of the selection, including all copies in an assembly, if the mesh is cut out of the surface of the whole
    /// structure (`context=whole`); absent otherwise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub selected_atoms: Option<u64>,
    /// Atoms of the file: of all models, and those that are not read.
    pub atoms_in_file: u64,
    /// Number of the meshed model; of the first one with `model=all`.
    pub model: i32,
    /// Number of meshed models with `model=all`; absent if one model is meshed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub models: Option<u64>,
    /// Assembly; absent for the asymmetric unit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub assembly: Option<AssemblyReport>,
    /// Instances of the units of the assembly, which `parts` lists; absent without `instances`. All other numbers of
    /// the report describe the units, each once.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub instances: Option<InstancesReport>,
    /// Atoms of the selected models that are not meshed.
    pub left_out: LeftOut,
    /// Unreadable values that do not affect the mesh, at most 12; absent if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(required = false)]
    pub warnings: Vec<String>,
    /// Table of van der Waals radii, or the file that gives them.
    pub radii: &'static str,
    /// Type of the surface.
    pub surface: &'static str,
    /// Radius of the probe in Å; solvent-accessible and solvent-excluded surfaces only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub probe: Option<f64>,
    /// Preset.
    pub preset: &'static str,
    /// Grid spacing in Å.
    pub resolution: f64,
    /// Parameter that set the spacing: `resolution` (given or default), `detail` or `max_triangles`.
    pub resolution_from: &'static str,
    /// Level of detail; absent if the request sets none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detail: Option<u8>,
    /// Requested maximum of triangles; absent if the request sets none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_triangles: Option<u64>,
    /// Meshes computed to find the spacing; absent if the spacing was given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tries: Option<u32>,
    /// Isovalue of the density; absent for surfaces of spheres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub isovalue: Option<f64>,
    /// Smoothness of the gaussian kernel; absent for other surfaces and raw parameters.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub smoothness: Option<f64>,
    /// Grid bricks (8 × 8 × 8 points) within reach of an atom.
    pub bricks: u64,
    /// Bricks that contain a part of the surface.
    pub surface_bricks: u64,
    /// Grid points evaluated.
    pub grid_points: u64,
    /// Cells of a dense grid over the bounding box.
    pub box_cells: u64,
    /// Vertices of the mesh.
    pub vertices: u64,
    /// Triangles of the mesh.
    pub triangles: u64,
    /// True if the mesh has no boundary. A surface that `split` and `context=whole` divide is checked before that.
    pub closed: bool,
    /// Reason why the mesh has a boundary: `cut` (`context=whole`, or a tile, which is measured without its skirts).
    /// Absent if `closed` is true, or if a check found a defect.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub open_reason: Option<&'static str>,
    /// True if all triangles have consistent winding.
    pub oriented: bool,
    /// True if all edges and vertices are manifold. False for a mesh with a boundary.
    pub manifold: bool,
    /// `check` if a check of the mesh found `manifold`; `construction` if it follows from the case table, because the
    /// checksum does not see vertices.
    pub manifold_from: &'static str,
    /// Method that checked `closed`, `oriented` and, unless it is by construction, `manifold`: `checksum` or `exact`.
    pub validation: &'static str,
    /// Euler characteristic: vertices − edges + triangles.
    pub euler: i64,
    /// Number of connected components.
    pub components: u64,
    /// Number of voids: components with negative volume. Most are gaps between atoms, so the number depends on the grid
    /// spacing. 0 if the mesh is cut open.
    pub voids: u64,
    /// Voids with the largest volumes, at most 100.
    pub void_list: Vec<VoidReport>,
    /// Number of cavities, closed regions that hold a probe; absent without `cavities`. They are found from the atoms
    /// and do not depend on the mesh.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cavities: Option<u64>,
    /// Cavities with the largest accessible volumes, at most 100; absent without `cavities`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cavity_list: Option<Vec<CavityReport>>,
    /// Number of pockets, regions outside the molecule that the probe can enter and a large probe cannot; absent
    /// without `pockets`. They are found from the atoms and do not depend on the mesh.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pockets: Option<u64>,
    /// Pockets with the largest volumes, at most 100; absent without `pockets`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pocket_list: Option<Vec<PocketReport>>,
    /// Shapes of the triangles; absent without `quality=high`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub triangle_shapes: Option<TriangleReport>,
    /// Simplification of the mesh; absent without `simplify`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub simplification: Option<SimplificationReport>,
    /// Components with the largest areas, at most 100.
    pub component_list: Vec<ComponentReport>,
    /// Parts of the mesh; absent if the request does not divide it.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[schema(required = false)]
    pub parts: Vec<PartReport>,
    /// Surface area in Å², including the walls of voids.
    pub area: f64,
    /// Upper estimate for macromolecules, in percent of the exact area, of the area that the mesh lacks at the creases
    /// between spheres: with `surface=vdw` or `sas`, the default radii and probe, and a grid spacing of at most 2 Å.
    /// Absent with `exact`, and if the mesh is simplified or cut.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub area_deficit_percent: Option<f64>,
    /// Enclosed volume in Å³, voids subtracted; null if the mesh is cut open.
    #[schema(required)]
    pub volume: Option<f64>,
    /// Exact areas and volume of the surface; absent if the request does not ask for them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub exact: Option<ExactReport>,
    /// Units of all lengths, areas and volumes in this report: `angstrom`.
    pub report_units: &'static str,
    /// Units of the coordinates in the mesh file: `angstrom`, `nanometer` or `meter`.
    pub file_units: &'static str,
    /// Vertex normals in the mesh file: `smooth` or `none`.
    pub normals: &'static str,
    /// Quantization of the vertices in the mesh file; absent if they are not quantized.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantization: Option<Quantization>,
    /// Colours of the vertices; absent if they have none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub color: Option<ColorReport>,
    /// Backend that computed the mesh: `cpu`, `gpu` or `reference`.
    pub backend: &'static str,
    /// Arithmetic of the backend, part of the key of the file.
    #[serde(skip)]
    pub arithmetic: String,
    /// Device of the backend.
    pub device: String,
    /// Reason for the choice of the backend.
    pub backend_reason: String,
    /// Reason why `backend` replaced the chosen one; absent if it did not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fallback: Option<String>,
    /// Picture; absent if the request asks for a mesh.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub picture: Option<PictureReport>,
    /// Wall-clock time per stage in ms.
    #[schema(value_type = std::collections::BTreeMap<String, f64>)]
    pub timings_ms: Map<String, Value>,
}

/// Counts of a report and the backend that ran.
pub(super) struct Counts {
    pub(super) resolution: f64,
    /// Centre of the mesh in the coordinates of the structure, in Å.
    pub(super) centre: [f64; 3],
    pub(super) tries: Option<u32>,
    pub(super) grid: GridStats,
    pub(super) n_vertices: usize,
    pub(super) n_triangles: usize,
    /// True if the mesh was cut out of a closed one.
    pub(super) cut: bool,
    pub(super) made_by: Option<BackendIdentity>,
    pub(super) storage: Storage,
}

impl Report {
    pub(super) fn new(
        structure: &Structure,
        selected: &Selected,
        options: &Options,
        choice: &Choice<'_>,
        counts: &Counts,
        measures: &Measures,
        timings: Vec<(&'static str, f64)>,
    ) -> Self {
        let params = &options.params;
        let gaussian = params.surface == SurfaceKind::Gaussian && params.paper.is_none();
        let made_by = counts.made_by.clone().unwrap_or_else(|| choice.backend.identity());
        let is_open = counts.cut && !measures.closed;
        let components = &measures.components;
        let mut voids: Vec<&Component> = components.iter().filter(|c| !is_open && c.volume < 0.0).collect();
        voids.sort_by(|a, b| a.volume.total_cmp(&b.volume));
        Self {
            id: structure.id.clone(),
            title: structure.title.clone(),
            source_format: structure.format.name(),
            atoms: selected.atoms.len() as u64,
            selected_atoms: selected.marks.is_some().then(|| selected.n_selected()),
            atoms_in_file: structure.n_in_file(),
            model: selected.model,
            assembly: AssemblyReport::new(&options.selection, selected),
            left_out: selected.left_out.clone(),
            warnings: structure.warnings.clone(),
            radii: structure.radii_name(),
            surface: params.surface.name(),
            probe: params.used_probe(),
            preset: params.preset.name(),
            resolution: counts.resolution,
            resolution_from: options.spacing.parameter(),
            detail: options.spacing.detail(),
            max_triangles: options.max_triangles(),
            tries: counts.tries,
            isovalue: params.level(),
            smoothness: gaussian.then_some(params.smoothness),
            bricks: counts.grid.bricks,
            surface_bricks: counts.grid.surface_bricks,
            grid_points: counts.grid.grid_points,
            box_cells: counts.grid.box_cells,
            vertices: counts.n_vertices as u64,
            triangles: counts.n_triangles as u64,
            closed: measures.closed,
            open_reason: is_open.then_some("cut"),
            oriented: measures.oriented,
            manifold: measures.manifold,
            // A mesh that fails the checksum is not manifold, even if its vertices are.
            manifold_from: match measures.validation {
                Validation::Checksum if measures.manifold => "construction",
                _ => "check",
            },
            validation: measures.validation.name(),
            euler: measures.euler,
            components: components.len() as u64,
            voids: voids.len() as u64,
            void_list: voids.iter().take(100).map(|void| VoidReport::new(void, counts.centre)).collect(),
            component_list: components.iter().take(100).map(|c| ComponentReport::new(c, is_open)).collect(),
            area: measures.area,
            area_deficit_percent: area_deficit_percent(structure, options, counts),
            volume: (!is_open).then_some(measures.volume),
            report_units: Units::Angstrom.name(),
            file_units: counts.storage.units.name(),
            normals: counts.storage.normals.name(),
            quantization: counts.storage.packing.step().map(|step| Quantization { step: step.length() }),
            backend_reason: made_by.reason(choice.reason),
            backend: made_by.backend,
            arithmetic: made_by.arithmetic,
            device: made_by.device,
            fallback: made_by.fallback_reason,
            timings_ms: timings
                .into_iter()
                .map(|(name, ms)| (name.to_owned(), Value::from((ms * 1e3).round() / 1e3)))
                .collect(),
            ..Self::default()
        }
    }

    /// Adds time in ms to a stage that ends after the job, such as `encode` and `write`.
    pub fn add_timing(&mut self, stage: &str, ms: f64) {
        let before = self.timings_ms.get(stage).and_then(Value::as_f64).unwrap_or_default();
        self.timings_ms.insert(stage.to_owned(), Value::from(((before + ms) * 1e3).round() / 1e3));
    }

    /// Adds the times of the stages of `clock`.
    pub(super) fn add_timings(&mut self, clock: &StageClock<'_>) {
        clock.finish().into_iter().for_each(|(stage, ms)| self.add_timing(stage, ms));
    }

    /// Returns the arithmetic of the file, as in its key: that of the mesh, followed by that of the picture.
    #[must_use]
    pub fn file_arithmetic(&self) -> String {
        file_arithmetic(&self.arithmetic, self.picture.as_ref().map(|picture| picture.arithmetic.as_str()))
    }

    /// Returns the report as the extras of a mesh file. Leaves out fields that differ between runs, because the same
    /// input gives the same bytes, and fields that describe the input rather than the mesh.
    #[must_use]
    pub fn extras(&self) -> Map<String, Value> {
        let Ok(Value::Object(mut map)) = serde_json::to_value(self) else { return Map::new() };
        // Keeps the order of the other fields.
        map.retain(|field, _| !EXCLUDED_EXTRAS.contains(&field.as_str()));
        map
    }
}

/// Returns [`molmesh_surface::SurfaceParams::area_deficit_percent`] of a mesh whose area nothing else changes: radii of
/// the file, simplification or a cut. A report with exact areas needs no estimate.
fn area_deficit_percent(structure: &Structure, options: &Options, counts: &Counts) -> Option<f64> {
    let needs_estimate = !options.exact && structure.radius.is_empty() && options.simplify.is_none() && !counts.cut;
    options.params.area_deficit_percent(counts.resolution).filter(|_| needs_estimate)
}

/// Fields of the report that mesh files do not contain. The last digits of `exact` and `triangle_shapes` depend on
/// mathematical libraries; `area_deficit_percent` describes the grid spacing, not the mesh.
const EXCLUDED_EXTRAS: [&str; 12] = [
    "timings_ms",
    "area_deficit_percent",
    "device",
    "backend_reason",
    "fallback",
    "exact",
    "triangle_shapes",
    "left_out",
    "warnings",
    "void_list",
    "cavity_list",
    "pocket_list",
];

/// Returns the arithmetic of a file: that of its mesh, followed by that of its picture.
#[must_use]
pub fn file_arithmetic(mesh: &str, picture: Option<&str>) -> String {
    picture.map_or_else(|| mesh.to_owned(), |picture| format!("{mesh}+{picture}"))
}
