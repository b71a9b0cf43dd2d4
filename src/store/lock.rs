//! Lock of a data folder, so that only one service writes to it.
//!
//! The operating system holds the lock for the open file and releases it when the process ends, however it ends. The
//! text in the file only describes the holder.

use std::fmt;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read as _, Write as _};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Creates a folder and those above it, so that they survive a power failure.
pub(super) fn create_folder(folder: &Path) -> io::Result<()> {
    let Some(parent) = folder.parent().filter(|_| !folder.is_dir()) else { return Ok(()) };
    create_folder(parent)?;
    match std::fs::create_dir(folder) {
        // Another process may have created it.
        Err(error) if !folder.is_dir() => Err(error),
        _ => sync_folder(parent),
    }
}

/// Makes the entries of a folder durable.
pub(super) fn sync_folder(folder: &Path) -> io::Result<()> {
    // The parent of a relative path with one component is empty.
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    #[cfg(unix)]
    File::open(folder)?.sync_all()?;
    Ok(())
}

/// Name of the lock file in a data folder.
const FILE: &str = "lock";
/// Largest description of a holder that is read, bytes.
const MAX_HOLDER_BYTES: u64 = 4096;

/// Errors of locking a data folder.
#[derive(Debug, Error)]
pub enum LockError {
    /// Another service holds the lock.
    #[error("the data folder {} (server.data_dir) is in use by {holder}", folder.display())]
    Held {
        /// Data folder.
        folder: PathBuf,
        /// Description of the other service.
        holder: String,
    },
    /// The folder cannot be created, or its lock file cannot be opened or locked.
    #[error("cannot lock the data folder {} (server.data_dir): {error}", folder.display())]
    Io {
        /// Data folder.
        folder: PathBuf,
        /// Error of the operating system.
        error: io::Error,
    },
}

/// Service that holds a lock, as described in the lock file.
#[derive(Debug, Serialize, Deserialize)]
struct Holder {
    pid: u32,
    /// Host name; absent if the operating system does not provide it.
    host: Option<String>,
    address: SocketAddr,
    /// Start time, RFC 3339.
    started: String,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { pid, host, address, started } = self;
        write!(f, "another molmesh service: pid {pid}")?;
        if let Some(host) = host {
            write!(f, " on host {host}")?;
        }
        write!(f, ", listening on {address}, started {started}")
    }
}

/// Exclusive use of a data folder, until it is dropped.
#[derive(Debug)]
pub struct FolderLock {
    _file: File,
}

impl FolderLock {
    /// Locks `folder`, creating it if necessary, and records this process and `address` in the lock file.
    ///
    /// # Errors
    /// Returns [`LockError::Held`] if another service uses the folder.
    pub fn acquire(folder: &Path, address: SocketAddr) -> Result<Self, LockError> {
        let failed = |error| LockError::Io { folder: folder.to_owned(), error };
        create_folder(folder).map_err(failed)?;
        let open = open(OpenOptions::new().read(true).write(true).create(true).truncate(false), folder);
        let mut file = open.map_err(failed)?;
        lock(&mut file, folder)?;
        let started = humantime::format_rfc3339_seconds(SystemTime::now()).to_string();
        let holder = Holder { pid: std::process::id(), host: host(), address, started };
        let text = serde_json::to_vec(&holder).map_err(|error| failed(error.into()))?;
        file.set_len(0).and_then(|()| file.write_all(&text)).map_err(failed)?;
        Ok(Self { _file: file })
    }

    /// Checks that the lock of `folder` is free, without creating anything.
    ///
    /// # Errors
    /// Returns [`LockError::Held`] if a service uses the folder.
    pub fn check(folder: &Path) -> Result<(), LockError> {
        match open(OpenOptions::new().read(true), folder) {
            Ok(mut file) => lock(&mut file, folder),
            // A folder that cannot be opened is reported when the store in it is opened.
            Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => Ok(()),
            Err(error) => Err(LockError::Io { folder: folder.to_owned(), error }),
        }
    }
}

/// Opens the lock file of a folder. Refuses a symbolic link, which may lead to a file of another program, a folder and
/// special files, such as a pipe, whose opening may wait.
fn open(options: &mut OpenOptions, folder: &Path) -> io::Result<File> {
    let file = folder.join(FILE);
    let wrong = |found: &str| Err(io::Error::other(format!("its file `lock` is {found}; remove it")));
    match file.symlink_metadata() {
        Ok(found) if found.is_symlink() => return wrong("a symbolic link"),
        Ok(found) if found.is_dir() => return wrong("a folder"),
        Ok(found) if !found.is_file() => return wrong("a pipe, socket or device"),
        Ok(_) | Err(_) => {}
    }
    // Such a file may be created between the two calls.
    #[cfg(target_os = "linux")]
    {
        let flags = rustix::fs::OFlags::NOFOLLOW | rustix::fs::OFlags::NONBLOCK;
        std::os::unix::fs::OpenOptionsExt::custom_flags(options, flags.bits().cast_signed());
    }
    options.open(file)
}

/// Locks an open lock file, or returns its holder in the error.
fn lock(file: &mut File, folder: &Path) -> Result<(), LockError> {
    match file.try_lock() {
        Ok(()) => Ok(()),
        Err(TryLockError::WouldBlock) => {
            let mut text = String::new();
            let read = file.take(MAX_HOLDER_BYTES).read_to_string(&mut text);
            let holder: Option<Holder> = read.ok().and_then(|_bytes| serde_json::from_str(&text).ok());
            // The other service may not have written its description yet.
            let holder = holder.map_or_else(|| "another process".to_owned(), |holder| holder.to_string());
            Err(LockError::Held { folder: folder.to_owned(), holder })
        }
        Err(TryLockError::Error(error)) => Err(LockError::Io { folder: folder.to_owned(), error }),
    }
}

/// Returns the name of this host; `None` on systems other than Linux.
fn host() -> Option<String> {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").ok()?;
    Some(name.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_has_one_holder_at_a_time() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("data");
        let address = "127.0.0.1:8080".parse().unwrap();
        FolderLock::check(&folder).unwrap();
        assert!(!folder.exists(), "a check creates nothing");
        let lock = FolderLock::acquire(&folder, address).unwrap();
        let held = [FolderLock::acquire(&folder, address).map(drop), FolderLock::check(&folder)];
        for refused in held {
            let message = refused.unwrap_err().to_string();
            let pid = format!("pid {}", std::process::id());
            for part in [folder.to_str().unwrap(), "server.data_dir", &pid, "127.0.0.1:8080", "started 20"] {
                assert!(message.contains(part), "no `{part}` in {message}");
            }
        }
        drop(lock);
        FolderLock::check(&folder).unwrap();
        drop(FolderLock::acquire(&folder, address).unwrap());
    }

    #[test]
    #[cfg(unix)]
    fn a_symbolic_link_is_not_followed() {
        let dir = tempfile::tempdir().unwrap();
        let (folder, other) = (dir.path().join("data"), dir.path().join("other"));
        std::fs::create_dir(&folder).unwrap();
        let link = folder.join(FILE);
        for exists in [false, true] {
            if exists {
                std::fs::write(&other, "of another program").unwrap();
            }
            std::os::unix::fs::symlink(&other, &link).unwrap();
            let mut results = vec![FolderLock::acquire(&folder, "127.0.0.1:1".parse().unwrap()).map(drop)];
            if exists {
                results.push(FolderLock::check(&folder));
            }
            for result in results {
                let message = result.unwrap_err().to_string();
                assert!(message.contains("`lock` is a symbolic link"), "{message}");
            }
            assert_eq!(
                std::fs::read(&other).unwrap_or_default(),
                if exists { &b"of another program"[..] } else { b"" }
            );
            assert_eq!(other.exists(), exists);
            std::fs::remove_file(&link).unwrap();
        }
        drop(FolderLock::acquire(&folder, "127.0.0.1:1".parse().unwrap()).unwrap());
    }

    #[test]
    #[cfg(unix)]
    fn a_folder_or_a_pipe_is_no_lock_file() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join(FILE);
        let refused = |what: &str| {
            let address = "127.0.0.1:1".parse().unwrap();
            for result in [FolderLock::acquire(dir.path(), address).map(drop), FolderLock::check(dir.path())] {
                let message = result.unwrap_err().to_string();
                assert!(message.ends_with(&format!("its file `lock` is {what}; remove it")), "{message}");
            }
        };
        std::fs::create_dir(&file).unwrap();
        refused("a folder");
        std::fs::remove_dir(&file).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&file).status().unwrap().success());
        refused("a pipe, socket or device");
        std::fs::remove_file(&file).unwrap();
        drop(FolderLock::acquire(dir.path(), "127.0.0.1:1".parse().unwrap()).unwrap());
    }

    #[test]
    fn a_lock_file_without_a_description_still_locks() {
        let dir = tempfile::tempdir().unwrap();
        let file = File::create(dir.path().join(FILE)).unwrap();
        file.lock().unwrap();
        let refused = FolderLock::acquire(dir.path(), "127.0.0.1:1".parse().unwrap()).unwrap_err();
        assert!(refused.to_string().ends_with("in use by another process"), "{refused}");
    }
}
