//! Errors of commands, with their exit codes, one-line messages and hints.

use std::io::{self, Write};

use molmesh::formats::FormatError;
use molmesh::pipeline::JobError;
use molmesh::structure::StructureError;
use molmesh::surface::SurfaceError;
use thiserror::Error;

use super::style::{Style, printable};

/// Exit codes. They are documented in `--help` and in `docs/start/cli.md` and do not change meaning.
pub(crate) mod code {
    /// Success.
    pub(crate) const OK: i32 = 0;
    /// Internal error, or an unhealthy service.
    pub(crate) const INTERNAL: i32 = 1;
    /// Bad usage or a bad parameter.
    pub(crate) const USAGE: i32 = 2;
    /// The input cannot be read from disk or stdin.
    pub(crate) const INPUT: i32 = 3;
    /// The structure or the map is rejected: unreadable, no atoms, empty selection.
    pub(crate) const STRUCTURE: i32 = 4;
    /// A limit is exceeded.
    pub(crate) const LIMIT: i32 = 5;
    /// No such backend or device on this machine.
    pub(crate) const BACKEND: i32 = 6;
    /// The output cannot be written.
    pub(crate) const OUTPUT: i32 = 7;
    /// Another service uses the data folder.
    pub(crate) const IN_USE: i32 = 8;
    /// Some of several files failed.
    pub(crate) const BATCH: i32 = 9;
    /// Interrupted (Ctrl-C).
    pub(crate) const INTERRUPTED: i32 = 130;
}

/// Table of exit codes for `--help`. `docs/start/cli.md` has the same text.
pub(crate) const EXIT_CODES: &str = "\
Exit codes:
    0  success
    1  internal error, or the checked service is unhealthy
    2  wrong usage or invalid parameter
    3  the input cannot be read
    4  the structure or the map is rejected: unreadable, no atoms, empty selection
    5  a limit is exceeded: input, atoms, map, grid, mesh
    6  the backend or device does not exist on this machine
    7  the output cannot be written
    8  another service uses the data folder
    9  some of several files failed; the last line counts them by reason
  130  interrupted; no partial file remains";

/// End of hints about backends.
const DOCTOR: &str = "; `molmesh doctor` lists the backends";

/// Error of a command.
#[derive(Debug, Error)]
pub(crate) enum CliError {
    /// The flags are invalid or contradict each other.
    #[error("{message}")]
    Usage { message: String, hint: Option<String> },
    /// The input cannot be read.
    #[error("cannot read {name}: {}", reason(source))]
    Input {
        /// Path, or `stdin`.
        name: String,
        source: io::Error,
    },
    /// Reading, selecting or meshing failed.
    #[error("{name}: {source}")]
    Job {
        name: String,
        source: JobError,
        /// Worst finding of the strict validator in the same file.
        strict_finding: Option<Box<str>>,
    },
    /// The requested strict check found errors.
    #[error("{name}: the strict check found {errors} errors")]
    Strict { name: String, errors: usize, first: String },
    /// The format cannot hold the mesh, or the mesh is broken.
    #[error(transparent)]
    Format(#[from] FormatError),
    /// The requested backend is not available.
    #[error("no backend `{requested}` on this machine: {why}")]
    NoBackend { requested: &'static str, why: String },
    /// The output cannot be written.
    #[error("cannot write {name}: {}", reason(source))]
    Output {
        /// Path, or `stdout`.
        name: String,
        source: io::Error,
    },
    /// Some files of a batch failed; the others were written.
    #[error("{failed} of {files} files failed: {reasons}")]
    Batch {
        failed: usize,
        files: usize,
        /// Meanings of exit codes, each with the number of files.
        reasons: String,
    },
    /// Interrupted by a signal.
    #[error("interrupted; no partial file remains")]
    Interrupted,
    /// The service could not start, or is not healthy.
    #[error("{0}")]
    Service(String),
    /// Another service uses the data folder.
    #[error("{0}")]
    InUse(String),
    /// A service would not start, or not be ready.
    #[error("a service would not start or not be ready: {}", failed.join(", "))]
    Unfit {
        /// Names of the failed checks.
        failed: Vec<&'static str>,
        /// True if the backend check failed.
        backend: bool,
    },
    /// Defect of the program.
    #[error("internal error: {0}")]
    Internal(String),
}

/// Returns the system's message without its error number.
fn reason(error: &io::Error) -> String {
    let text = error.to_string();
    let message = text.split(" (os error").next().unwrap_or(&text);
    match message.split_once(' ') {
        // "No such file" reads better as "no such file" behind a colon; "I/O error" keeps its capitals.
        Some((first, rest)) if first.chars().skip(1).all(char::is_lowercase) => {
            format!("{} {rest}", first.to_lowercase())
        }
        _ => message.to_owned(),
    }
}

impl CliError {
    /// Creates a usage error without a hint.
    pub(crate) fn usage(message: impl Into<String>) -> Self {
        Self::Usage { message: message.into(), hint: None }
    }

    /// Creates a usage error with a hint.
    pub(crate) fn usage_with_hint(message: impl Into<String>, hint: impl Into<String>) -> Self {
        Self::Usage { message: message.into(), hint: Some(hint.into()) }
    }

    /// Returns the exit code.
    pub(crate) fn code(&self) -> i32 {
        match self {
            Self::Usage { .. } => code::USAGE,
            Self::Input { .. } => code::INPUT,
            Self::Job { source: JobError::Structure(error), .. } => structure_code(error),
            Self::Job { source: JobError::Surface(error), .. } => surface_code(error),
            Self::Job { source: JobError::Color(_) | JobError::Map(_), .. } | Self::Strict { .. } => code::STRUCTURE,
            Self::Job { source: JobError::Format(error), .. } | Self::Format(error) => format_code(error),
            Self::NoBackend { .. } | Self::Unfit { backend: true, .. } => code::BACKEND,
            Self::Output { .. } => code::OUTPUT,
            Self::InUse(_) => code::IN_USE,
            Self::Batch { .. } => code::BATCH,
            Self::Interrupted => code::INTERRUPTED,
            Self::Job { source: JobError::Picture(_), .. }
            | Self::Service(_)
            | Self::Unfit { .. }
            | Self::Internal(_) => code::INTERNAL,
        }
    }

    /// Returns true if every other file of a batch would fail as well.
    pub(crate) fn ends_batch(&self) -> bool {
        match self {
            Self::Interrupted | Self::NoBackend { .. } => true,
            Self::Output { source, .. } => {
                matches!(source.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
            }
            _ => self.code() == code::INTERRUPTED,
        }
    }

    /// Returns a suggestion, if there is one.
    pub(crate) fn hint(&self) -> Option<String> {
        match self {
            Self::Usage { hint, .. } => hint.clone(),
            Self::Strict { first, .. } => Some(format!("the first: {first}")),
            Self::Job { source: JobError::Surface(error), .. } => surface_hint(error),
            Self::Job { source: JobError::Structure(_), strict_finding, .. } => {
                strict_finding.as_deref().map(str::to_owned)
            }
            Self::NoBackend { .. } => Some(format!("try --backend auto{DOCTOR}")),
            Self::InUse(_) => Some("stop that service, or choose another folder with --data-dir".to_owned()),
            Self::Output { source, .. } if source.kind() == io::ErrorKind::NotFound => {
                Some("the directory must exist".to_owned())
            }
            _ => None,
        }
    }

    /// Prints the error line and the hint line to stderr.
    pub(crate) fn print(&self, style: Style) {
        let hint = self.hint().map(|hint| format!("{} {hint}\n", style.dim("   hint:"))).unwrap_or_default();
        let text = format!("{} {}\n{hint}", style.red("molmesh:"), printable(&self.to_string()));
        // A closed stderr is ignored; the exit code still reports the failure.
        drop(io::stderr().write_all(text.as_bytes()));
    }
}

/// Returns the meaning of an exit code in a few words.
pub(crate) fn meaning(code: i32) -> &'static str {
    let number = code.to_string();
    let row = EXIT_CODES.lines().filter_map(|line| line.trim().split_once("  ")).find(|(row, _)| *row == number);
    row.and_then(|(_, text)| text.split([':', ',', ';']).next()).unwrap_or("unknown error")
}

fn structure_code(error: &StructureError) -> i32 {
    match error {
        StructureError::Input { .. } => code::INPUT,
        StructureError::Scratch { .. } | StructureError::DiskFull | StructureError::DiskSpace(_) => code::OUTPUT,
        _ => code::STRUCTURE,
    }
}

fn surface_code(error: &SurfaceError) -> i32 {
    match error {
        SurfaceError::NoSpheres | SurfaceError::BadSphere { .. } => code::STRUCTURE,
        // The isovalue is above the highest density.
        SurfaceError::BadParameter { .. }
        | SurfaceError::NoSurface { .. }
        | SurfaceError::NoPatch
        | SurfaceError::NoCavity { .. } => code::USAGE,
        SurfaceError::Limit(_) | SurfaceError::Memory(_) | SurfaceError::Deadline => code::LIMIT,
        SurfaceError::Device { .. } => code::BACKEND,
        SurfaceError::Cancelled => code::INTERRUPTED,
        SurfaceError::Sink => code::INTERNAL,
    }
}

fn format_code(error: &FormatError) -> i32 {
    match error {
        FormatError::Limit(_) | FormatError::CoordinateTooLarge { .. } => code::LIMIT,
        // A broken mesh is a defect of the program.
        _ => code::INTERNAL,
    }
}

fn surface_hint(error: &SurfaceError) -> Option<String> {
    match error {
        SurfaceError::Limit(error) => {
            let coarser = error.suggested_resolution.map(|h| format!("try --resolution {h}"));
            let raise = error.flag().map(|flag| format!("raise the limit with {flag}"));
            let both: Vec<String> = coarser.into_iter().chain(raise).collect();
            (!both.is_empty()).then(|| both.join(", or "))
        }
        SurfaceError::Device { .. } => Some(format!("try --backend cpu{DOCTOR}")),
        SurfaceError::NoSurface { isovalue: None } => Some("try a finer --resolution".to_owned()),
        SurfaceError::NoSurface { .. } => Some("try a lower --isovalue, or a finer --resolution".to_owned()),
        SurfaceError::NoCavity { .. } => {
            Some("try a finer --resolution; --cavities keep lists all cavities".to_owned())
        }
        SurfaceError::NoPatch => Some("try a finer --resolution, or omit --context".to_owned()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;
    use molmesh::surface::limit::LIMITS;
    use molmesh::surface::{Exceeded, Limit};

    use super::super::args::Args;
    use super::*;

    #[test]
    fn every_flag_of_a_limit_exists() {
        let mut args = Args::command();
        args.build();
        let mesh = args.find_subcommand("mesh").unwrap();
        let flags: Vec<String> =
            mesh.get_arguments().filter_map(|arg| Some(format!("--{}", arg.get_long()?))).collect();
        for flag in LIMITS.iter().filter_map(|row| row.flag) {
            assert!(flags.iter().any(|known| known == flag), "{flag}");
        }
    }

    #[test]
    fn every_error_has_its_exit_code() {
        let job = |source: JobError| CliError::Job { name: "x".into(), source, strict_finding: None };
        let missing = || io::Error::from(io::ErrorKind::NotFound);
        let cases: [(CliError, i32); 18] = [
            (CliError::Internal(String::new()), 1),
            (CliError::Unfit { failed: vec!["store"], backend: false }, 1),
            (CliError::usage("x"), 2),
            (CliError::Unfit { failed: vec!["devices", "store"], backend: true }, 6),
            (CliError::Input { name: "x".into(), source: missing() }, 3),
            (job(StructureError::NoAtoms { found: "nothing".into() }.into()), 4),
            (job(SurfaceError::NoSpheres.into()), 4),
            (CliError::Strict { name: "x".into(), errors: 1, first: String::new() }, 4),
            (job(SurfaceError::Limit(Exceeded::new(Limit::Atoms, 1).into()).into()), 5),
            (job(SurfaceError::Deadline.into()), 5),
            (job(SurfaceError::Device { why: String::new() }.into()), 6),
            (FormatError::Limit(Exceeded::new(Limit::FileBytes, 1).into()).into(), 5),
            (CliError::NoBackend { requested: "gpu", why: String::new() }, 6),
            (CliError::InUse(String::new()), 8),
            (CliError::Batch { failed: 1, files: 2, reasons: String::new() }, 9),
            (CliError::Output { name: "x".into(), source: missing() }, 7),
            (job(SurfaceError::Cancelled.into()), 130),
            (CliError::Interrupted, 130),
        ];
        for (error, expected) in cases {
            assert_eq!(error.code(), expected, "{error}");
        }
    }

    #[test]
    fn reasons_of_a_batch_come_from_the_table() {
        assert_eq!(
            [3, 4, 5, 77].map(meaning),
            [
                "the input cannot be read",
                "the structure or the map is rejected",
                "a limit is exceeded",
                "unknown error",
            ]
        );
    }

    #[test]
    fn only_errors_of_all_files_end_a_batch() {
        let output = |kind: io::ErrorKind| CliError::Output { name: "x".into(), source: kind.into() };
        assert!(output(io::ErrorKind::StorageFull).ends_batch() && CliError::Interrupted.ends_batch());
        assert!(!output(io::ErrorKind::PermissionDenied).ends_batch() && !CliError::usage("x").ends_batch());
    }

    #[test]
    fn system_messages_lose_their_number() {
        assert_eq!(reason(&io::Error::from_raw_os_error(2)), "no such file or directory");
    }

    #[test]
    fn grid_limit_suggests_a_resolution() {
        let error: SurfaceError = Exceeded::new(Limit::GridPoints, 1).suggest(0.4).error();
        let hint = CliError::Job { name: "x".into(), source: error.into(), strict_finding: None }.hint();
        assert_eq!(hint.as_deref(), Some("try --resolution 0.4, or raise the limit with --max-grid-points"));
    }
}
