//! A collector of traces over plain HTTP/1.1 that keeps what it is sent, or misbehaves on command.
#![allow(dead_code, reason = "every test crate compiles this file and uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]

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

/// What the collector does with a batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Manner {
    Takes,
    /// Takes it, but for so many spans.
    Refuses(i64),
    /// Answers with this status.
    Status(u16),
    /// Never answers.
    Silent,
}

/// What came.
#[derive(Default)]
struct Kept {
    heads: Vec<String>,
    requests: Vec<ExportTraceServiceRequest>,
    /// Connections of silent answers, held open.
    held: Vec<TcpStream>,
}

/// A running collector.
pub(crate) struct Collector {
    pub(crate) addr: SocketAddr,
    kept: Arc<Mutex<Kept>>,
    stop: Arc<AtomicBool>,
}

impl Collector {
    pub(crate) fn start(manner: Manner) -> Self {
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
                std::thread::spawn(move || answer(stream, manner, &kept));
            }
        });
        Self { addr, kept, stop }
    }

    pub(crate) fn url(&self) -> String {
        format!("http://{}", self.addr)
    }

    /// The heads of all requests.
    pub(crate) fn heads(&self) -> Vec<String> {
        self.kept.lock().unwrap().heads.clone()
    }

    pub(crate) fn requests(&self) -> Vec<ExportTraceServiceRequest> {
        self.kept.lock().unwrap().requests.clone()
    }

    /// Every span, in the order in which they were sent.
    pub(crate) fn spans(&self) -> Vec<Span> {
        let scopes = self.requests().into_iter().flat_map(|r| r.resource_spans).flat_map(|r| r.scope_spans);
        scopes.flat_map(|scope| scope.spans).collect()
    }

    /// The spans of a trace.
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

fn answer(mut stream: TcpStream, manner: Manner, kept: &Mutex<Kept>) {
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
        if manner == Manner::Silent {
            kept.held.push(stream);
            return;
        }
    }
    let (status, body) = match manner {
        Manner::Status(status) => (status, Vec::new()),
        Manner::Refuses(rejected_spans) => {
            let partial = ExportTracePartialSuccess { rejected_spans, error_message: "as told".to_owned() };
            (200, ExportTraceServiceResponse { partial_success: Some(partial) }.encode_to_vec())
        }
        Manner::Takes | Manner::Silent => (200, Vec::new()),
    };
    let head = format!("HTTP/1.1 {status} x\r\ncontent-length: {}\r\nconnection: close\r\n\r\n", body.len());
    stream.write_all(&[head.as_bytes(), &body].concat()).unwrap();
}

/// Bytes as hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes
        .iter()
        .flat_map(|byte| [byte >> 4, byte & 15])
        .filter_map(|digit| char::from_digit(digit.into(), 16))
        .collect()
}

/// The span of this name; there is one.
#[track_caller]
pub(crate) fn named<'a>(spans: &'a [Span], name: &str) -> &'a Span {
    let found: Vec<&Span> = spans.iter().filter(|span| span.name == name).collect();
    let names: Vec<&str> = spans.iter().map(|span| span.name.as_str()).collect();
    assert_eq!(found.len(), 1, "{name} among {names:?}");
    found[0]
}

/// The spans right below one.
pub(crate) fn below<'a>(spans: &'a [Span], parent: &Span) -> Vec<&'a Span> {
    spans.iter().filter(|span| span.parent_span_id == parent.span_id).collect()
}

/// An attribute as text.
pub(crate) fn attribute(span: &Span, key: &str) -> Option<String> {
    let pair = span.attributes.iter().find(|pair| pair.key == key)?;
    match pair.value.as_ref()?.value.as_ref()? {
        Value::StringValue(text) => Some(text.clone()),
        Value::IntValue(number) => Some(number.to_string()),
        Value::BoolValue(flag) => Some(flag.to_string()),
        other => panic!("{key}: {other:?}"),
    }
}
