//! `molmesh-bench service`: time of whole requests, as a client waits for them, on several backends in one run.
//!
//! Each upload has different bytes, so that no result is stored already. The backends take turns.

mod client;
mod process;

use std::collections::BTreeMap;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Map, Value, json};

use crate::error::{Error, Result};
use crate::stats::{Summary, digits};
use crate::structures::{self, SAMPLE, file_name};
use crate::{print, write_json};
use client::Client;
use process::Service;

/// Number of unmeasured requests for each structure and backend.
const WARM_UP: usize = 3;

/// Arguments of `molmesh-bench service`.
#[derive(Debug, clap::Args)]
pub(crate) struct ServiceArgs {
    /// Binary to measure
    #[arg(long, value_name = "FILE", default_value = "target/release/molmesh")]
    binary: PathBuf,
    /// Backends, each measured in its own process: cpu, gpu, auto
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "cpu,gpu")]
    backends: Vec<String>,
    /// Folder with structures, plain or compressed
    #[arg(long, value_name = "DIR", requires = "ids")]
    data: Option<PathBuf>,
    /// Structures of the folder; without a folder, the built-in sample is measured
    #[arg(long, value_name = "IDS", value_delimiter = ',', requires = "data")]
    ids: Vec<String>,
    /// Parameters of each request
    #[arg(long, value_name = "QUERY", default_value = "resolution=0.5&compress=quantize")]
    query: String,
    /// Number of measured requests of one client, for each structure and backend
    #[arg(long, value_name = "N", default_value_t = 21)]
    requests: usize,
    /// Number of simultaneous clients of the throughput measurement; 0 leaves it out
    #[arg(long, value_name = "N", default_value_t = 24)]
    clients: usize,
    /// Duration of a throughput measurement, s
    #[arg(long, value_name = "S", default_value_t = 5)]
    seconds: u64,
    /// Measure the first request of this number of new services instead
    #[arg(long, value_name = "N")]
    cold: Option<usize>,
    /// Further arguments of `molmesh serve`, such as `--set jobs.workers=4`
    #[arg(last = true, value_name = "ARGS")]
    serve: Vec<String>,
    /// Also write the results to this file, as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Folder for the log of each service, BACKEND.log
    #[arg(long, value_name = "FOLDER")]
    logs: Option<PathBuf>,
}

/// Structure whose uploads differ in a comment.
struct Structure {
    name: String,
    bytes: Vec<u8>,
}

impl Structure {
    /// Reads the structure of an entry and inflates it.
    fn load(folder: &Path, id: &str) -> Result<Self> {
        let path = structures::find(folder, id)?.ok_or_else(|| Error::failed(format!("there is no file of {id}")))?;
        let raw = std::fs::read(&path).map_err(Error::file(&path))?;
        let mut bytes = Vec::new();
        if raw.starts_with(&[0x1f, 0x8b]) {
            flate2::read::MultiGzDecoder::new(&raw[..]).read_to_end(&mut bytes).map_err(Error::file(&path))?;
        } else {
            bytes = raw;
        }
        let is_text = bytes.iter().take(200).all(u8::is_ascii);
        let text_only = || Error::failed(format!("{}: only PDB and mmCIF are measured", file_name(&path)));
        if is_text { Ok(Self { name: id.to_owned(), bytes }) } else { Err(text_only()) }
    }

    /// Returns the first line of an upload of the structure that no earlier upload has.
    fn mark(&self) -> String {
        static UPLOADS: AtomicU64 = AtomicU64::new(0);
        let n = UPLOADS.fetch_add(1, Ordering::Relaxed);
        let mark = if self.bytes.starts_with(b"data_") || self.bytes.starts_with(b"#") { "#" } else { "REMARK 999" };
        format!("{mark} {n}\n")
    }
}

/// Runs the command.
pub(crate) fn run(args: &ServiceArgs) -> Result<()> {
    if args.requests == 0 || args.backends.is_empty() {
        return Err(Error::Usage("--requests must be at least 1, and --backends must name one".to_owned()));
    }
    let structures = match &args.data {
        Some(folder) => args.ids.iter().map(|id| Structure::load(folder, id)).collect::<Result<Vec<_>>>()?,
        None => vec![Structure { name: "4pti".to_owned(), bytes: SAMPLE.to_vec() }],
    };
    let start = |backend: &String| Service::start(&args.binary, backend, &args.serve, args.logs.as_deref());
    if let Some(n) = args.cold {
        return cold(args, &structures, n, start);
    }
    let services = args.backends.iter().map(start).collect::<Result<Vec<_>>>()?;
    let mut results = Vec::new();
    for structure in &structures {
        let latency = latency(args, structure, &services)?;
        let known = known_structure(args, structure, &services)?;
        let rates = if args.clients > 0 { throughput(args, structure, &services)? } else { Vec::new() };
        print(&table(&structure.name, &args.backends, &latency, &known, &rates))?;
        results.push(json!({
            "structure": structure.name, "bytes": structure.bytes.len(), "milliseconds": latency,
            "known_structure_milliseconds": known, "meshes_per_second": rates,
        }));
        // After each structure, so that a run that is stopped leaves results.
        write_results(args, &results)?;
    }
    Ok(())
}

fn write_results(args: &ServiceArgs, rows: &[Value]) -> Result<()> {
    let results = json!({
        "backends": args.backends, "query": args.query, "clients": args.clients, "serve": args.serve, "rows": rows,
    });
    write_json(args.json.as_deref(), &results)
}

/// Measures the first request of `n` new services for each structure and backend.
fn cold(
    args: &ServiceArgs,
    structures: &[Structure],
    n: usize,
    start: impl Fn(&String) -> Result<Service>,
) -> Result<()> {
    let mut results = Vec::new();
    for structure in structures {
        let mut times = vec![Vec::new(); args.backends.len()];
        for _ in 0..n {
            for (backend, times) in args.backends.iter().zip(&mut times) {
                let service = start(backend)?;
                let mut client = Client::connect(service.addr)?;
                times.push(timed(|| upload(args, structure, &mut client))?);
            }
        }
        let times: Vec<Parts> = times.into_iter().map(parts).collect();
        print(&table(&structure.name, &args.backends, &times, &[], &[]))?;
        results.push(json!({ "structure": structure.name, "first_request_milliseconds": times }));
        write_results(args, &results)?;
    }
    Ok(())
}

/// Times of a request by part, ms: the entries of its `Server-Timing`, and `request` as the client measured it.
type Parts = BTreeMap<String, Summary>;

/// Sends one request after the other, to each service in turn.
fn in_turn(
    args: &ServiceArgs,
    services: &[Service],
    ask: impl Fn(usize, &mut Client) -> Result<Map<String, Value>>,
) -> Result<Vec<Parts>> {
    let mut clients = services.iter().map(|service| Client::connect(service.addr)).collect::<Result<Vec<_>>>()?;
    let mut times = vec![Vec::new(); services.len()];
    for round in 0..WARM_UP + args.requests {
        for (n, client) in clients.iter_mut().enumerate() {
            let timing = timed(|| ask(n, client))?;
            if round >= WARM_UP {
                times[n].push(timing);
            }
        }
    }
    Ok(times.into_iter().map(parts).collect())
}

/// Sends a request. Returns its `Server-Timing` with the time that the client waited, ms.
fn timed(ask: impl FnOnce() -> Result<Map<String, Value>>) -> Result<Map<String, Value>> {
    let begin = Instant::now();
    let mut timing = ask()?;
    timing.insert("request".to_owned(), (begin.elapsed().as_secs_f64() * 1e3).into());
    Ok(timing)
}

/// Summarizes the times of several requests.
fn parts(requests: Vec<Map<String, Value>>) -> Parts {
    let mut times = BTreeMap::<String, Vec<f64>>::new();
    for (part, ms) in requests.into_iter().flatten() {
        times.entry(part).or_default().push(ms.as_f64().unwrap_or_default());
    }
    times.into_iter().map(|(part, ms)| (part, Summary::of(ms).rounded())).collect()
}

/// Uploads the structure and receives its mesh.
fn upload(args: &ServiceArgs, structure: &Structure, client: &mut Client) -> Result<Map<String, Value>> {
    let target = format!("/v1/meshes?{}", args.query);
    client.timing("POST", &target, &[structure.mark().as_bytes(), &structure.bytes])
}

/// Measures requests that upload the structure.
fn latency(args: &ServiceArgs, structure: &Structure, services: &[Service]) -> Result<Vec<Parts>> {
    in_turn(args, services, |_, client| upload(args, structure, client))
}

/// Measures requests for a structure that the service has, each with another isovalue.
fn known_structure(args: &ServiceArgs, structure: &Structure, services: &[Service]) -> Result<Vec<Parts>> {
    let mut digests = Vec::new();
    for service in services {
        let mark = structure.mark();
        digests.push(Client::connect(service.addr)?.upload(&[mark.as_bytes(), &structure.bytes])?);
    }
    let count = AtomicU64::new(0);
    in_turn(args, services, |n, client| {
        let isovalue = 1.0 + 1e-4 * count.fetch_add(1, Ordering::Relaxed) as f64;
        let target = format!("/v1/structures/{}/surface.glb?{}&isovalue={isovalue:.4}", digests[n], args.query);
        client.timing("GET", &target, &[])
    })
}

/// Measures the meshes per second of many clients that upload different content, on each service alone, twice in turn.
fn throughput(args: &ServiceArgs, structure: &Structure, services: &[Service]) -> Result<Vec<f64>> {
    let mut rates = vec![0.0_f64; services.len()];
    for _ in 0..2 {
        for (service, best) in services.iter().zip(&mut rates) {
            let end = Instant::now() + Duration::from_secs(args.seconds);
            let client = || -> Result<u64> {
                let (mut client, mut n) = (Client::connect(service.addr)?, 0);
                while Instant::now() < end {
                    upload(args, structure, &mut client)?;
                    n += 1;
                }
                Ok(n)
            };
            let begin = Instant::now();
            let counts: Vec<Result<u64>> = std::thread::scope(|scope| {
                let clients: Vec<_> = (0..args.clients).map(|_| scope.spawn(client)).collect();
                let panicked = |_| Err(Error::failed("a client panicked"));
                clients.into_iter().map(|client| client.join().unwrap_or_else(panicked)).collect()
            });
            let n: u64 = counts.into_iter().sum::<Result<u64>>()?;
            *best = best.max(digits(n as f64 / begin.elapsed().as_secs_f64()));
        }
    }
    Ok(rates)
}

/// Formats the results of a structure as Markdown: medians in ms, and meshes per second.
fn table(name: &str, backends: &[String], latency: &[Parts], known: &[Parts], rates: &[f64]) -> String {
    let parts: Vec<&String> =
        latency.iter().flat_map(BTreeMap::keys).collect::<std::collections::BTreeSet<_>>().into_iter().collect();
    let mut text = format!("\n{name}, median ms\n\n| backend |");
    text.extend(parts.iter().map(|part| format!(" {part} |")));
    text += " known: request | total | read | meshes/s |\n|---|";
    text += &"---|".repeat(parts.len() + 4);
    let none = Parts::new();
    let of = |parts: &Parts, part: &str| parts.get(part).map_or_else(|| "–".to_owned(), |s| format!("{:.2}", s.median));
    for (n, backend) in backends.iter().enumerate() {
        text.extend([format!("\n| {backend} |")]);
        text.extend(parts.iter().map(|part| format!(" {} |", of(&latency[n], part))));
        let known = known.get(n).unwrap_or(&none);
        text.extend(["request", "total", "read"].map(|part| format!(" {} |", of(known, part))));
        text += &rates.get(n).map_or_else(|| " – |".to_owned(), |rate| format!(" {rate:.1} |"));
    }
    text + "\n"
}
