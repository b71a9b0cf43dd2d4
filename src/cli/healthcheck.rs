//! `molmesh healthcheck`: sends one GET to a running service, for containers without curl.

use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use super::args::HealthcheckArgs;
use super::error::CliError;

/// Maximum size of a response in bytes: status line, headers and a short body.
const MAX_RESPONSE: u64 = 64 << 10;

/// Runs the command: prints the status, and fails unless it is 200.
pub(super) fn run(args: &HealthcheckArgs) -> Result<(), CliError> {
    let url = Url::parse(&args.url)?;
    let timeout = timeout(args.timeout)?;
    let response = get(&url, timeout).map_err(|e| CliError::Service(format!("{} does not answer: {e}", args.url)))?;
    match status(&response) {
        Some(200) => super::print("200 ok\n"),
        Some(code) => Err(CliError::Service(format!("{} responds with status {code}", args.url))),
        None => Err(CliError::Service(format!("{} does not respond with HTTP", args.url))),
    }
}

/// Parses `--timeout`, in seconds.
pub(super) fn timeout(seconds: f64) -> Result<Duration, CliError> {
    Some(seconds)
        .filter(|seconds| (0.001..=3600.0).contains(seconds))
        .map(Duration::from_secs_f64)
        .ok_or_else(|| CliError::usage("parameter `timeout`: expected seconds from 0.001 to 3600"))
}

/// The parts of an `http://` address.
#[derive(Debug, PartialEq)]
struct Url<'a> {
    authority: &'a str,
    path: &'a str,
}

impl<'a> Url<'a> {
    fn parse(text: &'a str) -> Result<Self, CliError> {
        let rest = text
            .strip_prefix("http://")
            .ok_or_else(|| CliError::usage(format!("parameter `url`: `{text}` is not allowed; expected http://…")))?;
        let at = rest.find('/').unwrap_or(rest.len());
        let (authority, path) = rest.split_at(at);
        if authority.is_empty() || rest.contains(|c: char| c.is_ascii_control() || c == ' ') {
            return Err(CliError::usage(format!(
                "parameter `url`: `{text}` is not allowed; expected http://host:port/"
            )));
        }
        Ok(Self { authority, path: if ["", "/"].contains(&path) { "/readyz" } else { path } })
    }

    /// Returns host and port, by default port 80. Keeps the brackets of an IPv6 address, which the resolver needs.
    fn socket(&self) -> String {
        let after_host = self.authority.rfind(']').map_or(0, |i| i + 1);
        if self.authority[after_host..].contains(':') {
            self.authority.to_owned()
        } else {
            format!("{}:80", self.authority)
        }
    }
}

fn get(url: &Url<'_>, timeout: Duration) -> std::io::Result<Vec<u8>> {
    let mut last = std::io::Error::from(std::io::ErrorKind::AddrNotAvailable);
    for address in url.socket().to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, timeout) {
            Ok(mut stream) => {
                stream.set_read_timeout(Some(timeout))?;
                stream.set_write_timeout(Some(timeout))?;
                let (path, host) = (url.path, url.authority);
                write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nAccept: */*\r\nConnection: close\r\n\r\n")?;
                let mut response = Vec::new();
                stream.take(MAX_RESPONSE).read_to_end(&mut response)?;
                return Ok(response);
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// Returns the status code of an HTTP/1 response.
fn status(response: &[u8]) -> Option<u16> {
    let line = response.split(|&b| b == b'\r').next()?;
    let mut fields = std::str::from_utf8(line).ok()?.split(' ');
    fields.next().filter(|version| version.starts_with("HTTP/1."))?;
    fields.next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_urls() {
        let url = |text| Url::parse(text).map(|u| (u.socket(), u.path.to_owned()));
        let is = |socket: &str, path: &str| (socket.to_owned(), path.to_owned());
        assert_eq!(url("http://127.0.0.1:8080/livez").unwrap(), is("127.0.0.1:8080", "/livez"));
        assert_eq!(url("http://example").unwrap(), is("example:80", "/readyz"));
        assert_eq!(url("http://example/").unwrap(), is("example:80", "/readyz"));
        assert_eq!(url("http://[::1]/x").unwrap(), is("[::1]:80", "/x"));
        assert_eq!(url("http://[::1]:9").unwrap(), is("[::1]:9", "/readyz"));
        for bad in ["https://x/", "x", "http://", "http:///x", "http://a b/", "http://a/\r\nX: y"] {
            assert!(Url::parse(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn reads_the_status_of_a_status_line_only() {
        assert_eq!(status(b"HTTP/1.1 503 Service Unavailable\r\n\r\n"), Some(503));
        for bad in [&b""[..], b"hello", b"HTTP/1.1", b"HTTP/1.1 ok\r\n", b"\xff\xfe\r\n"] {
            assert_eq!(status(bad), None, "{bad:?}");
        }
    }
}
