//! Parsed requests for meshes: structure, parameters and format, from an address or from a body.

use axum::body::Body;
use axum::extract::{FromRequestParts, Query};
use axum::http::header::HeaderMap;
use axum::http::request::Parts;

use super::content_type::{DeclaredType, contradiction};
use super::form::UploadedFile;
use super::guard::Caller;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::source::{Loaded, StructureSource};
use super::state::{App, Shared};
use super::{json_body, negotiate, upload};
use crate::formats::Format;
use crate::jobs::UploadedMap;
use crate::pipeline::MapFile;
use crate::pipeline::params::{self, Request};
use crate::structure::detect_format;

/// Size of a JSON document, bytes, up to which it is parsed on the async runtime: a few microseconds.
const MAX_INLINE_JSON: usize = 4096;

/// Pairs of a query, in order.
pub(super) struct Pairs(pub(super) Vec<(String, String)>);

impl FromRequestParts<Shared> for Pairs {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, app: &Shared) -> Result<Self, Problem> {
        let Query(pairs) = Query::from_request_parts(parts, app)
            .await
            .map_err(|error| Problem::new(ProblemType::BadRequest, error.body_text()))?;
        Ok(Self(pairs))
    }
}

/// Parameters of an operation whose body is a structure or names one.
pub(super) trait BodyParameters: Sized {
    /// Checks the parameters of the query if the body may have more of them.
    fn check(pairs: &[(String, String)]) -> Result<(), Problem>;

    /// Parses all parameters.
    fn parse(
        app: &App,
        pairs: &[(String, String)],
        headers: &HeaderMap,
        map: Option<&UploadedMap>,
    ) -> Result<Self, Problem>;
}

impl BodyParameters for Request {
    fn check(pairs: &[(String, String)]) -> Result<(), Problem> {
        params::parse(pairs.iter().map(|(n, v)| (n, v)))?;
        Ok(())
    }

    fn parse(
        app: &App,
        pairs: &[(String, String)],
        headers: &HeaderMap,
        map: Option<&UploadedMap>,
    ) -> Result<Self, Problem> {
        let pairs = pairs.iter().map(|(n, v)| (n, v));
        let mut request = params::parse_with(pairs, |_| negotiate::format(headers))?;
        request.options.map = map.map(|map| MapFile::new(map.digest.to_string(), map.bytes.clone()));
        app.check_options(&request.options)?;
        Ok(request)
    }
}

/// Structure and parameters of a request.
pub(super) struct ParsedRequest<R = Request> {
    pub(super) source: StructureSource,
    pub(super) request: R,
    /// Map of the job.
    pub(super) map: Option<UploadedMap>,
    /// Parameters as the client wrote them.
    pub(super) pairs: Vec<(String, String)>,
    pub(super) declared: DeclaredType,
}

impl ParsedRequest {
    /// Parses an address that ends in `surface.{ext}` (`file`), or in `report.json` (`None`).
    pub(super) fn from_address(
        app: &App,
        source: StructureSource,
        file: Option<&str>,
        Pairs(pairs): Pairs,
    ) -> Result<Self, Problem> {
        let request = parse_address(file, &pairs)?;
        app.check_options(&request.options)?;
        Ok(Self { source, request, map: None, pairs, declared: DeclaredType::Neutral })
    }
}

impl<R: BodyParameters> ParsedRequest<R> {
    /// Receives a body: a structure file, a form with a file and perhaps a map, or a JSON document that names a
    /// structure. Invalid parameters in the query are rejected before the body is received.
    pub(super) async fn from_body(
        app: &Shared,
        caller: &Caller,
        Pairs(mut pairs): Pairs,
        headers: &HeaderMap,
        body: Body,
    ) -> Result<Self, Problem> {
        let is_json = upload::is_json(headers);
        let early = if is_json || upload::is_multipart(headers) {
            // The body has parameters as well.
            R::check(&pairs)?;
            None
        } else {
            Some(R::parse(app, &pairs, headers, None)?)
        };
        let (source, fields, declared, map) = if is_json {
            let json = upload::receive_json(app, caller, headers, body).await?;
            let (source, fields) = if json.len() <= MAX_INLINE_JSON {
                parse_json(&json)?
            } else {
                tokio::task::spawn_blocking(move || parse_json(&json)).await.map_err(Problem::internal)??
            };
            // The type is that of the document, not that of the structure.
            (source, fields, DeclaredType::Neutral, None)
        } else {
            let UploadedFile { bytes, digest, reservation, map, fields, declared } =
                upload::receive(app, caller, headers, body).await?;
            (StructureSource::Uploaded(Loaded::file(bytes, digest, reservation)), fields, declared, map)
        };
        let request = if let Some(request) = early {
            request
        } else {
            pairs.extend(fields);
            R::parse(app, &pairs, headers, map.as_ref())?
        };
        Ok(Self { source, request, map, pairs, declared })
    }
}

/// Parses the parameters of an address that ends in `surface.{ext}` (`file`), or in `report.json` (`None`).
pub(super) fn parse_address(file: Option<&str>, pairs: &[(String, String)]) -> Result<Request, Problem> {
    let named = file.map(format_of).transpose()?;
    if let Some(named) = named {
        reject_format(named, pairs)?;
    }
    let format = |_: &_| Ok::<_, Problem>(named.unwrap_or_default());
    params::parse_with(pairs.iter().map(|(n, v)| (n, v)), format)
}

/// Rejects the parameter `format` in an address whose path already names a format.
pub(super) fn reject_format(named: Format, pairs: &[(String, String)]) -> Result<(), Problem> {
    match pairs.iter().find(|(name, _)| name == "format") {
        Some((_, value)) if Format::ALL.iter().any(|format| format.name() == value) => {
            let detail = format!("parameter `format`: the path already names {}", named.name());
            Err(Problem::new(ProblemType::BadParameter, detail)
                .with("parameter", "format")
                .with("value", value.as_str())
                .with("expected", format!("no value here, or the path surface.{value}")))
        }
        _ => Ok(()),
    }
}

/// Returns the format that `surface.{ext}` names.
fn format_of(file: &str) -> Result<Format, Problem> {
    let format = |ext| Format::ALL.into_iter().find(|format| format.name() == ext);
    file.strip_prefix("surface.").and_then(format).ok_or_else(|| {
        let surfaces = Format::ALL.iter().map(|f| format!("surface.{}", f.name()));
        let available: Vec<String> = surfaces.chain(["tileset.json".to_owned()]).collect();
        let detail = format!("a structure has no `{file}`; it has {}", available.join(", "));
        Problem::new(ProblemType::NotFound, detail).with("available", available)
    })
}

fn bad_digest(text: &str) -> Problem {
    let shown: String = text.chars().take(80).collect();
    let expected = "the digest of a stored structure, 64 hexadecimal digits in lower case";
    Problem::new(
        ProblemType::BadParameter,
        format!("member `structure`: `{shown}` is not allowed; expected {expected}"),
    )
    .with("parameter", "structure")
    .with("value", shown)
    .with("expected", expected)
}

/// Parses a body that is declared as JSON. A structure file under that type is a contradiction.
fn parse_json(bytes: &[u8]) -> Result<(StructureSource, Vec<(String, String)>), Problem> {
    named(bytes).map_err(|problem| match detect_format(bytes) {
        Ok(Some(format)) => contradiction("application/json", format.name()),
        _ => problem,
    })
}

/// Parses `{"pdb_id": …}` or `{"structure": …}`; the other members are parameters.
fn named(bytes: &[u8]) -> Result<(StructureSource, Vec<(String, String)>), Problem> {
    let (mut source, mut fields) = (None, Vec::new());
    for (name, text) in json_body::members(bytes)? {
        let found = match name.as_str() {
            "pdb_id" => StructureSource::from_pdb_id(&text).map_err(|problem| problem.with("parameter", "pdb_id"))?,
            "structure" => StructureSource::Stored(text.parse().map_err(|_bad| bad_digest(&text))?),
            _ => {
                fields.push((name, text));
                continue;
            }
        };
        if source.replace(found).is_some() {
            return Err(json_body::bad("it names more than one structure"));
        }
    }
    let none = || json_body::bad("it names no structure: it has neither `pdb_id` nor `structure`");
    Ok((source.ok_or_else(none)?, fields))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_members_become_parameters() {
        let (source, fields) =
            named(br#"{"pdb_id": "4PTI", "resolution": 0.5, "chains": ["A", "B"], "atom_ids": true}"#).ok().unwrap();
        assert!(matches!(source, StructureSource::Entry(id) if id.as_str() == "4pti"));
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
