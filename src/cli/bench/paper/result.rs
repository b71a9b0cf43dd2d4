//! What was measured, as data: what the JSON file holds, and what tables and figures are made of.

use serde::{Deserialize, Serialize};

use super::super::measure::Spread;

/// Everything that one command measured on one machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(in crate::cli::bench) struct Document {
    /// `molmesh bench paper`: tells these files from others.
    pub(super) made_by: String,
    /// The version that measured.
    pub(super) version: String,
    /// When it was begun, RFC 3339.
    pub(super) date: String,
    pub(super) machine: Machine,
    /// The GPU, if one was used.
    pub(super) device: Option<Device>,
    /// The paper's tables, row by row.
    pub(super) rows: Vec<Row>,
    /// Time and memory against atoms.
    pub(super) growth: Option<Growth>,
    /// The device's stages against what it can do.
    pub(super) roofline: Vec<Roofline>,
}

/// What `made_by` says.
pub(super) const MADE_BY: &str = "molmesh bench paper";

/// A machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Machine {
    /// The processor's own name; empty where the system does not say.
    pub(super) cpu: String,
    /// Cores for this process, and threads of the native backend.
    pub(super) cores: usize,
    pub(super) threads: usize,
    pub(super) memory_bytes: Option<u64>,
    pub(super) os: String,
}

/// A device.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Device {
    pub(super) name: String,
    pub(super) driver: String,
    /// Whether it is a processor that plays a GPU: its speed says nothing of one.
    pub(super) software: bool,
}

/// One structure with one kernel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Row {
    pub(super) id: String,
    pub(super) kernel: String,
    /// Atoms that the paper counts.
    pub(super) paper_atoms: usize,
    /// Atoms that were meshed.
    pub(super) atoms: usize,
    pub(super) source: String,
    /// Whether it is another structure than the paper's.
    pub(super) stand_in: bool,
    /// By the paper's Table 1 and Table 2.
    pub(super) cpu: Side,
    pub(super) gpu: Side,
}

/// What belongs to one of the paper's tables.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Side {
    pub(super) paper_seconds: f64,
    pub(super) paper_cubes: u64,
    /// Cubes that the dense program of this side visits: the reference, or the 2010 program.
    pub(super) cubes: u64,
    /// Å.
    pub(super) spacing: f64,
    /// The dense program, then ours.
    pub(super) baseline: Cell,
    pub(super) ours: Cell,
    /// Triangles of the native CPU backend on this side's grid, where it ran.
    pub(super) triangles: Option<usize>,
}

/// One program on one structure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Cell {
    pub(super) program: String,
    pub(super) timed: Option<Timed>,
    /// Why it did not run, where it did not.
    pub(super) not_run: Option<String>,
}

impl Cell {
    /// From spheres to a mesh in the host's memory, s, median.
    pub(super) fn seconds(&self) -> Option<f64> {
        self.timed.as_ref().map(|t| t.seconds.median)
    }

    /// The stages on the device, summed, s, median.
    pub(super) fn device_seconds(&self) -> Option<f64> {
        self.timed.as_ref().and_then(|t| t.device_seconds).map(|s| s.median)
    }
}

/// What was measured of a program on a structure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Timed {
    /// Measured runs.
    pub(super) runs: usize,
    /// From spheres to a mesh in the host's memory.
    pub(super) seconds: Spread,
    /// The stages on the device, summed; none on the CPU and where the device has no clock.
    pub(super) device_seconds: Option<Spread>,
    /// Medians by stage, s: by the device's clock on a device, wall time on the CPU.
    pub(super) stages: Vec<(String, f64)>,
    pub(super) triangles: usize,
    /// Most memory of the process during a run, where the system says so.
    pub(super) host_bytes: Option<u64>,
    /// Memory of the device that the program holds afterwards.
    pub(super) device_bytes: Option<u64>,
}

/// Time and memory against atoms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Growth {
    /// What grows, in words.
    pub(super) structure: String,
    /// Å.
    pub(super) spacing: f64,
    pub(super) series: Vec<Series>,
}

/// One program's series.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Series {
    pub(super) program: String,
    pub(super) points: Vec<Point>,
    /// Why it ends where it ends, if before the others.
    pub(super) ends: Option<String>,
}

/// One size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Point {
    pub(super) atoms: usize,
    pub(super) timed: Timed,
}

/// The device's stages against what it can do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Roofline {
    /// What ran, in words.
    pub(super) structure: String,
    /// Bytes a second of a shader that copies, and multiply-adds a second of one that does nothing else.
    pub(super) memory_rate: f64,
    pub(super) fma_rate: f64,
    pub(super) stages: Vec<StageFacts>,
}

/// One stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct StageFacts {
    /// `gpu` or `paper`.
    pub(super) program: String,
    pub(super) stage: String,
    /// Threads of a workgroup, and the bytes that it shares.
    pub(super) workgroup_size: u32,
    pub(super) workgroup_bytes: u32,
    /// Workgroups of the run, where they are counted.
    pub(super) workgroups: Option<u64>,
    /// Least work: bytes that move, multiply-adds; none for the baseline, whose work is not counted.
    pub(super) bytes: Option<f64>,
    pub(super) fmas: Option<f64>,
    /// Median device time, s.
    pub(super) seconds: f64,
}

/// Five digits: more are noise, and make the files longer.
pub(super) fn digits(v: f64) -> f64 {
    if v == 0.0 || !v.is_finite() {
        return v;
    }
    format!("{v:.4e}").parse().unwrap_or(v)
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::entries::ENTRIES;
    use super::*;

    fn timed(seconds: f64, device: bool, stages: &[&str]) -> Timed {
        let spread = |s: f64| Spread { median: digits(s), min: digits(s) };
        let each = digits(seconds / 2.0 / stages.len() as f64);
        let stages = stages.iter().map(|name| ((*name).to_owned(), each)).collect();
        Timed {
            runs: 3,
            seconds: spread(seconds),
            device_seconds: device.then(|| spread(seconds / 2.0)),
            stages,
            triangles: 1000,
            host_bytes: Some(50_000_000),
            device_bytes: device.then_some(20_000_000),
        }
    }

    fn cell(program: &str, timed: Option<Timed>) -> Cell {
        let not_run = timed.is_none().then(|| "no device".to_owned());
        Cell { program: program.to_owned(), timed, not_run }
    }

    /// Results that nobody measured.
    pub(in super::super) fn made_up(device: bool) -> Document {
        let row = |entry: &super::super::entries::Entry| {
            let n = entry.atoms as f64;
            let side = |gpu: bool, programs: [&str; 2], paper_seconds: f64, cubes: u64| {
                let of = |seconds: f64| (!gpu || device).then(|| timed(seconds, gpu, &["field"]));
                let (baseline, ours) = (cell(programs[0], of(n * 1e-3)), cell(programs[1], of(n * 2e-5)));
                let spacing = 0.4;
                Side { paper_seconds, paper_cubes: cubes, cubes, spacing, baseline, ours, triangles: Some(1000) }
            };
            Row {
                id: entry.id.to_owned(),
                kernel: "gaussian".to_owned(),
                paper_atoms: entry.atoms,
                atoms: entry.atoms,
                source: "stand-in: made up".to_owned(),
                stand_in: true,
                cpu: side(false, ["reference", "cpu"], entry.cpu[0], entry.cubes[0]),
                gpu: side(true, ["paper", "gpu"], entry.gpu[0], entry.cubes[1]),
            }
        };
        let series = |program: &str, law: fn(f64) -> f64, gpu: bool| {
            let point = |n: usize| Point { atoms: n, timed: timed(law(n as f64), gpu, &["field", "emit"]) };
            let points = if !gpu || device { [100, 1_000, 10_000, 100_000].map(point).to_vec() } else { Vec::new() };
            Series { program: program.to_owned(), points, ends: (gpu && !device).then(|| "no device".to_owned()) }
        };
        let stage = |stage: &str, fmas: f64| StageFacts {
            program: "gpu".to_owned(),
            stage: stage.to_owned(),
            workgroup_size: 64,
            workgroup_bytes: 1024,
            workgroups: Some(10),
            bytes: Some(1e6),
            fmas: Some(fmas),
            seconds: 1e-5,
        };
        let roofline = Roofline {
            structure: "a structure".to_owned(),
            memory_rate: 4e12,
            fma_rate: 2e13,
            stages: vec![stage("field", 1e7), stage("scan", 0.0)],
        };
        Document {
            made_by: MADE_BY.to_owned(),
            version: "0.0.0".to_owned(),
            date: "2000-01-01T00:00:00Z".to_owned(),
            machine: Machine {
                cpu: "A Processor".to_owned(),
                cores: 2,
                threads: 2,
                memory_bytes: None,
                os: "any".to_owned(),
            },
            device: device.then(|| Device { name: "A Card".to_owned(), driver: "d".to_owned(), software: false }),
            rows: ENTRIES.iter().map(row).collect(),
            growth: Some(Growth {
                structure: "tiles".to_owned(),
                spacing: 1.0,
                series: vec![
                    series("reference", |n| 1e-7 * n * n, false),
                    series("cpu", |n| 1e-6 * n, false),
                    series("paper", |n| 1e-7 * n, true),
                    series("gpu", |n| 1e-8 * n, true),
                ],
            }),
            roofline: if device { vec![roofline] } else { Vec::new() },
        }
    }

    #[test]
    fn results_are_the_same_after_they_were_written() {
        for document in [made_up(true), made_up(false)] {
            let text = serde_json::to_string_pretty(&document).unwrap();
            assert_eq!(serde_json::from_str::<Document>(&text).unwrap(), document);
            let other = text.replace("\"runs\": 3", "\"runs\": 4");
            assert_ne!(serde_json::from_str::<Document>(&other).unwrap(), document);
        }
    }

    #[test]
    #[expect(clippy::float_cmp, reason = "the same numbers are meant")]
    fn five_digits_are_kept() {
        assert_eq!(
            [digits(0.0), digits(1.0), digits(123.456_789), digits(1.234_567e-9)],
            [0.0, 1.0, 123.46, 1.2346e-9]
        );
    }
}
