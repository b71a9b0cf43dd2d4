//! Problems in the OpenAPI document: one schema, and the statuses and problem types of each operation.

use std::collections::BTreeMap;

use serde_json::Value;
use utoipa::openapi::extensions::Extensions;
use utoipa::openapi::{ContentBuilder, Header, Object, Ref, RefOr, Response, ResponseBuilder, Schema};
use utoipa::{PartialSchema, ToSchema};

use super::components::PROBLEM_TYPES_EXTENSION;
use crate::http::problem::MEDIA_TYPE;
use crate::http::problem_types::{PROBLEM_TYPES, ProblemEntry, ProblemType};

/// Declares groups of problem types.
macro_rules! groups {
    ($($(#[$doc:meta])* $group:ident: $($problem_type:ident)+;)+) => {
        $($(#[$doc])* pub(in crate::http) const $group: &[ProblemType] = &[$(ProblemType::$problem_type),+];)+
    };
}

groups! {
    /// Problems while a body is received.
    BODY:
        BadRequest BodyTimeout BodyTooLarge UnsupportedMediaType UnsupportedEncoding TooMuchMemory MemoryFull;
    /// Problems of an operation that requires a scope.
    KEY: KeyRequired KeyInvalid KeyExpired ScopeMissing QuotaExceeded;
    /// Further problems of an operation that accepts signed URLs.
    SIGNED_URL: SignatureInvalid SignatureExpired;
    /// Problems of a path that names an uploaded structure.
    STRUCTURE: NoSuchStructure StoreFailed;
    /// Problems of a path that names an archive entry.
    ENTRY: NotInArchive EntryTooLarge ArchiveUnavailable;
    /// Problems of parameters.
    PARAMETERS: BadRequest BadParameter;
    /// Problems of reading a structure.
    READING: InflatedTooLarge UnreadableStructure NoAtoms TooManyAtoms TooManyDuplicates;
    /// Problems of waiting for a worker.
    WAITING: QueueFull TooManyDeliveries ShareExceeded;
    /// Problems of a document of a structure, in addition to those of reading it.
    LISTING:
        BadRequest BadParameter PreconditionFailed EmptySelection TooManyCandidates TooMuchMemory MemoryFull QueueFull
        TooManyDeliveries ShareExceeded;
    /// Problems of a job after the structure was read, and of its map.
    MESHING:
        UnreadableMap MapTooLarge EmptySelection TooManyCopies TooManyParts GridTooLarge TooManyCandidates MeshTooLarge
        PictureTooLarge DeviceMemory NoSurface Internal DeviceFailed TooMuchMemory MemoryFull ShuttingDown Deadline;
    /// Problems of submitting a job.
    SUBMITTING:
        OtherRequest QueueFull TooManyJobs TooManyDeliveries ShareExceeded StoreFull StoreFailed BrokerFailed;
    /// Problems of reading the record of a job.
    RECORD: BadRequest BadParameter NoSuchJob RecordUnreadable OtherRelease StoreFailed;
}

/// Declares a type for `responses(…)` with the problems of one operation, from groups and further types:
/// `problem_responses!(Name: [GROUP GROUP] ProblemType ProblemType)`.
macro_rules! problem_responses {
    ($name:ident: [$($group:ident)*] $($problem_type:ident)*) => {
        /// Problems of an operation.
        pub(in crate::http) enum $name {}

        impl utoipa::IntoResponses for $name {
            fn responses()
            -> std::collections::BTreeMap<String, utoipa::openapi::RefOr<utoipa::openapi::Response>> {
                use $crate::http::openapi::problems;
                problems::responses(&[
                    $(problems::$group,)*
                    &[$($crate::http::problem_types::ProblemType::$problem_type),*],
                ])
            }
        }
    };
}
pub(in crate::http) use problem_responses;

/// Returns the responses for some problem types, one per status.
pub(in crate::http) fn responses(groups: &[&[ProblemType]]) -> BTreeMap<String, RefOr<Response>> {
    let mut by_status: BTreeMap<String, Vec<&ProblemEntry>> = BTreeMap::new();
    for row in PROBLEM_TYPES.iter().filter(|row| groups.iter().any(|group| group.contains(&row.problem_type))) {
        by_status.entry(row.status.as_u16().to_string()).or_default().push(row);
    }
    by_status.into_iter().map(|(status, rows)| (status, RefOr::T(response(&rows)))).collect()
}

/// Returns the response for the problem types of one status.
fn response(rows: &[&ProblemEntry]) -> Response {
    // Titles only of few types: the document would be longer by 4 kB, and the schema of problems lists all types.
    let has_titles = rows.len() <= 2;
    let describe = |row: &&ProblemEntry| {
        if has_titles { format!("`{}`: {}.", row.slug, row.title) } else { format!("`{}`", row.slug) }
    };
    let described: Vec<String> = rows.iter().map(describe).collect();
    let names: Vec<&str> = rows.iter().map(|row| row.slug).collect();
    let problem = Ref::from_schema_name(ProblemDocument::name());
    let mut response = ResponseBuilder::new()
        .description(described.join(if has_titles { " " } else { ", " }))
        .content(MEDIA_TYPE, ContentBuilder::new().schema(Some(problem)).build())
        .extensions(Some(Extensions::from_iter([(PROBLEM_TYPES_EXTENSION, Value::from(names))])));
    let has = |problem_types: &[ProblemType]| rows.iter().any(|row| problem_types.contains(&row.problem_type));
    if rows.iter().any(|row| row.status.is_server_error())
        || has(&[ProblemType::NoResultYet, ProblemType::ArchiveUnavailable, ProblemType::QuotaExceeded])
    {
        response = with_headers(response, ["Retry-After"]);
    }
    if has(&[ProblemType::QuotaExceeded]) {
        response = with_headers(response, ["RateLimit-Policy", "RateLimit"]);
    }
    if has(&[ProblemType::KeyRequired]) {
        response = with_headers(response, ["WWW-Authenticate"]);
    }
    if has(&[ProblemType::RangeNotSatisfiable]) {
        response = with_headers(response, ["Content-Range"]);
    }
    response.build()
}

/// Adds headers, which `components.yaml` describes.
pub(super) fn with_headers<'a>(response: ResponseBuilder, names: impl IntoIterator<Item = &'a str>) -> ResponseBuilder {
    names.into_iter().fold(response, |response, name| response.header(name, Header::default()))
}

/// Problem document (RFC 9457).
pub(in crate::http) enum ProblemDocument {}

impl ToSchema for ProblemDocument {
    fn name() -> std::borrow::Cow<'static, str> {
        "Problem".into()
    }
}

/// Placeholder: `components.yaml` has the schema.
impl PartialSchema for ProblemDocument {
    fn schema() -> RefOr<Schema> {
        Object::new().into()
    }
}
