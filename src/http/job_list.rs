//! `GET /v1/jobs`: the jobs of the caller, in pages.
//!
//! The id of a job gives access to it, so a list must not contain jobs of others. With keys it has the jobs of the
//! caller's namespace, which every key of its group can open anyway. Without keys a client is an address, as for shares
//! and quotas. That is refused if the address does not stand for one client: a forgotten `server.trusted_proxies` would
//! otherwise show everybody the jobs of all, and with `access.cors_origins = "*"` any web page those of its reader.

use axum::Extension;
use axum::body::Body;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::http::header::{self, FORWARDED, HeaderName, HeaderValue, ORIGIN, VIA};
use axum::response::{IntoResponse, Response};
use bytes::BytesMut;
use utoipa::ToSchema;

use super::guard::{Caller, Peer};
use super::jobs::{self, JobDocument, Link};
use super::openapi::parameters::JobListParameters;
use super::openapi::problem_responses;
use super::parsed_request::Pairs;
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::{App, Shared};
use crate::jobs::{JobCursor, JobFilter, JobView, LISTED_BYTES, MAX_READS, Status};
use crate::pipeline::params::{self, ParamError};
use crate::store::Folder;
use crate::surface::OutOfMemory;

/// Number of jobs of a page, unless the client asks for another one.
pub(super) const DEFAULT_LIMIT: usize = 100;
/// Maximum number of jobs of a page.
pub(super) const MAX_LIMIT: usize = MAX_READS;
/// Names of the parameters.
const NAMES: [&str; 3] = ["state", "limit", "after"];
/// Headers with which proxies pass requests on.
const PROXY_HEADERS: [HeaderName; 4] =
    [HeaderName::from_static("x-forwarded-for"), HeaderName::from_static("x-real-ip"), FORWARDED, VIA];

/// Page of a list of jobs.
#[derive(Debug, ToSchema)]
#[expect(dead_code, reason = "for the schema alone: documents are written one by one")]
pub(super) struct JobList {
    /// Jobs in a fixed order, which does not follow from their times.
    jobs: Vec<JobDocument>,
    /// This page as `self`, and the next page as `next`; the last page has no `next`.
    links: Vec<Link>,
}

/// Parameters of a list of jobs.
#[derive(Debug, PartialEq)]
struct ListParameters {
    state: Option<Status>,
    limit: usize,
    after: Option<JobCursor>,
}

/// Returns the value of a parameter that may be given once.
pub(super) fn single<'a>(pairs: &'a [(String, String)], name: &'static str) -> Result<Option<&'a str>, ParamError> {
    let mut values = pairs.iter().filter(|(other, _)| other == name).map(|(_, value)| value.as_str());
    match (values.next(), values.next()) {
        (_, Some(_)) => Err(ParamError::Repeated { name }),
        (value, None) => Ok(value),
    }
}

/// Returns the size of a page.
pub(super) fn parse_limit(pairs: &[(String, String)]) -> Result<usize, ParamError> {
    let Some(text) = single(pairs, "limit")? else { return Ok(DEFAULT_LIMIT) };
    let number = text.parse().ok().filter(|limit| (1..=MAX_LIMIT).contains(limit));
    number.ok_or_else(|| ParamError::bad_value("limit", text, format!("a number from 1 to {MAX_LIMIT}")))
}

impl ListParameters {
    fn parse(pairs: &[(String, String)]) -> Result<Self, ParamError> {
        params::check_names(pairs, &NAMES)?;
        let state = |text: &str| {
            let expected = || Status::ALL.map(Status::name).join(", ");
            let found = Status::ALL.into_iter().find(|status| status.name() == text);
            found.ok_or_else(|| ParamError::bad_value("state", text, expected()))
        };
        let after = |text: &str| {
            let expected = "the value in the link `next` of the page before";
            text.parse().map_err(|_bad| ParamError::bad_value("after", text, expected))
        };
        Ok(Self {
            state: single(pairs, "state")?.map(state).transpose()?,
            limit: parse_limit(pairs)?,
            after: single(pairs, "after")?.map(after).transpose()?,
        })
    }

    /// Returns the address of the page that begins at `after`.
    fn address(&self, after: Option<&JobCursor>) -> String {
        let state = self.state.map(|state| format!("&state={}", state.name())).unwrap_or_default();
        let after = after.map(|after| format!("&after={}", after.as_str())).unwrap_or_default();
        format!("/v1/jobs?limit={}{state}{after}", self.limit)
    }
}

problem_responses!(Problems: [PARAMETERS] MemoryFull StoreFailed TooManyDeliveries ShareExceeded);

/// List jobs
///
/// Returns the asynchronous jobs of the caller: with keys those of the key's group, without keys those of the client's
/// address, or 403 (`client-unknown`) if that may be of several clients. A page may have fewer jobs
/// than `limit`, even none; only the last one has no link `next`.
#[utoipa::path(get, path = "/v1/jobs", tag = "jobs", operation_id = "listJobs", params(JobListParameters),
    responses((status = 200, description = "A page of the list.", body = JobList), Problems))]
pub(super) async fn list(
    State(app): State<Shared>,
    caller: Caller,
    peer: Option<Extension<Peer>>,
    headers: HeaderMap,
    query: Pairs,
) -> Result<Response, Problem> {
    let parameters = ListParameters::parse(&query.0)?;
    let client = if app.access.has_keys() {
        None
    } else {
        check_client(&app, peer.map(|Extension(peer)| peer), &headers)?;
        Some(caller.client)
    };
    let filter = JobFilter { namespace: caller.namespace, client, status: parameters.state };
    // A slow store holds neither readers nor workers.
    let _delivery = app.delivery(caller.client)?;
    let names = app.memory(caller.client).reservation();
    names.grow(LISTED_BYTES * app.store.usage(Folder::Jobs).objects)?;
    let memory = app.memory(caller.client).reservation();
    let (mut page, mut failed) = (BytesMut::new(), None);
    let add = |view: &JobView| {
        let separator: &[u8] = if page.is_empty() { b"{\"jobs\":[" } else { b"," };
        let document = serde_json::to_vec(&jobs::document(view)).map_err(Problem::internal);
        let written = document.and_then(|document| {
            let written = memory.extend(&mut page, &[separator, &document].concat(), 0);
            written.map_err(|error: OutOfMemory| error.into())
        });
        written.map_err(|problem: Problem| failed = Some(problem)).is_ok()
    };
    let next = app.job_store.list(&filter, parameters.after.as_ref(), parameters.limit, add).await?;
    // If the page has jobs, the rest follows on the next one.
    if let Some(problem) = failed.filter(|_| next.is_none()) {
        return Err(problem);
    }
    if page.is_empty() {
        page.extend_from_slice(b"{\"jobs\":[");
    }
    let link = |rel, href| jobs::link(rel, href, "application/json");
    let own = link("self", parameters.address(parameters.after.as_ref()));
    let next = next.map(|next| link("next", parameters.address(Some(&next))));
    let links: Vec<Link> = std::iter::once(own).chain(next).collect();
    let end = serde_json::to_string(&links).map_err(Problem::internal)?;
    memory.extend(&mut page, format!("],\"links\":{end}}}").as_bytes(), 0)?;
    let described = [
        (header::CONTENT_TYPE, HeaderValue::from_static("application/json")),
        (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
    ];
    Ok((described, Body::from(memory.attach(page.freeze()))).into_response())
}

/// Fails if the address of a request without a key may be that of several clients.
fn check_client(app: &App, peer: Option<Peer>, headers: &HeaderMap) -> Result<(), Problem> {
    let refused = |why: &str| {
        let detail = format!("without keys, jobs are listed by the address of the client, and {why}");
        Problem::new(ProblemType::ClientUnknown, detail)
    };
    let Peer(peer) = peer.ok_or_else(|| Problem::internal("the connection has no address"))?;
    let values = headers.get_all(&PROXY_HEADERS[0]).iter().filter_map(|value| value.to_str().ok());
    let is_forwarded = PROXY_HEADERS.iter().any(|name| headers.contains_key(name));
    if !app.access.is_single_client(peer, values, is_forwarded) {
        return Err(refused("this request may come from any client of a proxy"));
    }
    if app.access.sites.allows_any_origin() && headers.contains_key(ORIGIN) {
        return Err(refused("a page of another origin made this request"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(query: &[(&str, &str)]) -> Result<ListParameters, ParamError> {
        let pairs: Vec<_> = query.iter().map(|(n, v)| ((*n).to_owned(), (*v).to_owned())).collect();
        ListParameters::parse(&pairs)
    }

    #[test]
    fn parameters_are_checked() {
        let all = parsed(&[("state", "running"), ("limit", "7"), ("after", "3f")]).unwrap();
        assert_eq!((all.state, all.limit), (Some(Status::Running), 7));
        assert_eq!(all.address(all.after.as_ref()), "/v1/jobs?limit=7&state=running&after=3f");
        assert_eq!(parsed(&[]).unwrap().address(None), "/v1/jobs?limit=100");
        for (query, name) in [
            (&[("state", "done")][..], "state"),
            (&[("limit", "0")], "limit"),
            (&[("limit", "1001")], "limit"),
            (&[("limit", "ten")], "limit"),
            (&[("after", "")], "after"),
            (&[("after", "../x")], "after"),
            (&[("after", "1"), ("after", "2")], "after"),
            (&[("status", "running")], "status"),
        ] {
            let error = parsed(query).unwrap_err();
            assert_eq!(error.parameter(), name, "{error}");
        }
    }
}
