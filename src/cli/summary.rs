//! Summary of a report, as text of at most one screen.

use molmesh::formats::Format;
use molmesh::pipeline::{
    AssemblyReport, CavityReport, ColorReport, ExactReport, InstancesReport, LeftOut, PictureReport, PocketReport,
    Report, SimplificationReport, TriangleReport,
};
use molmesh::structure::strict_validator::Diagnostic;
use molmesh::surface::Validation;

use super::page::{Page, grouped};
use super::report::{self, WrittenFile};
use super::style::Style;

/// Characters of the longest bar.
const BAR: f64 = 24.0;

/// Formats the summary. `findings` are those of the strict validator, if it ran.
pub(crate) fn text(report: &Report, files: &[WrittenFile], findings: Option<&[Diagnostic]>, style: Style) -> String {
    let mut page = Page::new(style, report.id.as_deref().unwrap_or("structure"), &title(report.title.as_deref()));
    let (atoms, in_file) = (grouped(report.atoms), grouped(report.atoms_in_file));
    let models = match report.models {
        Some(1) => "1 model".to_owned(),
        Some(n) => format!("{} models", grouped(n)),
        None => format!("model {}", report.model),
    };
    page.row("atoms", &format!("{atoms} of {in_file} in the file ({}, {models})", report.source_format));
    let selected = |n| format!("{} atoms; the mesh is cut out of the surface of all atoms", grouped(n));
    page.rows("selected", report.selected_atoms.map(selected));
    page.rows("assembly", report.assembly.as_ref().map(assembled));
    page.rows("instances", report.instances.as_ref().map(|instances| repeated(report, instances)));
    page.rows("left out", left_out(&report.left_out));
    page.rows("warning", report.warnings.iter().cloned());
    page.row("surface", &surface(report));
    let [bricks, with_surface, grid_points, dense] =
        [report.bricks, report.surface_bricks, report.grid_points, report.box_cells].map(grouped);
    page.row(
        "grid",
        &format!("{bricks} bricks ({with_surface} with surface), {grid_points} grid points; box: {dense} cells"),
    );
    page.row("mesh", &format!("{} vertices, {} triangles", grouped(report.vertices), grouped(report.triangles)));
    page.rows("vertices", report.quantization.map(|found| format!("quantized in steps of {} Å", found.step)));
    page.rows("colours", report.color.as_ref().map(colors));
    let colorless = |file: &&WrittenFile| file.format.parse::<Format>().is_ok_and(|format| !format.holds_colors());
    if let (Some(_), Some(file)) = (&report.color, files.iter().find(colorless)) {
        page.row("warning", &format!("the format {} has no colours; glb, ply and obj have them", file.format));
    }
    if let Some(picture) = &report.picture {
        page.row("picture", &drawn(picture));
        page.row("renderer", &format!("{}: {} ({})", picture.renderer, picture.device, picture.reason));
    }
    let units = (report.file_units != report.report_units).then(|| format!("in {}s", report.file_units));
    let normals = (report.normals == "none").then(|| "without normals".to_owned());
    let stored: Vec<String> = units.into_iter().chain(normals).collect();
    if !stored.is_empty() {
        page.row("stored", &stored.join(", "));
    }
    page.row("validation", &validation(report, style));
    page.row("parts", &parts(report));
    let cavities = |found| cavities(found, report.cavity_list.as_deref().unwrap_or_default());
    page.rows("cavities", report.cavities.map(cavities));
    let pockets = |found| pockets(found, report.pocket_list.as_deref().unwrap_or_default());
    page.rows("pockets", report.pockets.map(pockets));
    page.rows("simplified", report.simplification.as_ref().map(simplified));
    page.rows("angles", report.triangle_shapes.as_ref().map(angles));
    let deficit =
        |percent| format!(" (macromolecules: up to {} % below the exact area; see --exact)", decimal(percent));
    let deficit = report.area_deficit_percent.map(deficit).unwrap_or_default();
    page.row("area", &format!("{} Å²{deficit}", decimal(report.area)));
    page.rows("volume", report.volume.map(|volume| format!("{} Å³", decimal(volume))));
    page.rows("exact", report.exact.as_ref().map(exact_measures));
    page.row("backend", &format!("{}: {} ({})", report.backend, report.device, report.backend_reason));
    page.rows("wrote", files.iter().map(WrittenFile::text));
    if let Some(findings) = findings {
        add_findings(&mut page, findings);
    }
    timings(&mut page, report);
    page.finish()
}

fn simplified(found: &SimplificationReport) -> String {
    let SimplificationReport { triangles_before, max_deviation, mean_deviation, intersections } = *found;
    let deviation = format!("deviation up to {max_deviation:.3} Å, mean {mean_deviation:.4} Å");
    let text = format!("from {} triangles, {deviation}", grouped(triangles_before));
    if intersections == 0 { text } else { format!("{text}, {} pairs of triangles intersect", grouped(intersections)) }
}

fn angles(shapes: &TriangleReport) -> String {
    let [all, most, median] = [shapes.smallest_angle, shapes.angle_1_percent, shapes.angle_median];
    format!("at least {all:.1}°, {most:.1}° in 99 % of the triangles, median {median:.1}°")
}

/// Formats exact areas and volume.
pub(super) fn exact_measures(exact: &ExactReport) -> String {
    let parts = exact.parts.as_ref().map(|parts| {
        let [contact, toroidal, concave] = [parts.contact, parts.toroidal, parts.concave].map(decimal);
        format!(" (contact {contact}, toroidal {toroidal}, concave {concave})")
    });
    let parts = parts.unwrap_or_default();
    let buried = exact.interface.as_ref().map(|interface| format!(", interface {} Å²", decimal(interface.area)));
    let [area, volume] = [exact.area, exact.volume].map(decimal);
    format!("area {area} Å²{parts}, volume {volume} Å³{}", buried.unwrap_or_default())
}

/// Returns the structure's title, cut to one line.
pub(super) fn title(title: Option<&str>) -> String {
    let title = title.unwrap_or_default();
    let mut chars = title.chars();
    let short: String = chars.by_ref().take(90).collect();
    if chars.next().is_some() { format!("{short}…") } else { short }
}

fn surface(report: &Report) -> String {
    let smoothness = report.smoothness.map(|a| format!(", smoothness {a}")).unwrap_or_default();
    let preset = Some(report.preset).filter(|p| *p != "default").map(|p| format!(" (preset {p})")).unwrap_or_default();
    let from = match (report.detail, report.max_triangles.zip(report.tries)) {
        (Some(level), _) => format!(" (detail {level})"),
        (None, Some((most, tries))) => format!(" (for at most {} triangles, {tries} tries)", grouped(most)),
        (None, None) => String::new(),
    };
    let isovalue = report.isovalue.map(|level| format!(", isovalue {level}")).unwrap_or_default();
    let probe = report.probe.map(|radius| format!(", probe {radius} Å")).unwrap_or_default();
    format!("{}, {} Å{from}{isovalue}{smoothness}{probe}{preset}", report.surface, report.resolution)
}

/// Formats the assembly, or its unit.
fn assembled(AssemblyReport { id, copies, unit }: &AssemblyReport) -> String {
    match unit {
        Some(unit) => format!("{id}, unit {unit} only, without operators"),
        None => format!("{id} of {} copies", grouped(*copies)),
    }
}

/// Formats the sums over all instances.
fn repeated(report: &Report, instances: &InstancesReport) -> String {
    let InstancesReport { count, atoms_sum, area_sum, volume_sum, .. } = instances;
    let [count, units, atoms] = [*count, report.parts.len() as u64, *atoms_sum].map(grouped);
    let [area, volume] = [*area_sum, *volume_sum].map(decimal);
    format!("{count} of {units} distinct units, not joined; sums: {atoms} atoms, {area} Å², {volume} Å³")
}

/// Formats the numbers of atoms that were left out, by residue name and reason, if there are any.
pub(super) fn left_out(left_out: &LeftOut) -> Option<String> {
    let LeftOut {
        total,
        other_blocks,
        spheres,
        other_models,
        other_chains,
        virtual_sites,
        kinds: _,
        residues,
        other_residues,
        hydrogens,
        alternatives,
    } = left_out;
    let named = residues.iter().map(|residue| format!("{} {}", residue.name, grouped(residue.atoms)));
    let counted = [
        ("other residues", other_residues),
        ("hydrogens", hydrogens),
        ("alternative locations", alternatives),
        ("virtual sites", virtual_sites),
        ("other chains", other_chains),
        ("other models", other_models),
        ("other data blocks", other_blocks),
        ("coarse-grained spheres", spheres),
    ];
    let counted = counted.into_iter().filter(|(_, n)| **n > 0).map(|(what, n)| format!("{what} {}", grouped(*n)));
    let reasons = || named.chain(counted).collect::<Vec<_>>().join(", ");
    (*total > 0).then(|| format!("{} atoms: {}", grouped(*total), reasons()))
}

/// Formats the colours and the first entries of their legend.
fn colors(color: &ColorReport) -> String {
    const MAX_ENTRIES: usize = 6;
    let palette = color.palette.map(|palette| format!(", {palette}")).unwrap_or_default();
    let range = color.range.map(|[low, high]| format!(" from {low} to {high}")).unwrap_or_default();
    let entries = color.legend.iter().filter(|_| color.range.is_none()).take(MAX_ENTRIES);
    let entries: Vec<String> = entries.map(|entry| format!("{} {}", entry.label, entry.color)).collect();
    let more = if color.range.is_none() && color.legend.len() > MAX_ENTRIES { ", …" } else { "" };
    let legend = if entries.is_empty() { String::new() } else { format!(": {}{more}", entries.join(", ")) };
    format!("{}{palette}{range}{legend}", color.scheme)
}

fn drawn(picture: &PictureReport) -> String {
    let PictureReport { width, height, view, azimuth, elevation, background, style, pixel, .. } = picture;
    let turned = match (*azimuth, *elevation) {
        (0.0, 0.0) => String::new(),
        (azimuth, elevation) => format!(", azimuth {azimuth}°, elevation {elevation}°"),
    };
    format!("{width} × {height}, {view} view{turned}, {style}, {background} background, {pixel:.4} Å per pixel")
}

fn validation(report: &Report, style: Style) -> String {
    let status = |holds: bool, yes: &str, no: &str| if holds { style.green(yes) } else { style.red(no) };
    let method = if report.validation == Validation::Exact.name() { "exact edge matching" } else { "edge checksum" };
    let manifold = if report.manifold_from == "check" { "manifold" } else { "manifold by construction" };
    if report.open_reason.is_some() {
        let oriented = status(report.oriented, "oriented", "NOT oriented");
        return format!("open along the cut (by {method}), {oriented}, Euler number {}", report.euler);
    }
    format!(
        "{} (by {method}), {}, {}, Euler number {}",
        status(report.closed, "watertight", "NOT watertight"),
        status(report.oriented, "oriented", "NOT oriented"),
        status(report.manifold, manifold, "NOT manifold"),
        report.euler
    )
}

fn parts(report: &Report) -> String {
    let of = |n: u64, one: &str, more: &str| format!("{} {}", grouped(n), if n == 1 { one } else { more });
    let components = of(report.components, "component", "components");
    match report.voids {
        0 => format!("{components}, no voids"),
        n => format!("{components}, of which {}", of(n, "void", "voids")),
    }
}

/// Formats the number of cavities and the volumes of the largest ones.
fn cavities(found: u64, largest: &[CavityReport]) -> String {
    let volumes: Vec<String> = largest.iter().take(5).map(|cavity| decimal(cavity.accessible_volume)).collect();
    match volumes.len() {
        0 => grouped(found),
        n => {
            let more = if found > n as u64 { ", …" } else { "" };
            let volumes = volumes.join(", ");
            let open = largest.iter().filter(|cavity| cavity.enclosed == Some(false)).count();
            let missing = if open > 0 { format!("; {open} not enclosed by the mesh") } else { String::new() };
            format!("{} (accessible volume {volumes}{more} Å³{missing})", grouped(found))
        }
    }
}

/// Formats the number of pockets and the volumes of the largest ones.
fn pockets(found: u64, largest: &[PocketReport]) -> String {
    let volumes: Vec<String> = largest.iter().take(5).map(|pocket| decimal(pocket.volume)).collect();
    let more = if found > volumes.len() as u64 { ", …" } else { "" };
    if volumes.is_empty() { grouped(found) } else { format!("{} ({}{more} Å³)", grouped(found), volumes.join(", ")) }
}

/// Adds the first findings only, as a damaged file can have one in each line.
pub(super) fn add_findings(page: &mut Page, findings: &[Diagnostic]) {
    let of = if findings.len() == 1 { "finding" } else { "findings" };
    page.row("check", &format!("{} {of} of the strict validator", findings.len()));
    for finding in findings.iter().take(5) {
        let text = format!("{}: {}", finding.level.name(), report::finding(finding));
        page.line(format!("    {}", text.chars().take(110).collect::<String>()));
    }
}

/// Adds a bar for each stage, relative to the longest stage.
fn timings(page: &mut Page, report: &Report) {
    let stages: Vec<(&str, f64)> =
        report.timings_ms.iter().filter_map(|(name, ms)| Some((name.as_str(), ms.as_f64()?))).collect();
    let total: f64 = stages.iter().map(|(_, ms)| ms).sum();
    let longest = stages.iter().map(|(_, ms)| *ms).fold(f64::MIN_POSITIVE, f64::max);
    page.row("time", &format!("{} ms", decimal(total)));
    for (name, ms) in stages {
        let (label, bar) = (page.style.dim(&format!("{name:<12}")), page.style.cyan(&bar(ms / longest)));
        page.line(format!("    {label} {:>9} ms  {bar}", decimal(ms)));
    }
}

/// Returns a bar with a resolution of an eighth of a character.
fn bar(fraction: f64) -> String {
    const EIGHTHS: [&str; 8] = ["", "▏", "▎", "▍", "▌", "▋", "▊", "▉"];
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to 0..=192")]
    let eighths = (fraction.clamp(0.0, 1.0) * BAR * 8.0).round().max(1.0) as usize;
    format!("{}{}", "█".repeat(eighths / 8), EIGHTHS[eighths % 8])
}

/// Formats a number with one decimal from 100, two from 1 and three below 1.
pub(super) fn decimal(value: f64) -> String {
    let digits = match value.abs() {
        v if v >= 100.0 => 1,
        v if v >= 1.0 => 2,
        _ => 3,
    };
    let text = format!("{value:.digits$}");
    let (sign, unsigned) = text.strip_prefix('-').map_or(("", text.as_str()), |rest| ("-", rest));
    match unsigned.split_once('.') {
        Some((whole, part)) => {
            let whole = whole.parse().map_or_else(|_| whole.to_owned(), grouped);
            format!("{sign}{whole}.{part}")
        }
        None => text,
    }
}

#[cfg(test)]
mod tests {
    use molmesh::pipeline::color::LegendEntry;
    use molmesh::pipeline::{Quantization, ResidueCount};

    use super::*;

    #[test]
    fn formats_numbers() {
        assert_eq!([0, 999, 1000, 1_234_567].map(grouped), ["0", "999", "1,000", "1,234,567"]);
        assert_eq!([0.0123, 3.1234, -1234.56, 99.999].map(decimal), ["0.012", "3.12", "-1,234.6", "100.00"]);
        assert_eq!(decimal(f64::NAN), "NaN");
    }

    #[test]
    fn bars_are_proportional_and_never_empty() {
        let cells = [0.0, 0.1, 0.5, 1.0].map(|f| bar(f).chars().count());
        assert_eq!(cells, [1, 3, 12, 24]);
        assert_eq!(bar(2.0), bar(1.0));
    }

    #[expect(clippy::too_many_lines, reason = "a field per line")]
    fn report() -> Report {
        Report {
            id: Some("4PTI".into()),
            title: Some("TRYPSIN INHIBITOR".into()),
            source_format: "pdb",
            atoms: 454,
            selected_atoms: None,
            atoms_in_file: 514,
            model: 1,
            models: None,
            assembly: None,
            instances: None,
            left_out: LeftOut {
                total: 60,
                virtual_sites: 2,
                residues: vec![ResidueCount { name: "HOH".into(), kind: "water", atoms: 53 }],
                hydrogens: 5,
                ..LeftOut::default()
            },
            warnings: vec!["line 9, column 55: found `   inf`; read as 1".into()],
            radii: "table",
            surface: "gaussian",
            probe: None,
            preset: "default",
            resolution: 0.5,
            resolution_from: "max_triangles",
            detail: None,
            max_triangles: Some(40_000),
            tries: Some(2),
            isovalue: Some(1.0),
            smoothness: Some(1.25),
            bricks: 300,
            surface_bricks: 250,
            grid_points: 153_600,
            box_cells: 1_000_000,
            vertices: 20_000,
            triangles: 39_996,
            closed: true,
            open_reason: None,
            oriented: true,
            manifold: false,
            manifold_from: "check",
            validation: "checksum",
            euler: 2,
            components: 2,
            voids: 1,
            void_list: Vec::new(),
            cavities: Some(2),
            cavity_list: None,
            pockets: Some(0),
            triangle_shapes: Some(TriangleReport {
                smallest_angle: 4.25,
                angle_0_1_percent: 20.0,
                angle_1_percent: 33.8,
                angle_median: 45.6,
                angle_histogram: Vec::new(),
                aspect_histogram: Vec::new(),
            }),
            simplification: None,
            pocket_list: None,
            component_list: Vec::new(),
            parts: Vec::new(),
            area: 3200.04,
            volume: Some(7100.0),
            report_units: "angstrom",
            file_units: "nanometer",
            normals: "none",
            quantization: Some(Quantization { step: 0.000_976_562_5 }),
            color: Some(ColorReport {
                scheme: "chain".into(),
                palette: None,
                range: None,
                blend: None,
                source: None,
                map: None,
                legend: vec![LegendEntry { label: "A".into(), color: "#4fa59b".into() }],
            }),
            exact: None,
            area_deficit_percent: None,
            backend: "cpu",
            arithmetic: String::new(),
            device: "2 threads".into(),
            backend_reason: "requested".into(),
            fallback: None,
            picture: Some(PictureReport {
                width: 640,
                height: 480,
                view: "principal",
                azimuth: 30.0,
                elevation: 0.0,
                background: "transparent".into(),
                style: "surface",
                pixel: 0.12345,
                renderer: "cpu",
                arithmetic: String::new(),
                device: "CPU rasterizer, 2 threads".into(),
                reason: "auto: no GPU".into(),
                fallback: None,
            }),
            timings_ms: [("read".to_owned(), 0.25.into()), ("field".to_owned(), 2.5.into())].into_iter().collect(),
        }
    }

    #[test]
    fn summary_is_complete_and_fits_one_screen() {
        let name = "a.glb".to_owned();
        let mut mesh = WrittenFile { member: "output", name, format: "glb", bytes: 720_000, is_stdout: false };
        let text = text(&report(), std::slice::from_ref(&mesh), None, Style::PLAIN);
        for part in [
            "4PTI TRYPSIN INHIBITOR",
            "454 of 514",
            "60 atoms: HOH 53, hydrogens 5, virtual sites 2",
            "warning    line 9, column 55: found `   inf`; read as 1",
            "300 bricks",
            "153,600 grid points",
            "0.5 Å (for at most 40,000 triangles, 2 tries)",
            "in nanometers, without normals",
            "20,000 vertices",
            "steps of 0.0009765625 Å",
            "colours    chain: A #4fa59b",
            "39,996 triangles",
            "watertight (by edge checksum), oriented, NOT manifold, Euler number 2",
            "2 components, of which 1 void",
            "angles     at least 4.2°, 33.8° in 99 % of the triangles, median 45.6°",
            "3,200.0 Å²",
            "7,100.0 Å³",
            "cpu: 2 threads (requested)",
            "a.glb (glb, 720,000 bytes)",
            "640 × 480, principal view, azimuth 30°, elevation 0°, surface, transparent background, 0.1235 Å per pixel",
            "cpu: CPU rasterizer, 2 threads (auto: no GPU)",
            "2.75 ms",
            "field",
        ] {
            assert!(text.contains(part), "no `{part}` in\n{text}");
        }
        assert!(text.lines().count() <= 26, "{text}");
        let warning = "the format stl has no colours";
        assert!(!text.contains(warning));
        mesh.format = "stl";
        assert!(super::text(&report(), &[mesh], None, Style::PLAIN).contains(warning));
    }
}
