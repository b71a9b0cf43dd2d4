//! `/`: a page that tries the service out, with its script and style, embedded. Nothing is loaded from elsewhere.

use axum::http::header::{CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, REFERRER_POLICY};
use axum::response::{IntoResponse, Response};

/// Only our own files run, only our own resources are asked.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

fn asset(media_type: &'static str, text: &'static str) -> Response {
    let headers = [
        (CONTENT_TYPE, media_type),
        (CONTENT_SECURITY_POLICY, POLICY),
        (REFERRER_POLICY, "no-referrer"),
        // Small, and changed by every release: asked for anew each time.
        (CACHE_CONTROL, "no-cache"),
    ];
    (headers, text).into_response()
}

pub(super) async fn index() -> Response {
    asset("text/html; charset=utf-8", include_str!("../../web/index.html"))
}

pub(super) async fn style() -> Response {
    asset("text/css; charset=utf-8", include_str!("../../web/app.css"))
}

pub(super) async fn script() -> Response {
    asset("text/javascript; charset=utf-8", include_str!("../../web/app.js"))
}

pub(super) async fn viewer() -> Response {
    asset("text/javascript; charset=utf-8", include_str!("../../web/viewer.js"))
}

pub(super) async fn icon() -> Response {
    asset("image/svg+xml", include_str!("../../web/icon.svg"))
}

pub(super) async fn sample() -> Response {
    asset("chemical/x-pdb", include_str!("../../samples/4pti.pdb"))
}
