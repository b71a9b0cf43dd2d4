//! Embedded pages: the viewer at `/`, if the program was built with it, `<molmesh-viewer>` for other pages, and Swagger
//! UI for the OpenAPI document at `/docs`. Nothing is loaded from other servers.

use std::collections::BTreeMap;
use std::io::{self, Read as _};
use std::sync::{Mutex, PoisonError};

use axum::extract::Path;
use axum::extract::rejection::PathRejection;
use axum::http::header::{
    CACHE_CONTROL, CONTENT_ENCODING, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY, VARY,
};
use axum::http::{HeaderMap, HeaderName};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::coding::{self, Coding};
use super::problem::Problem;
use super::problem_types::ProblemType;

/// Content security policy of the viewer. It allows scripts and requests of this server only. It allows WebAssembly,
/// for the meshopt decoder, but not `eval`. Images may be blobs, since the address of an image cannot carry a key.
const POLICY: &str = "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; \
                      img-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; \
                      frame-ancestors 'none'";

/// Content security policy of Swagger UI. It allows data URIs, for icons. Scripts set the inline styles, which a policy
/// does not restrict.
const DOCS_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                           connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

// `static FILES`: paths below `web/dist` with their contents, compressed with gzip; empty if the page was not built.
include!(concat!(env!("OUT_DIR"), "/page.rs"));

/// Page of a server without the viewer.
const NONE: &str = include_str!("../../web/none.html");
const ICON: &str = include_str!("../../web/public/assets/icon.svg");
/// Script of a server without the component. It logs the reason to the console.
const NO_COMPONENT: &str =
    "console.error(\"This server was built without the viewer, so <molmesh-viewer> is not available.\");\n";

/// Returns true if the program was built with the viewer.
#[must_use]
pub fn has_viewer() -> bool {
    found("index.html").is_some()
}

fn found(path: &str) -> Option<&'static [u8]> {
    FILES.iter().find(|(name, _)| *name == path).map(|(_, packed)| *packed)
}

fn headers(path: &str, policy: &'static str) -> [(HeaderName, &'static str); 4] {
    let media_type = match path.rsplit('.').next().unwrap_or_default() {
        "html" => "text/html; charset=utf-8",
        "js" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "svg" => "image/svg+xml",
        _ => "text/plain; charset=utf-8",
    };
    let caching = if is_named_by_contents(path) { "public, max-age=31536000, immutable" } else { "no-cache" };
    [
        (CONTENT_TYPE, media_type),
        (CONTENT_SECURITY_POLICY, policy),
        (REFERRER_POLICY, "no-referrer"),
        (CACHE_CONTROL, caching),
    ]
}

/// Returns true if a name ends in a hash of eight characters before its extension: `index-Dx3k_9aZ.js`.
fn is_named_by_contents(path: &str) -> bool {
    let stem = path.rsplit_once('.').map_or(path, |(stem, _)| stem).as_bytes();
    path.starts_with("assets/") && stem.len() > 16 && stem[stem.len() - 9] == b'-'
}

/// Answers with a file of the page, or with `instead`.
fn answer(request: &HeaderMap, path: &str, instead: &'static str) -> Result<Response, Problem> {
    match found(path) {
        Some(bytes) => Ok((headers(path, POLICY), gzip_file(request, bytes)?).into_response()),
        None => Ok((headers(path, POLICY), instead).into_response()),
    }
}

/// Answers with a file that is compressed with gzip. Inflates it for clients that do not accept gzip.
fn gzip_file(request: &HeaderMap, bytes: &'static [u8]) -> Result<Response, Problem> {
    if coding::is_accepted(request, Coding::Gzip) {
        let coding = [(CONTENT_ENCODING, "gzip"), (VARY, "accept-encoding")];
        return Ok((coding, Bytes::from_static(bytes)).into_response());
    }
    Ok(([(VARY, "accept-encoding")], inflated(bytes).map_err(Problem::internal)?).into_response())
}

/// Returns the contents of a file that is compressed with gzip. Each file is inflated once.
fn inflated(bytes: &'static [u8]) -> io::Result<Bytes> {
    /// Contents by the address of the compressed file.
    static INFLATED: Mutex<BTreeMap<usize, Bytes>> = Mutex::new(BTreeMap::new());
    let mut files = INFLATED.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(plain) = files.get(&bytes.as_ptr().addr()) {
        return Ok(plain.clone());
    }
    let mut plain = Vec::new();
    flate2::read::GzDecoder::new(bytes).read_to_end(&mut plain)?;
    let plain = Bytes::from(plain);
    files.insert(bytes.as_ptr().addr(), plain.clone());
    Ok(plain)
}

/// Serves the viewer.
pub(super) async fn index(request: HeaderMap) -> Result<Response, Problem> {
    answer(&request, "index.html", NONE)
}

/// Serves the script of `<molmesh-viewer>` for other pages.
///
/// A module that defines the element and loads its parts from this server.
pub(super) async fn component(request: HeaderMap) -> Result<Response, Problem> {
    answer(&request, "molmesh-viewer.js", NO_COMPONENT)
}

/// Serves the files of the page.
pub(super) async fn asset(file: Result<Path<String>, PathRejection>, request: HeaderMap) -> Result<Response, Problem> {
    let Path(file) = file?;
    let path = format!("assets/{file}");
    if found(&path).is_none() && file != "icon.svg" {
        let shown: String = file.chars().take(80).collect();
        return Err(Problem::new(ProblemType::NotFound, format!("the page has no file `{shown}`; reload the page")));
    }
    answer(&request, &path, ICON)
}

/// Serves a sample structure.
pub(super) async fn sample() -> Response {
    let mut headers = headers("sample.pdb", POLICY);
    headers[0].1 = "chemical/x-pdb";
    (headers, include_str!("../../samples/4pti.pdb")).into_response()
}

/// Serves Swagger UI.
pub(super) async fn docs() -> Response {
    (headers("docs.html", DOCS_POLICY), include_str!("../../web/docs.html")).into_response()
}

/// Serves the script that starts Swagger UI.
pub(super) async fn docs_script() -> Response {
    (headers("docs.js", DOCS_POLICY), include_str!("../../web/docs.js")).into_response()
}

/// Serves the style of Swagger UI, a file of the package `swagger-ui-dist`.
pub(super) async fn swagger_style(request: HeaderMap) -> Result<Response, Problem> {
    let style = include_bytes!("../../web/swagger/swagger-ui.css.gz");
    Ok((headers("swagger-ui.css", DOCS_POLICY), gzip_file(&request, style)?).into_response())
}

/// Serves the script of Swagger UI, a file of the package `swagger-ui-dist`.
pub(super) async fn swagger_script(request: HeaderMap) -> Result<Response, Problem> {
    let script = include_bytes!("../../web/swagger/swagger-ui-bundle.js.gz");
    Ok((headers("swagger-ui-bundle.js", DOCS_POLICY), gzip_file(&request, script)?).into_response())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_inflated_once() {
        let file: &[u8] = include_bytes!("../../web/swagger/swagger-ui.css.gz");
        let [first, second] = [(); 2].map(|()| inflated(file).unwrap());
        assert!(first.len() > file.len());
        assert_eq!(first.as_ptr(), second.as_ptr());
    }

    #[test]
    fn only_files_with_a_hash_in_their_name_are_immutable() {
        for (path, kept) in [
            ("assets/index-CGvWO8zU.css", true),
            ("assets/viewer-BuD58--0.js", true),
            ("assets/icon.svg", false),
            ("assets/licences.txt", false),
            ("molmesh-viewer.js", false),
            ("index.html", false),
        ] {
            assert_eq!(is_named_by_contents(path), kept, "{path}");
            assert_eq!(headers(path, POLICY)[3].1.contains("immutable"), kept, "{path}");
        }
        assert!(!POLICY.contains("unsafe-inline") && !POLICY.contains("'unsafe-eval'"));
    }
}
