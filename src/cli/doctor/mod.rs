//! `molmesh doctor`: reports the machine and its devices, which are used and why, and checks that a service with this
//! configuration would start and be ready.

mod checks;
mod external;
mod machine;
mod page;

use std::time::Duration;

use molmesh::config::{Config, Loaded};
use molmesh::pipeline::SelectedBackend;
use molmesh::surface::FoundDevice;
use serde_json::{Value, json};

use super::args::{DoctorArgs, TextOrJson};
use super::backend::{self, BackendRequest};
use super::error::CliError;
use super::report::json_text;
use super::style::Style;
use super::survey::{self, Availability};
use checks::{Check, CheckResult};
use machine::Machine;

/// Results of the command.
struct Findings {
    machine: Machine,
    loaded: Loaded,
    backends: Vec<Availability>,
    devices: Vec<FoundDevice>,
    /// Name of the selected backend and the reason.
    taken: Option<(&'static str, String)>,
    checks: Vec<Check>,
}

/// Runs the command.
pub(super) fn run(args: &DoctorArgs) -> Result<(), CliError> {
    let limit = super::healthcheck::timeout(args.timeout)?;
    let loaded = super::config::load(&args.serve)?;
    let findings = examine(args, loaded, limit)?;
    super::print(&match args.report {
        TextOrJson::Text => page::text(&findings, Style::stdout()),
        TextOrJson::Json => json_text(&findings.document()),
    })?;
    let failed: Vec<_> = findings.checks.iter().filter(|c| c.state == CheckResult::Failed).map(|c| c.name).collect();
    if failed.is_empty() {
        return Ok(());
    }
    Err(CliError::Unfit { backend: failed.contains(&checks::DEVICES), failed })
}

fn examine(args: &DoctorArgs, loaded: Loaded, limit: Duration) -> Result<Findings, CliError> {
    let machine = Machine::detect();
    let config: Config = loaded.config.clone();
    let mut checks = vec![checks::sources(args.serve.config.as_deref(), &loaded), checks::log(&config)];
    checks.extend(checks::warnings(&loaded));
    // The same steps as in a service: query all drivers, build the pipelines of the selected devices, make a mesh.
    let (mut backends, mut devices, mut taken) = (Vec::new(), Vec::new(), None);
    match backend::select(&BackendRequest::for_service(args.serve.backend, &config.devices)) {
        Ok(selected) => {
            backends = survey::backends(&selected);
            let SelectedBackend { backend, reason, devices: found, .. } = selected;
            checks.push(checks::first_mesh(backend.as_ref()));
            let n_devices = backend.devices().len();
            checks.push(checks::memory(&machine, &loaded, n_devices));
            (devices, taken) = (found, Some((backend.name(), reason)));
        }
        Err(error @ CliError::NoBackend { .. }) => {
            checks.push(Check::failed(checks::DEVICES, error.to_string()));
            checks.push(checks::memory(&machine, &loaded, 0));
        }
        Err(error) => return Err(error),
    }
    checks.extend(checks::files(&machine, &config));
    checks.extend(external::listeners(&config));
    checks.extend(external::data_dir(&config));
    checks.extend(checks::volume(external::volume(&config), &config));
    let failed = |e: std::io::Error| CliError::Service(format!("cannot start the runtime: {e}"));
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().map_err(failed)?;
    checks.extend(runtime.block_on(external::store(&config, limit)));
    checks.extend(runtime.block_on(external::broker(&config, limit)));
    checks.push(external::archive(&config));
    checks.extend(runtime.block_on(external::remote(&config, limit)));
    // Do not wait for requests that are still unanswered.
    runtime.shutdown_background();
    Ok(Findings { machine, loaded, backends, devices, taken, checks })
}

impl Findings {
    /// Returns the findings as JSON.
    fn document(&self) -> Value {
        let backend = |candidate: &Availability| {
            let (ok, detail) = match &candidate.state {
                Ok(device) => (true, device),
                Err(why) => (false, why),
            };
            json!({ "name": candidate.name, "ok": ok, "detail": detail })
        };
        let device = |device: &FoundDevice| {
            let facts = &device.facts;
            json!({
                "number": device.number, "taken": device.selected, "reason": device.reason, "name": facts.name,
                "kind": facts.kind.name(), "api": facts.api, "driver": facts.driver,
                "binding_bytes": facts.binding_bytes, "buffer_bytes": facts.buffer_bytes,
                "workgroup_bytes": facts.workgroup_bytes, "timestamps": facts.timestamps, "subgroups": facts.subgroups,
            })
        };
        let configuration = self.loaded.to_json();
        json!({
            "ok": self.checks.iter().all(|check| check.state != CheckResult::Failed),
            "molmesh": {
                "version": env!("CARGO_PKG_VERSION"), "gpu": cfg!(feature = "gpu"),
                "target": machine::TARGET, "compiler": machine::COMPILER,
            },
            "machine": self.machine.document(),
            "backends": self.backends.iter().map(backend).collect::<Vec<_>>(),
            "devices": self.devices.iter().map(device).collect::<Vec<_>>(),
            "backend": self.taken.as_ref().map(|(name, reason)| json!({ "name": name, "reason": reason })),
            "checks": self.checks,
            "config": configuration["config"],
            "sources": configuration["sources"],
        })
    }
}
