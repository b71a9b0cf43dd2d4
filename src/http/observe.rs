//! Span, log line and metrics of a request, which end with the last byte of the response.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use axum::extract::{MatchedPath, Request, State};
use axum::http::header::CONTENT_LENGTH;
use axum::http::{HeaderName, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::Response;
use hyper::body::Body as _;
use metrics::{gauge, histogram};
use tracing::Instrument as _;

use super::observed_body::observed;
use super::request_id::RequestId;
use super::timing;
use crate::telemetry::{
    HTTP_ACTIVE, HTTP_DURATION, HTTP_REQUEST_SIZE, HTTP_RESPONSE_SIZE, SpanKind, SpanParent, TraceSpan, Tracer,
    read_trace_context, shorten, traceparent,
};

/// `traceparent` (W3C Trace Context), of requests and responses.
pub(super) const TRACEPARENT: HeaderName = HeaderName::from_static("traceparent");
/// `tracestate` (W3C Trace Context), of requests; exported with the spans.
const TRACESTATE: HeaderName = HeaderName::from_static("tracestate");

/// Middleware: observes one request.
pub(super) async fn request(State(tracer): State<Tracer>, request: Request, next: Next) -> Response {
    let start = Instant::now();
    let id = request.extensions().get::<RequestId>().cloned().unwrap_or_default();
    let route = request.extensions().get::<MatchedPath>().cloned();
    let method = request.method().clone();
    let trace = {
        // Joins several values, as HTTP permits: the result is valid for `tracestate` and invalid for `traceparent`.
        let header = |name| {
            let values = request.headers().get_all(name).iter();
            values.map(|value| value.to_str().unwrap_or_default()).collect::<Vec<_>>().join(",")
        };
        let context = read_trace_context(&header(TRACEPARENT), &header(TRACESTATE));
        let parent = SpanParent { request: Some(id.as_str().into()), context, tracer };
        let method = known(&method);
        let name = route.as_ref().map_or_else(|| method.to_owned(), |route| format!("{method} {}", route.as_str()));
        TraceSpan::start(&parent, name, SpanKind::Server, start)
    };
    // The log omits the query, which may contain a signature. The guard adds the id of the key.
    let path = shorten(request.uri().path());
    let span = tracing::info_span!(
        "request",
        request_id = id.as_str(),
        trace_id = %trace.trace_id(),
        %method,
        path = path.as_str(),
        key = tracing::field::Empty
    );
    let received = Arc::new(AtomicU64::new(0));
    gauge!(HTTP_ACTIVE, "method" => known(&method)).increment(1.0);
    let path = if trace.is_recording() { path } else { String::new() };
    let mut log = Log {
        start,
        method,
        route,
        path,
        status: None,
        span: span.clone(),
        trace: trace.clone(),
        received: Arc::clone(&received),
        bytes: 0,
        length: None,
        complete: false,
    };
    let request = request
        .map(|body| observed(body, move |bytes, _is_end| _ = received.fetch_add(bytes as u64, Ordering::Relaxed)));
    let own_parent = HeaderValue::from_str(&traceparent(&trace.context()));
    let mut response = trace.run(next.run(request)).instrument(span).await;
    timing::write_header(&mut response, start.elapsed());
    if let Ok(own_parent) = own_parent {
        response.headers_mut().insert(TRACEPARENT, own_parent);
    }
    log.status = Some(response.status().as_u16());
    let length = response.headers().get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse().ok());
    response.map(|body| {
        // An empty body and the response to HEAD are not polled.
        log.complete = body.is_end_stream() || log.method == Method::HEAD;
        log.length = length.or_else(|| body.size_hint().exact());
        observed(body, move |bytes, is_end| log.count(bytes, is_end))
    })
}

/// Facts about a request, recorded when it is dropped.
struct Log {
    start: Instant,
    method: Method,
    route: Option<MatchedPath>,
    /// Path of a request whose span is recorded; otherwise empty.
    path: String,
    /// `None` if the client left before the response.
    status: Option<u16>,
    span: tracing::Span,
    trace: TraceSpan,
    /// Size of the request body, bytes.
    received: Arc<AtomicU64>,
    /// Bytes of the response body that were sent.
    bytes: usize,
    /// Announced size of the response body, bytes. A body of known size is not polled after its last byte.
    length: Option<u64>,
    complete: bool,
}

impl Drop for Log {
    fn drop(&mut self) {
        let time = self.start.elapsed();
        let route = self.route.as_ref().map_or("unmatched", MatchedPath::as_str).to_owned();
        let Self { status, bytes, complete, .. } = *self;
        let label = status.map_or_else(|| "none".to_owned(), |status| status.to_string());
        let method = known(&self.method);
        let received = self.received.load(Ordering::Relaxed);
        gauge!(HTTP_ACTIVE, "method" => method).decrement(1.0);
        for (name, value) in [
            (HTTP_DURATION, time.as_secs_f64()),
            (HTTP_REQUEST_SIZE, received as f64),
            (HTTP_RESPONSE_SIZE, bytes as f64),
        ] {
            histogram!(name, "method" => method, "route" => route.clone(), "status" => label.clone()).record(value);
        }
        let ms = (time.as_secs_f64() * 1e6).round() / 1e3;
        self.span.in_scope(|| {
            if let Some(status) = status {
                tracing::info!(status, ms, bytes, complete, "answered");
            } else {
                tracing::info!(ms, "the client left before the response");
            }
        });
        if self.trace.is_recording() {
            self.describe(method, route, received);
        }
        self.trace.end();
    }
}

impl Log {
    fn count(&mut self, bytes: usize, is_end: bool) {
        self.bytes += bytes;
        self.complete |= is_end || self.length == Some(self.bytes as u64);
    }

    /// Sets the attributes of the span, named by OpenTelemetry's conventions, and its status.
    fn describe(&self, method: &'static str, route: String, received: u64) {
        let trace = &self.trace;
        trace.set("http.request.method", method);
        trace.set("url.path", self.path.clone());
        trace.set("http.request.body.size", received.cast_signed());
        trace.set("http.response.body.size", (self.bytes as u64).cast_signed());
        trace.set("molmesh.request.id", trace.request().to_owned());
        trace.set("molmesh.complete", self.complete);
        if self.route.is_some() {
            trace.set("http.route", route);
        }
        if let Some(status) = self.status {
            trace.set("http.response.status_code", i64::from(status));
            // By OpenTelemetry's conventions, 4xx are not errors of a server.
            if status >= 500 {
                trace.fail(format!("answered with {status}"));
            }
        }
    }
}

/// Returns a method as a label. Unknown methods share one, since clients can invent any number.
fn known(method: &Method) -> &'static str {
    match method.as_str() {
        "GET" => "GET",
        "HEAD" => "HEAD",
        "POST" => "POST",
        "OPTIONS" => "OPTIONS",
        "PUT" => "PUT",
        "DELETE" => "DELETE",
        "PATCH" => "PATCH",
        _ => "other",
    }
}
