//! The machine, by name.

use std::fs;

use super::memory;
use super::result::Machine;

/// This one; the native backend has so many threads.
pub(super) fn look(threads: usize) -> Machine {
    let info = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    Machine {
        cpu: model(&info).unwrap_or_default().to_owned(),
        cores: std::thread::available_parallelism().map_or(1, std::num::NonZero::get),
        threads,
        memory_bytes: fs::read_to_string("/proc/meminfo").ok().and_then(|text| memory::field(&text, "MemTotal:")),
        os: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
    }
}

fn model(info: &str) -> Option<&str> {
    let line = info.lines().find(|line| line.starts_with("model name"))?;
    line.split_once(':').map(|(_, name)| name.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_processor_is_named_where_the_system_does() {
        assert_eq!(model("processor\t: 0\nmodel name\t: A B  (C) \nflags\t: x\n"), Some("A B  (C)"));
        assert_eq!(model("processor\t: 0\n"), None);
        assert!(look(3).cores > 0 && look(3).threads == 3);
    }
}
