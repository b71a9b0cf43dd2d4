//! What was measured, as text.

use std::fmt::Write as _;

use molmesh::gpu::yardstick::Rates;
use serde_json::{Value, json};

use super::measure::{Row, Spread};

/// The device's rates.
pub(super) fn rates(rates: Option<&Rates>) -> String {
    match rates {
        Some(r) => format!(
            "measured: memory {:.3} TB/s (read + written), {:.2} T multiply-adds/s, to the host {:.1} GB/s, round trip {:.0} µs\n\n",
            r.memory * 1e-12,
            r.fma * 1e-12,
            r.to_host * 1e-9,
            r.round_trip * 1e6,
        ),
        None => "no timestamps on this device: no times of stages and no floors\n\n".to_owned(),
    }
}

/// The same as JSON, in bytes, operations and seconds.
pub(super) fn rates_json(r: Rates) -> Value {
    json!({ "memory": r.memory, "fma": r.fma, "to_host": r.to_host, "round_trip": r.round_trip })
}

/// One case.
pub(super) fn row(name: &str, row: &Result<Row, String>) -> String {
    let row = match row {
        Ok(row) => row,
        Err(why) => return format!("{name}: not measured: {why}\n\n"),
    };
    let mut text = format!(
        "{name}: {} atoms at {:.4} Å, {} cells in the box, {} bricks ({} with surface), {} pairs, {} vertices{}, {} triangles, {:.1} MB, {} submissions\n",
        row.atoms,
        row.resolution,
        row.box_cells,
        row.bricks,
        row.surface_bricks,
        row.pairs,
        row.vertices,
        row.step.map(|step| format!(" in steps of {step} Å")).unwrap_or_default(),
        row.triangles,
        row.bytes as f64 * 1e-6,
        row.submissions,
    );
    // A string takes everything.
    _ = writeln!(
        text,
        "  {:<18}{:>10}{:>10}{:>10}{:>8}{:>10}{:>10}",
        "ms", "median", "min", "floor", "ratio", "MB", "Gfma"
    );
    let mut line = |name: &str, ms: Spread, floor: Option<f64>, work: Option<[f64; 2]>| {
        let number = |v: Option<f64>, digits: usize| v.map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"));
        let ratio = floor.filter(|f| *f > 0.0).map(|floor| ms.median / floor);
        _ = writeln!(
            text,
            "  {name:<18}{:>10.4}{:>10.4}{:>10}{:>8}{:>10}{:>10}",
            ms.median,
            ms.min,
            number(floor, 4),
            number(ratio, 1),
            number(work.map(|w| w[0] * 1e-6), 2),
            number(work.map(|w| w[1] * 1e-9), 2),
        );
    };
    for stage in &row.stages {
        line(stage.stage, stage.ms, stage.floor_ms, Some([stage.bytes, stage.fmas]));
    }
    line("stages, summed", row.stages_ms, row.floor_ms, None);
    line("first to last", row.device_ms, row.floor_ms, None);
    line("prepare (host)", row.prepare_ms, None, None);
    line("request to ready", row.ready_ms, row.transfer_floor_ms, None);
    line("request to read", row.read_ms, None, None);
    match &row.paper {
        Some(Ok(paper)) => {
            for (stage, ms) in &paper.stages {
                line(&format!("2010: {stage}"), *ms, None, None);
            }
            line("2010: summed", paper.stages_ms, None, None);
            line("2010: ready", paper.ready_ms, None, None);
            _ = writeln!(text, "  2010: {} triangles, {:.1} times slower on the device", paper.triangles, paper.faster);
        }
        Some(Err(why)) => _ = writeln!(text, "  2010: not measured: {why}"),
        None => {}
    }
    if let Some(check) = &row.check {
        _ = writeln!(
            text,
            "  against the CPU: {:+} triangles, area {:+.2e}, volume {:+.2e}, closed: {}",
            check.triangles, check.area, check.volume, check.closed
        );
    }
    text.push('\n');
    text
}
