//! Parser of the Prometheus format; a backend that changes the metrics of devices.
#![allow(dead_code, reason = "each test binary uses a part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

pub(crate) mod queries;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use molmesh::surface::{Backend, BackendIdentity, BackendJob, DeviceStatus, MeshOutput, SurfaceError};
use molmesh::telemetry::{Metric, MetricKind};

use crate::http_support::{Fake, Mode};

/// Sample: name, labels as text, value.
#[derive(Debug, Clone)]
pub(crate) struct Sample {
    pub(crate) name: String,
    pub(crate) labels: BTreeMap<String, String>,
    text: String,
    pub(crate) value: f64,
}

/// Metrics at one time.
#[derive(Debug, Clone, Default)]
pub(crate) struct Scrape {
    pub(crate) samples: Vec<Sample>,
    pub(crate) kinds: BTreeMap<String, String>,
    pub(crate) helps: BTreeSet<String>,
}

impl Scrape {
    pub(crate) fn of(text: &str) -> Self {
        let mut scrape = Self::default();
        for line in text.lines().filter(|line| !line.is_empty()) {
            if let Some(rest) = line.strip_prefix("# TYPE ") {
                let (name, kind) = rest.split_once(' ').unwrap();
                scrape.kinds.insert(name.to_owned(), kind.to_owned());
            } else if let Some(rest) = line.strip_prefix("# HELP ") {
                scrape.helps.insert(rest.split(' ').next().unwrap().to_owned());
            } else {
                let (series, value) = line.rsplit_once(' ').unwrap();
                let (name, labels) = series.split_once('{').unwrap_or((series, ""));
                let text = labels.trim_end_matches('}').to_owned();
                scrape.samples.push(Sample {
                    name: name.to_owned(),
                    labels: labels_of(&text),
                    text,
                    value: value.parse().unwrap(),
                });
            }
        }
        scrape
    }

    /// Returns the samples of a metric whose labels contain all of `labels`; for histograms, the counts.
    fn of_metric<'a>(&'a self, name: &str, labels: &'a [&str]) -> impl Iterator<Item = &'a Sample> {
        let count = format!("{name}_count");
        let name = name.to_owned();
        self.samples.iter().filter(move |sample| {
            (sample.name == name || sample.name == count) && labels.iter().all(|label| sample.text.contains(label))
        })
    }

    /// Returns the sum of the values of matching samples.
    pub(crate) fn moves(&self, name: &str, labels: &[&str]) -> f64 {
        self.of_metric(name, labels).map(|sample| sample.value).sum()
    }

    /// Returns the label sets of a metric.
    pub(crate) fn series(&self, name: &str) -> BTreeSet<String> {
        self.of_metric(name, &[]).map(|sample| sample.text.clone()).collect()
    }
}

fn labels_of(text: &str) -> BTreeMap<String, String> {
    // Label values of the product contain neither quotes nor commas.
    let pairs = text.split("\",").filter(|pair| !pair.is_empty());
    pairs
        .map(|pair| pair.split_once("=\"").unwrap())
        .map(|(n, v)| (n.to_owned(), v.trim_end_matches('"').to_owned()))
        .collect()
}

/// Returns the differences between exposed metrics and their descriptions.
pub(crate) fn check(scrape: &Scrape, metrics: &[Metric]) -> Vec<String> {
    let mut faults = Vec::new();
    for Sample { name, labels, .. } in &scrape.samples {
        let base = ["_bucket", "_sum", "_count"].iter().find_map(|suffix| {
            let base = name.strip_suffix(suffix)?;
            metrics.iter().find(|m| m.name == base && m.kind == MetricKind::Histogram)
        });
        let Some(metric) = base.or_else(|| metrics.iter().find(|m| m.name == name && m.kind != MetricKind::Histogram))
        else {
            faults.push(format!("{name} is not described"));
            continue;
        };
        let mut expected: BTreeSet<&str> = metric.labels.iter().map(|label| label.name).collect();
        if name.ends_with("_bucket") {
            expected.insert("le");
        }
        let found: BTreeSet<&str> = labels.keys().map(String::as_str).collect();
        if found != expected {
            faults.push(format!("{name} has the labels {found:?}, not {expected:?}"));
        }
        for label in metric.labels {
            let (Some(mut values), Some(value)) = (label.closed(), labels.get(label.name)) else { continue };
            if !values.any(|known| known == value) {
                faults.push(format!("{name}: {} is {value}, which is not among {}", label.name, label.values));
            }
        }
        match scrape.kinds.get(metric.name) {
            Some(kind) if kind == metric.kind.name() => {}
            kind => faults.push(format!("{}: its kind is {kind:?}", metric.name)),
        }
        if !scrape.helps.contains(metric.name) {
            faults.push(format!("{} has no help", metric.name));
        }
    }
    faults
}

/// Backend with a device whose metrics are all nonzero and that uses a fallback.
pub(crate) struct Devices(Arc<Fake>);

impl Devices {
    pub(crate) fn new() -> Arc<Self> {
        Arc::new(Self(Fake::new(Mode::Octahedra)))
    }
}

impl Backend for Devices {
    fn name(&self) -> &'static str {
        "gpu"
    }

    fn describe(&self) -> String {
        "a device".to_owned()
    }

    fn write(&self, job: &BackendJob<'_>) -> Result<MeshOutput, SurfaceError> {
        let fallback_reason = Some("fallback of a test".to_owned());
        let (arithmetic, device) = ("cpu".to_owned(), "the processor".to_owned());
        let made_by = Some(BackendIdentity { backend: "cpu", arithmetic, device, fallback_reason });
        Ok(MeshOutput { made_by, ..self.0.write(job)? })
    }

    fn devices(&self) -> Vec<DeviceStatus> {
        vec![DeviceStatus {
            number: 0,
            name: "card 0".to_owned(),
            down: None,
            waiting: 7,
            busy: Duration::from_millis(2500),
            finished: 11,
            failed: 2,
            lost: 5,
            hung: 5,
            rebuilds: 3,
            shared: 4,
            partitions: 3,
            held_bytes: 1 << 20,
        }]
    }
}
