//! `/v1/capabilities`: formats, parameters and limits of the service, for front ends that build their forms from it.

use axum::extract::State;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde::Serialize;
use serde_json::{Map, Value};
use utoipa::ToSchema;

use super::openapi::problem_responses;
use super::state::Shared;
use super::{form, pace, page, upload};
use crate::config::Config;
use crate::formats::Format;
use crate::jobs::Pool;
use crate::pipeline::params::{Domain, Parameter, TABLE};
use crate::structure::{element, radii};
use crate::surface::{DeviceStatus, FoundDevice, Preset, SurfaceKind, SurfaceOptions, SurfaceParams};

/// Formats, parameters, limits and devices of the service.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Capabilities {
    /// Always `molmesh`.
    name: &'static str,
    /// Version of the program.
    version: &'static str,
    /// Units of all lengths, areas and volumes.
    units: QuantityUnits,
    /// Accepted uploads.
    inputs: Inputs,
    /// Output formats. `png` is a picture of the mesh.
    formats: Vec<FormatDocument>,
    /// Format of a request that names none.
    default_format: &'static str,
    /// Surfaces.
    surfaces: Vec<&'static str>,
    /// Smoothness and isovalue of each preset.
    #[schema(value_type = std::collections::BTreeMap<String, PresetValues>)]
    presets: Map<String, Value>,
    /// Mesh parameters.
    parameters: Vec<ParameterDocument>,
    /// Configured limits.
    limits: Limits,
    /// Backends that compute meshes.
    backends: Vec<BackendDocument>,
    /// Backends that render pictures.
    renderers: Vec<BackendDocument>,
    /// Devices found at the start of the service.
    devices: Vec<DeviceDocument>,
    /// Van der Waals radii.
    radii: Radii,
    /// True if the server includes the web page.
    viewer: bool,
    /// Path of the list of problem types.
    problems: &'static str,
}

/// Units of all lengths, areas and volumes.
#[derive(Debug, Serialize, ToSchema)]
struct QuantityUnits {
    /// Unit of lengths.
    length: &'static str,
    /// Unit of areas.
    area: &'static str,
    /// Unit of volumes.
    volume: &'static str,
}

/// Accepted uploads.
#[derive(Debug, Serialize, ToSchema)]
struct Inputs {
    /// Structure formats.
    formats: &'static [&'static str],
    /// Compressions.
    encodings: &'static [&'static str],
    /// Remark on content types.
    note: &'static str,
}

/// Output format.
#[derive(Debug, Serialize, ToSchema)]
struct FormatDocument {
    /// File name extension.
    name: &'static str,
    /// Media type.
    media_type: &'static str,
}

/// Parameter values of a preset.
#[derive(Debug, Serialize, ToSchema)]
struct PresetValues {
    /// Smoothness of the gaussian kernel.
    smoothness: f64,
    /// Isovalue of the density.
    isovalue: f64,
}

/// Mesh parameter.
#[derive(Debug, Serialize, ToSchema)]
struct ParameterDocument {
    /// Name in queries, forms and JSON.
    name: &'static str,
    /// Description.
    doc: &'static str,
    /// Allowed values, in words.
    expected: String,
    /// Default value, in words.
    default: &'static str,
    /// Type of the values: `number`, `integer`, `boolean`, `choice` (one of `values`) or `text`.
    r#type: &'static str,
    /// Smallest value; numbers and integers only.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>, nullable = false)]
    min: Option<Value>,
    /// Largest value; numbers and integers only.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<f64>, nullable = false)]
    max: Option<Value>,
    /// Unit, empty if there is none; numbers only.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    unit: Option<&'static str>,
    /// Allowed values; choices only.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(nullable = false)]
    values: Option<&'static [&'static str]>,
}

/// Configured limits.
#[derive(Debug, Serialize, ToSchema)]
struct Limits {
    /// Largest request body, in bytes.
    body_bytes: u64,
    /// Largest JSON body, in bytes.
    json_bytes: u64,
    /// Largest head of a form part, in bytes.
    part_head_bytes: u64,
    /// Maximum number of parts of a form.
    parts: usize,
    /// Largest structure after decompression, in bytes.
    inflated_bytes: u64,
    /// Maximum number of atoms in all models of a structure.
    atoms: u64,
    /// Maximum number of atoms in a list of atoms or colours.
    labels: u64,
    /// Maximum number of grid points of a mesh.
    grid_points: u64,
    /// Maximum number of pairs of an atom and a grid brick of a mesh.
    candidate_pairs: u64,
    /// Largest mesh in memory, in bytes.
    mesh_bytes: u64,
    /// Largest mesh file, in bytes.
    output_bytes: u64,
    /// Memory for all uploads, jobs and meshes together, in bytes.
    memory_bytes: u64,
    /// Largest width and height of a picture, in pixels.
    picture_side: u32,
    /// Maximum number of jobs of each lane that run at the same time: short requests, long requests, asynchronous jobs.
    workers: usize,
    /// Maximum number of jobs in the queue of each lane of requests.
    queue: usize,
    /// Maximum number of concurrent mesh requests.
    deliveries: usize,
    /// Time limit of a synchronous request, in ms.
    deadline_ms: u64,
    /// Time limit of an asynchronous job, in ms.
    batch_deadline_ms: u64,
    /// Maximum number of starts of an asynchronous job.
    attempts: u32,
    /// Time limit for a request body, in ms.
    body_timeout_ms: u64,
    /// Time limit for the head of a request, in ms.
    header_timeout_ms: u64,
    /// Period in which a client must read `write_bytes`, in ms.
    write_timeout_ms: u64,
    /// Bytes that a client must read in each `write_timeout_ms`.
    write_bytes: u64,
    /// Maximum number of connections.
    connections: usize,
}

/// Backend that computes meshes or renders pictures.
#[derive(Debug, Serialize, ToSchema)]
struct BackendDocument {
    /// Name: `cpu` or `gpu`.
    name: &'static str,
    /// Device of the backend.
    device: String,
    /// Reason for the choice of the backend.
    reason: String,
}

/// Device of the machine.
#[derive(Debug, Serialize, ToSchema)]
struct DeviceDocument {
    /// Number that selects the device in the configuration.
    number: usize,
    /// Name.
    name: String,
    /// Kind of device.
    kind: &'static str,
    /// Graphics API.
    api: &'static str,
    /// Driver.
    driver: String,
    /// Largest storage buffer binding, in bytes.
    binding_bytes: u64,
    /// Largest buffer, in bytes.
    buffer_bytes: u64,
    /// Workgroup memory, in bytes.
    workgroup_bytes: u64,
    /// True if the device measures times.
    timestamps: bool,
    /// Smallest and largest number of threads in a subgroup; null if unknown.
    #[schema(required)]
    subgroups: Option<[u32; 2]>,
    /// True if the service uses the device.
    taken: bool,
    /// True if the device accepts jobs now.
    up: bool,
    /// Reason for the state of the device.
    reason: String,
}

/// Van der Waals radii.
#[derive(Debug, Serialize, ToSchema)]
struct Radii {
    /// Source of the radii.
    table: &'static str,
    /// Unit of the radii.
    unit: &'static str,
    /// Radius of elements that the table lacks.
    fallback: f32,
    /// Radii by element symbol.
    #[schema(value_type = std::collections::BTreeMap<String, f64>)]
    values: Map<String, Value>,
}

problem_responses!(ShowProblems: [PARAMETERS]);

/// List formats, parameters, limits and devices
#[utoipa::path(get, path = "/v1/capabilities", tag = "service", operation_id = "capabilities",
    responses((status = 200, description = "Formats, parameters, limits and devices.", body = Capabilities), ShowProblems))]
pub(super) async fn show(State(app): State<Shared>) -> Response {
    let headers = [(CONTENT_TYPE, "application/json"), (CACHE_CONTROL, "no-cache")];
    let body =
        if app.found.is_empty() { app.capabilities.clone() } else { document(&app.config, &app.pool, &app.found) };
    (headers, body).into_response()
}

/// Writes the document.
pub(super) fn document(config: &Config, pool: &Pool, found: &[FoundDevice]) -> Bytes {
    let (backend, renderer) = (pool.backend(), &pool.settings().renderer);
    let document = Capabilities {
        name: "molmesh",
        version: env!("CARGO_PKG_VERSION"),
        units: QuantityUnits { length: "Å", area: "Å²", volume: "Å³" },
        inputs: Inputs {
            formats: &["pdb", "mmcif", "bcif", "pqr", "xyz"],
            encodings: &["identity", "gzip", "zstd"],
            note: "The format is detected from the bytes; Content-Type is a hint.",
        },
        formats: Format::ALL.map(|f| FormatDocument { name: f.name(), media_type: f.media_type() }).into(),
        default_format: Format::default().name(),
        surfaces: SurfaceKind::ALL.iter().map(|k| k.name()).collect(),
        presets: presets(),
        parameters: TABLE.iter().map(parameter).collect(),
        limits: limits(config, pool),
        backends: vec![BackendDocument {
            name: backend.name(),
            device: backend.describe(),
            reason: pool.reason().to_owned(),
        }],
        renderers: vec![BackendDocument {
            name: renderer.renderer.name(),
            device: renderer.renderer.describe(),
            reason: renderer.reason.clone(),
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
            taken: found.selected,
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
    let Parameter { name, doc, default, domain } = *parameter;
    let (r#type, bounds, unit, values) = match domain {
        Domain::Number { min, max, unit } => ("number", Some([min.into(), max.into()]), Some(unit), None),
        Domain::Integer { min, max } => ("integer", Some([min.into(), max.into()]), None, None),
        Domain::Flag => ("boolean", None, None, None),
        Domain::Choice(values) => ("choice", None, None, Some(values)),
        Domain::Text { .. } => ("text", None, None, None),
    };
    let (min, max) = bounds.map(|[min, max]: [Value; 2]| (min, max)).unzip();
    ParameterDocument { name, doc, expected: domain.expected(), default, r#type, min, max, unit, values }
}

fn limits(config: &Config, pool: &Pool) -> Limits {
    let (limits, server, jobs) = (&config.limits, &config.server, &config.jobs);
    Limits {
        body_bytes: limits.body_bytes,
        json_bytes: upload::MAX_JSON_BYTES,
        part_head_bytes: form::MAX_HEAD_BYTES as u64,
        parts: form::MAX_PARTS,
        inflated_bytes: limits.inflated_bytes,
        atoms: limits.atoms,
        labels: limits.labels,
        grid_points: limits.grid_points,
        candidate_pairs: limits.candidate_pairs,
        mesh_bytes: limits.mesh_bytes,
        output_bytes: limits.output_bytes,
        memory_bytes: limits.memory_bytes,
        picture_side: limits.picture_side,
        workers: pool.settings().workers,
        queue: jobs.queue,
        deliveries: jobs.deliveries,
        deadline_ms: jobs.deadline_ms,
        batch_deadline_ms: jobs.batch_deadline_ms,
        attempts: jobs.attempts,
        body_timeout_ms: server.body_timeout_ms,
        header_timeout_ms: server.header_timeout_ms,
        write_timeout_ms: server.write_timeout_ms,
        write_bytes: pace::MIN_BYTES,
        connections: server.connections,
    }
}

/// Radii by element symbol, to the hundredth of an ångström that the sources give.
fn radii_by_symbol() -> Map<String, Value> {
    let radius = |number: u8| (f64::from(radii::vdw_radius(number)) * 100.0).round() / 100.0;
    (1u8..).zip(element::SYMBOLS).map(|(number, symbol)| (symbol.to_owned(), radius(number).into())).collect()
}
