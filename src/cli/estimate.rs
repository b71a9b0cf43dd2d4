//! Estimated time of one command on the CPU and on a GPU that is not started yet. `--backend auto` compares them.
//!
//! The constants are medians of a host with an H200 and 16 cores and of a host with 2 cores.

use std::fmt;

/// Start of a GPU: driver, device and pipelines, s.
const GPU_START: f64 = 0.3;
/// Time of a unit of work (an atom at 0.5 Å) on a GPU: reading on one core, transfer, first use of the memory, s.
const GPU_UNIT: f64 = 2.5e-6;
/// Serial part of the time of a unit on the CPU, s.
const CPU_UNIT: f64 = 1.5e-6;
/// Parallel part of the time of a unit on the CPU, s.
const CPU_UNIT_SHARED: f64 = 5e-6;

/// Estimated time of a command on either backend, s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Estimate {
    cpu: f64,
    gpu: f64,
}

impl Estimate {
    /// Estimates a job of `work` units with `threads` threads.
    pub(super) fn new(work: f64, threads: usize) -> Self {
        let cpu = work * (CPU_UNIT + CPU_UNIT_SHARED / threads.max(1) as f64);
        Self { cpu, gpu: GPU_START + work * GPU_UNIT }
    }

    /// Returns true if a GPU is expected to finish first.
    pub(super) fn favours_gpu(self) -> bool {
        self.gpu < self.cpu
    }
}

impl fmt::Display for Estimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "estimated {:.0} ms on the CPU, {:.0} ms on a GPU including its start",
            self.cpu * 1e3,
            self.gpu * 1e3
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_jobs_and_many_threads_favour_the_cpu() {
        let gpu = |work, threads| Estimate::new(work, threads).favours_gpu();
        assert!(!gpu(1e3, 1) && !gpu(5e4, 1) && !gpu(1e5, 2));
        assert!(gpu(1e6, 1) && gpu(1e6, 2));
        assert!(!gpu(3e5, 16) && !gpu(1e7, 16));
    }

    #[test]
    fn shows_both_estimates() {
        let text = Estimate::new(1e6, 2).to_string();
        assert_eq!(text, "estimated 4000 ms on the CPU, 2800 ms on a GPU including its start");
    }
}
