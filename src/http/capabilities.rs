//! `/v1/capabilities`: formats, parameters and limits of the service, for front ends that build their forms from it.

use axum::extract::State;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde::Serialize;
use serde_json::{Map, Value};
use utoipa::ToSchema;

use super::page;
use super::state::Shared;
use crate::config::Config;
use crate::formats::Format;
use crate::jobs::Pool;
use crate::pipeline::params::{Domain, Parameter, TABLE};
use crate::structure::{element, radii};
use crate::surface::{DeviceStatus, FoundDevice, Kernel, Preset, SurfaceOptions, SurfaceParams};

/// Capabilities and limits of the service.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Capabilities {
    /// `molmesh`.
    name: &'static str,
    /// The program's version.
    version: &'static str,
    units: Units,
    inputs: Inputs,
    /// Formats, the best known first; png is a picture.
    formats: Vec<FormatDocument>,
    /// The format where none is asked for.
    default_format: &'static str,
    /// Kernel functions.
    kernels: Vec<&'static str>,
    /// Smoothness and isovalue of every preset.
    #[schema(value_type = std::collections::BTreeMap<String, PresetValues>)]
    presets: Map<String, Value>,
    /// Every parameter of a mesh.
    parameters: Vec<ParameterDocument>,
    limits: Limits,
    /// The backend that makes the meshes.
    backends: Vec<BackendDocument>,
    /// Renderer of pictures.
    renderers: Vec<BackendDocument>,
    /// Every device that was found.
    devices: Vec<DeviceDocument>,
    radii: Radii,
    /// True if `/` is the viewer; otherwise it is a page that explains how to build it.
    viewer: bool,
    /// Address of the list of problem types.
    problems: &'static str,
}

/// The units of everything.
#[derive(Debug, Serialize, ToSchema)]
struct Units {
    length: &'static str,
    area: &'static str,
    volume: &'static str,
}

/// Formats and encodings of uploads.
#[derive(Debug, Serialize, ToSchema)]
struct Inputs {
    /// Structure formats.
    formats: &'static [&'static str],
    /// Compressions.
    encodings: &'static [&'static str],
    note: &'static str,
}

/// A format.
#[derive(Debug, Serialize, ToSchema)]
struct FormatDocument {
    /// Its file name's extension.
    name: &'static str,
    media_type: &'static str,
}

/// Values of a preset.
#[derive(Debug, Serialize, ToSchema)]
struct PresetValues {
    smoothness: f64,
    isovalue: f64,
}

/// A parameter.
#[derive(Debug, Serialize, ToSchema)]
struct ParameterDocument {
    name: &'static str,
    /// Effect.
    doc: &'static str,
    /// Allowed values, in words.
    expected: String,
    /// Default value, in words.
    default: &'static str,
    #[serde(flatten)]
    domain: DomainDocument,
}

/// Allowed values of a parameter.
#[derive(Debug, Serialize, ToSchema)]
#[serde(tag = "type", rename_all = "lowercase")]
enum DomainDocument {
    /// A number within bounds, both included.
    Number { min: f64, max: f64, unit: &'static str },
    /// A whole number within bounds, both included.
    Integer { min: i64, max: i64 },
    /// `true` or `false`.
    Boolean,
    /// One of these words.
    Choice { values: &'static [&'static str] },
    /// Words of these, separated by commas.
    Set { values: &'static [&'static str] },
    /// Free text.
    Text,
}

/// The limits, as they are configured.
#[derive(Debug, Serialize, ToSchema)]
struct Limits {
    body_bytes: u64,
    json_bytes: u64,
    part_head_bytes: u64,
    parts: usize,
    inflated_bytes: u64,
    atoms: u64,
    labels: u64,
    grid_samples: u64,
    candidate_pairs: u64,
    mesh_bytes: u64,
    output_bytes: u64,
    memory_bytes: u64,
    picture_side: u32,
    workers: usize,
    queue: usize,
    deliveries: usize,
    deadline_ms: u64,
    batch_deadline_ms: u64,
    attempts: u32,
    body_timeout_ms: u64,
    header_timeout_ms: u64,
    write_timeout_ms: u64,
    write_bytes: u64,
    connections: usize,
}

/// Backend or renderer.
#[derive(Debug, Serialize, ToSchema)]
struct BackendDocument {
    name: &'static str,
    /// Processor or device that it uses.
    device: String,
    /// Reason for its choice.
    reason: String,
}

/// A device that was found.
#[derive(Debug, Serialize, ToSchema)]
struct DeviceDocument {
    /// Its number, by which it is chosen.
    number: usize,
    name: String,
    /// Kind of the device.
    kind: &'static str,
    /// The graphics API that offers it.
    api: &'static str,
    driver: String,
    binding_bytes: u64,
    buffer_bytes: u64,
    workgroup_bytes: u64,
    timestamps: bool,
    /// The least and the most threads of a subgroup.
    #[schema(required)]
    subgroups: Option<[u32; 2]>,
    /// It was taken when the service started.
    taken: bool,
    /// It takes jobs now.
    up: bool,
    /// Reason why it is used or not.
    reason: String,
}

/// Van der Waals radii.
#[derive(Debug, Serialize, ToSchema)]
struct Radii {
    /// Source of the values.
    table: &'static str,
    unit: &'static str,
    /// The radius of elements that the table lacks.
    fallback: f32,
    /// By element symbol.
    #[schema(value_type = std::collections::BTreeMap<String, f64>)]
    values: Map<String, Value>,
}

/// Lists formats, parameters, limits and devices.
#[utoipa::path(get, path = "/v1/capabilities", tag = "service", operation_id = "capabilities",
    responses((status = 200, description = "Formats, parameters, limits, devices.", body = Capabilities)))]
pub(super) async fn show(State(app): State<Shared>) -> Response {
    let headers = [(CONTENT_TYPE, "application/json"), (CACHE_CONTROL, "no-cache")];
    let body =
        if app.found.is_empty() { app.capabilities.clone() } else { document(&app.config, &app.pool, &app.found) };
    (headers, body).into_response()
}

/// Writes the document.
pub(super) fn document(config: &Config, pool: &Pool, found: &[FoundDevice]) -> Bytes {
    let (backend, drawer) = (pool.backend(), pool.drawer());
    let document = Capabilities {
        name: "molmesh",
        version: env!("CARGO_PKG_VERSION"),
        units: Units { length: "Å", area: "Å²", volume: "Å³" },
        inputs: Inputs {
            formats: &["pdb", "mmcif", "bcif"],
            encodings: &["identity", "gzip", "zstd"],
            note: "The format is detected from the bytes; Content-Type is a hint.",
        },
        formats: Format::ALL.map(|f| FormatDocument { name: f.extension(), media_type: f.media_type() }).into(),
        default_format: Format::default().extension(),
        kernels: Kernel::ALL.iter().map(|k| k.name()).collect(),
        presets: presets(),
        parameters: TABLE.iter().map(parameter).collect(),
        limits: limits(config, pool),
        backends: vec![BackendDocument {
            name: backend.name(),
            device: backend.describe(),
            reason: pool.reason().to_owned(),
        }],
        renderers: vec![BackendDocument {
            name: drawer.renderer.name(),
            device: drawer.renderer.describe(),
            reason: drawer.reason.clone(),
        }],
        devices: devices(found, &backend.devices()),
        radii: Radii { table: radii::TABLE, unit: "Å", fallback: radii::FALLBACK, values: radii_by_symbol() },
        viewer: page::has_viewer(),
        problems: "/problems",
    };
    // Serializing text and numbers does not fail.
    serde_json::to_vec(&document).map(Bytes::from).unwrap_or_default()
}

/// Describes every device that was found.
fn devices(found: &[FoundDevice], running: &[DeviceStatus]) -> Vec<DeviceDocument> {
    let device = |found: &FoundDevice| {
        let status = running.iter().find(|status| status.number == found.number);
        let down = status.and_then(|status| status.down.as_ref());
        let facts = &found.facts;
        DeviceDocument {
            number: found.number,
            name: facts.name.clone(),
            kind: facts.kind.name(),
            api: facts.api,
            driver: facts.driver.clone(),
            binding_bytes: facts.binding_bytes,
            buffer_bytes: facts.buffer_bytes,
            workgroup_bytes: facts.workgroup_bytes,
            timestamps: facts.timestamps,
            subgroups: facts.subgroups,
            taken: found.taken,
            up: status.is_some() && down.is_none(),
            reason: down.unwrap_or(&found.reason).clone(),
        }
    };
    found.iter().map(device).collect()
}

/// Smoothness and isovalue of every preset, from the code that applies them.
fn presets() -> Map<String, Value> {
    let values = |preset: Preset| {
        let params = SurfaceParams::new(&SurfaceOptions { preset: Some(preset), ..SurfaceOptions::default() });
        let values = params.map(|p| PresetValues { smoothness: p.smoothness, isovalue: p.isovalue });
        values.ok().and_then(|values| serde_json::to_value(values).ok()).unwrap_or_default()
    };
    Preset::ALL.iter().map(|&preset| (preset.name().to_owned(), values(preset))).collect()
}

fn parameter(parameter: &Parameter) -> ParameterDocument {
    let domain = match parameter.domain {
        Domain::Number { min, max, unit } => DomainDocument::Number { min, max, unit },
        Domain::Integer { min, max } => DomainDocument::Integer { min, max },
        Domain::Flag => DomainDocument::Boolean,
        Domain::Choice(values) => DomainDocument::Choice { values },
        Domain::Set(values) => DomainDocument::Set { values },
        Domain::Text { .. } => DomainDocument::Text,
    };
    let Parameter { name, doc, default, .. } = *parameter;
    ParameterDocument { name, doc, expected: parameter.domain.expected(), default, domain }
}

fn limits(config: &Config, pool: &Pool) -> Limits {
    let (limits, server, jobs) = (&config.limits, &config.server, &config.jobs);
    Limits {
        body_bytes: limits.body_bytes,
        json_bytes: limits.json_bytes,
        part_head_bytes: limits.part_head_bytes,
        parts: limits.parts,
        inflated_bytes: limits.inflated_bytes,
        atoms: limits.atoms,
        labels: limits.labels,
        grid_samples: limits.grid_samples,
        candidate_pairs: limits.candidate_pairs,
        mesh_bytes: limits.mesh_bytes,
        output_bytes: limits.output_bytes,
        memory_bytes: limits.memory_bytes,
        picture_side: limits.picture_side,
        workers: pool.workers(),
        queue: jobs.queue,
        deliveries: jobs.deliveries,
        deadline_ms: jobs.deadline_ms,
        batch_deadline_ms: jobs.batch_deadline_ms,
        attempts: jobs.attempts,
        body_timeout_ms: server.body_timeout_ms,
        header_timeout_ms: server.header_timeout_ms,
        write_timeout_ms: server.write_timeout_ms,
        write_bytes: server.write_bytes,
        connections: server.connections,
    }
}

/// Radii by element symbol, to the hundredth of an ångström that the sources give.
fn radii_by_symbol() -> Map<String, Value> {
    let radius = |number: u8| (f64::from(radii::vdw_radius(number)) * 100.0).round() / 100.0;
    (1u8..).zip(element::SYMBOLS).map(|(number, symbol)| (symbol.to_owned(), radius(number).into())).collect()
}
