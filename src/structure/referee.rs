//! A second opinion: what pdbtbx, a strict validating reader, says of a file.
//!
//! Our reader takes what it needs and refuses the rest with one message; the referee checks the whole file against the
//! format and lists everything it does not like. It decides nothing: its findings go with a refusal, or answer a strict
//! check. It is slow (quadratic in the residues of a chain) and panics on hostile input, hence:
//!
//! * call it on a thread that may block, with at most [`MAX_BYTES`] of text;
//! * panics are caught and become a diagnostic. The panic hook is one for the whole process, so a library cannot replace
//!   it without a race against everybody else who does. [`quiet_panics`] therefore is for `main`, before there are
//!   threads: it wraps the hook once, and only panics of a thread that is inside [`check`] are kept from it. Without that
//!   call everything works the same, and a caught panic also shows on standard error.

use std::cell::Cell;
use std::io::BufReader;
use std::panic::{AssertUnwindSafe, catch_unwind};

use pdbtbx::{Context, ErrorLevel, Format, PDBError, ReadOptions, StrictnessLevel};

use super::atoms::SourceFormat;
use super::error::StructureError;
use super::read::{ReadLimits, without_mark};
use super::text::decode;
use super::{inflate, sniff};

/// Largest text that the referee reads: a few seconds in the worst case.
pub const MAX_BYTES: u64 = 8 << 20;

/// Most diagnostics that are returned; a damaged file has one per line.
pub const MAX_DIAGNOSTICS: usize = 100;

/// Longest message, characters.
const MAX_MESSAGE: usize = 400;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Level {
    /// Worth knowing.
    Note,
    /// Against the format's description, but readable.
    Warning,
    /// Not readable by the description.
    Error,
}

impl Level {
    /// `note`, `warning` or `error`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Note => "note",
            Self::Warning => "warning",
            Self::Error => "error",
        }
    }
}

/// One finding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diagnostic {
    /// How bad it is.
    pub level: Level,
    /// What it is, in words.
    pub message: String,
    /// The line of the inflated text, from 1, where one is to blame.
    pub line: Option<u64>,
}

impl Diagnostic {
    fn note(message: String) -> Self {
        Self { level: Level::Note, message, line: None }
    }
}

thread_local! {
    static INSIDE: Cell<bool> = const { Cell::new(false) };
}

/// Keeps the referee's caught panics from the process's panic hook. For `main`, once, before it starts threads and after it
/// has set any hook of its own.
pub fn quiet_panics() {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if !INSIDE.try_with(Cell::get).unwrap_or(false) {
            hook(info);
        }
    }));
}

/// Checks a file, compressed or not. Blocks for up to seconds; never panics.
///
/// # Errors
/// Those of inflating and of sniffing: what is no structure file is not checked.
pub fn check(bytes: &[u8], limits: &ReadLimits) -> Result<Vec<Diagnostic>, StructureError> {
    let limit = limits.max_inflated_bytes.min(MAX_BYTES);
    let too_large = || vec![Diagnostic::note(format!("not checked: the text is larger than {limit} bytes"))];
    let plain = match inflate::inflate(bytes, limit) {
        Err(StructureError::InflatedTooLarge { .. }) if limit < limits.max_inflated_bytes => return Ok(too_large()),
        plain => plain?,
    };
    let text = without_mark(&plain);
    // pdbtbx does not read BinaryCIF, so there is no second opinion on it.
    let format = match sniff::sniff(text)? {
        SourceFormat::Pdb => Format::Pdb,
        SourceFormat::Mmcif => Format::Mmcif,
        SourceFormat::BinaryCif => {
            return Ok(vec![Diagnostic::note("not checked: the strict reader does not read BinaryCIF".to_owned())]);
        }
    };
    INSIDE.set(true);
    let outcome = catch_unwind(AssertUnwindSafe(|| findings(text, format)));
    INSIDE.set(false);
    Ok(outcome.unwrap_or_else(|panic| {
        let words = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
        let message = format!("the checker gave up on this file: {}", words.unwrap_or("it does not say why"));
        vec![Diagnostic { level: Level::Error, message: short(&message), line: None }]
    }))
}

fn findings(text: &[u8], format: Format) -> Vec<Diagnostic> {
    let result = ReadOptions::new().set_format(format).set_level(StrictnessLevel::Loose).read_raw(BufReader::new(text));
    let (Ok((_, errors)) | Err(errors)) = result;
    let mut found: Vec<Diagnostic> = errors.iter().take(MAX_DIAGNOSTICS).map(diagnostic).collect();
    if errors.len() > MAX_DIAGNOSTICS {
        found.push(Diagnostic::note(format!("{} more findings", errors.len() - MAX_DIAGNOSTICS)));
    }
    found
}

fn diagnostic(error: &PDBError) -> Diagnostic {
    let level = match error.level() {
        ErrorLevel::BreakingError | ErrorLevel::InvalidatingError => Level::Error,
        ErrorLevel::StrictWarning | ErrorLevel::LooseWarning => Level::Warning,
        ErrorLevel::GeneralWarning => Level::Note,
    };
    let line = match error.context() {
        Context::FullLine { linenumber: n, .. }
        | Context::Line { linenumber: n, .. }
        | Context::Range { start_linenumber: n, .. }
        | Context::RangeHighlights { start_linenumber: n, .. } => Some(*n as u64),
        Context::None | Context::Show { .. } | Context::Multiple { .. } => None,
    };
    let message = short(&format!("{}: {}", error.short_description(), error.long_description()));
    Diagnostic { level, message, line: line.filter(|&n| n > 0) }
}

/// A message that is safe to print, on one line, and not endless.
fn short(message: &str) -> String {
    let line = message.split_whitespace().collect::<Vec<_>>().join(" ");
    decode(line.as_bytes()).chars().take(MAX_MESSAGE).collect()
}
