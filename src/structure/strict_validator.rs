//! Strict validation of a structure file by pdbtbx.
//!
//! The reader of this crate parses only what it needs and stops at the first error. This module checks the whole file
//! against the format and lists all findings. They accompany a read error, or answer a strict check. pdbtbx cannot be
//! stopped, is slow (quadratic in the residues of a chain) and panics on hostile input. Therefore:
//!
//! * It checks at most [`MAX_BYTES`] of text that pdbtbx checks fast enough, or [`MAX_UNREAD_BYTES`] of text that this
//!   crate cannot read. Call it on a thread that may block for about a second.
//! * Panics are caught and become a diagnostic. The panic hook is shared by the whole process, so a library cannot
//!   replace it without races. Call [`quiet_panics`] from `main` before starting threads: it wraps the hook once and
//!   silences panics of threads inside [`check`]. Without that call, a caught panic also prints to standard error.

use std::cell::Cell;
use std::io::BufReader;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use pdbtbx::{Context, ErrorLevel, Format, PDBError, ReadOptions, StrictnessLevel};

use super::atoms::SourceFormat;
use super::error::StructureError;
use super::read::{self, ReadLimits, Reading, without_mark};
use super::strict_cost::{Cost, count};
use super::text::decode;
use super::{inflate, sniff};
use crate::surface::{Control, Reservation};

/// Largest text that is checked.
pub const MAX_BYTES: u64 = 8 << 20;

/// Largest text that is checked if this crate cannot read it, so that the cost of checking is unknown. Takes about a
/// second in the worst case.
pub const MAX_UNREAD_BYTES: u64 = 32 << 10;

/// Memory of pdbtbx, bytes per byte of text.
const MEMORY_PER_BYTE: u64 = 32;

/// Largest number of returned diagnostics. A damaged file has one per line.
pub const MAX_DIAGNOSTICS: usize = 100;

/// Longest message in characters.
const MAX_MESSAGE: usize = 400;

/// Severity of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Level {
    /// Information.
    Note,
    /// Violates the format description, but is readable.
    Warning,
    /// Not readable according to the format description.
    Error,
}

impl Level {
    /// Returns `note`, `warning` or `error`.
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
    /// Severity.
    pub level: Level,
    /// Message.
    pub message: String,
    /// Line of the decompressed text, from 1, if known.
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

/// Hides caught panics of [`check`] from the panic hook of the process. Call it once from `main`, after setting other
/// hooks and before starting threads.
pub fn quiet_panics() {
    let hook = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if !INSIDE.try_with(Cell::get).unwrap_or(false) {
            hook(info);
        }
    }));
}

/// Checks a file, compressed or not. Blocks for about a second at most. Never panics. The only finding about a file
/// that would take longer is a note that says so.
///
/// # Errors
/// Returns errors of decompression and format detection, of limits, of memory and of cancellation.
pub fn check(bytes: &[u8], limits: &ReadLimits, control: &Control<'_>) -> Result<Vec<Diagnostic>, StructureError> {
    let limit = limits.max_inflated_bytes.min(MAX_BYTES);
    let reading = Reading::new(limits, control);
    let too_large = || vec![Diagnostic::note(format!("not checked: the text is larger than {limit} bytes"))];
    let plain = match inflate::inflate(bytes, limit, &reading) {
        Err(StructureError::InflatedTooLarge { .. }) if limit < limits.max_inflated_bytes => return Ok(too_large()),
        plain => plain?,
    };
    let text = without_mark(&plain);
    // pdbtbx reads only PDB and mmCIF.
    let unread =
        |format: &str| Ok(vec![Diagnostic::note(format!("not checked: the strict validator does not read {format}"))]);
    let format = match sniff::sniff(text)? {
        SourceFormat::Pdb => Format::Pdb,
        SourceFormat::Mmcif => Format::Mmcif,
        SourceFormat::BinaryCif => return unread("BinaryCIF"),
        SourceFormat::Pqr => return unread("PQR"),
        SourceFormat::Xyz => return unread("XYZ"),
    };
    let _memory = reading.reserve(MEMORY_PER_BYTE * text.len() as u64)?;
    let of_structure = Control { memory: Arc::new(Reservation::new(&control.memory)), ..control.clone() };
    let cost = match read::read_with(text, limits, &of_structure) {
        Ok(structure) => Cost::of(&structure, text),
        Err(StructureError::Syntax { .. } | StructureError::NoAtoms { .. }) => {
            if text.len() as u64 > MAX_UNREAD_BYTES {
                let message =
                    format!("not checked: the file cannot be read and has more than {MAX_UNREAD_BYTES} bytes");
                return Ok(vec![Diagnostic::note(message)]);
            }
            Cost::default()
        }
        Err(error) => return Err(error),
    };
    drop(of_structure);
    // The cost is that of one category.
    if !cost.is_low() || count(text, b"_atom_site.label_asym_id") > 1 {
        let message = "not checked: the strict validator would take too long, because its time grows with the square \
                       of the residues of a chain, the atoms of a residue and the records that refer to atoms";
        return Ok(vec![Diagnostic::note(message.to_owned())]);
    }
    let _copies = reading.reserve(cost.bytes())?;
    INSIDE.set(true);
    let outcome = catch_unwind(AssertUnwindSafe(|| findings(text, format)));
    INSIDE.set(false);
    Ok(outcome.unwrap_or_else(|panic| {
        let words = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
        let message = format!("the strict validator failed on this file: {}", words.unwrap_or("no reason given"));
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

/// Returns a message of bounded length that is safe to print on one line.
fn short(message: &str) -> String {
    let line = message.split_whitespace().collect::<Vec<_>>().join(" ");
    decode(line.as_bytes()).chars().take(MAX_MESSAGE).collect()
}
