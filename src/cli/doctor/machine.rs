//! Facts about the machine: processors and their extensions, memory, limits, GPU drivers.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};

/// Target triple of this binary.
pub(super) const TARGET: &str = env!("MOLMESH_TARGET");
/// Compiler of this binary.
pub(super) const COMPILER: &str = env!("MOLMESH_COMPILER");

/// Facts about a machine.
#[derive(Debug, Default)]
pub(super) struct Machine {
    /// Cores for this process.
    pub(super) cores: Option<usize>,
    /// Memory in bytes, if known.
    pub(super) bytes: Option<u64>,
    /// Memory limit of this process in bytes with its owner, if there is one.
    pub(super) limit: Option<(u64, &'static str)>,
    /// Limits of open files: the current one, and the hard limit to which a service raises it.
    pub(super) files: Option<[u64; 2]>,
    /// Installed Vulkan drivers, working or not; a sentence if there are none.
    pub(super) drivers: Vec<String>,
}

impl Machine {
    /// Collects the facts about this machine.
    pub(super) fn detect() -> Self {
        Self {
            cores: std::thread::available_parallelism().ok().map(std::num::NonZero::get),
            bytes: fs::read_to_string("/proc/meminfo").ok().and_then(|text| total(&text)),
            limit: limit(Path::new("/")).map(|bytes| (bytes, "this control group")),
            files: files(),
            drivers: drivers(),
        }
    }

    /// Returns the memory available to this process in bytes, with the owner of the limit.
    pub(super) fn memory(&self) -> Option<(u64, &'static str)> {
        let machine = self.bytes.map(|bytes| (bytes, "this machine"));
        [machine, self.limit].into_iter().flatten().min()
    }

    /// Returns the facts as JSON.
    pub(super) fn document(&self) -> Value {
        let vectors: Vec<&str> = vectors().collect();
        json!({
            "os": std::env::consts::OS, "arch": std::env::consts::ARCH, "cores": self.cores, "vectors": vectors,
            "memory_bytes": self.bytes, "memory_limit_bytes": self.limit.map(|(bytes, _)| bytes),
            "open_files": self.files.map(|[now, _]| now), "open_files_limit": self.files.map(|[_, most]| most),
            "drivers": self.drivers,
        })
    }
}

#[cfg(feature = "gpu")]
fn drivers() -> Vec<String> {
    if !cfg!(target_os = "linux") {
        return Vec::new();
    }
    let found = molmesh::gpu::manifests();
    if found.is_empty() {
        return vec![
            "no manifest of a Vulkan driver was found (in /usr/share/vulkan/icd.d and similar folders)".to_owned(),
        ];
    }
    found.iter().map(ToString::to_string).collect()
}

#[cfg(not(feature = "gpu"))]
fn drivers() -> Vec<String> {
    Vec::new()
}

/// Reads the soft and the hard limit of open files; `None` if either is unlimited.
#[cfg(target_os = "linux")]
fn files() -> Option<[u64; 2]> {
    let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile);
    Some([limit.current?, limit.maximum?])
}

#[cfg(not(target_os = "linux"))]
fn files() -> Option<[u64; 2]> {
    None
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

/// Returns the available vector extensions that the inner loops can use, by their compiler names.
pub(super) fn vectors() -> impl Iterator<Item = &'static str> {
    detected().into_iter().filter_map(|(name, on)| on.then_some(name))
}

#[cfg(target_arch = "x86_64")]
fn detected() -> [(&'static str, bool); 6] {
    [
        ("sse4.2", std::arch::is_x86_feature_detected!("sse4.2")),
        ("avx", std::arch::is_x86_feature_detected!("avx")),
        ("avx2", std::arch::is_x86_feature_detected!("avx2")),
        ("fma", std::arch::is_x86_feature_detected!("fma")),
        ("avx512f", std::arch::is_x86_feature_detected!("avx512f")),
        ("avx512vl", std::arch::is_x86_feature_detected!("avx512vl")),
    ]
}

#[cfg(target_arch = "aarch64")]
fn detected() -> [(&'static str, bool); 2] {
    [("neon", std::arch::is_aarch64_feature_detected!("neon")), ("sve", std::arch::is_aarch64_feature_detected!("sve"))]
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn detected() -> [(&'static str, bool); 0] {
    []
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
        let machine = Machine { bytes: Some(10), limit: Some((7, "a group")), ..Machine::default() };
        assert_eq!(machine.memory(), Some((7, "a group")));
        assert_eq!(Machine { limit: None, ..machine }.memory(), Some((10, "this machine")));
    }
}
