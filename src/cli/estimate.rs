//! Estimated time of one command on the CPU and on a GPU that is not started yet. `--backend auto` compares them.
//!
//! The default costs are medians of a host with an H200 and 16 cores and of a host with 2 cores. `molmesh doctor
//! --calibrate` replaces them by those of this machine.

use std::fmt;

use molmesh::pipeline::cost::Cost;
use serde::{Deserialize, Serialize};

/// Time to read a unit of work (an atom at 0.5 Å), on one core and for either backend, s.
const READING: f64 = 1.5e-6;

/// Cost of a GPU that is not started yet.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct GpuCost {
    /// Start: driver, device and pipelines, s.
    pub(super) start: f64,
    /// Additional time of the first mesh, which allocates the memory for transfers, s per unit.
    pub(super) first_use: f64,
    /// Cost of later meshes, including the transfer.
    pub(super) warm: Cost,
}

/// Costs of the backends on this machine.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MachineCosts {
    /// Cost on one thread of the CPU.
    pub(super) cpu: Cost,
    pub(super) gpu: GpuCost,
    /// True if they were measured on this machine.
    pub(super) measured: bool,
}

impl Default for MachineCosts {
    fn default() -> Self {
        let cost = |per_unit| Cost { per_job: 0.0, per_unit };
        let gpu = GpuCost { start: 0.3, first_use: 0.0, warm: cost(1e-6) };
        Self { cpu: cost(5e-6), gpu, measured: false }
    }
}

/// Estimated time of a command on either backend, s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Estimate {
    cpu: f64,
    gpu: f64,
    measured: bool,
}

impl Estimate {
    /// Estimates a job of `work` units with `threads` threads.
    pub(super) fn new(costs: &MachineCosts, work: f64, threads: usize) -> Self {
        let MachineCosts { cpu, gpu, measured } = *costs;
        let threads = threads.max(1) as f64;
        Self {
            cpu: READING * work + cpu.per_job + cpu.per_unit * work / threads,
            gpu: READING * work + gpu.start + gpu.first_use * work + gpu.warm.seconds(work),
            measured,
        }
    }

    /// Returns true if a GPU is expected to finish first.
    pub(super) fn favours_gpu(self) -> bool {
        self.gpu < self.cpu
    }
}

impl fmt::Display for Estimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (cpu, gpu) = (self.cpu * 1e3, self.gpu * 1e3);
        let source = if self.measured { "calibrated" } else { "not calibrated" };
        write!(f, "estimated {cpu:.0} ms on the CPU, {gpu:.0} ms on a GPU including its start; {source}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_jobs_and_many_threads_favour_the_cpu() {
        let gpu = |work, threads| Estimate::new(&MachineCosts::default(), work, threads).favours_gpu();
        assert!(!gpu(1e3, 1) && !gpu(5e4, 1) && !gpu(1e5, 2));
        assert!(gpu(1e6, 1) && gpu(1e6, 2));
        assert!(!gpu(3e5, 16) && !gpu(1e7, 16));
    }

    #[test]
    fn measured_costs_change_the_choice() {
        let default = MachineCosts::default();
        let gpu = |costs: &MachineCosts| Estimate::new(costs, 1e5, 4).favours_gpu();
        let fast = GpuCost { start: 0.01, first_use: 1e-8, warm: Cost { per_job: 0.001, per_unit: 1e-7 } };
        assert!(!gpu(&default) && gpu(&MachineCosts { gpu: fast, ..default }));
        // Each part of the cost counts.
        for slow in [
            GpuCost { start: 1.0, ..fast },
            GpuCost { first_use: 1e-5, ..fast },
            GpuCost { warm: Cost { per_job: 1.0, per_unit: 1e-7 }, ..fast },
            GpuCost { warm: Cost { per_job: 0.0, per_unit: 1e-5 }, ..fast },
        ] {
            assert!(!gpu(&MachineCosts { gpu: slow, ..default }), "{slow:?}");
        }
    }

    #[test]
    fn shows_both_estimates() {
        let costs = MachineCosts::default();
        let text = Estimate::new(&costs, 1e6, 2).to_string();
        assert_eq!(text, "estimated 4000 ms on the CPU, 2800 ms on a GPU including its start; not calibrated");
        let measured = Estimate::new(&MachineCosts { measured: true, ..costs }, 1e6, 2).to_string();
        assert!(measured.ends_with("; calibrated"), "{measured}");
    }
}
