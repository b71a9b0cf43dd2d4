//! Headers for browsers: CORS, and restrictions on the use of responses.

use axum::extract::{Request, State};
use axum::http::header::{self, HeaderName};
use axum::http::{HeaderMap, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::Response;
use tower_http::cors::{AllowHeaders, AllowOrigin, Any, CorsLayer};

use super::guard::{API_KEY, RATE_LIMIT, RATE_LIMIT_POLICY};
use super::observe::TRACEPARENT;
use super::preferences::{IDEMPOTENCY_KEY, PREFER, PREFERENCE_APPLIED, PRIORITY};
use super::state::Shared;
use super::timing::SERVER_TIMING;
use super::{delivery, request_id};
use crate::access::Access;
use crate::config::Origins;

/// Content security policy of responses that are not pages: no scripts, no frames.
const POLICY: HeaderValue = HeaderValue::from_static("default-src 'none'; frame-ancestors 'none'");

/// Request headers that listed origins may send.
const ALLOWED: [HeaderName; 14] = [
    header::ACCEPT,
    header::AUTHORIZATION,
    header::CONTENT_ENCODING,
    header::CONTENT_TYPE,
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
pub(super) fn cors(access: &Access) -> CorsLayer {
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
    ];
    let summary = delivery::SUMMARY.iter().chain(&delivery::PICTURE);
    let exposed = exposed.into_iter().chain(summary.map(|header| HeaderName::from_static(header.name)));
    let layer = CorsLayer::new()
        .allow_methods([Method::GET, Method::HEAD, Method::POST, Method::DELETE])
        .expose_headers(exposed.collect::<Vec<_>>())
        .max_age(std::time::Duration::from_hours(24));
    match &access.config().cors_origins {
        Some(Origins::Any) if access.is_closed() => {
            // `*` does not include `Authorization`.
            let all = [HeaderName::from_static("*"), header::AUTHORIZATION];
            layer.allow_origin(Any).allow_headers(AllowHeaders::list(all))
        }
        Some(Origins::Any) => layer.allow_origin(Any).allow_headers(Any),
        Some(Origins::These(origins)) => {
            let origins = origins.iter().filter_map(|origin| HeaderValue::from_str(origin).ok());
            layer
                .allow_origin(AllowOrigin::list(origins))
                .allow_headers(AllowHeaders::list(ALLOWED))
                .allow_credentials(access.config().cors_credentials)
        }
        // Without CORS headers browsers reject cross-origin requests.
        None => layer,
    }
}

/// Adds security headers that the handler has not set.
pub(super) async fn restrain(State(app): State<Shared>, request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    let config = app.access.config();
    let any_origin = config.cors_origins == Some(Origins::Any);
    let headers = response.headers_mut();
    // Browsers must not interpret a mesh as a script or a page.
    headers.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    // Only origins that may read responses may embed them.
    let embedders = if any_origin { "cross-origin" } else { "same-origin" };
    headers.insert(CROSS_ORIGIN_RESOURCE_POLICY, HeaderValue::from_static(embedders));
    or(headers, header::REFERRER_POLICY, HeaderValue::from_static("no-referrer"));
    or(headers, header::CONTENT_SECURITY_POLICY, POLICY);
    if let Some(value) = config.hsts_s.and_then(|age| HeaderValue::try_from(format!("max-age={age}")).ok()) {
        headers.insert(header::STRICT_TRANSPORT_SECURITY, value);
    }
    response
}

const CROSS_ORIGIN_RESOURCE_POLICY: HeaderName = HeaderName::from_static("cross-origin-resource-policy");

fn or(headers: &mut HeaderMap, name: HeaderName, value: HeaderValue) {
    headers.entry(name).or_insert(value);
}
