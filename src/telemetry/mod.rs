//! What the service tells about itself: logs, metrics, traces. The one place that installs global state: the log
//! subscriber, the panic hook and the metrics recorder.

mod context;
mod error;
mod export;
mod logs;
mod metrics;
mod names;
mod otlp;
mod process;
mod recorder;
mod scope;

pub use context::TraceContext;
pub use error::TelemetryError;
pub use export::{Exporter, Tracer};
pub use logs::{check_logs, init_logs};
pub use metrics::{Kind, Label, Metric};
pub use names::*;
pub use recorder::{Recorder, recorder};
pub use scope::{Closing, Origin, Scope, SpanKind, Value};
