//! `POST /v1/estimate`: what a mesh would cost, and what would fit if it were refused. Takes what `POST /v1/meshes` takes.

use std::sync::Arc;

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::header::{CACHE_CONTROL, HeaderMap};
use axum::response::{IntoResponse, Response};
use serde_json::{Value, json};

use super::ask::Input;
use super::meshes::{self, Pairs};
use super::problem::Problem;
use super::state::Shared;
use crate::formats::Format;
use crate::jobs::Failure;
use crate::pipeline::{self, Choice, Estimate, Job};
use crate::surface::CancelToken;

/// Stops the work when its request ends.
struct StopOnDrop(CancelToken);

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        self.0.cancel();
    }
}

/// Estimates the mesh of the body.
pub(super) async fn create(
    State(app): State<Shared>,
    query: Pairs,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    let taken = meshes::take(&app, query, &headers, body).await?;
    let format = taken.request.format.unwrap_or_default();
    // Half a mesh is work as well: it takes a place among those that are made.
    let place = app.delivery()?;
    let (declared, job) = (taken.declared.clone(), taken.request.job.clone());
    let Input { bytes, digest, lease } = taken.input(&app).await?;
    let seconds = app.pool.expected(&bytes, &job);
    let stop = StopOnDrop(CancelToken::default());
    let limits = pipeline::JobLimits {
        deadline: Some(std::time::Instant::now() + app.config.jobs.deadline()),
        ..app.config.limits.job()
    };
    let estimating = tokio::task::spawn_blocking({
        let (app, cancel, job) = (Arc::clone(&app), stop.0.clone(), job.clone());
        move || {
            let choice = Choice { backend: app.pool.backend().as_ref(), reason: app.pool.reason() };
            let estimate = pipeline::estimate(&bytes, &job, &limits, &choice, &cancel);
            drop((lease, place));
            estimate
        }
    });
    let estimate = estimating
        .await
        .map_err(Problem::internal)?
        .map_err(|error| declared.explain(Failure::Job { error, diagnostics: Vec::new() }))?;
    drop(stop);
    let wait = app.pool.estimated_wait().as_secs_f64();
    let mut document = document(&estimate, &job, format, app.config.limits.output_bytes);
    if let Some(members) = document.as_object_mut() {
        members.insert("structure".to_owned(), digest.to_string().into());
        members.insert("seconds".to_owned(), seconds.into());
        members.insert("wait_seconds".to_owned(), wait.into());
        members.insert("backend".to_owned(), app.pool.backend().name().into());
    }
    Ok(([(CACHE_CONTROL, "no-store")], Json(document)).into_response())
}

fn document(estimate: &Estimate, job: &Job, format: Format, limit: u64) -> Value {
    let problem = match &estimate.mesh {
        Ok(mesh) if mesh.bytes > limit => {
            Some(super::problem::file_too_large(mesh.bytes, limit, job.params.resolution))
        }
        Ok(_) => None,
        Err(error) => Some(Problem::from(error.clone())),
    };
    let mesh = estimate.mesh.as_ref().ok();
    json!({
        "accepted": problem.is_none(),
        "problem": problem.map(|problem| problem.record()),
        "atoms": estimate.atoms,
        "atoms_in_file": estimate.atoms_in_file,
        "resolution": job.params.resolution,
        "kernel": job.params.kernel.name(),
        "format": format.extension(),
        "box_cells": estimate.box_cells,
        "bricks": mesh.map(|m| m.bricks),
        "samples": mesh.map(|m| m.samples),
        "area": mesh.map(|m| m.area),
        "vertices": mesh.map(|m| m.vertices),
        "triangles": mesh.map(|m| m.triangles),
        "mesh_bytes": mesh.map(|m| m.bytes),
    })
}
