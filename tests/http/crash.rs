//! Power failures: the system calls of a service are recorded, and the data folder that each prefix of them leaves on
//! disk is opened again. Every accepted job must be there.

use crate::http_support;
use crate::tools;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use http_support::{SAMPLE, sample, start_cold};
use molmesh::surface::CpuBackend;

use crate::jobs_durable::{Process, ask};

/// System calls that change files or send responses to clients. Not every architecture has those with `?`.
const TRACED: &str = "trace=openat,write,pwrite64,lseek,ftruncate,fsync,fdatasync,?mkdir,mkdirat,?rename,renameat,\
                      ?renameat2,?link,linkat,?unlink,unlinkat,sendto,writev";

/// Recorded step.
#[derive(Debug, Clone)]
enum Step {
    Open {
        fd: u32,
        path: PathBuf,
        truncate: bool,
    },
    Write {
        fd: u32,
        at: Option<u64>,
        bytes: Vec<u8>,
    },
    Seek {
        fd: u32,
        at: u64,
    },
    Truncate {
        fd: u32,
        length: u64,
    },
    /// With the path at the time of the call.
    Sync {
        fd: u32,
        path: PathBuf,
    },
    Mkdir(PathBuf),
    Rename(PathBuf, PathBuf),
    Link(PathBuf, PathBuf),
    Unlink(PathBuf),
    /// A 202 with the path of its job.
    Accepted(String),
}

/// Decodes `\xNN\xNN…`.
fn decode(text: &str) -> Vec<u8> {
    text.split("\\x").skip(1).map(|byte| u8::from_str_radix(&byte[..2], 16).unwrap()).collect()
}

fn path(text: &str) -> PathBuf {
    String::from_utf8(decode(text)).unwrap().into()
}

/// Parses a call such as `write(12<\x2f>, "\x61\x62", 2) = 2`.
fn parse(call: &str) -> Option<Step> {
    let (name, rest) = call.split_once('(')?;
    let (arguments, result) = rest.rsplit_once(" = ")?;
    let result: u64 = result.split(['<', ' ']).next()?.parse().ok()?;
    let strings: Vec<&str> = arguments.split('"').skip(1).step_by(2).collect();
    assert!(!arguments.contains("\"..."), "strace cut a string: {name}");
    // Sockets and pipes have no path.
    let target = || Some(path(arguments.split_once('<')?.1.split_once('>')?.0)).filter(|path| path.is_absolute());
    let fd = || target().and_then(|_| arguments.split('<').next()?.parse::<u32>().ok());
    let number = |ix: usize| arguments.split(", ").nth(ix).unwrap().trim_end_matches(')').parse::<u64>().unwrap();
    let bytes = || {
        let mut bytes = strings.iter().flat_map(|text| decode(text)).collect::<Vec<_>>();
        bytes.truncate(usize::try_from(result).unwrap());
        bytes
    };
    Some(match name {
        "openat" => {
            let truncate = arguments.contains("O_TRUNC");
            Step::Open { fd: u32::try_from(result).unwrap(), path: path(strings[0]), truncate }
        }
        "write" | "writev" | "sendto" => {
            let bytes = bytes();
            match std::str::from_utf8(&bytes).ok().filter(|text| text.starts_with("HTTP/1.1 202")) {
                Some(head) => {
                    let location = head.lines().find_map(|line| line.strip_prefix("location: "));
                    Step::Accepted(location.unwrap().to_owned())
                }
                None => Step::Write { fd: fd()?, at: None, bytes },
            }
        }
        "pwrite64" => Step::Write { fd: fd()?, at: Some(number(3)), bytes: bytes() },
        "lseek" => Step::Seek { fd: fd()?, at: result },
        "ftruncate" => Step::Truncate { fd: fd()?, length: number(1) },
        "fsync" | "fdatasync" => Step::Sync { fd: fd()?, path: target()? },
        "mkdir" | "mkdirat" => Step::Mkdir(path(strings[0])),
        "rename" | "renameat" | "renameat2" => Step::Rename(path(strings[0]), path(strings[1])),
        "link" | "linkat" => Step::Link(path(strings[0]), path(strings[1])),
        "unlink" | "unlinkat" => Step::Unlink(path(strings[0])),
        other => panic!("unexpected call {other}"),
    })
}

/// Parses a log of strace. A call takes effect when it returns, but a response counts when it is sent.
fn steps(log: &str) -> Vec<Step> {
    let mut begun = HashMap::new();
    let mut steps = Vec::new();
    for line in log.lines() {
        let (pid, call) = line.split_once(' ').unwrap();
        let call = call.trim_start();
        if let Some(first) = call.strip_suffix(" <unfinished ...>") {
            let sent = ["write", "sendto"].iter().any(|name| first.starts_with(name));
            if sent && let Some(accepted @ Step::Accepted(_)) = parse(&format!("{first}) = {}", first.len())) {
                steps.push(accepted);
            }
            begun.insert(pid, first);
        } else if let Some((_, rest)) = call.strip_prefix("<... ").and_then(|rest| rest.split_once(" resumed>")) {
            steps.extend(parse(&format!("{}{rest}", begun.remove(pid).unwrap())));
        } else {
            steps.extend(parse(call));
        }
    }
    steps
}

/// File or folder, in memory and on the disk.
#[derive(Debug, Default, Clone)]
struct Node {
    is_folder: bool,
    entries: BTreeMap<String, usize>,
    bytes: Vec<u8>,
    synced_entries: BTreeMap<String, usize>,
    synced_bytes: Vec<u8>,
}

/// Files by path; folders have no bytes.
type Tree = BTreeMap<PathBuf, Option<Vec<u8>>>;

/// Disk with a cache. The folder `root` is on the disk.
struct Disk {
    root: PathBuf,
    nodes: Vec<Node>,
    /// Open files: node and position.
    open: HashMap<u32, (usize, u64)>,
}

impl Disk {
    fn new(root: &Path) -> Self {
        let top = Node { is_folder: true, ..Node::default() };
        Self { root: root.to_owned(), nodes: vec![top], open: HashMap::new() }
    }

    /// Returns the folder of a path below the root and its name in it.
    fn place(&self, path: &Path) -> Option<(usize, String)> {
        let mut parts: Vec<_> =
            path.strip_prefix(&self.root).ok()?.iter().map(|part| part.to_str().unwrap().to_owned()).collect();
        let last = parts.pop()?;
        Some((parts.iter().fold(0, |folder, part| self.nodes[folder].entries[part]), last))
    }

    fn find(&self, path: &Path) -> Option<usize> {
        if path == self.root {
            return Some(0);
        }
        let (folder, name) = self.place(path)?;
        self.nodes[folder].entries.get(&name).copied()
    }

    fn add(&mut self, path: &Path, is_folder: bool) -> Option<usize> {
        let (folder, name) = self.place(path)?;
        let ix = self.nodes.len();
        self.nodes.push(Node { is_folder, ..Node::default() });
        self.nodes[folder].entries.insert(name, ix);
        Some(ix)
    }

    fn remove(&mut self, path: &Path) -> Option<usize> {
        let (folder, name) = self.place(path)?;
        self.nodes[folder].entries.remove(&name)
    }

    fn apply(&mut self, step: &Step) {
        match step {
            Step::Open { fd, path, truncate } => {
                let node = self.find(path).or_else(|| self.add(path, false));
                self.open.remove(fd);
                if let Some(node) = node {
                    self.open.insert(*fd, (node, 0));
                    if *truncate {
                        self.nodes[node].bytes.clear();
                    }
                }
            }
            Step::Write { fd, at, bytes } => {
                let Some((node, position)) = self.open.get_mut(fd) else { return };
                let start = usize::try_from(at.unwrap_or(*position)).unwrap();
                let end = start + bytes.len();
                let file = &mut self.nodes[*node].bytes;
                file.resize(file.len().max(end), 0);
                file[start..end].copy_from_slice(bytes);
                if at.is_none() {
                    *position = end as u64;
                }
            }
            Step::Seek { fd, at } => {
                if let Some((_, position)) = self.open.get_mut(fd) {
                    *position = *at;
                }
            }
            Step::Truncate { fd, length } => {
                if let Some((node, _)) = self.open.get(fd) {
                    self.nodes[*node].bytes.resize(usize::try_from(*length).unwrap(), 0);
                }
            }
            Step::Sync { fd, .. } => {
                if let Some((node, _)) = self.open.get(fd) {
                    let node = &mut self.nodes[*node];
                    node.synced_bytes = node.bytes.clone();
                    node.synced_entries = node.entries.clone();
                }
            }
            Step::Mkdir(path) => {
                self.add(path, true);
            }
            Step::Rename(from, to) => {
                if let (Some(node), Some((folder, name))) = (self.remove(from), self.place(to)) {
                    self.nodes[folder].entries.insert(name, node);
                }
            }
            Step::Link(from, to) => {
                if let (Some(node), Some((folder, name))) = (self.find(from), self.place(to)) {
                    self.nodes[folder].entries.insert(name, node);
                }
            }
            Step::Unlink(path) => {
                self.remove(path);
            }
            Step::Accepted(_) => {}
        }
    }

    /// Returns what a power failure leaves: everything, or what was synced.
    fn tree(&self, all: bool) -> Tree {
        let mut tree = Tree::new();
        let mut folders = vec![(PathBuf::new(), 0)];
        while let Some((at, folder)) = folders.pop() {
            let Node { entries, synced_entries, .. } = &self.nodes[folder];
            for (name, ix) in if all { entries } else { synced_entries } {
                let (path, node) = (at.join(name), &self.nodes[*ix]);
                if node.is_folder {
                    folders.push((path.clone(), *ix));
                    tree.insert(path, None);
                } else {
                    tree.insert(path, Some(if all { node.bytes.clone() } else { node.synced_bytes.clone() }));
                }
            }
        }
        tree
    }
}

/// Requests of the test: path, idempotency key, body, expected result.
struct Request {
    path: &'static str,
    key: &'static str,
    body: Vec<u8>,
    mesh: Vec<u8>,
}

/// Hashes of states that were found to be whole, with the jobs that were accepted.
type Whole = BTreeSet<u64>;

/// Opens the folder `data` of `tree` and looks for the jobs. Panics if one is lost.
fn check(tree: &Tree, data: &Path, accepted: &[String], requests: &[Request]) {
    let dir = tempfile::tempdir().unwrap();
    for (path, bytes) in tree {
        match bytes {
            None => std::fs::create_dir(dir.path().join(path)).unwrap(),
            Some(bytes) => std::fs::write(dir.path().join(path), bytes).unwrap(),
        }
    }
    let data = dir.path().join(data);
    let server =
        start_cold(Arc::new(CpuBackend::new(None).unwrap()), |config| data.clone_into(&mut config.server.data_dir));
    for (job, request) in accepted.iter().zip(requests) {
        let state = server.get(&format!("{job}?wait=50")).json();
        assert_eq!(state["status"], "successful", "{state}");
        let mesh = server.get(server.get(&format!("{job}/result")).header("location").unwrap());
        assert!((mesh.status, &mesh.body) == (200, &request.mesh), "the mesh of {state}");
        let report = server.get(state["links"].as_array().unwrap().last().unwrap()["href"].as_str().unwrap());
        assert!(report.status == 200 && report.json().is_object(), "the report of {state}");
        let headers = [("prefer", "respond-async"), ("idempotency-key", request.key)];
        assert_eq!(server.post(request.path, &headers, &request.body).header("location"), Some(job.as_str()));
    }
    assert_eq!(std::fs::read_dir(data.join("store/quarantine")).unwrap().count(), 0);
    assert!(server.join());
}

/// Checks what each prefix of the steps leaves. Skips states in `whole`, and adds to it.
fn replay<'a>(
    mut disk: Disk,
    steps: impl Iterator<Item = &'a Step>,
    choices: &[bool],
    whole: &mut Whole,
    check: &dyn Fn(&Tree, &[String]),
) {
    let mut accepted = Vec::new();
    for step in steps {
        disk.apply(step);
        if let Step::Accepted(job) = step
            && !accepted.contains(job)
        {
            accepted.push(job.clone());
        }
        for all in choices {
            let tree = disk.tree(*all);
            let mut hasher = DefaultHasher::new();
            (&tree, &accepted).hash(&mut hasher);
            if !whole.contains(&hasher.finish()) {
                check(&tree, &accepted);
                whole.insert(hasher.finish());
            }
        }
    }
}

/// Records the requests to a new process with the folder `data`. Returns `None` without strace.
fn record(root: &Path, data: &Path, requests: &[Request]) -> Option<Vec<Step>> {
    if !Command::new("strace").arg("-V").output().is_ok_and(|output| output.status.success()) {
        return tools::missing("strace");
    }
    let log = root.join("strace.log");
    let mut program = Command::new("strace");
    program.args(["-f", "--seccomp-bpf", "-y", "-xx", "-s", "100000000", "-e", TRACED, "-o"]).arg(&log);
    program.arg(env!("CARGO_BIN_EXE_molmesh"));
    let server = Process::spawn(program, data);
    for Request { path, key, body, .. } in requests {
        let headers = format!("prefer: respond-async\r\nidempotency-key: {key}\r\n");
        let Some((202, Some(job), _)) = ask(server.addr, "POST", path, &headers, body) else { panic!("no job") };
        let (_, _, state) = ask(server.addr, "GET", &format!("{job}?wait=50"), "", b"").unwrap();
        let state: serde_json::Value = serde_json::from_slice(&state).unwrap();
        assert_eq!(state["status"], "successful", "{state}");
    }
    // The end of the process ends strace and completes the log.
    let text = std::fs::read_to_string(&log).unwrap();
    let pid = text.split(' ').next().unwrap().to_owned();
    assert!(Command::new("kill").arg(&pid).status().unwrap().success());
    server.wait();
    let steps = steps(&std::fs::read_to_string(&log).unwrap());
    std::fs::remove_file(log).unwrap();
    Some(steps)
}

#[test]
fn power_failures_lose_no_accepted_job() {
    let reference = start_cold(Arc::new(CpuBackend::new(None).unwrap()), |_| {});
    // A small result, a large one that is written in parts, and one that exists.
    let request = |path, key, body: &[u8]| {
        let mesh = reference.post(path, &[], body).body;
        Request { path, key, body: body.to_vec(), mesh }
    };
    let requests = [
        request("/v1/meshes?format=stl&resolution=2", "a", SAMPLE),
        request("/v1/meshes?format=stl&resolution=0.4", "b", &sample(1)),
        request("/v1/meshes?format=stl&resolution=2", "c", SAMPLE),
    ];
    assert!(requests[1].mesh.len() > 1 << 20);
    let below = Path::new("new/data");
    // The second time, an earlier process created the store and died, and nothing of it has reached the disk.
    let store = "new/data/store";
    let starts: [(_, &[bool], &[Request], &[&str]); 2] = [
        (
            None,
            &[true, false],
            &requests,
            &[
                "",
                "new",
                "new/data",
                store,
                "new/data/store/.secret.",
                "new/data/store/inputs",
                "new/data/store/inputs/*",
                "new/data/store/jobs",
                "new/data/store/jobs/*",
                "new/data/store/results",
                "new/data/store/results/*",
            ],
        ),
        (Some("new/data/store/inputs"), &[false], &requests[..1], &["new/data", store]),
    ];
    for (earlier, choices, requests, synced) in starts {
        let dir = tempfile::tempdir().unwrap();
        let root = dir.path().canonicalize().unwrap();
        let before = || {
            let mut disk = Disk::new(&root);
            let earlier: Vec<_> = earlier.into_iter().flat_map(|path| Path::new(path).ancestors()).collect();
            for path in earlier.iter().rev().skip(1) {
                disk.add(&root.join(path), true);
            }
            // The data folder itself is durable.
            for node in disk.nodes.iter_mut().take(2) {
                node.synced_entries = node.entries.clone();
            }
            disk
        };
        if let Some(folder) = earlier {
            std::fs::create_dir_all(root.join(folder)).unwrap();
        }
        let Some(steps) = record(&root, &root.join(below), requests) else { return };
        let mut whole = Whole::new();
        let check = |tree: &Tree, accepted: &[String]| check(tree, below, accepted, requests);
        replay(before(), steps.iter(), choices, &mut whole, &check);
        assert!(steps.len() > 50 && whole.len() > 10, "{} steps, {} states", steps.len(), whole.len());
        for control in synced {
            let is_synced = |path: &Path| {
                let path = path.strip_prefix(&root).unwrap_or(path);
                match control.strip_suffix("/*") {
                    Some(folder) => path.parent() == Some(Path::new(folder)),
                    // The rest of a staged name is random.
                    None if control.ends_with('.') => path.to_string_lossy().starts_with(control),
                    None => path == Path::new(control),
                }
            };
            let left = steps.iter().filter(|step| !matches!(step, Step::Sync { path, .. } if is_synced(path)));
            assert!(left.clone().count() < steps.len(), "`{control}` is never synced");
            let lost = catch_unwind(AssertUnwindSafe(|| replay(before(), left, &[false], &mut whole, &check)));
            assert!(lost.is_err(), "control: without the syncs of `{control}`, nothing is lost");
        }
    }
}
