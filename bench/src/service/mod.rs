//! `molmesh-bench service`: time of whole requests, as a client waits for them, on several backends in one run.
//!
//! Every upload has other bytes, so that no result is stored already. The backends take turns.

mod client;
mod process;

use std::collections::BTreeMap;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::error::{Error, Result};
use crate::print;
use crate::stats::{Summary, digits};
use crate::structures::{self, SAMPLE, file_name};
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
    /// Further arguments of `molmesh serve`, such as `--set devices.jobs=4`
    #[arg(last = true, value_name = "ARGS")]
    serve: Vec<String>,
    /// Also write the results to this file, as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
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

    /// Returns an upload that no earlier call has returned.
    fn upload(&self) -> Vec<u8> {
        static UPLOADS: AtomicU64 = AtomicU64::new(0);
        let n = UPLOADS.fetch_add(1, Ordering::Relaxed);
        let mark = if self.bytes.starts_with(b"data_") || self.bytes.starts_with(b"#") { "#" } else { "REMARK 999" };
        [format!("{mark} {n}\n").as_bytes(), &self.bytes].concat()
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
    let start = |backend: &String| Service::start(&args.binary, backend, &args.serve);
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
    }
    let Some(path) = &args.json else { return Ok(()) };
    let results = json!({ "backends": args.backends, "query": args.query, "clients": args.clients, "rows": results });
    std::fs::write(path, format!("{results:#}\n")).map_err(Error::file(path))
}

/// Times of a request by part, ms: the entries of its `Server-Timing`, and `request` as the client measured it.
type Parts = BTreeMap<String, Summary>;

/// Sends one request after the other, to each service in turn.
fn in_turn(
    args: &ServiceArgs,
    services: &[Service],
    ask: impl Fn(usize, &mut Client) -> Result<Value>,
) -> Result<Vec<Parts>> {
    let mut clients = services.iter().map(|service| Client::connect(service.addr)).collect::<Result<Vec<_>>>()?;
    let mut times: Vec<BTreeMap<String, Vec<f64>>> = vec![BTreeMap::new(); services.len()];
    for round in 0..WARM_UP + args.requests {
        for (n, client) in clients.iter_mut().enumerate() {
            let begin = Instant::now();
            let timing = ask(n, client)?;
            let waited = begin.elapsed().as_secs_f64() * 1e3;
            if round < WARM_UP {
                continue;
            }
            times[n].entry("request".to_owned()).or_default().push(waited);
            for (part, ms) in timing.as_object().into_iter().flatten() {
                times[n].entry(part.clone()).or_default().push(ms.as_f64().unwrap_or_default());
            }
        }
    }
    let summary = |parts: BTreeMap<String, Vec<f64>>| {
        parts.into_iter().map(|(part, ms)| (part, Summary::of(ms).rounded())).collect()
    };
    Ok(times.into_iter().map(summary).collect())
}

/// Measures requests that upload the structure.
fn latency(args: &ServiceArgs, structure: &Structure, services: &[Service]) -> Result<Vec<Parts>> {
    let target = format!("/v1/meshes?{}", args.query);
    in_turn(args, services, |_, client| {
        let upload = structure.upload();
        client.timing("POST", &target, &upload)
    })
}

/// Measures requests for a structure that the service has, each with another isovalue.
fn known_structure(args: &ServiceArgs, structure: &Structure, services: &[Service]) -> Result<Vec<Parts>> {
    let mut digests = Vec::new();
    for service in services {
        digests.push(Client::connect(service.addr)?.upload(&structure.upload())?);
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
    let target = format!("/v1/meshes?{}", args.query);
    let mut rates = vec![0.0_f64; services.len()];
    for _ in 0..2 {
        for (service, best) in services.iter().zip(&mut rates) {
            let end = Instant::now() + Duration::from_secs(args.seconds);
            let client = || -> Result<u64> {
                let (mut client, mut n) = (Client::connect(service.addr)?, 0);
                while Instant::now() < end {
                    client.timing("POST", &target, &structure.upload())?;
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
    let of = |parts: &Parts, part: &str| parts.get(part).map_or_else(|| "–".to_owned(), |s| format!("{:.2}", s.median));
    for (n, backend) in backends.iter().enumerate() {
        text.extend([format!("\n| {backend} |")]);
        text.extend(parts.iter().map(|part| format!(" {} |", of(&latency[n], part))));
        text.extend(["request", "total", "read"].map(|part| format!(" {} |", of(&known[n], part))));
        text += &rates.get(n).map_or_else(|| " – |".to_owned(), |rate| format!(" {rate:.1} |"));
    }
    text + "\n"
}
