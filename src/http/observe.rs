//! The span of a request, its log line and its duration, which ends with the last byte of the answer.

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Instant;

use axum::body::Body;
use axum::extract::{MatchedPath, Request};
use axum::http::Method;
use axum::middleware::Next;
use axum::response::Response;
use bytes::Bytes;
use hyper::body::{Body as HttpBody, Frame, SizeHint};
use metrics::histogram;
use tracing::Instrument as _;

use super::request_id::RequestId;
use crate::telemetry::HTTP_DURATION;

/// Watches one request.
pub(super) async fn request(request: Request, next: Next) -> Response {
    let start = Instant::now();
    let id = request.extensions().get::<RequestId>().cloned().unwrap_or_default();
    let route = request.extensions().get::<MatchedPath>().cloned();
    let method = request.method().clone();
    // The query stays out: a signature may stand in it. The guard adds whose key it is.
    let path = request.uri().path();
    let span = tracing::info_span!("request", id = id.as_str(), %method, path, key = tracing::field::Empty);
    let mut log = Log { start, method, route, status: None, span: span.clone(), bytes: 0, complete: false };
    let response = next.run(request).instrument(span).await;
    log.status = Some(response.status().as_u16());
    response.map(|body| {
        // Nobody polls a body that is empty, or the answer to HEAD.
        log.complete = body.is_end_stream() || log.method == Method::HEAD;
        Body::new(Observed { body, log })
    })
}

/// What is said about a request once it is over, however it ends.
struct Log {
    start: Instant,
    method: Method,
    route: Option<MatchedPath>,
    /// None if the client left before there was an answer.
    status: Option<u16>,
    span: tracing::Span,
    bytes: usize,
    complete: bool,
}

impl Drop for Log {
    fn drop(&mut self) {
        let time = self.start.elapsed();
        let route = self.route.as_ref().map_or("unmatched", MatchedPath::as_str).to_owned();
        let Self { status, bytes, complete, .. } = *self;
        let label = status.map_or_else(|| "none".to_owned(), |status| status.to_string());
        histogram!(HTTP_DURATION, "method" => known(&self.method), "route" => route, "status" => label)
            .record(time.as_secs_f64());
        let ms = (time.as_secs_f64() * 1e6).round() / 1e3;
        self.span.in_scope(|| {
            if let Some(status) = status {
                tracing::info!(status, ms, bytes, complete, "answered");
            } else {
                tracing::info!(ms, "the client left before it was answered");
            }
        });
    }
}

/// A method as a label: clients can make up any number of others.
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

/// A body that is counted.
struct Observed {
    body: Body,
    log: Log,
}

impl HttpBody for Observed {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let polled = Pin::new(&mut self.body).poll_frame(cx);
        match &polled {
            Poll::Ready(Some(Ok(frame))) => self.log.bytes += frame.data_ref().map_or(0, Bytes::len),
            Poll::Ready(None) => self.log.complete = true,
            _ => {}
        }
        if self.body.is_end_stream() {
            self.log.complete = true;
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
