//! `molmesh healthcheck`: sends one GET to a running service, for containers without curl.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use molmesh::pipeline::params::ParamError;
use reqwest::Url;

use super::args::HealthcheckArgs;
use super::error::CliError;

/// Maximum size of a response in bytes: status line, headers and a short body.
const MAX_RESPONSE: u64 = 64 << 10;

/// Runs the command: prints the status, and fails unless it is 200.
pub(super) fn run(args: &HealthcheckArgs) -> Result<(), CliError> {
    let url = parse_url(&args.url)?;
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

/// Parses `--url`. Without a path, it is that of `/readyz`.
fn parse_url(text: &str) -> Result<Url, ParamError> {
    let url = Url::parse(text).ok().filter(|url| url.scheme() == "http");
    let mut url = url.ok_or_else(|| ParamError::bad_value("url", text, "http://host:port/"))?;
    if url.path() == "/" {
        url.set_path("/readyz");
    }
    Ok(url)
}

fn get(url: &Url, timeout: Duration) -> std::io::Result<Vec<u8>> {
    let mut last = std::io::Error::from(std::io::ErrorKind::AddrNotAvailable);
    for address in url.socket_addrs(|| None)? {
        match TcpStream::connect_timeout(&address, timeout) {
            Ok(mut stream) => {
                stream.set_read_timeout(Some(timeout))?;
                stream.set_write_timeout(Some(timeout))?;
                let query = url.query().map(|query| format!("?{query}")).unwrap_or_default();
                let (path, host) = (url.path(), url.authority());
                write!(
                    stream,
                    "GET {path}{query} HTTP/1.1\r\nHost: {host}\r\nAccept: */*\r\nConnection: close\r\n\r\n"
                )?;
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
        for (text, expected) in [
            ("http://127.0.0.1:8080/livez", "http://127.0.0.1:8080/livez"),
            ("http://example", "http://example/readyz"),
            ("http://example/", "http://example/readyz"),
            ("http://[::1]/x?y", "http://[::1]/x?y"),
            // No line break gets into the request.
            ("http://a/\r\nX: y", "http://a/X:%20y"),
        ] {
            assert_eq!(parse_url(text).unwrap().as_str(), expected);
        }
        for bad in ["https://x/", "x", "http://", "http://a b/"] {
            assert!(parse_url(bad).is_err(), "{bad}");
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
