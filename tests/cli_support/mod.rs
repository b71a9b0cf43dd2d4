//! Runs the built binary with synthetic structures.
#![allow(dead_code, reason = "every test crate compiles this file and uses its own part")]
#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::missing_panics_doc,
    unreachable_pub,
    reason = "tests fail by panicking"
)]

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// Temporary folder.
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

    /// Returns the sorted names of all entries, including hidden files.
    pub fn entries(&self) -> Vec<String> {
        let name = |e: std::io::Result<std::fs::DirEntry>| e.unwrap().file_name().into_string().unwrap();
        let mut names: Vec<_> = std::fs::read_dir(self.0.path()).unwrap().map(name).collect();
        names.sort();
        names
    }
}

/// Returns a command of the binary, without the environment variables that change its output.
pub fn molmesh() -> Command {
    prepared(Command::new(env!("CARGO_BIN_EXE_molmesh")))
}

/// Removes the environment variables that change the output of the binary, and its use of the network.
fn prepared(mut command: Command) -> Command {
    for name in ["RUST_BACKTRACE", "RUST_LOG", "MOLMESH__DEVICES__USE", "COLUMNS", "CLICOLOR_FORCE"] {
        command.env_remove(name);
    }
    // Without a desktop, a layer of Mesa prints errors to stderr.
    command.env("NODEVICE_SELECT", "1");
    // Tests use no network, and no load balancer needs notice of a shutdown.
    command.env("MOLMESH__ARCHIVE__URL", "none");
    command.env("MOLMESH__SERVER__TERMINATION_NOTICE_MS", "none");
    command.stdin(Stdio::null());
    command
}

/// Runs `molmesh` with `args`.
pub fn run<S: AsRef<std::ffi::OsStr>>(args: impl IntoIterator<Item = S>) -> Output {
    molmesh().args(args).output().unwrap()
}

/// Runs `molmesh doctor` for a service on a free port with its own folder.
pub fn doctor(more: &[&str]) -> Output {
    let folder = Folder::new();
    let data = folder.path("data");
    molmesh().args(["doctor", "--listen", "127.0.0.1:0", "--data-dir"]).arg(data).args(more).output().unwrap()
}

/// Runs `molmesh mesh input -o output` and more flags.
pub fn mesh(input: &Path, output: &Path, more: &[&str]) -> Output {
    molmesh().arg("mesh").arg(input).arg("-o").arg(output).args(more).output().unwrap()
}

/// Runs `molmesh` with `args` and with `bytes` on stdin.
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

/// Asserts an exit code. Asserts that a failure prints one line and at most a hint.
#[track_caller]
pub fn assert_code(output: &Output, code: i32) {
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{stderr}");
    if code != 0 {
        assert!(stderr.starts_with("molmesh: "), "{stderr}");
        // The message, and two lines that point at a place in an expression.
        assert!(stderr.lines().count() <= 3, "{stderr}");
        assert!(!stderr.contains("panicked") && !stderr.contains("\x1b["), "{stderr}");
    }
}

/// Returns a PDB file with one carbon atom per residue at these positions, Å.
pub fn pdb(positions: &[[f64; 3]]) -> String {
    let line = |(i, [x, y, z]): (usize, &[f64; 3])| {
        let n = i % 9999 + 1;
        format!("ATOM  {n:>5}  CA  ALA A{n:>4}    {x:>8.3}{y:>8.3}{z:>8.3}  1.00  0.00           C  \n")
    };
    positions.iter().enumerate().map(line).chain(["END\n".to_owned()]).collect()
}

/// Returns a PDB file with ten overlapping atoms in a row.
pub fn rod() -> String {
    pdb(&std::array::from_fn::<_, 10, _>(|i| [f64::from(u32::try_from(i).unwrap()) * 1.5, 0.25, -0.75]))
}

/// Returns a PDB file with a cube of `n`³ atoms, 2 Å apart, for long jobs at a fine resolution.
pub fn block(n: u32) -> String {
    let at = |i: u32| f64::from(i) * 2.0;
    let positions: Vec<[f64; 3]> =
        (0..n).flat_map(|x| (0..n).flat_map(move |y| (0..n).map(move |z| [at(x), at(y), at(z)]))).collect();
    pdb(&positions)
}

/// Limit of the memory of processes: a control group, or the size of the data segment if none can be created.
#[cfg(target_os = "linux")]
pub struct MemoryLimit {
    mib: u64,
    group: Option<PathBuf>,
}

#[cfg(target_os = "linux")]
impl MemoryLimit {
    pub fn new(mib: u64) -> Self {
        static COUNT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
        let count = COUNT.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let name = format!("molmesh-test-{}-{count}", std::process::id());
        // Version 1, then version 2.
        let mounts = [("/sys/fs/cgroup/memory", "memory.limit_in_bytes"), ("/sys/fs/cgroup", "memory.max")];
        let group = mounts.into_iter().find_map(|(mount, file)| {
            let group = Path::new(mount).join(&name);
            std::fs::create_dir(&group).ok()?;
            let file = group.join(file);
            if file.exists() && std::fs::write(file, (mib << 20).to_string()).is_ok() {
                return Some(group);
            }
            drop(std::fs::remove_dir(group));
            None
        });
        Self { mib, group }
    }

    /// Returns a command of the binary that enters the group first.
    fn command(&self) -> Command {
        let Some(group) = &self.group else { return molmesh() };
        let mut shell = Command::new("sh");
        shell.args(["-c", "echo $$ > \"$0\" && exec \"$@\""]).arg(group.join("cgroup.procs"));
        shell.arg(env!("CARGO_BIN_EXE_molmesh"));
        prepared(shell)
    }

    /// Runs the binary in the group. Returns its output; `None` without a group.
    pub fn run(&self, args: &[&str]) -> Option<String> {
        self.group.as_ref()?;
        Some(stdout(&self.command().args(args).output().unwrap()))
    }

    /// Limits the data segment of a service outside a group: its size when idle, and as much again as the limit.
    fn apply(&self, service: &Service) {
        if self.group.is_none() {
            let bytes = (service.memory("VmData") + self.mib) << 20;
            let args = [format!("--pid={}", service.pid()), format!("--data={bytes}")];
            assert!(Command::new("prlimit").args(args).status().unwrap().success());
        }
    }
}

#[cfg(target_os = "linux")]
impl Drop for MemoryLimit {
    fn drop(&mut self) {
        // A group can be removed when its last process has ended.
        let removed = |group: &PathBuf| std::fs::remove_dir(group).is_ok();
        for _ in 0..100 {
            if self.group.as_ref().is_none_or(removed) {
                break;
            }
            std::thread::sleep(std::time::Duration::from_millis(50));
        }
    }
}

/// Running `molmesh serve`. Dropping it kills the process, unless it was stopped.
pub struct Service {
    child: std::process::Child,
    /// Address, such as `127.0.0.1:41234`.
    pub addr: String,
    /// Banner, or the first lines of a JSON log.
    pub banner: String,
    log: Option<std::thread::JoinHandle<String>>,
}

impl Service {
    /// Starts a service on free ports and waits until it is ready.
    pub fn start(folder: &Folder, more: &[&str]) -> Self {
        Self::start_as(molmesh(), folder, more)
    }

    /// Starts a service as [`Self::start`] does, which cannot use more memory than `limit`.
    #[cfg(target_os = "linux")]
    pub fn start_limited(folder: &Folder, limit: &MemoryLimit, more: &[&str]) -> Self {
        let service = Self::start_as(limit.command(), folder, more);
        limit.apply(&service);
        service
    }

    /// Starts a service with the binary of `command`, as [`Self::start`] does.
    fn start_as(mut command: Command, folder: &Folder, more: &[&str]) -> Self {
        use std::io::{BufRead, BufReader};
        let mut child = command
            .args(["serve", "--listen", "127.0.0.1:0", "--metrics-listen", "127.0.0.1:0", "--data-dir"])
            .arg(folder.path("data"))
            .args(more)
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let mut banner = String::new();
        loop {
            let line = lines.next().unwrap_or_else(|| panic!("the service ended after\n{banner}")).unwrap();
            banner.push_str(&line);
            banner.push('\n');
            // The last line of the banner, or the event that replaces it in a JSON log.
            if line.trim_start().starts_with("try ") || line.contains("\"listening\"") {
                break;
            }
        }
        // Read the rest of the log, as a full pipe would block the service.
        let log = std::thread::spawn(move || lines.map_while(Result::ok).collect::<Vec<_>>().join("\n"));
        let json = banner.lines().last().and_then(|line| serde_json::from_str::<serde_json::Value>(line).ok());
        let addr = if let Some(event) = json {
            event["address"].as_str().unwrap().to_owned()
        } else {
            let viewer = banner.lines().find(|l| l.contains("viewer")).unwrap();
            viewer.split("http://").nth(1).unwrap().trim_end_matches('/').to_owned()
        };
        let service = Self { child, addr, banner, log: Some(log) };
        let start = std::time::Instant::now();
        while !service.ready() {
            assert!(start.elapsed().as_secs() < 30, "the service is not ready after 30 s");
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        service
    }

    /// Returns true if `molmesh healthcheck` succeeds.
    pub fn ready(&self) -> bool {
        run(["healthcheck", "--url", &format!("http://{}/readyz", self.addr)]).status.success()
    }

    /// Returns a field of `/proc/<pid>/status`, such as `VmRSS` or `VmHWM`, MiB.
    #[cfg(target_os = "linux")]
    pub fn memory(&self, field: &str) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':')).unwrap();
        line.split_whitespace().next().unwrap().parse::<u64>().unwrap() >> 10
    }

    /// Returns true if the process runs.
    pub fn lives(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }

    /// Waits until the resident memory is at most `mib`, at most the ten seconds after which memory must be returned.
    #[cfg(target_os = "linux")]
    #[track_caller]
    pub fn assert_memory_returns(&self, mib: u64) {
        let end = std::time::Instant::now() + std::time::Duration::from_secs(10);
        while self.memory("VmRSS") > mib {
            assert!(std::time::Instant::now() < end, "{} MiB, more than {mib}", self.memory("VmRSS"));
            std::thread::sleep(std::time::Duration::from_millis(50));
        }
    }

    /// Returns the process id.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal and waits. Returns the exit code and the log.
    pub fn stop(self, signal: &str) -> (Option<i32>, String) {
        self.signal(signal);
        self.wait()
    }

    /// Sends a signal.
    pub fn signal(&self, signal: &str) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args([&format!("-{signal}"), &id]).status().unwrap().success());
    }

    /// Waits for the process. Returns the exit code and the log.
    pub fn wait(mut self) -> (Option<i32>, String) {
        let code = self.child.wait().unwrap().code();
        (code, self.log.take().unwrap().join().unwrap())
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        // After a stop there is no process to kill.
        drop(self.child.kill());
        drop(self.child.wait());
    }
}
