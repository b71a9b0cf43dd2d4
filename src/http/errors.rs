//! Conversion of the errors of other modules into problems. No other file does this for jobs, meshes and the store.

mod inputs;

use std::time::Duration;

use serde::Serialize;
use utoipa::ToSchema;

use super::problem::Problem;
use super::problem_types::ProblemType;
use crate::client_shares::ShareExceeded;
use crate::formats::FormatError;
use crate::jobs::{AcceptError, EndError, Failure, Refusal, SaveError};
use crate::picture::PictureError;
use crate::pipeline::JobError;
use crate::pipeline::params::ParamError;
use crate::store::StoreError;
use crate::structure::strict_validator::Diagnostic;
use crate::surface::params::MAX_RESOLUTION;
use crate::surface::{OutOfMemory, SurfaceError};

/// Finding of the strict validator.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Finding {
    /// Severity: `note`, `warning` or `error`.
    level: &'static str,
    /// Line of the file, from 1; null if the finding has no line.
    #[schema(required)]
    line: Option<u64>,
    /// Description of the finding.
    message: String,
}

/// Converts the findings of the strict validator.
pub(super) fn findings(diagnostics: &[Diagnostic]) -> Vec<Finding> {
    let finding = |d: &Diagnostic| Finding { level: d.level.name(), line: d.line, message: d.message.clone() };
    diagnostics.iter().map(finding).collect()
}

/// Adds the findings of the strict validator, if there are any.
fn diagnosed(problem: Problem, diagnostics: &[Diagnostic]) -> Problem {
    if diagnostics.is_empty() {
        return problem;
    }
    match serde_json::to_value(findings(diagnostics)) {
        Ok(findings) => problem.with("diagnostics", findings),
        Err(error) => Problem::internal(error),
    }
}

/// Returns the problem of a mesh file that exceeds `limit` bytes.
pub(super) fn file_too_large(bytes: u64, limit: u64, resolution: f64) -> Problem {
    oversized(&format!("the file would have {bytes} bytes and the limit is {limit}"), bytes, limit, resolution)
}

/// Returns the problem of a mesh with `actual` bytes, vertices or triangles, more than `limit`; `what` begins the
/// explanation. These numbers grow with the inverse square of the spacing.
#[expect(clippy::cast_precision_loss, reason = "an estimate: 52 bits suffice")]
fn oversized(what: &str, actual: u64, limit: u64, resolution: f64) -> Problem {
    let fits = (resolution * (actual as f64 / limit as f64).sqrt() * 105.0).ceil() / 100.0;
    if fits > MAX_RESOLUTION {
        return Problem::new(ProblemType::MeshTooLarge, what.to_owned()).with("limit", limit).with("actual", actual);
    }
    Problem::new(ProblemType::MeshTooLarge, format!("{what}; a resolution of {fits} Å should fit"))
        .with("limit", limit)
        .with("actual", actual)
        .with("suggested_resolution", fits)
}

/// Returns the problem of a mesh that cannot be written.
pub(super) fn format_problem(error: &FormatError, resolution: f64) -> Problem {
    match *error {
        FormatError::GlbTooLarge { bytes, limit } => file_too_large(bytes, limit, resolution),
        FormatError::TooMany { count, limit, .. } => oversized(&error.to_string(), count, limit, resolution),
        FormatError::AtomIndexTooLarge { limit, .. } => Problem::new(ProblemType::MeshTooLarge, error.to_string())
            .with("limit", limit)
            .with("parameter", "atom_ids"),
        _ => Problem::internal(error),
    }
}

impl From<ParamError> for Problem {
    fn from(error: ParamError) -> Self {
        let problem = Self::new(ProblemType::BadParameter, error.to_string());
        match error {
            ParamError::Unknown { name, nearest } => problem.with("parameter", name).with("nearest", nearest),
            ParamError::Repeated { name } => problem.with("parameter", name),
            ParamError::BadValue { name, value, expected } => {
                problem.with("parameter", name).with("value", value.trim_matches('`')).with("expected", expected)
            }
            ParamError::BadExpression { name, text, error } => problem
                .with("parameter", name)
                .with("value", text)
                .with("column", error.column)
                .with("found", error.found.trim_matches('`'))
                .with("expected", error.expected),
        }
    }
}

impl From<OutOfMemory> for Problem {
    fn from(error: OutOfMemory) -> Self {
        let full = || Self::new(ProblemType::MemoryFull, error.to_string()).retry_after(Duration::from_secs(1));
        match error {
            OutOfMemory::Budget { held, limit, .. } => full().with("limit", limit).with("actual", held),
            OutOfMemory::Share { limit, held, .. } => Self::new(ProblemType::ShareExceeded, error.to_string())
                .with("limit", limit)
                .with("actual", held)
                .retry_after(Duration::from_secs(1)),
            OutOfMemory::Limit { needed, limit } => {
                Self::new(ProblemType::TooMuchMemory, error.to_string()).with("limit", limit).with("actual", needed)
            }
            OutOfMemory::System { .. } => full(),
        }
    }
}

impl From<ShareExceeded> for Problem {
    fn from(ShareExceeded { limit }: ShareExceeded) -> Self {
        let detail =
            format!("this client already uses {limit} slots, its share; the other slots are for other clients");
        Self::new(ProblemType::ShareExceeded, detail).with("limit", limit).retry_after(Duration::from_secs(1))
    }
}

impl From<Refusal> for Problem {
    fn from(error: Refusal) -> Self {
        match error {
            Refusal::QueueFull { waiting, limit, wait } => Self::new(ProblemType::QueueFull, error.to_string())
                .with("limit", limit)
                .with("actual", waiting)
                .with("estimated_wait_s", wait.as_secs_f64())
                .retry_after(wait),
            Refusal::TooLate { wait, expected, allowed } => Self::new(ProblemType::QueueFull, error.to_string())
                .with("limit", u64::try_from(allowed.as_millis()).unwrap_or(u64::MAX))
                .with("estimated_wait_s", wait.as_secs_f64())
                .retry_after(wait.saturating_add(expected).saturating_sub(allowed)),
            Refusal::Draining => Self::shutting_down(error.to_string()),
        }
    }
}

impl From<Failure> for Problem {
    fn from(error: Failure) -> Self {
        match error {
            Failure::Job { error: JobError::Structure(error), diagnostics } => diagnosed(error.into(), &diagnostics),
            Failure::Job { error: JobError::Surface(error), .. } => error.into(),
            Failure::Job { error: JobError::Picture(error), .. } => error.into(),
            Failure::Job { error: JobError::Color(error), .. } => error.into(),
            Failure::Job { error: JobError::Map(error), .. } => error.into(),
            // Compression rejects no mesh for its size, so no resolution is suggested.
            Failure::Job { error: JobError::Format(error), .. } => format_problem(&error, 0.0),
            Failure::Check { ref diagnostics } => {
                let problem = Self::new(ProblemType::UnreadableStructure, error.to_string()).with("parameter", "check");
                diagnosed(problem, diagnostics)
            }
            Failure::Deadline { limit } => Self::new(ProblemType::Deadline, error.to_string())
                .with("limit", u64::try_from(limit.as_millis()).unwrap_or(u64::MAX)),
            Failure::Waited { limit, wait } => Self::new(ProblemType::QueueFull, error.to_string())
                .with("limit", u64::try_from(limit.as_millis()).unwrap_or(u64::MAX))
                .with("estimated_wait_s", wait.as_secs_f64())
                .retry_after(wait),
            Failure::Memory(error) => error.into(),
            Failure::Stopped => Self::shutting_down(error.to_string()),
            Failure::Panicked { .. } => Self::internal(error),
        }
    }
}

impl From<EndError> for Problem {
    fn from(error: EndError) -> Self {
        match error {
            EndError::Job(failure) => failure.into(),
            EndError::Save { error: SaveError::Format(error), resolution } => format_problem(&error, resolution),
            EndError::Save { error: SaveError::TooLarge { bytes, limit }, resolution } => {
                file_too_large(bytes, limit, resolution)
            }
            EndError::Save { error: SaveError::Store(error), .. } => error.into(),
            EndError::Save { error: SaveError::Other(error), .. } => Self::internal(error),
            EndError::Poison { attempts } => {
                Self::new(ProblemType::JobAbandoned, error.to_string()).with("actual", attempts)
            }
            EndError::Lost { .. } => Self::new(ProblemType::JobAbandoned, error.to_string()),
        }
    }
}

impl From<AcceptError> for Problem {
    fn from(error: AcceptError) -> Self {
        match error {
            AcceptError::Refused(refusal) => refusal.into(),
            AcceptError::BrokerDown => {
                Self::new(ProblemType::BrokerFailed, error.to_string()).retry_after(Duration::from_secs(5))
            }
            AcceptError::Store(error) => error.into(),
            AcceptError::OtherRequest => {
                Self::new(ProblemType::OtherRequest, error.to_string()).with("parameter", "Idempotency-Key")
            }
            AcceptError::Random(_) => Self::internal(error),
        }
    }
}

impl From<StoreError> for Problem {
    /// Logs the details. Clients do not get them, because they may contain paths and addresses of the operator.
    fn from(error: StoreError) -> Self {
        let wait = Duration::from_secs(5);
        match error {
            StoreError::TooLarge { bytes, max_bytes } => {
                Self::new(ProblemType::BodyTooLarge, error.to_string()).with("actual", bytes).with("limit", max_bytes)
            }
            StoreError::Full { held, max_bytes, .. } => Self::new(ProblemType::StoreFull, error.to_string())
                .with("actual", held)
                .with("limit", max_bytes)
                .retry_after(wait),
            StoreError::NoSpace { .. } => {
                tracing::error!(%error, "the disk of the store is full");
                Self::new(ProblemType::StoreFull, "the disk of the store is full").retry_after(wait)
            }
            StoreError::TooManyRecords { limit, .. } => {
                Self::new(ProblemType::TooManyJobs, error.to_string()).with("limit", limit).retry_after(wait)
            }
            StoreError::Quarantined { .. } => {
                Self::new(ProblemType::RecordUnreadable, "the record of the job is damaged and in quarantine")
            }
            StoreError::OtherRelease { .. } => Self::other_release(),
            StoreError::Damaged { digest } => Self::new(
                ProblemType::NoSuchStructure,
                format!("the stored structure `{digest}` was damaged and has been removed: upload it again"),
            ),
            other => {
                tracing::error!(error = %other, "the store failed");
                Self::new(ProblemType::StoreFailed, "the store cannot be reached").retry_after(wait)
            }
        }
    }
}

impl From<PictureError> for Problem {
    fn from(error: PictureError) -> Self {
        let detail = error.to_string();
        match error {
            PictureError::TooLarge { side, pixels, limit } => Self::new(ProblemType::PictureTooLarge, detail)
                .with("parameter", side)
                .with("limit", limit)
                .with("actual", pixels),
            _ => Self::internal(detail), // The parameters have been checked before.
        }
    }
}

impl From<SurfaceError> for Problem {
    fn from(error: SurfaceError) -> Self {
        use SurfaceError as E;
        let detail = error.to_string();
        let suggested = error.suggested_resolution();
        let fitting =
            |problem: Self| suggested.into_iter().fold(problem, |problem, h| problem.with("suggested_resolution", h));
        let exceeded = |kind: ProblemType, limit: u64, actual: u64| {
            Self::new(kind, error.to_string()).with("limit", limit).with("actual", actual)
        };
        match error {
            E::NoSpheres => Self::new(ProblemType::NoAtoms, detail),
            E::BadSphere { index, expected, .. } => {
                Self::new(ProblemType::UnreadableStructure, detail).with("atom", index).with("expected", expected)
            }
            E::BadParameter { .. } => ParamError::from(error).into(),
            E::GridTooLarge { grid_points, limit, resolution, .. } => {
                fitting(exceeded(ProblemType::GridTooLarge, limit, grid_points).with("resolution", resolution))
            }
            E::PocketGridTooLarge { grid_points, limit, .. } => {
                exceeded(ProblemType::GridTooLarge, limit, grid_points).with("parameter", "pockets")
            }
            E::TooManyPocketRows { rows, limit } => {
                exceeded(ProblemType::TooManyCandidates, limit, rows).with("parameter", "pockets")
            }
            E::TooManyCandidates { candidates, limit, resolution, .. } => {
                fitting(exceeded(ProblemType::TooManyCandidates, limit, candidates).with("resolution", resolution))
            }
            E::MeshTooLarge { bytes, limit, .. } => fitting(exceeded(ProblemType::MeshTooLarge, limit, bytes)),
            E::TooManyTriangles { triangles, limit, resolution, .. } => Self::new(ProblemType::MeshTooLarge, detail)
                .with("parameter", "max_triangles")
                .with("limit", limit)
                .with("actual", triangles)
                .with("resolution", resolution),
            E::TooManyTiles { limit, .. } => Self::new(ProblemType::GridTooLarge, detail).with("limit", limit),
            E::TilesetTooLarge { limit, .. } => Self::new(ProblemType::TooMuchMemory, detail).with("limit", limit),
            E::TooManyOverlaps { overlaps, limit } => exceeded(ProblemType::TooManyCandidates, limit, overlaps),
            E::NoSurface { isovalue: Some(isovalue) } => {
                Self::new(ProblemType::NoSurface, detail).with("parameter", "isovalue").with("isovalue", isovalue)
            }
            E::NoSurface { isovalue: None } => {
                Self::new(ProblemType::NoSurface, detail).with("parameter", "resolution")
            }
            E::NoCavity { .. } => Self::new(ProblemType::NoSurface, detail).with("parameter", "cavities"),
            E::NoPatch => Self::new(ProblemType::NoSurface, detail).with("parameter", "context"),
            E::DeviceMemory { needed, available, .. } => {
                fitting(exceeded(ProblemType::DeviceMemory, available, needed))
            }
            // The worker has logged the driver's message.
            E::Device { .. } => {
                Self::new(ProblemType::DeviceFailed, "no device could run the job").retry_after(Duration::from_secs(1))
            }
            E::Deadline => Self::new(ProblemType::Deadline, detail),
            E::Memory(error) => error.into(),
            E::Cancelled => Self::from(Failure::Stopped),
            E::Sink => Self::internal(detail), // Responses are not written to a sink.
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_format_that_cannot_count_the_triangles_is_explained_by_their_number() {
        let error = FormatError::TooMany { format: "STL", what: "triangles", count: 400, limit: 100 };
        let problem = format_problem(&error, 0.5).record("");
        assert_eq!(problem["detail"], format!("{error}; a resolution of 1.05 Å should fit"));
        assert_eq!((&problem["limit"], &problem["suggested_resolution"]), (&100.into(), &1.05.into()));
        // No grid is coarser than 20 Å.
        let none = file_too_large(200_000, 100, 0.5).record("");
        assert_eq!(none["detail"], "the file would have 200000 bytes and the limit is 100");
        assert!(none.get("suggested_resolution").is_none());
        let file = format_problem(&FormatError::GlbTooLarge { bytes: 400, limit: 100 }, 0.5).record("");
        assert_eq!(
            file["detail"],
            "the file would have 400 bytes and the limit is 100; a resolution of 1.05 Å should fit"
        );
    }
}
