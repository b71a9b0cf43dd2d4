//! The structure that a request names: uploaded bytes, a stored structure or an archive entry.

use std::sync::Arc;
use std::time::Duration;

use axum::extract::FromRequestParts;
use axum::extract::RawPathParams;
use axum::extract::rejection::RawPathParamsRejection;
use axum::http::header::{self, HeaderMap, HeaderName};
use axum::http::request::Parts;
use axum::http::{HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;

use super::conditional;
use super::guard::Caller;
use super::kinds::Kind;
use super::problem::Problem;
use super::state::Shared;
use crate::archive::{Entry, FetchError, UnavailableReason};
use crate::memory_budget::Lease;
use crate::store::{Digest, Name};
use crate::structure::{ArchiveError, EntryId};

/// Caching of everything that follows from a structure and its parameters. Archive entries are revised rarely, so a day
/// without revalidation is acceptable.
pub(super) const CACHE: HeaderValue = HeaderValue::from_static("public, max-age=86400, stale-while-revalidate=604800");

/// Structure that a request names.
pub(super) enum StructureSource {
    /// Uploaded with this request.
    Uploaded(Input),
    /// Uploaded earlier.
    Stored(Digest),
    /// Entry of the archive.
    Entry(EntryId),
}

/// Bytes of a structure file, with the memory that they are charged to. Clones share both.
#[derive(Clone)]
pub(super) struct Input {
    pub(super) bytes: Bytes,
    /// SHA-256 of `bytes`. An archive entry may have changed since its digest was first asked for.
    pub(super) digest: Digest,
    pub(super) lease: Arc<Lease>,
}

impl Input {
    /// Charges bytes to the service's memory budget.
    fn new(app: &Shared, bytes: Bytes, digest: Digest) -> Result<Self, Problem> {
        let lease = app.pool.settings().budget.lease();
        lease.grow(bytes.len() as u64)?;
        Ok(Self { bytes, digest, lease: Arc::new(lease) })
    }

    /// Uploaded bytes, which `lease` is charged with already.
    pub(super) fn uploaded(bytes: Bytes, digest: Digest, lease: Lease) -> Self {
        Self { bytes, digest, lease: Arc::new(lease) }
    }
}

impl StructureSource {
    /// Parses a PDB id.
    pub(super) fn from_pdb_id(text: &str) -> Result<Self, Problem> {
        text.parse().map(Self::Entry).map_err(|error| folder_problem(&error))
    }

    /// Parses the digest of a stored structure.
    pub(super) fn from_digest(text: &str) -> Result<Self, Problem> {
        text.parse().map(Self::Stored).map_err(|_bad| no_such_structure(text))
    }

    /// Returns the digest of the file. Fails if there is no such structure.
    pub(super) async fn digest(&self, app: &Shared, caller: &Caller) -> Result<Digest, Problem> {
        match self {
            Self::Uploaded(input) => Ok(input.digest),
            Self::Stored(digest) => match app.store.head(&Name::input(digest).within(caller.namespace)).await? {
                Some(_) => Ok(*digest),
                None => Err(no_such_structure(&digest.to_string())),
            },
            Self::Entry(id) => {
                app.archive.for_client(caller.client.0).digest(id).await.map_err(|error| archive_problem(&error))
            }
        }
    }

    /// Returns the file.
    pub(super) async fn load(&self, app: &Shared, caller: &Caller) -> Result<Input, Problem> {
        match self {
            Self::Uploaded(input) => Ok(input.clone()),
            Self::Stored(digest) => {
                let (name, absent) =
                    (Name::input(digest).within(caller.namespace), || no_such_structure(&digest.to_string()));
                let size = app.store.head(&name).await?.ok_or_else(absent)?.size;
                let lease = app.pool.settings().budget.lease();
                lease.grow(size)?;
                let bytes = app.store.get(&name).await?.ok_or_else(absent)?.bytes;
                Ok(Input { bytes, digest: *digest, lease: Arc::new(lease) })
            }
            Self::Entry(id) => {
                let fetched = app.archive.for_client(caller.client.0).fetch(id).await;
                let Entry { bytes, digest, .. } = fetched.map_err(|error| archive_problem(&error))?;
                Input::new(app, bytes, digest)
            }
        }
    }

    /// Returns a response with the document that `write` makes of the structure, or 304 if the client has it. The
    /// `ETag` is derived from the digest and from `variant`, the parameters of the document.
    pub(super) async fn document<F>(
        self,
        app: &Shared,
        caller: &Caller,
        headers: &HeaderMap,
        variant: &str,
        write: impl FnOnce(Input) -> F,
    ) -> Result<Response, Problem>
    where
        F: Future<Output = Result<Response, Problem>>,
    {
        let validators = validators(&self.digest(app, caller).await?, variant)?;
        conditional::check_match(headers, &validators[0].1)?;
        if conditional::is_unchanged(headers, &validators[0].1) {
            return Ok((StatusCode::NOT_MODIFIED, validators).into_response());
        }
        let _permit = app.delivery(caller.client)?;
        let input = self.load(app, caller).await?;
        let validators = self::validators(&input.digest, variant)?;
        Ok((validators, write(input).await?).into_response())
    }
}

/// Reads the structure from the path: `{id}` is a PDB id, `{digest}` that of a stored structure.
impl FromRequestParts<Shared> for StructureSource {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, app: &Shared) -> Result<Self, Problem> {
        let path = path_parameters(parts, app).await?;
        let mut sources = path.iter().filter_map(|(name, value)| match name {
            "id" => Some(Self::from_pdb_id(value)),
            "digest" => Some(Self::from_digest(value)),
            _ => None,
        });
        sources.next().unwrap_or_else(|| Err(Problem::internal("the path names no structure")))
    }
}

/// Returns the parameters of the path, decoded.
pub(super) async fn path_parameters(parts: &mut Parts, app: &Shared) -> Result<RawPathParams, Problem> {
    let bad = |e: RawPathParamsRejection| Problem::new(Kind::BadRequest, e.body_text());
    RawPathParams::from_request_parts(parts, app).await.map_err(bad)
}

fn validators(digest: &Digest, variant: &str) -> Result<[(HeaderName, HeaderValue); 2], Problem> {
    Ok([(header::ETAG, etag(digest, variant)?), (header::CACHE_CONTROL, CACHE)])
}

/// Returns the `ETag` of a document of a structure: the digest of its file, combined with the parameters `variant`.
pub(super) fn etag(digest: &Digest, variant: &str) -> Result<HeaderValue, Problem> {
    let digest = if variant.is_empty() { *digest } else { Digest::of(format!("{digest}&{variant}").as_bytes()) };
    HeaderValue::from_str(&format!("\"{digest}\"")).map_err(Problem::internal)
}

fn no_such_structure(digest: &str) -> Problem {
    let shown: String = digest.chars().take(80).collect();
    let detail =
        format!("there is no structure `{shown}`: unused structures are removed after some time; upload it again");
    Problem::new(Kind::NoSuchStructure, detail)
}

/// Converts an error of the archive.
fn archive_problem(error: &FetchError) -> Problem {
    let detail = error.to_string();
    match error {
        FetchError::NotFound { .. } => Problem::new(Kind::NotInArchive, detail),
        FetchError::Local(error) => folder_problem(error),
        FetchError::TooLarge { bytes, limit, .. } => {
            let problem = Problem::new(Kind::EntryTooLarge, detail).with("limit", *limit);
            bytes.iter().fold(problem, |problem, bytes| problem.with("actual", *bytes))
        }
        FetchError::Unavailable { host, reason, retry_after } => {
            let problem = Problem::new(Kind::ArchiveUnavailable, detail).with("host", host.as_str());
            let problem = match reason {
                UnavailableReason::Status(status) => problem.with("found", *status),
                _ => problem,
            };
            retry_after.iter().fold(problem, |problem, wait| problem.retry_after(*wait))
        }
        FetchError::Memory { error, .. } => (*error).into(),
        FetchError::Share { limit, .. } => {
            let wait = Duration::from_secs(1);
            Problem::new(Kind::ShareExceeded, detail).with("limit", *limit).retry_after(wait)
        }
        FetchError::Internal(_) => Problem::internal(detail),
    }
}

/// Converts an error of the local folder, whose paths clients do not get.
fn folder_problem(error: &ArchiveError) -> Problem {
    let detail = error.to_string();
    match error {
        ArchiveError::BadId { id } => Problem::new(Kind::BadParameter, detail)
            .with("parameter", "id")
            .with("value", id.as_str())
            .with("expected", "a PDB id such as 4pti or pdb_00004pti"),
        ArchiveError::TooLarge { bytes, limit, .. } => {
            Problem::new(Kind::InflatedTooLarge, detail).with("limit", *limit).with("actual", *bytes)
        }
        ArchiveError::Io(io) => Problem::internal(format!("{error}: {io}")),
    }
}
