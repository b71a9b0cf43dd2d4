//! Description of this machine, and memory of this process.

use std::fs;

use crate::paper::result::Machine;

/// Describes this machine. `threads` is the number of threads of the CPU backend.
pub(crate) fn describe(threads: usize) -> Machine {
    let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    Machine {
        cpu: model(&info).unwrap_or_default().to_owned(),
        cores: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        threads,
        memory_bytes: fs::read_to_string("/proc/meminfo").ok().and_then(|text| field(&text, "MemTotal:")),
        os: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
    }
}

fn model(info: &str) -> Option<&str> {
    let line = info.lines().find(|line| line.starts_with("model name"))?;
    line.split_once(':').map(|(_, name)| name.trim())
}

/// Returns a field of `/proc/self/status` or `/proc/meminfo`, bytes.
fn field(text: &str, name: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix(name))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

/// Runs `work`. Returns its result and the peak resident memory of this process, bytes; `None` on systems other than
/// Linux.
pub(crate) fn peak_memory<T>(work: impl FnOnce() -> T) -> (T, Option<u64>) {
    // `5` resets the peak to the current resident memory.
    let reset = fs::write("/proc/self/clear_refs", "5").is_ok();
    let value = work();
    let status = fs::read_to_string("/proc/self/status").ok().filter(|_| reset);
    (value, status.and_then(|text| field(&text, "VmHWM:")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_processor_name_is_read_if_present() {
        assert_eq!(model("processor\t: 0\nmodel name\t: A B  (C) \nflags\t: x\n"), Some("A B  (C)"));
        assert_eq!(model("processor\t: 0\n"), None);
        assert!(describe(3).cores > 0 && describe(3).threads == 3);
    }

    #[test]
    fn fields_are_found_by_name() {
        let text = "VmPeak:\t    9 kB\nVmHWM:\t   12 kB\nThreads:\t3\n";
        assert_eq!((field(text, "VmHWM:"), field(text, "VmRSS:"), field(text, "Threads:")), (Some(12_288), None, None));
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn the_peak_includes_the_work() {
        let ((), Some(before)) = peak_memory(|| ()) else { return };
        let (block, after) = peak_memory(|| std::hint::black_box(vec![1_u8; 64 << 20]));
        assert!(after.unwrap() >= before + (32 << 20), "{before} {after:?}");
        drop(block);
    }
}
