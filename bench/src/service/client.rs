//! HTTP/1.1 client with one persistent connection. It shares the cores of the service, so it spends as little as
//! possible: a body passes through the buffer of the connection.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{SocketAddr, TcpStream};

use serde_json::{Map, Value};

use crate::error::{Error, Result};

/// Number of bytes that are kept of a body.
const KEPT: usize = 64 << 10;

/// Client with one connection.
pub(super) struct Client {
    stream: BufReader<TcpStream>,
}

/// Response with its headers in lower case and the first [`KEPT`] bytes of its body.
struct Response {
    status: u16,
    headers: Vec<(String, String)>,
    body: Vec<u8>,
}

impl Response {
    fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|header| header.0 == name).map(|header| header.1.as_str())
    }
}

impl Client {
    /// Connects to a service.
    ///
    /// # Errors
    /// [`Error::Failed`].
    pub(super) fn connect(addr: SocketAddr) -> Result<Self> {
        let stream = TcpStream::connect(addr).map_err(Error::failed)?;
        stream.set_nodelay(true).map_err(Error::failed)?;
        Ok(Self { stream: BufReader::with_capacity(1 << 18, stream) })
    }

    /// Sends a request and receives the whole response. Returns the durations of its `Server-Timing`, ms.
    ///
    /// # Errors
    /// [`Error::Failed`], also for a status other than 200 and for a result that was stored already.
    pub(super) fn timing(&mut self, method: &str, target: &str, body: &[&[u8]]) -> Result<Map<String, Value>> {
        let response = self.ask(method, target, body)?;
        let timing = response.header("server-timing").unwrap_or_default();
        if response.status != 200 || timing.starts_with("cache") {
            let text = String::from_utf8_lossy(&response.body[..response.body.len().min(300)]).into_owned();
            return Err(Error::failed(format!("{method} {target}: {} {timing} {text}", response.status)));
        }
        let entry = |entry: &str| {
            let (name, ms) = entry.trim().split_once(";dur=")?;
            Some((name.to_owned(), Value::from(ms.parse::<f64>().ok()?)))
        };
        Ok(timing.split(',').filter_map(entry).collect())
    }

    /// Returns the status of the response to a `GET` request.
    ///
    /// # Errors
    /// [`Error::Failed`].
    pub(super) fn status(&mut self, target: &str) -> Result<u16> {
        Ok(self.ask("GET", target, &[])?.status)
    }

    /// Stores a structure. Returns its digest.
    ///
    /// # Errors
    /// [`Error::Failed`].
    pub(super) fn upload(&mut self, body: &[&[u8]]) -> Result<String> {
        let response = self.ask("POST", "/v1/structures", body)?;
        let document: Value = serde_json::from_slice(&response.body).map_err(Error::failed)?;
        let digest = document["digest"].as_str().map(str::to_owned);
        digest.ok_or_else(|| Error::failed(format!("the structure was not stored: {document}")))
    }

    /// Sends a request, whose body is given in parts, and receives the whole response.
    fn ask(&mut self, method: &str, target: &str, body: &[&[u8]]) -> Result<Response> {
        let length: usize = body.iter().map(|part| part.len()).sum();
        let head = format!("{method} {target} HTTP/1.1\r\nhost: localhost\r\ncontent-length: {length}\r\n\r\n");
        let out = self.stream.get_mut();
        std::iter::once(head.as_bytes())
            .chain(body.iter().copied())
            .try_for_each(|part| out.write_all(part))
            .map_err(Error::failed)?;
        let status = self.line()?;
        let status = status.split(' ').nth(1).and_then(|code| code.parse().ok());
        let status = status.ok_or_else(|| Error::failed("the response has no status"))?;
        let mut headers = Vec::new();
        loop {
            let line = self.line()?;
            let Some((name, value)) = line.split_once(':') else { break };
            headers.push((name.to_lowercase(), value.trim().to_owned()));
        }
        let mut response = Response { status, headers, body: Vec::new() };
        let length = response.header("content-length").and_then(|length| length.parse::<usize>().ok());
        match length {
            Some(length) => self.read(length, &mut response.body)?,
            None => self.chunks(&mut response.body)?,
        }
        Ok(response)
    }

    /// Receives a chunked body.
    fn chunks(&mut self, body: &mut Vec<u8>) -> Result<()> {
        loop {
            let line = self.line()?;
            let n = usize::from_str_radix(&line, 16).map_err(Error::failed)?;
            self.read(n, body)?;
            self.line()?;
            if n == 0 {
                return Ok(());
            }
        }
    }

    /// Receives `n` bytes and keeps the first of them.
    fn read(&mut self, n: usize, kept: &mut Vec<u8>) -> Result<()> {
        let mut left = n;
        while left > 0 {
            let bytes = self.stream.fill_buf().map_err(Error::failed)?;
            if bytes.is_empty() {
                return Err(Error::failed("the connection ended"));
            }
            let taken = bytes.len().min(left);
            kept.extend_from_slice(&bytes[..taken.min(KEPT.saturating_sub(kept.len()))]);
            self.stream.consume(taken);
            left -= taken;
        }
        Ok(())
    }

    /// Receives a line without its end.
    fn line(&mut self) -> Result<String> {
        let mut line = String::new();
        let n = self.stream.read_line(&mut line).map_err(Error::failed)?;
        if n == 0 { Err(Error::failed("the connection ended")) } else { Ok(line.trim_end().to_owned()) }
    }
}
