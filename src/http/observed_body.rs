//! HTTP body with a callback for each frame that is read.

use std::pin::Pin;
use std::task::{Context, Poll};

use axum::body::Body;
use bytes::Bytes;
use hyper::body::{Body as HttpBody, Frame, SizeHint};

/// Wraps a body. `observe` receives the size of each frame in bytes, and true at the end of the body. It is dropped
/// with the body.
pub(super) fn observed(body: Body, observe: impl FnMut(usize, bool) + Send + Unpin + 'static) -> Body {
    Body::new(Observed { body, observe })
}

struct Observed<F> {
    body: Body,
    observe: F,
}

impl<F: FnMut(usize, bool) + Unpin> HttpBody for Observed<F> {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let polled = Pin::new(&mut self.body).poll_frame(cx);
        let bytes = match &polled {
            Poll::Ready(Some(Ok(frame))) => frame.data_ref().map_or(0, Bytes::len),
            _ => 0,
        };
        let is_end = matches!(polled, Poll::Ready(None)) || self.body.is_end_stream();
        (self.observe)(bytes, is_end);
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
