//! Remote archive over plain HTTP/1.1 with scripted responses. Records all requests.
#![allow(dead_code, reason = "each test binary uses a part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]
#![allow(clippy::format_push_string, reason = "responses are readable in the order in which they are sent")]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Response of the archive.
#[derive(Debug, Clone)]
pub(crate) enum Response {
    /// Complete response: status, headers, body.
    Whole(u16, Vec<(&'static str, String)>, Vec<u8>),
    /// Raw bytes, then the end of the connection.
    Raw(Vec<u8>),
    /// Raw bytes, then silence for the duration.
    Stall(Vec<u8>, Duration),
    /// Chunked body without end.
    Endless,
    /// Response after a delay.
    After(Duration, Box<Response>),
}

/// Returns a 200 with a body.
pub(crate) fn ok(body: &[u8]) -> Response {
    Response::Whole(200, Vec::new(), body.to_vec())
}

/// Returns a response with a status only.
pub(crate) fn status(status: u16) -> Response {
    Response::Whole(status, Vec::new(), Vec::new())
}

/// Returns a response with a status and one header.
pub(crate) fn with(status: u16, name: &'static str, value: impl Into<String>) -> Response {
    Response::Whole(status, vec![(name, value.into())], Vec::new())
}

/// Returns a 200 with a body and an `ETag`. [`Remote::saying`] turns it into a 304 for a matching `If-None-Match`.
pub(crate) fn tagged(tag: &str, body: &[u8]) -> Response {
    Response::Whole(200, vec![("etag", tag.to_owned())], body.to_vec())
}

/// Received request.
#[derive(Debug, Clone)]
pub(crate) struct ReceivedRequest {
    pub(crate) path: String,
    pub(crate) head: String,
}

impl ReceivedRequest {
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        self.head.lines().find_map(|line| {
            let (n, value) = line.split_once(':')?;
            n.eq_ignore_ascii_case(name).then(|| value.trim())
        })
    }
}

type Script = Box<dyn FnMut(&ReceivedRequest, usize) -> Response + Send>;

/// Running archive, stopped on drop.
pub(crate) struct Remote {
    pub(crate) addr: SocketAddr,
    received: Arc<Mutex<Vec<ReceivedRequest>>>,
    stop: Arc<AtomicBool>,
}

impl Remote {
    /// Starts an archive. `script` maps a request and the number of earlier requests to the response.
    pub(crate) fn start(script: impl FnMut(&ReceivedRequest, usize) -> Response + Send + 'static) -> Self {
        Self::start_on("127.0.0.1:0".parse().unwrap(), script)
    }

    /// Starts an archive on a given address.
    pub(crate) fn start_on(
        addr: SocketAddr,
        script: impl FnMut(&ReceivedRequest, usize) -> Response + Send + 'static,
    ) -> Self {
        let listener = TcpListener::bind(addr).unwrap();
        let addr = listener.local_addr().unwrap();
        let received = Arc::new(Mutex::new(Vec::new()));
        let stop = Arc::new(AtomicBool::new(false));
        let (requests, stopped) = (Arc::clone(&received), Arc::clone(&stop));
        let script: Arc<Mutex<Script>> = Arc::new(Mutex::new(Box::new(script)));
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                if stopped.load(Ordering::SeqCst) {
                    return;
                }
                let (received, script) = (Arc::clone(&requests), Arc::clone(&script));
                std::thread::spawn(move || answer(stream, &received, &script));
            }
        });
        Self { addr, received, stop }
    }

    /// Starts an archive with the same response to every request.
    pub(crate) fn saying(response: Response) -> Self {
        Self::start(move |received, _| match &response {
            Response::Whole(200, headers, _)
                if headers.iter().any(|(n, v)| *n == "etag" && received.header("if-none-match") == Some(v)) =>
            {
                status(304)
            }
            response => response.clone(),
        })
    }

    /// Returns the URL template of its entries.
    pub(crate) fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.addr)
    }

    /// Returns all requests.
    pub(crate) fn requests(&self) -> Vec<ReceivedRequest> {
        self.received.lock().unwrap().clone()
    }

    /// Returns the number of requests.
    pub(crate) fn count(&self) -> usize {
        self.received.lock().unwrap().len()
    }
}

impl Drop for Remote {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        // Wakes the listener, which then ends.
        drop(TcpStream::connect(self.addr));
    }
}

fn answer(mut stream: TcpStream, received: &Mutex<Vec<ReceivedRequest>>, script: &Mutex<Script>) {
    let mut head = Vec::new();
    let mut byte = [0];
    while !head.ends_with(b"\r\n\r\n") {
        match stream.read(&mut byte) {
            Ok(1) => head.push(byte[0]),
            _ => return,
        }
    }
    let head = String::from_utf8(head).unwrap();
    let path = head.split(' ').nth(1).unwrap().to_owned();
    let request = ReceivedRequest { path, head };
    let n = {
        let mut received = received.lock().unwrap();
        received.push(request.clone());
        received.len() - 1
    };
    let response = script.lock().unwrap()(&request, n);
    // The client may disconnect early.
    drop(send(&mut stream, response));
}

fn send(stream: &mut TcpStream, response: Response) -> std::io::Result<()> {
    match response {
        Response::Whole(status, headers, body) => {
            let mut head = format!("HTTP/1.1 {status} X\r\nconnection: close\r\n");
            if status != 304 {
                head += &format!("content-length: {}\r\n", body.len());
            }
            for (name, value) in headers {
                head += &format!("{name}: {value}\r\n");
            }
            stream.write_all(format!("{head}\r\n").as_bytes())?;
            stream.write_all(&body)
        }
        Response::Raw(bytes) => stream.write_all(&bytes),
        Response::Stall(bytes, time) => {
            stream.write_all(&bytes)?;
            stream.flush()?;
            std::thread::sleep(time);
            Ok(())
        }
        Response::Endless => {
            stream.write_all(b"HTTP/1.1 200 X\r\ntransfer-encoding: chunked\r\n\r\n")?;
            loop {
                stream.write_all(format!("400\r\n{}\r\n", "x".repeat(0x400)).as_bytes())?;
            }
        }
        Response::After(time, response) => {
            std::thread::sleep(time);
            send(stream, *response)
        }
    }
}
