//! Results as Markdown: the paper's tables with published and measured times.

use std::fmt::Write as _;

use super::NOT_SELECTED;
use super::fit::fits;
use super::result::{Cell, Document, Growth, Roofline, Row, Side};

/// Marks rows in which another structure replaces the paper's.
const MARK: &str = "substitute";

/// Formats all results as a page.
pub(super) fn page(document: &Document) -> String {
    let mut page = format!("# The tables of Dias, Bora and Gomes (2010), measured\n\n{}\n", machine(document));
    for (title, body) in sections(document) {
        _ = write!(page, "## {title}\n\n{body}\n");
    }
    page
}

/// Formats the sections that have results, with their titles.
fn sections(document: &Document) -> Vec<(&'static str, String)> {
    let mut sections = Vec::new();
    if !document.rows.is_empty() {
        sections.push(("Table 1: on the CPU", cpu(&document.rows)));
        sections.push(("Table 2: on the GPU", gpu(&document.rows)));
        sections.push(("Triangles", triangles(&document.rows)));
    }
    if let Some(growth) = &document.growth {
        sections.push(("Growth", self::growth(growth)));
    }
    if !document.roofline.is_empty() {
        sections.push(("Stages against the device", roofline(&document.roofline)));
    }
    sections
}

/// Formats a part of a page: the section of each document that has it, with a description of the machine. Returns
/// `None` for an unknown name.
pub(super) fn part(name: &str, documents: &[Document]) -> Option<String> {
    let (_, title) = PARTS.iter().find(|(known, _)| *known == name)?;
    let mut text = String::new();
    for document in documents {
        let found = sections(document).into_iter().find(|(found, _)| found == title);
        if let Some((_, body)) = found.filter(|_| has(name, document)) {
            _ = write!(text, "\n{}\n{body}", machine(document));
        }
    }
    if text.is_empty() {
        text.push_str("\nNot run.\n");
    }
    Some(text + "\n")
}

/// Names of the parts of pages, and titles of their sections.
const PARTS: [(&str, &str); 5] = [
    ("table-1", "Table 1: on the CPU"),
    ("table-2", "Table 2: on the GPU"),
    ("triangles", "Triangles"),
    ("growth", "Growth"),
    ("stages", "Stages against the device"),
];

/// Returns true if any program ran in this part of a document.
fn has(name: &str, document: &Document) -> bool {
    let ran = |cell: &Cell| cell.timed.is_some();
    let any =
        |side: fn(&Row) -> &Side| document.rows.iter().map(side).any(|side| ran(&side.baseline) || ran(&side.ours));
    match name {
        "table-1" => any(|row| &row.cpu),
        "table-2" => any(|row| &row.gpu),
        _ => true,
    }
}

/// Describes machine, device, and date.
fn machine(document: &Document) -> String {
    let m = &document.machine;
    let cpu = if m.cpu.is_empty() { "unknown processor" } else { &m.cpu };
    let memory = m.memory_bytes.map(|bytes| format!(", {:.0} GB of memory", bytes as f64 * 1e-9)).unwrap_or_default();
    let device = match &document.device {
        Some(d) if d.software => format!("GPU: none; its programs ran on software ({}, {})", d.name, d.driver),
        Some(d) => format!("GPU: {} ({})", d.name, d.driver),
        None => "GPU: not run".to_owned(),
    };
    format!(
        "Measured with molmesh {} on {}:\n{cpu}, {} cores ({} threads){memory}, {}.\n{device}. Medians.\n",
        document.version, document.date, m.cores, m.threads, m.os
    )
}

/// Formats the first columns of a row.
fn structure(row: &Row) -> String {
    let mark = if row.substitute { format!(" *({MARK})*") } else { String::new() };
    let atoms = if row.atoms == row.paper_atoms {
        row.atoms.to_string()
    } else {
        format!("{} ({})", row.atoms, row.paper_atoms)
    };
    format!("| {}{mark} | {} | {atoms} ", row.id, row.kernel)
}

fn cell(cell: &Cell) -> String {
    match (cell.seconds(), &cell.not_run) {
        (Some(s), _) => seconds(s),
        (None, Some(why)) if why != NOT_SELECTED => format!("not run: {}", why.replace('|', "/")),
        (None, _) => "not run".to_owned(),
    }
}

fn ratio(value: Option<f64>) -> String {
    value.map_or("–".to_owned(), |v| format!("{} ×", three(v)))
}

fn cpu(rows: &[Row]) -> String {
    let mut text = "| structure | kernel | atoms (paper) | cubes | paper's | reference | runs | native | runs | reference : native | paper : native |\n\
        |---|---|---|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for row in rows {
        let side = &row.cpu;
        let runs = |c: &Cell| c.timed.as_ref().map_or("–".to_owned(), |t| t.runs.to_string());
        _ = writeln!(
            text,
            "{}| {} | {} | {} | {} | {} | {} | {} | {} |",
            structure(row),
            cubes(side.cubes, side.paper_cubes),
            seconds(side.paper_seconds),
            cell(&side.baseline),
            runs(&side.baseline),
            cell(&side.ours),
            runs(&side.ours),
            ratio(side.speedup()),
            ratio(side.ours.seconds().map(|s| side.paper_seconds / s)),
        );
    }
    text
}

fn gpu(rows: &[Row]) -> String {
    let mut text = "| structure | kernel | atoms (paper) | cubes | paper's | its program: whole | on the device | ours: whole | on the device | runs | device : device | whole : whole | paper : ours, whole |\n\
        |---|---|---|---|---|---|---|---|---|---|---|---|---|\n"
        .to_owned();
    for row in rows {
        let side = &row.gpu;
        let device = |c: &Cell| c.device_seconds().map_or("–".to_owned(), seconds);
        let runs = side.ours.timed.as_ref().map_or("–".to_owned(), |t| t.runs.to_string());
        let by_device = side.baseline.device_seconds().zip(side.ours.device_seconds());
        _ = writeln!(
            text,
            "{}| {} | {} | {} | {} | {} | {} | {runs} | {} | {} | {} |",
            structure(row),
            cubes(side.cubes, side.paper_cubes),
            seconds(side.paper_seconds),
            cell(&side.baseline),
            device(&side.baseline),
            cell(&side.ours),
            device(&side.ours),
            ratio(by_device.map(|(a, b)| a / b)),
            ratio(side.baseline.seconds().zip(side.ours.seconds()).map(|(a, b)| a / b)),
            ratio(side.ours.seconds().map(|s| side.paper_seconds / s)),
        );
    }
    text
}

fn cubes(ours: u64, paper: u64) -> String {
    format!("{ours} ({:+.2} %)", 100.0 * (ours as f64 / paper as f64 - 1.0))
}

/// Compares the numbers of triangles.
fn triangles(rows: &[Row]) -> String {
    let (mut compared, mut wrong) = (0, Vec::new());
    for row in rows {
        for (side, table) in [(&row.cpu, "Table 1"), (&row.gpu, "Table 2")] {
            let made = [&side.baseline, &side.ours].iter().filter(|c| c.timed.is_some()).count();
            // Without the CPU backend, the comparison is with ours.
            compared += if side.triangles.is_some() { made } else { made.saturating_sub(1) };
            let off = side.disagreements().into_iter();
            wrong.extend(off.map(|off| format!("{} {} {table}: {off}", row.id, row.kernel)));
        }
    }
    if wrong.is_empty() {
        return format!("{compared} comparisons of numbers of triangles on the same grid: all equal.\n");
    }
    let list: Vec<String> = wrong.iter().map(|w| format!("- {w}\n")).collect();
    format!(
        "{compared} comparisons of numbers of triangles on the same grid, {} differ:\n\n{}",
        wrong.len(),
        list.concat()
    )
}

fn growth(growth: &Growth) -> String {
    let mut text = format!("{} at {} Å.\n\n", growth.structure, growth.spacing);
    text.push_str(
        "| program | atoms | whole | on the device | runs | triangles | host memory, peak | device memory |\n|---|---|---|---|---|---|---|---|\n",
    );
    let mega = |bytes: Option<u64>| bytes.map_or("–".to_owned(), |b| format!("{:.0} MB", b as f64 * 1e-6));
    for series in &growth.series {
        for point in &series.points {
            let t = &point.timed;
            _ = writeln!(
                text,
                "| {} | {} | {} | {} | {} | {} | {} | {} |",
                series.program,
                point.atoms,
                seconds(t.seconds.median),
                t.device_median().map_or("–".to_owned(), seconds),
                t.runs,
                t.triangles,
                mega(t.host_bytes),
                mega(t.device_bytes)
            );
        }
        if let Some(why) = &series.ends {
            _ = writeln!(text, "| {} | not run: {why} | | | | | | |", series.program);
        }
    }
    text.push_str("\n| program | quantity | exponent | fitted from | to | sizes |\n|---|---|---|---|---|---|\n");
    for series in &growth.series {
        for (what, fit) in fits(series) {
            _ = writeln!(
                text,
                "| {} | {what} | {:.3} | {:.0} | {:.0} | {} |",
                series.program, fit.exponent, fit.from, fit.to, fit.points
            );
        }
    }
    text
}

fn roofline(all: &[Roofline]) -> String {
    let mut text = String::new();
    for one in all {
        _ = writeln!(
            text,
            "{}.\nMeasured rates of the device: {:.2} TB/s of memory, {:.2} T multiply-adds/s.\n\
             wgpu does not report registers and workgroups in flight.\n\n\
             | program | stage | threads per workgroup | shared memory | workgroups | time | minimum bytes | minimum multiply-adds | share of memory rate | share of arithmetic rate |\n\
             |---|---|---|---|---|---|---|---|---|---|",
            one.structure,
            one.memory_rate * 1e-12,
            one.fma_rate * 1e-12
        );
        for s in &one.stages {
            let number = |v: Option<f64>, unit: f64, name: &str| {
                v.map_or("not counted".to_owned(), |v| format!("{} {name}", three(v * unit)))
            };
            let share = |v: Option<f64>, rate: f64| {
                v.map_or("–".to_owned(), |v| format!("{:.1} %", 100.0 * v / s.seconds.max(1e-12) / rate))
            };
            _ = writeln!(
                text,
                "| {} | {} | {} | {} B | {} | {} | {} | {} | {} | {} |",
                s.program,
                s.stage,
                s.workgroup_size,
                s.workgroup_bytes,
                s.workgroups.map_or("–".to_owned(), |n| n.to_string()),
                seconds(s.seconds),
                number(s.bytes, 1e-6, "MB"),
                number(s.fmas, 1e-9, "G"),
                share(s.bytes, one.memory_rate),
                share(s.fmas, one.fma_rate)
            );
        }
        text.push('\n');
    }
    text
}

/// Formats a time with three significant digits in a suitable unit.
pub(super) fn seconds(s: f64) -> String {
    let (value, unit) = match s {
        s if s >= 1.0 || s == 0.0 => (s, "s"),
        s if s >= 1e-3 => (s * 1e3, "ms"),
        s => (s * 1e6, "µs"),
    };
    format!("{} {unit}", three(value))
}

/// Formats a number of at least 1 with three significant digits.
fn three(value: f64) -> String {
    match value {
        v if v >= 100.0 => format!("{v:.0}"),
        v if v >= 10.0 => format!("{v:.1}"),
        v => format!("{v:.2}"),
    }
}

#[cfg(test)]
mod tests {
    use super::super::result::tests::made_up;
    use super::*;

    #[test]
    fn times_have_three_digits_and_a_unit() {
        let all = [0.0, 250.5, 15.0, 1.004, 0.137e-3, 0.0421, 3.2e-6].map(seconds);
        assert_eq!(all, ["0.00 s", "250 s", "15.0 s", "1.00 s", "137 µs", "42.1 ms", "3.20 µs"]);
    }

    #[test]
    fn rows_mark_substitutes_and_contain_the_papers_seconds() {
        let page = page(&made_up(true));
        let rows: Vec<&str> = page.lines().filter(|line| line.starts_with("| 1BIJ")).collect();
        assert_eq!(rows.len(), 2, "{page}");
        assert!(rows.iter().all(|row| row.contains("*(substitute)*")), "{rows:?}");
        assert!(rows[0].contains("| 250 s |") && rows[1].contains("| 15.0 s |"), "{rows:?}");
        // 4387 atoms: 4.387 s against 87.74 ms, on the device half of each.
        assert!(rows[0].contains("| 4.39 s | 3 | 87.7 ms | 3 | 50.0 × | 2855 × |"), "{rows:?}");
        assert!(rows[1].contains("| 50.0 × | 50.0 × | 171 × |"), "{rows:?}");
        let columns: Vec<usize> =
            page.lines().filter(|l| l.starts_with("| 1BIJ")).map(|l| l.matches('|').count()).collect();
        assert_eq!(columns, [12, 14]);
        let mut real = made_up(true);
        real.rows.iter_mut().for_each(|row| row.substitute = false);
        assert!(!self::page(&real).contains(MARK));
    }

    #[test]
    fn different_numbers_of_triangles_are_listed() {
        assert!(page(&made_up(true)).contains("64 comparisons of numbers of triangles on the same grid: all equal"));
        let mut off = made_up(true);
        off.rows[3].gpu.baseline.timed.as_mut().unwrap().triangles += 2;
        let page = page(&off);
        assert!(page.contains("1 differ") && page.contains("4PTI gaussian Table 2: paper +2"), "{page}");
    }

    #[test]
    fn parts_include_all_documents_with_results() {
        let both = [made_up(false), made_up(true)];
        let count = |name: &str| part(name, &both).unwrap().matches("Measured with").count();
        assert_eq!(["table-1", "table-2", "growth", "stages"].map(count), [2, 1, 2, 1]);
        assert_eq!(part("table-2", &both[..1]).unwrap().trim(), "Not run.");
        assert_eq!(part("table-3", &both), None);
    }
}
