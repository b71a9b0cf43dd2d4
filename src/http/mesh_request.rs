//! Responses to requests for meshes: from the store, from a job that the request waits for, or with a job (202).
//!
//! A request gets a 202 only if it has `Prefer: respond-async` or `Prefer: wait=`. Any other request is answered within
//! `jobs.deadline_ms` or refused; its work is cancelled then, unless another request shares it.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::extract::FromRequestParts;
use axum::http::header::{self, HeaderMap};
use axum::http::request::Parts;
use axum::http::{HeaderValue, Method, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use tracing::Instrument as _;

use super::guard::Caller;
use super::parsed_request::{Pairs, ParsedRequest};
use super::preferences::{PREFERENCE_APPLIED, RequestPreferences};
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::source::{self, Loaded, StructureSource};
use super::state::Shared;
use super::timing::Timing;
use super::{conditional, delivery, jobs, results};
use crate::jobs::{ContentKey, Failure, Input, JobSpec, Lane, Refusal, Task, Ticket};
use crate::store::Digest;
use crate::telemetry::{SpanParent, TraceSpan};

/// Request for a mesh or its report.
pub(super) struct MeshRequest {
    app: Shared,
    caller: Caller,
    method: Method,
    /// Conditions and the range of a GET request; empty for an upload.
    headers: HeaderMap,
    parsed: ParsedRequest,
    /// True if the response is the report instead of the mesh.
    report: bool,
    preferences: RequestPreferences,
    /// `Cache-Control` of the response; `None` if it belongs to this request alone.
    cache: Option<HeaderValue>,
    timing: Timing,
}

/// Reads a GET request: the path names the structure and ends in `surface.{ext}` (`{file}`) or in `report.json`.
impl FromRequestParts<Shared> for MeshRequest {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, app: &Shared) -> Result<Self, Problem> {
        let timing = Timing::start();
        let path = source::path_parameters(parts, app).await?;
        let file = path.iter().find_map(|(name, value)| (name == "file").then_some(value));
        let query = Pairs::from_request_parts(parts, app).await?;
        let caller = Caller::of(&parts.extensions);
        let preferences = RequestPreferences::of(&parts.headers, caller.client)?;
        let structure = StructureSource::from_request_parts(parts, app).await?;
        let parsed = ParsedRequest::from_address(app, structure, file, query)?;
        let (app, method, headers) = (Arc::clone(app), parts.method.clone(), parts.headers.clone());
        let (report, cache) = (file.is_none(), Some(source::CACHE));
        Ok(Self { app, caller, method, headers, parsed, report, preferences, cache, timing })
    }
}

impl MeshRequest {
    /// Creates the request of an upload, whose reception began with `timing`.
    pub(super) fn from_upload(
        app: Shared,
        caller: Caller,
        parsed: ParsedRequest,
        report: bool,
        preferences: RequestPreferences,
        timing: Timing,
    ) -> Self {
        let (method, headers) = (Method::POST, HeaderMap::new());
        Self { app, caller, method, headers, parsed, report, preferences, cache: None, timing }
    }

    /// Answers the request.
    pub(super) async fn answer(mut self) -> Result<Response, Problem> {
        let digest = self.parsed.source.digest(&self.app, &self.caller).await?;
        self.timing.lap("receive");
        if let Some(response) = self.without_work(&digest).await? {
            return Ok(response);
        }
        self.timing.lap("lookup");
        let (source, caller) = (&self.parsed.source, &self.caller);
        // The strict validator and the record of a job need the file.
        let loaded = if self.parsed.request.strict || self.is_answered_with_job() {
            source.load(&self.app, caller).await?
        } else {
            source.find(&self.app, caller, &digest, Some(&self.parsed.request.options)).await?
        };
        self.timing.lap("load");
        self.compute(loaded).await
    }

    /// Returns a response that needs no job: a stored result, a 304, or the headers for a HEAD request.
    async fn without_work(&self, digest: &Digest) -> Result<Option<Response>, Problem> {
        let Self { app, method, headers, report, .. } = self;
        let ParsedRequest { request, declared, .. } = &self.parsed;
        // Strict checks and reports need a run, a declared format is checked by parsing, and a job has its own address.
        let is_reusable = !request.strict && !report && !declared.is_structure() && !self.preferences.respond_async;
        let namespace = self.caller.namespace;
        let key = |arithmetic: String| ContentKey::new(digest, request, &arithmetic, namespace);
        // Any backend may compute the file, and the key depends on the backend.
        let mut keys: Vec<ContentKey> = app.pool.file_arithmetics(&request.options).into_iter().map(key).collect();
        // A report has no validator.
        if !report {
            let mut rejected = Ok(());
            keys.retain(|key| match conditional::check_match(headers, &delivery::etag(key)) {
                Ok(()) => true,
                Err(problem) => {
                    rejected = Err(problem);
                    false
                }
            });
            if keys.is_empty() {
                rejected?;
            }
        }
        if is_reusable {
            if let Some(cache) = &self.cache
                && let Some(etag) =
                    keys.iter().map(delivery::etag).find(|etag| conditional::is_unchanged(headers, etag))
            {
                let caching = [(header::ETAG, etag), (header::CACHE_CONTROL, cache.clone())];
                return Ok(Some((StatusCode::NOT_MODIFIED, caching).into_response()));
            }
            for key in &keys {
                let stored = match results::stored(app, &self.caller, key, request.format, method, headers).await {
                    // The store has logged its error. The mesh is computed again.
                    Err(problem) if problem.is(ProblemType::StoreFailed) => break,
                    stored => stored?,
                };
                if let Some(mut response) = stored {
                    response.headers_mut().remove(header::CACHE_CONTROL);
                    return Ok(Some(self.with_cache_control(response)));
                }
            }
        }
        if *method != Method::HEAD || *report {
            return Ok(None);
        }
        // The summary headers would need a run, as would the `ETag` if several backends may make the file.
        let media_type = HeaderValue::from_static(request.format.media_type());
        // The length is unknown as well, and an empty body would declare 0 (RFC 9110, section 8.6).
        let unknown_length = Body::from_stream(futures_util::stream::empty::<Result<Bytes, Infallible>>());
        let mut response = ([(header::CONTENT_TYPE, media_type)], unknown_length).into_response();
        if let [key] = &keys[..] {
            response.headers_mut().insert(header::ETAG, delivery::etag(key));
        }
        Ok(Some(self.with_cache_control(response)))
    }

    fn with_cache_control(&self, mut response: Response) -> Response {
        if let Some(cache) = &self.cache {
            response.headers_mut().insert(header::CACHE_CONTROL, cache.clone());
        }
        response
    }

    /// Returns true if the response is a job. A job has no report of its own to return later, so a request for a report
    /// is never answered with a job.
    fn is_answered_with_job(&self) -> bool {
        self.preferences.respond_async && !self.report
    }

    /// Computes the mesh, or answers with a job.
    async fn compute(self, loaded: Loaded) -> Result<Response, Problem> {
        let app = Arc::clone(&self.app);
        app.admit_work(&self.caller)?;
        if self.is_answered_with_job() {
            return self.accept(loaded, None).await;
        }
        let report = self.report;
        let permit = app.delivery(self.caller.client)?;
        let wait = self.preferences.wait.filter(|_| !report);
        let jobs = &app.config.jobs;
        let deadline = Duration::from_millis(jobs.deadline_ms);
        let allowed = if wait.is_some() { Duration::from_millis(jobs.batch_deadline_ms) } else { deadline };
        let ticket = app.pool.submit(self.task(&loaded), allowed, None);
        let mut ticket = ticket.map_err(|refusal| self.refused(refusal))?;
        if ticket.is_shared
            && let Some(span) = TraceSpan::current()
        {
            span.link(ticket.span.context());
        }
        let outcome = match wait {
            None => ticket.wait().await,
            Some(wait) => match tokio::time::timeout(wait.min(deadline), ticket.wait()).await {
                Ok(outcome) => outcome,
                Err(_elapsed) => {
                    drop(permit);
                    return self.accept(loaded, Some(ticket)).await;
                }
            },
        };
        let (digest, joined, namespace) = (loaded.digest, ticket.is_shared, self.caller.namespace);
        // Dropping the last ticket of unfinished work cancels it.
        drop((ticket, loaded));
        let finished = outcome.map_err(|failure| self.failed(failure))?;
        let Self { parsed: ParsedRequest { source, request, declared, .. }, headers, cache, mut timing, .. } = self;
        let format = request.format;
        drop(source);
        if joined {
            // The stages belong to another request as well, and some ended before this one began.
            timing.lap("joined");
        } else {
            timing.job(&finished.product.report);
        }
        declared.check_format(finished.product.report.source_format)?;
        if report {
            return delivery::report(&finished, timing);
        }
        // Another backend may have computed the mesh, with other bytes.
        let key = ContentKey::new(&digest, &request, &finished.product.report.file_arithmetic(), namespace);
        let is_stored = results::save_later(&app, &finished, format, &key);
        // The current file, one of several possible ones, is known only now.
        conditional::check_match(&headers, &delivery::etag(&key))?;
        let mut response = delivery::mesh(&app, Arc::clone(&finished), format, &key, timing, permit).await?;
        let answered = response.headers_mut();
        if is_stored && results::will_be_stored(&app, &key, format, answered).await {
            answered.insert(header::CONTENT_LOCATION, delivery::text(&results::path(&key, format.name())));
        }
        if let Some(cache) = cache {
            answered.insert(header::CACHE_CONTROL, cache);
        }
        Ok(response)
    }

    fn task(&self, loaded: &Loaded) -> Task {
        Task {
            input: loaded.input.clone(),
            digest: loaded.digest,
            namespace: self.caller.namespace,
            request: self.parsed.request.clone(),
            rank: self.preferences.rank,
            reservation: Some(Arc::clone(&loaded.reservation)),
            parent: SpanParent::current(),
            id: None,
        }
    }

    /// Accepts a durable job and answers with its address. `ticket` belongs to work that is queued or running already.
    async fn accept(self, mut loaded: Loaded, mut ticket: Option<Ticket>) -> Result<Response, Problem> {
        let digest = loaded.digest;
        let spec = self.job_spec(&mut loaded).await?;
        // The archive may have another file of the entry now.
        ticket = ticket.filter(|_| loaded.digest == digest);
        let Self { app, parsed, preferences, .. } = self;
        let job_store = app.job_store.clone();
        // A client that disconnects now does not interrupt the acceptance.
        let accepted = tokio::spawn(async move { job_store.accept(spec, ticket).await }.in_current_span());
        let view = accepted.await.map_err(Problem::internal)??;
        let expected = app.pool.expected(&loaded.input, &parsed.request.options);
        let mut response = jobs::accepted(&view, app.pool.estimated_wait(Lane::Batch).saturating_add(expected));
        if preferences.respond_async {
            response.headers_mut().insert(PREFERENCE_APPLIED, HeaderValue::from_static("respond-async"));
        }
        Ok(response)
    }

    /// Returns the durable job of the request. Loads the file of the structure if it is not in memory.
    async fn job_spec(&self, loaded: &mut Loaded) -> Result<JobSpec, Problem> {
        if loaded.input.file().is_none() {
            *loaded = self.parsed.source.load(&self.app, &self.caller).await?;
        }
        let Input::File(file) = loaded.input.clone() else { return Err(Problem::internal("a file was not loaded")) };
        let ParsedRequest { pairs, map, .. } = &self.parsed;
        Ok(JobSpec {
            task: self.task(loaded),
            file,
            map: map.clone(),
            parameters: pairs.clone(),
            idempotency_key: self.preferences.idempotency_key.clone(),
            batch: None,
        })
    }

    fn refused(&self, refusal: Refusal) -> Problem {
        let is_late = matches!(refusal, Refusal::TooLate { .. });
        let problem = Problem::from(refusal);
        if is_late { self.advise(problem) } else { problem }
    }

    fn failed(&self, failure: Failure) -> Problem {
        let problem = self.parsed.declared.explain(failure);
        if problem.is(ProblemType::Deadline) { self.advise(problem) } else { problem }
    }

    /// Recommends a job to a client whose request cannot be answered in time.
    fn advise(&self, problem: Problem) -> Problem {
        if self.report { problem } else { problem.advise("send `Prefer: respond-async` to get a job") }
    }
}
