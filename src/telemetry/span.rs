//! Trace spans of the OpenTelemetry SDK, with the request id that log lines contain.

use std::borrow::Cow;
use std::collections::HashMap;
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use opentelemetry::propagation::TextMapPropagator as _;
use opentelemetry::trace::{
    Span as _, SpanContext, SpanKind, SpanRef, Status, TraceContextExt as _, TraceFlags, TraceId, Tracer as _,
};
use opentelemetry::{Context, KeyValue, Value};
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::trace::Span;

use super::{Tracer, shorten};

/// Request and parent span of some work. Outlives the span.
#[derive(Debug, Clone, Default)]
pub(crate) struct SpanParent {
    /// Id of the request.
    pub(crate) request: Option<Arc<str>>,
    /// Parent of the spans of this work. Without one, the first span starts a trace.
    pub(crate) context: Option<SpanContext>,
    /// Tracer of the service that does the work.
    pub(crate) tracer: Tracer,
}

impl SpanParent {
    /// Returns the parent for work that the current task starts; the default outside [`TraceSpan::run`].
    pub(crate) fn current() -> Self {
        TraceSpan::current().map(|span| span.as_parent()).unwrap_or_default()
    }

    /// Returns the log span of a job: its lines name the request, the trace and the job (shortened).
    pub(crate) fn log_span(&self, job: Option<&str>) -> tracing::Span {
        use tracing::field::{Empty, display};
        let span = tracing::info_span!("job", request_id = Empty, trace_id = Empty, job_id = Empty);
        for (field, id) in [("request_id", self.request.as_deref()), ("job_id", job.map(shorten).as_deref())] {
            if let Some(id) = id {
                span.record(field, display(id));
            }
        }
        if let Some(context) = &self.context {
            span.record("trace_id", display(context.trace_id()));
        }
        span
    }

    fn start(&self, name: Cow<'static, str>, kind: SpanKind, start: SystemTime) -> Span {
        let parent = self.context.clone().map(|context| Context::new().with_remote_span_context(context));
        let tracer = &self.tracer.0;
        let builder = tracer.span_builder(name).with_kind(kind).with_start_time(start);
        tracer.build_with_context(builder, &parent.unwrap_or_default())
    }
}

/// Open span. Clones refer to the same span, which ends with [`TraceSpan::end`] or when the last clone is dropped.
#[derive(Debug, Clone)]
pub(crate) struct TraceSpan(Arc<SpanState>);

#[derive(Debug)]
struct SpanState {
    request: Option<Arc<str>>,
    tracer: Tracer,
    /// Holds the SDK's span.
    context: Context,
    start: Instant,
    /// Wall-clock time of `start`. All times of this span and its parts are offsets from it, so that they nest even if
    /// the wall clock is adjusted meanwhile.
    start_time: SystemTime,
}

tokio::task_local! {
    static CURRENT: TraceSpan;
}

impl TraceSpan {
    /// Starts a span below `parent` that began at `start`. The parent decides whether it is recorded; without a parent
    /// the sampling ratio does.
    pub(crate) fn start(
        parent: &SpanParent,
        name: impl Into<Cow<'static, str>>,
        kind: SpanKind,
        start: Instant,
    ) -> Self {
        let start_time = SystemTime::now().checked_sub(start.elapsed()).unwrap_or(SystemTime::UNIX_EPOCH);
        let context = Context::new().with_span(parent.start(name.into(), kind, start_time));
        let SpanParent { request, tracer, .. } = parent.clone();
        Self(Arc::new(SpanState { request, tracer, context, start, start_time }))
    }

    /// Returns the span that the current task runs in.
    pub(crate) fn current() -> Option<Self> {
        CURRENT.try_with(Self::clone).ok()
    }

    /// Runs `work` with this span as the current one.
    pub(crate) async fn run<F: Future>(self, work: F) -> F::Output {
        CURRENT.scope(self, work).await
    }

    /// Returns this span as the parent of others.
    pub(crate) fn as_parent(&self) -> SpanParent {
        let SpanState { request, tracer, .. } = &*self.0;
        SpanParent { request: request.clone(), context: Some(self.context()), tracer: tracer.clone() }
    }

    /// Returns trace id, span id, flags and `tracestate`.
    pub(crate) fn context(&self) -> SpanContext {
        self.span().span_context().clone()
    }

    /// Returns the id of the trace, which is shown as 32 hexadecimal digits.
    pub(crate) fn trace_id(&self) -> TraceId {
        self.span().span_context().trace_id()
    }

    /// Returns the id of the request; empty if there is none.
    pub(crate) fn request(&self) -> &str {
        self.0.request.as_deref().unwrap_or_default()
    }

    /// Returns true if attributes of this span are recorded.
    pub(crate) fn is_recording(&self) -> bool {
        self.span().is_recording()
    }

    /// Links this span to another one, which may belong to another trace.
    pub(crate) fn link(&self, other: SpanContext) {
        self.span().add_link(other, Vec::new());
    }

    /// Sets an attribute.
    pub(crate) fn set(&self, key: &'static str, value: impl Into<Value>) {
        self.span().set_attribute(KeyValue::new(key, value));
    }

    /// Marks the span as failed.
    pub(crate) fn fail(&self, message: impl Into<Cow<'static, str>>) {
        self.span().set_status(Status::error(message));
    }

    /// Records a finished part of this span as a child of it, even after this span has ended.
    pub(crate) fn part(&self, name: &'static str, start: Instant, duration: Duration) {
        if self.span().span_context().is_sampled() {
            let start = self.wall_clock(start);
            self.as_parent().start(name.into(), SpanKind::Internal, start).end_with_timestamp(start + duration);
        }
    }

    /// Ends the span now. Later changes have no effect.
    pub(crate) fn end(&self) {
        self.span().end_with_timestamp(self.0.start_time + self.0.start.elapsed());
    }

    fn span(&self) -> SpanRef<'_> {
        self.0.context.span()
    }

    /// Converts `time`, which may lie before the start of the span: a request can join a job that already runs.
    fn wall_clock(&self, time: Instant) -> SystemTime {
        let SpanState { start, start_time, .. } = &*self.0;
        match time.checked_duration_since(*start) {
            Some(after) => *start_time + after,
            None => start_time.checked_sub(start.saturating_duration_since(time)).unwrap_or(*start_time),
        }
    }
}

/// Reads `traceparent` and `tracestate` of W3C Trace Context. Returns `None` for an invalid `traceparent` and ignores
/// an invalid `tracestate`.
pub(crate) fn read_trace_context(traceparent: &str, tracestate: &str) -> Option<SpanContext> {
    let headers = [("traceparent", traceparent), ("tracestate", tracestate)];
    let headers: HashMap<String, String> = headers.map(|(name, value)| (name.to_owned(), value.to_owned())).into();
    let context = TraceContextPropagator::new().extract_with_context(&Context::new(), &headers);
    Some(context.span().span_context().clone()).filter(SpanContext::is_valid)
}

/// Formats the value of `traceparent`.
pub(crate) fn traceparent(context: &SpanContext) -> String {
    let flags = context.trace_flags() & TraceFlags::SAMPLED;
    format!("00-{}-{}-{flags:02x}", context.trace_id(), context.span_id())
}

/// Formats the value of `tracestate`, unless it is empty.
pub(crate) fn tracestate(context: &SpanContext) -> Option<String> {
    Some(context.trace_state().header()).filter(|state| !state.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    const TRACEPARENT: &str = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01";

    #[test]
    fn trace_contexts_are_read_and_written() {
        let context = read_trace_context(TRACEPARENT, "rojo=1, congo=2").unwrap();
        assert_eq!(traceparent(&context), TRACEPARENT);
        assert_eq!(tracestate(&context).as_deref(), Some("rojo=1,congo=2"));
        // Undefined flags are not passed on; later versions may append fields.
        let flags = read_trace_context(&TRACEPARENT.replace("-01", "-ff"), "").unwrap();
        assert_eq!((traceparent(&flags).as_str(), tracestate(&flags)), (TRACEPARENT, None));
        assert!(read_trace_context(&format!("01{}-more", &TRACEPARENT[2..]), "").is_some());
        // An invalid tracestate is ignored as a whole.
        assert_eq!(tracestate(&read_trace_context(TRACEPARENT, "a=1,B=2").unwrap()), None);
        for invalid in [
            "",
            "00",
            "ff-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01-x",
            "00-0AF7651916CD43DD8448EB211C80319C-b7ad6b7169203331-01",
            "00-00000000000000000000000000000000-b7ad6b7169203331-01",
            "00-0af7651916cd43dd8448eb211c80319c-0000000000000000-01",
            "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-0g",
            "0x-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            &format!("{TRACEPARENT},{TRACEPARENT}"),
        ] {
            assert_eq!(read_trace_context(invalid, "a=b"), None, "{invalid}");
        }
    }

    #[test]
    fn children_belong_to_the_trace_of_their_parent() {
        let context = read_trace_context(TRACEPARENT, "a=1");
        let parent = SpanParent { context: context.clone(), ..SpanParent::default() };
        let child = TraceSpan::start(&parent, "child", SpanKind::Internal, Instant::now());
        let (of_child, of_parent) = (child.context(), context.unwrap());
        assert_eq!(of_child.trace_id(), of_parent.trace_id());
        assert_ne!(of_child.span_id(), of_parent.span_id());
        assert!(of_child.is_sampled() && tracestate(&of_child).as_deref() == Some("a=1"));
        // Without a collector, new traces are not sampled, and each has an id of its own.
        let root = || TraceSpan::start(&SpanParent::default(), "root", SpanKind::Internal, Instant::now());
        assert!(root().context().is_valid() && !root().context().is_sampled());
        assert_ne!(root().trace_id(), root().trace_id());
    }
}
