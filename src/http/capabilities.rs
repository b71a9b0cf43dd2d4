//! `/v1/capabilities`: what the service can do and what it refuses, for front-ends that build their forms from it.

use axum::extract::State;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use serde_json::{Map, Value, json};

use super::state::Shared;
use crate::config::Config;
use crate::formats::Format;
use crate::jobs::Pool;
use crate::pipeline::params::{Domain, Parameter, TABLE};
use crate::structure::{element, radii};
use crate::surface::{DeviceStatus, FoundDevice, Kernel, Preset, SurfaceOptions, SurfaceParams};

/// The document.
pub(super) async fn show(State(app): State<Shared>) -> Response {
    let headers = [(CONTENT_TYPE, "application/json"), (CACHE_CONTROL, "no-cache")];
    let body =
        if app.found.is_empty() { app.capabilities.clone() } else { document(&app.config, &app.pool, &app.found) };
    (headers, body).into_response()
}

/// Writes the document.
pub(super) fn document(config: &Config, pool: &Pool, found: &[FoundDevice]) -> Bytes {
    let formats: Vec<Value> =
        Format::ALL.iter().map(|f| json!({ "name": f.extension(), "media_type": f.media_type() })).collect();
    let document = json!({
        "name": "molmesh",
        "version": env!("CARGO_PKG_VERSION"),
        "units": { "length": "Å", "area": "Å²", "volume": "Å³" },
        "inputs": {
            "formats": ["pdb", "mmcif"],
            "encodings": ["identity", "gzip", "zstd"],
            "note": "The bytes are looked at; Content-Type is a hint.",
        },
        "formats": formats,
        "default_format": Format::default().extension(),
        "kernels": Kernel::ALL.iter().map(|k| k.name()).collect::<Vec<_>>(),
        "presets": presets(),
        "parameters": TABLE.iter().map(parameter).collect::<Vec<_>>(),
        "limits": limits(config, pool),
        "backends": [{
            "name": pool.backend().name(),
            "device": pool.backend().describe(),
            "reason": pool.reason(),
        }],
        "devices": devices(found, &pool.backend().devices()),
        "radii": { "table": radii::TABLE, "unit": "Å", "fallback": radii::FALLBACK, "values": radii_by_symbol() },
        "problems": "/problems",
    });
    Bytes::from(document.to_string())
}

/// Every device that was found; `up` says whether it takes jobs now, `reason` why or why not.
fn devices(found: &[FoundDevice], running: &[DeviceStatus]) -> Vec<Value> {
    let device = |found: &FoundDevice| {
        let status = running.iter().find(|status| status.number == found.number);
        let down = status.and_then(|status| status.down.as_ref());
        let facts = &found.facts;
        json!({
            "number": found.number,
            "name": facts.name,
            "kind": facts.kind.name(),
            "api": facts.api,
            "driver": facts.driver,
            "binding_bytes": facts.binding_bytes,
            "buffer_bytes": facts.buffer_bytes,
            "workgroup_bytes": facts.workgroup_bytes,
            "timestamps": facts.timestamps,
            "subgroups": facts.subgroups,
            "taken": found.taken,
            "up": status.is_some() && down.is_none(),
            "reason": down.unwrap_or(&found.reason),
        })
    };
    found.iter().map(device).collect()
}

/// Smoothness and isovalue of every preset, from the code that applies them.
fn presets() -> Map<String, Value> {
    let values = |preset: Preset| {
        let params = SurfaceParams::new(&SurfaceOptions { preset: Some(preset), ..SurfaceOptions::default() });
        params.map_or(Value::Null, |p| json!({ "smoothness": p.smoothness, "isovalue": p.isovalue }))
    };
    Preset::ALL.iter().map(|&preset| (preset.name().to_owned(), values(preset))).collect()
}

fn parameter(parameter: &Parameter) -> Value {
    let mut entry = json!({
        "name": parameter.name,
        "doc": parameter.doc,
        "expected": parameter.domain.expected(),
        "default": parameter.default,
    });
    let more = match parameter.domain {
        Domain::Number { min, max, unit } => json!({ "type": "number", "min": min, "max": max, "unit": unit }),
        Domain::Integer => json!({ "type": "integer" }),
        Domain::Flag => json!({ "type": "boolean" }),
        Domain::Choice(values) => json!({ "type": "choice", "values": values }),
        Domain::Set(values) => json!({ "type": "set", "values": values }),
        Domain::Text { .. } => json!({ "type": "text" }),
    };
    if let (Some(entry), Value::Object(more)) = (entry.as_object_mut(), more) {
        entry.extend(more);
    }
    entry
}

fn limits(config: &Config, pool: &Pool) -> Value {
    let (limits, server, jobs) = (&config.limits, &config.server, &config.jobs);
    json!({
        "body_bytes": limits.body_bytes,
        "inflated_bytes": limits.inflated_bytes,
        "atoms": limits.atoms,
        "grid_samples": limits.grid_samples,
        "mesh_bytes": limits.mesh_bytes,
        "output_bytes": limits.output_bytes,
        "memory_bytes": limits.memory_bytes,
        "workers": pool.workers(),
        "queue": jobs.queue,
        "deliveries": jobs.deliveries,
        "deadline_ms": jobs.deadline_ms,
        "sync_wait_ms": jobs.sync_wait_ms,
        "batch_deadline_ms": jobs.batch_deadline_ms,
        "attempts": jobs.attempts,
        "body_timeout_ms": server.body_timeout_ms,
        "header_timeout_ms": server.header_timeout_ms,
        "write_timeout_ms": server.write_timeout_ms,
        "connections": server.connections,
    })
}

/// Radii by element symbol, to the hundredth of an ångström that the sources give.
fn radii_by_symbol() -> Map<String, Value> {
    let radius = |number: u8| (f64::from(radii::vdw_radius(number)) * 100.0).round() / 100.0;
    (1u8..).zip(element::SYMBOLS).map(|(number, symbol)| (symbol.to_owned(), radius(number).into())).collect()
}
