//! Memory of this machine and of this process's control group. Limits of processes (`ulimit`) are ignored, because they
//! count address space instead of memory.

use std::fs;
use std::path::Path;

/// Memory and its owner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct OwnedMemory {
    /// Size, bytes.
    pub bytes: u64,
    /// Name of the owner, such as `this machine`.
    pub owner: &'static str,
}

/// Memory that a process can use.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct AvailableMemory {
    /// Memory of the machine, if known.
    pub machine: Option<u64>,
    /// Limit of the control group and its ancestors, if there is one.
    pub limit: Option<u64>,
}

impl AvailableMemory {
    /// Reads the memory of this machine and the limit of this process.
    #[must_use]
    pub fn detect() -> Self {
        let text = fs::read_to_string("/proc/meminfo").ok();
        Self { machine: text.and_then(|text| total(&text)), limit: limit(Path::new("/")) }
    }

    /// Returns the smaller of both.
    #[must_use]
    pub fn least(self) -> Option<OwnedMemory> {
        let owned = |bytes: Option<u64>, owner| bytes.map(|bytes| OwnedMemory { bytes, owner });
        let both = [owned(self.machine, "this machine"), owned(self.limit, "this control group")];
        both.into_iter().flatten().min()
    }
}

/// Parses the total memory in `/proc/meminfo`, bytes.
fn total(text: &str) -> Option<u64> {
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()?.checked_mul(1024)
}

/// Returns the smallest memory limit of this process's control group and its ancestors, bytes. Supports both versions.
fn limit(root: &Path) -> Option<u64> {
    let groups = fs::read_to_string(root.join("proc/self/cgroup")).ok()?;
    let mut least: Option<u64> = None;
    for line in groups.lines() {
        let mut fields = line.splitn(3, ':');
        let (Some(_), Some(controllers), Some(path)) = (fields.next(), fields.next(), fields.next()) else { continue };
        let (mount, file) = match controllers {
            "" => ("sys/fs/cgroup", "memory.max"),
            _ if controllers.split(',').any(|name| name == "memory") => {
                ("sys/fs/cgroup/memory", "memory.limit_in_bytes")
            }
            _ => continue,
        };
        let mount = root.join(mount);
        // In a container, the path may be the host's while the mount is the container's.
        for group in Path::new(path.trim_start_matches('/')).ancestors() {
            let text = fs::read_to_string(mount.join(group).join(file)).ok();
            // `max`, and a huge number in version 1, mean no limit.
            let bytes = text.and_then(|text| text.trim().parse::<u64>().ok()).filter(|bytes| *bytes < 1 << 60);
            least = [least, bytes].into_iter().flatten().min();
        }
    }
    least
}

#[cfg(test)]
mod tests {
    use super::*;

    fn limit_of(files: &[(&str, &str)]) -> Option<u64> {
        let root = tempfile::tempdir().unwrap();
        for (path, text) in files {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        }
        limit(root.path())
    }

    #[test]
    fn smallest_cgroup_limit_applies_in_both_versions() {
        let group = ("proc/self/cgroup", "0::/a/b\n");
        assert_eq!(limit_of(&[]), None);
        assert_eq!(limit_of(&[group]), None);
        assert_eq!(limit_of(&[group, ("sys/fs/cgroup/a/b/memory.max", "max\n")]), None);
        let outer = ("sys/fs/cgroup/a/memory.max", "4096\n");
        assert_eq!(limit_of(&[group, ("sys/fs/cgroup/a/b/memory.max", "8192\n"), outer]), Some(4096));
        // Inside a container.
        assert_eq!(limit_of(&[("proc/self/cgroup", "0::/\n"), ("sys/fs/cgroup/memory.max", "777\n")]), Some(777));
        let first = ("proc/self/cgroup", "5:cpu,cpuacct:/x\n4:memory:/docker/7\n");
        let file = "sys/fs/cgroup/memory/memory.limit_in_bytes";
        assert_eq!(limit_of(&[first, (file, "1000\n")]), Some(1000));
        assert_eq!(limit_of(&[first, (file, "9223372036854771712\n")]), None);
    }

    #[test]
    fn smaller_of_memory_and_limit_applies() {
        assert_eq!(total("MemTotal:       16 kB\nMemFree: 1 kB\n"), Some(16 << 10));
        assert_eq!(total("MemFree: 1 kB\n"), None);
        let of = |machine, limit| AvailableMemory { machine, limit }.least().map(|least| (least.bytes, least.owner));
        assert_eq!(of(Some(10), Some(7)), Some((7, "this control group")));
        assert_eq!(of(Some(10), None), Some((10, "this machine")));
        assert_eq!(of(None, None), None);
        assert!(AvailableMemory::detect().machine.is_some_and(|bytes| bytes > 1 << 28), "a Linux machine");
    }
}
