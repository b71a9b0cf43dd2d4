//! Conversion of the errors of other modules into problems. No other file does this for jobs, meshes and the store.

mod inputs;

use std::fmt::Display;
use std::time::Duration;

use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;

use super::problem::Problem;
use super::problem_types::{ProblemEntry, ProblemType};
use crate::client_shares::ShareExceeded;
use crate::formats::FormatError;
use crate::jobs::{AcceptError, EndError, Failure, Refusal, SaveError};
use crate::picture::PictureError;
use crate::pipeline::JobError;
use crate::pipeline::params::ParamError;
use crate::store::StoreError;
use crate::structure::strict_validator::Diagnostic;
use crate::surface::{Exceeded, Limit, OutOfMemory, SurfaceError};

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
    let error = Exceeded { actual: Some(bytes), ..Exceeded::new(Limit::FileBytes, limit) };
    Problem::from(&error.suggest_for_area(resolution))
}

/// Returns the problem of a mesh that cannot be written.
pub(super) fn format_problem(error: &FormatError, resolution: f64) -> Problem {
    match error {
        // A number that is not known does not depend on the grid spacing.
        FormatError::Limit(error) if error.actual.is_none() => Problem::from(&**error),
        FormatError::Limit(error) => Problem::from(&Exceeded::clone(error).suggest_for_area(resolution)),
        _ => Problem::internal(error),
    }
}

/// Returns the message of an error, with the configuration key of its limit.
fn with_key(error: &impl Display, limit: Limit) -> String {
    format!("{error} ({})", limit.row().key.unwrap_or_default())
}

impl From<&Exceeded> for Problem {
    fn from(error: &Exceeded) -> Self {
        let row = error.limit.row();
        let Some(entry) = ProblemEntry::find(row.problem) else { return Self::internal(error) };
        let members = [
            ("parameter", row.parameter.map(Value::from)),
            ("actual", error.actual.map(Value::from)),
            ("resolution", error.resolution.map(Value::from)),
            ("position", error.position.map(|position| position.to_vec().into())),
            ("suggested_resolution", error.suggested_resolution.map(Value::from)),
        ];
        let problem = Self::new(entry.problem_type, error.message(error.key())).with("limit", error.max);
        members
            .into_iter()
            .filter_map(|(name, value)| Some((name, value?)))
            .fold(problem, |p, (name, v)| p.with(name, v))
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
        let busy = |kind, detail| Self::new(kind, detail).retry_after(Duration::from_secs(1));
        match error {
            OutOfMemory::Budget { held, limit, .. } => {
                busy(ProblemType::MemoryFull, with_key(&error, Limit::MemoryBytes))
                    .with("limit", limit)
                    .with("actual", held)
            }
            OutOfMemory::Share { limit, held, .. } => {
                busy(ProblemType::ShareExceeded, format!("{error} (server.client_share)"))
                    .with("limit", limit)
                    .with("actual", held)
            }
            OutOfMemory::Limit { needed, limit } => {
                Self::from(&Exceeded { actual: Some(needed), ..Exceeded::new(Limit::MemoryBytes, limit) })
            }
            OutOfMemory::System { .. } => busy(ProblemType::MemoryFull, error.to_string()),
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
            StoreError::TooLarge(error) => Self::from(&*error),
            StoreError::Full { held, max_bytes, .. } => Self::new(ProblemType::StoreFull, error.to_string())
                .with("actual", held)
                .with("limit", max_bytes)
                .retry_after(wait),
            StoreError::NoSpace { .. } => {
                tracing::error!(%error, "the disk of the store is full");
                Self::new(ProblemType::StoreFull, "the disk of the store is full").retry_after(wait)
            }
            StoreError::TooManyRecords(error) => Self::from(&*error).retry_after(wait),
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
            PictureError::Limit(error) => Self::from(&*error),
            _ => Self::internal(detail), // The parameters have been checked before.
        }
    }
}

impl From<SurfaceError> for Problem {
    fn from(error: SurfaceError) -> Self {
        use SurfaceError as E;
        let detail = error.to_string();
        match error {
            E::NoSpheres => Self::new(ProblemType::NoAtoms, detail),
            E::BadSphere { index, expected, .. } => {
                Self::new(ProblemType::UnreadableStructure, detail).with("atom", index).with("expected", expected)
            }
            E::BadParameter { .. } => ParamError::from(error).into(),
            E::Limit(error) => Self::from(&*error),
            E::NoSurface { isovalue: Some(isovalue) } => {
                Self::new(ProblemType::NoSurface, detail).with("parameter", "isovalue").with("isovalue", isovalue)
            }
            E::NoSurface { isovalue: None } => {
                Self::new(ProblemType::NoSurface, detail).with("parameter", "resolution")
            }
            E::NoCavity { .. } => Self::new(ProblemType::NoSurface, detail).with("parameter", "cavities"),
            E::NoPatch => Self::new(ProblemType::NoSurface, detail).with("parameter", "context"),
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
    use crate::structure::StructureError;
    use crate::structure::map::MapError;
    use crate::surface::limit::LIMITS;

    #[test]
    fn every_limit_has_a_problem_type() {
        for row in LIMITS {
            assert!(ProblemEntry::find(row.problem).is_some_and(|entry| entry.is_rejection), "{row:?}");
        }
    }

    #[test]
    fn problems_have_the_names_that_errors_of_jobs_state() {
        let why = String::new;
        let limit = || Exceeded::new(Limit::GridPoints, 1);
        let system = OutOfMemory::System { needed: 1 };
        let structure: [StructureError; 7] = [
            StructureError::UnknownFormat { found: why() },
            StructureError::Syntax { line: 1, column: 1, found: why(), expected: why() },
            StructureError::BadAssembly { id: why(), found: why(), expected: why() },
            StructureError::NoEntities,
            StructureError::NoAtoms { found: why() },
            StructureError::EmptySelection { holds: why() },
            StructureError::NotFound { what: "chain", requested: why(), available: why() },
        ];
        let surface: [SurfaceError; 11] = [
            SurfaceError::NoSpheres,
            SurfaceError::BadSphere { index: 0, what: "x", value: 0.0, expected: "" },
            SurfaceError::BadParameter { name: "probe", value: why(), expected: why() },
            SurfaceError::NoSurface { isovalue: None },
            SurfaceError::NoPatch,
            SurfaceError::NoCavity { probe: 1.4, cavities: 0 },
            limit().error(),
            system.into(),
            OutOfMemory::Limit { needed: 2, limit: 1 }.into(),
            SurfaceError::Device { why: why() },
            SurfaceError::Cancelled,
        ];
        let others = [
            JobError::Format(limit().error()),
            JobError::Format(FormatError::NotQuantized),
            JobError::Map(MapError::UnknownFormat { found: why() }),
        ];
        let errors = structure.into_iter().map(JobError::from).chain(surface.into_iter().map(JobError::from));
        for error in errors.chain(others) {
            let name = error.problem();
            let problem = Problem::from(Failure::Job { error, diagnostics: Vec::new() });
            assert_eq!(problem.slug(), name);
        }
    }

    #[test]
    fn a_format_that_cannot_count_the_triangles_is_explained_by_their_number() {
        let triangles = Exceeded { actual: Some(400), ..Exceeded::new(Limit::FileTriangles, 100) };
        let problem = format_problem(&triangles.error(), 0.5).record("");
        assert_eq!(
            problem["detail"],
            "the file would have 400 triangles, the limit is 100; a resolution of 1.05 Å should fit"
        );
        assert_eq!((&problem["limit"], &problem["suggested_resolution"]), (&100.into(), &1.05.into()));
        // No grid is coarser than 20 Å.
        let none = file_too_large(200_000, 100, 0.5).record("");
        assert_eq!(none["detail"], "the file would have 200000 bytes, the limit is 100");
        assert!(none.get("suggested_resolution").is_none());
        let atom = format_problem(&Exceeded::new(Limit::AtomIndex, 7).error(), 0.5).record("");
        assert_eq!((&atom["parameter"], atom.get("suggested_resolution")), (&"atom_ids".into(), None));
    }
}
