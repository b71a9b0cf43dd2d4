//! Leftovers of crashed processes.

use std::io;
use std::path::Path;
use std::time::{Duration, SystemTime};

use super::backend::CHECK;
use super::name::Folder;

/// Age at which unfinished objects are abandoned; no job takes that long. Younger ones may belong to another process,
/// as during a rolling restart.
pub(super) const STALE: Duration = Duration::from_hours(1);

/// Returns true if an unfinished object last written at `written` is abandoned at `now`.
pub(super) fn is_stale(written: SystemTime, now: SystemTime) -> bool {
    now.duration_since(written).is_ok_and(|age| age >= STALE)
}

/// Removes abandoned staged files of the store in `root`. Their name is that of the object, with `#` and a number.
/// Blocks.
pub(super) fn clear_files(root: &Path, now: SystemTime) -> io::Result<u64> {
    let mut removed = 0;
    for folder in Folder::ALL.map(Folder::as_str).into_iter().chain([CHECK]) {
        for entry in std::fs::read_dir(root.join(folder))? {
            let entry = entry?;
            let name = entry.file_name();
            let staged = name.to_str().and_then(|name| name.rsplit_once('#'));
            if !staged.is_some_and(|(_, count)| count.bytes().all(|c| c.is_ascii_digit())) {
                continue;
            }
            // Another process may have finished or removed it.
            let Ok(written) = entry.metadata().and_then(|meta| meta.modified()) else { continue };
            if is_stale(written, now) {
                match std::fs::remove_file(entry.path()) {
                    Err(e) if e.kind() != io::ErrorKind::NotFound => return Err(e),
                    _ => removed += 1,
                }
            }
        }
    }
    Ok(removed)
}
