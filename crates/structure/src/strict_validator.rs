//! Strict validation of a structure file by pdbtbx.
//!
//! The reader of this crate parses only what it needs and stops at the first error. This module checks the whole file
//! against the format and lists all findings, for a read error or a strict check. pdbtbx cannot be stopped, is slow
//! (quadratic in the residues of a chain) and panics on hostile input. Therefore:
//!
//! * It checks at most [`MAX_BYTES`] of text that pdbtbx checks fast enough, or [`MAX_UNREAD_BYTES`] of text that this
//!   crate cannot read. Call it on a thread that may block for about a second.
//! * pdbtbx runs on a thread of its own. After a cancellation or the deadline, [`check`] returns at once; the thread
//!   ends within about a second and keeps its memory reserved until then.
//! * Panics are caught and become a diagnostic. The panic hook is shared by the whole process, so a library cannot
//!   replace it without races. Call [`quiet_panics`] from `main` before starting threads: it wraps the hook once and
//!   silences panics of threads inside [`check`]. Without that call, a caught panic also prints to standard error.

use std::any::Any;
use std::cell::Cell;
use std::io::BufReader;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use molmesh_surface::{Control, Reservation, named};
use pdbtbx::{Context, ErrorLevel, Format, PDBError, ReadOptions, StrictnessLevel};

use super::error::StructureError;
use super::read::{self, ReadLimits, without_mark};
use super::source::SourceFormat;
use super::strict_cost::{Cost, count};
use super::text::decode;
use super::{decoder, sniff};

/// Maximum size of a text that is checked, bytes.
pub const MAX_BYTES: u64 = 8 << 20;

/// Maximum size of a text that is checked although this crate cannot read it, bytes. The cost of the check is then
/// unknown, about a second at most.
pub const MAX_UNREAD_BYTES: u64 = 32 << 10;

/// Memory of pdbtbx and of its copy of the text, bytes per byte of text.
const MEMORY_PER_BYTE: u64 = 33;

/// Maximum number of threads that run pdbtbx. It bounds the number of cancelled checks that still run.
const MAX_THREADS: usize = 8;

/// Interval at which cancellation and deadline are checked.
const POLL: Duration = Duration::from_millis(5);

/// Maximum number of returned diagnostics. A damaged file has one per line.
pub const MAX_DIAGNOSTICS: usize = 100;

/// Maximum length of a message, characters.
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

named!(Level, Note => "note", Warning => "warning", Error => "error");

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

/// Number of threads that run pdbtbx.
static THREADS: AtomicUsize = AtomicUsize::new(0);

/// Slot of a thread among the [`MAX_THREADS`].
struct ThreadSlot;

impl ThreadSlot {
    /// Waits for a free slot.
    fn wait(control: &Control<'_>) -> Result<Self, StructureError> {
        let take = |n: usize| (n < MAX_THREADS).then_some(n + 1);
        while THREADS.try_update(Ordering::Relaxed, Ordering::Relaxed, take).is_err() {
            stop(control)?;
            thread::sleep(POLL);
        }
        Ok(Self)
    }
}

impl Drop for ThreadSlot {
    fn drop(&mut self) {
        THREADS.fetch_sub(1, Ordering::Relaxed);
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

/// Checks a file, compressed or not. Blocks for about a second at most. Never panics. If the check would take longer,
/// the only finding is a note about that.
///
/// # Errors
/// Returns errors of decompression and format detection, of limits, of memory and of cancellation.
pub fn check(bytes: &[u8], limits: &ReadLimits, control: &Control<'_>) -> Result<Vec<Diagnostic>, StructureError> {
    let limit = limits.max_inflated_bytes.min(MAX_BYTES);
    let text_memory = Reservation::new(&control.memory);
    let too_large = || vec![Diagnostic::note(format!("not checked: the text is larger than {limit} bytes"))];
    let plain = match decoder::inflate(bytes, limit, &text_memory, control, &|_| Ok(())) {
        Err(StructureError::Limit(_)) if limit < limits.max_inflated_bytes => return Ok(too_large()),
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
    let memory = control.reserve(MEMORY_PER_BYTE * text.len() as u64)?;
    let metered = control.metered();
    let cost = match read::read_with(text, limits, &metered) {
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
    drop(metered);
    // The estimated cost applies to a file with one `atom_site` category.
    if !cost.is_low() || count(text, b"_atom_site.label_asym_id") > 1 {
        let message = "not checked: the strict validator would take too long, because its time grows with the square \
                       of the residues of a chain, the atoms of a residue and the records that refer to atoms";
        return Ok(vec![Diagnostic::note(message.to_owned())]);
    }
    let held = (memory, control.reserve(cost.bytes())?, ThreadSlot::wait(control)?);
    let (text, (sender, receiver)) = (text.to_vec(), mpsc::sync_channel(1));
    let run = move || {
        INSIDE.set(true);
        let found = catch_unwind(AssertUnwindSafe(|| findings(&text, format))).unwrap_or_else(|panic| failed(&*panic));
        drop((text, held));
        // The receiver is gone if the check was cancelled.
        _ = sender.send(found);
    };
    if let Err(error) = thread::Builder::new().name("molmesh-strict".to_owned()).spawn(run) {
        return Ok(vec![Diagnostic::note(format!("not checked: the strict validator has no thread: {error}"))]);
    }
    loop {
        match receiver.recv_timeout(POLL) {
            Ok(found) => return Ok(found),
            Err(RecvTimeoutError::Timeout) => stop(control)?,
            Err(RecvTimeoutError::Disconnected) => return Ok(failed(&"no result")),
        }
    }
}

/// Returns an error after a cancellation or the deadline.
fn stop(control: &Control<'_>) -> Result<(), StructureError> {
    let is_late = control.deadline.is_some_and(|deadline| deadline <= Instant::now());
    if is_late { Err(StructureError::Cancelled) } else { read::check(control) }
}

/// Returns the finding about a panic of pdbtbx.
fn failed(panic: &(dyn Any + Send)) -> Vec<Diagnostic> {
    let words = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
    let message = format!("the strict validator failed on this file: {}", words.unwrap_or("no reason given"));
    vec![Diagnostic { level: Level::Error, message: short(&message), line: None }]
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
