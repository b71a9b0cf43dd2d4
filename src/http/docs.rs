//! `/docs`: Swagger UI for the OpenAPI document. Its files are those of the package `swagger-ui-dist`, embedded with
//! gzip; nothing is loaded from other servers.

use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY};
use axum::http::{HeaderMap, HeaderName};
use axum::response::{IntoResponse, Response};

use super::embedded;
use super::problem::Problem;

/// Content security policy: as on the page, and data URIs for the icons of Swagger UI. Its inline styles are set by
/// scripts, which a policy does not restrict.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
                      connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

const BUNDLE: &[u8] = include_bytes!("../../web/swagger/swagger-ui-bundle.js.gz");
const STYLE: &[u8] = include_bytes!("../../web/swagger/swagger-ui.css.gz");

fn headers(media_type: &'static str) -> [(HeaderName, &'static str); 4] {
    [
        (CONTENT_TYPE, media_type),
        (CONTENT_SECURITY_POLICY, POLICY),
        (REFERRER_POLICY, "no-referrer"),
        (CACHE_CONTROL, "no-cache"),
    ]
}

/// Answers with an embedded file of this type.
fn packed(request: &HeaderMap, media_type: &'static str, bytes: &'static [u8]) -> Result<Response, Problem> {
    Ok((headers(media_type), embedded::file(request, bytes)?).into_response())
}

/// Serves Swagger UI for the OpenAPI document.
pub(super) async fn index() -> Response {
    (headers("text/html; charset=utf-8"), include_str!("../../web/docs.html")).into_response()
}

/// Serves the script that starts the page.
pub(super) async fn start() -> Response {
    (headers("text/javascript; charset=utf-8"), include_str!("../../web/docs.js")).into_response()
}

/// Serves the style of Swagger UI.
pub(super) async fn style(headers: HeaderMap) -> Result<Response, Problem> {
    packed(&headers, "text/css; charset=utf-8", STYLE)
}

/// Serves the script of Swagger UI.
pub(super) async fn bundle(headers: HeaderMap) -> Result<Response, Problem> {
    packed(&headers, "text/javascript; charset=utf-8", BUNDLE)
}
