//! NATS servers for tests, installed by `tests/tools/setup.sh`.
#![allow(dead_code, reason = "each test binary uses a part")]

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use tempfile::TempDir;

/// Returns the installed servers: the oldest supported version and a recent one. CI has both; elsewhere the tests run
/// without those that are missing.
pub(crate) fn programs() -> Vec<PathBuf> {
    let tools = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/test-tools");
    let all = [tools.join("nats-server"), tools.join("venv/bin/nats-server")];
    let (found, missing): (Vec<_>, Vec<_>) = all.into_iter().partition(|program| program.exists());
    for program in missing {
        assert!(std::env::var_os("CI").is_none(), "{} is missing; run tests/tools/setup.sh", program.display());
        let skipped = format!("SKIPPED: {} is missing; run tests/tools/setup.sh\n", program.display());
        std::io::stdout().write_all(skipped.as_bytes()).unwrap();
    }
    found
}

/// Server with its data in a temporary folder.
pub(crate) struct NatsServer {
    program: PathBuf,
    folder: TempDir,
    child: Option<Child>,
    address: String,
}

impl NatsServer {
    /// Starts a server on a free port.
    pub(crate) fn start(program: &Path) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let child = Some(Self::spawn(program, folder.path(), "-1"));
        let begun = Instant::now();
        let address = loop {
            assert!(begun.elapsed() < Duration::from_secs(20), "the server does not start");
            std::thread::sleep(Duration::from_millis(20));
            let ports = std::fs::read_dir(folder.path()).unwrap().flatten().map(|entry| entry.path());
            let ports = ports.filter(|path| path.extension().is_some_and(|extension| extension == "ports"));
            let text = ports.last().and_then(|path| std::fs::read_to_string(path).ok()).unwrap_or_default();
            let document: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
            if let Some(address) = document["nats"][0].as_str() {
                break address.to_owned();
            }
        };
        Self { program: program.to_owned(), folder, child, address }
    }

    fn spawn(program: &Path, folder: &Path, port: &str) -> Child {
        let mut command = Command::new(program);
        command.args(["-js", "-a", "127.0.0.1", "-p", port, "-sd"]).arg(folder.join("data"));
        command.arg("--ports_file_dir").arg(folder).stdout(Stdio::null()).stderr(Stdio::null());
        command.spawn().unwrap()
    }

    /// Returns the URL of the server.
    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    /// Kills the server. Removes its data unless `keeps_data`.
    pub(crate) fn stop(&mut self, keeps_data: bool) {
        if let Some(mut child) = self.child.take() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
        if !keeps_data {
            std::fs::remove_dir_all(self.folder.path().join("data")).unwrap();
        }
    }

    /// Starts a stopped server again, at the same address.
    pub(crate) fn restart(&mut self) {
        let port = self.address.rsplit(':').next().unwrap();
        self.child = Some(Self::spawn(&self.program, self.folder.path(), port));
    }
}

impl Drop for NatsServer {
    fn drop(&mut self) {
        self.stop(true);
    }
}
