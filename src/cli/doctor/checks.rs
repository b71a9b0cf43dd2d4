//! [`Check`], and the checks that access nothing outside the process.

use std::path::Path;
use std::time::Instant;

use molmesh::config::{Config, ConfigSource, Loaded, OwnedMemory};
use molmesh::surface::Backend;
use molmesh::telemetry;
use serde::Serialize;

use super::machine::Machine;
use super::page::size;

/// Name of the backend check, whose failure has its own exit code.
pub(super) const DEVICES: &str = "devices";

/// Result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum CheckResult {
    /// Passed.
    Ok,
    /// A service would start and be ready, but may fail later, as the detail explains.
    Warning,
    /// A service would not start or not be ready.
    Failed,
}

/// A check with its result.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(super) struct Check {
    /// Name.
    pub(super) name: &'static str,
    /// Result.
    pub(super) state: CheckResult,
    /// Finding as text.
    pub(super) detail: String,
}

impl Check {
    /// Creates a check that passed.
    pub(super) fn ok(name: &'static str, detail: impl Into<String>) -> Self {
        Self { name, state: CheckResult::Ok, detail: detail.into() }
    }

    /// Creates a check with a warning.
    pub(super) fn warning(name: &'static str, detail: impl Into<String>) -> Self {
        Self { name, state: CheckResult::Warning, detail: detail.into() }
    }

    /// Creates a check that failed.
    pub(super) fn failed(name: &'static str, detail: impl Into<String>) -> Self {
        Self { name, state: CheckResult::Failed, detail: detail.into() }
    }
}

/// Reports the sources of the configuration. An invalid configuration has already ended the command.
pub(super) fn sources(file: Option<&Path>, loaded: &Loaded) -> Check {
    let (mut from_file, mut variables, mut flags) = (0, Vec::new(), 0);
    for (_, source) in loaded.sources() {
        match source {
            ConfigSource::Default | ConfigSource::Memory { .. } => {}
            ConfigSource::File { .. } => from_file += 1,
            ConfigSource::Environment { variable } => variables.push(variable.as_str()),
            ConfigSource::Flag => flags += 1,
        }
    }
    let file = file.map_or("no file".to_owned(), |file| format!("{} ({from_file} in effect)", file.display()));
    let variables = if variables.is_empty() { "no variable".to_owned() } else { variables.join(" ") };
    Check::ok("config", format!("{file}; {variables}; {flags} from the command line"))
}

/// Reports the warnings of the configuration: readable secret files, misspelt variables.
pub(super) fn warnings(loaded: &Loaded) -> impl Iterator<Item = Check> {
    loaded.warnings.iter().map(|warning| Check::warning("warnings", warning.clone()))
}

/// Checks the log filter.
pub(super) fn log(config: &Config) -> Check {
    match telemetry::check_logs(&config.log) {
        Ok(()) => Check::ok("log", format!("`{}`, to stderr", config.log.filter)),
        Err(error) => Check::failed("log", error.to_string()),
    }
}

/// Makes a first mesh, as a service does before it is ready.
pub(super) fn first_mesh(backend: &dyn Backend) -> Check {
    let start = Instant::now();
    match backend.warm_up() {
        Ok(()) => {
            let ms = start.elapsed().as_secs_f64() * 1e3;
            Check::ok(DEVICES, format!("{} made a first mesh in {ms:.1} ms", backend.name()))
        }
        Err(error) => Check::failed(DEVICES, format!("{} cannot make a mesh: {error}", backend.name())),
    }
}

/// Memory of a service outside its budgets: threads, libraries, metrics.
const OTHER_MEMORY: u64 = 256 << 20;

/// Checks that the memory budgets fit into the memory.
pub(super) fn memory(machine: &Machine, loaded: &Loaded, devices: usize) -> Check {
    let config = &loaded.config;
    let devices = u64::try_from(devices).unwrap_or(u64::MAX);
    let budget = match loaded.source("limits.memory_bytes") {
        source @ ConfigSource::Memory { .. } => format!("limits.memory_bytes, {source}"),
        _ => "limits.memory_bytes".to_owned(),
    };
    let parts = [
        (&*budget, config.limits.memory_bytes),
        ("results in memory", config.store.memory_bytes),
        ("readback buffers", config.devices.readback_bytes.saturating_mul(devices)),
        ("others", OTHER_MEMORY),
    ];
    let most = parts.iter().fold(0_u64, |sum, (_, bytes)| sum.saturating_add(*bytes));
    let sum: Vec<String> = parts.iter().map(|(name, bytes)| format!("{} {name}", size(*bytes))).collect();
    let sum = format!("{} at most ({})", size(most), sum.join(", "));
    match machine.memory.least() {
        None => Check::ok("memory", format!("{sum}; the memory size is unknown")),
        Some(OwnedMemory { bytes, owner }) if most > bytes => {
            let detail = format!("{sum} exceed the {} of {owner}: the system may kill the process", size(bytes));
            Check::warning("memory", detail)
        }
        Some(OwnedMemory { bytes, owner }) => Check::ok("memory", format!("{sum}, of {} of {owner}", size(bytes))),
    }
}

/// Files that a service opens in addition to its connections: libraries, devices, the store, requests to an archive.
const OTHER_FILES: u64 = 128;

/// Checks that the limit of open files allows the configured connections.
pub(super) fn files(machine: &Machine, config: &Config) -> Option<Check> {
    let [_, most] = machine.files?;
    let needed = (config.server.connections as u64).saturating_add(OTHER_FILES);
    let sum = format!("{needed} ({} server.connections, {OTHER_FILES} others), of {most}", config.server.connections);
    Some(if needed > most {
        let detail = format!("{sum}: connections will fail under load; raise the limit or lower server.connections");
        Check::warning("open files", detail)
    } else {
        Check::ok("open files", sum)
    })
}

/// Checks that the volume of the data folder, of `volume` bytes, can hold what is stored there.
pub(super) fn volume(volume: Option<u64>, config: &Config) -> Option<Check> {
    let volume = volume?;
    let results = if config.store.url.is_none() { config.store.max_bytes } else { 0 };
    let copies = if config.archive.url.is_some() { config.archive.cache_bytes } else { 0 };
    let most = results.saturating_add(copies);
    let sum = format!("{} store.max_bytes, {} archive.cache_bytes", size(results), size(copies));
    Some(if most > volume {
        let detail = format!("{} at most ({sum}) exceed the volume of {}: it may fill up", size(most), size(volume));
        Check::warning("volume", detail)
    } else {
        Check::ok("volume", format!("{} at most ({sum}), of {}", size(most), size(volume)))
    })
}

#[cfg(test)]
mod tests {
    use molmesh::config::AvailableMemory;

    use super::*;

    #[test]
    fn stored_data_must_fit_the_volume() {
        let mut config = Config::default();
        (config.store.max_bytes, config.archive.cache_bytes) = (1000, 100);
        let state = |bytes, config: &Config| volume(Some(bytes), config).unwrap().state;
        assert_eq!((state(1100, &config), state(1099, &config)), (CheckResult::Ok, CheckResult::Warning));
        config.archive.url = None;
        assert_eq!((state(1000, &config), state(999, &config)), (CheckResult::Ok, CheckResult::Warning));
        config.store.url = Some("s3://bucket".to_owned());
        assert_eq!(state(0, &config), CheckResult::Ok, "the store is elsewhere");
        assert_eq!(volume(None, &config), None);
    }

    #[test]
    fn connections_need_open_files() {
        let mut config = Config::default();
        config.server.connections = 1000;
        let state = |most| files(&Machine { files: Some([10, most]), ..Machine::default() }, &config).unwrap().state;
        assert_eq!((state(1128), state(1127)), (CheckResult::Ok, CheckResult::Warning));
        assert_eq!(files(&Machine::default(), &config), None);
    }

    #[test]
    fn budgets_above_the_memory_are_a_warning() {
        let pairs = [("limits.memory_bytes", "1GiB"), ("devices.readback_bytes", "1MiB")];
        let flags = pairs.map(|(key, value)| (key.to_owned(), value.to_owned()));
        let mut loaded = molmesh::config::load(None, [], &flags).unwrap();
        loaded.config.store.memory_bytes = 1 << 20;
        let check = |limit| {
            let memory = AvailableMemory { limit, machine: None };
            super::memory(&Machine { memory, ..Machine::default() }, &loaded, 1)
        };
        let enough = (1 << 30) + (2 << 20) + OTHER_MEMORY;
        assert_eq!(check(Some(enough)).state, CheckResult::Ok);
        assert_eq!(check(Some(enough - 1)).state, CheckResult::Warning);
        assert_eq!(check(None).state, CheckResult::Ok);
        let detail = check(Some(enough - 1)).detail;
        assert!(detail.contains("1282MiB at most") && detail.contains("this control group"), "{detail}");
    }
}
