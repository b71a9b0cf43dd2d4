//! `POST /v1/meshes`: the mesh of an upload, or of what a JSON document names.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::rejection::QueryRejection;
use axum::extract::{Query, State};
use axum::http::header::{self, HeaderMap};
use axum::http::{Extensions, HeaderValue, Method};
use axum::response::Response;

use super::ask::{self, Ask, Input};
use super::declared::Declared;
use super::kinds::Kind;
use super::openapi::bodies::{STRUCTURE_TO_MESH, StructureFile};
use super::openapi::meshes::{Reported, Uploaded};
use super::openapi::parameters::{Coding, MeshParameters, Wishes};
use super::openapi::problems::{ASKING, BODY, MESHING, NAMED, PARAMETERS, READING};
use super::openapi::refusals;
use super::problem::Problem;
use super::state::{App, Shared};
use super::timing::Timing;
use super::upload::{self, Upload};
use super::wish::Wish;
use super::{document, negotiate, pdb, structures};
use crate::formats::Format;
use crate::pipeline::params::{self, Request};
use crate::store::Digest;
use crate::structure::EntryId;

/// A query as pairs, in order.
pub(super) type Pairs = Result<Query<Vec<(String, String)>>, QueryRejection>;

/// The pairs of a query.
pub(super) fn pairs(query: Pairs) -> Result<Vec<(String, String)>, Problem> {
    let Query(pairs) = query.map_err(|e| Problem::new(Kind::BadRequest, e.body_text()))?;
    Ok(pairs)
}

/// What a body asks for.
pub(super) struct Taken {
    pub(super) request: Request,
    pub(super) pairs: Vec<(String, String)>,
    pub(super) format: Format,
    pub(super) digest: Digest,
    pub(super) declared: Declared,
    /// The bytes, or what names them.
    source: Source,
}

impl Taken {
    /// The bytes.
    pub(super) async fn input(self, app: &Shared) -> Result<Input, Problem> {
        self.source.input(app).await
    }
}

refusals!(MeshRefusals: [BODY, NAMED, PARAMETERS, READING, MESHING, ASKING, [Kind::NotAcceptable]]);

/// Mesh a structure
///
/// The parameter `format` sets the format of the mesh; without it the server uses the format that `Accept` prefers, or
/// GLB. `POST /v1/report` returns the report without the mesh.
#[utoipa::path(post, path = "/v1/meshes", tag = "meshes", operation_id = "createMesh",
    params(MeshParameters, Wishes, Coding),
    request_body(content = StructureFile, description = STRUCTURE_TO_MESH, content_type = "application/octet-stream"),
    responses(Uploaded, MeshRefusals))]
pub(super) async fn create(
    State(app): State<Shared>,
    query: Pairs,
    headers: HeaderMap,
    extensions: Extensions,
    body: Body,
) -> Result<Response, Problem> {
    answer(&app, query, &headers, &extensions, body, false).await
}

refusals!(ReportRefusals: [
    BODY, NAMED, PARAMETERS, READING, MESHING, [Kind::QueueFull, Kind::TooManyDeliveries],
]);

/// Mesh a structure and return the report
///
/// Takes what `POST /v1/meshes` takes, computes the mesh and returns its report instead of the file: atoms, grid, area,
/// volume, components, voids, validation and times.
#[utoipa::path(post, path = "/v1/report", tag = "meshes", operation_id = "createReport",
    params(MeshParameters, Coding),
    request_body(content = StructureFile, description = STRUCTURE_TO_MESH, content_type = "application/octet-stream"),
    responses(Reported, ReportRefusals))]
pub(super) async fn report(
    State(app): State<Shared>,
    query: Pairs,
    mut headers: HeaderMap,
    extensions: Extensions,
    body: Body,
) -> Result<Response, Problem> {
    // `Accept` applies to the report, not to a mesh format.
    headers.remove(header::ACCEPT);
    answer(&app, query, &headers, &extensions, body, true).await
}

/// Answers an upload with its mesh or its report.
async fn answer(
    app: &Shared,
    query: Pairs,
    headers: &HeaderMap,
    extensions: &Extensions,
    body: Body,
    report: bool,
) -> Result<Response, Problem> {
    let mut timing = Timing::start();
    let wish = Wish::of(headers, extensions)?;
    let taken = take(app, query, headers, body).await?;
    let Taken { request, pairs, format, digest, declared, source } = taken;
    timing.lap("receive");
    let mut ask = Ask { digest, request, pairs, format, wish, report, cache: None, timing, declared };
    // What a type says about the bytes is found out by reading them.
    let known =
        if ask.declared.is_structure() { None } else { ask.known(app, &Method::POST, &HeaderMap::new()).await? };
    let mut response = if let Some(response) = known {
        response
    } else {
        ask.timing.lap("lookup");
        let input = source.input(app).await?;
        ask.timing.lap("load");
        ask.make(app, input).await?
    };
    if !report {
        response.headers_mut().append(header::VARY, HeaderValue::from_static("accept"));
    }
    Ok(response)
}

/// Receives what a body asks for.
pub(super) async fn take(app: &Shared, query: Pairs, headers: &HeaderMap, body: Body) -> Result<Taken, Problem> {
    let mut pairs = pairs(query)?;
    // A request that will be refused is refused before its body is received.
    let mut request = params::parse(pairs.iter().map(|(n, v)| (n, v)))?;
    let is_json = upload::is_json(headers);
    let late = is_json || upload::is_multipart(headers);
    let early = if late { None } else { Some(settled(app, &mut request, headers)?) };
    let received = if is_json {
        upload::receive_json(app, headers, body).await
    } else {
        upload::receive(app, headers, body).await
    };
    let Upload { bytes, lease, fields, declared } = received?;
    let (source, fields) = if is_json {
        named(&bytes)?
    } else {
        let digest = ask::digest(&bytes).await?;
        (Source::Sent(Input { bytes, digest, lease: Arc::new(lease) }), fields)
    };
    if late {
        pairs.extend(fields);
        request = params::parse(pairs.iter().map(|(n, v)| (n, v)))?;
    }
    let format = early.map_or_else(|| settled(app, &mut request, headers), Ok)?;
    let digest = match &source {
        Source::Sent(input) => input.digest,
        Source::Entry(id) => pdb::digest(app, id).await?,
        Source::Structure(digest) => *digest,
    };
    // The type of a document that names a structure says nothing about the structure.
    let declared = if matches!(source, Source::Sent(_)) { declared } else { Declared::Neutral };
    Ok(Taken { request, pairs, format, digest, declared, source })
}

/// Returns the format of the mesh and adapts the request to it.
fn settled(app: &App, request: &mut Request, headers: &HeaderMap) -> Result<Format, Problem> {
    let format = request.format.map_or_else(|| negotiate::format(headers), Ok)?;
    params::settle(&mut request.job, format)?;
    app.accepts(&request.job)?;
    Ok(format)
}

/// Where the bytes come from.
enum Source {
    /// They were sent.
    Sent(Input),
    /// An entry of the archive is named.
    Entry(EntryId),
    /// A structure that was uploaded is named.
    Structure(Digest),
}

impl Source {
    async fn input(self, app: &Shared) -> Result<Input, Problem> {
        match self {
            Self::Sent(input) => Ok(input),
            Self::Entry(id) => pdb::input(app, &id).await,
            Self::Structure(digest) => structures::input(app, &digest).await,
        }
    }
}

/// Reads `{"pdb_id": …}` or `{"structure": …}` with parameters beside it.
fn named(bytes: &[u8]) -> Result<(Source, Vec<(String, String)>), Problem> {
    let (mut source, mut fields) = (None, Vec::new());
    for (name, text) in document::members(bytes)? {
        let found = match name.as_str() {
            "pdb_id" => Source::Entry(text.parse().map_err(|error| pdb::of_folder(&error))?),
            "structure" => Source::Structure(structures::digest_of(&text)?),
            _ => {
                fields.push((name, text));
                continue;
            }
        };
        if source.replace(found).is_some() {
            return Err(document::bad("it names more than one structure"));
        }
    }
    let source = source.ok_or_else(|| document::bad("it names no structure: it has no `pdb_id` and no `structure`"))?;
    Ok((source, fields))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_members_become_parameters() {
        let (source, fields) =
            named(br#"{"pdb_id": "4PTI", "resolution": 0.5, "chains": ["A", "B"], "atom_ids": true}"#).ok().unwrap();
        assert!(matches!(source, Source::Entry(id) if id.as_str() == "4pti"));
        let expected = [("resolution", "0.5"), ("chains", "A,B"), ("atom_ids", "true")];
        assert_eq!(fields, expected.map(|(n, v)| (n.to_owned(), v.to_owned())));
        for bad in [
            "[]",
            "{",
            "{}",
            "{\"resolution\": 1}",
            "{\"pdb_id\": {}}",
            "{\"pdb_id\": \"../x\"}",
            "{\"pdb_id\": null}",
            "{\"structure\": \"xyz\"}",
            "{\"pdb_id\": \"4pti\", \"chains\": []}",
        ] {
            assert!(named(bad.as_bytes()).is_err(), "{bad}");
        }
    }
}
