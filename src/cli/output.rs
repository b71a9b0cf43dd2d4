//! Output of a command: stdout, or a file that gets its name only when it is complete.

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

#[cfg(unix)]
use molmesh::formats::PlaceBytes;
use molmesh::surface::CancelToken;

use super::error::CliError;
use super::interrupt;

/// Open output. Dropping it without [`Output::finish`] removes the partial file.
pub(crate) struct Output {
    to: To,
    name: String,
    cancel: CancelToken,
    /// Bytes written so far.
    pub(crate) bytes: u64,
    /// Time spent in the system's writes, which is no encoding time.
    pub(crate) writing: Duration,
}

enum To {
    Stdout(io::StdoutLock<'static>),
    /// What cannot be replaced by a rename: a pipe, a terminal, `/dev/null`.
    Device(File),
    /// A file beside `target`, renamed when it is complete.
    Staged {
        file: File,
        target: PathBuf,
    },
}

impl Output {
    /// Opens `path`; `-` is stdout. Detects most errors of the final rename before any work is done.
    pub(crate) fn open(path: &Path, cancel: &CancelToken) -> Result<Self, CliError> {
        let name = if is_stdio(path) { "stdout".to_owned() } else { path.display().to_string() };
        let to = if is_stdio(path) { Ok(To::Stdout(io::stdout().lock())) } else { open_file(path) };
        match to {
            Ok(to) => Ok(Self { to, name, cancel: cancel.clone(), bytes: 0, writing: Duration::ZERO }),
            Err(source) => Err(CliError::Output { name, source }),
        }
    }

    /// A way to write at any place of the file, if it is one.
    #[cfg(unix)]
    pub(crate) fn placer(&self) -> Option<Placer<'_>> {
        match &self.to {
            To::Staged { file, .. } => Some(Placer { file, cancel: &self.cancel }),
            To::Stdout(_) | To::Device(_) => None,
        }
    }

    /// The length of a file that was written through [`Self::placer`].
    pub(crate) fn set_len(&mut self, bytes: u64) {
        self.bytes = bytes;
    }

    /// Returns true if the output is stdout.
    pub(crate) fn is_stdout(&self) -> bool {
        matches!(self.to, To::Stdout(_))
    }

    /// Renames the file to its final name.
    pub(crate) fn finish(mut self) -> Result<(), CliError> {
        let done = self.flush().and_then(|()| match &self.to {
            To::Staged { target, .. } => interrupt::commit(target),
            To::Stdout(_) | To::Device(_) => Ok(()),
        });
        done.map_err(|source| self.failure(source))
    }

    /// Returns the error for a failed write: an interrupt if there was a signal.
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
        if matches!(self.to, To::Staged { .. }) {
            interrupt::discard();
        }
    }
}

/// Writes at any place of a staged file.
#[cfg(unix)]
pub(crate) struct Placer<'a> {
    file: &'a File,
    cancel: &'a CancelToken,
}

#[cfg(unix)]
impl PlaceBytes for Placer<'_> {
    fn place(&self, offset: u64, bytes: &[u8]) -> io::Result<()> {
        if self.cancel.is_cancelled() {
            return Err(io::Error::other("interrupted"));
        }
        std::os::unix::fs::FileExt::write_all_at(self.file, bytes, offset)
    }
}

impl Write for Output {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.cancel.is_cancelled() {
            // Not `ErrorKind::Interrupted`, after which callers repeat the write.
            return Err(io::Error::other("interrupted"));
        }
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

/// Returns true if `path` means stdin or stdout.
pub(crate) fn is_stdio(path: &Path) -> bool {
    path.as_os_str() == "-"
}

fn open_file(path: &Path) -> io::Result<To> {
    // Follow links, so that the file is replaced and not the link.
    let target = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let existing = fs::metadata(&target).ok();
    match &existing {
        Some(meta) if meta.is_dir() => return Err(io::ErrorKind::IsADirectory.into()),
        Some(meta) if !meta.is_file() => return Ok(To::Device(OpenOptions::new().write(true).open(&target)?)),
        Some(_) => {
            // Do not replace a read-only file through its directory.
            OpenOptions::new().write(true).open(&target)?;
        }
        None => {}
    }
    let Some(file_name) = target.file_name() else { return Err(io::ErrorKind::InvalidInput.into()) };
    let mut staged_name = std::ffi::OsString::from(".");
    staged_name.push(file_name);
    // The time makes the name unique among containers that share a volume and use the same process id.
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos();
    staged_name.push(format!(".{}-{now:x}.part", std::process::id()));
    let staged = target.with_file_name(staged_name);
    // Registered before the file exists, so that an interrupt cannot miss it.
    interrupt::stage(&staged);
    let created = OpenOptions::new().write(true).create_new(true).open(&staged).and_then(|file| {
        existing.map_or(Ok(()), |meta| file.set_permissions(meta.permissions()))?;
        Ok(To::Staged { file, target })
    });
    created.inspect_err(|_| interrupt::discard())
}

#[cfg(test)]
mod tests {
    use super::*;

    // A single test, as a process has only one staged file.
    #[test]
    fn file_appears_only_when_it_is_finished() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.glb");
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
        output.finish().unwrap();
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
