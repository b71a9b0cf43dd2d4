//! Fuzzing of molmesh: runs mutated inputs through readers, configuration, keys, records and HTTP requests, and fails
//! on a panic, on an input that takes more than a second, and on one that exceeds the memory of its target.
//!
//! `make fuzz` builds it with `rustc.sh`, which adds the counters that guide the mutations. Each target runs in a
//! process of its own. A failing input is saved below `target/fuzz`.

mod coverage;
mod engine;
mod memory;
#[cfg(test)]
mod metered;
mod mutate;
mod targets;

use std::collections::VecDeque;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode};
use std::time::Duration;

use clap::{Parser, Subcommand};

use coverage::Coverage;
use engine::{Error, Target};
use targets::TARGETS;

#[global_allocator]
static ALLOCATOR: memory::Counting = memory::Counting;

/// Fuzzing of molmesh. Without a command, it fuzzes every target.
#[derive(Parser)]
struct Args {
    #[command(subcommand)]
    command: Option<Action>,
    /// Time per target, s.
    #[arg(long, global = true, default_value_t = 30)]
    seconds: u64,
    /// Seed of the random numbers. Default: random, and printed.
    #[arg(long, global = true)]
    seed: Option<u64>,
    /// Targets that run at the same time.
    #[arg(long, default_value_t = 2)]
    parallel: usize,
}

#[derive(Subcommand)]
enum Action {
    /// Fuzzes one target.
    Target { name: String },
    /// Runs files through one target.
    Replay { name: String, files: Vec<PathBuf> },
}

fn main() -> ExitCode {
    let args = Args::parse();
    let seed = args.seed.unwrap_or_else(|| fastrand::u64(..));
    let done = match &args.command {
        None => all(args.seconds, seed, args.parallel.max(1)),
        Some(Action::Target { name }) => Coverage::new()
            .ok_or("built without coverage: use `make fuzz`, or set RUSTC_WORKSPACE_WRAPPER".to_owned())
            .and_then(|coverage| one(name, args.seconds, seed, coverage)),
        Some(Action::Replay { name, files }) => replay(name, files),
    };
    match done {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::from(2)
        }
    }
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the folder of a target's seeds.
fn corpus(name: &str) -> PathBuf {
    root().join("corpus").join(name)
}

fn out(name: &str) -> PathBuf {
    root().join("../target/fuzz").join(name)
}

fn target(name: &str) -> Result<&'static Target, String> {
    let names = || TARGETS.iter().map(|target| target.name).collect::<Vec<_>>().join(", ");
    TARGETS.iter().find(|target| target.name == name).ok_or_else(|| format!("no target `{name}`; expected {}", names()))
}

/// Fuzzes all targets, each in a process of its own. Returns true if none failed.
fn all(seconds: u64, seed: u64, parallel: usize) -> Result<bool, String> {
    let failed = |name: &str, error: io::Error| format!("{name}: {error}");
    let program = std::env::current_exe().map_err(|error| failed("the program", error))?;
    let mut running: VecDeque<(&str, Child)> = VecDeque::new();
    let mut waiting: VecDeque<&Target> = TARGETS.iter().collect();
    let mut sound = true;
    loop {
        while running.len() < parallel
            && let Some(target) = waiting.pop_front()
        {
            let mut command = Command::new(&program);
            command.args(["target", target.name, "--seconds", &seconds.to_string(), "--seed", &seed.to_string()]);
            // One thread: a deterministic order, and counters without races.
            command.env("RAYON_NUM_THREADS", "1");
            running.push_back((target.name, command.spawn().map_err(|error| failed(target.name, error))?));
        }
        let Some((name, mut child)) = running.pop_front() else { return Ok(sound) };
        let status = child.wait().map_err(|error| failed(name, error))?;
        if !status.success() {
            sound = false;
            if status.code().is_none() {
                eprintln!("{name}: {status}; the input is {}", out(name).join("current").display());
            }
        }
    }
}

/// Fuzzes one target. Returns true if it did not fail.
fn one(name: &str, seconds: u64, seed: u64, mut coverage: Coverage) -> Result<bool, String> {
    let target = target(name)?;
    let (folder, text) = (out(name), |error: io::Error| format!("{name}: {error}"));
    fs::create_dir_all(&folder).map_err(text)?;
    engine::record_panics();
    engine::watch(target.name);
    let seeds = engine::seeds(&corpus(name)).map_err(text)?;
    match engine::fuzz(target, &mut coverage, seeds, &folder, Duration::from_secs(seconds), seed) {
        Ok(s) => {
            let rate = s.executions as f64 / s.elapsed.as_secs_f64();
            println!(
                "{name}: seed {seed}, {} executions ({rate:.0}/s), {} inputs cover {} branches, slowest {:.1?}, peak {:.1} MiB",
                s.executions,
                s.n_inputs,
                s.n_covered,
                s.slowest,
                s.peak as f64 / f64::from(1 << 20),
            );
            Ok(true)
        }
        Err(Error::Io(error)) => Err(text(error)),
        Err(Error::Failed { failure, input, from }) => {
            let path = if let Some(seed) = from {
                seed
            } else {
                let path = folder.join("failed");
                fs::write(&path, input).map_err(text)?;
                path
            };
            eprintln!("{name}: seed {seed}, FAILED: {failure}; the input is {}", path.display());
            Ok(false)
        }
    }
}

/// Runs files through a target. Returns true if none failed.
fn replay(name: &str, files: &[PathBuf]) -> Result<bool, String> {
    let target = target(name)?;
    engine::record_panics();
    let mut sound = true;
    for path in files {
        let bytes = fs::read(path).map_err(|error| format!("{}: {error}", path.display()))?;
        match engine::run(target, &bytes) {
            Ok(cost) => println!("{}: {:.1?}, {} bytes of memory", path.display(), cost.time, cost.bytes),
            Err(failure) => {
                sound = false;
                println!("{}: FAILED: {failure}", path.display());
            }
        }
    }
    Ok(sound)
}
