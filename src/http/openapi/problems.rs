//! Problems in the description: one schema, and for every operation the statuses that it can give with their types.

use std::collections::BTreeMap;

use axum::http::StatusCode;
use serde_json::Value;
use utoipa::openapi::schema::{AdditionalProperties, AllOfBuilder, SchemaFormat, SchemaType, Type};
use utoipa::openapi::{
    ArrayBuilder, ContentBuilder, Header, HeaderBuilder, KnownFormat, Object, ObjectBuilder, Ref, RefOr, Response,
    ResponseBuilder, Schema,
};
use utoipa::{PartialSchema, ToSchema};

use crate::http::kinds::{KINDS, Kind, Row};
use crate::http::problem::MEDIA_TYPE;

/// Problems of receiving a body.
pub(in crate::http) const BODY: &[Kind] = &[
    Kind::BadRequest,
    Kind::BodyTimeout,
    Kind::BodyTooLarge,
    Kind::UnsupportedMediaType,
    Kind::UnsupportedEncoding,
    Kind::MemoryFull,
];
/// Further problems of a JSON document that names a structure.
pub(in crate::http) const NAMED: &[Kind] =
    &[Kind::NoSuchStructure, Kind::NotInArchive, Kind::EntryTooLarge, Kind::ArchiveUnavailable, Kind::StoreFailed];
/// Problems of parameters.
pub(in crate::http) const PARAMETERS: &[Kind] = &[Kind::BadRequest, Kind::BadParameter];
/// Problems of reading a structure.
pub(in crate::http) const READING: &[Kind] =
    &[Kind::InflatedTooLarge, Kind::UnreadableStructure, Kind::NoAtoms, Kind::TooManyAtoms];
/// Problems of a job, without those of reading.
pub(in crate::http) const MESHING: &[Kind] = &[
    Kind::EmptySelection,
    Kind::GridTooLarge,
    Kind::TooManyCandidates,
    Kind::MeshTooLarge,
    Kind::PictureTooLarge,
    Kind::DeviceMemory,
    Kind::NoSurface,
    Kind::Internal,
    Kind::DeviceFailed,
    Kind::MemoryFull,
    Kind::ShuttingDown,
    Kind::Deadline,
];
/// Problems of requesting a job, before it runs.
pub(in crate::http) const ASKING: &[Kind] =
    &[Kind::OtherRequest, Kind::QueueFull, Kind::TooManyDeliveries, Kind::StoreFull, Kind::StoreFailed];

/// Names the problems of one operation: `refusals!(Name: [GROUP, …, [Kind::…, …]])` is a type for `responses(…)`.
macro_rules! refusals {
    ($name:ident: [$($group:expr),+ $(,)?]) => {
        /// The problems of an operation.
        pub(in crate::http) enum $name {}

        impl utoipa::IntoResponses for $name {
            fn responses()
            -> std::collections::BTreeMap<String, utoipa::openapi::RefOr<utoipa::openapi::Response>> {
                let groups: &[&[$crate::http::kinds::Kind]] = &[$(&$group[..]),+];
                $crate::http::openapi::problems::responses(groups)
            }
        }
    };
}
pub(in crate::http) use refusals;

/// The responses of some kinds, one per status.
pub(in crate::http) fn responses(groups: &[&[Kind]]) -> BTreeMap<String, RefOr<Response>> {
    let mut by_status: BTreeMap<String, Vec<&Row>> = BTreeMap::new();
    for row in KINDS.iter().filter(|row| groups.iter().any(|group| group.contains(&row.kind))) {
        by_status.entry(row.status.as_u16().to_string()).or_default().push(row);
    }
    by_status.into_iter().map(|(status, rows)| (status, RefOr::T(response(&rows)))).collect()
}

fn response(rows: &[&Row]) -> Response {
    let types: Vec<Value> = rows.iter().map(|row| address(row).into()).collect();
    let status = rows.first().map(|row| Value::from(row.status.as_u16()));
    let described: Vec<String> = rows.iter().map(|row| format!("`{}`: {}.", row.slug, row.title)).collect();
    let narrow = ObjectBuilder::new()
        .property("type", ObjectBuilder::new().schema_type(Type::String).enum_values(Some(types)))
        .property("status", ObjectBuilder::new().schema_type(Type::Integer).enum_values(Some(status)));
    let schema = AllOfBuilder::new().item(Ref::from_schema_name(ProblemDocument::name())).item(narrow);
    let mut response = ResponseBuilder::new()
        .description(described.join(" "))
        .content(MEDIA_TYPE, ContentBuilder::new().schema(Some(Schema::from(schema.build()))).build());
    if rows.iter().any(|row| row.status.is_server_error() || row.kind == Kind::NoResultYet || is_archives(row)) {
        let seconds = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(1)).maximum(Some(600));
        let doc = "Seconds after which trying again is worth it, where time alone can help.";
        response =
            response.header("Retry-After", HeaderBuilder::new().schema(Some(seconds)).description(Some(doc)).build());
    }
    if rows.iter().any(|row| row.kind == Kind::QuotaExceeded) {
        let seconds = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(1));
        response = response
            .header("Retry-After", header(seconds, "Seconds until there is some of the quota again."))
            .header("RateLimit-Policy", header(text(), "What the quota is, as a structured field."))
            .header("RateLimit", header(text(), "What is left of it, as a structured field."));
    }
    if rows.iter().any(|row| row.status == StatusCode::UNAUTHORIZED) {
        response = response.header("WWW-Authenticate", header(text(), "`Bearer`, and why (RFC 6750)."));
    }
    if rows.iter().any(|row| row.kind == Kind::RangeNotSatisfiable) {
        let text = ObjectBuilder::new().schema_type(Type::String);
        let doc = "`bytes */LENGTH`: how long the file is.";
        response =
            response.header("Content-Range", HeaderBuilder::new().schema(Some(text)).description(Some(doc)).build());
    }
    response.build()
}

fn text() -> ObjectBuilder {
    ObjectBuilder::new().schema_type(Type::String)
}

fn header(schema: ObjectBuilder, doc: &str) -> Header {
    HeaderBuilder::new().schema(Some(schema)).description(Some(doc)).build()
}

fn is_archives(row: &Row) -> bool {
    row.kind == Kind::ArchiveUnavailable
}

fn address(row: &Row) -> String {
    format!("/problems/{}", row.slug)
}

/// The document of a problem, after RFC 9457.
pub(in crate::http) enum ProblemDocument {}

impl ToSchema for ProblemDocument {
    fn name() -> std::borrow::Cow<'static, str> {
        "Problem".into()
    }
}

/// A member besides the standard's: its name, its type, what it says.
type Member = (&'static str, Option<Type>, &'static str);

/// Members that some kinds have.
const MEMBERS: &[Member] = &[
    ("parameter", Some(Type::String), "The parameter that is at fault."),
    ("value", None, "What was given."),
    ("expected", Some(Type::String), "What would be allowed, in words."),
    ("limit", Some(Type::Integer), "The limit that was reached."),
    ("actual", Some(Type::Integer), "What there is, or would be, instead."),
    ("resolution", Some(Type::Number), "The spacing of the grid, Å."),
    ("suggested_resolution", Some(Type::Number), "A spacing that would fit, Å."),
    ("isovalue", Some(Type::Number), "The level that the density does not reach."),
    ("estimated_wait_s", Some(Type::Number), "How long a job would wait, s."),
    ("line", Some(Type::Integer), "Where in the file, from 1."),
    ("column", Some(Type::Integer), "Where in the line, from 1."),
    ("place", Some(Type::String), "Where in a binary file: category, column, encoding, row (from 1) or byte (from 0)."),
    ("atom", Some(Type::Integer), "Which atom, from 0."),
    ("found", None, "What was found instead."),
    ("declared", Some(Type::String), "What `Content-Type` said."),
    ("encoding", Some(Type::String), "The compression of the file."),
    ("host", Some(Type::String), "The archive that was asked."),
    ("status_name", Some(Type::String), "How the job stands."),
    ("scope", Some(Type::String), "The scope that the key does not have."),
    ("expired", Some(Type::String), "When the key or the signed address ended."),
];

impl PartialSchema for ProblemDocument {
    fn schema() -> RefOr<Schema> {
        let text = |doc: &str| ObjectBuilder::new().schema_type(Type::String).description(Some(doc));
        let statuses = ObjectBuilder::new()
            .schema_type(Type::Integer)
            .format(Some(SchemaFormat::KnownFormat(KnownFormat::Int32)))
            .minimum(Some(400))
            .maximum(Some(599))
            .description(Some("The status of the answer."));
        let types: Vec<Value> = KINDS.iter().map(|row| address(row).into()).collect();
        let strings = ArrayBuilder::new().items(Object::with_type(Type::String));
        let nearest = ObjectBuilder::new()
            .schema_type(SchemaType::from_iter([Type::String, Type::Null]))
            .description(Some("The known name that is nearest to an unknown one."));
        let finding = ObjectBuilder::new()
            .property("level", text("`note`, `warning` or `error`."))
            .property("line", ObjectBuilder::new().schema_type(SchemaType::from_iter([Type::Integer, Type::Null])))
            .property("message", text("What it is."));
        let check = ObjectBuilder::new()
            .property("name", text("`accepting`, `devices` or `store`."))
            .property("ok", ObjectBuilder::new().schema_type(Type::Boolean))
            .property("detail", text("What was found."));
        let mut problem = ObjectBuilder::new()
            .description(Some("Something to tell the client instead of what it asked for (RFC 9457)."))
            .property("type", text("What kind of problem; GET it for an explanation.").enum_values(Some(types)))
            .property("title", text("The kind in a few words."))
            .property("status", statuses)
            .property("detail", text("What happened this time."))
            .property("instance", text("The request's id, which is in the log."));
        for name in ["type", "title", "status", "detail", "instance"] {
            problem = problem.required(name);
        }
        for (name, kind, doc) in MEMBERS {
            let kind = kind.clone().map_or_else(|| SchemaType::AnyValue, SchemaType::new);
            problem = problem.property(*name, ObjectBuilder::new().schema_type(kind).description(Some(*doc)));
        }
        let problem = problem
            .property("nearest", nearest)
            .property(
                "violated-policies",
                ArrayBuilder::new()
                    .items(Object::with_type(Type::String))
                    .description(Some("The quotas that are used up: `requests`, `work`, `concurrency`.")),
            )
            .property("available", strings.description(Some("What there is instead.")))
            .property("checks", ArrayBuilder::new().items(check).description(Some("What `/readyz` looked at.")))
            .property(
                "diagnostics",
                ArrayBuilder::new().items(finding).description(Some("What a second, strict reader says of the file.")),
            )
            .additional_properties(Some(AdditionalProperties::FreeForm(true)));
        RefOr::T(problem.build().into())
    }
}
