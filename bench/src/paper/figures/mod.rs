//! Figures, drawn from stored results.
//!
//! They have a white background, to be readable on dark pages, and colours that colour-blind readers can distinguish
//! (Okabe and Ito). The name of a series is at its end.

mod bars;
mod lines;

use super::entries::{ENTRIES, Entry};
use super::fit::{Fit, fits};
use super::result::{Cell, Document, Growth, Row, Side, Timed};
use lines::{Chart, Line};

/// Colour of the paper's own numbers.
const PAPER_COLOUR: &str = "#555555";
/// Colours of the programs.
const COLOURS: [(&str, &str); 4] =
    [("reference", "#D55E00"), ("cpu", "#0072B2"), ("paper", "#AA4499"), ("gpu", "#009E73")];

/// Draws all figures that have results. Returns file names and SVG texts.
pub(super) fn all(documents: &[Document]) -> Vec<(&'static str, String)> {
    let documents = &representative(documents)[..];
    let charts = [
        ("paper-cpu.svg", tables(documents, false)),
        ("paper-gpu.svg", tables(documents, true)),
        ("growth-cpu.svg", growth(documents, false)),
        ("growth-gpu.svg", growth(documents, true)),
        ("memory.svg", memory(documents)),
    ];
    let charts = charts.into_iter().filter_map(|(name, chart)| Some((name, chart.draw()?)));
    let stages = [("stages-cpu.svg", "cpu"), ("stages-gpu.svg", "gpu")];
    let stages = stages.into_iter().filter_map(|(name, program)| Some((name, bars::stages(documents, program)?)));
    let roofline =
        documents.iter().rev().find_map(|document| bars::roofline(document)).map(|svg| ("roofline.svg", svg));
    charts.chain(stages).chain(roofline).collect()
}

/// Returns the results, without those of emulated GPUs if there are results of hardware.
fn representative(documents: &[Document]) -> Vec<&Document> {
    let software = |d: &Document| d.device.as_ref().is_some_and(|device| device.software);
    let hardware = documents.iter().any(|d| d.device.is_some() && !software(d));
    documents.iter().filter(|d| !(hardware && software(d))).collect()
}

/// Returns the colour of a program.
fn colour(program: &str) -> &'static str {
    COLOURS.iter().find(|(name, _)| *name == program).map_or(PAPER_COLOUR, |(_, colour)| colour)
}

/// Returns the name of a program in the figures, with its hardware.
fn label(program: &str, document: &Document) -> String {
    let device =
        document.device.as_ref().map_or("no device", |d| if d.software { "software" } else { d.name.as_str() });
    match program {
        "reference" => "sequential reference".to_owned(),
        "cpu" => format!("native, {} threads", document.machine.threads),
        "paper" => format!("2010 program, {device}"),
        _ => format!("ours, {device}"),
    }
}

/// Creates the paper's Figure 2 or 3: time against atoms for the structures of its tables.
fn tables(documents: &[&Document], gpu: bool) -> Chart {
    fn rows(document: &Document) -> impl Iterator<Item = &Row> {
        document.rows.iter().filter(|row| row.kernel == "gaussian")
    }
    let mut lines: Vec<Line> = Vec::new();
    if documents.iter().any(|d| rows(d).next().is_some()) {
        let seconds = |entry: &Entry| if gpu { entry.gpu[0] } else { entry.cpu[0] };
        let points = ENTRIES.iter().map(|entry| (entry.atoms as f64, seconds(entry))).collect();
        let card = if gpu { "GeForce GTX 280" } else { "Core 2 Quad Q9550" };
        lines.push(Line::new(format!("the paper, {card}"), PAPER_COLOUR, points));
    }
    for document in documents {
        let of = |time: &dyn Fn(&Cell) -> Option<f64>, ours: bool| -> Vec<(f64, f64)> {
            let point = |row: &Row| {
                let side: &Side = if gpu { &row.gpu } else { &row.cpu };
                Some((row.atoms as f64, time(if ours { &side.ours } else { &side.baseline })?))
            };
            let mut points: Vec<_> = rows(document).filter_map(point).collect();
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            points
        };
        for (ours, program) in
            [(false, if gpu { "paper" } else { "reference" }), (true, if gpu { "gpu" } else { "cpu" })]
        {
            let name = label(program, document);
            lines.extend(nonempty(Line::new(name.clone(), colour(program), of(&Cell::seconds, ours)).beside(&lines)));
            let device = of(&Cell::device_seconds, ours);
            lines.extend(nonempty(Line::new(format!("{name}: stages"), colour(program), device).dotted()));
        }
    }
    let title = if gpu { "The paper's structures on a GPU" } else { "The paper's structures on a CPU" };
    Chart { title: format!("{title}, Gaussian"), y: "seconds", lines }
}

/// Creates the chart of time against atoms, with fitted exponents.
fn growth(documents: &[&Document], gpu: bool) -> Chart {
    let mut lines: Vec<Line> = Vec::new();
    for (document, growth) in grown(documents) {
        for series in &growth.series {
            if ["paper", "gpu"].contains(&series.program.as_str()) != gpu {
                continue;
            }
            let fits = fits(series);
            let fit = |what: &str| fits.iter().find(|(of, _)| *of == what).map(|(_, fit)| *fit);
            let name = label(&series.program, document);
            let colour = colour(&series.program);
            let all = series.points(&|t| Some(t.seconds.median));
            lines.extend(nonempty(Line::new(name.clone(), colour, all).beside(&lines).fitted(fit("time"))));
            let device = series.points(&Timed::device_median);
            let device = Line::new(format!("{name}: stages"), colour, device).dotted();
            lines.extend(nonempty(device.fitted(fit("device time"))));
        }
    }
    let spacing = grown(documents).next().map_or(0.0, |(_, growth)| growth.spacing);
    let on = if gpu { "on a GPU" } else { "on a CPU" };
    Chart { title: format!("Time against atoms {on}, {spacing} Å"), y: "seconds", lines }
}

/// Creates the chart of memory against atoms.
fn memory(documents: &[&Document]) -> Chart {
    let mut lines: Vec<Line> = Vec::new();
    for (document, growth) in grown(documents) {
        for series in &growth.series {
            let mega = |of: &dyn Fn(&Timed) -> Option<u64>| series.points(&|t| of(t).map(|bytes| bytes as f64 * 1e-6));
            let (name, colour) = (label(&series.program, document), colour(&series.program));
            let host = Line::new(format!("{name}: host"), colour, mega(&|t| t.host_bytes));
            lines.extend(nonempty(host.beside(&lines)));
            lines.extend(nonempty(Line::new(format!("{name}: device"), colour, mega(&|t| t.device_bytes)).dotted()));
        }
    }
    Chart { title: "Memory against atoms: host peak, device held".to_owned(), y: "MB", lines }
}

fn grown<'a>(documents: &'a [&Document]) -> impl Iterator<Item = (&'a Document, &'a Growth)> {
    documents.iter().filter_map(|d| Some((*d, d.growth.as_ref()?)))
}

impl Line {
    /// Adds the fitted power law, and its exponent to the name.
    fn fitted(self, fit: Option<Fit>) -> Self {
        let Some(fit) = fit else { return self };
        Self { name: format!("{} ∝ n^{:.2}", self.name, fit.exponent), fit: Some(fit), ..self }
    }
}

/// Returns the line if it has points.
fn nonempty(line: Line) -> Option<Line> {
    (!line.points.is_empty()).then_some(line)
}

#[cfg(test)]
mod tests {
    use super::super::result::tests::made_up;
    use super::*;

    /// Returns the first XML error of a text: mismatched tags, unquoted attributes, or bare ampersands.
    fn ill_formed(text: &str) -> Option<String> {
        let (mut open, mut rest) = (Vec::new(), text);
        while let Some((before, tag)) = rest.split_once('<') {
            let bare =
                before.split('&').skip(1).any(|part| part.split_once(';').is_none_or(|(name, _)| name.len() >= 8));
            if bare || before.contains('>') {
                return Some(format!("text {before:?}"));
            }
            if let Some(comment) = tag.strip_prefix("!--") {
                rest = comment.split_once("-->")?.1;
                continue;
            }
            let Some((tag, after)) = tag.split_once('>') else { return Some(format!("{tag:?} does not end")) };
            rest = after;
            if tag.starts_with('?') {
                continue;
            }
            if let Some(name) = tag.strip_prefix('/') {
                if open.pop() != Some(name.to_owned()) {
                    return Some(format!("</{name}> closes nothing"));
                }
                continue;
            }
            let (name, attributes) = tag.trim_end_matches('/').split_once(char::is_whitespace).unwrap_or((tag, ""));
            if attributes.split('"').step_by(2).any(|part| !part.trim().is_empty() && !part.trim().ends_with('=')) {
                return Some(format!("attributes {attributes:?}"));
            }
            if !tag.ends_with('/') {
                open.push(name.to_owned());
            }
        }
        (!open.is_empty()).then(|| format!("{open:?} are not closed"))
    }

    #[test]
    fn ill_formed_xml_is_detected() {
        assert_eq!(ill_formed("<?xml version=\"1.0\"?><a b=\"c d\"><!-- x > y --><e/>f &amp; g</a>"), None);
        for bad in ["<a>", "<a></b>", "<a b=c/>", "<a>x & y</a>", "</a>", "<a>x > y</a>", "<a"] {
            assert!(ill_formed(bad).is_some(), "{bad}");
        }
    }

    #[test]
    fn figures_are_well_formed_and_contain_all_series() {
        let figures = all(&[made_up(true)]);
        let names: Vec<&str> = figures.iter().map(|(name, _)| *name).collect();
        assert_eq!(
            names,
            [
                "paper-cpu.svg",
                "paper-gpu.svg",
                "growth-cpu.svg",
                "growth-gpu.svg",
                "memory.svg",
                "stages-cpu.svg",
                "stages-gpu.svg",
                "roofline.svg"
            ]
        );
        for (name, svg) in &figures {
            assert_eq!(ill_formed(svg), None, "{name}");
            assert!(svg.contains("white") || svg.contains("#ffffff"), "{name} has a background");
            assert!(svg.len() < 60_000, "{name}: {} bytes", svg.len());
        }
        let has = |figure: &str, what: &str| {
            let (_, svg) = figures.iter().find(|(name, _)| *name == figure).unwrap();
            svg.contains(what)
        };
        // The seconds of these results grow as n², n, n, n.
        for (figure, series) in [
            ("paper-cpu.svg", "the paper, Core 2 Quad Q9550"),
            ("paper-cpu.svg", "sequential reference"),
            ("paper-gpu.svg", "the paper, GeForce GTX 280"),
            ("paper-gpu.svg", "ours, A Card: stages"),
            ("growth-cpu.svg", "sequential reference ∝ n^2.00"),
            ("growth-cpu.svg", "native, 2 threads ∝ n^1.00"),
            ("growth-gpu.svg", "2010 program, A Card ∝ n^1.00"),
            ("growth-gpu.svg", "ours, A Card: stages ∝ n^1.00"),
            ("memory.svg", "native, 2 threads: host"),
            ("memory.svg", "ours, A Card: device"),
            ("stages-cpu.svg", "emit"),
            ("stages-gpu.svg", "field"),
            ("roofline.svg", "memory, of 4.00 TB/s"),
        ] {
            assert!(has(figure, series), "{figure} has no {series:?}");
        }
        assert!(!has("growth-cpu.svg", "A Card") && !has("paper-cpu.svg", "A Card"));
    }

    #[test]
    fn programs_that_did_not_run_have_no_figure() {
        let figures = all(&[made_up(false)]);
        let names: Vec<&str> = figures.iter().map(|(name, _)| *name).collect();
        assert_eq!(names, ["paper-cpu.svg", "paper-gpu.svg", "growth-cpu.svg", "memory.svg", "stages-cpu.svg"]);
        let (_, gpu) = &figures[1];
        assert!(gpu.contains("GTX 280") && !gpu.contains("ours"), "only the paper has a line");
        assert!(all(&[]).is_empty());
    }

    #[test]
    fn emulated_gpus_are_omitted_if_there_is_hardware() {
        let (hardware, mut software) = (made_up(true), made_up(true));
        software.device.as_mut().unwrap().software = true;
        assert_eq!(representative(&[software.clone(), hardware.clone()]), [&hardware]);
        assert_eq!(representative(&[software.clone(), made_up(false)]).len(), 2);
        assert_eq!(ENTRIES.len(), hardware.rows.len());
    }
}
