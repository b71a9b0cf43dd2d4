//! Problems in the OpenAPI document: one schema, and the statuses and problem types of each operation.

use std::collections::BTreeMap;

use serde_json::{Value, json};
use utoipa::openapi::extensions::Extensions;
use utoipa::openapi::schema::{AdditionalProperties, SchemaFormat, SchemaType, Type};
use utoipa::openapi::{
    ArrayBuilder, ContentBuilder, Header, HeaderBuilder, KnownFormat, Object, ObjectBuilder, Ref, RefOr, Response,
    ResponseBuilder, Schema,
};
use utoipa::{PartialSchema, ToSchema};

use super::components::PROBLEM_TYPES_EXTENSION;
use crate::http::problem::MEDIA_TYPE;
use crate::http::problem_types::{PROBLEM_TYPES, ProblemEntry, ProblemType};

/// Description of the header `Content-Range`.
pub(super) const CONTENT_RANGE: &str = "`bytes FIRST-LAST/LENGTH`; `bytes */LENGTH` if the range is outside the file.";

/// Problems while a body is received.
pub(in crate::http) const BODY: &[ProblemType] = &[
    ProblemType::BadRequest,
    ProblemType::BodyTimeout,
    ProblemType::BodyTooLarge,
    ProblemType::UnsupportedMediaType,
    ProblemType::UnsupportedEncoding,
    ProblemType::TooMuchMemory,
    ProblemType::MemoryFull,
];
/// Further problems of a JSON body that names a structure.
pub(in crate::http) const NAMED_STRUCTURE: &[ProblemType] = &[
    ProblemType::NoSuchStructure,
    ProblemType::NotInArchive,
    ProblemType::EntryTooLarge,
    ProblemType::ArchiveUnavailable,
    ProblemType::StoreFailed,
];
/// Problems of parameters.
pub(in crate::http) const PARAMETERS: &[ProblemType] = &[ProblemType::BadRequest, ProblemType::BadParameter];
/// Problems of reading a structure.
pub(in crate::http) const READING: &[ProblemType] = &[
    ProblemType::InflatedTooLarge,
    ProblemType::UnreadableStructure,
    ProblemType::NoAtoms,
    ProblemType::TooManyAtoms,
    ProblemType::TooManyDuplicates,
];
/// Problems of a document of a structure, in addition to those of reading it.
pub(in crate::http) const LISTING: &[ProblemType] = &[
    ProblemType::BadRequest,
    ProblemType::BadParameter,
    ProblemType::PreconditionFailed,
    ProblemType::EmptySelection,
    ProblemType::TooManyCandidates,
    ProblemType::TooMuchMemory,
    ProblemType::MemoryFull,
    ProblemType::QueueFull,
    ProblemType::TooManyDeliveries,
    ProblemType::ShareExceeded,
];
/// Problems of a job after the structure was read, and of its map.
pub(in crate::http) const MESHING: &[ProblemType] = &[
    ProblemType::UnreadableMap,
    ProblemType::MapTooLarge,
    ProblemType::EmptySelection,
    ProblemType::TooManyCopies,
    ProblemType::TooManyParts,
    ProblemType::GridTooLarge,
    ProblemType::TooManyCandidates,
    ProblemType::MeshTooLarge,
    ProblemType::PictureTooLarge,
    ProblemType::DeviceMemory,
    ProblemType::NoSurface,
    ProblemType::Internal,
    ProblemType::DeviceFailed,
    ProblemType::TooMuchMemory,
    ProblemType::MemoryFull,
    ProblemType::ShuttingDown,
    ProblemType::Deadline,
];
/// Problems of submitting a job.
pub(in crate::http) const SUBMITTING: &[ProblemType] = &[
    ProblemType::OtherRequest,
    ProblemType::QueueFull,
    ProblemType::TooManyJobs,
    ProblemType::TooManyDeliveries,
    ProblemType::ShareExceeded,
    ProblemType::StoreFull,
    ProblemType::StoreFailed,
    ProblemType::BrokerFailed,
];

/// Declares a type for `responses(…)` with the problems of one operation:
/// `problem_responses!(Name: [GROUP, …, [ProblemType::…, …]])`.
macro_rules! problem_responses {
    ($name:ident: [$($group:expr),+ $(,)?]) => {
        /// Problems of an operation.
        pub(in crate::http) enum $name {}

        impl utoipa::IntoResponses for $name {
            fn responses()
            -> std::collections::BTreeMap<String, utoipa::openapi::RefOr<utoipa::openapi::Response>> {
                let groups: &[&[$crate::http::problem_types::ProblemType]] = &[$(&$group[..]),+];
                $crate::http::openapi::problems::responses(groups)
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
    let described: Vec<String> = rows.iter().map(|row| format!("`{}`: {}.", row.slug, row.title)).collect();
    let names: Vec<&str> = rows.iter().map(|row| row.slug).collect();
    let problem = Ref::from_schema_name(ProblemDocument::name());
    let mut response = ResponseBuilder::new()
        .description(described.join(" "))
        .content(MEDIA_TYPE, ContentBuilder::new().schema(Some(problem)).build())
        .extensions(Some(Extensions::from_iter([(PROBLEM_TYPES_EXTENSION, Value::from(names))])));
    let has = |problem_types: &[ProblemType]| rows.iter().any(|row| problem_types.contains(&row.problem_type));
    if rows.iter().any(|row| row.status.is_server_error())
        || has(&[ProblemType::NoResultYet, ProblemType::ArchiveUnavailable, ProblemType::QuotaExceeded])
    {
        response = response.header("Retry-After", retry_after());
    }
    if has(&[ProblemType::QuotaExceeded]) {
        response = response
            .header("RateLimit-Policy", header(text(), "Quotas of the client, as a structured field."))
            .header("RateLimit", header(text(), "Remaining quota, as a structured field."));
    }
    if has(&[ProblemType::KeyRequired]) {
        response = response.header("WWW-Authenticate", header(text(), "`Bearer` and the reason (RFC 6750)."));
    }
    if has(&[ProblemType::RangeNotSatisfiable]) {
        response = response.header("Content-Range", header(text(), CONTENT_RANGE));
    }
    response.build()
}

/// Returns the header `Retry-After`.
pub(super) fn retry_after() -> Header {
    let int64 = SchemaFormat::KnownFormat(KnownFormat::Int64);
    let seconds = ObjectBuilder::new().schema_type(Type::Integer).format(Some(int64)).minimum(Some(0));
    header(seconds, "Seconds to wait before the next request. Absent if waiting does not help.")
}

fn text() -> ObjectBuilder {
    ObjectBuilder::new().schema_type(Type::String)
}

fn header(schema: ObjectBuilder, doc: &str) -> Header {
    HeaderBuilder::new().schema(Some(schema)).description(Some(doc)).build()
}

fn address(row: &ProblemEntry) -> String {
    format!("/problems/{}", row.slug)
}

/// Problem document (RFC 9457).
pub(in crate::http) enum ProblemDocument {}

impl ToSchema for ProblemDocument {
    fn name() -> std::borrow::Cow<'static, str> {
        "Problem".into()
    }
}

/// Member that some problem types add: name, type (`None`: any), description.
type Member = (&'static str, Option<Type>, &'static str);

/// Members that some problem types add.
const MEMBERS: &[Member] = &[
    ("parameter", Some(Type::String), "Name of the rejected parameter."),
    ("value", None, "The rejected value."),
    ("expected", Some(Type::String), "Allowed values, in words."),
    ("limit", Some(Type::Integer), "The limit that was exceeded."),
    ("actual", Some(Type::Integer), "The value that exceeds the limit."),
    ("resolution", Some(Type::Number), "Grid spacing of the rejected mesh in Å."),
    ("suggested_resolution", Some(Type::Number), "Grid spacing in Å at which the mesh should fit."),
    ("isovalue", Some(Type::Number), "Isovalue that the density does not reach."),
    ("estimated_wait_s", Some(Type::Number), "Estimated time in the queue in seconds."),
    ("line", Some(Type::Integer), "Line in the file or JSON document, from 1."),
    ("column", Some(Type::Integer), "Column in the line, or position in the expression, from 1."),
    (
        "location",
        Some(Type::String),
        "Position in a binary file: category, column, encoding, row (from 1) or byte (from 0). For an invalid assembly, its id.",
    ),
    ("atom", Some(Type::Integer), "Index of the atom, from 0."),
    ("found", None, "Content found where `expected` was required."),
    ("declared", Some(Type::String), "The `Content-Type` of the request."),
    ("encoding", Some(Type::String), "Compression of the file."),
    ("host", Some(Type::String), "Host name of the archive."),
    ("status_name", Some(Type::String), "Status of the job."),
    ("scope", Some(Type::String), "The scope that the key lacks."),
    ("expired", Some(Type::String), "Expiry time of the key or the signed URL."),
];

impl PartialSchema for ProblemDocument {
    fn schema() -> RefOr<Schema> {
        let text = |doc: &str| ObjectBuilder::new().schema_type(Type::String).description(Some(doc));
        let status = ObjectBuilder::new()
            .schema_type(Type::Integer)
            .format(Some(SchemaFormat::KnownFormat(KnownFormat::Int32)))
            .minimum(Some(400))
            .maximum(Some(599))
            .description(Some("HTTP status of the response."));
        let types: Vec<Value> = PROBLEM_TYPES.iter().map(|row| address(row).into()).collect();
        let strings =
            |doc: &str| ArrayBuilder::new().items(Object::with_type(Type::String)).description(Some(doc.to_owned()));
        let nearest = ObjectBuilder::new()
            .schema_type(SchemaType::from_iter([Type::String, Type::Null]))
            .description(Some("The known name closest to an unknown one."));
        let mut problem = ObjectBuilder::new()
            .description(Some("Error response (RFC 9457)."))
            .property("type", text("Path of the problem type; GET it for an explanation.").enum_values(Some(types)))
            .property("title", text("Short summary of the problem type."))
            .property("status", status)
            .property("detail", text("Explanation of this occurrence."))
            .property("instance", text("Id of the request, as in the server log."));
        for name in ["type", "title", "status", "detail", "instance"] {
            problem = problem.required(name);
        }
        for (name, kind, doc) in MEMBERS {
            let kind = kind.clone().map_or_else(|| SchemaType::AnyValue, SchemaType::new);
            problem = problem.property(*name, ObjectBuilder::new().schema_type(kind).description(Some(*doc)));
        }
        let position = ArrayBuilder::new()
            .items(Object::with_type(Type::Number))
            .description(Some("Coordinates x, y, z in Å at which too many atoms lie."));
        let list = |name: &str, doc: &str| {
            ArrayBuilder::new().items(Ref::from_schema_name(name)).description(Some(doc.to_owned()))
        };
        let problem = problem
            .property("nearest", nearest)
            .property("violated-policies", strings("Exhausted quotas: `requests`, `work` or `concurrency`."))
            .property("position", position)
            .property("available", strings("Accepted values, such as media types."))
            .property("checks", list("ReadinessCheck", "Results of the readiness checks."))
            .property("diagnostics", list("Finding", "Errors and warnings of the strict validator about the file."))
            .additional_properties(Some(AdditionalProperties::FreeForm(true)))
            .examples([json!({
                "type": "/problems/bad-parameter",
                "title": ProblemType::BadParameter.row().title,
                "status": 400,
                "detail": "unknown parameter `resolutoin`; did you mean `resolution`?",
                "instance": "0123456789abcdef",
                "parameter": "resolutoin",
                "nearest": "resolution",
            })]);
        RefOr::T(problem.build().into())
    }
}
