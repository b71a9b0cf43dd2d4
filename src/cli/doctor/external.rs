//! Checks outside the process: addresses, store, broker, folder of structures, remote archive.

use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::time::Duration;

use molmesh::archive::Archive;
use molmesh::config::Config;
use molmesh::http::check_broker;
use molmesh::memory_budget::Budget;
use molmesh::store::{self, Folder, FolderLock, Store};
use molmesh::structure::{self, EntryId};

use super::checks::Check;
use super::page::size;

/// Maximum number of entries to count: several times the whole archive.
const MAX_ENTRIES: usize = 1_000_000;
/// Entry that is requested from a remote archive.
const ENTRY: &str = "4pti";

/// Checks that the addresses can be listened on. Both stay bound until the end, which detects an address given twice.
pub(super) fn listeners(config: &Config) -> Vec<Check> {
    let mut held = Vec::new();
    let mut check = |name: &'static str, addr: SocketAddr| match TcpListener::bind(addr) {
        Ok(listener) => {
            held.push(listener);
            let port = if addr.port() == 0 { ", any port" } else { "" };
            Check::ok(name, format!("{addr} is free{port}"))
        }
        Err(error) => Check::failed(name, format!("cannot listen on {addr} (server.{name}): {error}")),
    };
    let service = check("listen", config.server.listen);
    let metrics = config.server.metrics_listen.map(|addr| check("metrics_listen", addr));
    [service].into_iter().chain(metrics).collect()
}

/// Reports another service that uses the data folder; `None` if there is none.
pub(super) fn data_dir(config: &Config) -> Option<Check> {
    let error = FolderLock::check(&config.server.data_dir).err()?;
    Some(Check::failed("data_dir", error.to_string()))
}

/// Returns the size of the volume of the data folder, or of the folder that it will be created in, bytes.
#[cfg(target_os = "linux")]
pub(super) fn volume(config: &Config) -> Option<u64> {
    let folder = std::path::absolute(&config.server.data_dir).ok()?;
    let volume = folder.ancestors().find_map(|folder| rustix::fs::statvfs(folder).ok())?;
    volume.f_blocks.checked_mul(volume.f_frsize)
}

#[cfg(not(target_os = "linux"))]
pub(super) fn volume(_config: &Config) -> Option<u64> {
    None
}

/// Checks that the store can be opened, written, read and listed, and that none of its job records is in quarantine.
/// Reports its content.
pub(super) async fn store(config: &Config, limit: Duration) -> Vec<Check> {
    // Dropped last.
    let _created = CreatedFolders::before(config.store.url.is_none().then_some(config.server.data_dir.as_path()));
    match tokio::time::timeout(limit, Store::open(&config.store, &config.server.data_dir)).await {
        Ok(Ok(store)) => vec![content(config, &store), records(&store).await],
        Ok(Err(error)) => vec![Check::failed("store", error.to_string())],
        Err(_elapsed) => {
            let location = config.store.url.clone().unwrap_or_else(|| config.server.data_dir.display().to_string());
            vec![Check::failed("store", format!("{location} does not answer within {} ms", limit.as_millis()))]
        }
    }
}

fn content(config: &Config, store: &Store) -> Check {
    let usage = Folder::ALL.map(|folder| (folder, store.usage(folder)));
    let bytes: u64 = usage.iter().map(|(_, usage)| usage.bytes).sum();
    let held: Vec<_> = usage.iter().map(|(folder, usage)| format!("{} {}", usage.objects, folder.as_str())).collect();
    let (location, most) = (store.location(), size(config.store.max_bytes));
    let detail = format!("{location} can be written and read; {}, {} of {most}", held.join(", "), size(bytes));
    match store::link_of(&config.server.data_dir).filter(|_| config.store.url.is_none()) {
        None => Check::ok("store", detail),
        Some(target) => {
            let link = format!("; it is a symbolic link to {}, where objects are removed", target.display());
            Check::warning("store", detail + &link)
        }
    }
}

async fn records(store: &Store) -> Check {
    match store.quarantined().await {
        Ok(0) => Check::ok("records", "no job record is in quarantine"),
        Ok(n) => Check::failed("records", format!("{n} job records cannot be read and are in quarantine")),
        Err(error) => Check::failed("records", error.to_string()),
    }
}

/// Checks that the broker answers; `None` without a broker.
pub(super) async fn broker(config: &Config, limit: Duration) -> Option<Check> {
    let url = config.broker.url.as_deref()?;
    let answer = tokio::time::timeout(limit, check_broker(&config.broker, url)).await;
    Some(match answer.unwrap_or_else(|_elapsed| Err(format!("no answer within {} ms", limit.as_millis()))) {
        Ok(()) => Check::ok("broker", "the NATS server answers and offers JetStream"),
        Err(why) => Check::failed("broker", format!("jobs cannot be dispatched (broker.url): {why}")),
    })
}

/// Guard that removes the folders that a check created, if they are still empty.
struct CreatedFolders(Option<PathBuf>);

impl CreatedFolders {
    /// Records the part of `path` that does not exist yet.
    fn before(path: Option<&Path>) -> Self {
        let missing = |path: &&Path| !path.as_os_str().is_empty() && !path.exists();
        Self(path.and_then(|path| path.ancestors().take_while(missing).last().map(Path::to_owned)))
    }
}

impl Drop for CreatedFolders {
    fn drop(&mut self) {
        if let Some(path) = &self.0 {
            remove_empty(path);
        }
    }
}

/// Removes a folder that contains nothing but empty folders. Ignores errors.
fn remove_empty(path: &Path) {
    for entry in std::fs::read_dir(path).into_iter().flatten().flatten() {
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            remove_empty(&entry.path());
        }
    }
    drop(std::fs::remove_dir(path));
}

/// Checks the folder of structures and counts its entries.
pub(super) fn archive(config: &Config) -> Check {
    let dir = config.archive_dir();
    let name = dir.display();
    if config.archive.dir.is_none() && !dir.exists() {
        return Check::ok("archive", format!("none: there is no folder {name}"));
    }
    let survey = match structure::survey(&dir, MAX_ENTRIES) {
        Ok(survey) => survey,
        Err((path, error)) => {
            let detail = format!("{} cannot be listed, so entries are missing: {error}", path.display());
            return Check::warning("archive", detail);
        }
    };
    let Some(first) = &survey.first else {
        return Check::warning("archive", format!("{name} contains no entry: no file has a name like 4pti.cif"));
    };
    let more = if survey.more { "or more " } else { "" };
    match structure::Archive::new(&dir).stamp(first) {
        Ok(Some(_)) => Check::ok("archive", format!("{name} contains {} {more}entries", survey.entries)),
        Ok(None) => {
            let why = "its path has no supported layout, or it is a link that leads out of the folder";
            Check::warning("archive", format!("{name} contains {}, but {why}", first.as_str()))
        }
        Err(error) => {
            let why = std::error::Error::source(&error).map_or_else(|| error.to_string(), ToString::to_string);
            Check::warning("archive", format!("{name} contains {first}, which cannot be opened: {why}"))
        }
    }
}

/// Checks that every host of the remote archive answers.
pub(super) async fn remote(config: &Config, limit: Duration) -> Vec<Check> {
    let Ok(id) = ENTRY.parse::<EntryId>() else { return Vec::new() };
    let check = |(host, answer): (String, Result<u16, String>)| match answer {
        // A working host may lack the entry or reject the method.
        Ok(status @ (200..=399 | 404 | 405 | 410)) => {
            Check::ok("remote", format!("{host} answers ({status} for {id})"))
        }
        Ok(status) => Check::warning("remote", format!("{host} answers {status} for {id}")),
        Err(why) => Check::warning("remote", format!("the request to {host} failed: {why}")),
    };
    Archive::new(config, Budget::unlimited()).reach(&id, limit).await.into_iter().map(check).collect()
}
