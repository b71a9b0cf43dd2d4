//! Facts about the machine: processors and their extensions, memory, limits, GPU drivers.

use molmesh::config::AvailableMemory;
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
    /// Memory of the machine and limit of this process.
    pub(super) memory: AvailableMemory,
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
            memory: AvailableMemory::detect(),
            files: files(),
            drivers: drivers(),
        }
    }

    /// Returns the facts as JSON.
    pub(super) fn document(&self) -> Value {
        let vectors: Vec<&str> = vectors().collect();
        json!({
            "os": std::env::consts::OS, "arch": std::env::consts::ARCH, "cores": self.cores, "vectors": vectors,
            "memory_bytes": self.memory.machine, "memory_limit_bytes": self.memory.limit,
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
