//! `…/colors`: the colour of every atom of a structure, so that clients can recolour a mesh that has `_ATOM`.

use std::fmt::Write as _;

use axum::body::Body;
use axum::http::header::{self, HeaderMap, HeaderName, HeaderValue};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::atoms::SELECTED_BYTES;
use super::color_parameters::{self, expected};
use super::delivery;
use super::document;
use super::guard::Caller;
use super::openapi::meshes::AtomColorsResponse;
use super::openapi::parameters::{ColorParameters, ConditionHeaders, RangeHeaders, StructurePath};
use super::openapi::problem_responses;
use super::parsed_request::Pairs;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::source::{self, DocumentRequest, Loaded};
use super::state::{Delivery, Shared};
use crate::jobs::MemoryReservation;
use crate::pipeline::{AtomColors, ColorError, Coloring, Options, params};
use crate::structure::{self, ReadLimits, Structure};
use crate::surface::Control;

/// Header with scheme, palette, range and legend.
pub(super) const LEGEND: HeaderName = HeaderName::from_static("molmesh-colors");
/// Largest number of entries of the legend, which must fit into a header.
const MAX_ENTRIES: usize = 24;

problem_responses!(Problems: [READING LISTING] RangeNotSatisfiable);

/// Get the colours of the atoms of a structure
///
/// Four bytes for each atom of the file, in file order: red, green, blue (sRGB) and alpha. A mesh with `atom_ids=true`
/// has a vertex attribute `_ATOM` (`atom` in PLY), the index of the atom in this list, so a client can recolour the
/// vertices without requesting a new mesh. The header `Molmesh-Colors` describes the colours.
#[utoipa::path(
    get,
    path = "/v1/structures/{digest}/colors",
    tag = "structures",
    operation_id = "colorAtoms",
    params(StructurePath, ColorParameters, ConditionHeaders, RangeHeaders),
    responses(AtomColorsResponse, Problems)
)]
pub(super) async fn list(request: DocumentRequest, query: Pairs) -> Result<Response, Problem> {
    let DocumentRequest { app, caller, headers, .. } = &request;
    let (options, coloring) = color_parameters::parse(&query.0)?;
    let variant = params::canonical(&options);
    let write = async |loaded: Loaded, delivery| {
        let etag = source::etag(&loaded.digest, &variant)?;
        let (colors, legend) = write_list(app, caller, loaded, delivery, options, coloring).await?;
        let described =
            [(header::CONTENT_TYPE, HeaderValue::from_static("application/octet-stream")), (LEGEND, legend)];
        Ok((described, part_of(&colors, headers, &etag)?).into_response())
    };
    request.document(&variant, None, write).await
}

/// Lists the colours of the atoms, with their legend.
async fn write_list(
    app: &Shared,
    caller: &Caller,
    loaded: Loaded,
    delivery: Delivery,
    options: Options,
    coloring: Coloring,
) -> Result<(Bytes, HeaderValue), Problem> {
    let max_atoms = app.config.limits.job().read.max_atoms;
    let list = move |structure: &Structure, limits: &ReadLimits, control: &Control<'_>, memory: MemoryReservation| {
        // The list has the atoms of the file. Copies in an assembly affect only the range of numbers.
        let limits = ReadLimits { max_atoms, ..*limits };
        control.memory.grow(SELECTED_BYTES * structure.len() as u64)?;
        let selected = structure::select_with(structure, &options.selection, &limits, control)?.atoms;
        let colors = AtomColors::new(structure, &selected, &coloring).map_err(not_colorable)?;
        let list = document::collect(memory, control, |out| {
            (0..structure.len()).try_for_each(|i| out.write_all(&colors.of(i)))
        })?;
        let mut report = colors.report(&selected);
        report.legend.truncate(MAX_ENTRIES);
        let legend = serde_json::to_string(&report).map_err(Problem::internal)?;
        Ok((list, HeaderValue::from_str(&ascii(&legend)).map_err(Problem::internal)?))
    };
    loaded.list_atoms(app, caller, delivery, list).await
}

fn not_colorable(error: ColorError) -> Problem {
    Problem::new(
        ProblemType::BadParameter,
        format!("parameter `scheme`: `{}` cannot be applied: {}", error.scheme, error.why),
    )
    .with("parameter", "scheme")
    .with("value", error.scheme)
    .with("expected", expected())
}

/// Escapes the characters of a JSON text that a header cannot contain.
fn ascii(json: &str) -> String {
    let mut text = String::with_capacity(json.len());
    for c in json.chars() {
        match c {
            ' '..='~' => text.push(c),
            _ => c.encode_utf16(&mut [0; 2]).iter().for_each(|unit| {
                // Writing to a string cannot fail.
                write!(text, "\\u{unit:04x}").unwrap_or_default();
            }),
        }
    }
    text
}

/// Returns a response with the list or the requested part of it.
fn part_of(list: &Bytes, headers: &HeaderMap, etag: &HeaderValue) -> Result<Response, Problem> {
    let (part, status, headers) = delivery::requested_part(headers, etag, list.len() as u64)?;
    let [from, to] = [part.start, part.end].map(|at| usize::try_from(at).unwrap_or(list.len()));
    Ok((status, headers, Body::from(list.slice(from..to))).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn legends_fit_a_header() {
        let text = ascii(r#"{"label":"Ä🧬 b"}"#);
        assert_eq!(text, r#"{"label":"\u00c4\ud83e\uddec b"}"#);
        assert_eq!(serde_json::from_str::<serde_json::Value>(&text).unwrap()["label"], "Ä🧬 b");
    }
}
