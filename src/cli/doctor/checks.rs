//! [`Check`], and the checks that access nothing outside the process.

use std::path::Path;
use std::time::Instant;

use molmesh::config::{Config, Loaded, Source};
use molmesh::surface::Backend;
use molmesh::telemetry;

use super::machine::Machine;
use super::page::size;

/// Name of the backend check, whose failure has its own exit code.
pub(super) const DEVICES: &str = "devices";

/// Result of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum State {
    /// Passed.
    Ok,
    /// A service would start and be ready, but the operator should know.
    Warning,
    /// A service would not start or not be ready.
    Failed,
}

impl State {
    /// Returns the name in JSON.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warning => "warning",
            Self::Failed => "failed",
        }
    }
}

/// A check with its result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Check {
    /// Name.
    pub(super) name: &'static str,
    /// Result.
    pub(super) state: State,
    /// Finding as text.
    pub(super) detail: String,
}

impl Check {
    /// Creates a check.
    pub(super) fn new(name: &'static str, state: State, detail: impl Into<String>) -> Self {
        Self { name, state, detail: detail.into() }
    }
}

/// Reports the sources of the configuration. An invalid configuration has already ended the command.
pub(super) fn sources(file: Option<&Path>, loaded: &Loaded) -> Check {
    let (mut from_file, mut variables, mut flags) = (0, Vec::new(), 0);
    for (_, source) in loaded.sources() {
        match source {
            Source::Default => {}
            Source::File { .. } => from_file += 1,
            Source::Environment { variable } => variables.push(variable.as_str()),
            Source::Flag => flags += 1,
        }
    }
    let file = file.map_or("no file".to_owned(), |file| format!("{} ({from_file} in effect)", file.display()));
    let variables = if variables.is_empty() { "no variable".to_owned() } else { variables.join(" ") };
    Check::new("config", State::Ok, format!("{file}; {variables}; {flags} from the command line"))
}

/// Reports the warnings of the configuration: readable secret files, misspelt variables.
pub(super) fn warnings(loaded: &Loaded) -> impl Iterator<Item = Check> {
    loaded.warnings.iter().map(|warning| Check::new("warnings", State::Warning, warning.clone()))
}

/// Checks the log filter.
pub(super) fn log(config: &Config) -> Check {
    match telemetry::check_logs(&config.log) {
        Ok(()) => Check::new("log", State::Ok, format!("`{}`, to stderr", config.log.filter)),
        Err(error) => Check::new("log", State::Failed, error.to_string()),
    }
}

/// Makes a first mesh, as a service does before it is ready.
pub(super) fn first_mesh(backend: &dyn Backend) -> Check {
    let start = Instant::now();
    match backend.warm_up() {
        Ok(()) => {
            let ms = start.elapsed().as_secs_f64() * 1e3;
            Check::new(DEVICES, State::Ok, format!("{} made a first mesh in {ms:.1} ms", backend.name()))
        }
        Err(error) => Check::new(DEVICES, State::Failed, format!("{} cannot make a mesh: {error}", backend.name())),
    }
}

/// Checks that the memory budgets fit into the memory.
pub(super) fn memory(machine: &Machine, config: &Config, workers: usize, devices: usize) -> Check {
    let (limits, archive) = (&config.limits, &config.archive);
    let [workers, devices] = [workers, devices].map(|n| u64::try_from(n).unwrap_or(u64::MAX));
    let fetches = if archive.url.is_some() { archive.concurrent as u64 } else { 0 };
    let parts = [
        ("limits.memory_bytes", limits.memory_bytes),
        ("meshes of jobs", limits.mesh_bytes.saturating_mul(workers)),
        ("readback buffers", config.devices.readback_bytes.saturating_mul(devices)),
        ("store.memory_bytes", config.store.memory_bytes),
        ("fetched entries", archive.max_bytes.saturating_mul(fetches)),
    ];
    let most = parts.iter().fold(0_u64, |sum, (_, bytes)| sum.saturating_add(*bytes));
    let sum: Vec<String> = parts.iter().map(|(name, bytes)| format!("{} {name}", size(*bytes))).collect();
    let budget = format!("{} at most ({})", size(most), sum.join(", "));
    match machine.memory() {
        None => Check::new("memory", State::Ok, format!("{budget}; the memory size is unknown")),
        Some((bytes, owner)) if most > bytes => {
            let detail = format!("{budget} exceed the {} of {owner}: the system may kill the process", size(bytes));
            Check::new("memory", State::Warning, detail)
        }
        Some((bytes, owner)) => Check::new("memory", State::Ok, format!("{budget}, of {} of {owner}", size(bytes))),
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
        Check::new("open files", State::Warning, detail)
    } else {
        Check::new("open files", State::Ok, sum)
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
        let detail = format!("{} at most ({sum}) exceed the volume of {}: it will be full", size(most), size(volume));
        Check::new("volume", State::Warning, detail)
    } else {
        Check::new("volume", State::Ok, format!("{} at most ({sum}), of {}", size(most), size(volume)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stored_data_must_fit_the_volume() {
        let mut config = Config::default();
        (config.store.max_bytes, config.archive.cache_bytes) = (1000, 100);
        let state = |bytes, config: &Config| volume(Some(bytes), config).unwrap().state;
        assert_eq!((state(1100, &config), state(1099, &config)), (State::Ok, State::Warning));
        config.archive.url = None;
        assert_eq!((state(1000, &config), state(999, &config)), (State::Ok, State::Warning));
        config.store.url = Some("s3://bucket".to_owned());
        assert_eq!(state(0, &config), State::Ok, "the store is elsewhere");
        assert_eq!(volume(None, &config), None);
    }

    #[test]
    fn connections_need_open_files() {
        let mut config = Config::default();
        config.server.connections = 1000;
        let state = |most| files(&Machine { files: Some([10, most]), ..Machine::default() }, &config).unwrap().state;
        assert_eq!((state(1128), state(1127)), (State::Ok, State::Warning));
        assert_eq!(files(&Machine::default(), &config), None);
    }

    #[test]
    fn budgets_above_the_memory_are_a_warning() {
        let mut config = Config::default();
        config.limits.memory_bytes = 1 << 30;
        config.limits.mesh_bytes = 1 << 20;
        config.store.memory_bytes = 1 << 20;
        config.devices.readback_bytes = 1 << 20;
        config.archive.url = None;
        let machine = |limit| Machine { limit, ..Machine::default() };
        let state = |limit| memory(&machine(limit), &config, 2, 1).state;
        let enough = (1 << 30) + (4 << 20);
        assert_eq!(state(Some((enough, "this control group"))), State::Ok);
        assert_eq!(state(Some((enough - 1, "this control group"))), State::Warning);
        assert_eq!(state(None), State::Ok);
        let detail = memory(&machine(Some((enough - 1, "this control group"))), &config, 2, 1).detail;
        assert!(detail.contains("1028MiB at most") && detail.contains("this control group"), "{detail}");
    }
}
