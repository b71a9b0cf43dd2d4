//! Protection against web pages of other sites: the host that a request names, and the site that it comes from.

use std::time::SystemTime;

use axum::extract::{Request, State};
use axum::http::header::{HOST, HeaderName, ORIGIN};
use axum::http::uri::Authority;
use axum::http::{HeaderValue, Method, Version};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::guard::{self, RequiredScope};
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::Shared;
use crate::access::{Access, SignatureCheck, Sites, authority};

/// Fetch metadata that browsers send to trustworthy addresses.
const SEC_FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");
const SEC_FETCH_MODE: HeaderName = HeaderName::from_static("sec-fetch-mode");
const SEC_FETCH_DEST: HeaderName = HeaderName::from_static("sec-fetch-dest");

/// Middleware: passes requests on that name this service and do not come from a page of another site.
pub(super) async fn check(State(app): State<Shared>, request: Request, next: Next) -> Response {
    match admit(&app.access, &request) {
        Ok(()) => next.run(request).await,
        Err(problem) => {
            guard::discard_body(request).await;
            problem.into_response()
        }
    }
}

/// Returns the host that the request names. Fails if the listener does not answer to it.
pub(super) fn check_host(sites: &Sites, request: &Request) -> Result<Option<Authority>, Problem> {
    let host = host(request)?;
    if let Some(host) = &host
        && !sites.answers(host.as_str())
    {
        let detail = format!("this service does not answer to `{host}`; the operator can add it to server.hosts");
        return Err(Problem::new(ProblemType::WrongHost, detail));
    }
    Ok(host)
}

fn admit(access: &Access, request: &Request) -> Result<(), Problem> {
    let host = check_host(&access.sites, request)?;
    if is_foreign(access, request, host.as_ref()) && !has_key(access, request) && !opens_page(request) {
        let detail = "a page of another origin made this request, and the service does not allow that origin";
        return Err(Problem::new(ProblemType::CrossSite, detail));
    }
    Ok(())
}

/// Returns the host that the request names, with its port. HTTP/1.0 does not require one.
fn host(request: &Request) -> Result<Option<Authority>, Problem> {
    let bad = |detail: &str| Problem::new(ProblemType::BadRequest, detail);
    let mut named = request.uri().authority().cloned();
    let mut values = request.headers().get_all(HOST).iter();
    if let Some(value) = values.next() {
        let parsed = Authority::try_from(value.as_bytes()).ok().filter(|host| !host.as_str().contains('@'));
        let host = parsed.ok_or_else(|| bad("the header `Host` is not a host with an optional port"))?;
        if values.next().is_some() || named.is_some_and(|named| named != host) {
            return Err(bad("the request names more than one host"));
        }
        named = Some(host);
    }
    if named.is_none() && request.version() != Version::HTTP_10 {
        return Err(bad("the header `Host` is missing"));
    }
    Ok(named)
}

/// Returns true if a page of an origin that may not read responses made the request.
fn is_foreign(access: &Access, request: &Request, host: Option<&Authority>) -> bool {
    let origin = request.headers().get(ORIGIN).map(|origin| origin.to_str().unwrap_or("null"));
    if access.sites.allows_any_origin() || origin.is_some_and(|origin| access.sites.allows_origin(origin)) {
        return false;
    }
    match request.headers().get(SEC_FETCH_SITE).map(HeaderValue::as_bytes) {
        Some(b"same-origin" | b"none") => false,
        Some(b"cross-site") => true,
        // A page of the service sends its own origin; a proxy with TLS changes only the scheme.
        _ => origin.is_some_and(|origin| {
            !authority(origin).zip(host).is_some_and(|(own, host)| host.as_str().eq_ignore_ascii_case(own))
        }),
    }
}

/// Returns true if the request has a key or a signature, which other pages cannot add. The guard verifies them.
fn has_key(access: &Access, request: &Request) -> bool {
    let uri = request.uri();
    guard::has_key(request.headers())
        || access.check_signature(uri.path(), uri.query(), SystemTime::now()) != SignatureCheck::Absent
}

/// Returns true if the user follows a link to the page, the documentation or another public document.
fn opens_page(request: &Request) -> bool {
    let is = |name, value: &[u8]| request.headers().get(name).is_some_and(|sent| sent.as_bytes() == value);
    request.method() == Method::GET
        && is(SEC_FETCH_MODE, b"navigate")
        && is(SEC_FETCH_DEST, b"document")
        && RequiredScope::of(request).is_none()
}
