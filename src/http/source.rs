//! The structure that a request names: uploaded bytes, a stored structure or an archive entry.

use std::env::consts::{ARCH, OS};
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
use super::problem::Problem;
use super::problem_types::ProblemType;
use super::state::{Delivery, Shared};
use crate::archive::{Entry, FetchError, UnavailableReason};
use crate::jobs::{Input, MemoryReservation};
use crate::pipeline::{Options, algorithm_versions};
use crate::store::{Digest, Name};
use crate::structure::{ArchiveError, EntryId, ReadLimits, Structure, StructureError};
use crate::surface::{Control, Limit};

/// Caching of everything that follows from a structure and its parameters. Archive entries are revised rarely, so a day
/// without revalidation is acceptable.
pub(super) const CACHE: HeaderValue = HeaderValue::from_static("public, max-age=86400, stale-while-revalidate=604800");

/// Structure that a request names.
pub(super) enum StructureSource {
    /// Uploaded with this request.
    Uploaded(Loaded),
    /// Uploaded earlier.
    Stored(Digest),
    /// Entry of the archive.
    Entry(EntryId),
}

/// Structure with the memory that its file is charged to. Clones share both.
#[derive(Clone)]
pub(super) struct Loaded {
    pub(super) input: Input,
    /// SHA-256 of the file. An archive entry may have changed since its digest was first computed.
    pub(super) digest: Digest,
    pub(super) reservation: Arc<MemoryReservation>,
}

impl Loaded {
    /// Returns a file that `reservation` is charged with already.
    pub(super) fn file(bytes: Bytes, digest: Digest, reservation: MemoryReservation) -> Self {
        Self { input: Input::File(bytes), digest, reservation: Arc::new(reservation) }
    }

    /// Reads the structure and lists its atoms by `list`, on a blocking thread. `list` gets the reservation of its
    /// list, which counts towards the memory budget until the list is sent. `delivery` is released when the work has
    /// stopped.
    pub(super) async fn list_atoms<T: Send + 'static>(
        self,
        app: &Shared,
        caller: &Caller,
        delivery: Delivery,
        list: impl FnOnce(&Structure, &ReadLimits, &Control<'_>, MemoryReservation) -> Result<T, Problem> + Send + 'static,
    ) -> Result<T, Problem> {
        let mut limits = app.config.limits.job().read;
        let is_fixed = app.config.limits.labels < limits.max_atoms;
        limits.max_atoms = limits.max_atoms.min(app.config.limits.labels);
        let reservation = app.memory(caller.client).reservation();
        let (structures, namespace) = (app.structures(), caller.namespace);
        let Self { input, digest, reservation: file } = self;
        let listing = app.read(caller, (file, delivery), move |control| {
            let structure = structures.get((namespace, digest), &input, &limits, control).map_err(|mut error| {
                if let StructureError::Limit(exceeded) = &mut error {
                    exceeded.is_fixed |= is_fixed && exceeded.limit == Limit::Atoms;
                }
                error
            })?;
            list(&structure, &limits, control, reservation)
        });
        listing.await?
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
            Self::Uploaded(loaded) => Ok(loaded.digest),
            Self::Stored(digest) => match app.store.head(&Name::input(digest).within(caller.namespace)).await? {
                Some(_) => Ok(*digest),
                None => Err(no_such_structure(&digest.to_string())),
            },
            Self::Entry(id) => {
                app.archive.for_client(caller.client.0).digest(id).await.map_err(|error| archive_problem(&error))
            }
        }
    }

    /// Returns the structure in memory if there is one, for `options` with a tile also as a part of its tileset, the
    /// tileset if its atoms are on disk, or the file. `digest` is the one that [`Self::digest`] returned for this
    /// caller, which has checked that the structure exists.
    pub(super) async fn find(
        &self,
        app: &Shared,
        caller: &Caller,
        digest: &Digest,
        options: Option<&Options>,
    ) -> Result<Loaded, Problem> {
        let namespace = caller.namespace;
        match (self, app.structures().find((namespace, *digest), options)) {
            (Self::Stored(_) | Self::Entry(_), Some(input)) => {
                if let Self::Stored(_) = self {
                    app.store.touch(&Name::input(digest).within(namespace), app.store.now());
                }
                let reservation = Arc::new(app.pool.settings().budget.reservation());
                Ok(Loaded { input, digest: *digest, reservation })
            }
            _ => self.load(app, caller).await,
        }
    }

    /// Returns the file.
    pub(super) async fn load(&self, app: &Shared, caller: &Caller) -> Result<Loaded, Problem> {
        let reservation = || app.memory(caller.client).reservation();
        match self {
            Self::Uploaded(loaded) => Ok(loaded.clone()),
            Self::Stored(digest) => {
                let (name, absent) =
                    (Name::input(digest).within(caller.namespace), || no_such_structure(&digest.to_string()));
                let size = app.store.head(&name).await?.ok_or_else(absent)?.size;
                let reservation = reservation();
                reservation.grow(size)?;
                let bytes = app.store.input(digest, caller.namespace).await?.ok_or_else(absent)?;
                Ok(Loaded::file(bytes, *digest, reservation))
            }
            Self::Entry(id) => {
                let fetched = app.archive.for_client(caller.client.0).fetch(id).await;
                let Entry { bytes, digest, .. } = fetched.map_err(|error| archive_problem(&error))?;
                // The bytes hold their reservation themselves.
                Ok(Loaded::file(bytes, digest, reservation()))
            }
        }
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

/// Request for a document of a structure.
pub(super) struct DocumentRequest {
    pub(super) app: Shared,
    pub(super) caller: Caller,
    pub(super) headers: HeaderMap,
    source: StructureSource,
}

/// Reads the request; its path names the structure.
impl FromRequestParts<Shared> for DocumentRequest {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, app: &Shared) -> Result<Self, Problem> {
        let source = StructureSource::from_request_parts(parts, app).await?;
        let (caller, headers) = (Caller::of(&parts.extensions), parts.headers.clone());
        Ok(Self { app: Arc::clone(app), caller, headers, source })
    }
}

impl DocumentRequest {
    /// Creates the request for a document of the structure in a body. It has no conditions.
    pub(super) fn from_body(app: Shared, caller: Caller, source: StructureSource) -> Self {
        Self { app, caller, headers: HeaderMap::new(), source }
    }

    /// Returns a response with the document that `write` makes of the structure, or 304 if the client has it. `write`
    /// holds the delivery slot of the request until its work has stopped. `options` are those of
    /// [`StructureSource::find`]. The `ETag` is that of [`etag`] with `variant`, the parameters of the document.
    pub(super) async fn document<F>(
        &self,
        variant: &str,
        options: Option<&Options>,
        write: impl FnOnce(Loaded, Delivery) -> F,
    ) -> Result<Response, Problem>
    where
        F: Future<Output = Result<Response, Problem>>,
    {
        let Self { app, caller, headers, source } = self;
        let digest = source.digest(app, caller).await?;
        let validators = validators(&digest, variant)?;
        conditional::check_match(headers, &validators[0].1)?;
        if conditional::is_unchanged(headers, &validators[0].1) {
            return Ok((StatusCode::NOT_MODIFIED, validators).into_response());
        }
        app.admit_work(caller)?;
        let delivery = app.delivery(caller.client)?;
        let loaded = source.find(app, caller, &digest, options).await?;
        let validators = self::validators(&loaded.digest, variant)?;
        Ok((validators, write(loaded, delivery).await?).into_response())
    }
}

/// Returns the parameters of the path, decoded.
pub(super) async fn path_parameters(parts: &mut Parts, app: &Shared) -> Result<RawPathParams, Problem> {
    let bad = |e: RawPathParamsRejection| Problem::new(ProblemType::BadRequest, e.body_text());
    RawPathParams::from_request_parts(parts, app).await.map_err(bad)
}

fn validators(digest: &Digest, variant: &str) -> Result<[(HeaderName, HeaderValue); 2], Problem> {
    Ok([(header::ETAG, etag(digest, variant)?), (header::CACHE_CONTROL, CACHE)])
}

/// Returns the `ETag` of a document of a structure: a digest of its file, the parameters `variant`, the versions of the
/// algorithms and the system, because the last digits of numbers depend on mathematical libraries.
pub(super) fn etag(digest: &Digest, variant: &str) -> Result<HeaderValue, Problem> {
    let versions = algorithm_versions::document_versions();
    let digest = Digest::of(format!("molmesh {versions} {OS} {ARCH}\n{digest}&{variant}").as_bytes());
    HeaderValue::from_str(&format!("\"{digest}\"")).map_err(Problem::internal)
}

fn no_such_structure(digest: &str) -> Problem {
    let shown: String = digest.chars().take(80).collect();
    let detail =
        format!("there is no structure `{shown}`: unused structures are removed after some time; upload it again");
    Problem::new(ProblemType::NoSuchStructure, detail)
}

/// Converts an error of the archive.
fn archive_problem(error: &FetchError) -> Problem {
    let detail = error.to_string();
    match error {
        FetchError::NotFound { .. } => Problem::new(ProblemType::NotInArchive, detail),
        FetchError::Local(error) => folder_problem(error),
        FetchError::TooLarge(error) => Problem::from(&**error),
        FetchError::Unavailable { host, reason, retry_after } => {
            let problem = Problem::new(ProblemType::ArchiveUnavailable, detail).with("host", host.as_str());
            let problem = match reason {
                UnavailableReason::Status(status) => problem.with("found", *status),
                _ => problem,
            };
            retry_after.iter().fold(problem, |problem, wait| problem.retry_after(*wait))
        }
        FetchError::Memory { error, .. } => (*error).into(),
        FetchError::Busy { limit, wait, .. } => Problem::new(ProblemType::QueueFull, detail)
            .with("limit", u64::try_from(limit.as_millis()).unwrap_or(u64::MAX))
            .with("estimated_wait_s", wait.as_secs_f64())
            .retry_after(*wait),
        FetchError::Share { limit, .. } => {
            let wait = Duration::from_secs(1);
            Problem::new(ProblemType::ShareExceeded, detail).with("limit", *limit).retry_after(wait)
        }
        FetchError::Internal(_) => Problem::internal(detail),
    }
}

/// Converts an error of the local folder. Clients do not get its path.
fn folder_problem(error: &ArchiveError) -> Problem {
    let detail = error.to_string();
    match error {
        ArchiveError::BadId { id } => Problem::new(ProblemType::BadParameter, detail)
            .with("parameter", "id")
            .with("value", id.as_str())
            .with("expected", "a PDB id such as 4pti or pdb_00004pti"),
        ArchiveError::Limit(error) => Problem::from(&**error),
        ArchiveError::Io(io) => Problem::internal(format!("{error}: {io}")),
    }
}
