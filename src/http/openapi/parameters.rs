//! Parameters in the description. Those of meshes are written from the one table that requests are read with.

use serde_json::Value;
use utoipa::IntoParams;
use utoipa::openapi::extensions::Extensions;
use utoipa::openapi::path::{Parameter, ParameterBuilder, ParameterIn, ParameterStyle};
use utoipa::openapi::schema::{SchemaFormat, Type};
use utoipa::openapi::{ArrayBuilder, KnownFormat, ObjectBuilder, Required, Schema};

use crate::formats::Format;
use crate::pipeline::params::{self, Domain, TABLE};

/// Place of a value; only some places have lists.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Place {
    /// A query, where lists are separated by commas.
    Query,
    /// A JSON document.
    Json,
    /// A form, where lists are text.
    Form,
}

/// The schema of a parameter's values.
pub(super) fn schema(parameter: &params::Parameter, place: Place) -> Schema {
    let doc = format!("{} Default: {}.", parameter.doc, parameter.default);
    let object = |kind: Type| ObjectBuilder::new().schema_type(kind).description(Some(doc.as_str()));
    let words = |words: &[&str]| words.iter().map(|word| Value::from(*word)).collect::<Vec<_>>();
    let number: Option<Value> = parameter.default.parse::<f64>().ok().map(Value::from);
    // A form has no use for what a query's schema tells front ends.
    let hints = if place == Place::Query { hints(parameter) } else { None };
    match parameter.domain {
        Domain::Number { min, max, .. } => {
            object(Type::Number).minimum(Some(min)).maximum(Some(max)).default(number).extensions(hints).into()
        }
        Domain::Integer { min, max } => {
            let wide = i32::try_from(min).is_err() || i32::try_from(max).is_err();
            let format = SchemaFormat::KnownFormat(if wide { KnownFormat::Int64 } else { KnownFormat::Int32 });
            object(Type::Integer).format(Some(format)).minimum(Some(min)).maximum(Some(max)).extensions(hints).into()
        }
        Domain::Flag => object(Type::Boolean).default(parameter.default.parse::<bool>().ok().map(Value::from)).into(),
        Domain::Choice(values) => {
            let default = values.contains(&parameter.default).then(|| Value::from(parameter.default));
            object(Type::String).enum_values(Some(words(values))).default(default).extensions(hints).into()
        }
        Domain::Set(values) if place == Place::Form => {
            let one = values.join("|");
            object(Type::String).pattern(Some(format!("^({one})(,({one}))*$"))).into()
        }
        Domain::Set(values) => {
            let item = ObjectBuilder::new().schema_type(Type::String).enum_values(Some(words(values)));
            ArrayBuilder::new().items(item).min_items(Some(1)).description(Some(doc)).into()
        }
        Domain::Text { expected } => {
            object(Type::String).min_length(Some(1)).title(Some(expected)).extensions(hints).into()
        }
    }
}

/// Hints for the controls of front ends, as `x-control`: `unit`, `usual` (the part of the bounds for a slider), `instead_of`
/// (parameters that cannot stand beside this one), and `format` (the only one that it goes with). One member, as their order would be anybody's.
fn hints(parameter: &params::Parameter) -> Option<Extensions> {
    let mut control = serde_json::Map::new();
    if let Domain::Number { unit, .. } = parameter.domain
        && !unit.is_empty()
    {
        control.insert("unit".to_owned(), unit.into());
    }
    if let Some(usual) = params::usual(parameter) {
        control.insert("usual".to_owned(), usual.to_vec().into());
    }
    if params::PICTURES.contains(&parameter.name) {
        control.insert("format".to_owned(), Format::Png.extension().into());
    }
    if params::SPACINGS.contains(&parameter.name) {
        let others: Vec<&str> = params::SPACINGS.into_iter().filter(|name| *name != parameter.name).collect();
        control.insert("instead_of".to_owned(), others.into());
    }
    (!control.is_empty()).then(|| Extensions::from_iter([("x-control", Value::from(control))]))
}

fn query(parameter: &params::Parameter) -> Parameter {
    let lists = matches!(parameter.domain, Domain::Set(_));
    ParameterBuilder::new()
        .name(parameter.name)
        .parameter_in(ParameterIn::Query)
        .required(Required::False)
        .description(Some(parameter.doc))
        .schema(Some(schema(parameter, Place::Query)))
        .style(lists.then_some(ParameterStyle::Form))
        .explode(lists.then_some(false))
        .build()
}

/// The parameters of a mesh.
pub(in crate::http) enum MeshParameters {}

impl IntoParams for MeshParameters {
    fn into_params(_: impl Fn() -> Option<ParameterIn>) -> Vec<Parameter> {
        TABLE.iter().map(query).collect()
    }
}

/// The parameters of a mesh whose address names its format.
pub(in crate::http) enum SurfaceParameters {}

impl IntoParams for SurfaceParameters {
    fn into_params(_: impl Fn() -> Option<ParameterIn>) -> Vec<Parameter> {
        let file = ObjectBuilder::new()
            .schema_type(Type::String)
            .enum_values(Some(Format::ALL.map(|format| format!("surface.{}", format.extension()))));
        let file = path("file", "The mesh, by the extension of its format; or `surface.png`, its picture.")
            .schema(Some(file))
            .build();
        std::iter::once(file).chain(TABLE.iter().filter(|p| p.name != "format").map(query)).collect()
    }
}

fn path(name: &str, doc: &str) -> ParameterBuilder {
    let builder = ParameterBuilder::new().name(name).parameter_in(ParameterIn::Path);
    builder.required(Required::True).description(Some(doc))
}

/// Text of some pattern, with an example.
fn text(pattern: &str, example: &str) -> ObjectBuilder {
    ObjectBuilder::new().schema_type(Type::String).pattern(Some(pattern)).examples([example])
}

/// Names a type of parameters that are one path segment each.
macro_rules! segment {
    ($(#[$doc:meta])* $type:ident, $name:literal, $words:literal, $pattern:literal, $example:literal) => {
        $(#[$doc])*
        pub(in crate::http) enum $type {}

        impl IntoParams for $type {
            fn into_params(_: impl Fn() -> Option<ParameterIn>) -> Vec<Parameter> {
                vec![path($name, $words).schema(Some(text($pattern, $example))).build()]
            }
        }
    };
}

segment!(
    /// `{id}` of an entry.
    EntryPath, "id", "The entry's id, in any case.",
    "^([0-9][A-Za-z0-9]{3}|[Pp][Dd][Bb]_[A-Za-z0-9]{8})$", "4pti"
);
segment!(
    /// `{digest}` of a structure.
    StructurePath, "digest", "SHA-256 of the structure's bytes as they came.",
    "^[0-9a-f]{64}$", "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
);
segment!(
    /// `{file}` of the page.
    AssetPath, "file", "The file's name.", "^[A-Za-z0-9._-]{1,100}$", "icon.svg"
);
segment!(
    /// `{id}` of a job.
    JobPath, "id", "The job's id.", "^[0-9a-f]{32}$", "0123456789abcdef0123456789abcdef"
);
segment!(
    /// `{key}` of a result.
    ResultPath, "key", "The result's key.",
    "^[0-9a-f]{64}$", "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
);

/// `{file}` of a result.
pub(in crate::http) enum ResultFile {}

impl IntoParams for ResultFile {
    fn into_params(_: impl Fn() -> Option<ParameterIn>) -> Vec<Parameter> {
        let extensions = Format::ALL.map(Format::extension).join("|");
        let file = text(&format!("^[0-9a-f]{{64}}\\.({extensions})$"), &format!("{}.glb", "0".repeat(64)));
        vec![path("file", "The result's key and the extension of its format.").schema(Some(file)).build()]
    }
}

/// A header that a request may have: its name, a pattern for it if not any will do, an example, what it does.
type Header = (&'static str, Option<&'static str>, &'static str, &'static str);

fn headers(all: &[Header]) -> Vec<Parameter> {
    let one = |(name, pattern, example, doc): &Header| {
        let value = ObjectBuilder::new().schema_type(Type::String).pattern(*pattern).examples([*example]);
        let builder = ParameterBuilder::new().name(*name).parameter_in(ParameterIn::Header);
        builder.required(Required::False).description(Some(*doc)).schema(Some(value)).build()
    };
    all.iter().map(one).collect()
}

/// Names a type of request headers.
macro_rules! request_headers {
    ($(#[$doc:meta])* $type:ident: $all:expr) => {
        $(#[$doc])*
        pub(in crate::http) enum $type {}

        impl IntoParams for $type {
            fn into_params(_: impl Fn() -> Option<ParameterIn>) -> Vec<Parameter> {
                headers(&$all)
            }
        }
    };
}

request_headers!(
    /// Preferences of a request.
    Wishes: [
        (
            "Prefer", None, "respond-async",
            "`respond-async`: a job is promised (202) and the mesh made later. `wait=SECONDS`: how long the answer \
             may take before a job is promised instead (RFC 7240).",
        ),
        (
            "Priority", None, "u=3",
            "`u=0` (urgent) to `u=7`: the order among a client's own jobs (RFC 9218).",
        ),
        (
            "Idempotency-Key", Some("^[ -~]{1,255}$"), "upload-1",
            "A key of the client's choice: the same request with the same key is promised the same job.",
        ),
    ]
);
request_headers!(
    /// The compression of an upload.
    Coding: [(
        "Content-Encoding", Some("^(identity|gzip|x-gzip|zstd)?$"), "gzip",
        "How the body is compressed. It need not be said: the bytes are looked at.",
    )]
);
request_headers!(
    /// Validators of the client's copy.
    Unchanged: [(
        "If-None-Match", None, "\"ba7816bf\"", "`ETag`s that the client has: if one still holds, the answer is 304.",
    )]
);
request_headers!(
    /// Parts of a file that was made before.
    Parts: [
        (
            "Range", None, "bytes=0-1023",
            "The part that is wanted. It is heeded where the file was made before; otherwise, and for several parts, \
             the whole is sent.",
        ),
        ("If-Range", None, "\"ba7816bf\"", "The `ETag` of which a part is wanted; of another file all is sent."),
    ]
);
request_headers!(
    /// Last event that the client received.
    Resumption: [(
        "Last-Event-ID", None, "3", "The last event that was seen: only newer ones are sent. After the last, 204.",
    )]
);
