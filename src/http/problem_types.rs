//! Problem types: names, statuses and explanations. The only table of status codes.

use axum::http::StatusCode;
use serde::{Serialize, Serializer};
use utoipa::ToSchema;

/// Explanation of a problem type.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ProblemDescription)]
pub(super) struct ProblemEntry {
    /// `type` of the problems, and the path of this document.
    pub(super) r#type: &'static str,
    /// HTTP status of the problems.
    #[serde(serialize_with = "serialize_status")]
    #[schema(value_type = u16, minimum = 400, maximum = 599)]
    pub(super) status: StatusCode,
    /// Short summary.
    pub(super) title: &'static str,
    /// Meaning and remedy.
    about: &'static str,
    #[serde(skip)]
    pub(super) problem_type: ProblemType,
    /// Last segment of the `type`.
    #[serde(skip)]
    pub(super) slug: &'static str,
    /// True if the metric of rejections counts it: a limit was reached, or a permission was missing.
    #[serde(skip)]
    pub(super) is_rejection: bool,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature that serde requires")]
fn serialize_status<S: Serializer>(status: &StatusCode, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_u16(status.as_u16())
}

impl ProblemEntry {
    /// Returns the row with this slug.
    pub(super) fn find(slug: &str) -> Option<&'static Self> {
        PROBLEM_TYPES.iter().find(|row| row.slug == slug)
    }
}

/// Declares [`ProblemType`] and [`PROBLEM_TYPES`].
macro_rules! problem_types {
    ($($name:ident = $slug:literal, $status:ident, $is_rejection:literal, $title:literal, $about:literal;)+) => {
        /// Problem type.
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub(super) enum ProblemType {
            $($name),+
        }

        /// All problem types, in the order of [`ProblemType`].
        pub(super) static PROBLEM_TYPES: &[ProblemEntry] = &[$(
            ProblemEntry {
                r#type: concat!("/problems/", $slug),
                status: StatusCode::$status,
                title: $title,
                about: $about,
                problem_type: ProblemType::$name,
                slug: $slug,
                is_rejection: $is_rejection,
            }
        ),+];
    };
}

problem_types! {
    BadRequest = "bad-request", BAD_REQUEST, false, "The request is malformed",
        "The request is not valid HTTP, JSON or multipart/form-data. `detail` gives the reason.";
    BadParameter = "bad-parameter", BAD_REQUEST, false, "A parameter cannot be used",
        "A parameter is unknown, repeated, malformed, out of range, or in conflict with another one. `parameter` names it, `value` is the value sent, `expected` describes the allowed values, and `nearest` is the known name closest to an unknown one. In a selection, `column` is the position of the error in characters and `found` the content there. /v1/capabilities lists all parameters.";
    KeyRequired = "key-required", UNAUTHORIZED, true, "An API key is required",
        "This server requires an API key: `Authorization: Bearer mm_…` or `X-Api-Key: mm_…`. Ask the operator for one. A GET request may use a signed URL instead.";
    KeyInvalid = "key-invalid", UNAUTHORIZED, true, "The API key is invalid",
        "The server does not know the key: it may be mistyped, truncated or revoked.";
    KeyExpired = "key-expired", UNAUTHORIZED, true, "The API key has expired",
        "The key was valid until `expired`. Ask the operator for a new one.";
    ScopeMissing = "scope-missing", FORBIDDEN, true, "The API key lacks a scope",
        "The key is valid but lacks the scope `scope`. `mesh` allows computing, `read` allows reading results.";
    SignatureInvalid = "signature-invalid", FORBIDDEN, true, "The signature is invalid",
        "The signature does not match the URL. Use a signed URL unchanged: the signature covers the path, the parameters and their spelling.";
    SignatureExpired = "signature-expired", FORBIDDEN, true, "The signed URL has expired",
        "The URL was valid until `expired`. Request a new one from its source.";
    CrossSite = "cross-site", FORBIDDEN, true, "Pages of this origin are not allowed",
        "A web page of another origin made the request. Send an API key, or ask the operator to add the origin to access.cors_origins. If the page belongs to this service, its proxy must pass on the `Host` header.";
    ClientUnknown = "client-unknown", FORBIDDEN, true, "The client cannot be identified",
        "The service has no keys and lists jobs by the address of the client, but this address may be that of several clients: a proxy that the service does not know has passed the request on, or a page of another site made it. Ask the operator to configure keys or server.trusted_proxies. A repeated request with the `Idempotency-Key` of a job returns that job.";
    NotFound = "not-found", NOT_FOUND, false, "Not found",
        "No resource has this path. /openapi.yaml lists the operations of the service.";
    NotInArchive = "not-in-archive", NOT_FOUND, false, "The archive has no such entry",
        "The id is well formed, but neither the local folder nor the remote archive has a file for it. Send the file to POST /v1/meshes instead.";
    NoSuchStructure = "no-such-structure", NOT_FOUND, false, "There is no such structure",
        "The server has no structure with this digest. Structures are removed some time after their last use. Upload it again with POST /v1/structures.";
    NoSuchJob = "no-such-job", NOT_FOUND, false, "There is no such job",
        "The server has no job or batch with this id. They are removed some time after their last use.";
    NoResultYet = "no-result-yet", NOT_FOUND, false, "The job has no result yet",
        "The job is queued or running. `GET /v1/jobs/{id}?wait=20` waits for its end; `/v1/jobs/{id}/events` reports its progress.";
    MethodNotAllowed = "method-not-allowed", METHOD_NOT_ALLOWED, false, "Method not allowed",
        "The `Allow` header lists the methods of the resource.";
    NotAcceptable = "not-acceptable", NOT_ACCEPTABLE, false, "No acceptable representation",
        "The server cannot produce any media type in `Accept`, or any content coding in `Accept-Encoding`. `available` lists those that it can produce; the parameter `format` selects a media type directly.";
    BodyTimeout = "body-timeout", REQUEST_TIMEOUT, true, "The request body was too slow",
        "The request body was not complete within `limit` ms.";
    JobEnded = "job-ended", CONFLICT, false, "The job has ended",
        "A job that has ended cannot be cancelled. Its result stays available for some time.";
    JobDismissed = "job-dismissed", GONE, false, "The job was cancelled",
        "The job was cancelled and has no result.";
    ResultGone = "result-gone", GONE, false, "The result has been removed",
        "The job succeeded, but its result was removed to free space or because it expired. Request the mesh again.";
    PreconditionFailed = "precondition-failed", PRECONDITION_FAILED, false, "The file has another `ETag`",
        "No `ETag` in `If-Match` is that of the current file. Request the file again without `If-Match`.";
    BodyTooLarge = "body-too-large", PAYLOAD_TOO_LARGE, true, "The request body is too large",
        "The request body exceeds `limit` bytes, or `detail` names the part of it that is too large. Compress the structure with gzip or zstd, or ask the operator to raise the limit that `detail` names.";
    InflatedTooLarge = "inflated-too-large", PAYLOAD_TOO_LARGE, true, "The decompressed file is too large",
        "The structure, the map or the archive of a batch exceeds `limit` bytes after decompression.";
    EntryTooLarge = "entry-too-large", PAYLOAD_TOO_LARGE, true, "The archive entry is too large",
        "The entry exceeds `limit` bytes as sent by the archive. Ask the operator to put the entry into the folder of archive.dir.";
    UnsupportedMediaType = "unsupported-media-type", UNSUPPORTED_MEDIA_TYPE, false, "The media type does not fit",
        "`Content-Type` is optional, because the server detects the format from the content. Here the two disagree (`declared` is the header, `found` the detected content), or the body of `POST /v1/structures` is JSON. Only `POST /v1/meshes`, `/v1/report`, `/v1/estimate`, `/v1/areas` and `/v1/batches` take JSON, which names structures on the server.";
    UnsupportedEncoding = "unsupported-encoding", UNSUPPORTED_MEDIA_TYPE, false, "Unsupported content encoding",
        "`Content-Encoding` must be gzip, zstd or identity, and match the content.";
    RangeNotSatisfiable = "range-not-satisfiable", RANGE_NOT_SATISFIABLE, false, "The range is not satisfiable",
        "`Range` starts after the end of the file, which has `actual` bytes.";
    WrongHost = "wrong-host", MISDIRECTED_REQUEST, true, "The service has another host name",
        "The service accepts only the names of a loopback address and those in server.hosts. The request names another host. Use `localhost`, or ask the operator to add the name to server.hosts.";
    UnreadableStructure = "unreadable-structure", UNPROCESSABLE_ENTITY, false, "The structure cannot be read",
        "The body is not a valid PDB, mmCIF, BinaryCIF, PQR or XYZ file. `line` and `column` (text) or `location` (binary) locate the error, `found` and `expected` describe it, and `diagnostics` lists the findings of the strict validator.";
    UnreadableMap = "unreadable-map", UNPROCESSABLE_ENTITY, false, "The map cannot be read",
        "The part `map` of the form is not a valid CCP4, MRC or OpenDX map. `location` locates the error, `found` and `expected` describe it; `encoding` is set if the compressed data is broken.";
    NoAtoms = "no-atoms", UNPROCESSABLE_ENTITY, false, "The structure has no atoms",
        "The file has no atoms with coordinates. `found` describes its content.";
    EmptySelection = "empty-selection", UNPROCESSABLE_ENTITY, false, "The selection is empty",
        "No atom of the file matches the selection. `found` describes the content of the file and how to select it, or `parameter` and `value` name the missing item and `expected` the available ones.";
    TooManyAtoms = "too-many-atoms", UNPROCESSABLE_ENTITY, true, "The structure has too many atoms",
        "The file, or the assembly (`actual` atoms), has more than `limit` atoms.";
    GridTooLarge = "grid-too-large", UNPROCESSABLE_ENTITY, true, "The grid would be too large",
        "At this resolution the surface needs more than `limit` grid points. `suggested_resolution` is a grid spacing in Å that should fit, if there is one.";
    TooManyCandidates = "too-many-candidates", UNPROCESSABLE_ENTITY, true, "Too many pairs of atoms and grid bricks",
        "At this resolution and with these radii, the pairs of atoms and grid bricks (8 × 8 × 8 points) exceed `limit`. For a solvent-excluded surface, the same limit applies to pairs of atoms that overlap when enlarged by the probe; 64 comparisons of overlaps count as a pair. `within` may test 64 distances for each pair that the operator allows. `suggested_resolution` is a grid spacing in Å that should fit, if there is one; smaller radii or a smaller probe also help.";
    TooManyDuplicates = "too-many-duplicates", UNPROCESSABLE_ENTITY, true, "Too many atoms have the same position",
        "More than `limit` atoms of one model have exactly the coordinates `position` (Å). Remove the placeholder atoms or split the models.";
    TooManyCopies = "too-many-copies", UNPROCESSABLE_ENTITY, true, "The assembly has too many copies",
        "The assembly has more than `limit` copies of chains. Mesh another assembly or the asymmetric unit.";
    TooManyParts = "too-many-parts", UNPROCESSABLE_ENTITY, true, "The mesh would have too many parts",
        "`parameter` (`split` or `model`) divides the selected atoms into more than `limit` parts. Select fewer chains or another `split`, or one model.";
    MapTooLarge = "map-too-large", UNPROCESSABLE_ENTITY, true, "The map has too many points",
        "The grid of the map has `actual` points, more than `limit`. Cut out the region of the structure, or use a coarser grid.";
    MeshTooLarge = "mesh-too-large", UNPROCESSABLE_ENTITY, true, "The mesh would be too large",
        "The mesh or its file exceeds `limit` bytes; `suggested_resolution` is a grid spacing in Å that should fit, if there is one. Or no mesh has as few triangles as `max_triangles` requires: `actual` is the smallest number, at `resolution`.";
    PictureTooLarge = "picture-too-large", UNPROCESSABLE_ENTITY, true, "The picture would be too large",
        "`parameter` (`width` or `height`) is `actual` pixels and the limit is `limit`. Request a smaller picture.";
    DeviceMemory = "device-memory", UNPROCESSABLE_ENTITY, true, "The device has too little memory",
        "At this resolution the surface needs more memory than the device has (`limit` bytes), even in parts. `suggested_resolution` is a grid spacing in Å that should fit, if there is one.";
    TooMuchMemory = "too-much-memory", UNPROCESSABLE_ENTITY, true, "The request needs too much memory",
        "The request alone needs at least `actual` bytes of memory at once, more than the `limit` bytes that the service may use. Use a coarser resolution, a smaller picture or fewer atoms, or ask the operator to raise limits.memory_bytes. An uploaded body may use half of that memory, the index of a tileset limits.structure_cache_bytes, or limits.scratch_bytes on disk.";
    NoSurface = "no-surface", UNPROCESSABLE_ENTITY, false, "There is no surface",
        "The density does not reach `isovalue` at any grid point, or no grid point lies inside the spheres. Use a lower isovalue or a finer resolution. Or no triangle is nearest to a selected atom (`context=whole`), or no component of the mesh encloses a cavity (`cavities=only`).";
    OtherRequest = "other-request", UNPROCESSABLE_ENTITY, false, "The idempotency key belongs to another request",
        "The `Idempotency-Key` was used before with another structure, another map, other parameters or another format.";
    ArchiveUnavailable = "archive-unavailable", FAILED_DEPENDENCY, false, "The archive is unavailable",
        "The server has no copy of the entry, and the request to the archive at `host` failed: `detail` gives the reason and `found` the status of the archive's response, if there was one. Retry after `Retry-After` seconds, or send the file to POST /v1/meshes.";
    QuotaExceeded = "quota-exceeded", TOO_MANY_REQUESTS, true, "The quota is exceeded",
        "`violated-policies` names the exhausted quotas: `requests` in a window, `work` (seconds of computing in a window) or `concurrency` (simultaneous requests). `RateLimit-Policy` and `RateLimit` give the quotas and what remains. Retry after `Retry-After` seconds; rejected requests are not counted.";
    Internal = "internal", INTERNAL_SERVER_ERROR, false, "Internal server error",
        "An unexpected error occurred. The server log has the details under the request id in `instance`.";
    JobAbandoned = "job-abandoned", INTERNAL_SERVER_ERROR, false, "The job was abandoned",
        "The process ended during each attempt of the job (`actual` attempts), or the input of the job is missing. The server log has the details.";
    RecordUnreadable = "record-unreadable", INTERNAL_SERVER_ERROR, false, "The record of the job cannot be read",
        "The stored record of the job is damaged. The service keeps it in quarantine for its operator. Send the request again, with another idempotency key if it has one.";
    OtherRelease = "other-release", SERVICE_UNAVAILABLE, false, "Another release wrote the record of the job",
        "The service has nodes of several releases, or was set back to an earlier one. The node that answers cannot read the record of the job, which stays as it is: nodes of the other release run the job and know its state. Retry after `Retry-After` seconds.";
    NotReady = "not-ready", SERVICE_UNAVAILABLE, false, "The service is not ready",
        "The service has not yet computed its first mesh or read the records of its jobs, failed to compute the mesh, or is shutting down.";
    DeviceFailed = "device-failed", SERVICE_UNAVAILABLE, false, "No device could run the job",
        "All devices that could run the job failed, and there is no fallback. The job is not the cause. Retry after `Retry-After` seconds; the server log has the details.";
    QueueFull = "queue-full", SERVICE_UNAVAILABLE, true, "Too many jobs are waiting",
        "All workers are busy and `limit` jobs are waiting, or the request would probably miss its deadline, `limit` ms. `Retry-After` is an estimate in seconds.";
    TooManyJobs = "too-many-jobs", SERVICE_UNAVAILABLE, true, "Too many asynchronous jobs are open",
        "The server keeps records of at most `limit` asynchronous jobs, in total or for one client, and none of these jobs has ended. Wait for the end of a job, or cancel one. Retry after `Retry-After` seconds.";
    MemoryFull = "memory-full", SERVICE_UNAVAILABLE, true, "The memory limit is reached",
        "Requests and jobs use all memory reserved for them, or indexes of tilesets and archives of batches all disk space: `limit` bytes, of which `actual` are in use. Retry after `Retry-After` seconds.";
    StoreFull = "store-full", SERVICE_UNAVAILABLE, true, "The store is full",
        "The store uses all space reserved for it (`limit` bytes), and no object may be removed now; without `limit`, its disk is full. Retry after `Retry-After` seconds.";
    StoreFailed = "store-failed", SERVICE_UNAVAILABLE, false, "The store is unavailable",
        "The store cannot be written or read. The server log has the details. Retry after `Retry-After` seconds.";
    BrokerFailed = "broker-failed", SERVICE_UNAVAILABLE, false, "Jobs cannot be dispatched",
        "The queue that the nodes of the service share does not answer, so no asynchronous job can be accepted. Other requests are answered. Retry after `Retry-After` seconds.";
    TooManyDeliveries = "too-many-deliveries", SERVICE_UNAVAILABLE, true, "Too many meshes are being sent",
        "`limit` mesh requests are in progress, most of them waiting for slow clients. Retry after `Retry-After` seconds.";
    ShareExceeded = "share-exceeded", SERVICE_UNAVAILABLE, true, "The client holds its share",
        "Connections, meshes in progress, fetches from the archive and memory are limited, and this client (its key, or its address) holds its share: `limit` of them, or `limit` bytes. Wait for the end of its other requests, then retry.";
    ShuttingDown = "shutting-down", SERVICE_UNAVAILABLE, false, "The service is shutting down",
        "The service stopped before the job was done. Retry: another instance, or this one after its restart, will run it.";
    TooManyConnections = "too-many-connections", SERVICE_UNAVAILABLE, true, "Too many connections",
        "The server has reached its limit of connections. Retry after `Retry-After` seconds.";
    Deadline = "deadline", GATEWAY_TIMEOUT, true, "The deadline has passed",
        "The mesh was not done within `limit` ms, including the time in the queue. Send `Prefer: respond-async` to get a job, which has more time, or use a coarser resolution: the work grows with the cube of its inverse.";
}

impl ProblemType {
    /// Returns the row of the problem type.
    pub(super) fn row(self) -> &'static ProblemEntry {
        &PROBLEM_TYPES[self as usize]
    }

    /// Returns the problem type for the status of an error response that a library made.
    pub(super) fn from_status(status: StatusCode) -> Self {
        match status {
            StatusCode::NOT_FOUND => Self::NotFound,
            StatusCode::METHOD_NOT_ALLOWED => Self::MethodNotAllowed,
            StatusCode::NOT_ACCEPTABLE => Self::NotAcceptable,
            StatusCode::REQUEST_TIMEOUT => Self::BodyTimeout,
            StatusCode::PAYLOAD_TOO_LARGE => Self::BodyTooLarge,
            StatusCode::UNSUPPORTED_MEDIA_TYPE => Self::UnsupportedMediaType,
            StatusCode::RANGE_NOT_SATISFIABLE => Self::RangeNotSatisfiable,
            StatusCode::SERVICE_UNAVAILABLE => Self::NotReady,
            StatusCode::GATEWAY_TIMEOUT => Self::Deadline,
            other if other.is_client_error() => Self::BadRequest,
            _ => Self::Internal,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slugs_are_unique() {
        for row in PROBLEM_TYPES {
            assert_eq!(ProblemEntry::find(row.slug).map(|found| found.problem_type), Some(row.problem_type), "{row:?}");
        }
    }
}
