//! Mesh responses in the OpenAPI document.

use std::collections::BTreeMap;

use utoipa::openapi::link::Link;
use utoipa::openapi::{Content, ContentBuilder, Header, Ref, RefOr, Response, ResponseBuilder};
use utoipa::{IntoResponses, ToSchema};

use super::bodies::binary;
use super::problems::with_headers;
use crate::formats::Format;
use crate::http::delivery::{PICTURE, ReportDocument, SUMMARY};
use crate::http::jobs::JobDocument;
use crate::http::negotiate::OCTETS;

/// Adds the headers that summarize the report.
fn summarized(response: ResponseBuilder) -> ResponseBuilder {
    with_headers(response, SUMMARY.iter().chain(&PICTURE).map(|summary| summary.name))
}

fn reference<T: ToSchema>() -> Content {
    ContentBuilder::new().schema(Some(Ref::from_schema_name(T::name()))).build()
}

/// 200: the whole file. `model/*` stands for all types that begin with `model/`: client generators treat types that end
/// in `+json` as JSON documents.
fn whole() -> RefOr<Response> {
    let doc = "The mesh. Its media type follows from the format: `model/gltf-binary` (glb), `model/gltf+json` (gltf), \
               `application/ply`, `model/x-ply-text`, `model/stl`, `model/obj`, `model/x-vtp`, \
               `model/x-msms-vert`, `model/x-msms-face` or `image/png`; `application/octet-stream` if `Accept` \
               prefers it.";
    let response = ResponseBuilder::new().description(doc);
    let response = with_headers(response, ["ETag", "Cache-Control", "Accept-Ranges"]);
    let response = with_headers(response, ["Content-Disposition", "Content-Location", "Server-Timing", "Vary"]);
    let file = || ContentBuilder::new().schema(Some(binary("Bytes of the file."))).build();
    let types = Format::ALL.map(Format::media_type).into_iter();
    let others = types.filter(|media_type| !media_type.starts_with("model/"));
    let types = [OCTETS, "model/*"].into_iter().chain(others);
    let add = |response: ResponseBuilder, media_type| response.content(media_type, file());
    RefOr::T(types.fold(summarized(response), add).build())
}

/// 202: a job, with links to the operations on it.
fn accepted() -> RefOr<Response> {
    let link = |operation: &str, doc: &str| {
        Link::builder().operation_id(operation).parameter("id", "$response.body#/jobID").description(doc).build()
    };
    let response = ResponseBuilder::new()
        .description("A job was accepted: the request has `Prefer: respond-async`, or `Prefer: wait=` and the mesh takes longer.")
        .content("application/json", reference::<JobDocument>())
        .link("job", link("showJob", "Status of the job."))
        .link("events", link("watchJob", "Events of the job."))
        .link("result", link("showJobResult", "Result of the job."))
        .link("cancel", link("dismissJob", "Cancels the job."));
    RefOr::T(with_headers(response, ["Location", "Retry-After", "Preference-Applied"]).build())
}

/// 206: a part of the content, described like that of status 200, with other headers.
fn part_of(whole: RefOr<Response>) -> RefOr<Response> {
    let RefOr::T(mut response) = whole else { return whole };
    "The requested part of the file, with the headers of status 200.".clone_into(&mut response.description);
    response.headers.clear();
    response.headers.insert("Content-Range".to_owned(), Header::default().into());
    RefOr::T(response)
}

/// 200: the colours of atoms.
fn colors() -> RefOr<Response> {
    let list = ContentBuilder::new().schema(Some(binary("Red, green, blue and alpha of each atom."))).build();
    let response = ResponseBuilder::new().description("The colours, four bytes per atom.").content(OCTETS, list);
    RefOr::T(with_headers(response, ["ETag", "Cache-Control", "Accept-Ranges", "molmesh-colors"]).build())
}

/// 304: the client has the current version.
fn unchanged() -> RefOr<Response> {
    let response = ResponseBuilder::new().description("The client already has the current version.");
    RefOr::T(with_headers(response, ["ETag", "Cache-Control"]).build())
}

/// Declares a type that describes responses by status.
macro_rules! answers {
    ($(#[$doc:meta])* $type:ident: $($status:literal: $response:expr),+) => {
        $(#[$doc])*
        pub(in crate::http) enum $type {}

        impl IntoResponses for $type {
            fn responses() -> BTreeMap<String, RefOr<Response>> {
                BTreeMap::from([$(($status.to_owned(), $response)),+])
            }
        }
    };
}

answers!(
    /// Responses to an upload.
    MeshOrJob: "200": whole(), "202": accepted()
);
answers!(
    /// Responses of a path that names a structure.
    CacheableMeshOrJob: "200": whole(), "202": accepted(), "206": part_of(whole()), "304": unchanged()
);
answers!(
    /// Responses of a stored result.
    StoredMesh: "200": whole(), "206": part_of(whole()), "304": unchanged()
);
answers!(
    /// Responses with the colours of atoms.
    AtomColorsResponse: "200": colors(), "206": part_of(colors()), "304": unchanged()
);
answers!(
    /// Response of a conditional request for a document.
    NotModified: "304": unchanged()
);
answers!(
    /// Response with a report.
    ReportResponse: "200": report()
);

fn report() -> RefOr<Response> {
    let response = ResponseBuilder::new()
        .description("The report. It is not cached, because its times are those of this request.")
        .content("application/json", reference::<ReportDocument>());
    RefOr::T(summarized(with_headers(response, ["Server-Timing"])).build())
}
