//! Bar charts: time by stage, and shares of the device rates by stage.

use kuva::backend::svg::SvgBackend;
use kuva::plot::BarPlot;
use kuva::render::layout::{ComputedLayout, Layout};
use kuva::render::plots::Plot;
use kuva::render::render::{TextAnchor, render_multiple};

use super::super::result::{Document, Point, StageFacts};
use super::lines::{framed, text};
use super::{grown, label};

/// Colours of the stages, from bottom to top.
const COLOURS: [&str; 8] = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#999999", "#117733"];
/// Minimum number of atoms of a bar. Latency dominates smaller structures.
const MIN_ATOMS: usize = 10_000;

/// Draws the time per atom by stage, for each size of a program's series in the last results that have one.
pub(super) fn stages(documents: &[&Document], program: &str) -> Option<String> {
    let (document, series) = grown(documents)
        .filter_map(|(d, growth)| Some((d, growth.series.iter().find(|s| s.program == program)?)))
        .filter(|(_, series)| series.points.iter().any(|p| p.atoms >= MIN_ATOMS && !p.timed.stages.is_empty()))
        .last()?;
    let points: Vec<&Point> =
        series.points.iter().filter(|p| p.atoms >= MIN_ATOMS && !p.timed.stages.is_empty()).collect();
    let mut names: Vec<&str> = Vec::new();
    for (name, _) in points.iter().flat_map(|p| &p.timed.stages) {
        if !names.contains(&name.as_str()) {
            names.push(name);
        }
    }
    let each = |p: &Point, name: &str| {
        let stage = p.timed.stages.iter().find(|(known, _)| known == name);
        stage.map_or(0.0, |(_, s)| s * 1e6 / p.atoms as f64)
    };
    let mut bars = BarPlot::new().with_width(0.7);
    for point in &points {
        let parts = names.iter().zip(COLOURS).map(|(name, colour)| (each(point, name), colour));
        bars = bars.with_group(thousands(point.atoms), parts);
    }
    let plots = vec![Plot::Bar(bars.with_stacked())];
    let title = format!("Time per atom by stage: {}", label(program, document));
    let layout = framed(Layout::auto_from_plots(&plots), &title).with_x_label("atoms").with_y_label("µs per atom");
    let computed = ComputedLayout::from_layout(&layout);
    let mut scene = render_multiple(plots, layout);
    let last = points.last()?;
    let (mut below, mut next, x) = (0.0, f64::MAX, computed.width - computed.margin_right + 8.0);
    for (name, colour) in names.iter().zip(COLOURS) {
        let part = each(last, name);
        let y = (computed.map_y(below + 0.5 * part) + 4.0).min(next);
        (below, next) = (below + part, y - 15.0);
        let share = 100.0 * part / names.iter().map(|name| each(last, name)).sum::<f64>();
        scene.add(text([x, y], &format!("{name}: {share:.0} % of the last bar"), colour, TextAnchor::Start));
    }
    Some(SvgBackend::new().render_scene(&scene))
}

/// Draws the shares of the device rates that each stage reaches, for the last structure of the results.
pub(super) fn roofline(document: &Document) -> Option<String> {
    let roofline = document.roofline.last()?;
    // Shares of memory and arithmetic rates.
    let reached = |s: &StageFacts| {
        let share = |work: Option<f64>, rate: f64| work.map(|work| 100.0 * work / s.seconds.max(1e-12) / rate);
        Some([share(s.bytes, roofline.memory_rate)?, share(s.fmas, roofline.fma_rate)?])
    };
    let stages: Vec<(&StageFacts, [f64; 2])> = roofline.stages.iter().filter_map(|s| Some((s, reached(s)?))).collect();
    if stages.is_empty() {
        return None;
    }
    let colours = ["#0072B2", "#E69F00"];
    let mut bars = BarPlot::new().with_width(0.7);
    for (stage, reached) in &stages {
        bars = bars.with_group(stage.stage.clone(), reached.iter().copied().zip(colours));
    }
    let plots = vec![Plot::Bar(bars)];
    let title = format!("Share of device rates by stage: {}", label("gpu", document));
    let y = "% of the measured rate";
    let layout =
        framed(Layout::auto_from_plots(&plots), &title).with_x_label(roofline.structure.clone()).with_y_label(y);
    let computed = ComputedLayout::from_layout(&layout);
    let mut scene = render_multiple(plots, layout);
    let x = computed.width - computed.margin_right + 8.0;
    let rates = [
        format!("memory, of {:.2} TB/s", roofline.memory_rate * 1e-12),
        format!("arithmetic, of {:.1} T multiply-adds/s", roofline.fma_rate * 1e-12),
    ];
    for (i, (rate, colour)) in rates.iter().zip(colours).enumerate() {
        scene.add(text([x, 70.0 + 18.0 * i as f64], rate, colour, TextAnchor::Start));
    }
    Some(SvgBackend::new().render_scene(&scene))
}

/// Formats a number with the suffixes k and M.
fn thousands(n: usize) -> String {
    match n {
        n if n >= 1_000_000 && n.is_multiple_of(1_000_000) => format!("{} M", n / 1_000_000),
        n if n >= 1_000 && n.is_multiple_of(1_000) => format!("{} k", n / 1_000),
        n => n.to_string(),
    }
}
