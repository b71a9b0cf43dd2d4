//! Results as stored in JSON, the source of tables and figures.

use serde::{Deserialize, Serialize};

use crate::stats::Summary;

/// Results of one command on one machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Document {
    /// Version of molmesh.
    pub(crate) version: String,
    /// Start time, RFC 3339.
    pub(crate) date: String,
    pub(crate) machine: Machine,
    /// GPU, if one was used.
    pub(crate) device: Option<Device>,
    /// Rows of the paper's tables.
    pub(crate) rows: Vec<Row>,
    /// Time and memory against atoms.
    pub(crate) growth: Option<Growth>,
    /// Stages against the rates of the device.
    pub(crate) roofline: Vec<Roofline>,
}

/// Description of a machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Machine {
    /// Name of the processor; empty if unknown.
    pub(crate) cpu: String,
    /// Number of cores available to this process.
    pub(crate) cores: usize,
    /// Number of threads of the CPU backend.
    pub(crate) threads: usize,
    pub(crate) memory_bytes: Option<u64>,
    pub(crate) os: String,
}

/// Description of a device.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Device {
    pub(crate) name: String,
    pub(crate) driver: String,
    /// True if a processor emulates the device, whose speed is then not that of a GPU.
    pub(crate) software: bool,
}

/// Results of one structure with one kernel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Row {
    pub(crate) id: String,
    pub(crate) kernel: String,
    /// Number of atoms according to the paper.
    pub(crate) paper_atoms: usize,
    /// Number of meshed atoms.
    pub(crate) atoms: usize,
    pub(crate) source: String,
    /// True if another structure replaces the paper's.
    pub(crate) substitute: bool,
    /// Part for the paper's Table 1.
    pub(crate) cpu: Side,
    /// Part for the paper's Table 2.
    pub(crate) gpu: Side,
}

/// Part of a row that belongs to one of the paper's tables.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Side {
    pub(crate) paper_seconds: f64,
    pub(crate) paper_cubes: u64,
    /// Number of cubes that the dense program visits (the reference or the 2010 program).
    pub(crate) cubes: u64,
    /// Grid spacing, Å.
    pub(crate) spacing: f64,
    /// Dense program.
    pub(crate) baseline: Cell,
    /// CPU backend or GPU stages.
    pub(crate) ours: Cell,
    /// Number of triangles of the CPU backend on this grid, if it ran.
    pub(crate) triangles: Option<usize>,
}

impl Side {
    /// Returns the speedup of ours over the baseline, by device time if both have it.
    pub(crate) fn speedup(&self) -> Option<f64> {
        let device = self.baseline.device_seconds().zip(self.ours.device_seconds());
        let (baseline, ours) = device.or_else(|| self.baseline.seconds().zip(self.ours.seconds()))?;
        Some(baseline / ours)
    }

    /// Lists the programs whose number of triangles differs from that of the CPU backend, or of ours if it did not run.
    pub(crate) fn disagreements(&self) -> Vec<String> {
        let of = |cell: &Cell| cell.timed.as_ref().map(|t| t.triangles);
        let expected = self.triangles.or_else(|| of(&self.ours));
        let differs = |cell: &Cell| {
            let (made, expected) = (of(cell)?, expected?);
            (made != expected).then(|| format!("{} {:+}", cell.program, made.cast_signed() - expected.cast_signed()))
        };
        [&self.baseline, &self.ours].into_iter().filter_map(differs).collect()
    }
}

/// Results of one program on one structure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Cell {
    pub(crate) program: String,
    pub(crate) timed: Option<Timed>,
    /// Reason why it did not run.
    pub(crate) not_run: Option<String>,
}

impl Cell {
    /// Returns the median time from spheres to a mesh in host memory, s.
    pub(crate) fn seconds(&self) -> Option<f64> {
        self.timed.as_ref().map(|t| t.seconds.median)
    }

    /// Returns the median device time; see [`Timed::device_median`].
    pub(crate) fn device_seconds(&self) -> Option<f64> {
        self.timed.as_ref().and_then(Timed::device_median)
    }
}

/// Measurements of a program on a structure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Timed {
    /// Number of measured runs.
    pub(crate) runs: usize,
    /// Time from spheres to a mesh in host memory, s.
    pub(crate) seconds: Summary,
    /// Sum of the stages on the device, s; `None` on the CPU and on devices without timestamps.
    pub(crate) device_seconds: Option<Summary>,
    /// Medians by stage, s: device time on a device, wall time on the CPU.
    pub(crate) stages: Vec<(String, f64)>,
    pub(crate) triangles: usize,
    /// Peak memory of the process during a run, if the system reports it.
    pub(crate) host_bytes: Option<u64>,
    /// Device memory held after the run.
    pub(crate) device_bytes: Option<u64>,
}

impl Timed {
    /// Returns the median of the sum of the stages on the device, s.
    pub(crate) fn device_median(&self) -> Option<f64> {
        self.device_seconds.map(|s| s.median)
    }
}

/// Time and memory against atoms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Growth {
    /// Description of the structure.
    pub(crate) structure: String,
    /// Grid spacing, Å.
    pub(crate) spacing: f64,
    pub(crate) series: Vec<Series>,
}

/// Series of one program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Series {
    pub(crate) program: String,
    pub(crate) points: Vec<Point>,
    /// Reason why it ends early.
    pub(crate) ends: Option<String>,
}

impl Series {
    /// Returns a value against atoms, for the points that have it.
    pub(crate) fn points(&self, of: &dyn Fn(&Timed) -> Option<f64>) -> Vec<(f64, f64)> {
        self.points.iter().filter_map(|p| Some((p.atoms as f64, of(&p.timed)?))).collect()
    }
}

/// Measurements of one size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Point {
    pub(crate) atoms: usize,
    pub(crate) timed: Timed,
}

/// Stages against the rates of the device.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Roofline {
    /// Description of the meshed structure.
    pub(crate) structure: String,
    /// Bytes per second, measured by a copying shader.
    pub(crate) memory_rate: f64,
    /// Multiply-adds per second.
    pub(crate) fma_rate: f64,
    pub(crate) stages: Vec<StageFacts>,
}

/// Measurements of one stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StageFacts {
    /// `gpu` or `paper`.
    pub(crate) program: String,
    pub(crate) stage: String,
    /// Threads per workgroup.
    pub(crate) workgroup_size: u32,
    /// Shared memory per workgroup, bytes.
    pub(crate) workgroup_bytes: u32,
    /// Number of workgroups; `None` for the baseline.
    pub(crate) workgroups: Option<u64>,
    /// Minimum memory traffic, bytes; `None` for the baseline.
    pub(crate) bytes: Option<f64>,
    /// Minimum number of multiply-adds; `None` for the baseline.
    pub(crate) fmas: Option<f64>,
    /// Median device time, s.
    pub(crate) seconds: f64,
}

#[cfg(test)]
pub(crate) mod tests {
    use super::super::entries::ENTRIES;
    use super::*;
    use crate::stats::digits;

    fn timed(seconds: f64, device: bool, stages: &[&str]) -> Timed {
        let spread = |s: f64| Summary { median: digits(s), min: digits(s) };
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

    /// Creates artificial results for tests.
    pub(crate) fn made_up(device: bool) -> Document {
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
                source: "substitute: generated".to_owned(),
                substitute: true,
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
    fn results_survive_storage() {
        for document in [made_up(true), made_up(false)] {
            let text = serde_json::to_string_pretty(&document).unwrap();
            assert_eq!(serde_json::from_str::<Document>(&text).unwrap(), document);
            let other = text.replace("\"runs\": 3", "\"runs\": 4");
            assert_ne!(serde_json::from_str::<Document>(&other).unwrap(), document);
        }
    }
}
