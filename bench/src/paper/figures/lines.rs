//! Line charts with logarithmic axes.

use kuva::backend::svg::SvgBackend;
use kuva::plot::{LinePlot, MarkerShape, ScatterPlot};
use kuva::render::color::Color;
use kuva::render::layout::{ComputedLayout, Layout, TickFormat};
use kuva::render::plots::Plot;
use kuva::render::render::{Primitive, TextAnchor, render_multiple};
use std::sync::Arc;

use super::super::fit::Fit;

/// Width and height of a figure, pixels.
const SIZE: [f64; 2] = [860.0, 460.0];
/// Width of the names on the right, pixels.
const NAMES: f64 = 300.0;
/// Font size, pixels.
const TEXT: u32 = 12;

/// Chart over the number of atoms.
pub(super) struct Chart {
    pub(super) title: String,
    /// Label of the y axis.
    pub(super) y: &'static str,
    pub(super) lines: Vec<Line>,
}

/// Line of a chart.
pub(super) struct Line {
    pub(super) name: String,
    pub(super) colour: &'static str,
    pub(super) points: Vec<(f64, f64)>,
    pub(super) fit: Option<Fit>,
    /// Dash pattern; `None` for a solid line.
    pub(super) dash: Option<&'static str>,
}

impl Line {
    pub(super) fn new(name: String, colour: &'static str, points: Vec<(f64, f64)>) -> Self {
        Self { name, colour, points, fit: None, dash: None }
    }

    /// Makes the line dashed if `others` contain a solid one of its colour, which is that of another machine.
    pub(super) fn beside(self, others: &[Self]) -> Self {
        let again = others.iter().any(|other| other.colour == self.colour && other.dash.is_none());
        Self { dash: again.then_some("7 4"), ..self }
    }

    /// Makes the line dotted, for a part of the time.
    pub(super) fn dotted(self) -> Self {
        Self { dash: Some("2 3"), ..self }
    }
}

impl Chart {
    /// Draws the chart as SVG; `None` if it has no points.
    pub(super) fn draw(&self) -> Option<String> {
        let mut plots = Vec::new();
        for line in &self.lines {
            let mut plot = LinePlot::new()
                .with_data(line.points.iter().copied())
                .with_color(line.colour)
                .with_stroke_width(if line.dash == Some("2 3") { 1.2 } else { 2.0 });
            plot = match line.dash {
                Some("2 3") => plot.with_dotted(),
                Some(_) => plot.with_dashed(),
                None => plot,
            };
            plots.push(Plot::Line(plot));
            let dots = ScatterPlot::new()
                .with_data(line.points.iter().copied())
                .with_color(line.colour)
                .with_marker(MarkerShape::Circle)
                .with_size(2.5);
            plots.push(Plot::Scatter(dots));
            if let Some(fit) = line.fit {
                let law = [fit.from, fit.to].map(|x| (x, fit.at(x)));
                plots.push(Plot::Line(LinePlot::new().with_data(law).with_color("#222222").with_stroke_width(0.6)));
            }
        }
        let all = || self.lines.iter().flat_map(|line| line.points.iter().copied());
        let edge = |of: fn(f64, f64) -> f64, start: f64, axis: fn((f64, f64)) -> f64| all().map(axis).fold(start, of);
        let (first, right) = (edge(f64::min, f64::MAX, |p| p.0), edge(f64::max, 0.0, |p| p.0));
        let (low, high) = (edge(f64::min, f64::MAX, |p| p.1), edge(f64::max, 0.0, |p| p.1));
        if all().next().is_none() || low <= 0.0 || first <= 0.0 {
            return None;
        }
        let layout = framed(Layout::auto_from_plots(&plots), &self.title)
            .with_x_label("atoms")
            .with_y_label(self.y)
            .with_log_scale()
            .with_x_axis_min(10_f64.powf(first.log10().floor()))
            .with_x_axis_max(right)
            .with_y_axis_min(10_f64.powf(low.log10().floor()))
            .with_y_axis_max(10_f64.powf(high.log10().ceil()))
            .with_x_tick_format(TickFormat::Custom(Arc::new(power)))
            .with_y_tick_format(TickFormat::Custom(Arc::new(power)));
        let computed = ComputedLayout::from_layout(&layout);
        let mut scene = render_multiple(plots, layout);
        // Names are beside the ends of the lines, moved apart if they would overlap.
        let mut names: Vec<(f64, &Line)> =
            self.lines.iter().filter_map(|line| Some((computed.map_y(line.points.last()?.1), line))).collect();
        names.sort_by(|a, b| a.0.total_cmp(&b.0));
        let step = f64::from(TEXT) + 3.0;
        let height = step * (names.len().saturating_sub(1)) as f64;
        let mut next = f64::MIN;
        for (i, (y, line)) in names.iter().enumerate() {
            let left_below = step * (names.len() - 1 - i) as f64;
            let y = y.max(next).min((SIZE[1] - 50.0).max(height) - left_below);
            next = y + step;
            let end = line.points.last().copied().unwrap_or_default();
            let from = [computed.map_x(end.0), computed.map_y(end.1)];
            let at = computed.map_x(right) + 14.0;
            scene.add(Primitive::Line {
                x1: from[0] + 4.0,
                y1: from[1],
                x2: at - 3.0,
                y2: y,
                stroke: Color::from(line.colour),
                stroke_width: 0.5,
                stroke_dasharray: None,
            });
            scene.add(text([at, y + 4.0], &line.name, line.colour, TextAnchor::Start));
        }
        Some(SvgBackend::new().render_scene(&scene))
    }
}

/// Applies the size and fonts of all figures.
pub(super) fn framed(layout: Layout, title: &str) -> Layout {
    layout
        .with_width(SIZE[0])
        .with_height(SIZE[1])
        .with_title(title)
        .with_title_size(15)
        .with_label_size(13)
        .with_tick_size(11)
        .with_font_family("Helvetica, Arial, sans-serif")
        .with_force_margins(70.0, NAMES)
}

/// Returns a line of text.
pub(super) fn text([x, y]: [f64; 2], content: &str, colour: &str, anchor: TextAnchor) -> Primitive {
    let (content, color) = (content.to_owned(), Some(Color::from(colour)));
    Primitive::Text { x, y, content, size: TEXT, anchor, rotate: None, bold: false, color }
}

/// Formats a power of ten. Returns an empty text for other numbers.
fn power(value: f64) -> String {
    let exponent = value.log10().round();
    if (value / 10_f64.powf(exponent) - 1.0).abs() > 1e-6 {
        return String::new();
    }
    let digit = |c: char| match c {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        c => char::from_u32(u32::from(c) - u32::from('0') + 0x2070).unwrap_or(c),
    };
    match exponent {
        0.0 => "1".to_owned(),
        1.0 => "10".to_owned(),
        e => format!("10{}", format!("{e:.0}").chars().map(digit).collect::<String>()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_of_ten_are_formatted() {
        assert_eq!([1.0, 10.0, 1e-6, 1e4, 1e12, 300.0].map(power), ["1", "10", "10⁻⁶", "10⁴", "10¹²", ""]);
    }
}
