//! A running `molmesh serve`.

use std::fs::File;
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use super::client::Client;
use crate::error::{Error, Result};

/// Maximum time until a service is ready.
const MAX_START: Duration = Duration::from_mins(1);

/// Service in its own process, with its own folder. Dropping it ends the process and removes the folder.
pub(super) struct Service {
    child: Child,
    folder: PathBuf,
    /// Address.
    pub(super) addr: SocketAddr,
}

impl Service {
    /// Starts a service on a free port and waits until it is ready: it has meshed once and, with several backends,
    /// measured them. Its log is written to `BACKEND.log` in the folder `logs`, if that is given.
    ///
    /// # Errors
    /// [`Error::File`] if the binary cannot be started, [`Error::Failed`] with its messages if it ends.
    pub(super) fn start(binary: &Path, backend: &str, more: &[String], logs: Option<&Path>) -> Result<Self> {
        let folder = std::env::temp_dir().join(format!("molmesh-bench-{}-{backend}", std::process::id()));
        let mut child = Command::new(binary)
            .args(["serve", "--listen", "127.0.0.1:0", "--backend", backend, "--data-dir"])
            .arg(&folder)
            .args([
                "--set",
                "archive.url=none",
                "--set",
                "server.metrics_listen=none",
                "--set",
                "server.client_share=1",
            ])
            .args(["--set", "server.termination_notice_ms=none"])
            .args(more)
            .stdin(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(Error::file(binary))?;
        let lines = child.stderr.take().map(|stderr| BufReader::new(stderr).lines());
        let mut lines = lines.ok_or_else(|| Error::failed("the service has no standard error"))?;
        let (mut said, mut addr) = (String::new(), None);
        // The address stands in the banner, whose last line begins with `try`.
        for line in lines.by_ref().map_while(std::result::Result::ok) {
            addr = addr.or_else(|| line.split_once("http://")?.1.trim_end_matches('/').parse().ok());
            if line.trim_start().starts_with("try ") {
                break;
            }
            said.extend([line.as_str(), "\n"]);
        }
        let log = logs.map(|folder| folder.join(format!("{backend}.log")));
        let mut log = log.map(|path| File::create(&path).map_err(Error::file(&path))).transpose()?;
        // A full pipe would block the service.
        std::thread::spawn(move || {
            for line in lines.map_while(std::result::Result::ok) {
                if let Some(log) = &mut log {
                    drop(writeln!(log, "{line}"));
                }
            }
        });
        match addr {
            Some(addr) => {
                let service = Self { child, folder, addr };
                service.wait_until_ready()?;
                Ok(service)
            }
            None => Err(Error::failed(format!("the service with --backend {backend} did not start:\n{said}"))),
        }
    }
}

impl Service {
    fn wait_until_ready(&self) -> Result<()> {
        let end = Instant::now() + MAX_START;
        while Client::connect(self.addr)?.status("/readyz")? != 200 {
            if Instant::now() > end {
                return Err(Error::failed(format!("the service was not ready within {MAX_START:?}")));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(())
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        drop((self.child.kill(), self.child.wait()));
        drop(std::fs::remove_dir_all(&self.folder));
    }
}
