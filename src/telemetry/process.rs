//! Metrics of this process, read from the system on every scrape. Only available on Linux.

/// Updates memory, processor time, file descriptors and threads.
pub(super) fn publish() {
    #[cfg(target_os = "linux")]
    linux::publish();
}

#[cfg(target_os = "linux")]
mod linux {
    use std::sync::LazyLock;
    use std::time::{Duration, SystemTime, UNIX_EPOCH};

    use metrics::gauge;
    use rustix::process::{Resource, getrlimit};
    use rustix::time::{ClockId, clock_gettime};

    use crate::telemetry::{
        PROCESS_CPU, PROCESS_FDS, PROCESS_MAX_FDS, PROCESS_RESIDENT, PROCESS_START, PROCESS_THREADS, PROCESS_VIRTUAL,
    };

    /// Start time of the process, in seconds since 1970: the current time minus its age by the boot-time clock.
    static STARTED: LazyLock<Option<f64>> = LazyLock::new(|| {
        let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
        // The process name, in parentheses, may contain any character. The fields after it start with the third.
        let ticks: u64 = stat.rsplit_once(')')?.1.split_whitespace().nth(19)?.parse().ok()?;
        let since_boot = Duration::try_from_secs_f64(ticks as f64 / rustix::param::clock_ticks_per_second() as f64);
        let age = Duration::try_from(clock_gettime(ClockId::Boottime)).ok()?.saturating_sub(since_boot.ok()?);
        Some((SystemTime::now().duration_since(UNIX_EPOCH).ok()?.saturating_sub(age)).as_secs_f64())
    });

    pub(super) fn publish() {
        if let Ok(time) = Duration::try_from(clock_gettime(ClockId::ProcessCPUTime)) {
            gauge!(PROCESS_CPU).set(time.as_secs_f64());
        }
        if let Some(started) = *STARTED {
            gauge!(PROCESS_START).set(started);
        }
        let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
        let field = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
            line.split_whitespace().next()?.parse::<u64>().ok().map(|value| value as f64)
        };
        for (name, field, unit) in [
            (PROCESS_RESIDENT, field("VmRSS"), 1024.0),
            (PROCESS_VIRTUAL, field("VmSize"), 1024.0),
            (PROCESS_THREADS, field("Threads"), 1.0),
        ] {
            if let Some(value) = field {
                gauge!(name).set(value * unit);
            }
        }
        if let Ok(open) = std::fs::read_dir("/proc/self/fd") {
            // Reading the folder opens a descriptor itself.
            gauge!(PROCESS_FDS).set(open.count().saturating_sub(1) as f64);
        }
        if let Some(limit) = getrlimit(Resource::Nofile).current {
            gauge!(PROCESS_MAX_FDS).set(limit as f64);
        }
    }
}
