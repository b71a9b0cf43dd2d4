//! Kinds of problems: stable names, HTTP statuses and explanations. The only table of status codes.

use axum::http::StatusCode;

/// Kind of a problem.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    BadRequest,
    BadParameter,
    KeyRequired,
    KeyInvalid,
    KeyExpired,
    ScopeMissing,
    SignatureInvalid,
    SignatureExpired,
    NotFound,
    NotInArchive,
    NoSuchStructure,
    NoSuchJob,
    NoResultYet,
    MethodNotAllowed,
    NotAcceptable,
    BodyTimeout,
    JobEnded,
    JobDismissed,
    ResultGone,
    BodyTooLarge,
    InflatedTooLarge,
    EntryTooLarge,
    UnsupportedMediaType,
    UnsupportedEncoding,
    RangeNotSatisfiable,
    UnreadableStructure,
    NoAtoms,
    EmptySelection,
    TooManyAtoms,
    GridTooLarge,
    TooManyCandidates,
    MeshTooLarge,
    PictureTooLarge,
    DeviceMemory,
    NoSurface,
    OtherRequest,
    ArchiveUnavailable,
    QuotaExceeded,
    Internal,
    JobAbandoned,
    NotReady,
    DeviceFailed,
    QueueFull,
    MemoryFull,
    StoreFull,
    StoreFailed,
    TooManyDeliveries,
    ShuttingDown,
    TooManyConnections,
    Deadline,
}

/// Row of the table of problems.
pub(super) struct Row {
    pub(super) kind: Kind,
    /// Last segment of the `type`: `/problems/{slug}`.
    pub(super) slug: &'static str,
    pub(super) status: StatusCode,
    pub(super) title: &'static str,
    /// Meaning of the problem, and what the client can do.
    pub(super) about: &'static str,
    /// Counted as a rejection: a limit was reached or a right was missing.
    pub(super) limit: bool,
}

const fn row(
    kind: Kind,
    slug: &'static str,
    status: StatusCode,
    limit: bool,
    title: &'static str,
    about: &'static str,
) -> Row {
    Row { kind, slug, status, title, about, limit }
}

use StatusCode as S;

/// Every kind, in the order of [`Kind`].
#[rustfmt::skip]
pub(super) const KINDS: &[Row] = &[
    row(Kind::BadRequest, "bad-request", S::BAD_REQUEST, false, "The request is malformed",
        "The request could not be understood as HTTP or as multipart/form-data. `detail` says what was found."),
    row(Kind::BadParameter, "bad-parameter", S::BAD_REQUEST, false, "A parameter cannot be used",
        "A parameter is unknown, given twice, malformed, out of range, or does not go with another one. `parameter` names it, `value` is what was given, `expected` says what is allowed, `nearest` is the known name that is nearest to an unknown one. /v1/capabilities lists all of them."),
    row(Kind::KeyRequired, "key-required", S::UNAUTHORIZED, true, "A key is needed",
        "This server asks for a key: `Authorization: Bearer mm_…`, or `X-Api-Key: mm_…`. Its operator gives them out. A GET may have a signed address instead."),
    row(Kind::KeyInvalid, "key-invalid", S::UNAUTHORIZED, true, "The key is not known",
        "The key that was sent is none of this server's, was withdrawn, or was cut off when it was copied."),
    row(Kind::KeyExpired, "key-expired", S::UNAUTHORIZED, true, "The key has expired",
        "The key was good until `expired`. Ask the operator for another one."),
    row(Kind::ScopeMissing, "scope-missing", S::FORBIDDEN, true, "The key is not for this",
        "The key is good, but not for what was asked: it has no scope `scope`. `mesh` is to compute, `read` to read what there is."),
    row(Kind::SignatureInvalid, "signature-invalid", S::FORBIDDEN, true, "The signature does not hold",
        "The address has a signature that is not its own. A signed address is used as it was given: path, parameters and their spelling are signed."),
    row(Kind::SignatureExpired, "signature-expired", S::FORBIDDEN, true, "The signed address has expired",
        "The address was signed until `expired`. Ask for another one where it came from."),
    row(Kind::NotFound, "not-found", S::NOT_FOUND, false, "There is nothing here",
        "No resource has this path. /v1/capabilities and / say what there is."),
    row(Kind::NotInArchive, "not-in-archive", S::NOT_FOUND, false, "The archive has no such entry",
        "The id is well formed, but neither this server's folder of structures nor the archive that it asks has a file for it. POST the file to /v1/meshes instead."),
    row(Kind::NoSuchStructure, "no-such-structure", S::NOT_FOUND, false, "There is no such structure",
        "No structure with this digest is kept. Structures are kept for some time after their last use: upload it again with POST /v1/structures."),
    row(Kind::NoSuchJob, "no-such-job", S::NOT_FOUND, false, "There is no such job",
        "No job with this id is on record. Jobs are kept for some time after their end."),
    row(Kind::NoResultYet, "no-result-yet", S::NOT_FOUND, false, "The job has no result yet",
        "The job waits or runs. `GET /v1/jobs/{id}?wait=20` waits for its end, `/v1/jobs/{id}/events` tells how far it is."),
    row(Kind::MethodNotAllowed, "method-not-allowed", S::METHOD_NOT_ALLOWED, false, "The resource has no such method",
        "The `Allow` header lists the methods that the resource has."),
    row(Kind::NotAcceptable, "not-acceptable", S::NOT_ACCEPTABLE, false, "No such representation",
        "None of the media types in `Accept` can be produced. `available` lists those that can; `?format=` names one directly."),
    row(Kind::BodyTimeout, "body-timeout", S::REQUEST_TIMEOUT, true, "The body came too slowly",
        "The request's body was not complete within `limit` milliseconds."),
    row(Kind::JobEnded, "job-ended", S::CONFLICT, false, "The job has ended",
        "A job that has ended cannot be cancelled. Its result stays for some time."),
    row(Kind::JobDismissed, "job-dismissed", S::GONE, false, "The job was cancelled",
        "The job was cancelled before its end, and has no result."),
    row(Kind::ResultGone, "result-gone", S::GONE, false, "The result is gone",
        "The job was successful, but its result was kept for some time only. Ask for the mesh again."),
    row(Kind::BodyTooLarge, "body-too-large", S::PAYLOAD_TOO_LARGE, true, "The body is too large",
        "The request's body has more than `limit` bytes, or `detail` names what of it is too large. Compress a structure with gzip or zstd, or ask the operator to raise the limit that `detail` names."),
    row(Kind::InflatedTooLarge, "inflated-too-large", S::PAYLOAD_TOO_LARGE, true, "The structure inflates to too much",
        "After decompression the structure has more than `limit` bytes."),
    row(Kind::EntryTooLarge, "entry-too-large", S::PAYLOAD_TOO_LARGE, true, "The entry is too large",
        "As the archive sends it, the entry has more than `limit` bytes. Ask the operator to raise archive.max_bytes."),
    row(Kind::UnsupportedMediaType, "unsupported-media-type", S::UNSUPPORTED_MEDIA_TYPE, false, "The content is not what its type says",
        "`Content-Type` is only a hint, as the bytes are looked at; but here the two contradict each other. `declared` is what the header said, `found` what the bytes are."),
    row(Kind::UnsupportedEncoding, "unsupported-encoding", S::UNSUPPORTED_MEDIA_TYPE, false, "The content encoding cannot be used",
        "`Content-Encoding` may be gzip, zstd or identity, and the bytes must be what it says."),
    row(Kind::RangeNotSatisfiable, "range-not-satisfiable", S::RANGE_NOT_SATISFIABLE, false, "The range lies outside the file",
        "`Range` asks for bytes behind the end of the file, which has `actual` bytes."),
    row(Kind::UnreadableStructure, "unreadable-structure", S::UNPROCESSABLE_ENTITY, false, "The structure cannot be read",
        "The bytes are no PDB, mmCIF or BinaryCIF file, or a broken one. `line` and `column` give the place in a text and `place` that in a binary file, where there is one, `found` and `expected` what stood there and what should have; `diagnostics` is what a second, strict reader says of the file."),
    row(Kind::NoAtoms, "no-atoms", S::UNPROCESSABLE_ENTITY, false, "The structure has no atoms",
        "The file was read, but holds no atoms with coordinates. `found` says what it holds instead."),
    row(Kind::EmptySelection, "empty-selection", S::UNPROCESSABLE_ENTITY, false, "The selection holds no atoms",
        "The file holds atoms, but none that was asked for. `found` says what the file holds and how to select it, or `parameter` and `value` name what it lacks and `expected` what it has."),
    row(Kind::TooManyAtoms, "too-many-atoms", S::UNPROCESSABLE_ENTITY, true, "The structure has too many atoms",
        "The file holds more than `limit` atoms."),
    row(Kind::GridTooLarge, "grid-too-large", S::UNPROCESSABLE_ENTITY, true, "The grid would be too large",
        "At this resolution the surface needs more than `limit` grid samples. `suggested_resolution` is a spacing in ångström that would fit."),
    row(Kind::TooManyCandidates, "too-many-candidates", S::UNPROCESSABLE_ENTITY, true, "The atoms overlap too much",
        "At this resolution and with these radii, the atoms would reach grid bricks (8 × 8 × 8 samples) more than `limit` times in total. `suggested_resolution` is a spacing in ångström that would fit, if there is one; smaller radii also help."),
    row(Kind::MeshTooLarge, "mesh-too-large", S::UNPROCESSABLE_ENTITY, true, "The mesh would be too large",
        "The mesh, or its file, would have more than `limit` bytes; `suggested_resolution` is a spacing in ångström that would fit. Or no mesh has as few triangles as `parameter` (`max_triangles`) asks for: `actual` is the fewest, at `resolution`."),
    row(Kind::PictureTooLarge, "picture-too-large", S::UNPROCESSABLE_ENTITY, true, "The picture would be too large",
        "The side that `parameter` names (`width` or `height`) would have `actual` pixels, and `limit` are allowed. Ask for a smaller picture, or ask the operator to raise limits.picture_side."),
    row(Kind::DeviceMemory, "device-memory", S::UNPROCESSABLE_ENTITY, true, "The device has too little memory",
        "At this resolution the surface needs more memory than the device has (`limit` bytes), even piece by piece. `suggested_resolution` is a spacing in ångström that would fit."),
    row(Kind::NoSurface, "no-surface", S::UNPROCESSABLE_ENTITY, false, "There is no surface",
        "The density reaches `isovalue` nowhere on the grid. Take a lower isovalue or a finer resolution."),
    row(Kind::OtherRequest, "other-request", S::UNPROCESSABLE_ENTITY, false, "The idempotency key is another request's",
        "`Idempotency-Key` was used before with another structure, other parameters or another format."),
    row(Kind::ArchiveUnavailable, "archive-unavailable", S::FAILED_DEPENDENCY, false, "The archive cannot be reached",
        "This server has no copy of the entry, and the archive at `host` could not be asked for it: `detail` says why, `found` is the status that it answered with, if it did. Try again after `Retry-After` seconds, or POST the file to /v1/meshes."),
    row(Kind::QuotaExceeded, "quota-exceeded", S::TOO_MANY_REQUESTS, true, "The quota is used up",
        "`violated-policies` names the quota that this client has used up: `requests` in a window, `work` (seconds of computing in a window), or `concurrency` (requests at once). `RateLimit-Policy` and `RateLimit` say what there is and what is left. Try again after `Retry-After` seconds; what is refused does not count."),
    row(Kind::Internal, "internal", S::INTERNAL_SERVER_ERROR, false, "Internal error",
        "Something failed that should not have. The log has the details under the request id that `instance` gives."),
    row(Kind::JobAbandoned, "job-abandoned", S::INTERNAL_SERVER_ERROR, false, "The job was given up",
        "The job was begun several times, and each time the service ended before the job did; or what it needs is not there any more. The log says more."),
    row(Kind::NotReady, "not-ready", S::SERVICE_UNAVAILABLE, false, "Not ready",
        "The service has not yet computed its first mesh, could not, or is shutting down."),
    row(Kind::DeviceFailed, "device-failed", S::SERVICE_UNAVAILABLE, false, "No device could run the job",
        "Every device that could have run the job failed, and nothing stands in for them. It is not the job's fault. Try again after `Retry-After` seconds; the log says what happened."),
    row(Kind::QueueFull, "queue-full", S::SERVICE_UNAVAILABLE, true, "Too many jobs are waiting",
        "All workers are busy and `limit` jobs are waiting, or the job would miss its deadline in the queue. `Retry-After` is an estimate in seconds."),
    row(Kind::MemoryFull, "memory-full", S::SERVICE_UNAVAILABLE, true, "Too much is held in memory",
        "Uploads and meshes that clients have not taken yet use the memory that is set aside for them (`limit` bytes). Try again after `Retry-After` seconds."),
    row(Kind::StoreFull, "store-full", S::SERVICE_UNAVAILABLE, true, "The store is full",
        "What the service keeps takes the space that is set aside for it (`limit` bytes), and nothing of it may be removed now. Try again after `Retry-After` seconds."),
    row(Kind::StoreFailed, "store-failed", S::SERVICE_UNAVAILABLE, false, "The store does not answer",
        "What must be kept cannot be kept, or what is kept cannot be read. The log says more. Try again after `Retry-After` seconds."),
    row(Kind::TooManyDeliveries, "too-many-deliveries", S::SERVICE_UNAVAILABLE, true, "Too many meshes are being delivered",
        "`limit` requests for meshes are being processed, most of them for clients that read slowly. Try again after `Retry-After` seconds."),
    row(Kind::ShuttingDown, "shutting-down", S::SERVICE_UNAVAILABLE, false, "The service is shutting down",
        "The job was not done before the service stopped. Try again: another instance, or this one after its restart, will do it."),
    row(Kind::TooManyConnections, "too-many-connections", S::SERVICE_UNAVAILABLE, true, "Too many connections",
        "The server holds as many connections as it may. Try again after `Retry-After` seconds."),
    row(Kind::Deadline, "deadline", S::GATEWAY_TIMEOUT, true, "The deadline passed",
        "The mesh was not finished within `limit` milliseconds, time in the queue included. Send `Prefer: respond-async` to get a job, which has more time, or use a coarser resolution: the work grows with the cube of its inverse."),
];

impl Kind {
    /// Returns the row of the kind.
    pub(super) fn row(self) -> &'static Row {
        match KINDS.iter().find(|row| row.kind == self) {
            Some(row) => row,
            None => unreachable!("every kind has a row, which a test checks"),
        }
    }

    /// Returns the kind of a library's error response by its status.
    pub(super) fn of_status(status: StatusCode) -> Self {
        match status {
            S::NOT_FOUND => Self::NotFound,
            S::METHOD_NOT_ALLOWED => Self::MethodNotAllowed,
            S::NOT_ACCEPTABLE => Self::NotAcceptable,
            S::REQUEST_TIMEOUT => Self::BodyTimeout,
            S::PAYLOAD_TOO_LARGE => Self::BodyTooLarge,
            S::UNSUPPORTED_MEDIA_TYPE => Self::UnsupportedMediaType,
            S::RANGE_NOT_SATISFIABLE => Self::RangeNotSatisfiable,
            S::SERVICE_UNAVAILABLE => Self::NotReady,
            S::GATEWAY_TIMEOUT => Self::Deadline,
            other if other.is_client_error() => Self::BadRequest,
            _ => Self::Internal,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_has_one_row_in_order() {
        for (n, row) in KINDS.iter().enumerate() {
            assert_eq!(row.kind as usize, n, "{}", row.slug);
            assert_eq!(row.kind.row().slug, row.slug);
            assert!(KINDS.iter().filter(|other| other.slug == row.slug).count() == 1, "{}", row.slug);
        }
        assert_eq!(KINDS.len(), Kind::Deadline as usize + 1);
    }
}
