//! `molmesh doctor`: what this machine has, what of it is used, and why the rest is not.

use molmesh::config::DevicesConfig;
use molmesh::pipeline::JobLimits;
use molmesh::structure::radii;
use molmesh::surface::DeviceFacts;

use super::args::{BackendName, DoctorArgs};
use super::backend::{self, Asked};
use super::error::CliError;
use super::page::Page;
use super::style::Style;

/// Runs the command.
pub(super) fn run(args: &DoctorArgs) -> Result<(), CliError> {
    super::say(&text(args, Style::stdout())?)
}

fn text(args: &DoctorArgs, style: Style) -> Result<String, CliError> {
    let mut page = Page::new(style, "molmesh", env!("CARGO_PKG_VERSION"));
    let mut line = |label: &str, value: &str| page.row(label, value);
    line("system", &format!("{} {}", std::env::consts::OS, std::env::consts::ARCH));
    let cores = std::thread::available_parallelism().map_or_else(|e| format!("unknown ({e})"), |n| n.to_string());
    line("cores", &format!("{cores} for this process"));
    line("vectors", &vector_extensions());
    // As a service would do it: every driver is asked, and the stages are built on what is taken.
    let asked = Asked { backend: BackendName::Auto, devices: &args.devices.devices, threads: None };
    let picked = backend::pick(&asked, &backend::Use::Service(DevicesConfig::default()))?;
    for candidate in backend::survey(&picked).into_iter().filter(|candidate| !candidate.is_device()) {
        let name = &candidate.name;
        match candidate.state {
            Ok(device) => line(name, &format!("{} {device}", style.green("yes"))),
            Err(why) => line(name, &format!("{} {why}", style.dim("no "))),
        }
    }
    for device in &picked.devices {
        let facts = &device.facts;
        let taken = if device.taken { style.green("yes") } else { style.dim("no ") };
        line(&format!("device {}", device.number), &format!("{taken} {}: {}", facts.name, device.reason));
        line("", &format!("    {}, {}, {}", facts.kind.name(), facts.api, facts.driver));
        line("", &format!("    {}", abilities(facts)));
    }
    for (i, driver) in drivers().iter().enumerate() {
        line(if i == 0 { "drivers" } else { "" }, driver);
    }
    line("auto", &format!("{} ({})", picked.backend.name(), picked.reason));
    let JobLimits { read, surface, .. } = JobLimits::default();
    line("limits", &format!("{} atoms, {} bytes inflated", read.max_atoms, read.max_inflated_bytes));
    line("", &format!("{} samples, {} bytes of mesh", surface.max_samples, surface.max_mesh_bytes));
    line("radii", radii::TABLE);
    Ok(page.finish())
}

/// What announces itself as a Vulkan driver, whether or not it starts.
#[cfg(feature = "gpu")]
fn drivers() -> Vec<String> {
    if !cfg!(target_os = "linux") {
        return Vec::new();
    }
    let found = molmesh::gpu::manifests();
    if found.is_empty() {
        return vec![
            "no manifest of a Vulkan driver is where a loader looks (/usr/share/vulkan/icd.d and the like)".to_owned(),
        ];
    }
    found.iter().map(ToString::to_string).collect()
}

#[cfg(not(feature = "gpu"))]
fn drivers() -> Vec<String> {
    Vec::new()
}

/// What of a device matters to the stages.
fn abilities(facts: &DeviceFacts) -> String {
    let mib = |bytes: u64| format!("{} MiB", bytes >> 20);
    let subgroups = facts.subgroups.map_or("no subgroups".to_owned(), |[least, most]| {
        if least == most { format!("subgroups of {least}") } else { format!("subgroups of {least} to {most}") }
    });
    format!(
        "bindings to {}, buffers to {}, {} KiB a workgroup, {}, {subgroups}",
        mib(facts.binding_bytes),
        mib(facts.buffer_bytes),
        facts.workgroup_bytes >> 10,
        if facts.timestamps { "timestamps" } else { "no timestamps" },
    )
}

/// The extensions that the inner loops care about, by the name that compilers give them.
fn vector_extensions() -> String {
    let found: Vec<&str> = detected().into_iter().filter_map(|(name, on)| on.then_some(name)).collect();
    if found.is_empty() { "none that is known here".to_owned() } else { found.join(" ") }
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
