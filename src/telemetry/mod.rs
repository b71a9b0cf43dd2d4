//! Logs, metrics and traces of the service. The only module that installs global state: the log subscriber, the panic
//! hook and the metrics recorder.

mod error;
mod logs;
mod metrics;
mod names;
mod process;
mod recorder;
mod shorten;
mod span;
mod traces;

pub use error::TelemetryError;
pub use logs::{check_logs, init_logs};
pub use metrics::{Label, Metric, MetricKind};
pub use names::*;
pub(crate) use opentelemetry::trace::{SpanContext, SpanKind};
pub use recorder::{Recorder, recorder};
pub(crate) use shorten::shorten;
pub(crate) use span::{SpanParent, TraceSpan, read_trace_context, traceparent, tracestate};
pub(crate) use traces::{Tracer, Traces};
