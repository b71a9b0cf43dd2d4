//! Description of a metric: name, kind, labels and help text.

/// Kind of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MetricKind {
    /// Counter of integers.
    Counter,
    /// Counter of seconds, with fractions.
    Seconds,
    /// Value that rises and falls.
    Gauge,
    /// Counts of values by bucket.
    Histogram,
}

impl MetricKind {
    /// Returns the name of the kind in the exposition format.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Counter | Self::Seconds => "counter",
            Self::Gauge => "gauge",
            Self::Histogram => "histogram",
        }
    }
}

/// Label of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Label {
    /// Name.
    pub name: &'static str,
    /// Allowed values: a closed list such as `a|b|c`, or a description.
    pub values: &'static str,
}

impl Label {
    /// Returns the values if they are a closed list.
    #[must_use]
    pub fn closed(&self) -> Option<impl Iterator<Item = &'static str>> {
        (!self.values.contains(' ')).then(|| self.values.split('|'))
    }
}

/// Description of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Metric {
    /// Name with the base unit, and `_total` for counters. The prefix is `molmesh_`, except for names that are
    /// standard.
    pub name: &'static str,
    /// Kind.
    pub kind: MetricKind,
    /// Labels. Ids are never labels.
    pub labels: &'static [Label],
    /// Help text.
    pub help: &'static str,
}
