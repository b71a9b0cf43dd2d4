//! Where the time of an answer went, for `Server-Timing`: entries that follow one another, and add up to the time from the
//! request's arrival to the head of its answer.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use axum::http::header::HeaderName;
use axum::response::Response;

use super::delivery;
use crate::pipeline::Report;
use crate::telemetry::TraceSpan;

/// The header.
pub(super) const SERVER_TIMING: HeaderName = HeaderName::from_static("server-timing");

/// A clock that is looked at when something is over: all time since the last look belongs to what was.
#[derive(Debug, Clone)]
pub(super) struct Timing {
    last: Instant,
    /// Names and milliseconds, in order.
    entries: Vec<(String, f64)>,
}

impl Timing {
    /// Starts with the request's handler.
    pub(super) fn start() -> Self {
        Self { last: Instant::now(), entries: Vec::new() }
    }

    /// `name` is over. It is a part of the request's span too.
    pub(super) fn lap(&mut self, name: &'static str) {
        let (begun, time) = self.look();
        if let Some(span) = TraceSpan::current() {
            span.part(name, begun, time);
        }
        self.add(name, ms(time));
    }

    /// The answer's head is ready. What it takes to write the rest is a span of its own.
    pub(super) fn head(&mut self) {
        let (_, time) = self.look();
        self.add("encode", ms(time));
    }

    /// A job of this request is over: its stages took the time, by their own clock.
    pub(super) fn job(&mut self, report: &Report) {
        self.look();
        for (name, ms) in &report.timings_ms {
            self.add(name, ms.as_f64().unwrap_or_default());
        }
    }

    fn look(&mut self) -> (Instant, Duration) {
        let begun = std::mem::replace(&mut self.last, Instant::now());
        (begun, self.last.saturating_duration_since(begun))
    }

    fn add(&mut self, name: &str, ms: f64) {
        match self.entries.iter_mut().find(|(other, _)| other == name) {
            Some((_, sum)) => *sum += ms,
            None => self.entries.push((name.to_owned(), ms)),
        }
    }

    /// The header's value for an answer whose head took `total`: what no entry accounts for is `other`.
    fn value(&self, total: Duration) -> String {
        let mut text = String::new();
        let (mut sum, mut total) = (0.0, microseconds(ms(total)));
        for (name, ms) in &self.entries {
            let us = microseconds(*ms);
            sum += us;
            // Writing to a string does not fail.
            _ = write!(text, "{name};dur={:.3}, ", us / 1e3);
        }
        // Parts that were rounded up may be a little more than the whole.
        if sum > total && sum - total <= self.entries.len() as f64 {
            total = sum;
        }
        _ = write!(text, "other;dur={:.3}, {}", (total - sum).max(0.0) / 1e3, total_entry(total));
        text
    }
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// Whole microseconds, as they are written: so that what is written adds up.
fn microseconds(ms: f64) -> f64 {
    (ms * 1e3).round()
}

fn total_entry(microseconds: f64) -> String {
    format!("total;dur={:.3}", microseconds / 1e3)
}

/// Writes the header of an answer whose head took `total` and that says, or may say, where time went.
pub(super) fn tell(response: &mut Response, total: Duration) {
    let value = match response.extensions_mut().remove::<Timing>() {
        Some(timing) => timing.value(total),
        None => match response.headers().get(&SERVER_TIMING).and_then(|value| value.to_str().ok()) {
            Some(known) => format!("{known}, {}", total_entry(microseconds(ms(total)))),
            None => return,
        },
    };
    response.headers_mut().insert(SERVER_TIMING, delivery::text(&value));
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn sums(value: &str) -> (f64, f64) {
        let entries = value.split(", ").map(|entry| entry.split_once(";dur=").unwrap());
        let (total, parts): (Vec<_>, Vec<_>) = entries.partition(|(name, _)| *name == "total");
        let sum = |list: Vec<(&str, &str)>| list.iter().map(|(_, ms)| ms.parse::<f64>().unwrap()).sum();
        (sum(parts), sum(total))
    }

    #[test]
    fn entries_add_up_to_the_total() {
        let start = Instant::now();
        let mut timing = Timing::start();
        for name in ["receive", "lookup", "receive"] {
            std::thread::sleep(Duration::from_millis(2));
            timing.lap(name);
        }
        timing.head();
        let value = timing.value(start.elapsed());
        let (parts, total) = sums(&value);
        assert!((parts - total).abs() < 1e-6 && total >= 6.0, "{value}");
        assert_eq!(value.matches("receive").count(), 1);
        // The control: without an entry they do not.
        let without = value.split(", ").filter(|entry| !entry.starts_with("receive")).collect::<Vec<_>>().join(", ");
        assert!(sums(&without).0 < total * 0.95, "{without}");
    }

    #[test]
    fn parts_that_were_rounded_up_add_up_as_well() {
        let mut timing = Timing::start();
        for name in ["receive", "lookup", "encode"] {
            timing.add(name, 0.0006);
        }
        assert_eq!(
            timing.value(Duration::from_nanos(1800)),
            "receive;dur=0.001, lookup;dur=0.001, encode;dur=0.001, other;dur=0.000, total;dur=0.003"
        );
        // More than rounding is no reason to say that it took longer.
        timing.add("mesh", 1.0);
        assert!(timing.value(Duration::from_nanos(1800)).ends_with("other;dur=0.000, total;dur=0.002"));
    }

    #[test]
    fn answers_that_were_made_before_say_so_and_how_long_it_took() {
        let mut response = Response::new(axum::body::Body::empty());
        tell(&mut response, Duration::from_millis(1));
        assert!(response.headers().is_empty());
        response.headers_mut().insert(SERVER_TIMING, HeaderValue::from_static("cache;desc=hit"));
        tell(&mut response, Duration::from_micros(1500));
        assert_eq!(response.headers()[&SERVER_TIMING], "cache;desc=hit, total;dur=1.500");
    }
}
