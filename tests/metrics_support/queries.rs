//! Checks that dashboards and alerts query existing metrics.

use std::path::{Path, PathBuf};

use molmesh::telemetry::METRICS;

use super::Scrape;
use crate::tools::{Queries, Selector};

/// Files with queries.
pub(crate) const FILES: [&str; 2] = ["deploy/grafana.json", "deploy/alerts.yaml"];
/// Labels that Prometheus adds to every scraped sample.
const ADDED: [&str; 2] = ["job", "instance"];
/// Metrics that Prometheus generates.
const MADE: [&str; 1] = ["up"];

pub(crate) fn path(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(file)
}

/// Returns the faults of a file's queries: syntax errors and selectors without a match in `scrape`.
pub(crate) fn faults(queries: &Queries, scrape: &Scrape) -> Vec<String> {
    let mut faults: Vec<String> = queries.error.iter().cloned().collect();
    if queries.error.is_none() && queries.expressions.is_empty() {
        faults.push("no queries".to_owned());
    }
    for expression in &queries.expressions {
        let place = &expression.place;
        faults.extend(expression.error.iter().map(|error| format!("{place}: {error}")));
        for selector in &expression.selectors {
            faults.extend(of_selector(selector, scrape).map(|fault| format!("{place}: {fault}")));
        }
    }
    faults
}

fn of_selector(selector: &Selector, scrape: &Scrape) -> Option<String> {
    let Some(metric) = &selector.metric else { return Some("a selector without a name".to_owned()) };
    let sample = scrape.samples.iter().find(|sample| sample.name == *metric);
    let labels: Vec<&str> = match sample {
        Some(sample) => sample.labels.keys().map(String::as_str).chain(ADDED).collect(),
        None if MADE.contains(&metric.as_str()) => ADDED.to_vec(),
        None => return Some(format!("{metric} is not exposed")),
    };
    let named = selector.matchers.iter().map(|(label, ..)| label).chain(&selector.around);
    if let Some(label) = named.into_iter().find(|label| !labels.contains(&label.as_str())) {
        return Some(format!("{metric} has no label {label}"));
    }
    let base = METRICS.iter().find(|m| metric.starts_with(m.name) && sample.is_some())?;
    selector.matchers.iter().filter(|(.., regex)| !regex).find_map(|(label, value, _)| {
        let mut values = base.labels.iter().find(|known| known.name == label)?.closed()?;
        (!values.any(|known| known == value)).then(|| format!("{metric}: {label} is never {value}"))
    })
}

/// Returns the metrics in a file's queries; histograms by their base name.
pub(crate) fn metrics(queries: &Queries) -> Vec<&'static str> {
    let selectors = queries.expressions.iter().flat_map(|expression| &expression.selectors);
    let names = selectors.filter_map(|selector| selector.metric.as_deref());
    let base = |name: &str| {
        let of_histogram = ["_bucket", "_sum", "_count"].iter().find_map(|suffix| name.strip_suffix(suffix));
        METRICS.iter().map(|m| m.name).find(|known| *known == name || Some(*known) == of_histogram)
    };
    names.filter_map(base).collect()
}
