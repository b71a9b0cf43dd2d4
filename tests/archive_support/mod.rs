//! A remote archive over plain HTTP/1.1 that misbehaves on command, and counts what it is asked.
#![allow(dead_code, reason = "every test crate compiles this file and uses its own part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests say what they expect by panicking")]
#![allow(clippy::format_push_string, reason = "answers read best as they are sent")]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What the archive answers.
#[derive(Debug, Clone)]
pub(crate) enum Say {
    /// A whole answer: status, headers, body.
    Whole(u16, Vec<(&'static str, String)>, Vec<u8>),
    /// These bytes as they are, then the end.
    Raw(Vec<u8>),
    /// These bytes, and nothing more for so long.
    Stall(Vec<u8>, Duration),
    /// A chunked body that does not end before the client does.
    Endless,
    /// The answer after so long.
    After(Duration, Box<Say>),
}

/// 200 with a body.
pub(crate) fn ok(body: &[u8]) -> Say {
    Say::Whole(200, Vec::new(), body.to_vec())
}

/// A bare status.
pub(crate) fn status(status: u16) -> Say {
    Say::Whole(status, Vec::new(), Vec::new())
}

/// A status with one header.
pub(crate) fn with(status: u16, name: &'static str, value: impl Into<String>) -> Say {
    Say::Whole(status, vec![(name, value.into())], Vec::new())
}

/// 200 with a body and a validator; 304 to whoever names the validator.
pub(crate) fn tagged(tag: &str, body: &[u8]) -> Say {
    Say::Whole(200, vec![("etag", tag.to_owned())], body.to_vec())
}

/// A request as it came.
#[derive(Debug, Clone)]
pub(crate) struct Asked {
    pub(crate) path: String,
    pub(crate) head: String,
}

impl Asked {
    pub(crate) fn header(&self, name: &str) -> Option<&str> {
        self.head.lines().find_map(|line| {
            let (n, value) = line.split_once(':')?;
            n.eq_ignore_ascii_case(name).then(|| value.trim())
        })
    }
}

type Script = Box<dyn FnMut(&Asked, usize) -> Say + Send>;

/// A running archive.
pub(crate) struct Remote {
    pub(crate) addr: SocketAddr,
    asked: Arc<Mutex<Vec<Asked>>>,
    stop: Arc<AtomicBool>,
}

impl Remote {
    /// Answers each request with what `script` says of it and of the number of requests before it.
    pub(crate) fn start(script: impl FnMut(&Asked, usize) -> Say + Send + 'static) -> Self {
        Self::start_on("127.0.0.1:0".parse().unwrap(), script)
    }

    /// The same on a given address.
    pub(crate) fn start_on(addr: SocketAddr, script: impl FnMut(&Asked, usize) -> Say + Send + 'static) -> Self {
        let listener = TcpListener::bind(addr).unwrap();
        let addr = listener.local_addr().unwrap();
        let asked = Arc::new(Mutex::new(Vec::new()));
        let stop = Arc::new(AtomicBool::new(false));
        let (asked_there, stop_there) = (Arc::clone(&asked), Arc::clone(&stop));
        let script: Arc<Mutex<Script>> = Arc::new(Mutex::new(Box::new(script)));
        std::thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                if stop_there.load(Ordering::SeqCst) {
                    return;
                }
                let (asked, script) = (Arc::clone(&asked_there), Arc::clone(&script));
                std::thread::spawn(move || answer(stream, &asked, &script));
            }
        });
        Self { addr, asked, stop }
    }

    /// The same answer to every request.
    pub(crate) fn saying(say: Say) -> Self {
        Self::start(move |asked, _| match &say {
            Say::Whole(200, headers, _)
                if headers.iter().any(|(n, v)| *n == "etag" && asked.header("if-none-match") == Some(v)) =>
            {
                status(304)
            }
            say => say.clone(),
        })
    }

    /// The template of its entries.
    pub(crate) fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.addr)
    }

    /// Everything that was asked.
    pub(crate) fn asked(&self) -> Vec<Asked> {
        self.asked.lock().unwrap().clone()
    }

    /// How often it was asked.
    pub(crate) fn count(&self) -> usize {
        self.asked.lock().unwrap().len()
    }
}

impl Drop for Remote {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        // The one that waits for a connection gets one; afterwards nobody listens.
        drop(TcpStream::connect(self.addr));
    }
}

fn answer(mut stream: TcpStream, asked: &Mutex<Vec<Asked>>, script: &Mutex<Script>) {
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
    let request = Asked { path, head };
    let n = {
        let mut asked = asked.lock().unwrap();
        asked.push(request.clone());
        asked.len() - 1
    };
    let say = script.lock().unwrap()(&request, n);
    // A client that has heard enough hangs up.
    drop(speak(&mut stream, say));
}

fn speak(stream: &mut TcpStream, say: Say) -> std::io::Result<()> {
    match say {
        Say::Whole(status, headers, body) => {
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
        Say::Raw(bytes) => stream.write_all(&bytes),
        Say::Stall(bytes, time) => {
            stream.write_all(&bytes)?;
            stream.flush()?;
            std::thread::sleep(time);
            Ok(())
        }
        Say::Endless => {
            stream.write_all(b"HTTP/1.1 200 X\r\ntransfer-encoding: chunked\r\n\r\n")?;
            loop {
                stream.write_all(format!("400\r\n{}\r\n", "x".repeat(0x400)).as_bytes())?;
            }
        }
        Say::After(time, say) => {
            std::thread::sleep(time);
            speak(stream, *say)
        }
    }
}
