//! Content negotiation of meshes (RFC 9110): the most specific range of `Accept` that matches a media type gives its
//! weight.

use axum::extract::Request;
use axum::http::header::{ACCEPT, CONTENT_TYPE, VARY};
use axum::http::{HeaderMap, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;

use super::problem::{self, Problem};
use super::problem_types::ProblemType;
use crate::formats::Format;

/// Media type for clients that treat every mesh as bytes.
pub(super) const OCTETS: &str = "application/octet-stream";

/// Sends a mesh as `application/octet-stream` if `Accept` prefers that type.
pub(super) async fn relabel(request: Request, next: Next) -> Response {
    let values = request.headers().get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok());
    let accept = values.collect::<Vec<_>>().join(",");
    let ranges = accept.split(',').enumerate().filter_map(|(position, text)| range(position, text));
    let preferred = ranges.max_by(|a, b| a.weight.total_cmp(&b.weight).then(b.position.cmp(&a.position)));
    let is_octets = preferred.is_some_and(|range| range.is(OCTETS));
    let mut response = next.run(request).await;
    let headers = response.headers_mut();
    let is_mesh = |value: &HeaderValue| Format::ALL.iter().any(|format| format.media_type() == value);
    if is_octets && headers.get(CONTENT_TYPE).is_some_and(is_mesh) {
        headers.insert(CONTENT_TYPE, HeaderValue::from_static(OCTETS));
        headers.append(VARY, HeaderValue::from_static("accept"));
    }
    response
}

/// Returns the format that `Accept` prefers. Ties go to the range that stands first, then to the order of
/// [`Format::ALL`].
pub(super) fn format(headers: &HeaderMap) -> Result<Format, Problem> {
    let values: Vec<&str> = headers.get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok()).collect();
    choose(&values.join(",")).ok_or_else(|| {
        let available: Vec<&str> = Format::ALL.iter().map(|format| format.media_type()).collect();
        Problem::new(ProblemType::NotAcceptable, format!("the available formats are {}", available.join(", ")))
            .with("available", available)
    })
}

/// Media range with its weight and its position in the header.
struct MediaRange<'a> {
    kind: &'a str,
    subtype: &'a str,
    weight: f64,
    position: usize,
}

impl MediaRange<'_> {
    /// Returns true if the range is this media type, not a wildcard that contains it.
    fn is(&self, media_type: &str) -> bool {
        media_type.split_once('/').is_some_and(|(kind, subtype)| {
            self.kind.eq_ignore_ascii_case(kind) && self.subtype.eq_ignore_ascii_case(subtype)
        })
    }

    /// Returns 0 for no match; more specific matches are higher. Every mesh is also `application/octet-stream`.
    fn specificity(&self, media_type: &str) -> u8 {
        let kind = media_type.split('/').next().unwrap_or_default();
        match (self.kind, self.subtype) {
            _ if self.is(OCTETS) => 1,
            ("*", "*") => 1,
            (k, "*") if k.eq_ignore_ascii_case(kind) => 2,
            _ if self.is(media_type) => 3,
            _ => 0,
        }
    }
}

fn choose(accept: &str) -> Option<Format> {
    if accept.trim().is_empty() {
        return Some(Format::default());
    }
    let ranges = accept.split(',').enumerate().filter_map(|(position, text)| range(position, text));
    // Errors and jobs are JSON, independent of the mesh format. Some generated clients send no other type.
    let is_json = |range: &MediaRange<'_>| range.is("application/json") || range.is(problem::MEDIA_TYPE);
    let (json, ranges): (Vec<_>, Vec<_>) = ranges.partition(is_json);
    if ranges.is_empty() && json.iter().any(|range| range.weight > 0.0) {
        return Some(Format::default());
    }
    let best = Format::ALL.into_iter().filter_map(|format| {
        let matching = ranges.iter().filter(|range| range.specificity(format.media_type()) > 0);
        let range = matching.max_by_key(|r| (r.specificity(format.media_type()), usize::MAX - r.position))?;
        (range.weight > 0.0).then_some((range.weight, usize::MAX - range.position, format))
    });
    // `max_by` returns the last of equal elements; the first one is wanted.
    best.rev().max_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))).map(|(_, _, format)| format)
}

/// Parses one member of the list. Malformed ones are ignored.
fn range(position: usize, text: &str) -> Option<MediaRange<'_>> {
    let mut parts = text.split(';').map(str::trim);
    let (kind, subtype) = parts.next()?.split_once('/')?;
    Some(MediaRange { kind, subtype, weight: weight(parts)?, position })
}

/// Returns the weight among the parameters of a member, by default 1; `None` if it is malformed.
pub(super) fn weight<'a>(mut parameters: impl Iterator<Item = &'a str>) -> Option<f64> {
    let q = parameters.find_map(|parameter| parameter.strip_prefix("q=").or_else(|| parameter.strip_prefix("Q=")));
    q.map_or(Some(1.0), |q| q.parse().ok().filter(|q| (0.0..=1.0).contains(q)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table() {
        for (accept, expected) in [
            ("", Some(Format::Glb)),
            ("*/*", Some(Format::Glb)),
            ("model/*", Some(Format::Glb)),
            ("model/stl", Some(Format::Stl)),
            ("MODEL/STL", Some(Format::Stl)),
            ("model/obj, model/stl", Some(Format::Obj)),
            ("model/obj;q=0.5, model/stl;q=0.9", Some(Format::Stl)),
            ("application/*", Some(Format::Ply)),
            ("*/*;q=0.1, application/ply", Some(Format::Ply)),
            ("model/gltf-binary;q=0, */*", Some(Format::Gltf)),
            ("model/*;q=0.2, model/obj;q=0.8", Some(Format::Obj)),
            ("text/html, application/xhtml+xml, */*;q=0.8", Some(Format::Glb)),
            ("text/html", None),
            ("application/json", Some(Format::Glb)),
            ("application/json, model/stl", Some(Format::Stl)),
            ("application/json;q=0", None),
            ("*/*;q=0", None),
            ("nonsense", None),
            ("model/stl;q=2", None),
            ("model/stl; q=1.0", Some(Format::Stl)),
            ("application/octet-stream", Some(Format::Glb)),
            ("application/octet-stream, model/stl", Some(Format::Glb)),
            ("model/stl, application/octet-stream", Some(Format::Stl)),
            ("application/problem+json", Some(Format::Glb)),
            ("application/problem+json, model/stl", Some(Format::Stl)),
            ("application/problem+json, text/html", None),
        ] {
            assert_eq!(choose(accept), expected, "{accept}");
        }
    }
}
