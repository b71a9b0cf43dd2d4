//! Request ids: the client's own if it is valid, else a random one.

use std::collections::hash_map::RandomState;
use std::hash::BuildHasher as _;
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU64, Ordering};

use axum::extract::Request;
use axum::http::{HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;

/// `X-Request-Id`, of requests and responses.
pub(super) const HEADER: HeaderName = HeaderName::from_static("x-request-id");
/// Maximum length of a client's id, which is part of every log line.
const MAX_LEN: usize = 64;

/// Id of a request: visible ASCII.
#[derive(Debug, Clone)]
pub(super) struct RequestId(HeaderValue);

impl RequestId {
    /// Returns the id as text.
    pub(super) fn as_str(&self) -> &str {
        self.0.to_str().unwrap_or_default()
    }

    fn random() -> Self {
        // The random hash keys of the standard library suffice for an id.
        static KEYS: LazyLock<[RandomState; 2]> = LazyLock::new(Default::default);
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let n = NEXT.fetch_add(1, Ordering::Relaxed);
        let [a, b] = KEYS.each_ref().map(|keys| keys.hash_one(n));
        HeaderValue::from_str(&format!("{a:016x}{b:016x}")).map_or_else(|_| Self::default(), Self)
    }
}

impl Default for RequestId {
    fn default() -> Self {
        Self(HeaderValue::from_static("unknown"))
    }
}

fn is_valid(id: &HeaderValue) -> bool {
    let allowed = |b: &u8| b.is_ascii_alphanumeric() || b"-_.".contains(b);
    (1..=MAX_LEN).contains(&id.len()) && id.as_bytes().iter().all(allowed)
}

/// Middleware: assigns the id and adds it to the response.
pub(super) async fn assign(mut request: Request, next: Next) -> Response {
    let sent = request.headers().get(&HEADER).filter(|id| is_valid(id)).cloned();
    let id = sent.map_or_else(RequestId::random, RequestId);
    request.extensions_mut().insert(id.clone());
    let mut response = next.run(request).await;
    response.headers_mut().insert(HEADER, id.0);
    response
}
