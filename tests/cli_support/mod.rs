//! Drives the built binary: made-up structures in, exit codes and files out.
#![allow(dead_code, reason = "every test crate compiles this file and uses its own part")]
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::missing_panics_doc,
    unreachable_pub,
    reason = "tests say what they expect by panicking"
)]

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// A folder that is gone afterwards.
pub struct Folder(tempfile::TempDir);

impl Folder {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub fn file(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        let path = self.path(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }

    /// Names of everything in it, hidden files too, sorted.
    pub fn entries(&self) -> Vec<String> {
        let name = |e: std::io::Result<std::fs::DirEntry>| e.unwrap().file_name().into_string().unwrap();
        let mut names: Vec<_> = std::fs::read_dir(self.0.path()).unwrap().map(name).collect();
        names.sort();
        names
    }
}

/// The binary, with an environment that does not change what it prints.
pub fn molmesh() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_molmesh"));
    for name in ["RUST_BACKTRACE", "RUST_LOG", "MOLMESH__DEVICES__USE", "COLUMNS", "CLICOLOR_FORCE"] {
        command.env_remove(name);
    }
    // A layer of Mesa's complains on stderr where there is no desktop.
    command.env("NODEVICE_SELECT", "1");
    // Tests stay on this machine, and there is no load balancer that would have to notice the end of a service.
    command.env("MOLMESH__ARCHIVE__URL", "none");
    command.env("MOLMESH__SERVER__TERMINATION_NOTICE_MS", "none");
    command.stdin(Stdio::null());
    command
}

/// Runs `molmesh` with `args`.
pub fn run<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Output {
    molmesh().args(args).output().unwrap()
}

/// Runs `molmesh doctor` for a service on a free port with a folder of its own.
pub fn doctor(more: &[&str]) -> Output {
    let folder = Folder::new();
    let data = folder.path("data");
    molmesh().args(["doctor", "--listen", "127.0.0.1:0", "--data-dir"]).arg(data).args(more).output().unwrap()
}

/// Runs `molmesh mesh input -o output` and more flags.
pub fn mesh(input: &Path, output: &Path, more: &[&str]) -> Output {
    molmesh().arg("mesh").arg(input).arg("-o").arg(output).args(more).output().unwrap()
}

/// Runs `molmesh` with `args`, `bytes` on stdin.
pub fn piped(args: &[&str], bytes: &[u8]) -> Output {
    let mut child =
        molmesh().args(args).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(bytes).unwrap();
    child.wait_with_output().unwrap()
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

pub fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

/// Asserts an exit code, and that a failure is one line with at most a hint behind it.
#[track_caller]
pub fn assert_code(output: &Output, code: i32) {
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{said}");
    if code != 0 {
        assert!(said.starts_with("molmesh: "), "{said}");
        assert!(said.lines().count() <= 2, "{said}");
        assert!(!said.contains("panicked") && !said.contains("\x1b["), "{said}");
    }
}

/// One carbon a residue, at these places, Å.
pub fn pdb(places: &[[f64; 3]]) -> String {
    let line = |(i, [x, y, z]): (usize, &[f64; 3])| {
        let n = i % 9999 + 1;
        format!("ATOM  {n:>5}  CA  ALA A{n:>4}    {x:>8.3}{y:>8.3}{z:>8.3}  1.00  0.00           C  \n")
    };
    places.iter().enumerate().map(line).chain(["END\n".to_owned()]).collect()
}

/// Ten overlapping atoms in a row.
pub fn rod() -> String {
    pdb(&std::array::from_fn::<_, 10, _>(|i| [f64::from(u32::try_from(i).unwrap()) * 1.5, 0.25, -0.75]))
}

/// A cube of `n`³ atoms, 2 Å apart: work that takes long at a fine resolution.
pub fn block(n: u32) -> String {
    let at = |i: u32| f64::from(i) * 2.0;
    let places: Vec<[f64; 3]> =
        (0..n).flat_map(|x| (0..n).flat_map(move |y| (0..n).map(move |z| [at(x), at(y), at(z)]))).collect();
    pdb(&places)
}

/// A running `molmesh serve`. Killed when dropped, unless it was stopped.
pub struct Service {
    child: std::process::Child,
    /// Its address, such as `127.0.0.1:41234`.
    pub addr: String,
    /// Its banner.
    pub banner: String,
    log: Option<std::thread::JoinHandle<String>>,
}

impl Service {
    /// Starts a service on free ports and waits until it is ready.
    pub fn start(folder: &Folder, more: &[&str]) -> Self {
        use std::io::{BufRead, BufReader};
        let mut child = molmesh()
            .args(["serve", "--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--data-dir"])
            .arg(folder.path("data"))
            .args(more)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let mut banner = String::new();
        loop {
            let line = lines.next().unwrap_or_else(|| panic!("it ended after\n{banner}")).unwrap();
            banner.push_str(&line);
            banner.push('\n');
            if line.trim_start().starts_with("try ") {
                break;
            }
        }
        // The log has to be read on, or the service waits for somebody to do it.
        let log = std::thread::spawn(move || lines.map_while(Result::ok).collect::<Vec<_>>().join("\n"));
        let viewer = banner.lines().find(|l| l.contains("viewer")).unwrap();
        let addr = viewer.split("http://").nth(1).unwrap().trim_end_matches('/').to_owned();
        let service = Self { child, addr, banner, log: Some(log) };
        let start = std::time::Instant::now();
        while !service.ready() {
            assert!(start.elapsed().as_secs() < 30, "it is not ready after 30 s");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        service
    }

    /// Whether `molmesh healthcheck` says that it is ready.
    pub fn ready(&self) -> bool {
        run(["healthcheck", "--url", &format!("http://{}/readyz", self.addr)]).status.success()
    }

    /// A field of its `/proc/<pid>/status`, such as `VmRSS` or `VmHWM`, MiB.
    #[cfg(target_os = "linux")]
    pub fn memory(&self, field: &str) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':')).unwrap();
        line.split_whitespace().next().unwrap().parse::<u64>().unwrap() >> 10
    }

    /// Its process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends it a signal; returns its exit code and its log.
    pub fn stop(self, signal: &str) -> (Option<i32>, String) {
        self.signal(signal);
        self.wait()
    }

    /// Sends it a signal.
    pub fn signal(&self, signal: &str) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args([&format!("-{signal}"), &id]).status().unwrap().success());
    }

    /// Waits for its end; returns its exit code and its log.
    pub fn wait(mut self) -> (Option<i32>, String) {
        let code = self.child.wait().unwrap().code();
        (code, self.log.take().unwrap().join().unwrap())
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // After a stop there is nothing to kill, and that is no error.
        drop(self.child.kill());
        drop(self.child.wait());
    }
}
