//! The most memory that this process takes during a piece of work, by the word of Linux.

use std::fs;

/// A look at the process's memory from a moment on.
#[derive(Debug)]
pub(super) struct Watch {
    /// Whether the high-water mark could be lowered to the present: else it tells of earlier work.
    lowered: bool,
}

impl Watch {
    /// From now on.
    pub(super) fn start() -> Self {
        // `5` lowers the high-water mark of resident memory to what is resident now; other systems have no such file.
        Self { lowered: fs::write("/proc/self/clear_refs", "5").is_ok() }
    }

    /// The most that was resident since, bytes; none where the system does not say.
    pub(super) fn peak(&self) -> Option<u64> {
        if !self.lowered {
            return None;
        }
        field(&fs::read_to_string("/proc/self/status").ok()?, "VmHWM:")
    }
}

/// A field of `/proc/…/status` or `/proc/meminfo`, bytes.
pub(super) fn field(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_found_by_their_names() {
        let text = "VmPeak:\t    9 kB\nVmHWM:\t   12 kB\nThreads:\t3\n";
        assert_eq!((field(text, "VmHWM:"), field(text, "VmRSS:"), field(text, "Threads:")), (Some(12_288), None, None));
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn the_peak_is_that_of_the_work() {
        let watch = Watch::start();
        let Some(before) = watch.peak() else { return };
        let block = std::hint::black_box(vec![1_u8; 64 << 20]);
        let after = watch.peak().unwrap();
        assert!(after >= before + (60 << 20), "{before} {after}");
        drop(block);
    }
}
