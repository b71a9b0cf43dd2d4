//! NATS servers for tests, installed by `tests/tools/setup.sh`.
#![allow(dead_code, reason = "each test binary uses a part")]

use std::fs::OpenOptions;
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::TcpStream;
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

/// Number of lines of the log that a failing test prints.
const LOG_LINES: usize = 60;

/// Server with its data and its log in a temporary folder. A test that panics prints the end of the log.
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
        let log = OpenOptions::new().create(true).append(true).open(folder.join("log")).unwrap();
        let mut command = Command::new(program);
        command.args(["-js", "-a", "127.0.0.1", "-p", port, "-sd"]).arg(folder.join("data"));
        command.arg("--ports_file_dir").arg(folder).stdout(Stdio::null()).stderr(log);
        command.spawn().unwrap()
    }

    /// Prints the state of the server, and the end of its log or the start of the report of its crash.
    fn explain(&mut self) {
        let ended = self.child.as_mut().map(Child::try_wait);
        let log = std::fs::read(self.folder.path().join("log")).unwrap_or_default();
        let log = String::from_utf8_lossy(&log);
        let lines: Vec<_> = log.lines().collect();
        let is_crash = |line: &&str| ["panic:", "fatal error:", "SIG"].iter().any(|start| line.starts_with(start));
        let begin = lines.iter().position(is_crash).unwrap_or(lines.len().saturating_sub(LOG_LINES));
        let shown = &lines[begin..lines.len().min(begin + LOG_LINES)];
        let text = format!("{}, ended: {ended:?}, log:\n{}\n", self.program.display(), shown.join("\n"));
        drop(std::io::stdout().write_all(text.as_bytes()));
    }

    /// Returns the URL of the server.
    pub(crate) fn address(&self) -> &str {
        &self.address
    }

    /// Sends a request to JetStream, such as `STREAM.INFO.molmesh-jobs`, and returns the answer.
    pub(crate) fn jetstream(&self, request: &str) -> String {
        let mut connection = TcpStream::connect(self.address.trim_start_matches("nats://")).unwrap();
        connection.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
        let inbox = format!("answer.{}", connection.local_addr().unwrap().port());
        let connect = "CONNECT {\"verbose\":false}";
        write!(connection, "{connect}\r\nSUB {inbox} 1\r\nPUB $JS.API.{request} {inbox} 0\r\n\r\n").unwrap();
        let answer = BufReader::new(connection).lines().map(Result::unwrap).find(|line| line.starts_with('{')).unwrap();
        assert!(!answer.contains("\"error\""), "{request}: {answer}");
        answer
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
        if std::thread::panicking() {
            self.explain();
        }
        self.stop(true);
    }
}
