//! Charges to the memory budget are at least the memory that is used, at every endpoint that takes a structure, each
//! with a small input that needs much memory. The system tells how far the resident memory of a service grows; with a
//! limit of that less a tolerance, the same request must be refused.

use std::collections::HashMap;
use std::fmt::Write as _;
use std::fs;
use std::sync::LazyLock;
use std::time::Duration;

use crate::cli_support::{Folder, Service};
use crate::http_support::{Reply, SAMPLE, connect, gzip, send_on};

/// Memory that need not be charged, MiB: code, threads, and what the allocator keeps.
const UNCHARGED: u64 = 16;
/// Least growth of a case, MiB. A smaller one would not show much.
const LEAST: u64 = 40;

/// Returns the growth of the resident memory of a process while `work` runs, MiB, and the value of `work`.
fn growth<T>(pid: u32, work: impl FnOnce() -> T) -> (u64, T) {
    let peak = || {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
        line.split_whitespace().next().unwrap().parse::<u64>().unwrap() >> 10
    };
    // Sets the peak to the present value.
    fs::write(format!("/proc/{pid}/clear_refs"), "5").unwrap();
    let before = peak();
    let value = work();
    (peak().saturating_sub(before), value)
}

/// Returns an mmCIF file of `n` atoms, each with a model, four names and a position.
fn atoms(n: usize, row: impl Fn(usize) -> (usize, [String; 4])) -> String {
    let mut text = "data_x\nloop_\n".to_owned();
    let items = "pdbx_PDB_model_num label_atom_id label_comp_id label_asym_id auth_asym_id auth_seq_id type_symbol \
                 Cartn_x Cartn_y Cartn_z";
    for item in items.split(' ') {
        writeln!(text, "_atom_site.{item}").unwrap();
    }
    for i in 0..n {
        let (model, [name, residue, label, chain]) = row(i);
        let [x, y, z] = [i % 50, i / 50 % 50, i / 2500].map(|n| n * 8);
        writeln!(text, "{model} {name} {residue} {label} {chain} {i} C {x} {y} {z}").unwrap();
    }
    text
}

/// Names of the inputs.
const INPUTS: [&str; 7] = ["sample", "names", "chains", "models", "confidences", "sequences", "lattice"];
/// Inputs by name. Uploads are compressed; stored files are not, so that a case needs little memory to load them.
static BODIES: LazyLock<HashMap<&str, Vec<u8>>> =
    LazyLock::new(|| INPUTS.into_iter().map(|name| (name, input(name).into_bytes())).collect());

/// Makes an input.
fn input(name: &str) -> String {
    match name {
        // JSON and CSV escape most of each name.
        "names" => atoms(25_000, |i| (1, ["a", "r", "l", "c"].map(|of| format!("{of}{i}{}", "\"".repeat(240))))),
        "chains" => atoms(200_000, |i| (1, ["C".to_owned(), "U".to_owned(), format!("l{i}"), format!("c{i}")])),
        "models" => atoms(600_000, |i| (i + 1, ["C", "U", "A", "A"].map(str::to_owned))),
        "confidences" => {
            let mut text = atoms(1, |_| (1, ["CA", "ALA", "A", "A"].map(str::to_owned)));
            text += "_ma_qa_metric.id 1\n_ma_qa_metric.mode local\n_ma_qa_metric.type pLDDT\nloop_\n";
            for item in ["model_id", "label_asym_id", "label_seq_id", "label_comp_id", "metric_value", "metric_id"] {
                writeln!(text, "_ma_qa_metric_local.{item}").unwrap();
            }
            let long = "x".repeat(1500);
            for i in 0..12_000 {
                writeln!(text, "1 {long} {i} {long} 50 1").unwrap();
            }
            text
        }
        "sequences" => {
            let mut text = std::str::from_utf8(SAMPLE).unwrap().to_owned();
            let letter = |n: usize| char::from(b"ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"[n % 36]);
            for line in 0..200_000 {
                write!(text, "SEQRES   1{}{} 9999 ", letter(line / 100_000), letter(line / 3600)).unwrap();
                for n in (0..13).map(|k| 13 * line + k) {
                    write!(text, " {}{}{}", letter(n / 1296), letter(n / 36), letter(n)).unwrap();
                }
                text.push('\n');
            }
            text
        }
        "lattice" => {
            let mut text = "300000\n\n".to_owned();
            for i in 0..300_000 {
                let [x, y, z] = [i % 70, i / 70 % 70, i / 4900].map(|n| n * 3);
                writeln!(text, "C {x} {y} {z}").unwrap();
            }
            text
        }
        _ => std::str::from_utf8(SAMPLE).unwrap().to_owned(),
    }
}

/// Request with an input, which it uploads (a target that begins with `/`) or has stored before (the rest of its path).
/// `{n}` is a parameter that no other request has.
struct Case {
    input: &'static str,
    target: &'static str,
}

const UPLOADS: [Case; 5] = [
    Case { input: "names", target: "/v1/structures" },
    Case { input: "names", target: "/v1/estimate?resolution=3" },
    Case { input: "chains", target: "/v1/report?select=all&resolution=4&surface=vdw&exact=true&radius_scale=1.0{n}" },
    Case { input: "names", target: "/v1/meshes?select=all&resolution=3&color=residue&isovalue=1.0{n}" },
    Case { input: "lattice", target: "/v1/meshes?format=png&width=1500&height=1500&resolution=3&isovalue=1.0{n}" },
];

/// Each of six levels finds the neighbours of the one below.
const NESTED: &str = "surface.glb?resolution=3&isovalue=1.0{n}&select=within%204%20of%20(within%204%20of%20(within%204\
                      %20of%20(within%204%20of%20(within%204%20of%20(within%204%20of%20(all))))))";

const STORED: [Case; 15] = [
    Case { input: "names", target: "" },
    Case { input: "models", target: "" },
    Case { input: "confidences", target: "" },
    Case { input: "sequences", target: "" },
    Case { input: "names", target: "atoms?positions=true&select=all" },
    Case { input: "names", target: "areas?by=atom&surface=vdw&select=all" },
    Case { input: "names", target: "colors?scheme=residue" },
    Case { input: "names", target: "surface.glb?select=all&resolution=3&color=chain&isovalue=1.0{n}" },
    Case { input: "names", target: "surface.png?select=all&resolution=3&isovalue=1.0{n}" },
    Case { input: "names", target: "report.json?select=all&resolution=3&isovalue=1.0{n}" },
    Case { input: "chains", target: "" },
    Case { input: "chains", target: "tileset.json?select=all&resolution=2" },
    Case { input: "chains", target: "tileset.subtree?select=all&resolution=2" },
    Case { input: "chains", target: "surface.glb?tile=0/0/0/0&select=all&resolution=2" },
    Case { input: "lattice", target: NESTED },
];

/// Sends the request of a case, with another `input`.
fn ask(service: &Service, target: &str, input: &str, n: u32) -> Reply {
    let stream = connect(service.addr.parse().unwrap());
    stream.set_read_timeout(Some(Duration::from_mins(9))).unwrap();
    let target = target.replace("{n}", &n.to_string());
    let body = &BODIES[input];
    if target.starts_with('/') {
        return send_on(stream, "POST", &target, &[("content-encoding", "gzip")], &gzip(body));
    }
    let path = format!("/v1/structures/{}/{target}", molmesh::store::Digest::of(body));
    send_on(stream, "GET", path.trim_end_matches('/'), &[], b"")
}

fn start(folder: &Folder, memory: Option<u64>) -> Service {
    let limit = memory.map(|mib| format!("limits.memory_bytes={mib}MiB"));
    let limit: Vec<&str> = limit.iter().flat_map(|limit| ["--set", limit]).collect();
    let settings = ["--devices", "cpu", "--set", "jobs.deadline_ms=600000"];
    Service::start(folder, &[&settings[..], &limit].concat())
}

/// Returns true if a service with a limit of `memory` MiB refuses the request for lack of memory.
fn is_refused(folder: &Folder, case: &Case, memory: u64) -> Result<bool, String> {
    let reply = ask(&start(folder, Some(memory)), case.target, case.input, 2);
    let text = String::from_utf8_lossy(&reply.body);
    // No other request runs, so it will not fit later either. An estimate contains the problem of a mesh.
    let is_refused = text.contains("too-much-memory");
    if is_refused || [200, 201].contains(&reply.status) { Ok(is_refused) } else { Err(text.into_owned()) }
}

/// Returns the growth of a service without a low limit during the request, MiB.
fn measured(folder: &Folder, case: &Case) -> Result<u64, String> {
    let service = start(folder, None);
    // Code and threads.
    ask(&service, case.target, "sample", 8);
    let (grown, reply) = growth(service.pid(), || ask(&service, case.target, case.input, 1));
    if ![200, 201].contains(&reply.status) {
        return Err(String::from_utf8_lossy(&reply.body).into_owned());
    }
    if grown >= LEAST { Ok(grown) } else { Err(format!("the input needs {grown} MiB only")) }
}

/// Checks that at most [`UNCHARGED`] of the memory that a request needs is not charged.
fn check(folder: &Folder, case: &Case) -> Result<u64, String> {
    let grown = measured(folder, case)?;
    let is_charged = is_refused(folder, case, grown - UNCHARGED)?;
    if is_charged {
        Ok(grown)
    } else {
        Err(format!("{grown} MiB are used, and less than {} charged", grown - UNCHARGED))
    }
}

/// Checks the cases. Returns the failures.
fn failures(cases: &[Case], stored: &[&str]) -> Vec<String> {
    let folder = Folder::new();
    let service = start(&folder, None);
    for input in stored {
        let stream = connect(service.addr.parse().unwrap());
        assert_eq!(send_on(stream, "POST", "/v1/structures", &[], &BODIES[input]).status, 201, "{input}");
    }
    drop(service);
    let check = |case: &Case| {
        let checked = check(&folder, case);
        Some(format!("{} {}: {}", case.input, case.target, checked.err()?))
    };
    cases.iter().filter_map(check).collect()
}

#[test]
fn memory_of_uploads_is_charged() {
    let found = failures(&UPLOADS, &[]);
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn memory_of_requests_for_stored_structures_is_charged() {
    let found = failures(&STORED, &INPUTS);
    assert!(found.is_empty(), "{}", found.join("\n"));
}

/// Negative control: the measurement finds memory that nobody charged, and a service with enough memory does not refuse
/// the request.
#[test]
fn memory_that_is_not_charged_is_found() {
    let (grown, memory) = growth(std::process::id(), || vec![1_u8; 64 << 20]);
    assert!((60..80).contains(&grown) && memory.contains(&1), "{grown} MiB");
    // The charge may be a multiple of the use.
    let (folder, case) = (Folder::new(), &UPLOADS[0]);
    let used = measured(&folder, case).unwrap();
    assert_eq!(is_refused(&folder, case, used + 6 * grown - UNCHARGED), Ok(false));
}
