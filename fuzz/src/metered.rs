//! Comparison of the memory that jobs allocate with what they add to their meter.

use std::fmt::Write as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use molmesh::picture::SelectedRenderer;
use molmesh::pipeline::{self, Choice, JobLimits, Options, params};
use molmesh::structure::read_with;
use molmesh::surface::{Control, CpuBackend, MemoryMeter, OutOfMemory};

use crate::memory;

/// Memory that jobs need not add to their meter: small lists, texts, queues of threads.
const SLACK: u64 = 1 << 20;

/// Meter without a limit.
#[derive(Debug, Default)]
struct Meter {
    held: AtomicU64,
    most: AtomicU64,
}

impl MemoryMeter for Meter {
    fn grow(&self, bytes: u64) -> Result<(), OutOfMemory> {
        let held = self.held.fetch_add(bytes, Ordering::SeqCst) + bytes;
        self.most.fetch_max(held, Ordering::SeqCst);
        Ok(())
    }

    fn shrink(&self, bytes: u64) {
        self.held.fetch_sub(bytes, Ordering::SeqCst);
    }
}

/// Returns a PDB file of `side`³ carbon atoms on a lattice, in chains A and B.
fn atoms(side: i32, spacing: f64) -> String {
    let mut text = String::new();
    for i in 0..side * side * side {
        let [x, y, z] = [i % side, i / side % side, i / (side * side)].map(|i| spacing * f64::from(i));
        let chain = if 2 * i < side * side * side { 'A' } else { 'B' };
        writeln!(text, "ATOM      1  CA  ALA {chain}   1    {x:>8.3}{y:>8.3}{z:>8.3}  1.00  0.00           C").unwrap();
    }
    text
}

/// Kind of work.
#[derive(Clone, Copy, PartialEq)]
enum Work {
    Mesh,
    Picture,
    Estimate,
}

/// Runs a job. Returns the maximum of the memory that it allocated, and that of its meter.
fn peaks(text: &str, options: &Options, work: Work) -> [u64; 2] {
    let backend = CpuBackend::new(Some(2)).unwrap();
    let choice = Choice { backend: &backend, reason: "" };
    let limits = JobLimits::default();
    let run = |meter: Arc<Meter>| {
        let control = Control { memory: meter, ..Control::default() };
        if work == Work::Estimate {
            let read = |control: &Control<'_>| read_with(text.as_bytes(), &limits.read, control).map(Box::new);
            assert!(pipeline::estimate(read, options, &limits, &choice, &control).unwrap().mesh.is_ok());
            return;
        }
        let mut product = pipeline::run(text.as_bytes(), options, &limits, &choice, &control, &(), None).unwrap();
        if let Some(picture) = &options.picture {
            pipeline::draw(&mut product, picture, &SelectedRenderer::cpu(""), &control, &()).unwrap();
        }
    };
    // Threads keep buffers from job to job.
    run(Arc::default());
    let meter = Arc::new(Meter::default());
    let before = memory::restart();
    run(Arc::clone(&meter));
    [(memory::peak() - before) as u64, meter.most.load(Ordering::SeqCst)]
}

/// Name, structure file, work and parameters of a job.
type Case<'a> = (&'a str, &'a str, Work, &'a [(&'a str, &'a str)]);

/// Runs the jobs one after the other, because the allocator counts the memory of all threads.
#[test]
fn jobs_allocate_no_more_than_they_add_to_their_meter() {
    let (dense, sparse) = (atoms(40, 2.0), atoms(16, 64.0));
    let cases: [Case; 9] = [
        ("dense", &dense, Work::Mesh, &[("resolution", "0.8")]),
        ("sparse", &sparse, Work::Mesh, &[("resolution", "1")]),
        ("ses", &dense, Work::Mesh, &[("surface", "ses"), ("resolution", "1")]),
        ("split", &dense, Work::Mesh, &[("split", "chain"), ("resolution", "1")]),
        ("quantize", &dense, Work::Mesh, &[("compress", "quantize"), ("resolution", "0.8")]),
        ("colour", &dense, Work::Mesh, &[("color", "chain"), ("resolution", "1")]),
        ("picture", &dense, Work::Picture, &[("resolution", "1")]),
        ("estimate", &dense, Work::Estimate, &[("resolution", "0.8")]),
        ("sparse estimate", &sparse, Work::Estimate, &[("resolution", "1")]),
    ];
    let mut found = Vec::new();
    for (name, text, work, parameters) in cases {
        let format = (work == Work::Picture).then_some(("format", "png"));
        let options = params::parse(parameters.iter().copied().chain(format)).unwrap().options;
        let [allocated, metered] = peaks(text, &options, work);
        println!("{name}: {allocated} bytes allocated, {metered} metered");
        // Control: a meter that counts nothing would fail.
        assert!(allocated > 2 * SLACK, "{name}: {allocated}");
        if allocated > metered + SLACK {
            found.push(format!("{name}: {allocated} bytes allocated, {metered} metered"));
        }
    }
    assert!(found.is_empty(), "{found:#?}");
}
