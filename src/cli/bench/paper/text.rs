//! The results as text for a terminal, line by line as they come.

use std::fmt::Write as _;

use super::fit;
use super::result::{Cell, Document, Growth, Roofline, Row, Series, Side};

/// What a stand-in is marked with in every row.
pub(super) const MARK: &str = "stand-in";

/// The machine and the device.
pub(super) fn head(document: &Document, no_device: Option<&String>) -> String {
    let m = &document.machine;
    let memory = m.memory_bytes.map(|bytes| format!(", {:.0} GB", bytes as f64 * 1e-9)).unwrap_or_default();
    let cpu = if m.cpu.is_empty() { "processor without a name" } else { &m.cpu };
    let device = match (&document.device, no_device) {
        (Some(d), _) => format!("{}, {}{}", d.name, d.driver, if d.software { ", SOFTWARE: no GPU" } else { "" }),
        (None, why) => why.cloned().unwrap_or_default(),
    };
    format!("machine: {cpu}, {} cores, {} threads{memory}, {}\ndevice: {device}\n\n", m.cores, m.threads, m.os)
}

/// The columns of [`row`].
pub(super) fn columns() -> String {
    "from spheres to a mesh in memory, medians; on the device in brackets; × how many times faster than the program before it\n\
     structure  kernel          atoms  paper CPU    reference          native  |  paper GPU         its program                  ours\n"
        .to_owned()
}

/// One row, and below it where it is not the paper's structure or programs disagree.
pub(super) fn row(row: &Row) -> String {
    let mut text = format!("{:<10} {:<14} {:>6}", row.id, row.kernel, row.atoms);
    for side in [&row.cpu, &row.gpu] {
        _ = write!(text, " {:>10}", seconds(side.paper_seconds));
        for cell in [&side.baseline, &side.ours] {
            _ = write!(text, " {:>19}", time(cell));
        }
        if let Some(faster) = faster(side) {
            _ = write!(text, " ×{faster:.1}");
        }
        text.push_str(" |");
    }
    text = text.trim_end_matches(" |").to_owned() + "\n";
    let mut note = |what: String| _ = writeln!(text, "           {what}");
    if row.stand_in {
        note(format!("{MARK}: {}", row.source));
    } else if row.atoms != row.paper_atoms {
        note(format!("{}; the paper counts {} atoms", row.source, row.paper_atoms));
    }
    for cell in [&row.cpu.baseline, &row.cpu.ours, &row.gpu.baseline, &row.gpu.ours] {
        if let Some(why) = cell.not_run.as_ref().filter(|why| *why != "not asked for") {
            note(format!("{} not run: {why}", cell.program));
        }
    }
    for side in [&row.cpu, &row.gpu] {
        let off = disagreements(side);
        if !off.is_empty() {
            note(format!("TRIANGLES DIFFER from the native backend's: {}", off.join(", ")));
        }
    }
    text
}

/// A program's time.
fn time(cell: &Cell) -> String {
    match (cell.seconds(), cell.device_seconds()) {
        (None, _) => "not run".to_owned(),
        (Some(all), None) => seconds(all),
        (Some(all), Some(device)) => format!("{} [{}]", seconds(all), seconds(device)),
    }
}

/// How many times ours is faster than the baseline of its side: by device time where both have it.
pub(super) fn faster(side: &Side) -> Option<f64> {
    let device = side.baseline.device_seconds().zip(side.ours.device_seconds());
    let (baseline, ours) = device.or_else(|| side.baseline.seconds().zip(side.ours.seconds()))?;
    Some(baseline / ours)
}

/// The programs of a side that made other numbers of triangles than the native backend, or, where that did not run, than
/// each other.
pub(super) fn disagreements(side: &Side) -> Vec<String> {
    let of = |cell: &Cell| cell.timed.as_ref().map(|t| t.triangles);
    let expected = side.triangles.or_else(|| of(&side.ours));
    let differs = |cell: &Cell| {
        let (made, expected) = (of(cell)?, expected?);
        (made != expected).then(|| format!("{} {:+}", cell.program, made.cast_signed() - expected.cast_signed()))
    };
    [&side.baseline, &side.ours].into_iter().filter_map(differs).collect()
}

/// A time in the unit that suits it, three digits.
pub(super) fn seconds(s: f64) -> String {
    let (value, unit) = match s {
        s if s >= 1.0 || s == 0.0 => (s, "s"),
        s if s >= 1e-3 => (s * 1e3, "ms"),
        s => (s * 1e6, "µs"),
    };
    format!("{} {unit}", three(value))
}

/// Three digits that count.
pub(super) fn three(value: f64) -> String {
    match value {
        v if v >= 100.0 => format!("{v:.0}"),
        v if v >= 10.0 => format!("{v:.1}"),
        v => format!("{v:.2}"),
    }
}

/// The growth, a block for each program.
pub(super) fn growth(growth: Option<&Growth>) -> String {
    let Some(growth) = growth else { return String::new() };
    let mut text = format!("\ntime against atoms: {} at {} Å\n", growth.structure, growth.spacing);
    for series in &growth.series {
        _ = writeln!(text, "{}", series.program);
        for point in &series.points {
            let t = &point.timed;
            let mega = |bytes: Option<u64>| bytes.map_or("–".to_owned(), |b| format!("{:.0} MB", b as f64 * 1e-6));
            let device = t.device_seconds.map(|s| format!(" [{}]", seconds(s.median))).unwrap_or_default();
            _ = writeln!(
                text,
                "  {:>9} atoms {:>22} {:>11} triangles, host {}, device {}",
                point.atoms,
                seconds(t.seconds.median) + &device,
                t.triangles,
                mega(t.host_bytes),
                mega(t.device_bytes)
            );
        }
        if let Some(why) = &series.ends {
            _ = writeln!(text, "  not run: {why}");
        }
        for (what, fit) in fits(series) {
            _ = writeln!(
                text,
                "  {what} grows with atoms to the power of {:.3} ({} sizes from {:.0} to {:.0})",
                fit.exponent, fit.points, fit.from, fit.to
            );
        }
    }
    text
}

/// The fits of a series: of its time, and of its time on the device.
pub(super) fn fits(series: &Series) -> Vec<(&'static str, fit::Fit)> {
    let points = |of: &dyn Fn(&super::result::Point) -> Option<f64>| -> Vec<(f64, f64)> {
        series.points.iter().filter_map(|p| Some((p.atoms as f64, of(p)?))).collect()
    };
    let all = points(&|p| Some(p.timed.seconds.median));
    let device = points(&|p| p.timed.device_seconds.map(|s| s.median));
    let named = [("time", all), ("device time", device)];
    named.into_iter().filter_map(|(what, points)| Some((what, fit::fit(&points, fit::from(&points))?))).collect()
}

/// The stages against the device.
pub(super) fn roofline(all: &[Roofline]) -> String {
    let mut text = String::new();
    for one in all {
        _ = writeln!(
            text,
            "\nstages: {}; memory {:.2} TB/s, {:.2} T multiply-adds/s measured",
            one.structure,
            one.memory_rate * 1e-12,
            one.fma_rate * 1e-12
        );
        for stage in &one.stages {
            let share = |work: Option<f64>, rate: f64| {
                work.map_or("–".to_owned(), |work| format!("{:.1} %", 100.0 * work / stage.seconds.max(1e-12) / rate))
            };
            _ = writeln!(
                text,
                "  {:<6}{:<12}{:>5} threads {:>6} B shared {:>9} workgroups {:>10}: {:>7} of the memory rate, {:>7} of the arithmetic",
                stage.program,
                stage.stage,
                stage.workgroup_size,
                stage.workgroup_bytes,
                stage.workgroups.map_or("–".to_owned(), |n| n.to_string()),
                seconds(stage.seconds),
                share(stage.bytes, one.memory_rate),
                share(stage.fmas, one.fma_rate)
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_three_digits_and_a_unit() {
        let all = [0.0, 250.5, 15.0, 1.004, 0.137e-3, 0.0421, 3.2e-6].map(seconds);
        assert_eq!(all, ["0.00 s", "250 s", "15.0 s", "1.00 s", "137 µs", "42.1 ms", "3.20 µs"]);
    }
}
