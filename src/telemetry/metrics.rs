//! What a metric is: name, kind, labels with what bounds them, and the sentence that is its documentation and its help text.

/// How a metric moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// It only rises, by whole numbers.
    Counter,
    /// It only rises, by fractions: seconds.
    Seconds,
    /// It rises and falls.
    Gauge,
    /// It counts values in buckets.
    Histogram,
}

impl Kind {
    /// Its name in the exposition format.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Counter | Self::Seconds => "counter",
            Self::Gauge => "gauge",
            Self::Histogram => "histogram",
        }
    }
}

/// A label: its name, and what bounds its values. A closed list is written as `a|b|c`, anything else in words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Label {
    /// Its name.
    pub name: &'static str,
    /// Its values, or what bounds them.
    pub values: &'static str,
}

impl Label {
    /// The values, where they are a closed list.
    #[must_use]
    pub fn closed(&self) -> Option<impl Iterator<Item = &'static str>> {
        (!self.values.contains(' ')).then(|| self.values.split('|'))
    }
}

/// A metric as it is described to people and to Prometheus.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Metric {
    /// Its name: prefix `molmesh_` but for those that are named alike everywhere, base units, `_total` on counters.
    pub name: &'static str,
    /// How it moves.
    pub kind: Kind,
    /// Its labels. Ids are never among them.
    pub labels: &'static [Label],
    help: &'static [&'static str],
}

impl Metric {
    pub(super) const fn new(
        name: &'static str,
        kind: Kind,
        labels: &'static [Label],
        help: &'static [&'static str],
    ) -> Self {
        Self { name, kind, labels, help }
    }

    /// What it says, in a sentence or two.
    #[must_use]
    pub fn help(&self) -> String {
        self.help.iter().map(|line| line.trim()).collect::<Vec<_>>().join(" ")
    }
}
