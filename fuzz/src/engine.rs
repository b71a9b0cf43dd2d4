//! Loop of mutation and measurement, guided by coverage.

use std::fmt;
use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt as _;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use fastrand::Rng;

use crate::coverage::Coverage;
use crate::memory;
use crate::mutate::mutate;

/// Longest permitted time of one input.
pub(crate) const MAX_TIME: Duration = Duration::from_secs(1);
/// Time after which an input is assumed to run for ever.
const HANG: Duration = Duration::from_secs(30);
/// Runs of an input that exceeds [`MAX_TIME`]: the machine may have been busy.
const TRIES: usize = 3;
/// Length of mutated inputs, bytes, unless a seed is longer.
const MAX_LEN: usize = 32 << 10;

/// Function to fuzz, with its limits.
#[derive(Clone, Copy)]
pub(crate) struct Target {
    pub(crate) name: &'static str,
    /// Panics if an input violates a property.
    pub(crate) run: fn(&[u8]),
    /// Bytes that one input may allocate at most, at the same time.
    pub(crate) max_memory: usize,
    /// Returns the words of the format, for mutations.
    pub(crate) words: fn() -> Vec<String>,
}

/// Violation of a limit or a property.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Failure {
    Panic(String),
    Time(Duration),
    Memory { bytes: usize, max: usize },
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Panic(message) => write!(f, "panic: {message}"),
            Self::Time(time) => write!(f, "{time:.2?}, more than {MAX_TIME:?}"),
            Self::Memory { bytes, max } => write!(f, "{bytes} bytes of memory, more than {max}"),
        }
    }
}

/// Time and memory of one input.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Cost {
    pub(crate) time: Duration,
    pub(crate) bytes: usize,
}

/// Message of the first panic in any thread since it was last taken.
static PANIC: Mutex<Option<String>> = Mutex::new(None);
/// Start of the running input, ms since the start of the program; 0 between inputs.
static STARTED: AtomicU64 = AtomicU64::new(0);

/// Records panics of all threads, also those that the library catches, except those of the strict validator's parser,
/// which are known and reported to clients.
pub(crate) fn record_panics() {
    std::panic::set_hook(Box::new(|info| {
        let place = info.location().map_or_else(String::new, ToString::to_string);
        if place.contains("/pdbtbx-") {
            return;
        }
        let message = format!("{} ({place})", info.payload_as_str().unwrap_or("without a message"));
        eprintln!("panic: {message}");
        PANIC.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(message);
    }));
}

/// Ends the process if an input runs for longer than [`HANG`].
pub(crate) fn watch(name: &'static str) {
    let start = Instant::now();
    std::thread::spawn(move || {
        let mut last = (0, start);
        loop {
            std::thread::sleep(Duration::from_secs(1));
            let now = STARTED.load(Relaxed);
            if now != last.0 {
                last = (now, Instant::now());
            } else if now != 0 && last.1.elapsed() > HANG {
                eprintln!("{name}: an input runs for more than {HANG:?}");
                std::process::abort();
            }
        }
    });
}

/// Runs one input and measures it.
pub(crate) fn run(target: &Target, input: &[u8]) -> Result<Cost, Failure> {
    let first = run_once(target, input)?;
    let mut cost = first;
    for _ in 1..TRIES {
        if cost.time > MAX_TIME {
            cost.time = cost.time.min(run_once(target, input)?.time);
        }
    }
    if cost.time > MAX_TIME {
        return Err(Failure::Time(cost.time));
    }
    if cost.bytes > target.max_memory {
        return Err(Failure::Memory { bytes: cost.bytes, max: target.max_memory });
    }
    Ok(cost)
}

fn run_once(target: &Target, input: &[u8]) -> Result<Cost, Failure> {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    STARTED.store(COUNT.fetch_add(1, Relaxed) + 1, Relaxed);
    let before = memory::restart();
    let start = Instant::now();
    let ended = catch_unwind(AssertUnwindSafe(|| (target.run)(input)));
    let cost = Cost { time: start.elapsed(), bytes: memory::peak().saturating_sub(before) };
    STARTED.store(0, Relaxed);
    match PANIC.lock().unwrap_or_else(PoisonError::into_inner).take() {
        Some(message) => Err(Failure::Panic(message)),
        None if ended.is_err() => Err(Failure::Panic("without a message".to_owned())),
        None => Ok(cost),
    }
}

/// Result of fuzzing a target.
pub(crate) struct Summary {
    pub(crate) executions: u64,
    pub(crate) elapsed: Duration,
    pub(crate) n_inputs: usize,
    pub(crate) n_covered: usize,
    pub(crate) slowest: Duration,
    pub(crate) peak: usize,
}

/// Returns the seeds of a target, sorted by name.
pub(crate) fn seeds(folder: &Path) -> io::Result<Vec<(PathBuf, Vec<u8>)>> {
    let mut files = fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
    files.sort();
    files.into_iter().map(|path| fs::read(&path).map(|bytes| (path, bytes))).collect()
}

/// Error of fuzzing: a failure with the input that causes it, or an I/O error.
pub(crate) enum Error {
    Failed { failure: Failure, input: Vec<u8>, from: Option<PathBuf> },
    Io(io::Error),
}

impl From<io::Error> for Error {
    fn from(error: io::Error) -> Self {
        Self::Io(error)
    }
}

/// Fuzzes a target for `time`. Writes each input to `current` before it runs, so that it is known if the process dies,
/// and the slowest one to `slowest`.
pub(crate) fn fuzz(
    target: &Target,
    coverage: &mut Coverage,
    seeds: Vec<(PathBuf, Vec<u8>)>,
    out: &Path,
    time: Duration,
    seed: u64,
) -> Result<Summary, Error> {
    let start = Instant::now();
    let current = File::create(out.join("current"))?;
    let max_len = seeds.iter().map(|(_, bytes)| bytes.len()).fold(MAX_LEN, usize::max);
    let (mut executions, mut slowest, mut peak) = (0, Duration::ZERO, 0);
    let mut measure = |input: &[u8], from: Option<&Path>, coverage: &mut Coverage| -> Result<bool, Error> {
        current.write_all_at(input, 0)?;
        current.set_len(input.len() as u64)?;
        coverage.clear();
        let cost = run(target, input).map_err(|failure| Error::Failed {
            failure,
            input: input.to_vec(),
            from: from.map(Path::to_owned),
        })?;
        executions += 1;
        peak = peak.max(cost.bytes);
        if cost.time > slowest {
            slowest = cost.time;
            fs::write(out.join("slowest"), input)?;
        }
        Ok(coverage.merge())
    };
    // The first run creates servers and tables that exist once.
    if let Some((path, bytes)) = seeds.first() {
        measure(bytes, Some(path), coverage)?;
    }
    let mut inputs = Vec::new();
    for (path, bytes) in seeds {
        measure(&bytes, Some(&path), coverage)?;
        inputs.push(bytes);
    }
    let (mut rng, words) = (Rng::with_seed(seed), (target.words)());
    while start.elapsed() < time {
        // Recent inputs reach the least explored code.
        let first = if rng.bool() { 0 } else { inputs.len() * 3 / 4 };
        let mut input = inputs.get(rng.usize(first..inputs.len().max(first + 1))).cloned().unwrap_or_default();
        mutate(&mut rng, &mut input, &inputs, &words, max_len);
        if measure(&input, None, coverage)? {
            inputs.push(input);
        }
    }
    let (n_inputs, n_covered) = (inputs.len(), coverage.n_covered());
    Ok(Summary { executions, elapsed: start.elapsed(), n_inputs, n_covered, slowest, peak })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::targets::TARGETS;

    fn target(run: fn(&[u8])) -> Target {
        Target { name: "test", run, max_memory: 1 << 20, words: Vec::new }
    }

    /// The hook and the counters belong to the process, so one test uses them.
    #[test]
    fn seeds_and_mutations_pass_and_failures_are_found() {
        for target in TARGETS {
            assert!(!seeds(&crate::corpus(target.name)).unwrap().is_empty(), "{} has no seeds", target.name);
            // Without counters, all mutations start from seeds.
            let passed = crate::one(target.name, 1, fastrand::u64(..), Coverage::default());
            assert_eq!(passed, Ok(true), "{}", target.name);
        }
        // Negative controls.
        let panics = run(&target(|input| assert!(input.is_empty(), "not empty")), b"x");
        assert!(matches!(&panics, Err(Failure::Panic(why)) if why.starts_with("not empty")), "{panics:?}");
        let elsewhere = run(&target(|_| drop(std::thread::spawn(|| panic!("in a thread")).join())), b"");
        assert!(matches!(&elsewhere, Err(Failure::Panic(why)) if why.starts_with("in a thread")), "{elsewhere:?}");
        let slow = run(&target(|_| std::thread::sleep(MAX_TIME + Duration::from_millis(10))), b"");
        assert!(matches!(slow, Err(Failure::Time(_))), "{slow:?}");
        let large = run(&target(|_| drop(std::hint::black_box(vec![1_u8; 2 << 20]))), b"");
        assert!(matches!(large, Err(Failure::Memory { bytes, .. }) if bytes >= 2 << 20), "{large:?}");
        let small = run(&target(|_| drop(std::hint::black_box(vec![1_u8; 1 << 19]))), b"");
        assert!(small.as_ref().is_ok_and(|cost| cost.bytes >= 1 << 19), "{small:?}");
    }

    #[test]
    fn mutations_follow_their_seed() {
        let mutated = |seed| {
            let (mut rng, mut input) = (Rng::with_seed(seed), b"loop_ 12.5 'a'\n".repeat(9));
            mutate(&mut rng, &mut input, &[b"other".to_vec()], &["word".to_owned()], 200);
            input
        };
        assert_eq!(mutated(1), mutated(1));
        let different: std::collections::BTreeSet<_> = (0..100).map(mutated).collect();
        assert!(different.len() > 90 && different.iter().all(|input| input.len() <= 200), "{}", different.len());
    }
}
