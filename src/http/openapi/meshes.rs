//! Answers with meshes in the description.

use std::collections::BTreeMap;

use utoipa::openapi::schema::{SchemaType, Type};
use utoipa::openapi::{
    Content, ContentBuilder, Header, HeaderBuilder, ObjectBuilder, Ref, RefOr, Response, ResponseBuilder, Schema,
};
use utoipa::{IntoResponses, ToSchema};

use crate::formats::Format;
use crate::http::delivery::{PICTURE, ReportDocument, SUMMARY};
use crate::http::jobs::JobDocument;

fn header(kind: Type, doc: &str) -> Header {
    HeaderBuilder::new().schema(Some(ObjectBuilder::new().schema_type(kind))).description(Some(doc)).build()
}

fn text(doc: &str) -> Header {
    header(Type::String, doc)
}

/// Summary headers with their descriptions, in the order of [`SUMMARY`].
fn summary() -> impl Iterator<Item = (&'static str, Header)> {
    let of = |name: &str| match name {
        "molmesh-atoms" | "molmesh-vertices" | "molmesh-triangles" | "molmesh-components" | "molmesh-euler" => {
            Type::Integer
        }
        "molmesh-area" | "molmesh-volume" | "molmesh-resolution" | "molmesh-isovalue" => Type::Number,
        "molmesh-closed" | "molmesh-manifold" => Type::Boolean,
        _ => Type::String,
    };
    let summary = SUMMARY.into_iter().map(move |name| {
        let member = name.trim_start_matches("molmesh-").replace('-', "_");
        (name, header(of(name), &format!("`{member}` of the report.")))
    });
    let picture = PICTURE.into_iter().map(|(name, member)| {
        let kind = if member == "pixel" { Type::Number } else { Type::String };
        (name, header(kind, &format!("`{member}` of the report's `picture`; a picture alone has it.")))
    });
    summary.chain(picture)
}

/// The schema of a mesh file: bytes, of which the format's own standard says more.
fn file() -> Content {
    ContentBuilder::new().schema(Some(Schema::from(ObjectBuilder::new().schema_type(SchemaType::AnyValue)))).build()
}

fn reference<T: ToSchema>() -> Content {
    ContentBuilder::new().schema(Some(Ref::from_schema_name(T::name()))).build()
}

fn mesh(doc: &str) -> ResponseBuilder {
    let response = ResponseBuilder::new()
        .description(doc)
        .header("Content-Disposition", text("A file name."))
        .header(
            "ETag",
            text(
                "The strong validator of the file: SHA-256 over input, parameters, format, arithmetic (instruction set, or \
                 GPU and driver) and version. Equal tags mean equal bytes.",
            ),
        )
        .header(
            "Server-Timing",
            text(
                "Where the time went, ms: entries add up to `total`; `cache;desc=hit` for a file that was made before.",
            ),
        );
    let response = summary().fold(response, |response, (name, header)| response.header(name, header));
    Format::ALL.iter().fold(response, |response, format| response.content(format.media_type(), file()))
}

fn caching(response: ResponseBuilder) -> ResponseBuilder {
    response.header("Cache-Control", text("How long the file stays good."))
}

const LOCATION: &str = "Where the same bytes are found for as long as they are kept: /v1/results/….";

/// 202: a job.
fn promised() -> RefOr<Response> {
    let response = ResponseBuilder::new()
        .description("A job was accepted: the request has `Prefer: respond-async`, or `Prefer: wait=` and the mesh takes longer.")
        .content("application/json", reference::<JobDocument>())
        .header("Location", text("The job."))
        .header("Retry-After", header(Type::Integer, "Seconds after which asking for the job is worth it."))
        .header("Preference-Applied", text("`respond-async`, if that was wished for."))
        .header("Cache-Control", text("`no-store`."));
    RefOr::T(response.build())
}

/// 206: a part.
fn part() -> RefOr<Response> {
    let response = caching(mesh("The part of the file that was asked for."))
        .header("Content-Range", text("`bytes FIRST-LAST/LENGTH`."))
        .header("Accept-Ranges", text("`bytes`."));
    RefOr::T(response.build())
}

/// 304: nothing.
fn unchanged() -> RefOr<Response> {
    let response = ResponseBuilder::new()
        .description("The client has it already.")
        .header("ETag", text("The validator that holds."))
        .header("Cache-Control", text("How long it stays good."));
    RefOr::T(response.build())
}

/// The answers to an upload.
pub(in crate::http) enum Uploaded {}

impl IntoResponses for Uploaded {
    fn responses() -> BTreeMap<String, RefOr<Response>> {
        let whole = mesh("The mesh, or its report with `report=json`.")
            .content("application/json", reference::<ReportDocument>())
            .header("Content-Location", text(LOCATION))
            .header("Vary", text("`accept`."));
        BTreeMap::from([("200".to_owned(), RefOr::T(whole.build())), ("202".to_owned(), promised())])
    }
}

/// The answers under an address that names a structure.
pub(in crate::http) enum Addressed {}

impl IntoResponses for Addressed {
    fn responses() -> BTreeMap<String, RefOr<Response>> {
        let whole = caching(mesh("The mesh, or its report with `report=json`."))
            .content("application/json", reference::<ReportDocument>())
            .header("Content-Location", text(LOCATION));
        BTreeMap::from([
            ("200".to_owned(), RefOr::T(whole.build())),
            ("202".to_owned(), promised()),
            ("206".to_owned(), part()),
            ("304".to_owned(), unchanged()),
        ])
    }
}

/// The answers under a result's own address.
pub(in crate::http) enum Kept {}

impl IntoResponses for Kept {
    fn responses() -> BTreeMap<String, RefOr<Response>> {
        let whole = caching(mesh("The file, byte for byte as it was made."))
            .header("Content-Location", text("This address."))
            .header("Accept-Ranges", text("`bytes`."));
        BTreeMap::from([
            ("200".to_owned(), RefOr::T(whole.build())),
            ("206".to_owned(), part()),
            ("304".to_owned(), unchanged()),
        ])
    }
}

/// 304, for documents.
pub(in crate::http) enum NotModified {}

impl IntoResponses for NotModified {
    fn responses() -> BTreeMap<String, RefOr<Response>> {
        BTreeMap::from([("304".to_owned(), unchanged())])
    }
}
