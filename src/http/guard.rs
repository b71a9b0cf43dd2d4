//! Authentication, authorization and quotas: keys, signed URLs, limits per client.
//!
//! Only permitted requests for operations that need a scope count towards a quota. Work is charged when it is done, to
//! the client that requested it first.

use std::convert::Infallible;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use axum::extract::{FromRequestParts, Request, State};
use axum::http::header::{self, AUTHORIZATION, HeaderMap, HeaderName, WWW_AUTHENTICATE};
use axum::http::request::Parts;
use axum::http::uri::{PathAndQuery, Uri};
use axum::http::{Extensions, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use http_body_util::BodyExt as _;
use hyper::body::Body as _;
use tracing::Span;

use super::observed_body::observed;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::{App, Shared};
use crate::access::{
    Access, Account, Denied, Key, Quota, QuotaExceeded, Scope, Signature, SignatureCheck, rate_limit,
    rate_limit_policy, remove_signature,
};
use crate::jobs::{Client, rfc3339};
use crate::store::Namespace;

/// `X-Api-Key`, an alternative to `Authorization`.
pub(super) const API_KEY: HeaderName = HeaderName::from_static("x-api-key");
/// `RateLimit-Policy` and `RateLimit`: the quotas, and the remainder.
pub(super) const RATE_LIMIT_POLICY: HeaderName = HeaderName::from_static("ratelimit-policy");
pub(super) const RATE_LIMIT: HeaderName = HeaderName::from_static("ratelimit");

/// Maximum time that a request waits until the records of jobs were read, after a start.
const RECORDS_WAIT: Duration = Duration::from_secs(5);

/// Remote address of a connection.
#[derive(Debug, Clone, Copy)]
pub(super) struct Peer(pub(super) IpAddr);

impl Peer {
    /// Returns the identity of the peer, which is that of its requests if it is no proxy and they have no key.
    pub(super) fn client(self) -> Client {
        Client::named(&client_name(self.0.to_canonical()))
    }
}

/// Client of a request.
#[derive(Debug, Clone, Default)]
pub(super) struct Caller {
    /// Identity for the queue: a key, else an address.
    pub(super) client: Client,
    /// Namespace of its structures, results and jobs.
    pub(super) namespace: Namespace,
    /// Account of its quota; `None` without limits.
    account: Option<Account>,
}

impl Caller {
    /// Returns the caller that [`check`] has found.
    pub(super) fn of(extensions: &Extensions) -> Self {
        extensions.get::<Self>().cloned().unwrap_or_default()
    }

    fn new(name: &str, is_key: bool, quota: Option<&Arc<Quota>>) -> Self {
        let client = Client::named(name);
        let quota = quota.filter(|quota| !quota.is_unlimited()).cloned();
        Self {
            client,
            namespace: Namespace::default(),
            account: quota.map(|quota| Account { client: client.0, is_key, quota }),
        }
    }

    fn key(app: &App, key: &Key) -> Self {
        Self::new(&format!("key {}", key.id), true, Some(&key.quota)).within(app.namespace(&key.group))
    }

    fn address(access: &Access, request: &Request) -> Self {
        let Some(Peer(peer)) = request.extensions().get::<Peer>() else { return Self::default() };
        let values = request.headers().get_all("x-forwarded-for").iter().filter_map(|v| v.to_str().ok());
        Self::new(&client_name(access.client(*peer, values)), false, access.address_quota.as_ref())
    }

    fn within(self, namespace: Namespace) -> Self {
        Self { namespace, ..self }
    }
}

/// Reads the caller that [`check`] has found.
impl<S: Sync> FromRequestParts<S> for Caller {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(Self::of(&parts.extensions))
    }
}

/// Name of an address as a client. IPv6 addresses count by their /64 network, which one client commonly owns.
fn client_name(address: IpAddr) -> String {
    match address {
        IpAddr::V4(address) => address.to_string(),
        IpAddr::V6(address) => {
            let [a, b, c, d, ..] = address.segments();
            format!("{a:x}:{b:x}:{c:x}:{d:x}::/64")
        }
    }
}

/// Scope that a request needs; `None`: it is open. `operations` records it.
#[derive(Clone, Copy)]
pub(super) struct RequiredScope(pub(super) Option<Scope>);

impl RequiredScope {
    /// Returns the recorded scope.
    pub(super) fn of(request: &Request) -> Option<Scope> {
        // A request without a record is not open by mistake.
        request.extensions().get::<Self>().map_or(Some(Scope::Mesh), |Self(scope)| *scope)
    }
}

/// Middleware: passes permitted requests on, refuses the others.
pub(super) async fn check(State(app): State<Shared>, mut request: Request, next: Next) -> Response {
    let key = presented(request.headers());
    // Handlers and logs do not see the key.
    request.headers_mut().remove(AUTHORIZATION);
    request.headers_mut().remove(API_KEY);
    let Some(scope) = RequiredScope::of(&request) else { return next.run(request).await };
    let (caller, signature) = match authorize(&app, scope, key, &mut request) {
        Ok(authorized) => authorized,
        Err(problem) => {
            discard_body(request).await;
            return problem.into_response();
        }
    };
    // Until then, inputs of unfinished jobs are not protected from eviction, and their ends are not known.
    if !app.job_store.records_read(RECORDS_WAIT).await {
        discard_body(request).await;
        let detail = "the service has just started and still reads the records of its jobs";
        return Problem::new(ProblemType::NotReady, detail).retry_after(RECORDS_WAIT).into_response();
    }
    let account = caller.account.clone();
    let running = account.as_ref().map(|account| app.access.meter.admit(account, Instant::now())).transpose();
    request.extensions_mut().insert(caller);
    let mut response = match running {
        Ok(None) => next.run(request).await,
        Ok(Some(running)) => next.run(request).await.map(|body| {
            // The request counts until the body is dropped.
            observed(body, move |_bytes, _is_end| _ = &running)
        }),
        Err(exceeded) => {
            discard_body(request).await;
            refusal(&exceeded).into_response()
        }
    };
    if let Some(account) = &account {
        add_quota_headers(&app.access, account, &mut response);
    }
    if app.access.is_closed() {
        keep_private(response.headers_mut());
    }
    if let Some(signature) = signature {
        end_with_signature(&app.access, &signature, response.headers_mut());
    }
    response
}

/// Reads the body of a refused request if it is small and arrives at once: some HTTP/2 clients report a broken stream
/// if the response arrives before they have sent their body.
pub(super) async fn discard_body(request: Request) {
    const MAX_BYTES: u64 = 64 << 10;
    const MAX_TIME: Duration = Duration::from_millis(500);
    let asks_first = request.headers().contains_key(header::EXPECT);
    let mut body = request.into_body();
    if asks_first || body.size_hint().lower() > MAX_BYTES {
        return;
    }
    let read = async {
        let mut seen = 0;
        while let Some(Ok(frame)) = body.frame().await {
            seen += frame.data_ref().map_or(0, |data| data.len() as u64);
            if seen > MAX_BYTES {
                break;
            }
        }
    };
    drop(tokio::time::timeout(MAX_TIME, read).await);
}

/// Key of a request as the client sent it.
enum Presented {
    Nothing,
    Text(String),
    /// Several keys, or not text.
    Nonsense,
}

/// Returns true if a request has a key, known or not.
pub(super) fn has_key(headers: &HeaderMap) -> bool {
    !matches!(presented(headers), Presented::Nothing)
}

fn presented(headers: &HeaderMap) -> Presented {
    const SCHEME: &str = "bearer ";
    let bearer = headers.get_all(AUTHORIZATION).iter().filter_map(|value| {
        let value = value.as_bytes();
        // Other schemes are meant for proxies.
        let ours = value.len() > SCHEME.len() && value[..SCHEME.len()].eq_ignore_ascii_case(SCHEME.as_bytes());
        ours.then(|| value[SCHEME.len()..].trim_ascii())
    });
    let plain = headers.get_all(API_KEY).iter().map(HeaderValue::as_bytes);
    let mut texts = bearer.chain(plain);
    let Some(first) = texts.next() else { return Presented::Nothing };
    match str::from_utf8(first) {
        Ok(text) if texts.all(|other| other == first) => Presented::Text(text.to_owned()),
        _ => Presented::Nonsense,
    }
}

/// Identifies and authorizes the client. Removes a valid signature from the address and returns it.
fn authorize(
    app: &App,
    scope: Scope,
    key: Presented,
    request: &mut Request,
) -> Result<(Caller, Option<Signature>), Problem> {
    let access = &app.access;
    if !access.is_closed() {
        return Ok((Caller::address(access, request), None));
    }
    let now = SystemTime::now();
    let may_be_signed = [Method::GET, Method::HEAD].contains(request.method());
    let uri = request.uri();
    let signature =
        if may_be_signed { access.check_signature(uri.path(), uri.query(), now) } else { SignatureCheck::Absent };
    if signature != SignatureCheck::Absent {
        *request.uri_mut() = unsigned(request.uri())?;
    }
    let found = match key {
        Presented::Text(text) => access.verify(&text, now),
        Presented::Nonsense => Err(Denied::Unknown),
        Presented::Nothing => {
            let signature = by_signature(signature)?;
            let caller = Caller::address(access, request).within(app.namespace(&signature.group));
            return Ok((caller, Some(signature)));
        }
    };
    let key = found.map_err(no_key)?;
    Span::current().record("key", key.id.as_str());
    if !key.allows(scope) {
        let detail = format!("the scope `{}` is required, which the key `{}` does not have", scope.name(), key.id);
        let challenge = format!("Bearer realm=\"molmesh\", error=\"insufficient_scope\", scope=\"{}\"", scope.name());
        return Err(Problem::new(ProblemType::ScopeMissing, detail)
            .with("scope", scope.name())
            .header(WWW_AUTHENTICATE, &challenge));
    }
    let signature = if let SignatureCheck::Valid(signature) = signature { Some(signature) } else { None };
    Ok((Caller::key(app, &key), signature))
}

/// Returns the address without its signature.
fn unsigned(uri: &Uri) -> Result<Uri, Problem> {
    let rest = uri.query().and_then(remove_signature);
    let target = rest.map_or_else(|| uri.path().to_owned(), |rest| format!("{}?{rest}", uri.path()));
    let mut parts = uri.clone().into_parts();
    parts.path_and_query = Some(PathAndQuery::try_from(target).map_err(Problem::internal)?);
    Uri::from_parts(parts).map_err(Problem::internal)
}

/// Returns a valid signature.
fn by_signature(signature: SignatureCheck) -> Result<Signature, Problem> {
    match signature {
        SignatureCheck::Valid(signature) => Ok(signature),
        SignatureCheck::Absent => Err(Problem::new(
            ProblemType::KeyRequired,
            "a key is required, in `Authorization: Bearer …` or `X-Api-Key`; a GET may use a signed URL instead",
        )
        .header(WWW_AUTHENTICATE, "Bearer realm=\"molmesh\"")),
        SignatureCheck::Invalid => {
            let detail = "the signature does not match this address, which must be used unchanged";
            Err(Problem::new(ProblemType::SignatureInvalid, detail))
        }
        SignatureCheck::Expired(end) => {
            let end = rfc3339(end.saturating_mul(1000));
            let detail = format!("the signed URL expired at {end}");
            Err(Problem::new(ProblemType::SignatureExpired, detail).with("expired", end))
        }
    }
}

fn no_key(denied: Denied) -> Problem {
    let problem = match denied {
        Denied::Unknown => Problem::new(ProblemType::KeyInvalid, "the key is unknown"),
        Denied::Expired(end) => {
            let end = humantime::format_rfc3339_seconds(end).to_string();
            Problem::new(ProblemType::KeyExpired, format!("the key expired at {end}")).with("expired", end)
        }
    };
    problem.header(WWW_AUTHENTICATE, "Bearer realm=\"molmesh\", error=\"invalid_token\"")
}

/// Returns the problem of an exceeded quota.
fn refusal(exceeded: &QuotaExceeded) -> Problem {
    let QuotaExceeded { policy, limit, wait } = *exceeded;
    let what = match policy {
        "work" => format!("the jobs of this client took {limit} s of this window or more, which is its quota"),
        "concurrency" => format!("{limit} requests of this client are running, which is its quota"),
        _ => format!("this client has made {limit} requests in this window, which is its quota"),
    };
    Problem::new(ProblemType::QuotaExceeded, what)
        .with("violated-policies", vec![policy])
        .with("limit", limit)
        .retry_after_window(wait)
}

impl App {
    /// Fails if the caller's quota of work is used up.
    pub(super) fn admit_work(&self, caller: &Caller) -> Result<(), Problem> {
        let Some(account) = &caller.account else { return Ok(()) };
        self.access.meter.admit_work(account, Instant::now()).map_err(|exceeded| refusal(&exceeded))
    }

    /// Charges `time` of work that is not a job to `caller`.
    pub(super) fn charge(&self, caller: &Caller, time: Duration) {
        self.access.meter.spent(caller.client.0, time, Instant::now());
    }
}

/// Adds the quota headers to a response.
fn add_quota_headers(access: &Access, account: &Account, response: &mut Response) {
    // A client without remaining quota would delay following the redirect.
    let redirects = response.headers().contains_key(header::LOCATION) && response.status().is_redirection();
    let usage = access.meter.usage(account, Instant::now());
    let fields = [
        (RATE_LIMIT_POLICY, rate_limit_policy(&account.quota)),
        (RATE_LIMIT, rate_limit(&account.quota, &usage).filter(|_| !redirects)),
    ];
    for (name, value) in fields {
        if let Some(value) = value.and_then(|value| HeaderValue::try_from(value).ok()) {
            response.headers_mut().insert(name, value);
        }
    }
}

/// Makes a cacheable response private, since a key or a signature was needed for it.
fn keep_private(headers: &mut HeaderMap) {
    let Some(value) = headers.get(header::CACHE_CONTROL).and_then(|value| value.to_str().ok()) else { return };
    let private = value.strip_prefix("public").map(|rest| HeaderValue::try_from(format!("private{rest}")));
    if let Some(Ok(value)) = private {
        headers.insert(header::CACHE_CONTROL, value);
    }
}

/// Limits the caching of a response to the time for which its signed URL is valid, and signs the URL that it
/// redirects to in the same way.
fn end_with_signature(access: &Access, signature: &Signature, headers: &mut HeaderMap) {
    let end_time = UNIX_EPOCH.checked_add(Duration::from_secs(signature.until)).unwrap_or_else(SystemTime::now);
    let left = end_time.duration_since(SystemTime::now()).unwrap_or_default().as_secs();
    let text = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok());
    let cached = text(header::CACHE_CONTROL).map(|value| cached_for(value, left));
    let location = text(header::LOCATION).and_then(|target| access.sign(target, signature));
    for (name, value) in [(header::CACHE_CONTROL, cached), (header::LOCATION, location)] {
        if let Some(value) = value.and_then(|value| HeaderValue::try_from(value).ok()) {
            headers.insert(name, value);
        }
    }
}

/// Returns a `Cache-Control` for `left` seconds at most: without permission to use a response that is older.
fn cached_for(value: &str, left: u64) -> String {
    let directives = value.split(',').map(str::trim).filter_map(|directive| match directive.split_once('=') {
        Some(("max-age", age)) => Some(format!("max-age={}", age.parse().map_or(left, |age: u64| age.min(left)))),
        Some(("stale-while-revalidate" | "stale-if-error", _)) => None,
        _ => Some(directive.to_owned()).filter(|directive| directive != "immutable"),
    });
    directives.collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests;
