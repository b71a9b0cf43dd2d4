//! Text form of the findings.

use molmesh::config::ConfigSource;
use molmesh::structure::radii;
use molmesh::surface::DeviceFacts;

use super::Findings;
use super::checks::CheckResult;
use super::machine::{self, COMPILER, TARGET};
use crate::cli::page::Page;
use crate::cli::style::Style;

/// Columns after which a row of values is wrapped.
const WIDTH: usize = 100;

/// Formats the findings.
pub(super) fn text(findings: &Findings, style: Style) -> String {
    let mut page = Page::new(style, "molmesh", env!("CARGO_PKG_VERSION"));
    let machine = &findings.machine;
    page.row("build", &format!("{TARGET} ({COMPILER})"));
    page.row("system", &format!("{} {}", std::env::consts::OS, std::env::consts::ARCH));
    let cores = machine.cores.map_or("an unknown number".to_owned(), |cores| cores.to_string());
    page.row("cores", &format!("{cores} for this process"));
    let vectors: Vec<&str> = machine::vectors().collect();
    page.row("vectors", &if vectors.is_empty() { "none".to_owned() } else { vectors.join(" ") });
    let memory = machine.memory.machine.map_or("unknown".to_owned(), size);
    let limit = machine.memory.limit;
    let limit = limit.map_or("no control group limit".to_owned(), |n| format!("{} for this control group", size(n)));
    page.row("memory", &format!("{memory}, {limit}"));
    if let Some([now, most]) = machine.files {
        page.row("open files", &format!("{now}, raised to {most} by a service"));
    }
    for candidate in &findings.backends {
        let state = match &candidate.state {
            Ok(device) => format!("{} {device}", style.green("yes")),
            Err(why) => format!("{} {why}", style.dim("no ")),
        };
        page.row(&candidate.name, &state);
    }
    for device in &findings.devices {
        let facts = &device.facts;
        let used = if device.selected { style.green("yes") } else { style.dim("no ") };
        page.row(&format!("device {}", device.number), &format!("{used} {}: {}", facts.name, device.reason));
        page.row("", &format!("    {}, {}, {}", facts.kind.name(), facts.api, facts.driver));
        page.row("", &format!("    {}", abilities(facts)));
    }
    for (i, driver) in findings.machine.drivers.iter().enumerate() {
        page.row(if i == 0 { "drivers" } else { "" }, driver);
    }
    if let Some((name, reason)) = &findings.taken {
        page.row("auto", &format!("{name} ({reason})"));
    }
    page.row("radii", radii::TABLE);
    limits(&mut page, findings);
    page.line(String::new());
    for check in &findings.checks {
        let state = match check.state {
            CheckResult::Ok => style.green("ok     "),
            CheckResult::Warning => style.bold("warning"),
            CheckResult::Failed => style.red("failed "),
        };
        page.line(format!("  {state} {}: {}", style.bold(check.name), check.detail));
    }
    page.finish()
}

/// Adds all numbers of the configuration. A star marks those that are not defaults.
fn limits(page: &mut Page, findings: &Findings) {
    let document = findings.loaded.to_json();
    for (section, keys) in document["config"].as_object().into_iter().flatten() {
        let mut rows = vec![String::new()];
        for (key, value) in keys.as_object().into_iter().flatten() {
            let Some(number) = value.as_u64() else { continue };
            let set = findings.loaded.source(&format!("{section}.{key}")) != ConfigSource::Default;
            let value = if key.ends_with("_bytes") { size(number) } else { number.to_string() };
            let word = format!("{key} {value}{}", if set { "*" } else { "" });
            match rows.last_mut() {
                Some(row) if row.is_empty() => *row = word,
                Some(row) if row.chars().count() + word.chars().count() < WIDTH => {
                    row.push_str(", ");
                    row.push_str(&word);
                }
                _ => rows.push(word),
            }
        }
        for (n, row) in rows.iter().enumerate().filter(|(_, row)| !row.is_empty()) {
            page.row(if n == 0 { section } else { "" }, row);
        }
    }
}

/// Formats bytes with a binary suffix. Rounds a number that would have many digits.
pub(super) fn size(bytes: u64) -> String {
    let suffixes = [("GiB", 30), ("MiB", 20), ("KiB", 10)];
    let exact = suffixes.iter().find(|(_, shift)| bytes >= 1 << shift && bytes.trailing_zeros() >= *shift);
    let exact = exact.filter(|(_, shift)| *shift == 30 || bytes >> shift < 100_000);
    match exact {
        Some((suffix, shift)) => format!("{}{suffix}", bytes >> shift),
        None if bytes < 1 << 20 => format!("{bytes} bytes"),
        None => format!("{:.1}GiB", bytes as f64 / f64::from(1 << 30)),
    }
}

/// Formats the limits and features of a device.
fn abilities(facts: &DeviceFacts) -> String {
    let mib = |bytes: u64| format!("{} MiB", bytes >> 20);
    let subgroups = facts.subgroups.map_or("no subgroups".to_owned(), |[min, max]| {
        if min == max { format!("subgroups of {min}") } else { format!("subgroups of {min} to {max}") }
    });
    format!(
        "bindings to {}, buffers to {}, {} KiB per workgroup, {}, {subgroups}",
        mib(facts.binding_bytes),
        mib(facts.buffer_bytes),
        facts.workgroup_bytes >> 10,
        if facts.timestamps { "timestamps" } else { "no timestamps" },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_exact_or_rounded() {
        assert_eq!([0, 1000, 1024, 64 << 20, 3 << 30].map(size), ["0 bytes", "1000 bytes", "1KiB", "64MiB", "3GiB"]);
        assert_eq!([(3 << 29) + 1, 24_684_084 << 10].map(size), ["1.5GiB", "23.5GiB"]);
    }
}
