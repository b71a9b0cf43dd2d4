//! Bad input over a real socket: every row of a table gets the expected status, problem and number within a time limit,
//! and the server keeps running. The command line exits with the expected code on the same rows.

mod rows;

use crate::cli_support;
use crate::http_support;

use std::io::Write;
use std::process::{Output, Stdio};
use std::sync::{Arc, Once};
use std::time::{Duration, Instant};

use http_support::{Reply, Running, SAMPLE, send, start};
use molmesh::surface::cpu::CpuBackend;
use rows::{ATOMS, BODY_BYTES, INFLATED_BYTES, Is, Row, rows};
use serde_json::Value;

/// Time limit of a response. Unoptimized builds are slower.
const IN_TIME: Duration = Duration::from_millis(if cfg!(debug_assertions) { 3000 } else { 100 });
/// Number of slowest rows to print.
const SHOWN: usize = 8;

static QUIET: Once = Once::new();

fn server() -> Running {
    // As `molmesh serve` does: the strict validator panics at some rows, which is caught and silent.
    QUIET.call_once(molmesh::structure::strict_validator::quiet_panics);
    let server = start(Arc::new(CpuBackend::new(None).unwrap()), |c| {
        c.limits.body_bytes = BODY_BYTES;
        c.limits.inflated_bytes = INFLATED_BYTES;
        c.limits.atoms = ATOMS;
    });
    let archive = server.dir.path().join("archive");
    std::fs::create_dir_all(&archive).unwrap();
    std::fs::write(archive.join("1bad.cif"), "noise").unwrap();
    server
}

fn ask(server: &Running, row: &Row) -> Reply {
    let path = if row.query.is_empty() { row.path.clone() } else { format!("{}?{}", row.path, row.query) };
    send(server.addr, row.method, &path, &row.headers, &row.body)
}

/// Returns the differences between a response and its row.
fn faults(row: &Row, reply: &Reply, time: Duration) -> Vec<String> {
    let mut faults = Vec::new();
    let mut check = |right: bool, what: String| {
        if !right {
            faults.push(format!("{}: {what}", row.name));
        }
    };
    let text = String::from_utf8_lossy(&reply.body[..reply.body.len().min(2000)]).into_owned();
    check(reply.complete, "the response is incomplete".to_owned());
    check(time <= IN_TIME, format!("took {time:?}, {IN_TIME:?} are allowed"));
    check(reply.status == row.status, format!("status {} instead of {}: {text}", reply.status, row.status));
    if row.slug.is_empty() {
        check(reply.body.starts_with(b"glTF"), "the response is not a GLB".to_owned());
    } else {
        let kind = reply.header("content-type");
        check(kind == Some("application/problem+json"), format!("the response is {kind:?}"));
    }
    let document: Value = serde_json::from_slice(&reply.body).unwrap_or(Value::Null);
    if !row.slug.is_empty() {
        let slug = format!("/problems/{}", row.slug);
        check(document["type"] == *slug, format!("type {} instead of {slug}", document["type"]));
        check(document["status"] == row.status, format!("the document's status is {}", document["status"]));
        let detail = document["detail"].as_str().unwrap_or_default();
        check((1..1000).contains(&detail.len()), format!("a detail of {} bytes", detail.len()));
    }
    for (name, is) in &row.named {
        let value = match reply.header(name) {
            Some(header) if row.slug.is_empty() => serde_json::from_str(header).unwrap_or(Value::Null),
            _ => document[*name].clone(),
        };
        check(!value.is_null() && is.fits(&value), format!("`{name}` is {value}, not {is:?}: {text}"));
    }
    faults
}

/// Sends a row and checks the response. Repeats slow rows up to twice, as other load may cause a delay.
fn drive(server: &Running, row: &Row) -> (Vec<String>, Duration) {
    let mut fastest = Duration::MAX;
    let mut last = Vec::new();
    for _ in 0..3 {
        let start = Instant::now();
        let reply = ask(server, row);
        fastest = fastest.min(start.elapsed());
        last = faults(row, &reply, fastest);
        if server.get("/livez").status != 200 {
            last.push(format!("{}: the server is down", row.name));
        }
        if fastest <= IN_TIME {
            break;
        }
    }
    (last, fastest)
}

#[test]
fn every_row_gets_its_response_in_time_and_the_server_keeps_running() {
    let server = server();
    let good = || {
        let reply = server.post("/v1/meshes?resolution=1", &[], SAMPLE);
        assert!(reply.status == 200 && reply.body.starts_with(b"glTF"), "{}", reply.status);
        reply.body
    };
    let before = good();
    let rows = rows();
    assert!(rows.len() >= 45, "{} rows", rows.len());
    let mut names: Vec<&str> = rows.iter().map(|row| row.name).collect();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), rows.len(), "two rows have the same name");

    let mut wrong = Vec::new();
    let mut times = Vec::new();
    for row in &rows {
        assert!(!row.named.is_empty(), "{}: no expected member", row.name);
        let (faults, time) = drive(&server, row);
        wrong.extend(faults);
        times.push((time, row.name));
    }
    times.sort_unstable_by(|a, b| b.cmp(a));
    eprintln!("{} rows; the slowest, at most {IN_TIME:?} each:", rows.len());
    for (time, name) in &times[..SHOWN] {
        eprintln!("{:9.2} ms  {name}", time.as_secs_f64() * 1e3);
    }
    assert!(wrong.is_empty(), "{} faults:\n{}", wrong.len(), wrong.join("\n"));
    assert!(good() == before, "the same file gives a different mesh");
    assert!(server.metric("molmesh_panics_total", &[]) == 0.0, "something panicked");
}

/// Converts the parameters of a row to flags.
fn flags(query: &str) -> Vec<String> {
    let pairs = query.split('&').filter_map(|pair| pair.split_once('='));
    pairs.map(|(name, value)| format!("--{}={value}", name.replace('_', "-"))).collect()
}

/// Runs `molmesh mesh - -o -` with the server's limits. The command may exit before it reads its input.
fn mesh(row: &Row) -> Output {
    let mut command = cli_support::molmesh();
    let limits = [
        format!("--max-input-bytes={INFLATED_BYTES}"),
        format!("--max-atoms={ATOMS}"),
        format!("--max-grid-points={}", 1 << 30),
    ];
    command.args(["mesh", "-", "-o", "-", "--quiet"]).args(limits).args(flags(&row.query));
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdin.take().unwrap().write_all(&row.body));
    child.wait_with_output().unwrap()
}

#[test]
fn exit_codes_match_the_responses_of_the_server() {
    let mut wrong = Vec::new();
    let mut seen = [0; 8];
    for row in rows() {
        let Some(exit) = row.exit else { continue };
        let done = mesh(&row);
        let stderr = String::from_utf8_lossy(&done.stderr).into_owned();
        if done.status.code() != Some(exit) {
            wrong.push(format!("{}: {:?} instead of {exit}: {stderr}", row.name, done.status.code()));
        }
        let mesh = done.stdout.starts_with(b"glTF");
        let quiet = if exit == 0 { mesh } else { done.stdout.is_empty() && stderr.starts_with("molmesh: ") };
        if !quiet || stderr.contains("panicked") || stderr.chars().any(|c| c.is_control() && c != '\n') {
            wrong.push(format!("{}: {} bytes of output, and {stderr}", row.name, done.stdout.len()));
        }
        seen[usize::try_from(exit).unwrap()] += 1;
    }
    assert!(wrong.is_empty(), "{} faults:\n{}", wrong.len(), wrong.join("\n"));
    eprintln!("rows by exit code 0 to 7: {seen:?}");
    assert!([0, 2, 4, 5].iter().all(|&code| seen[code] >= 3), "{seen:?}");
}

#[test]
fn control_wrong_expectations_are_detected() {
    let server = server();
    let of = |name: &str| rows().into_iter().find(|row| row.name == name).unwrap();
    let good = of("mmCIF with NaN");
    assert_eq!(drive(&server, &good).0, Vec::<String>::new());
    let named = |named| Row { named, ..good.clone() };
    let one = |name, is| named(vec![(name, is)]);
    for (wrong, expected) in [
        (Row { status: 400, ..good.clone() }, "status 422 instead of 400"),
        (Row { slug: "no-atoms", ..good.clone() }, "instead of /problems/no-atoms"),
        (Row { slug: "", status: 200, ..good.clone() }, "not a GLB"),
        (one("line", Is::Equal(10.into())), "`line` is 9"),
        (one("column", Is::Above(11.0)), "`column` is 11"),
        (one("expected", Is::Contains("Cartn_z")), "`expected` is"),
        (one("limit", Is::Contains("")), "`limit` is null"),
        (Row { slug: "unreadable-structure", status: 422, ..of("Latin-1") }, "status 200 instead of 422"),
        (Row { named: vec![("molmesh-atoms", Is::Equal(2.into()))], ..of("Latin-1") }, "`molmesh-atoms` is 1"),
    ] {
        let (faults, _) = drive(&server, &wrong);
        assert!(faults.iter().any(|fault| fault.contains(expected)), "{expected}: {faults:?}");
    }
    let reply = ask(&server, &good);
    let late = faults(&good, &reply, IN_TIME + Duration::from_millis(1));
    assert!(late.len() == 1 && late[0].contains("took"), "{late:?}");
}
