//! `/docs`: the description to read and to try, in Swagger UI. Its files are embedded, packed as they came in the package
//! `swagger-ui-dist`; nothing is loaded from elsewhere.

use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY};
use axum::http::{HeaderMap, HeaderName};
use axum::response::{IntoResponse, Response};

use super::packed;
use super::problem::Problem;

/// Our own files and resources, as on the page; besides, Swagger UI has icons in its style, and shows downloads. What it
/// lays out by `style` goes through the document's objects, which a policy does not touch.
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

/// A packed file with what it is.
fn packed(request: &HeaderMap, media_type: &'static str, bytes: &'static [u8]) -> Result<Response, Problem> {
    Ok((headers(media_type), packed::file(request, bytes)?).into_response())
}

/// The description, to read and to try.
pub(super) async fn index() -> Response {
    (headers("text/html; charset=utf-8"), include_str!("../../web/docs.html")).into_response()
}

/// What starts the page.
pub(super) async fn start() -> Response {
    (headers("text/javascript; charset=utf-8"), include_str!("../../web/docs.js")).into_response()
}

/// The style of Swagger UI.
pub(super) async fn style(headers: HeaderMap) -> Result<Response, Problem> {
    packed(&headers, "text/css; charset=utf-8", STYLE)
}

/// Swagger UI.
pub(super) async fn bundle(headers: HeaderMap) -> Result<Response, Problem> {
    packed(&headers, "text/javascript; charset=utf-8", BUNDLE)
}
