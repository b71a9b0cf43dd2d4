//! `Server-Timing`: consecutive phases of a request, which add up to the time from its arrival to the head of the
//! response.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use axum::http::HeaderValue;
use axum::http::header::HeaderName;
use axum::response::Response;

use crate::pipeline::Report;
use crate::telemetry::TraceSpan;

/// `Server-Timing`.
pub(super) const SERVER_TIMING: HeaderName = HeaderName::from_static("server-timing");

/// Phases of a request. Each call of [`Self::lap`] ends a phase that began with the call before.
#[derive(Debug, Clone)]
pub(super) struct Timing {
    last: Instant,
    /// Names and durations in ms, in order.
    entries: Vec<(String, f64)>,
}

impl Timing {
    /// Starts the first phase.
    pub(super) fn start() -> Self {
        Self { last: Instant::now(), entries: Vec::new() }
    }

    /// Ends phase `name`, which is also part of the request's span.
    pub(super) fn lap(&mut self, name: &'static str) {
        let (begun, time) = self.restart();
        if let Some(span) = TraceSpan::current() {
            span.part(name, begun, time);
        }
        self.add(name, ms(time));
    }

    /// Ends the last phase: the head of the response is ready. Writing the body has a span of its own.
    pub(super) fn head(&mut self) {
        let (_, time) = self.restart();
        self.add("encode", ms(time));
    }

    /// Replaces the phase of a finished job by the stages in its report.
    pub(super) fn job(&mut self, report: &Report) {
        self.restart();
        for (name, ms) in &report.timings_ms {
            self.add(name, ms.as_f64().unwrap_or_default());
        }
    }

    fn restart(&mut self) -> (Instant, Duration) {
        let begun = std::mem::replace(&mut self.last, Instant::now());
        (begun, self.last.saturating_duration_since(begun))
    }

    fn add(&mut self, name: &str, ms: f64) {
        match self.entries.iter_mut().find(|(other, _)| other == name) {
            Some((_, sum)) => *sum += ms,
            None => self.entries.push((name.to_owned(), ms)),
        }
    }

    /// Returns the value of the header for a head that took `total`; `other` is the remainder.
    fn value(&self, total: Duration) -> String {
        let mut text = String::new();
        let (mut sum, mut total) = (0.0, microseconds(ms(total)));
        for (name, ms) in &self.entries {
            let us = microseconds(*ms);
            sum += us;
            // Writing to a string never fails.
            _ = write!(text, "{name};dur={:.3}, ", us / 1e3);
        }
        // Rounded phases may exceed the total slightly.
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

/// Rounds to whole microseconds, so that the written values add up.
fn microseconds(ms: f64) -> f64 {
    (ms * 1e3).round()
}

fn total_entry(microseconds: f64) -> String {
    format!("total;dur={:.3}", microseconds / 1e3)
}

/// Writes the header of a response that has phases or a stored `Server-Timing`; its head took `total`.
pub(super) fn write_header(response: &mut Response, total: Duration) {
    let value = match response.extensions_mut().remove::<Timing>() {
        Some(timing) => timing.value(total),
        None => match response.headers().get(&SERVER_TIMING).and_then(|value| value.to_str().ok()) {
            Some(known) => format!("{known}, {}", total_entry(microseconds(ms(total)))),
            None => return,
        },
    };
    if let Ok(value) = HeaderValue::try_from(value) {
        response.headers_mut().insert(SERVER_TIMING, value);
    }
}

#[cfg(test)]
mod tests {
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
        // Control: without one entry they do not add up.
        let without = value.split(", ").filter(|entry| !entry.starts_with("receive")).collect::<Vec<_>>().join(", ");
        assert!(sums(&without).0 < total * 0.95, "{without}");
    }

    #[test]
    fn rounded_entries_add_up() {
        let mut timing = Timing::start();
        for name in ["receive", "lookup", "encode"] {
            timing.add(name, 0.0006);
        }
        assert_eq!(
            timing.value(Duration::from_nanos(1800)),
            "receive;dur=0.001, lookup;dur=0.001, encode;dur=0.001, other;dur=0.000, total;dur=0.003"
        );
        // A larger excess does not change the total.
        timing.add("mesh", 1.0);
        assert!(timing.value(Duration::from_nanos(1800)).ends_with("other;dur=0.000, total;dur=0.002"));
    }

    #[test]
    fn stored_results_have_a_cache_entry_and_a_total() {
        let mut response = Response::new(axum::body::Body::empty());
        write_header(&mut response, Duration::from_millis(1));
        assert!(response.headers().is_empty());
        response.headers_mut().insert(SERVER_TIMING, HeaderValue::from_static("cache;desc=hit"));
        write_header(&mut response, Duration::from_micros(1500));
        assert_eq!(response.headers()[&SERVER_TIMING], "cache;desc=hit, total;dur=1.500");
    }
}
