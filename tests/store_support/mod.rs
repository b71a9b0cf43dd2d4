//! Locations for test stores: a temporary folder, and a bucket of an in-memory S3 service (moto).
#![allow(dead_code, reason = "each test binary uses a part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests fail by panicking")]

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU64, Ordering};

use molmesh::config::{Secret, StoreConfig};
use molmesh::store::{Digest, Name, Store, StoreError};
use serde::Deserialize;
use tempfile::TempDir;

use crate::tools;

/// S3 service with the bucket `meshes`, stopped on drop or with the process.
pub(crate) struct Service {
    child: Child,
    stdin: Option<ChildStdin>,
    stdout: BufReader<ChildStdout>,
    pub(crate) access: Access,
}

/// Address and credentials, which the service prints when it is ready.
#[derive(Debug, Clone, Deserialize)]
pub(crate) struct Access {
    pub(crate) endpoint: String,
    pub(crate) id: String,
    pub(crate) secret: String,
}

impl Service {
    pub(crate) fn start(arguments: &[&str]) -> Self {
        let python = tools::python_interpreter();
        let python = python.unwrap_or_else(|| panic!("the S3 service is not installed: run tests/tools/setup.sh"));
        let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/tools/s3.py");
        let mut child = Command::new(python)
            .arg(script)
            .args(arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap_or_else(|e| panic!("the S3 service does not start: {e}"));
        let stdin = child.stdin.take();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        let access = serde_json::from_str(&line).unwrap_or_else(|e| panic!("the S3 service printed {line:?}: {e}"));
        Self { child, stdin, stdout, access }
    }

    /// Makes the service unavailable: it closes connections without a response and keeps its objects.
    pub(crate) fn away(&mut self) {
        self.command("away");
    }

    /// Makes the service available again.
    pub(crate) fn back(&mut self) {
        self.command("back");
    }

    fn command(&mut self, word: &str) {
        writeln!(self.stdin.as_mut().unwrap(), "{word}").unwrap();
        let mut line = String::new();
        self.stdout.read_line(&mut line).unwrap();
        assert_eq!(line.trim(), word);
    }

    pub(crate) fn config(&self, prefix: &str) -> StoreConfig {
        StoreConfig {
            url: Some(format!("s3://meshes/{prefix}")),
            endpoint: Some(self.access.endpoint.clone()),
            region: Some("us-east-1".to_owned()),
            allow_http: true,
            access_key_id: Some(self.access.id.clone()),
            secret_access_key: Some(Secret::new(&self.access.secret)),
            ..StoreConfig::default()
        }
    }

    /// Sends a request that bypasses the store. The service requires a signature but does not check it.
    pub(crate) fn send(&self, method: &str, path: &str) -> String {
        let host = self.access.endpoint.strip_prefix("http://").unwrap();
        let mut stream = TcpStream::connect(host).unwrap();
        let signed =
            "AWS4-HMAC-SHA256 Credential=any/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=x";
        let head = format!("{method} {path} HTTP/1.0\r\nHost: {host}\r\nAuthorization: {signed}");
        write!(stream, "{head}\r\nContent-Length: 0\r\n\r\n").unwrap();
        let mut response = String::new();
        stream.read_to_string(&mut response).unwrap();
        assert!(
            response.split(' ').nth(1).is_some_and(|status| status.starts_with('2')),
            "{method} {path}: {response}"
        );
        response
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        drop(self.stdin.take());
        self.child.wait().unwrap();
    }
}

static SHARED: LazyLock<Service> = LazyLock::new(|| Service::start(&[]));

/// Returns the service that tests share.
pub(crate) fn shared() -> &'static Service {
    &SHARED
}

/// Configuration and location of a test's store.
pub(crate) struct TestStore {
    pub(crate) config: StoreConfig,
    pub(crate) dir: TempDir,
    service: Option<(&'static Service, String)>,
}

pub(crate) fn local() -> TestStore {
    TestStore { config: StoreConfig::default(), dir: tempfile::tempdir().unwrap(), service: None }
}

pub(crate) fn s3() -> TestStore {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let prefix = format!("test/{}", COUNT.fetch_add(1, Ordering::Relaxed));
    let service = shared();
    TestStore { config: service.config(&prefix), dir: tempfile::tempdir().unwrap(), service: Some((service, prefix)) }
}

impl TestStore {
    pub(crate) async fn try_open(&self) -> Result<Store, StoreError> {
        Store::open(&self.config, self.dir.path()).await
    }

    pub(crate) async fn open(&self) -> Store {
        self.try_open().await.unwrap()
    }

    pub(crate) fn is_local(&self) -> bool {
        self.service.is_none()
    }

    /// Returns the root of a local store.
    pub(crate) fn root(&self) -> PathBuf {
        assert!(self.is_local());
        self.dir.path().join("store")
    }

    /// Removes an object, bypassing the store.
    pub(crate) fn remove_directly(&self, name: &Name) {
        match &self.service {
            None => std::fs::remove_file(self.root().join(name.to_string())).unwrap(),
            Some((service, prefix)) => drop(service.send("DELETE", &format!("/meshes/{prefix}/{name}"))),
        }
    }

    /// Returns unfinished objects: names of staged files, or keys of multipart uploads.
    pub(crate) fn unfinished(&self) -> Vec<String> {
        match &self.service {
            None => {
                let folders = ["inputs", "jobs", "results"].map(|folder| std::fs::read_dir(self.root().join(folder)));
                let files = folders.into_iter().flat_map(Result::unwrap).map(|file| file.unwrap().file_name());
                files.filter_map(|file| file.into_string().ok().filter(|name| name.contains('#'))).collect()
            }
            Some((service, prefix)) => {
                let response = service.send("GET", "/meshes?uploads");
                let keys = response.split("<Key>").skip(1).filter_map(|rest| rest.split("</Key>").next());
                keys.filter(|key| key.starts_with(&format!("{prefix}/"))).map(str::to_owned).collect()
            }
        }
    }
}

/// Returns the name of a result by number.
pub(crate) fn result(number: u64) -> Name {
    Name::result(&format!("{number:064x}"), "glb").unwrap()
}

/// Returns the name of an input by number.
pub(crate) fn input(number: u64) -> Name {
    Name::input(&Digest::of(&number.to_le_bytes()))
}

/// Returns the name of a job by number.
pub(crate) fn job(number: u64) -> Name {
    Name::job(&format!("{number:x}")).unwrap()
}

/// Returns pseudorandom bytes for a seed.
pub(crate) fn noise(length: usize, seed: u64) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state.to_le_bytes()
    };
    std::iter::repeat_with(&mut next).flatten().take(length).collect()
}
