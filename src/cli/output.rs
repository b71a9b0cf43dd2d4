//! Output of a command: stdout, or a file that gets its name only when it is complete.

use std::fs::{self, File, OpenOptions};
use std::io::{self, IsTerminal as _, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use molmesh::formats::{Format, RandomAccess};
use molmesh::surface::CancelToken;

use super::error::CliError;
use super::interrupt;
use super::report::WrittenFile;

/// Maximum size of one write, bytes. Cancellation is checked between writes.
const MAX_WRITE: usize = 1 << 20;

/// Number of files that this process has staged.
static STAGED: AtomicU64 = AtomicU64::new(0);

/// Open output. Dropping it without [`Output::finish`] removes the file.
pub(crate) struct Output {
    to: To,
    /// Path, or `stdout`.
    pub(crate) name: String,
    cancel: CancelToken,
    /// Bytes written so far.
    pub(crate) bytes: u64,
    /// Time spent in system writes.
    pub(crate) writing: Duration,
}

enum To {
    Stdout(io::Stdout),
    /// Output that a rename cannot replace: a pipe, a terminal, `/dev/null`.
    Device(File),
    /// The file `path` beside `target`, renamed when it is complete.
    Staged {
        file: File,
        path: PathBuf,
        target: PathBuf,
    },
}

impl Output {
    /// Opens `path`; `-` is stdout. Detects errors before any work is done.
    pub(crate) fn open(path: &Path, cancel: &CancelToken) -> Result<Self, CliError> {
        let name = if is_stdio(path) { "stdout".to_owned() } else { path.display().to_string() };
        let to = if is_stdio(path) { Ok(To::Stdout(io::stdout())) } else { open_file(path) };
        match to {
            Ok(to) => Ok(Self { to, name, cancel: cancel.clone(), bytes: 0, writing: Duration::ZERO }),
            Err(source) => Err(CliError::Output { name, source }),
        }
    }

    /// Returns true if the output is a file that can be written in any order.
    pub(crate) fn has_random_access(&self) -> bool {
        cfg!(unix) && matches!(self.to, To::Staged { .. })
    }

    /// Describes the file for a report, in which it is the member `member`.
    pub(crate) fn written(&self, member: &'static str, format: &'static str) -> WrittenFile {
        let is_stdout = matches!(self.to, To::Stdout(_));
        WrittenFile { member, name: self.name.clone(), format, bytes: self.bytes, is_stdout }
    }

    /// Rejects a binary format on a terminal, which would interpret the bytes as commands.
    pub(crate) fn refuse_terminal(&self, format: Format) -> Result<(), CliError> {
        let terminal = match &self.to {
            To::Stdout(out) => out.is_terminal(),
            To::Device(file) => file.is_terminal(),
            To::Staged { .. } => false,
        };
        if !terminal || format.is_text() {
            return Ok(());
        }
        let message = format!("{} is a terminal, and {format} is a binary format", self.name);
        Err(CliError::usage_with_hint(message, "name a file with -o, or redirect the output"))
    }

    /// Completes all outputs of a command: renames the files to their final names.
    pub(crate) fn finish(mut outputs: Vec<Self>) -> Result<(), CliError> {
        for output in &mut outputs {
            output.flush().map_err(|source| output.failure(source))?;
        }
        let staged = |output: &Self| matches!(output.to, To::Staged { .. });
        let staged: Vec<&Self> = outputs.iter().filter(|output| staged(output)).collect();
        let paths = staged.iter().filter_map(|output| match &output.to {
            To::Staged { path, target, .. } => Some((path.as_path(), target.as_path())),
            To::Stdout(_) | To::Device(_) => None,
        });
        interrupt::commit(&paths.collect::<Vec<_>>()).map_err(|(number, source)| staged[number].failure(source))
    }

    fn check_cancelled(&self) -> io::Result<()> {
        // Not `Interrupted`: callers retry a write that fails with it.
        if self.cancel.is_cancelled() { Err(io::Error::other("interrupted")) } else { Ok(()) }
    }

    /// Converts the error of a failed write: to an interrupt if the command was cancelled.
    pub(crate) fn failure(&self, source: io::Error) -> CliError {
        if self.cancel.is_cancelled() {
            CliError::Interrupted
        } else {
            CliError::Output { name: self.name.clone(), source }
        }
    }
}

impl Drop for Output {
    fn drop(&mut self) {
        if let To::Staged { path, .. } = &self.to {
            interrupt::discard(path);
        }
    }
}

impl RandomAccess for Output {
    fn write_all_at(&self, bytes: &[u8], offset: u64) -> io::Result<()> {
        self.check_cancelled()?;
        match &self.to {
            #[cfg(unix)]
            To::Staged { file, .. } => std::os::unix::fs::FileExt::write_all_at(file, bytes, offset),
            _ => Err(io::ErrorKind::NotSeekable.into()),
        }
    }
}

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.check_cancelled()?;
        let bytes = &bytes[..bytes.len().min(MAX_WRITE)];
        let start = Instant::now();
        let written = match &mut self.to {
            To::Stdout(out) => out.write(bytes),
            To::Device(file) | To::Staged { file, .. } => file.write(bytes),
        };
        self.writing += start.elapsed();
        written.inspect(|&n| self.bytes += n as u64)
    }

    fn flush(&mut self) -> io::Result<()> {
        match &mut self.to {
            To::Stdout(out) => out.flush(),
            To::Device(file) | To::Staged { file, .. } => file.flush(),
        }
    }
}

/// Returns true if `path` denotes stdin or stdout.
pub(crate) fn is_stdio(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Rejects an output that would replace the input.
pub(crate) fn refuse_input(input: &Path, output: &Path) -> Result<(), CliError> {
    let is_input = !is_stdio(output) && same_file(input, output).unwrap_or(false);
    if !is_input {
        return Ok(());
    }
    let message = format!("the output `{}` is the input", output.display());
    Err(CliError::usage_with_hint(message, "name another file"))
}

/// Rejects two outputs with the same path, or both on stdout.
pub(crate) fn refuse_same(a: &Path, b: &Path) -> Result<(), CliError> {
    let same = if is_stdio(a) || is_stdio(b) { a == b } else { place(a) == place(b) };
    if same { Err(same_outputs(a)) } else { Ok(()) }
}

/// Returns the error of two outputs that are the same file.
pub(crate) fn same_outputs(path: &Path) -> CliError {
    CliError::usage(format!("two outputs are written to `{}`; expected different files", path.display()))
}

/// Returns a path that is equal for all names of an output, also if it or its folder does not exist.
pub(crate) fn place(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    // The part that exists may contain links.
    let resolved = |at: &Path| Some(at.canonicalize().ok()?.join(path.strip_prefix(at).ok()?));
    fold_case(path.ancestors().find_map(resolved).unwrap_or(path))
}

/// Returns the path in lower case on macOS and Windows, where names that differ only in case are the same file.
pub(crate) fn fold_case(path: PathBuf) -> PathBuf {
    let has_case = !cfg!(any(target_os = "macos", windows));
    if has_case { path } else { path.to_string_lossy().to_lowercase().into() }
}

/// Returns true if the name of an output is that of a folder.
pub(crate) fn ends_in_slash(path: &Path) -> bool {
    path.as_os_str().as_encoded_bytes().last().is_some_and(|byte| std::path::is_separator(char::from(*byte)))
}

/// Returns true if both are the same regular file, also through links or a redirected stdin.
#[cfg(unix)]
fn same_file(input: &Path, output: &Path) -> io::Result<bool> {
    use std::os::fd::AsFd as _;
    use std::os::unix::fs::MetadataExt as _;

    let input = if is_stdio(input) {
        File::from(io::stdin().as_fd().try_clone_to_owned()?).metadata()?
    } else {
        fs::metadata(input)?
    };
    let output = fs::metadata(output)?;
    Ok(output.is_file() && (input.dev(), input.ino()) == (output.dev(), output.ino()))
}

#[cfg(not(unix))]
fn same_file(input: &Path, output: &Path) -> io::Result<bool> {
    Ok(input.canonicalize()? == output.canonicalize()?)
}

fn open_file(path: &Path) -> io::Result<To> {
    // Resolves links, so that the target is replaced instead of the link.
    let target = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let existing = fs::metadata(&target).ok();
    match &existing {
        Some(meta) if meta.is_dir() => return Err(io::ErrorKind::IsADirectory.into()),
        Some(meta) if !meta.is_file() => return Ok(To::Device(OpenOptions::new().write(true).open(&target)?)),
        Some(_) => {
            // A read-only file must not be replaced through its directory.
            OpenOptions::new().write(true).open(&target)?;
        }
        None => {}
    }
    if target.file_name().is_none() {
        return Err(io::ErrorKind::InvalidInput.into());
    }
    // The time makes the name unique if processes share an id, as in containers with a common volume. The name of the
    // target may be too long to be a part of it.
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
    let number = STAGED.fetch_add(1, Ordering::Relaxed);
    let staged = target.with_file_name(format!(".molmesh-{}-{number}-{now:x}.part", std::process::id()));
    // Registered before the file exists, so that no interrupt can come in between.
    interrupt::stage(&staged);
    let created = OpenOptions::new().write(true).create_new(true).open(&staged).and_then(|file| {
        existing.map_or(Ok(()), |meta| file.set_permissions(meta.permissions()))?;
        Ok(To::Staged { file, path: staged.clone(), target })
    });
    created.inspect_err(|_| interrupt::discard(&staged))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn file_appears_only_when_it_is_finished() {
        let dir = tempfile::tempdir().unwrap();
        // The longest name of common file systems.
        let path = dir.path().join(format!("{}.glb", "a".repeat(251)));
        let entries = || fs::read_dir(dir.path()).unwrap().count();
        let cancel = CancelToken::default();

        let mut output = Output::open(&path, &cancel).unwrap();
        output.write_all(b"half").unwrap();
        assert!(!path.exists());
        drop(output);
        assert_eq!(entries(), 0, "an unfinished file leaves nothing");

        let mut output = Output::open(&path, &cancel).unwrap();
        output.write_all(b"whole").unwrap();
        assert_eq!(output.bytes, 5);
        Output::finish(vec![output]).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"whole");
        assert_eq!(entries(), 1);

        let mut output = Output::open(&path, &cancel).unwrap();
        cancel.cancel();
        let error = output.write_all(b"more").unwrap_err();
        assert!(matches!(output.failure(error), CliError::Interrupted));
        drop(output);
        assert_eq!(fs::read(&path).unwrap(), b"whole", "the old file survives");
        assert_eq!(entries(), 1);
    }
}
