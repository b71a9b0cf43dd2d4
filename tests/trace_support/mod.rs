//! Collector of traces over plain HTTP/1.1 that records its requests or misbehaves.
#![allow(dead_code, reason = "each test binary uses a part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use opentelemetry_proto::tonic::collector::trace::v1::{
    ExportTracePartialSuccess, ExportTraceServiceRequest, ExportTraceServiceResponse,
};
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message as _;

/// Behaviour of the collector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum CollectorMode {
    Accept,
    /// Accepts a batch except this number of spans.
    Reject(i64),
    /// Responds with this status.
    Status(u16),
    /// Never responds.
    Silent,
}

/// Received requests.
#[derive(Default)]
struct Kept {
    heads: Vec<String>,
    requests: Vec<ExportTraceServiceRequest>,
    /// Connections without a response, held open.
    held: Vec<TcpStream>,
}

/// Running collector, stopped on drop.
pub(crate) struct Collector {
    pub(crate) addr: SocketAddr,
    kept: Arc<Mutex<Kept>>,
    stop: Arc<AtomicBool>,
}

impl Collector {
    pub(crate) fn start(mode: CollectorMode) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let addr = listener.local_addr().unwrap();
        let (kept, stop) = (Arc::<Mutex<Kept>>::default(), Arc::<AtomicBool>::default());
        let (kept_there, stop_there) = (Arc::clone(&kept), Arc::clone(&stop));
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                if stop_there.load(Ordering::SeqCst) {
                    return;
                }
                let kept = Arc::clone(&kept_there);
                std::thread::spawn(move || answer(stream, mode, &kept));
            }
        });
        Self { addr, kept, stop }
    }

    pub(crate) fn url(&self) -> String {
        format!("http://{}", self.addr)
    }

    /// Returns the heads of all requests.
    pub(crate) fn heads(&self) -> Vec<String> {
        self.kept.lock().unwrap().heads.clone()
    }

    pub(crate) fn requests(&self) -> Vec<ExportTraceServiceRequest> {
        self.kept.lock().unwrap().requests.clone()
    }

    /// Returns all spans in the order of arrival.
    pub(crate) fn spans(&self) -> Vec<Span> {
        let scopes = self.requests().into_iter().flat_map(|r| r.resource_spans).flat_map(|r| r.scope_spans);
        scopes.flat_map(|scope| scope.spans).collect()
    }

    /// Returns the spans of a trace.
    pub(crate) fn trace(&self, id: &str) -> Vec<Span> {
        self.spans().into_iter().filter(|span| hex(&span.trace_id) == id).collect()
    }
}

impl Drop for Collector {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        drop(TcpStream::connect(self.addr));
    }
}

fn answer(mut stream: TcpStream, mode: CollectorMode, kept: &Mutex<Kept>) {
    let (mut head, mut byte) = (Vec::new(), [0]);
    while !head.ends_with(b"\r\n\r\n") {
        match stream.read(&mut byte) {
            Ok(1) => head.push(byte[0]),
            _ => return,
        }
    }
    let head = String::from_utf8(head).unwrap().to_ascii_lowercase();
    let length = head.lines().find_map(|line| line.strip_prefix("content-length: ")).unwrap().parse().unwrap();
    let mut body = vec![0; length];
    stream.read_exact(&mut body).unwrap();
    {
        let mut kept = kept.lock().unwrap();
        kept.heads.push(head);
        kept.requests.push(ExportTraceServiceRequest::decode(&body[..]).unwrap());
        if mode == CollectorMode::Silent {
            kept.held.push(stream);
            return;
        }
    }
    let (status, body) = match mode {
        CollectorMode::Status(status) => (status, Vec::new()),
        CollectorMode::Reject(rejected_spans) => {
            let partial = ExportTracePartialSuccess { rejected_spans, error_message: "rejected by a test".to_owned() };
            (200, ExportTraceServiceResponse { partial_success: Some(partial) }.encode_to_vec())
        }
        CollectorMode::Accept | CollectorMode::Silent => (200, Vec::new()),
    };
    let head = format!("HTTP/1.1 {status} x\r\ncontent-length: {}\r\nconnection: close\r\n\r\n", body.len());
    stream.write_all(&[head.as_bytes(), &body].concat()).unwrap();
}

/// Formats bytes as hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes
        .iter()
        .flat_map(|byte| [byte >> 4, byte & 15])
        .filter_map(|digit| char::from_digit(digit.into(), 16))
        .collect()
}

/// Returns the only span of this name.
#[track_caller]
pub(crate) fn named<'a>(spans: &'a [Span], name: &str) -> &'a Span {
    let found: Vec<&Span> = spans.iter().filter(|span| span.name == name).collect();
    let names: Vec<&str> = spans.iter().map(|span| span.name.as_str()).collect();
    assert_eq!(found.len(), 1, "{name} among {names:?}");
    found[0]
}

/// Returns the child spans of a span.
pub(crate) fn below<'a>(spans: &'a [Span], parent: &Span) -> Vec<&'a Span> {
    spans.iter().filter(|span| span.parent_span_id == parent.span_id).collect()
}

/// Returns an attribute as text.
pub(crate) fn attribute(span: &Span, key: &str) -> Option<String> {
    let pair = span.attributes.iter().find(|pair| pair.key == key)?;
    match pair.value.as_ref()?.value.as_ref()? {
        Value::StringValue(text) => Some(text.clone()),
        Value::IntValue(number) => Some(number.to_string()),
        Value::BoolValue(flag) => Some(flag.to_string()),
        other => panic!("{key}: {other:?}"),
    }
}
