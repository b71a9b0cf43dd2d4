//! Spans as OTLP writes them.

use std::time::{SystemTime, UNIX_EPOCH};

use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::common::v1::any_value::Value as Any;
use opentelemetry_proto::tonic::common::v1::{AnyValue, InstrumentationScope, KeyValue};
use opentelemetry_proto::tonic::resource::v1::Resource;
use opentelemetry_proto::tonic::trace::v1::span::{Link, SpanKind as Kind};
use opentelemetry_proto::tonic::trace::v1::status::StatusCode;
use opentelemetry_proto::tonic::trace::v1::{ResourceSpans, ScopeSpans, Span, Status};
use prost::Message as _;

use super::TraceContext;
use super::scope::{Closing, Finished, SpanKind, Value};

/// The flags that say whether the span above is another process's.
const HAS_IS_REMOTE: u32 = 0x100;
const IS_REMOTE: u32 = 0x200;

/// What is sent at once.
pub(super) struct Batch(ExportTraceServiceRequest);

impl Batch {
    /// The spans of `service`.
    pub(super) fn new(service: &str, spans: Vec<Finished>) -> Self {
        let version = env!("CARGO_PKG_VERSION");
        let of_service = [("service.name", service.to_owned()), ("service.version", version.to_owned())];
        let resource = Resource {
            attributes: of_service.into_iter().map(|(key, value)| pair(key, value.into())).collect(),
            ..Resource::default()
        };
        let scope = InstrumentationScope {
            name: env!("CARGO_PKG_NAME").to_owned(),
            version: version.to_owned(),
            ..InstrumentationScope::default()
        };
        let spans = spans.into_iter().map(span).collect();
        let spans = ScopeSpans { scope: Some(scope), spans, ..ScopeSpans::default() };
        let all = ResourceSpans { resource: Some(resource), scope_spans: vec![spans], ..ResourceSpans::default() };
        Self(ExportTraceServiceRequest { resource_spans: vec![all] })
    }

    pub(super) fn encode(&self) -> Vec<u8> {
        self.0.encode_to_vec()
    }
}

/// What the collector did not take of a batch.
#[derive(Debug, Default)]
pub(super) struct Refused {
    pub(super) spans: u64,
    pub(super) why: String,
}

impl Refused {
    /// Reads a collector's answer. One that cannot be read refuses nothing: the status said that all is well.
    pub(super) fn read(answer: &[u8]) -> Self {
        let partial = ExportTraceServiceResponse::decode(answer).ok().and_then(|answer| answer.partial_success);
        partial.map_or_else(Self::default, |partial| Self {
            spans: u64::try_from(partial.rejected_spans).unwrap_or(0),
            why: partial.error_message,
        })
    }
}

fn pair(key: &str, value: Value) -> KeyValue {
    let value = match value {
        Value::Text(text) => Any::StringValue(text.into_owned()),
        Value::Number(number) => Any::IntValue(number),
        Value::Flag(flag) => Any::BoolValue(flag),
    };
    KeyValue { key: key.to_owned(), value: Some(AnyValue { value: Some(value) }), ..KeyValue::default() }
}

fn nanoseconds(time: SystemTime) -> u64 {
    u64::try_from(time.duration_since(UNIX_EPOCH).unwrap_or_default().as_nanos()).unwrap_or(u64::MAX)
}

fn span(span: Finished) -> Span {
    let Finished { context, parent, start, end, closing, links } = span;
    let Closing { name, kind, attributes, error } = closing;
    let remote = if kind == SpanKind::Server && parent.is_some() { IS_REMOTE } else { 0 };
    let kind = match kind {
        SpanKind::Internal => Kind::Internal,
        SpanKind::Server => Kind::Server,
        SpanKind::Client => Kind::Client,
        SpanKind::Consumer => Kind::Consumer,
    };
    let link = |to: TraceContext| Link {
        trace_id: to.trace().to_be_bytes().to_vec(),
        span_id: to.span().to_be_bytes().to_vec(),
        trace_state: to.tracestate().unwrap_or_default().to_owned(),
        flags: u32::from(to.is_sampled()),
        ..Link::default()
    };
    Span {
        trace_id: context.trace().to_be_bytes().to_vec(),
        span_id: context.span().to_be_bytes().to_vec(),
        trace_state: context.tracestate().unwrap_or_default().to_owned(),
        parent_span_id: parent.map(|id| id.to_be_bytes().to_vec()).unwrap_or_default(),
        flags: HAS_IS_REMOTE | remote | u32::from(context.is_sampled()),
        name: name.into_owned(),
        kind: kind.into(),
        start_time_unix_nano: nanoseconds(start),
        end_time_unix_nano: nanoseconds(end),
        attributes: attributes.into_iter().map(|(key, value)| pair(key, value)).collect(),
        links: links.into_iter().map(link).collect(),
        status: error.map(|message| Status { message, code: StatusCode::Error.into() }),
        ..Span::default()
    }
}
