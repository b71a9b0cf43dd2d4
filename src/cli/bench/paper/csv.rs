//! The results as comma-separated values (RFC 4180), one line for each structure, kernel and program.

use super::result::{Growth, Row, Series, Side, Timed};

/// The columns of the tables.
const COLUMNS: [&str; 19] = [
    "id",
    "kernel",
    "paper_atoms",
    "atoms",
    "source",
    "stand_in",
    "program",
    "paper_cubes",
    "cubes",
    "spacing_angstrom",
    "paper_seconds",
    "runs",
    "seconds_median",
    "seconds_min",
    "device_seconds_median",
    "triangles",
    "native_triangles",
    "host_bytes",
    "not_run",
];

/// The tables.
pub(super) fn rows(rows: &[Row]) -> String {
    let mut text = line(COLUMNS);
    for row in rows {
        for side in [&row.cpu, &row.gpu] {
            for cell in [&side.baseline, &side.ours] {
                text.push_str(&self::row(row, side, cell));
            }
        }
    }
    text
}

fn row(row: &Row, side: &Side, cell: &super::result::Cell) -> String {
    let timed = cell.timed.as_ref();
    let of = |value: &dyn Fn(&Timed) -> String| timed.map(value).unwrap_or_default();
    line([
        row.id.clone(),
        row.kernel.clone(),
        row.paper_atoms.to_string(),
        row.atoms.to_string(),
        row.source.clone(),
        row.stand_in.to_string(),
        cell.program.clone(),
        side.paper_cubes.to_string(),
        side.cubes.to_string(),
        format!("{:.5}", side.spacing),
        side.paper_seconds.to_string(),
        of(&|t| t.runs.to_string()),
        of(&|t| t.seconds.median.to_string()),
        of(&|t| t.seconds.min.to_string()),
        of(&|t| option(t.device_seconds.map(|s| s.median))),
        of(&|t| t.triangles.to_string()),
        option(side.triangles),
        of(&|t| option(t.host_bytes)),
        cell.not_run.clone().unwrap_or_default(),
    ])
}

/// Time and memory against atoms.
pub(super) fn growth(growth: &Growth) -> String {
    let head = [
        "program",
        "atoms",
        "spacing_angstrom",
        "runs",
        "seconds_median",
        "seconds_min",
        "device_seconds_median",
        "triangles",
        "host_bytes",
        "device_bytes",
        "not_run",
    ];
    let mut text = line(head);
    let spacing = growth.spacing.to_string();
    for Series { program, points, ends } in &growth.series {
        for point in points {
            let t = &point.timed;
            text.push_str(&line([
                program.clone(),
                point.atoms.to_string(),
                spacing.clone(),
                t.runs.to_string(),
                t.seconds.median.to_string(),
                t.seconds.min.to_string(),
                option(t.device_seconds.map(|s| s.median)),
                t.triangles.to_string(),
                option(t.host_bytes),
                option(t.device_bytes),
                String::new(),
            ]));
        }
        if let Some(why) = ends {
            let mut row = vec![String::new(); head.len()];
            (row[0], row[2], row[10]) = (program.clone(), spacing.clone(), why.clone());
            text.push_str(&line(row));
        }
    }
    text
}

fn option(value: Option<impl ToString>) -> String {
    value.map(|v| v.to_string()).unwrap_or_default()
}

fn line(fields: impl IntoIterator<Item = impl AsRef<str>>) -> String {
    let quoted = |field: &str| {
        if field.contains([',', '"', '\n', '\r']) {
            format!("\"{}\"", field.replace('"', "\"\""))
        } else {
            field.to_owned()
        }
    };
    fields.into_iter().map(|field| quoted(field.as_ref())).collect::<Vec<_>>().join(",") + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_would_break_a_line_is_quoted() {
        assert_eq!(line(["a", "b,c", "d \"e\"", ""]), "a,\"b,c\",\"d \"\"e\"\"\",\n");
    }
}
