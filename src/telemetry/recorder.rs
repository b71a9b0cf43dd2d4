//! Metrics recorder and the text format of Prometheus.

use std::sync::OnceLock;

use metrics::Unit;
use metrics_exporter_prometheus::{Matcher, PrometheusBuilder, PrometheusHandle};

use super::metrics::{Metric, MetricKind};
use super::names::{
    ARCHIVE_FETCH, BUILD_INFO, HTTP_DURATION, HTTP_REQUEST_SIZE, HTTP_RESPONSE_SIZE, METRICS, STAGE_DURATION,
};
use super::{TelemetryError, process};

/// Buckets of durations, seconds: from a cached response to the deadline, about three per decade.
const SECONDS: [f64; 16] =
    [0.0005, 0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0];
/// Buckets of sizes, bytes: from a problem document to the largest mesh, in powers of four.
const BYTES: [f64; 12] = [
    0.0,
    1024.0,
    4096.0,
    16_384.0,
    65_536.0,
    262_144.0,
    1_048_576.0,
    4_194_304.0,
    16_777_216.0,
    67_108_864.0,
    268_435_456.0,
    1_073_741_824.0,
];

/// Metrics recorder of this process.
#[derive(Clone)]
pub struct Recorder(PrometheusHandle);

impl Recorder {
    /// Returns all metrics in the text format of Prometheus. Reads the process metrics with system calls.
    #[must_use]
    pub fn render(&self) -> String {
        process::publish();
        let text = self.0.render();
        // The recorder's counters are integers, so counters of seconds are recorded as gauges. Correct their type.
        METRICS.iter().filter(|metric| metric.kind == MetricKind::Seconds).fold(text, |text, metric| {
            let line = |kind: &str| format!("# TYPE {} {kind}\n", metric.name);
            text.replace(&line("gauge"), &line(metric.kind.name()))
        })
    }

    /// Drains the buffers of histograms. Call it every few seconds.
    pub fn run_upkeep(&self) {
        self.0.run_upkeep();
    }
}

/// Returns the recorder of this process. The first call installs it.
///
/// # Errors
/// Returns [`TelemetryError::Install`] if another recorder is installed.
pub fn recorder() -> Result<Recorder, TelemetryError> {
    static RECORDER: OnceLock<Result<Recorder, String>> = OnceLock::new();
    let installed = RECORDER.get_or_init(|| {
        let seconds = [HTTP_DURATION, STAGE_DURATION, ARCHIVE_FETCH].map(|name| (name, &SECONDS[..]));
        let bytes = [HTTP_REQUEST_SIZE, HTTP_RESPONSE_SIZE].map(|name| (name, &BYTES[..]));
        let handle = seconds
            .into_iter()
            .chain(bytes)
            .try_fold(PrometheusBuilder::new(), |builder, (name, buckets)| {
                builder.set_buckets_for_metric(Matcher::Full(name.to_owned()), buckets)
            })
            .and_then(PrometheusBuilder::install_recorder)
            .map_err(|e| e.to_string())?;
        METRICS.iter().for_each(describe);
        metrics::gauge!(BUILD_INFO, "version" => env!("CARGO_PKG_VERSION")).set(1.0);
        Ok(Recorder(handle))
    });
    installed.clone().map_err(|reason| TelemetryError::Install { what: "the metrics recorder", reason })
}

/// Sets the help text of a metric. If all its series are known, also sets their initial value: rates are only correct
/// if the first scrape contains a zero.
fn describe(metric: &Metric) {
    let (name, help) = (metric.name, metric.help);
    let unit = if name.contains("_seconds") {
        Unit::Seconds
    } else if name.contains("_bytes") {
        Unit::Bytes
    } else {
        Unit::Count
    };
    match metric.kind {
        MetricKind::Counter => metrics::describe_counter!(name, unit, help),
        MetricKind::Gauge | MetricKind::Seconds => metrics::describe_gauge!(name, unit, help),
        MetricKind::Histogram => metrics::describe_histogram!(name, unit, help),
    }
    let mut series: Vec<Vec<metrics::Label>> = vec![Vec::new()];
    for label in metric.labels {
        let Some(values) = label.closed() else { return };
        let values: Vec<&'static str> = values.collect();
        series = series
            .into_iter()
            .flat_map(|before| {
                let with = |value: &&'static str| {
                    let new = metrics::Label::from_static_parts(label.name, value);
                    [&before[..], &[new]].concat()
                };
                values.iter().map(with).collect::<Vec<_>>()
            })
            .collect();
    }
    for labels in series {
        match metric.kind {
            MetricKind::Counter => metrics::counter!(name, labels).increment(0),
            MetricKind::Gauge => metrics::gauge!(name, labels).set(0.0),
            // Empty histograms are not useful, and counters of seconds belong to existing devices and processes.
            MetricKind::Histogram | MetricKind::Seconds => {}
        }
    }
}
