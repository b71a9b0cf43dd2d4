//! Number of cores that a job of a GPU keeps busy on the host, and the share of cores that is left to the CPU backend.

/// Cores that a job keeps busy before any measurement.
const FIRST_GUESS: f64 = 1.0;
/// Minimum duration of a measurement, s of GPU jobs.
const MIN_JOB_TIME: f64 = 0.05;
/// Weight of the last measurement in the average, except for the first one, which replaces the guess.
const LAST_WEIGHT: f64 = 0.3;
/// Time constant of the average number of GPU jobs, s. Small jobs share a submission and end together, so the host
/// seems idle until the next ones start.
const JOBS_TIME: f64 = 0.05;
/// Minimum share of idle cores: a loaded host still runs a job of the CPU.
const MIN_SHARE: f64 = 0.05;

/// Measurement of the processor time of GPU jobs, while the CPU backend has no job. For a job of a GPU, the host reads
/// a file, sorts atoms and sends a mesh.
#[derive(Debug, Clone, Copy)]
pub(super) struct HostCores {
    cores: f64,
    per_job: f64,
    is_measured: bool,
    /// Duration and processor time of GPU jobs since the last measurement, s.
    sums: [f64; 2],
    /// Number of GPU jobs, averaged with the time constant [`JOBS_TIME`].
    mean_jobs: f64,
    last: Update,
}

#[derive(Debug, Clone, Copy)]
struct Update {
    /// Wall time and processor time, s.
    at: [f64; 2],
    gpu_jobs: usize,
    /// True if the CPU backend has no job.
    gpu_alone: bool,
}

impl HostCores {
    /// Starts the measurement on a host with `cores` cores.
    pub(super) const fn new(cores: usize) -> Self {
        let last = Update { at: [0.0; 2], gpu_jobs: 0, gpu_alone: true };
        let (cores, sums) = (cores as f64, [0.0; 2]);
        Self { cores, per_job: FIRST_GUESS, is_measured: false, sums, mean_jobs: 0.0, last }
    }

    /// Records that the number of jobs changes at `now`, the wall time and processor time of this process, s.
    pub(super) fn update(&mut self, now: [f64; 2], cpu_jobs: usize, gpu_jobs: usize) {
        let Update { at, gpu_jobs: before, gpu_alone } = self.last;
        let [wall, processor] = [0, 1].map(|k| (now[k] - at[k]).max(0.0));
        self.mean_jobs += (1.0 - (-wall / JOBS_TIME).exp()) * (before as f64 - self.mean_jobs);
        if gpu_alone && before > 0 {
            self.sums[0] += before as f64 * wall;
            self.sums[1] += processor;
        }
        self.last = Update { at: now, gpu_jobs, gpu_alone: cpu_jobs == 0 };
        let [jobs, processor] = self.sums;
        if jobs >= MIN_JOB_TIME {
            let weight = if self.is_measured { LAST_WEIGHT } else { 1.0 };
            self.per_job += weight * (processor / jobs - self.per_job);
            (self.is_measured, self.sums) = (true, [0.0; 2]);
        }
    }

    /// Returns the share of cores, from 0.05 to 1, that the jobs of GPUs leave idle at the last [`update`].
    ///
    /// [`update`]: Self::update
    pub(super) fn idle_share(&self) -> f64 {
        let jobs = self.mean_jobs.max(self.last.gpu_jobs as f64);
        (1.0 - self.per_job * jobs / self.cores).clamp(MIN_SHARE, 1.0)
    }
}

/// Returns the processor time of this process, s; 0 on systems other than Linux, where GPU jobs count as free.
pub(super) fn processor_time() -> f64 {
    #[cfg(target_os = "linux")]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
    }
    #[cfg(not(target_os = "linux"))]
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_jobs_of_gpus_alone_are_measured() {
        let mut host = HostCores::new(8);
        let mut now = [0.0; 2];
        for _ in 0..30 {
            // Two jobs of a GPU use a core together; then a job of the CPU uses all; then the host is idle.
            for (cpu_jobs, gpu_jobs, cores) in [(0, 2, 1.0), (1, 2, 8.0), (0, 0, 0.0)] {
                host.update(now, cpu_jobs, gpu_jobs);
                now = [now[0] + 0.1, now[1] + 0.1 * cores];
            }
        }
        assert!((host.per_job - 0.5).abs() < 1e-3, "{host:?}");
        let now = [now[0] + 9.0, now[1]];
        for (jobs, share) in [(0, 1.0), (8, 0.5), (16, MIN_SHARE), (99, MIN_SHARE)] {
            host.update(now, 0, jobs);
            assert!((host.idle_share() - share).abs() < 1e-3, "{jobs}: {host:?}");
        }
        // Eight jobs end together: half of the cores may be needed again at once.
        host.update(now, 0, 8);
        let ended = [now[0] + 0.2, now[1] + 0.8];
        host.update(ended, 0, 0);
        assert!(host.idle_share() < 0.55, "{host:?}");
        host.update([ended[0] + 0.5, ended[1]], 0, 0);
        assert!(host.idle_share() > 0.99, "{host:?}");
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn work_takes_processor_time() {
        let begun = processor_time();
        let end = std::time::Instant::now() + std::time::Duration::from_millis(30);
        while std::time::Instant::now() < end {}
        let busy = processor_time() - begun;
        assert!(busy > 1e-3, "{busy}");
    }
}
