//! The report of a job: what was read, which grid, what the mesh is, how long each stage took.

use serde::Serialize;
use serde_json::{Map, Value};

use super::{Choice, Job};
use crate::formats::{Storage, Units};
#[cfg(feature = "png")]
use crate::picture::{Drawer, PictureParams, Rendered};
use crate::structure::{LeftOut, Selected, Structure, radii};
use crate::surface::{Component, GridStats, Measures, Served};

/// One connected component.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
pub struct ComponentReport {
    /// Its triangles.
    pub triangles: u64,
    /// Its vertices.
    pub vertices: u64,
    /// Å².
    pub area: f64,
    /// Å³, negative for a void.
    pub volume: f64,
}

impl ComponentReport {
    fn new(&Component { triangles, vertices, area, volume, .. }: &Component) -> Self {
        Self { triangles, vertices, area, volume }
    }
}

/// A void: a closed surface whose inside is outside the molecule. No probe has tested whether a solvent molecule fits:
/// most are gaps between atoms.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
pub struct VoidReport {
    /// Centroid of its volume in the coordinates of the structure, Å.
    pub center: [f64; 3],
    /// Å³.
    pub volume: f64,
    /// Å².
    pub area: f64,
}

impl VoidReport {
    /// `centre`: that of the mesh in the coordinates of the structure, Å.
    fn new(void: &Component, centre: [f64; 3]) -> Self {
        let centroid = void.centroid();
        Self { center: std::array::from_fn(|k| centre[k] + centroid[k]), volume: -void.volume, area: void.area }
    }
}

/// Atoms under one residue name.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
pub struct ResidueCount {
    /// Name of the residue.
    pub name: String,
    /// Number of atoms.
    pub atoms: u64,
}

/// Atoms of the model that are not meshed, each counted under the first reason that applies, in the order of the
/// fields.
#[derive(Debug, Clone, Default, Serialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
pub struct LeftOutReport {
    /// Sum of all counts below.
    pub total: u64,
    /// Atoms of chains that were not asked for.
    pub other_chains: u64,
    /// Sites that are not atoms: charge sites of water models, lone pairs, Drude particles.
    pub virtual_sites: u64,
    /// Atoms of kinds that were not asked for, by residue name; the ten most frequent names.
    pub residues: Vec<ResidueCount>,
    /// Atoms of kinds that were not asked for, under all other residue names.
    pub other_residues: u64,
    /// Hydrogen atoms of residues that are meshed.
    pub hydrogens: u64,
    /// Other alternative locations of residues that are meshed.
    pub alternatives: u64,
}

impl LeftOutReport {
    fn new(left_out: &LeftOut) -> Self {
        let residues = left_out.residues.iter();
        Self {
            total: left_out.total(),
            other_chains: left_out.other_chains,
            virtual_sites: left_out.virtual_sites,
            residues: residues.map(|(name, atoms)| ResidueCount { name: name.clone(), atoms: *atoms }).collect(),
            other_residues: left_out.other_residues,
            hydrogens: left_out.hydrogens,
            alternatives: left_out.alternatives,
        }
    }
}

/// How coarse the file's vertices are.
#[derive(Debug, Clone, Copy, Serialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
pub struct Quantization {
    /// Distance between neighbouring coordinates, Å; a vertex is moved by half of it at most along each axis.
    pub step: f32,
}

/// A picture, and who drew it.
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
pub struct PictureReport {
    /// Pixels of a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// From where the molecule is seen.
    pub view: &'static str,
    /// How far the viewer has walked around from there, degrees.
    pub azimuth: f64,
    /// How far the viewer has climbed then, degrees.
    pub elevation: f64,
    /// What is behind the molecule: `transparent`, or a colour.
    pub background: String,
    /// How the surface is shaded.
    pub style: &'static str,
    /// Å that a pixel is wide and high: the projection is orthographic.
    pub pixel: f64,
    /// What drew it: `cpu` or `gpu`.
    pub renderer: &'static str,
    /// Its arithmetic, for the key of the file.
    #[serde(skip)]
    pub arithmetic: String,
    /// What that ran on.
    pub device: String,
    /// Why it was taken.
    pub reason: String,
    /// Why `renderer` stood in for the one that was chosen; absent where none had to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fallback: Option<String>,
}

#[cfg(feature = "png")]
impl PictureReport {
    pub(super) fn new(params: &PictureParams, drawer: &Drawer, drawn: &Rendered) -> Self {
        let served = drawn.served.clone().unwrap_or_else(|| Served {
            backend: drawer.renderer.name(),
            arithmetic: drawer.renderer.arithmetic(),
            device: drawer.renderer.describe(),
            fallback_reason: None,
        });
        Self {
            width: params.width,
            height: params.height,
            view: params.view.name(),
            azimuth: params.azimuth,
            elevation: params.elevation,
            background: params.background.to_string(),
            style: params.style.name(),
            pixel: drawn.pixel,
            renderer: served.backend,
            arithmetic: served.arithmetic,
            device: served.device,
            reason: match &served.fallback_reason {
                Some(why) => format!("{}; but {why}", drawer.reason),
                None => drawer.reason.clone(),
            },
            fallback: served.fallback_reason,
        }
    }
}

/// A job's report. Field names are the JSON names.
#[expect(clippy::struct_field_names, reason = "the fields are named like the members of the JSON")]
#[derive(Debug, Clone, Serialize)]
#[cfg_attr(feature = "server", derive(utoipa::ToSchema))]
pub struct Report {
    /// PDB id or data block name.
    #[cfg_attr(feature = "server", schema(required))]
    pub id: Option<String>,
    /// Title of the structure.
    #[cfg_attr(feature = "server", schema(required))]
    pub title: Option<String>,
    /// `pdb`, `mmcif` or `bcif`.
    pub source_format: &'static str,
    /// Atoms meshed.
    pub atoms: u64,
    /// Atoms in the file, all models.
    pub atoms_in_file: u64,
    /// The model that was taken.
    pub model: i32,
    /// Atoms of the model that are not meshed.
    pub left_out: LeftOutReport,
    /// Values of the file that could not be read and do not matter for the mesh, at most 12; absent if there are none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    #[cfg_attr(feature = "server", schema(required = false))]
    pub warnings: Vec<String>,
    /// The table of radii.
    pub radii: &'static str,
    /// Kernel function.
    pub kernel: &'static str,
    /// Preset.
    pub preset: &'static str,
    /// Grid spacing, Å.
    pub resolution: f64,
    /// The parameter that the spacing follows from: `resolution` (as given, or its default), `detail` or `max_triangles`.
    pub resolution_from: &'static str,
    /// The level of detail; absent where none was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detail: Option<u8>,
    /// Triangles asked for at most; absent where they were not bounded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_triangles: Option<u64>,
    /// Meshes that were made to find the spacing; absent where it was known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tries: Option<u32>,
    /// Isovalue.
    pub isovalue: f64,
    /// The Gaussian's smoothness; absent for other kernels and raw parameters.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub smoothness: Option<f64>,
    /// Bricks that some atom reaches.
    pub bricks: u64,
    /// Bricks with surface.
    pub surface_bricks: u64,
    /// Samples evaluated.
    pub samples: u64,
    /// Cells that a dense grid would have had.
    pub box_cells: u64,
    /// Vertices.
    pub vertices: u64,
    /// Triangles.
    pub triangles: u64,
    /// No boundary.
    pub closed: bool,
    /// Consistent winding.
    pub oriented: bool,
    /// Manifold edges and vertices.
    pub manifold: bool,
    /// How the last three were established: `checksum` or `exact`.
    pub validation: &'static str,
    /// V − E + F.
    pub euler: i64,
    /// Number of connected components.
    pub components: u64,
    /// Number of voids: components with negative volume. No probe has tested them, and most are gaps between atoms, so
    /// their number changes with the grid spacing.
    pub voids: u64,
    /// The voids of largest volume, at most 100.
    pub void_list: Vec<VoidReport>,
    /// The components of largest area, at most 100.
    pub component_list: Vec<ComponentReport>,
    /// Å².
    pub area: f64,
    /// Å³.
    pub volume: f64,
    /// The units of every length, area and volume in this report: `angstrom`.
    pub report_units: &'static str,
    /// The units of the file's coordinates: `angstrom`, `nanometer` or `meter`.
    pub file_units: &'static str,
    /// The normals of the file's vertices: `smooth` or `none`.
    pub normals: &'static str,
    /// How coarse the file's vertices are; absent where they are not quantised.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub quantization: Option<Quantization>,
    /// The backend that ran.
    pub backend: &'static str,
    /// Its arithmetic, for the key of the file.
    #[serde(skip)]
    pub arithmetic: String,
    /// What it ran on.
    pub device: String,
    /// Why it was taken.
    pub backend_reason: String,
    /// Why `backend` stood in for the one that was chosen; absent where none had to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fallback: Option<String>,
    /// The picture; absent where the mesh itself was asked for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub picture: Option<PictureReport>,
    /// Wall time per stage, ms.
    #[cfg_attr(feature = "server", schema(value_type = std::collections::BTreeMap<String, f64>))]
    pub timings_ms: Map<String, Value>,
}

/// What a report counts, and who made it.
pub(super) struct Counts {
    pub(super) resolution: f64,
    /// The mesh's centre in the coordinates of the structure, Å.
    pub(super) centre: [f64; 3],
    pub(super) tries: Option<u32>,
    pub(super) grid: GridStats,
    pub(super) n_vertices: usize,
    pub(super) n_triangles: usize,
    pub(super) served: Option<Served>,
    pub(super) storage: Storage,
}

impl Report {
    pub(super) fn new(
        structure: &Structure,
        selected: &Selected,
        job: &Job,
        choice: &Choice<'_>,
        counts: &Counts,
        measures: &Measures,
        timings: Vec<(&'static str, f64)>,
    ) -> Self {
        let params = &job.params;
        let gaussian = params.kernel == crate::surface::Kernel::Gaussian && params.paper.is_none();
        let served = counts.served.clone().unwrap_or_else(|| Served {
            backend: choice.backend.name(),
            arithmetic: choice.backend.arithmetic(),
            device: choice.backend.describe(),
            fallback_reason: None,
        });
        let mut voids: Vec<&Component> = measures.components.iter().filter(|c| c.volume < 0.0).collect();
        voids.sort_by(|a, b| a.volume.total_cmp(&b.volume));
        Self {
            id: structure.id.clone(),
            title: structure.title.clone(),
            source_format: structure.format.name(),
            atoms: selected.atoms.len() as u64,
            atoms_in_file: structure.len() as u64,
            model: selected.model,
            left_out: LeftOutReport::new(&selected.left_out),
            warnings: structure.warnings.clone(),
            radii: radii::TABLE,
            kernel: params.kernel.name(),
            preset: params.preset.name(),
            resolution: counts.resolution,
            resolution_from: job.spacing.parameter(),
            detail: job.spacing.detail(),
            max_triangles: job.spacing.max_triangles(),
            tries: counts.tries,
            isovalue: params.isovalue,
            smoothness: gaussian.then_some(params.smoothness),
            bricks: counts.grid.bricks,
            surface_bricks: counts.grid.surface_bricks,
            samples: counts.grid.samples,
            box_cells: counts.grid.box_cells,
            vertices: counts.n_vertices as u64,
            triangles: counts.n_triangles as u64,
            closed: measures.closed,
            oriented: measures.oriented,
            manifold: measures.manifold,
            validation: measures.validation.name(),
            euler: measures.euler,
            components: measures.components.len() as u64,
            voids: voids.len() as u64,
            void_list: voids.iter().take(100).map(|void| VoidReport::new(void, counts.centre)).collect(),
            component_list: measures.components.iter().take(100).map(ComponentReport::new).collect(),
            area: measures.area,
            volume: measures.volume,
            report_units: Units::Angstrom.name(),
            file_units: counts.storage.units.name(),
            normals: counts.storage.normals.name(),
            quantization: counts.storage.packing.step().map(|step| Quantization { step: step.length() }),
            backend: served.backend,
            arithmetic: served.arithmetic,
            device: served.device,
            backend_reason: match &served.fallback_reason {
                Some(why) => format!("{}; but {why}", choice.reason),
                None => choice.reason.to_owned(),
            },
            fallback: served.fallback_reason,
            picture: None,
            timings_ms: timings
                .into_iter()
                .map(|(name, ms)| (name.to_owned(), Value::from((ms * 1e3).round() / 1e3)))
                .collect(),
        }
    }

    /// Adds time to a stage that ran after the job, or went on after it, such as `encode` and `write`.
    pub fn add_timing(&mut self, stage: &str, ms: f64) {
        let before = self.timings_ms.get(stage).and_then(Value::as_f64).unwrap_or_default();
        self.timings_ms.insert(stage.to_owned(), Value::from(((before + ms) * 1e3).round() / 1e3));
    }

    /// Arithmetic of the file, as in its key: that of the mesh, followed by that of the picture.
    #[must_use]
    pub fn maker(&self) -> String {
        maker(&self.arithmetic, self.picture.as_ref().map(|picture| picture.arithmetic.as_str()))
    }

    /// The report as a mesh file's extras: without what differs from run to run, so that the same input gives
    /// the same bytes, and without what describes the input rather than the mesh.
    #[must_use]
    pub fn extras(&self) -> Map<String, Value> {
        let Ok(Value::Object(mut map)) = serde_json::to_value(self) else { return Map::new() };
        for field in ["timings_ms", "device", "backend_reason", "fallback", "left_out", "warnings", "void_list"] {
            map.remove(field);
        }
        map
    }
}

/// Arithmetic of a file: that of its mesh, followed by that of its picture.
#[must_use]
pub fn maker(mesh: &str, picture: Option<&str>) -> String {
    picture.map_or_else(|| mesh.to_owned(), |picture| format!("{mesh}+{picture}"))
}
