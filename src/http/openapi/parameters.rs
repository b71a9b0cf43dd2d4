//! Parameters in the OpenAPI document. Mesh parameters come from the table that the request parser uses.

use serde_json::Value;
use utoipa::IntoParams;
use utoipa::openapi::extensions::Extensions;
use utoipa::openapi::path::{Parameter, ParameterBuilder, ParameterIn};
use utoipa::openapi::schema::{SchemaFormat, Type};
use utoipa::openapi::{KnownFormat, ObjectBuilder, OpenApi, Ref, RefOr, Required, Schema};

use super::components::pascal_case;
use crate::formats::Format;
use crate::http::job_list::{DEFAULT_LIMIT, MAX_LIMIT};
use crate::http::{atom_parameters, batch_plan, color_parameters};
use crate::pipeline::params::{self, Domain, TABLE};
use crate::pipeline::{AreaLevel, areas, tileset};
use crate::surface::SurfaceKind;

const DIGEST_PATTERN: &str = "^[0-9a-f]{64}$";
const DIGEST_EXAMPLE: &str = "edf4c54b21822f1924f4915e0c459f7e53c016e03bc2d01e415cca648e478087";
/// Name of the schema of `surface.{ext}`.
const SURFACE_FILE: &str = "SurfaceFile";

/// Adds a named schema for each parameter with a fixed set of values, so that generators make one type of each.
pub(super) fn add_choices(api: &mut OpenApi) {
    let schemas = &mut api.components.get_or_insert_default().schemas;
    let files = Format::ALL.map(|format| format!("surface.{}", format.name()));
    let files = ObjectBuilder::new()
        .schema_type(Type::String)
        .description(Some("File name of a mesh: `surface.` and the name of the format."))
        .enum_values(Some(files));
    schemas.insert(SURFACE_FILE.to_owned(), RefOr::T(files.into()));
    for parameter in TABLE {
        let Domain::Choice(values) = parameter.domain else { continue };
        // A format that is sent takes precedence over `Accept`, so declaring its default would change responses.
        let declared = parameter.name != "format" && values.contains(&parameter.default);
        let default = declared.then(|| Value::from(parameter.default));
        let object = ObjectBuilder::new()
            .schema_type(Type::String)
            .description(Some(format!("Value of `{}`.", parameter.name)))
            .enum_values(Some(values.iter().map(|value| Value::from(*value))))
            .default(default);
        schemas.insert(pascal_case(parameter.name), RefOr::T(object.into()));
    }
}

/// Returns the schema of a parameter's values.
fn schema(parameter: &params::Parameter) -> RefOr<Schema> {
    let object = |kind: Type| ObjectBuilder::new().schema_type(kind);
    match parameter.domain {
        Domain::Number { min, max, .. } => {
            let default = parameter.default.parse::<f64>().ok().map(Value::from);
            object(Type::Number).minimum(Some(min)).maximum(Some(max)).default(default).into()
        }
        Domain::Integer { min, max } => {
            let wide = i32::try_from(min).is_err() || i32::try_from(max).is_err();
            let format = SchemaFormat::KnownFormat(if wide { KnownFormat::Int64 } else { KnownFormat::Int32 });
            object(Type::Integer).format(Some(format)).minimum(Some(min)).maximum(Some(max)).into()
        }
        Domain::Flag => object(Type::Boolean).default(parameter.default.parse::<bool>().ok().map(Value::from)).into(),
        Domain::Choice(_) => RefOr::Ref(Ref::from_schema_name(pascal_case(parameter.name))),
        Domain::Text { expected } => object(Type::String)
            .min_length(Some(1))
            .max_length(Some(params::MAX_VALUE_BYTES))
            .title(Some(expected))
            .into(),
    }
}

/// Describes a parameter with its valid values and its default.
fn describe(parameter: &params::Parameter) -> String {
    let text = parameter.describe();
    if parameter.name != "format" {
        return text;
    }
    text.replace("Default: ", "Default: the format that `Accept` prefers, or ")
}

/// Returns the `x-control` extension, from which front ends build controls: `unit`, `usual` (the range of a slider),
/// `instead_of` (parameters that exclude this one) and `format` (the only format that this one applies to).
fn hints(parameter: &params::Parameter) -> Option<Extensions> {
    let mut control = serde_json::Map::new();
    if let Domain::Number { unit, .. } = parameter.domain
        && !unit.is_empty()
    {
        control.insert("unit".to_owned(), unit.into());
    }
    if let Some(usual) = params::usual_range(parameter) {
        control.insert("usual".to_owned(), usual.to_vec().into());
    }
    if params::PICTURES.contains(&parameter.name) {
        control.insert("format".to_owned(), Format::Png.name().into());
    }
    if params::SPACINGS.contains(&parameter.name) {
        let others: Vec<&str> = params::SPACINGS.into_iter().filter(|name| *name != parameter.name).collect();
        control.insert("instead_of".to_owned(), others.into());
    }
    (!control.is_empty()).then(|| Extensions::from_iter([("x-control", Value::from(control))]))
}

fn query(parameter: &params::Parameter) -> Parameter {
    ParameterBuilder::new()
        .name(parameter.name)
        .parameter_in(ParameterIn::Query)
        .required(Required::False)
        .description(Some(describe(parameter)))
        .schema(Some(schema(parameter)))
        .extensions(hints(parameter))
        .build()
}

/// Returns the parameters of a mesh that have these names.
fn mesh_parameters(names: &[&str]) -> impl Iterator<Item = Parameter> {
    names.iter().filter_map(|name| TABLE.iter().find(|parameter| parameter.name == *name)).map(query)
}

/// Returns the parameters that apply to a tileset.
fn tile_parameters() -> impl Iterator<Item = &'static params::Parameter> {
    let others = || ["format", "check", "tile"].into_iter().chain(params::PICTURES).chain(tileset::NOT_APPLICABLE);
    TABLE.iter().filter(move |parameter| others().all(|other| other != parameter.name))
}

/// Describes a query parameter that is not, or not in this form, one of a mesh.
fn own(name: &str, required: Required, doc: impl Into<String>, schema: ObjectBuilder) -> Parameter {
    let builder = ParameterBuilder::new().name(name).parameter_in(ParameterIn::Query).required(required);
    builder.description(Some(doc.into())).schema(Some(schema)).build()
}

/// Describes the parameter that limits the size of a page.
fn page_limit() -> Parameter {
    let limit = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(1)).maximum(Some(MAX_LIMIT));
    own("limit", Required::False, "Maximum size of the page.", limit.default(Some(Value::from(DEFAULT_LIMIT))))
}

/// Describes the parameter that selects the rows of a table of areas.
fn rows() -> Parameter {
    let levels = ObjectBuilder::new().schema_type(Type::String).enum_values(Some(AreaLevel::ALL.map(AreaLevel::name)));
    let levels = levels.default(Some(Value::from(AreaLevel::default().name())));
    let doc = "Rows of the table of areas. Value: atom, residue or chain. Default: residue.";
    own(params::areas::BY, Required::False, doc, levels)
}

fn path(name: &str, doc: &str) -> ParameterBuilder {
    let builder = ParameterBuilder::new().name(name).parameter_in(ParameterIn::Path);
    builder.required(Required::True).description(Some(doc))
}

/// Returns a schema for text that matches `pattern`, with an example.
fn text(pattern: &str, example: &str) -> ObjectBuilder {
    ObjectBuilder::new().schema_type(Type::String).pattern(Some(pattern)).examples([example])
}

/// Describes a path segment that matches `pattern`.
fn segment(name: &str, doc: &str, pattern: &str, example: &str) -> Vec<Parameter> {
    vec![path(name, doc).schema(Some(text(pattern, example))).build()]
}

/// Request header: name, pattern (`None`: any text), example, description.
type Header = (&'static str, Option<&'static str>, &'static str, &'static str);

fn headers(all: &[Header]) -> Vec<Parameter> {
    let one = |(name, pattern, example, doc): &Header| {
        let value = ObjectBuilder::new().schema_type(Type::String).pattern(*pattern).examples([*example]);
        let builder = ParameterBuilder::new().name(*name).parameter_in(ParameterIn::Header);
        builder.required(Required::False).description(Some(*doc)).schema(Some(value)).build()
    };
    all.iter().map(one).collect()
}

/// `Idempotency-Key`. Tabs are allowed at both ends, where HTTP removes them.
const IDEMPOTENCY_KEY: Header = (
    "Idempotency-Key",
    Some("^[\\t ]*[ -~]{1,255}[\\t ]*$"),
    "upload-1",
    "Key chosen by the client, 1 to 255 characters. A repeated request with the same key returns the same job or batch.",
);

/// Declares a type for `params(…)` of an operation.
macro_rules! parameters {
    ($(#[$doc:meta])* $type:ident: $parameters:expr) => {
        $(#[$doc])*
        pub(in crate::http) enum $type {}

        impl IntoParams for $type {
            fn into_params(_: impl Fn() -> Option<ParameterIn>) -> Vec<Parameter> {
                $parameters
            }
        }
    };
}

parameters!(
    /// Query parameters of a mesh.
    MeshParameters: TABLE.iter().map(query).collect()
);
parameters!(
    /// Query parameters of a batch.
    BatchParameters: {
        let outputs = ObjectBuilder::new().schema_type(Type::String).min_length(Some(1)).title(Some(batch_plan::expected()));
        let outputs = outputs.default(Some(Value::from(Format::default().name()))).examples(["glb,png"]);
        let doc = format!(
            "Outputs of each file: names of formats, and `areas` for a table of exact areas. A parameter applies to the \
             outputs that have it. Value: {}. Default: glb.", batch_plan::expected()
        );
        let own = [
            own(batch_plan::OUTPUTS, Required::False, doc, outputs),
            rows(),
        ];
        own.into_iter().chain(TABLE.iter().filter(|parameter| parameter.name != "format").map(query)).collect()
    }
);
parameters!(
    /// Parameters of a mesh whose path names the format.
    SurfaceParameters: {
        let doc = "`surface.` and the name of the mesh format; `surface.png` is a picture of the mesh.";
        let file = path("file", doc).schema(Some(Ref::from_schema_name(SURFACE_FILE))).build();
        std::iter::once(file).chain(TABLE.iter().filter(|p| p.name != "format").map(query)).collect()
    }
);
parameters!(
    /// Query parameters of a tileset.
    TilesetParameters: tile_parameters().map(query).collect()
);
parameters!(
    /// Query parameters of a subtree.
    SubtreeParameters: {
        let own = tile_parameters().filter(|parameter| parameter.name != "instances");
        own.map(query).chain(mesh_parameters(&["tile"])).collect()
    }
);
parameters!(
    /// Query parameters of the colours of atoms.
    ColorParameters: {
        let value = ObjectBuilder::new().schema_type(Type::String).title(Some(color_parameters::expected())).examples(["chain"]);
        let doc = format!("Colour scheme. Value: {}.", color_parameters::expected());
        let scheme = own("scheme", Required::True, doc, value);
        std::iter::once(scheme).chain(mesh_parameters(&color_parameters::NAMES)).collect()
    }
);
parameters!(
    /// Query parameters of the list of atoms.
    AtomParameters: {
        let value = ObjectBuilder::new().schema_type(Type::Boolean).default(Some(Value::from(false)));
        let doc = "Lists only the atoms of a mesh with the same parameters, with the copies of an assembly, and adds their \
                   indices in the file and their positions. The parameters that select atoms need it. Default: false.";
        let positions = own(atom_parameters::POSITIONS, Required::False, doc, value);
        std::iter::once(positions).chain(mesh_parameters(&atom_parameters::NAMES)).collect()
    }
);
parameters!(
    /// Query parameters of the areas of atoms.
    AreaParameters: {
        let text = || ObjectBuilder::new().schema_type(Type::String);
        let surfaces = text().enum_values(Some(params::areas::SURFACES.map(SurfaceKind::name)));
        let interfaces = text().min_length(Some(1)).max_length(Some(params::MAX_VALUE_BYTES));
        let interfaces = interfaces.title(Some(areas::EXPECTED));
        let doc = format!(
            "Compares two sets of chains: the rows are those of both sides together, with the areas `alone` and \
             `buried`. Value: {}.", areas::EXPECTED
        );
        let own = vec![
            rows(),
            own("surface", Required::True, "Type of the surface. Value: vdw, sas or ses.", surfaces),
            own("interface", Required::False, doc, interfaces),
        ];
        let others = mesh_parameters(&params::areas::NAMES);
        let others: Vec<_> = others.filter(|other| own.iter().all(|own| own.name != other.name)).collect();
        own.into_iter().chain(others).collect()
    }
);
parameters!(
    /// `{id}` of an archive entry.
    EntryPath: {
        let pattern = "^([0-9][A-Za-z0-9]{3}|[Pp][Dd][Bb]_[A-Za-z0-9]{8})$";
        segment("id", "PDB id of the entry, in upper or lower case.", pattern, "4pti")
    }
);
parameters!(
    /// `{digest}` of an uploaded structure.
    StructurePath: {
        let doc = "SHA-256 digest of the structure's bytes as uploaded, in hexadecimal.";
        segment("digest", doc, DIGEST_PATTERN, DIGEST_EXAMPLE)
    }
);
parameters!(
    /// `{id}` of a job.
    JobPath: segment("id", "Id of the job.", "^[0-9a-f]{32}$", "0123456789abcdef0123456789abcdef")
);
parameters!(
    /// Query parameters of a list of jobs.
    JobListParameters: {
        let state = ParameterBuilder::new().name("state").parameter_in(ParameterIn::Query).required(Required::False);
        let state = state.description(Some("Status of the jobs. Default: every status."));
        vec![
            state.schema(Some(Ref::from_schema_name("JobStatus"))).build(),
            page_limit(),
            own(
                "after", Required::False, "Position of the page, from the link `next` of the page before.",
                text("^[0-9a-f]{1,32}$", "3f2"),
            ),
        ]
    }
);
parameters!(
    /// Query parameters of a page of the files of a batch.
    BatchPageParameters: {
        let offset = ObjectBuilder::new().schema_type(Type::Integer).minimum(Some(0)).default(Some(Value::from(0)));
        vec![own("offset", Required::False, "Number of files to skip.", offset), page_limit()]
    }
);
parameters!(
    /// `{id}` of a batch.
    BatchPath: segment("id", "Id of the batch.", "^[0-9a-f]{32}$", "0123456789abcdef0123456789abcdef")
);
parameters!(
    /// `{key}` of a result.
    ResultPath: segment("key", "Key of the result.", DIGEST_PATTERN, DIGEST_EXAMPLE)
);
parameters!(
    /// `{slug}` of a problem type.
    ProblemPath: segment("slug", "Last segment of the `type` of a problem.", "^[a-z-]{1,40}$", "grid-too-large")
);
parameters!(
    /// `{file}` of a result.
    ResultFile: {
        let pattern = format!("^[0-9a-f]{{64}}\\.({})$", Format::ALL.map(Format::name).join("|"));
        let example = format!("{}.glb", "0".repeat(64));
        segment("file", "Key of the result, followed by the name of its format.", &pattern, &example)
    }
);
parameters!(
    /// Headers that choose between a mesh and a job.
    PreferenceHeaders: headers(&[
        (
            "Prefer", None, "respond-async",
            "`respond-async` creates a job and returns 202 at once. `wait=SECONDS` waits at most that long for the \
             mesh, then returns 202 with a job (RFC 7240).",
        ),
        (
            "Priority", None, "u=3",
            "Urgency from `u=0` (most urgent) to `u=7` (RFC 9218). It orders the waiting requests of one client. Jobs \
             of all clients have three levels: 0 to 2, 3 and 4, 5 to 7.",
        ),
        IDEMPOTENCY_KEY,
    ])
);
parameters!(
    /// Headers of a batch.
    BatchHeaders: headers(&[IDEMPOTENCY_KEY])
);
parameters!(
    /// Compression of an upload.
    ContentEncodingHeader: headers(&[(
        "Content-Encoding", Some("^(identity|gzip|x-gzip|zstd)?$"), "gzip",
        "Compression of the body. Optional: the server detects gzip and zstd from the content.",
    )])
);
parameters!(
    /// Conditional request.
    ConditionHeaders: headers(&[
        ("If-None-Match", None, "\"ba7816bf\"", "`ETag`s that the client has. If one matches, the response is 304."),
        ("If-Match", None, "\"ba7816bf\"", "`ETag`s that the client expects. If none matches, the response is 412."),
    ])
);
parameters!(
    /// Range request.
    RangeHeaders: headers(&[
        (
            "Range", None, "bytes=0-1023",
            "Part of the file to return. Applies to stored results and colours; other responses, and requests for \
             several ranges, return the whole file.",
        ),
        ("If-Range", None, "\"ba7816bf\"", "`ETag` that the `Range` refers to. If it differs, the whole file is sent."),
    ])
);
parameters!(
    /// Position in an event stream.
    LastEventIdHeader: headers(&[(
        "Last-Event-ID", None, "3",
        "Id of the last event received. Only later events are sent; after the final event the response is 204.",
    )])
);
