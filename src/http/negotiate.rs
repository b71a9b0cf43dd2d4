//! Mesh format from `Accept` (RFC 9110): the most specific matching range determines the weight of a media type.

use axum::http::HeaderMap;
use axum::http::header::ACCEPT;

use super::kinds::Kind;
use super::problem::Problem;
use crate::formats::Format;

/// Returns the preferred format; ties go to the first range, then to the order of [`Format::ALL`].
pub(super) fn format(headers: &HeaderMap) -> Result<Format, Problem> {
    let values: Vec<&str> = headers.get_all(ACCEPT).iter().filter_map(|value| value.to_str().ok()).collect();
    choose(&values.join(",")).ok_or_else(|| {
        let available: Vec<&str> = Format::ALL.iter().map(|format| format.media_type()).collect();
        Problem::new(Kind::NotAcceptable, format!("the available formats are {}", available.join(", ")))
            .with("available", available)
    })
}

/// Media range with its weight and its position in the header.
struct Range<'a> {
    kind: &'a str,
    subtype: &'a str,
    weight: f64,
    place: usize,
}

impl Range<'_> {
    /// Returns 0 without a match; higher is more specific.
    fn specificity(&self, media_type: &str) -> u8 {
        let (kind, subtype) = media_type.split_once('/').unwrap_or_default();
        match (self.kind, self.subtype) {
            ("*", "*") => 1,
            (k, "*") if k.eq_ignore_ascii_case(kind) => 2,
            (k, s) if k.eq_ignore_ascii_case(kind) && s.eq_ignore_ascii_case(subtype) => 3,
            _ => 0,
        }
    }
}

fn choose(accept: &str) -> Option<Format> {
    if accept.trim().is_empty() {
        return Some(Format::default());
    }
    let ranges: Vec<Range<'_>> = accept.split(',').enumerate().filter_map(|(place, text)| range(place, text)).collect();
    let best = Format::ALL.into_iter().filter_map(|format| {
        let matching = ranges.iter().filter(|range| range.specificity(format.media_type()) > 0);
        let range = matching.max_by_key(|r| (r.specificity(format.media_type()), usize::MAX - r.place))?;
        (range.weight > 0.0).then_some((range.weight, usize::MAX - range.place, format))
    });
    // `max_by` returns the last of equal elements; the first one is wanted.
    best.rev().max_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))).map(|(_, _, format)| format)
}

/// Parses one member of the list; malformed ones are ignored.
fn range(place: usize, text: &str) -> Option<Range<'_>> {
    let mut parts = text.split(';').map(str::trim);
    let (kind, subtype) = parts.next()?.split_once('/')?;
    let weight = parts
        .find_map(|parameter| parameter.strip_prefix("q=").or_else(|| parameter.strip_prefix("Q=")))
        .map_or(Some(1.0), |q| q.parse::<f64>().ok().filter(|q| (0.0..=1.0).contains(q)))?;
    Some(Range { kind, subtype, weight, place })
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
            ("application/json", None),
            ("*/*;q=0", None),
            ("nonsense", None),
            ("model/stl;q=2", None),
            ("model/stl; q=1.0", Some(Format::Stl)),
        ] {
            assert_eq!(choose(accept), expected, "{accept}");
        }
    }
}
