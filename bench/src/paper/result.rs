//! The results as data, stored as JSON: tables and figures are made from them.

use serde::{Deserialize, Serialize};

use crate::stats::Summary;

/// The results of one command on one machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Document {
    /// The version of molmesh.
    pub(crate) version: String,
    /// The start, RFC 3339.
    pub(crate) date: String,
    pub(crate) machine: Machine,
    /// The GPU, if one was used.
    pub(crate) device: Option<Device>,
    /// The rows of the paper's tables.
    pub(crate) rows: Vec<Row>,
    /// Time and memory against atoms.
    pub(crate) growth: Option<Growth>,
    /// The device's stages against its rates.
    pub(crate) roofline: Vec<Roofline>,
}

/// A machine.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Machine {
    /// The processor's name; empty if the system does not tell it.
    pub(crate) cpu: String,
    /// Cores for this process.
    pub(crate) cores: usize,
    /// Threads of the CPU backend.
    pub(crate) threads: usize,
    pub(crate) memory_bytes: Option<u64>,
    pub(crate) os: String,
}

/// A device.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Device {
    pub(crate) name: String,
    pub(crate) driver: String,
    /// Whether a processor emulates it: its speed says nothing about GPUs.
    pub(crate) software: bool,
}

/// One structure with one kernel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Row {
    pub(crate) id: String,
    pub(crate) kernel: String,
    /// Atoms by the paper.
    pub(crate) paper_atoms: usize,
    /// Atoms that were meshed.
    pub(crate) atoms: usize,
    pub(crate) source: String,
    /// Whether another structure replaces the paper's.
    pub(crate) stand_in: bool,
    /// The paper's Table 1.
    pub(crate) cpu: Side,
    /// The paper's Table 2.
    pub(crate) gpu: Side,
}

/// The part of a row that belongs to one of the paper's tables.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Side {
    pub(crate) paper_seconds: f64,
    pub(crate) paper_cubes: u64,
    /// Cubes that the dense program visits: the reference, or the 2010 program.
    pub(crate) cubes: u64,
    /// Å.
    pub(crate) spacing: f64,
    /// The dense program.
    pub(crate) baseline: Cell,
    /// The CPU backend, or the stages.
    pub(crate) ours: Cell,
    /// Triangles of the CPU backend on this grid, if it ran.
    pub(crate) triangles: Option<usize>,
}

impl Side {
    /// Returns the speed of ours relative to the baseline: by device time if both have it.
    pub(crate) fn speedup(&self) -> Option<f64> {
        let device = self.baseline.device_seconds().zip(self.ours.device_seconds());
        let (baseline, ours) = device.or_else(|| self.baseline.seconds().zip(self.ours.seconds()))?;
        Some(baseline / ours)
    }

    /// Lists the programs whose numbers of triangles differ from the CPU backend's, or from each other's if that did not
    /// run.
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

/// One program on one structure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Cell {
    pub(crate) program: String,
    pub(crate) timed: Option<Timed>,
    /// Why it did not run.
    pub(crate) not_run: Option<String>,
}

impl Cell {
    /// Median time from spheres to a mesh in host memory, s.
    pub(crate) fn seconds(&self) -> Option<f64> {
        self.timed.as_ref().map(|t| t.seconds.median)
    }

    /// As [`Timed::device_median`].
    pub(crate) fn device_seconds(&self) -> Option<f64> {
        self.timed.as_ref().and_then(Timed::device_median)
    }
}

/// The measurements of a program on a structure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Timed {
    /// Measured runs.
    pub(crate) runs: usize,
    /// From spheres to a mesh in host memory.
    pub(crate) seconds: Summary,
    /// The sum of the stages on the device; `None` on the CPU, and on a device without timestamps.
    pub(crate) device_seconds: Option<Summary>,
    /// Medians by stage, s: device time on a device, wall time on the CPU.
    pub(crate) stages: Vec<(String, f64)>,
    pub(crate) triangles: usize,
    /// Peak memory of the process during a run, where the system tells it.
    pub(crate) host_bytes: Option<u64>,
    /// Device memory that the program holds afterwards.
    pub(crate) device_bytes: Option<u64>,
}

impl Timed {
    /// Median sum of the stages on the device, s.
    pub(crate) fn device_median(&self) -> Option<f64> {
        self.device_seconds.map(|s| s.median)
    }
}

/// Time and memory against atoms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Growth {
    /// The structure that grows.
    pub(crate) structure: String,
    /// Å.
    pub(crate) spacing: f64,
    pub(crate) series: Vec<Series>,
}

/// The series of one program.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Series {
    pub(crate) program: String,
    pub(crate) points: Vec<Point>,
    /// Why it ends before the others.
    pub(crate) ends: Option<String>,
}

impl Series {
    /// Returns a value against atoms, for the points that have it.
    pub(crate) fn points(&self, of: &dyn Fn(&Timed) -> Option<f64>) -> Vec<(f64, f64)> {
        self.points.iter().filter_map(|p| Some((p.atoms as f64, of(&p.timed)?))).collect()
    }
}

/// One size.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Point {
    pub(crate) atoms: usize,
    pub(crate) timed: Timed,
}

/// The device's stages against its rates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Roofline {
    /// The structure that was meshed.
    pub(crate) structure: String,
    /// Bytes per second of a copying shader.
    pub(crate) memory_rate: f64,
    /// Multiply-adds per second.
    pub(crate) fma_rate: f64,
    pub(crate) stages: Vec<StageFacts>,
}

/// One stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct StageFacts {
    /// `gpu` or `paper`.
    pub(crate) program: String,
    pub(crate) stage: String,
    /// Threads of a workgroup.
    pub(crate) workgroup_size: u32,
    /// Bytes that a workgroup shares.
    pub(crate) workgroup_bytes: u32,
    /// Workgroups of the run; `None` for the baseline.
    pub(crate) workgroups: Option<u64>,
    /// The least work, bytes; `None` for the baseline.
    pub(crate) bytes: Option<f64>,
    /// The least work, multiply-adds; `None` for the baseline.
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

    /// Results for tests, not measured.
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
    fn results_are_the_same_after_they_were_stored() {
        for document in [made_up(true), made_up(false)] {
            let text = serde_json::to_string_pretty(&document).unwrap();
            assert_eq!(serde_json::from_str::<Document>(&text).unwrap(), document);
            let other = text.replace("\"runs\": 3", "\"runs\": 4");
            assert_ne!(serde_json::from_str::<Document>(&other).unwrap(), document);
        }
    }
}
