//! A span that is open: who asked, where in which trace, since when. Finished spans go to the [`Tracer`], with the times that
//! somebody measured: stages are told after they ran.

use std::borrow::Cow;
use std::fmt;
use std::future::Future;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use super::{TraceContext, Tracer};

/// Links of a span at most, as OpenTelemetry limits them.
const MAX_LINKS: usize = 128;

/// Where something comes from: the request that asked for it and the span that it belongs under. Outlives both.
#[derive(Debug, Clone, Default)]
pub struct Origin {
    /// The request's id.
    pub request: Option<Arc<str>>,
    /// The span that it belongs under; none: it begins a trace.
    pub context: Option<TraceContext>,
    /// Where its spans go.
    pub tracer: Tracer,
}

/// What a span is to the one above it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpanKind {
    /// A part of the work.
    Internal,
    /// A request that is answered here.
    Server,
    /// A request that is asked of somebody.
    Client,
    /// Work that was promised to somebody who does not wait for it.
    Consumer,
}

/// The value of an attribute.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Text.
    Text(Cow<'static, str>),
    /// A whole number.
    Number(i64),
    /// Yes or no.
    Flag(bool),
}

impl From<&'static str> for Value {
    fn from(text: &'static str) -> Self {
        Self::Text(text.into())
    }
}

impl From<String> for Value {
    fn from(text: String) -> Self {
        Self::Text(text.into())
    }
}

impl From<u64> for Value {
    fn from(number: u64) -> Self {
        Self::Number(i64::try_from(number).unwrap_or(i64::MAX))
    }
}

/// What is known of a span once it is over.
#[derive(Debug)]
pub struct Closing {
    /// Its name: one of few.
    pub name: Cow<'static, str>,
    /// What it is to the one above.
    pub kind: SpanKind,
    /// What is to be known of it.
    pub attributes: Vec<(&'static str, Value)>,
    /// Why it failed, if it did.
    pub error: Option<String>,
}

impl Closing {
    /// A part of the work that went well.
    #[must_use]
    pub fn of(name: &'static str) -> Self {
        Self { name: name.into(), kind: SpanKind::Internal, attributes: Vec::new(), error: None }
    }
}

/// A span that is over.
#[derive(Debug)]
pub(super) struct Finished {
    pub(super) context: TraceContext,
    pub(super) parent: Option<u64>,
    pub(super) start: SystemTime,
    pub(super) end: SystemTime,
    pub(super) closing: Closing,
    pub(super) links: Vec<TraceContext>,
}

/// A span that is open. Clones are the same one.
#[derive(Debug, Clone)]
pub struct Scope(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    request: Option<Arc<str>>,
    context: TraceContext,
    parent: Option<u64>,
    tracer: Tracer,
    begun: Instant,
    /// The same moment by the clock that people read. Spans below are placed by their distance from it, so that a clock that is
    /// put right meanwhile cannot tear them apart.
    at: SystemTime,
    links: Mutex<Vec<TraceContext>>,
}

tokio::task_local! {
    static CURRENT: Scope;
}

impl Scope {
    /// Opens a span under `origin` that began at `begun`. Whether it is recorded is decided above, or here where nobody is.
    #[must_use]
    pub fn open(origin: &Origin, begun: Instant) -> Self {
        let tracer = origin.tracer.clone();
        let context =
            origin.context.as_ref().map_or_else(|| TraceContext::root(|id| tracer.samples(id)), TraceContext::child);
        Self(Arc::new(Inner {
            request: origin.request.clone(),
            parent: origin.context.as_ref().map(TraceContext::span),
            context,
            tracer,
            begun,
            at: SystemTime::now().checked_sub(begun.elapsed()).unwrap_or(SystemTime::UNIX_EPOCH),
            links: Mutex::default(),
        }))
    }

    /// The span in which this task runs.
    #[must_use]
    pub fn current() -> Option<Self> {
        CURRENT.try_with(Self::clone).ok()
    }

    /// Where what is done now comes from.
    #[must_use]
    pub fn current_origin() -> Origin {
        Self::current().map(|scope| scope.origin()).unwrap_or_default()
    }

    /// Runs `work` in this span.
    pub async fn run<F: Future>(self, work: F) -> F::Output {
        CURRENT.scope(self, work).await
    }

    /// What comes from this span.
    #[must_use]
    pub fn origin(&self) -> Origin {
        let Inner { request, context, tracer, .. } = &*self.0;
        Origin { request: request.clone(), context: Some(context.clone()), tracer: tracer.clone() }
    }

    /// Its place in the trace.
    #[must_use]
    pub fn context(&self) -> &TraceContext {
        &self.0.context
    }

    /// The id of the request that asked for it; empty if none did.
    #[must_use]
    pub fn request(&self) -> &str {
        self.0.request.as_deref().unwrap_or_default()
    }

    /// The trace's id as logs say it.
    #[must_use]
    pub fn trace_id(&self) -> TraceId {
        TraceId(self.0.context.trace())
    }

    /// Says that this span has to do with another one, of another trace perhaps.
    pub fn link(&self, other: &TraceContext) {
        let mut links = self.0.links.lock().unwrap_or_else(PoisonError::into_inner);
        if self.is_recorded() && links.len() < MAX_LINKS {
            links.push(other.clone());
        }
    }

    /// The span of the log in which this is done: its lines name request, trace and job.
    #[must_use]
    pub fn log(&self, job: Option<&str>) -> tracing::Span {
        use tracing::field::{Empty, display};
        let span = tracing::info_span!("job", request_id = Empty, trace_id = %self.trace_id(), job_id = Empty);
        for (field, id) in [("request_id", self.0.request.as_deref()), ("job_id", job)] {
            if let Some(id) = id {
                span.record(field, display(id));
            }
        }
        span
    }

    /// Whether what is told of this span goes anywhere.
    #[must_use]
    pub fn is_recorded(&self) -> bool {
        self.0.tracer.records(&self.0.context)
    }

    /// Tells of a part of this span that is over.
    pub fn part(&self, name: &'static str, begun: Instant, time: Duration) {
        if self.is_recorded() {
            let context = self.0.context.child();
            self.send(context, Some(self.0.context.span()), begun, time, Closing::of(name), Vec::new());
        }
    }

    /// This span is over. `closing` is asked only if somebody wants to know.
    pub fn close(&self, closing: impl FnOnce() -> Closing) {
        if self.is_recorded() {
            let links = std::mem::take(&mut *self.0.links.lock().unwrap_or_else(PoisonError::into_inner));
            let Inner { context, parent, begun, .. } = &*self.0;
            self.send(context.clone(), *parent, *begun, begun.elapsed(), closing(), links);
        }
    }

    fn send(
        &self,
        context: TraceContext,
        parent: Option<u64>,
        begun: Instant,
        time: Duration,
        closing: Closing,
        links: Vec<TraceContext>,
    ) {
        let Inner { begun: own, at, tracer, .. } = &*self.0;
        // What began before this span, such as work that it takes part in, lies before it.
        let start = match begun.checked_duration_since(*own) {
            Some(after) => *at + after,
            None => at.checked_sub(own.saturating_duration_since(begun)).unwrap_or(*at),
        };
        tracer.send(Finished { context, parent, start, end: start + time, closing, links });
    }
}

/// A trace's id, as everybody writes it: 32 hexadecimal digits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceId(u128);

impl fmt::Display for TraceId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}
