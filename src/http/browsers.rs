//! Headers for browsers: CORS, and restrictions on the use of responses.

use std::sync::Arc;

use axum::extract::{Request, State};
use axum::http::header::{self, HeaderName};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::Response;
use tower_http::cors::{AllowHeaders, AllowOrigin, Any, CorsLayer};

use super::colors::LEGEND;
use super::guard::{API_KEY, RATE_LIMIT, RATE_LIMIT_POLICY};
use super::observe::TRACEPARENT;
use super::preferences::{IDEMPOTENCY_KEY, PREFER, PREFERENCE_APPLIED, PRIORITY};
use super::state::Shared;
use super::timing::SERVER_TIMING;
use super::{delivery, request_id};
use crate::access::Access;

/// Content security policy of responses that are not pages: no scripts, no frames.
const POLICY: HeaderValue = HeaderValue::from_static("default-src 'none'; frame-ancestors 'none'");

/// Request headers that listed origins may send.
const ALLOWED: [HeaderName; 15] = [
    header::ACCEPT,
    header::AUTHORIZATION,
    header::CONTENT_ENCODING,
    header::CONTENT_TYPE,
    header::IF_MATCH,
    header::IF_NONE_MATCH,
    header::IF_RANGE,
    header::RANGE,
    API_KEY,
    IDEMPOTENCY_KEY,
    LAST_EVENT_ID,
    PREFER,
    PRIORITY,
    TRACEPARENT,
    request_id::HEADER,
];
const LAST_EVENT_ID: HeaderName = HeaderName::from_static("last-event-id");

/// Builds the CORS layer.
pub(super) fn cors(access: &Arc<Access>) -> CorsLayer {
    let exposed = [
        header::ETAG,
        header::LOCATION,
        header::CONTENT_LOCATION,
        header::CONTENT_RANGE,
        header::ACCEPT_RANGES,
        header::CONTENT_DISPOSITION,
        header::RETRY_AFTER,
        header::WWW_AUTHENTICATE,
        SERVER_TIMING,
        TRACEPARENT,
        PREFERENCE_APPLIED,
        RATE_LIMIT,
        RATE_LIMIT_POLICY,
        request_id::HEADER,
        LEGEND,
    ];
    let summary = delivery::SUMMARY.iter().chain(&delivery::PICTURE);
    let exposed = exposed.into_iter().chain(summary.map(|header| HeaderName::from_static(header.name)));
    let layer = CorsLayer::new()
        .allow_methods([Method::GET, Method::HEAD, Method::POST, Method::DELETE])
        .expose_headers(exposed.collect::<Vec<_>>())
        .max_age(std::time::Duration::from_hours(24));
    if access.sites.allows_any_origin() {
        if !access.is_closed() {
            return layer.allow_origin(Any).allow_headers(Any);
        }
        // `*` does not include `Authorization`.
        let all = [HeaderName::from_static("*"), header::AUTHORIZATION];
        return layer.allow_origin(Any).allow_headers(AllowHeaders::list(all));
    }
    let (shared, credentials) = (Arc::clone(access), access.allows_credentials);
    let allows = move |origin: &HeaderValue, _: &Parts| origin.to_str().is_ok_and(|o| shared.sites.allows_origin(o));
    layer
        .allow_origin(AllowOrigin::predicate(allows))
        .allow_headers(AllowHeaders::list(ALLOWED))
        .allow_credentials(credentials)
}

/// Adds security headers that the handler has not set.
pub(super) async fn restrain(State(app): State<Shared>, request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    let sites = &app.access.sites;
    let headers = response.headers_mut();
    // Browsers must not interpret a mesh as a script or a page.
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    // Only origins that may read responses may embed them.
    let embedders = match (sites.allows_any_origin(), sites.allows_loopback_origins()) {
        (true, _) => "cross-origin",
        (_, true) => "same-site",
        _ => "same-origin",
    };
    headers.insert(CROSS_ORIGIN_RESOURCE_POLICY, HeaderValue::from_static(embedders));
    or(headers, header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    or(headers, header::CONTENT_SECURITY_POLICY, POLICY);
    response
}

const CROSS_ORIGIN_RESOURCE_POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");

fn or(headers: &mut HeaderMap, name: HeaderName, value: HeaderValue) {
    headers.entry(name).or_insert(value);
}
