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

/// Describes a handler that answers with an embedded file, and is one.
macro_rules! embedded {
    ($handler:ident, $path:literal, $id:literal, $media_type:literal, $words:literal, $file:literal) => {
        #[doc = $words]
        #[utoipa::path(get, path = $path, tag = "page", operation_id = $id,
                            responses((status = 200, description = $words, body = String, content_type = $media_type)))]
        pub(super) async fn $handler() -> Response {
            asset($media_type, include_str!($file))
        }
    };
}

embedded!(index, "/", "page", "text/html; charset=utf-8", "The page.", "../../web/index.html");
embedded!(style, "/app.css", "pageStyle", "text/css; charset=utf-8", "Its style.", "../../web/app.css");
embedded!(script, "/app.js", "pageScript", "text/javascript; charset=utf-8", "Its script.", "../../web/app.js");
embedded!(viewer, "/viewer.js", "pageViewer", "text/javascript; charset=utf-8", "Its viewer.", "../../web/viewer.js");
embedded!(icon, "/icon.svg", "pageIcon", "image/svg+xml", "Its icon.", "../../web/icon.svg");
embedded!(sample, "/sample.pdb", "sample", "chemical/x-pdb", "A structure to try.", "../../samples/4pti.pdb");
