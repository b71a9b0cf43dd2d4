//! Memory of the whole process: it stays within the configured limit under load, in a process that cannot have more.
#![cfg(target_os = "linux")]

use crate::bcif_support;
use crate::cli_support;
use crate::http_support;

use std::io::Write as _;
use std::time::{Duration, Instant};

use bcif_support::{block, byte_array, category, column, file, i32s, run_length};
use cli_support::{Folder, MemoryLimit, Service};
use http_support::{connect, gzip, send, send_on};

/// Limit of the service, MiB.
const BUDGET: u64 = 256;
/// Limit of the process, MiB.
const LIMIT: u64 = 512;
/// Memory outside the budget: threads, the runtime, and requests that are refused, MiB.
const OVERHEAD: u64 = 96;

#[test]
fn a_burst_of_large_uploads_stays_within_the_memory_limit() {
    let folder = Folder::new();
    let budget = format!("limits.memory_bytes={BUDGET}MiB");
    let sets = [&budget, "limits.structure_cache_bytes=16MiB", "jobs.workers=4", "server.client_share=1"];
    let settings = [&["--devices", "cpu"][..], &sets.map(|set| ["--set", set]).concat()].concat();
    let limit = MemoryLimit::new(LIMIT);
    let service = Service::start_limited(&folder, &limit, &settings);
    let addr = service.addr.parse().unwrap();
    // 40 MB of text.
    let (idle, body) = (service.memory("VmRSS"), gzip(cli_support::block(80).as_bytes()));
    let targets = [
        "/v1/structures",
        "/v1/estimate?resolution=2",
        "/v1/report?resolution=2",
        "/v1/meshes?resolution=2",
        "/v1/meshes?resolution=2.5&format=png",
        "/v1/meshes?resolution=3&check=strict",
    ];
    let statuses: Vec<u16> = std::thread::scope(|scope| {
        let ask = |n: usize| {
            let (target, body) = (targets[n % targets.len()], &body);
            let separator = if target.contains('?') { '&' } else { '?' };
            // Different parameters, so that no two requests share a job.
            let target = match target {
                "/v1/structures" => target.to_owned(),
                _ => format!("{target}{separator}isovalue=1.{n:03}"),
            };
            scope.spawn(move || {
                let stream = connect(addr);
                // The service answers within `jobs.deadline_ms`, a minute, and on a loaded machine a little later.
                stream.set_read_timeout(Some(Duration::from_mins(2))).unwrap();
                stream.set_write_timeout(Some(Duration::from_mins(2))).unwrap();
                send_on(stream, "POST", &target, &[], body).status
            })
        };
        let clients: Vec<_> = (0..24).map(ask).collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    assert!(statuses.iter().all(|status| [200, 201, 503].contains(status)), "{statuses:?}");
    // Both outcomes occur: the limit was reached, and not by the first request.
    assert!(statuses.contains(&503) && statuses.iter().any(|status| *status < 300), "{statuses:?}");
    let peak = service.memory("VmHWM");
    assert!(peak <= idle + BUDGET + OVERHEAD, "{peak} MiB at most, {idle} MiB idle: {statuses:?}");
    assert!(peak > idle + BUDGET / 2, "{peak} MiB at most, {idle} MiB idle: the load was too small");
    service.assert_memory_returns(idle + OVERHEAD);
    assert_eq!(service.stop("TERM").0, Some(0));
}

/// Attack: a request, the problem type of its response, and the maximum memory above that of an idle service, MiB.
struct Attack {
    name: &'static str,
    target: &'static str,
    header: (&'static str, &'static str),
    body: Vec<u8>,
    status: u16,
    slug: &'static str,
    memory: u64,
}

const NO_HEADER: (&str, &str) = ("accept", "*/*");
const GZIP: (&str, &str) = ("content-encoding", "gzip");
const JSON: (&str, &str) = ("content-type", "application/json");
const FORM: (&str, &str) = ("content-type", "multipart/form-data; boundary=XX");

fn attacks() -> Vec<Attack> {
    let attack = |name, target, header, body: Vec<u8>, (status, slug): (u16, &'static str), memory| Attack {
        name,
        target,
        header,
        body,
        status,
        slug,
        memory,
    };
    let identical = gzip(cli_support::pdb(&vec![[0.0; 3]; 300_000]).as_bytes());
    let dense: Vec<[f64; 3]> =
        (0..5000_u32).map(|i| [i % 20, i / 20 % 20, i / 400].map(|n| f64::from(n) * 0.1)).collect();
    let dense = cli_support::pdb(&dense).into_bytes();
    let picture = gzip(cli_support::block(20).as_bytes());
    vec![
        attack(
            "identical atoms",
            "/v1/meshes?radius_scale=10",
            GZIP,
            identical.clone(),
            (422, "too-many-duplicates"),
            BUDGET,
        ),
        attack(
            "identical atoms, estimate",
            "/v1/estimate?radius_scale=10",
            GZIP,
            identical,
            (422, "too-many-duplicates"),
            BUDGET,
        ),
        attack("sparse atoms", "/v1/meshes", NO_HEADER, lattice(), (422, "grid-too-large"), BUDGET),
        attack("sparse atoms, estimate", "/v1/estimate", NO_HEADER, lattice(), (200, "grid-too-large"), BUDGET),
        attack("run-length bomb", "/v1/meshes", NO_HEADER, run_length_bomb(), (422, "too-many-atoms"), 16),
        attack("gzip bomb", "/v1/meshes", GZIP, gzip_bomb(), (422, "too-much-memory"), BUDGET),
        attack("JSON of 20 MB", "/v1/meshes", JSON, vec![b'0'; 20_000_000], (413, "body-too-large"), 16),
        attack(
            "endless head of a part",
            "/v1/meshes",
            FORM,
            [b"--XX\r\na: ".to_vec(), vec![b'x'; 20_000_000]].concat(),
            (413, "body-too-large"),
            16,
        ),
        attack(
            "picture",
            "/v1/meshes?format=png&width=4096&height=4096",
            GZIP,
            picture,
            (422, "too-much-memory"),
            BUDGET,
        ),
        attack("copies of an assembly", "/v1/meshes?assembly=1", NO_HEADER, assembly(), (422, "too-many-copies"), 16),
        attack(
            "overlaps of spheres",
            "/v1/meshes?surface=ses&probe=10",
            NO_HEADER,
            dense,
            (422, "too-many-candidates"),
            BUDGET,
        ),
    ]
}

/// Returns a compressed file of 1 GiB.
fn gzip_bomb() -> Vec<u8> {
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    let piece = b"REMARK\n".repeat(1 << 17);
    for _ in 0..(1 << 30) / piece.len() {
        gzip.write_all(&piece).unwrap();
    }
    gzip.finish().unwrap()
}

/// Returns an XYZ file of a million atoms, 64 Å apart: each has bricks of the grid of its own.
fn lattice() -> Vec<u8> {
    let mut text = b"1000000\n\n".to_vec();
    for i in 0..1_000_000_u32 {
        let [x, y, z] = [i % 100, i / 100 % 100, i / 10_000].map(|n| n * 64);
        writeln!(text, "C {x} {y} {z}").unwrap();
    }
    text
}

/// Returns a BinaryCIF file of a few hundred bytes that declares 2³¹ atoms.
fn run_length_bomb() -> Vec<u8> {
    let n = i32::MAX;
    let runs = |name| column(name, i32s(&[0, n]), vec![run_length(i64::from(n)), byte_array(3)]);
    let all = ["Cartn_x", "Cartn_y", "Cartn_z", "auth_seq_id"].map(runs).to_vec();
    file(vec![block("x", vec![category("_atom_site", i64::from(n), all)])])
}

/// Returns an mmCIF file of one atom and an assembly of a trillion copies.
fn assembly() -> Vec<u8> {
    let columns = |category: &str, names: &[&str]| -> String {
        std::iter::once("loop_\n".to_owned()).chain(names.iter().map(|name| format!("{category}.{name}\n"))).collect()
    };
    let site = columns("_atom_site", &["type_symbol", "label_asym_id", "Cartn_x", "Cartn_y", "Cartn_z"]);
    let rules = columns("_pdbx_struct_assembly_gen", &["assembly_id", "oper_expression", "asym_id_list"]);
    let matrix = (1..4).flat_map(|i| (1..4).map(move |j| format!("matrix[{i}][{j}]")));
    let names: Vec<_> = matrix.chain((1..4).map(|i| format!("vector[{i}]"))).collect();
    let names: Vec<_> = std::iter::once("id").chain(names.iter().map(String::as_str)).collect();
    let operators = columns("_pdbx_struct_oper_list", &names);
    format!("data_x\n{site}C A 0 0 0\n{rules}1 '(1-1000000)(1-1000000)' A\n{operators}1 1 0 0 0 1 0 0 0 1 0 0 0\n")
        .into_bytes()
}

/// Every attack gets its problem within the budget, from a process that is limited to twice as much memory.
#[test]
fn attacks_are_refused_within_the_memory_limit() {
    let limit = MemoryLimit::new(LIMIT);
    for attack in attacks() {
        let folder = Folder::new();
        let budget = format!("limits.memory_bytes={BUDGET}MiB");
        let sets = [&budget, "limits.candidate_pairs=4000000"];
        let settings = [&["--devices", "cpu"][..], &sets.map(|set| ["--set", set]).concat()].concat();
        let mut service = Service::start_limited(&folder, &limit, &settings);
        let idle = service.memory("VmRSS");
        let reply = send(service.addr.parse().unwrap(), "POST", attack.target, &[attack.header], &attack.body);
        assert!(service.lives(), "{}: the process ended", attack.name);
        let used = service.memory("VmHWM").saturating_sub(idle);
        eprintln!("{}: {used} MiB above {idle} MiB", attack.name);
        if attack.status == 200 {
            // An estimate contains the problem that a mesh would get.
            assert_eq!(reply.json()["problem"]["type"], format!("/problems/{}", attack.slug), "{}", attack.name);
        } else {
            reply.problem(attack.status, attack.slug);
        }
        assert!(used <= attack.memory + OVERHEAD, "{}: {used} MiB above {idle} MiB", attack.name);
        assert_eq!(service.stop("TERM").0, Some(0), "{}", attack.name);
    }
}

/// Returns an mmCIF file of `n` residues with one atom, whose chain and residue have names of 255 characters. JSON and
/// CSV escape most of these.
fn long_names(n: usize) -> Vec<u8> {
    let name = format!("x{}", "\"".repeat(254));
    let mut text = b"data_x\nloop_\n".to_vec();
    for item in ["type_symbol", "label_atom_id", "label_comp_id", "auth_asym_id", "auth_seq_id"] {
        writeln!(text, "_atom_site.{item}").unwrap();
    }
    text.extend(b"_atom_site.Cartn_x\n_atom_site.Cartn_y\n_atom_site.Cartn_z\n");
    for i in 0..n {
        let [x, y, z] = [i % 100, i / 100 % 100, i / 10_000].map(|n| n * 8);
        writeln!(text, "C C {name} {name} {i} {x} {y} {z}").unwrap();
    }
    text
}

/// Documents about atoms are charged as they grow: they end with a problem, and the process lives.
#[test]
fn documents_with_long_names_stay_within_the_memory_limit() {
    let (folder, limit) = (Folder::new(), MemoryLimit::new(LIMIT));
    let budget = format!("limits.memory_bytes={BUDGET}MiB");
    let mut service = Service::start_limited(&folder, &limit, &["--devices", "cpu", "--set", &budget]);
    let addr = service.addr.parse().unwrap();
    let structure = |n: usize| {
        let reply = send(addr, "POST", "/v1/structures", &[GZIP], &gzip(&long_names(n)));
        assert_eq!(reply.status, 201, "{}", String::from_utf8_lossy(&reply.body));
        reply.header("location").unwrap().to_owned()
    };
    let [small, large] = [100, 150_000].map(structure);
    let idle = service.memory("VmRSS");
    for document in ["atoms", "atoms?positions=true&select=all", "areas?surface=sas", "areas?by=atom&surface=vdw"] {
        let get = |structure: &str| send(addr, "GET", &format!("{structure}/{document}"), &[], b"");
        let reply = get(&small);
        assert!(reply.status == 200 && reply.body.len() > 100 * 1000, "{document}: {}", reply.body.len());
        get(&large).problem(422, "too-much-memory");
        assert!(service.lives(), "{document}: the process ended");
    }
    assert_eq!(send(addr, "GET", &format!("{large}/colors?scheme=chain"), &[], b"").body.len(), 4 * 150_000);
    let used = service.memory("VmHWM").saturating_sub(idle);
    assert!(used <= BUDGET + OVERHEAD, "{used} MiB above {idle} MiB");
    assert_eq!(service.stop("TERM").0, Some(0));
}

/// Negative control: with a budget above the limit of the process, the same attack ends it.
#[test]
fn a_budget_above_the_limit_of_the_process_is_fatal() {
    let (folder, limit) = (Folder::new(), MemoryLimit::new(LIMIT));
    let mut service =
        Service::start_limited(&folder, &limit, &["--devices", "cpu", "--set", "limits.memory_bytes=8GiB"]);
    let mut client = connect(service.addr.parse().unwrap());
    let body = gzip_bomb();
    let head = format!(
        "POST /v1/meshes HTTP/1.1\r\nhost: localhost\r\n{}: {}\r\ncontent-length: {}\r\n\r\n",
        GZIP.0,
        GZIP.1,
        body.len()
    );
    client.write_all(head.as_bytes()).unwrap();
    drop(client.write_all(&body));
    let end = Instant::now() + Duration::from_mins(1);
    while service.lives() {
        assert!(Instant::now() < end, "the process has {} MiB and runs", service.memory("VmRSS"));
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// The default budget is half of the memory of the control group.
#[test]
fn the_default_budget_follows_the_control_group() {
    let limit = MemoryLimit::new(1000);
    let Some(printed) = limit.run(&["config", "print"]) else {
        return eprintln!("SKIPPED: no control group can be created");
    };
    let line = printed.lines().find(|line| line.starts_with("memory_bytes")).unwrap();
    assert_eq!(line, "memory_bytes = 524288000 # half of the 1000 MiB of this control group");
    let doctor = limit.run(&["doctor", "--listen", "127.0.0.1:0", "--devices", "cpu"]).unwrap();
    assert!(doctor.contains("500MiB limits.memory_bytes, half of the 1000 MiB of this control group"), "{doctor}");
}
