//! Entries from a remote archive: correct, faulty, slow and missing responses.

use crate::archive_support;
use crate::http_support;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use archive_support::{Remote, Response, ok, status, tagged, with};
use http_support::{Fake, Mode, SAMPLE, gzip, send, start};
use molmesh::archive::{Archive, Entry, FetchError, Source, UnavailableReason};
use molmesh::config::Config;
use molmesh::memory_budget::Budget;
use molmesh::store::Digest;
use molmesh::structure::EntryId;

const CIF: &str = "/d/{id}.cif";
const GZ: &str = "/d/{id}.cif.gz";

fn id(text: &str) -> EntryId {
    text.parse().unwrap()
}

/// Configuration with short times, and its data folder.
struct Setup {
    dir: tempfile::TempDir,
    config: Config,
}

impl Setup {
    fn new(url: &str, change: impl FnOnce(&mut Config)) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut config = Config::default();
        dir.path().clone_into(&mut config.server.data_dir);
        let archive = &mut config.archive;
        archive.url = Some(url.parse().unwrap());
        archive.connect_timeout_ms = 1000;
        archive.first_byte_timeout_ms = 3000;
        archive.timeout_ms = 10_000;
        archive.backoff_ms = 10;
        archive.breaker_failures = 100;
        change(&mut config);
        Self { dir, config }
    }

    fn archive(&self) -> Archive {
        Archive::new(&self.config, Budget::unlimited())
    }

    fn copies(&self) -> PathBuf {
        self.dir.path().join("cache/archive")
    }

    fn put(&self, name: &str, bytes: &[u8]) {
        let folder = self.dir.path().join("archive");
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(folder.join(name), bytes).unwrap();
    }
}

/// Fetches 4pti once from a new archive.
async fn once(url: &str, change: impl FnOnce(&mut Config)) -> Result<Entry, FetchError> {
    Setup::new(url, change).archive().fetch(&id("4pti")).await
}

#[track_caller]
fn why(result: Result<Entry, FetchError>) -> (UnavailableReason, Option<Duration>) {
    match result {
        Err(FetchError::Unavailable { reason, retry_after, .. }) => (reason, retry_after),
        other => panic!("{other:?}"),
    }
}

async fn pause(ms: u64) {
    tokio::time::sleep(Duration::from_millis(ms)).await;
}

// ------------------------------------------------------------------------------------------- successful fetches

#[tokio::test(flavor = "multi_thread")]
async fn fetches_compressed_and_plain_entries() {
    for (path, body) in [(GZ, gzip(b"data_4PTI")), (CIF, b"data_4PTI".to_vec())] {
        let remote = Remote::saying(ok(&body));
        let place = Setup::new(&remote.url(path), |_| {});
        let archive = place.archive();
        let entry = archive.fetch(&id("4PTI")).await.unwrap();
        assert_eq!((&entry.bytes[..], entry.digest, entry.source), (&body[..], Digest::of(&body), Source::Remote));
        let again = archive.fetch(&id("pdb_00004pti")).await.unwrap();
        assert_eq!((again.bytes, again.digest, again.source), (entry.bytes, entry.digest, Source::Cache));
        let asked = remote.requests();
        assert_eq!((asked.len(), asked[0].path.as_str()), (1, path.replace("{id}", "4pti").as_str()));
        assert!(asked[0].header("user-agent").unwrap().starts_with("molmesh/"), "{asked:?}");
        assert_eq!(asked[0].header("accept-encoding"), None);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn accepts_chunked_responses() {
    let remote = Remote::saying(Response::Raw(
        b"HTTP/1.1 200 X\r\ntransfer-encoding: chunked\r\n\r\n2\r\nab\r\n0\r\n\r\n".into(),
    ));
    assert_eq!(&once(&remote.url(CIF), |_| {}).await.unwrap().bytes[..], b"ab");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_folder_takes_precedence() {
    let remote = Remote::saying(ok(b"remote"));
    let place = Setup::new(&remote.url(CIF), |c| c.archive.local_check_interval_ms = 1);
    place.put("4pti.cif", b"local");
    let archive = place.archive();
    let entry = archive.fetch(&id("4pti")).await.unwrap();
    assert_eq!((&entry.bytes[..], entry.source, remote.count()), (&b"local"[..], Source::Local, 0));
    // Even if the entry was fetched before.
    assert_eq!(archive.digest(&id("1abc")).await.unwrap(), Digest::of(b"remote"));
    place.put("1abc.cif", b"mine");
    pause(5).await;
    assert_eq!(archive.digest(&id("1abc")).await.unwrap(), Digest::of(b"mine"));
    assert_eq!(remote.count(), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn digests_are_cached() {
    let remote = Remote::saying(ok(b"remote"));
    let place = Setup::new(&remote.url(CIF), |_| {});
    let archive = place.archive();
    assert_eq!(archive.known(&id("4pti")).await, None);
    archive.fetch(&id("4pti")).await.unwrap();
    std::fs::remove_dir_all(place.copies()).unwrap();
    assert_eq!(archive.known(&id("4pti")).await, Some(Digest::of(b"remote")));
    // Cached digests expire.
    let place = Setup::new(&remote.url(CIF), |c| c.archive.revalidate_after_ms = 1000);
    let archive = place.archive();
    archive.fetch(&id("4pti")).await.unwrap();
    assert!(archive.known(&id("4pti")).await.is_some());
    pause(1100).await;
    assert_eq!(archive.known(&id("4pti")).await, None);
    // A local file is checked again after `local_check_interval_ms`.
    for (local_check_interval_ms, expected) in [(60_000, &b"old"[..]), (1, &b"newer"[..])] {
        let place = Setup::new(&remote.url(CIF), |c| c.archive.local_check_interval_ms = local_check_interval_ms);
        place.put("4pti.cif", b"old");
        let archive = place.archive();
        assert_eq!(archive.digest(&id("4pti")).await.unwrap(), Digest::of(b"old"));
        pause(5).await;
        assert_eq!(archive.known(&id("4pti")).await, Some(Digest::of(b"old")));
        place.put("4pti.cif", b"newer");
        pause(5).await;
        assert_eq!(archive.digest(&id("4pti")).await.unwrap(), Digest::of(expected), "{local_check_interval_ms}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn old_copies_are_revalidated() {
    let remote = Remote::start(|asked, n| match n {
        0 => tagged("\"a\"", b"first"),
        _ if asked.header("if-none-match") == Some("\"a\"") && n == 1 => status(304),
        2 => tagged("\"b\"", b"second"),
        _ => status(500),
    });
    let place = Setup::new(&remote.url(CIF), |c| c.archive.revalidate_after_ms = 1000);
    let archive = place.archive();
    let fetch = async || {
        let entry = archive.fetch(&id("4pti")).await.unwrap();
        (String::from_utf8(entry.bytes.to_vec()).unwrap(), entry.source)
    };
    assert_eq!(fetch().await, ("first".to_owned(), Source::Remote));
    pause(1100).await;
    assert_eq!(fetch().await, ("first".to_owned(), Source::Cache));
    assert_eq!(remote.requests()[1].header("if-none-match"), Some("\"a\""));
    // The confirmation renews the copy.
    assert_eq!((fetch().await.1, remote.count()), (Source::Cache, 2));
    pause(1100).await;
    assert_eq!(fetch().await, ("second".to_owned(), Source::Remote));
    // Validators are not sent to another URL.
    let other = Remote::saying(ok(b"third"));
    let mut config = place.config.clone();
    config.archive.url = Some(other.url(CIF).parse().unwrap());
    pause(1100).await;
    assert_eq!(&Archive::new(&config, Budget::unlimited()).fetch(&id("4pti")).await.unwrap().bytes[..], b"third");
    assert_eq!(other.requests()[0].header("if-none-match"), None);
}

#[tokio::test(flavor = "multi_thread")]
async fn revalidates_by_date_without_an_etag() {
    let date = "Wed, 21 Oct 2015 07:28:00 GMT";
    let remote = Remote::start(move |asked, _| match asked.header("if-modified-since") {
        Some(since) if since == date => status(304),
        _ => Response::Whole(200, vec![("last-modified", date.to_owned())], b"x".to_vec()),
    });
    let place = Setup::new(&remote.url(CIF), |c| c.archive.revalidate_after_ms = 1);
    let archive = place.archive();
    for source in [Source::Remote, Source::Cache, Source::Cache] {
        assert_eq!(archive.fetch(&id("4pti")).await.unwrap().source, source);
        pause(5).await;
    }
    assert_eq!(remote.count(), 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn tries_the_second_url_if_the_first_fails() {
    for first in [status(404), status(403), status(500)] {
        let (first, second) = (Remote::saying(first), Remote::saying(ok(b"x")));
        let urls = format!("{} {}", first.url(CIF), second.url("/{middle}/{id_upper}"));
        let entry = once(&urls, |c| c.archive.attempts = 1).await.unwrap();
        assert_eq!((&entry.bytes[..], first.count()), (&b"x"[..], 1));
        assert_eq!(second.requests()[0].path, "/pt/4PTI");
    }
    // The unavailable URL may have the entry, so the error is not "not found".
    let (dead, without) = (Remote::saying(status(500)), Remote::saying(status(404)));
    let urls = format!("{} {}", dead.url(CIF), without.url(CIF));
    assert_eq!(why(once(&urls, |c| c.archive.attempts = 1).await).0, UnavailableReason::Status(500));
}

// -------------------------------------------------------------------------------------------------- missing entries

#[tokio::test(flavor = "multi_thread")]
async fn missing_entries_are_not_requested_again_for_a_while() {
    for absent in [404, 410] {
        let remote = Remote::saying(status(absent));
        let place = Setup::new(&remote.url(CIF), |c| c.archive.retry_missing_after_ms = 1000);
        let archive = place.archive();
        for _ in 0..3 {
            assert!(matches!(archive.fetch(&id("4pti")).await, Err(FetchError::NotFound { .. })), "{absent}");
        }
        assert_eq!(remote.count(), 1, "{absent}");
        pause(1100).await;
        assert!(archive.fetch(&id("4pti")).await.is_err());
        assert_eq!(remote.count(), 2, "{absent}");
        place.put("4pti.cif", b"local");
        assert_eq!(archive.fetch(&id("4pti")).await.unwrap().source, Source::Local);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn copies_of_withdrawn_entries_are_removed() {
    let remote = Remote::start(|_, n| if n == 0 { ok(b"x") } else { status(410) });
    let place = Setup::new(&remote.url(CIF), |c| c.archive.revalidate_after_ms = 1);
    let archive = place.archive();
    archive.fetch(&id("4pti")).await.unwrap();
    pause(5).await;
    assert!(matches!(archive.fetch(&id("4pti")).await, Err(FetchError::NotFound { .. })));
    assert_eq!(std::fs::read_dir(place.copies().join("pt")).unwrap().count(), 0);
    assert_eq!(archive.known(&id("4pti")).await, None);
}

#[tokio::test(flavor = "multi_thread")]
async fn without_urls_no_request_is_sent() {
    let remote = Remote::saying(ok(b"x"));
    let mut place = Setup::new(&remote.url(CIF), |c| c.archive.revalidate_after_ms = 1);
    place.archive().fetch(&id("4pti")).await.unwrap();
    place.config.archive.url = None;
    pause(5).await;
    let archive = place.archive();
    assert_eq!(archive.fetch(&id("4pti")).await.unwrap().source, Source::Cache);
    assert!(archive.known(&id("4pti")).await.is_some());
    assert!(matches!(archive.fetch(&id("1abc")).await, Err(FetchError::NotFound { .. })));
    assert_eq!(remote.count(), 1);
}

// ------------------------------------------------------------------------------------------------------- redirects

#[tokio::test(flavor = "multi_thread")]
async fn redirects_are_limited_and_stay_on_their_host() {
    let hops = |n: usize| {
        Remote::start(move |_, at| if at < n { with(302, "location", format!("/hop/{at}")) } else { ok(b"x") })
    };
    for (n, good) in [(1, true), (3, true), (4, false)] {
        let remote = hops(n);
        let result = once(&remote.url(CIF), |_| {}).await;
        assert_eq!((result.is_ok(), remote.count()), (good, n.min(3) + 1), "{n}: {result:?}");
    }
    let elsewhere = Remote::saying(ok(b"x"));
    let targets = [
        elsewhere.url("/x"),
        format!("http://localhost:{}/x", elsewhere.addr.port()),
        format!("https://{}/x", elsewhere.addr),
        "file:///etc/passwd".to_owned(),
    ];
    for to in targets {
        let remote = Remote::saying(with(307, "location", &to));
        let result = once(&remote.url(CIF), |c| c.archive.allow_private = true).await;
        assert_eq!((why(result), remote.count()), ((UnavailableReason::Redirect, None), 1), "{to}");
    }
    assert_eq!(elsewhere.count(), 0);
    let looped = Remote::saying(with(301, "location", "/d/4pti.cif"));
    assert_eq!(why(once(&looped.url(CIF), |_| {}).await).0, UnavailableReason::Redirect);
    assert!(looped.count() <= 4);
}

// --------------------------------------------------------------------------------------------------------- failures

#[tokio::test(flavor = "multi_thread")]
async fn slow_heads_and_bodies_time_out() {
    let head = b"HTTP/1.1 200 X\r\ncontent-length: 9\r\n\r\nab".to_vec();
    for bytes in [b"HTTP/1.1 200 X\r\n".to_vec(), head] {
        let remote = Remote::saying(Response::Stall(bytes, Duration::from_mins(1)));
        let begin = Instant::now();
        let result = once(&remote.url(CIF), |c| {
            c.archive.connect_timeout_ms = 100;
            c.archive.first_byte_timeout_ms = 100;
            c.archive.attempts = 2;
        })
        .await;
        assert_eq!((why(result).0, remote.count()), (UnavailableReason::Timeout, 2));
        assert!(begin.elapsed() < Duration::from_secs(30), "{:?}", begin.elapsed());
    }
    // The total time also ends a response that keeps arriving.
    let remote = Remote::saying(Response::Endless);
    let result = once(&remote.url(CIF), |c| {
        c.archive.timeout_ms = 300;
        c.archive.max_bytes = u64::MAX;
    })
    .await;
    assert_eq!(why(result).0, UnavailableReason::Timeout);
}

#[tokio::test(flavor = "multi_thread")]
async fn responses_of_the_wrong_length_are_rejected() {
    let gz = gzip(&[b'x'; 500]);
    let announcing = |n: usize| {
        [format!("HTTP/1.1 200 X\r\nconnection: close\r\ncontent-length: {n}\r\n\r\n").as_bytes(), &gz].concat()
    };
    for (n, expected) in [
        (gz.len() + 1, UnavailableReason::Broken),
        (gz.len() - 1, UnavailableReason::Damaged),
        (4, UnavailableReason::Damaged),
    ] {
        let remote = Remote::saying(Response::Raw(announcing(n)));
        let place = Setup::new(&remote.url(GZ), |_| {});
        let result = place.archive().fetch(&id("4pti")).await;
        assert_eq!((why(result).0, remote.count()), (expected, 3), "{n}");
        assert!(!place.copies().exists(), "{n}");
    }
    let remote = Remote::saying(Response::Raw(announcing(gz.len())));
    assert_eq!(&once(&remote.url(GZ), |_| {}).await.unwrap().bytes[..], &gz[..]);
    let cut = Remote::saying(Response::Raw(b"HTTP/1.1 200 X\r\ntransfer-encoding: chunked\r\n\r\n5\r\nab".into()));
    assert_eq!(why(once(&cut.url(CIF), |_| {}).await).0, UnavailableReason::Broken);
    let page = Remote::saying(ok(b"<html>please log in</html>"));
    assert_eq!(why(once(&page.url(GZ), |_| {}).await).0, UnavailableReason::Damaged);
}

#[tokio::test(flavor = "multi_thread")]
async fn bodies_are_limited_during_the_transfer() {
    for response in [
        ok(&[b'x'; 1001]),
        Response::Endless,
        Response::Raw(b"HTTP/1.1 200 X\r\ncontent-length: 99999999999\r\n\r\n".into()),
    ] {
        let remote = Remote::saying(response);
        match once(&remote.url(CIF), |c| c.archive.max_bytes = 1000).await {
            Err(FetchError::TooLarge(error)) => assert_eq!(error.max, 1000),
            other => panic!("{other:?}"),
        }
        assert_eq!(remote.count(), 1, "not retried");
    }
    let remote = Remote::saying(ok(&[b'x'; 1000]));
    assert_eq!(once(&remote.url(CIF), |c| c.archive.max_bytes = 1000).await.unwrap().bytes.len(), 1000);
}

#[tokio::test(flavor = "multi_thread")]
async fn only_temporary_failures_are_retried() {
    for (bad, requests) in [(500, 3), (503, 3), (429, 3), (403, 1), (401, 1), (304, 1), (206, 1)] {
        let remote = Remote::saying(status(bad));
        let (why, retry_after) = why(once(&remote.url(CIF), |_| {}).await);
        assert_eq!((why, remote.count()), (UnavailableReason::Status(bad), requests));
        assert_eq!(retry_after.is_some(), requests > 1, "{bad}");
    }
    let remote = Remote::start(|_, n| if n < 2 { status(500) } else { ok(b"x") });
    assert_eq!(once(&remote.url(CIF), |_| {}).await.unwrap().source, Source::Remote);
    assert_eq!(remote.count(), 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn retry_after_is_respected() {
    let limited = Remote::start(|_, n| if n == 0 { with(429, "retry-after", "1") } else { ok(b"x") });
    let begin = Instant::now();
    once(&limited.url(CIF), |_| {}).await.unwrap();
    assert!(begin.elapsed() >= Duration::from_secs(1) && limited.count() == 2, "{:?}", begin.elapsed());
    // A longer `Retry-After` is reported to the caller, and requests to the host pause.
    let busy = Remote::saying(with(503, "retry-after", "100"));
    let place = Setup::new(&busy.url(CIF), |_| {});
    let archive = place.archive();
    for expected in [UnavailableReason::Status(503), UnavailableReason::Paused] {
        let (why, retry_after) = why(archive.fetch(&id("4pti")).await);
        assert_eq!((why, busy.count()), (expected, 1));
        assert!(retry_after.is_some_and(|d| (95..=100).contains(&d.as_secs())), "{retry_after:?}");
    }
}

/// Returns a URL template of this machine without a listener.
fn unreachable() -> String {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    format!("http://{}{CIF}", listener.local_addr().unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_circuit_breaker_opens_and_closes() {
    let (result, retry_after) = why(once(&unreachable(), |_| {}).await);
    assert_eq!(result, UnavailableReason::Connect);
    assert!(retry_after.is_some());

    let broken = Arc::new(AtomicBool::new(true));
    let seen = Arc::clone(&broken);
    let remote = Remote::start(move |_, _| if seen.load(Ordering::SeqCst) { status(500) } else { ok(b"x") });
    let place = Setup::new(&remote.url(CIF), |c| {
        c.archive.attempts = 1;
        c.archive.breaker_failures = 2;
        c.archive.breaker_ms = 1500;
    });
    let archive = place.archive();
    for _ in 0..2 {
        assert_eq!(why(archive.fetch(&id("4pti")).await).0, UnavailableReason::Status(500));
    }
    for entry in ["4pti", "1abc", "2abc"] {
        let (why, retry_after) = why(archive.fetch(&id(entry)).await);
        assert_eq!(why, UnavailableReason::Paused);
        assert!(retry_after.unwrap() <= Duration::from_millis(1500));
    }
    assert_eq!(remote.count(), 2, "no requests during the pause");
    // The trial fails.
    pause(1600).await;
    assert_eq!(why(archive.fetch(&id("4pti")).await).0, UnavailableReason::Status(500));
    assert_eq!(why(archive.fetch(&id("4pti")).await).0, UnavailableReason::Paused);
    assert_eq!(remote.count(), 3);
    broken.store(false, Ordering::SeqCst);
    pause(1600).await;
    for entry in ["4pti", "1abc"] {
        archive.fetch(&id(entry)).await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stale_copy_is_used_if_the_archive_fails() {
    let remote = Remote::start(|_, n| if n == 0 { ok(b"x") } else { status(500) });
    let place = Setup::new(&remote.url(CIF), |c| {
        c.archive.revalidate_after_ms = 1;
        c.archive.attempts = 1;
        c.archive.breaker_failures = 1;
    });
    let archive = place.archive();
    archive.fetch(&id("4pti")).await.unwrap();
    pause(5).await;
    // The first request fails, the second is not sent.
    for _ in 0..2 {
        let entry = archive.fetch(&id("4pti")).await.unwrap();
        assert_eq!((&entry.bytes[..], entry.source, remote.count()), (&b"x"[..], Source::Cache, 2));
    }
    assert_eq!(why(archive.fetch(&id("1abc")).await).0, UnavailableReason::Paused);
}

#[tokio::test(flavor = "multi_thread")]
async fn names_must_not_resolve_to_private_addresses() {
    let remote = Remote::saying(ok(b"x"));
    let by_name = format!("http://localhost:{}{CIF}", remote.addr.port());
    assert_eq!(why(once(&by_name, |_| {}).await), (UnavailableReason::Private, None));
    assert_eq!(remote.count(), 0);
    once(&by_name, |c| c.archive.allow_private = true).await.unwrap();
    // IP addresses in the configuration are allowed.
    once(&remote.url(CIF), |_| {}).await.unwrap();
    assert_eq!(remote.count(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_configured_proxy_is_used() {
    let proxy = Remote::saying(ok(b"x"));
    let url = format!("http://archive.invalid{CIF}");
    let named = format!("http://{}", proxy.addr);
    let set = |c: &mut Config| c.archive.proxy = Some(serde_json::from_value(named.into()).unwrap());
    assert_eq!(&once(&url, set).await.unwrap().bytes[..], b"x");
    assert_eq!(proxy.requests()[0].path, "http://archive.invalid/d/4pti.cif");
    assert_eq!(why(once(&url, |_| {}).await).0, UnavailableReason::Connect);
}

// ------------------------------------------------------------------------------------------------------ concurrency

#[tokio::test(flavor = "multi_thread")]
async fn concurrent_callers_share_a_fetch_that_outlives_them() {
    let slow = Response::After(Duration::from_millis(1500), Box::new(ok(b"x")));
    let remote = Remote::saying(slow);
    let place = Setup::new(&remote.url(CIF), |_| {});
    let archive = place.archive();
    let fetch = || {
        let archive = archive.clone();
        tokio::spawn(async move { archive.fetch(&id("4pti")).await })
    };
    let first = fetch();
    pause(50).await;
    let others: Vec<_> = (0..20).map(|_| fetch()).collect();
    pause(50).await;
    first.abort();
    assert!(first.await.unwrap_err().is_cancelled());
    for other in others {
        assert_eq!(&other.await.unwrap().unwrap().bytes[..], b"x");
    }
    assert_eq!(remote.count(), 1);
    // Without any caller left, the copy is still stored.
    let (archive, entry) = (archive.clone(), id("1abc"));
    let alone = tokio::spawn(async move { archive.fetch(&entry).await });
    pause(50).await;
    alone.abort();
    let copy = place.copies().join("ab/1abc.json");
    http_support::wait_for("a copy", || copy.exists());
    assert_eq!(remote.count(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn concurrent_fetches_are_limited() {
    let remote = Remote::saying(Response::After(Duration::from_secs(1), Box::new(ok(b"x"))));
    let place = Setup::new(&remote.url(CIF), |c| c.archive.concurrent = 2);
    let archive = place.archive();
    let done = Arc::new(AtomicUsize::new(0));
    for entry in ["1aaa", "2aaa", "3aaa"] {
        let (archive, done) = (archive.clone(), Arc::clone(&done));
        tokio::spawn(async move {
            archive.fetch(&id(entry)).await.unwrap();
            done.fetch_add(1, Ordering::SeqCst);
        });
    }
    http_support::wait_for("two requests", || remote.count() == 2);
    pause(100).await;
    assert_eq!(remote.count(), 2, "the third one waits");
    http_support::wait_for("all three", || done.load(Ordering::SeqCst) == 3);
    // Waiting for other fetches is limited.
    let remote = Remote::saying(Response::After(Duration::from_millis(900), Box::new(ok(b"x"))));
    let place = Setup::new(&remote.url(CIF), |c| {
        c.archive.concurrent = 1;
        c.archive.timeout_ms = 200;
        c.archive.attempts = 1;
    });
    let archive = place.archive();
    for entry in ["1aaa", "2aaa", "3aaa", "4aaa"] {
        let archive = archive.clone();
        tokio::spawn(async move { archive.fetch(&id(entry)).await });
    }
    let end = why(archive.fetch(&id("5aaa")).await).0;
    assert!([UnavailableReason::Timeout, UnavailableReason::Busy].contains(&end), "{end:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_fetch_that_waits_for_a_reader_ends_in_time() {
    let remote = Remote::saying(Response::After(Duration::from_millis(300), Box::new(ok(b"x"))));
    let place = Setup::new(&remote.url(CIF), |c| {
        c.jobs.workers = 1;
        c.archive.timeout_ms = 1500;
        c.archive.breaker_failures = 1;
    });
    let archive = place.archive();
    let readers = archive.readers();
    let far = Instant::now() + Duration::from_mins(1);
    let hold = || async { readers.wait(None, far, far).await.unwrap() };
    let busy = |ended: Result<Entry, FetchError>| assert!(matches!(ended, Err(FetchError::Busy { .. })), "{ended:?}");
    // Before the folder is read.
    let held = hold().await;
    let start = Instant::now();
    busy(archive.fetch(&id("1aaa")).await);
    busy(archive.digest(&id("1aaa")).await.map(|_| unreachable!()));
    assert!(start.elapsed() < Duration::from_secs(5) && remote.count() == 0, "{:?}", start.elapsed());
    drop(held);
    // Before a body that has arrived is checked.
    let fetch = tokio::spawn({
        let archive = archive.clone();
        async move { archive.fetch(&id("1aaa")).await }
    });
    http_support::wait_for("the request", || remote.count() == 1);
    let held = hold().await;
    busy(fetch.await.unwrap());
    drop(held);
    // The archive is not to blame, so its circuit breaker is closed.
    assert_eq!(&archive.fetch(&id("1aaa")).await.unwrap().bytes[..], b"x");
}

#[test]
fn an_entry_gets_503_while_no_reader_is_free() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("4pti.pdb"), SAMPLE).unwrap();
    let backend = Fake::new(Mode::Slow(Duration::from_secs(4)));
    let server = start(backend, |c| {
        c.archive.dir = Some(folder.path().to_owned());
        c.archive.timeout_ms = 1000;
        c.jobs.workers = 1;
        c.server.client_share = 1.0;
    });
    let get = || server.get("/v1/pdb/4pti/atoms");
    std::thread::scope(|scope| {
        // An estimate holds the reader while it meshes a coarse grid.
        let estimate = scope.spawn(|| server.post("/v1/estimate", &[], SAMPLE).status);
        std::thread::sleep(Duration::from_millis(500));
        let start = Instant::now();
        let reply = get();
        let problem = reply.problem(503, "queue-full");
        assert!(reply.header("retry-after").is_some() && problem["limit"] == 500, "{problem}");
        assert!(start.elapsed() < Duration::from_secs(3), "{:?}", start.elapsed());
        assert_eq!(estimate.join().unwrap(), 200);
    });
    assert_eq!(get().status, 200, "the control");
}

// ------------------------------------------------------------------------------------------------- copies on disk

#[tokio::test(flavor = "multi_thread")]
async fn copies_survive_a_restart() {
    let remote = Remote::saying(ok(b"x"));
    let place = Setup::new(&remote.url(CIF), |_| {});
    let digest = place.archive().fetch(&id("4pti")).await.unwrap().digest;
    let entry = place.archive().fetch(&id("4pti")).await.unwrap();
    assert_eq!((entry.digest, entry.source, remote.count()), (digest, Source::Cache, 1));
}

#[tokio::test(flavor = "multi_thread")]
async fn damaged_copies_are_fetched_again() {
    type Damage = fn(&Path, &Path);
    let damages: [(&str, Damage); 6] = [
        ("no damage (control)", |_, _| {}),
        ("a changed byte", |body, _| std::fs::write(body, b"whole entrz").unwrap()),
        ("a truncated body", |body, _| std::fs::write(body, b"whole").unwrap()),
        ("a longer body", |body, _| std::fs::write(body, b"whole entry and more").unwrap()),
        ("no body", |body, _| std::fs::remove_file(body).unwrap()),
        ("invalid metadata", |_, metadata| std::fs::write(metadata, b"{").unwrap()),
    ];
    for (what, damage) in damages {
        let remote = Remote::saying(ok(b"whole entry"));
        let place = Setup::new(&remote.url(CIF), |_| {});
        place.archive().fetch(&id("4pti")).await.unwrap();
        let copy = |extension: &str| place.copies().join("pt/4pti").with_extension(extension);
        damage(&copy("body"), &copy("json"));
        let archive = place.archive();
        for _ in 0..2 {
            assert_eq!(&archive.fetch(&id("4pti")).await.unwrap().bytes[..], b"whole entry", "{what}");
        }
        assert_eq!(remote.count(), if what.contains("control") { 1 } else { 2 }, "{what}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn least_recently_used_copies_are_evicted() {
    let remote = Remote::saying(ok(&[b'x'; 1000]));
    let mut place = Setup::new(&remote.url(CIF), |c| c.archive.cache_bytes = 2500);
    let archive = place.archive();
    let fetch = async |archive: &Archive, entry: &str| {
        pause(5).await;
        archive.fetch(&id(entry)).await.map(|entry| entry.source)
    };
    for (entry, source) in
        [("1aaa", Source::Remote), ("2aaa", Source::Remote), ("1aaa", Source::Cache), ("3aaa", Source::Remote)]
    {
        assert_eq!(fetch(&archive, entry).await.unwrap(), source, "{entry}");
    }
    // A later process knows the order of use and removes temporary files.
    let leftover = place.copies().join("aa/.1-1.tmp");
    std::fs::write(&leftover, b"half").unwrap();
    let old = std::time::SystemTime::now() - Duration::from_hours(2);
    std::fs::File::options().append(true).open(&leftover).unwrap().set_modified(old).unwrap();
    let later = place.archive();
    for (entry, source) in [("3aaa", Source::Cache), ("1aaa", Source::Cache), ("2aaa", Source::Remote)] {
        assert_eq!(fetch(&later, entry).await.unwrap(), source, "{entry}");
    }
    assert!(!leftover.exists());
    place.config.archive.url = None;
    let offline = place.archive();
    for (entry, kept) in [("1aaa", true), ("2aaa", true), ("3aaa", false)] {
        assert_eq!(fetch(&offline, entry).await.is_ok(), kept, "{entry}");
    }
    // An entry larger than the capacity is served but not stored.
    let place = Setup::new(&remote.url(CIF), |c| c.archive.cache_bytes = 999);
    let archive = place.archive();
    for _ in 0..2 {
        assert_eq!(fetch(&archive, "4pti").await.unwrap(), Source::Remote);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_entry_that_cannot_be_stored_is_still_served() {
    let remote = Remote::saying(ok(b"x"));
    let place = Setup::new(&remote.url(CIF), |_| {});
    std::fs::write(place.dir.path().join("cache"), "a file in place of the folder").unwrap();
    let archive = place.archive();
    for _ in 0..2 {
        assert_eq!(archive.fetch(&id("4pti")).await.unwrap().source, Source::Remote);
    }
}

// ------------------------------------------------------------------------------------------------------ over HTTP

const SURFACE: &str = "/v1/pdb/4pti/surface.glb?resolution=2";

fn server(url: &str, change: impl FnOnce(&mut Config)) -> http_support::Running {
    let url = url.parse().unwrap();
    start(Fake::new(Mode::Octahedra), |c| {
        c.archive.url = Some(url);
        c.archive.backoff_ms = 10;
        change(c);
    })
}

#[test]
fn meshes_an_entry_of_the_remote_archive() {
    let remote = Remote::saying(tagged("\"a\"", &gzip(SAMPLE)));
    let server = server(&remote.url(GZ), |_| {});
    let counted = |source: &str, result: &str| {
        let labels = [format!("source=\"{source}\""), format!("result=\"{result}\"")];
        server.metric("molmesh_archive_requests_total", &[&labels[0], &labels[1]])
    };
    let fetched = counted("remote", "found");
    let reply = server.get(SURFACE);
    assert_eq!(reply.status, 200, "{}", String::from_utf8_lossy(&reply.body));
    assert!(reply.body.starts_with(b"glTF") && reply.header("cache-control").is_some());
    assert!(counted("remote", "found") > fetched);
    assert!(server.metric("molmesh_archive_fetch_seconds_count", &["result=\"found\""]) >= 1.0);
    assert!(server.metric("molmesh_archive_cache_bytes", &[]) > 0.0);
    let cached = counted("cache", "found");
    // Other parameters, because the same mesh may come from the stored results. A structure in memory needs no copy,
    // except for the strict validator.
    assert_eq!(server.get(&SURFACE.replace("=2", "=1.9")).status, 200);
    assert!(counted("cache", "found") <= cached);
    assert_eq!(server.get(&format!("{SURFACE}&check=strict")).status, 200);
    assert!(counted("cache", "found") > cached);
    assert_eq!(server.get(SURFACE).header("etag"), reply.header("etag"));
    // Conditional requests use the cached digest and need no copy.
    std::fs::remove_dir_all(server.dir.path().join("cache")).unwrap();
    let tag = reply.header("etag").unwrap();
    let known = counted("cache", "known");
    assert_eq!(send(server.addr, "GET", SURFACE, &[("if-none-match", tag)], b"").status, 304);
    assert_eq!(send(server.addr, "HEAD", SURFACE, &[], b"").header("etag"), Some(tag));
    assert!(counted("cache", "known") >= known + 2.0);
    assert_eq!(remote.count(), 1);
}

#[test]
fn an_unavailable_archive_has_its_own_problem_type() {
    let server = server(&unreachable(), |c| c.archive.breaker_failures = 3);
    for detail in ["connected", "paused"] {
        let reply = server.get(SURFACE);
        let problem = reply.problem(424, "archive-unavailable");
        assert_eq!(problem["host"], "127.0.0.1");
        assert!(problem["detail"].as_str().unwrap().contains(detail), "{problem}");
        let wait: u64 = reply.header("retry-after").unwrap().parse().unwrap();
        assert!((1..=30).contains(&wait), "{wait}");
    }
    let forbidden = Remote::saying(status(403));
    let server = self::server(&forbidden.url(CIF), |_| {});
    let reply = server.get(SURFACE);
    assert_eq!(reply.problem(424, "archive-unavailable")["found"], 403);
    assert_eq!(reply.header("retry-after"), None);
}

#[test]
fn missing_and_too_large_entries_are_reported() {
    let remote = Remote::start(|asked, _| if asked.path.contains("4pti") { ok(&[b'x'; 2000]) } else { status(404) });
    let server = server(&remote.url(CIF), |c| c.archive.max_bytes = 1000);
    let problem = server.get(SURFACE).problem(413, "entry-too-large");
    assert_eq!((&problem["limit"], &problem["actual"]), (&1000.into(), &2000.into()));
    server.get("/v1/pdb/1abc/surface.glb").problem(404, "not-in-archive");
    let before = remote.count();
    for bad in ["..%2f..%2fetc", "4pti%2f..", "4pti%00", "4pti?x=y", "%2e%2e", "4pti%3fx", "http:%2f%2fh"] {
        let reply = server.get(&format!("/v1/pdb/{bad}/surface.glb"));
        assert!([400, 404].contains(&reply.status), "{bad}: {}", reply.status);
    }
    assert_eq!(remote.count(), before, "invalid ids cause no requests");
}

#[test]
fn stale_copies_are_counted_and_logged() {
    let remote = Remote::start(|_, n| if n == 0 { ok(SAMPLE) } else { status(500) });
    let server = server(&remote.url(CIF), |c| {
        c.archive.revalidate_after_ms = 1;
        c.archive.attempts = 1;
    });
    let stale = || server.metric("molmesh_archive_requests_total", &["result=\"stale\""]);
    assert_eq!(server.get(SURFACE).status, 200);
    let (before, lines) = (stale(), http_support::log_lines("stale copy").len());
    std::thread::sleep(Duration::from_millis(5));
    assert_eq!(server.get(SURFACE).status, 200);
    assert!(stale() > before && http_support::log_lines("stale copy").len() > lines);
}

#[test]
fn running_fetches_count_as_memory() {
    let remote = Remote::start(|_, n| if n == 0 { Response::Endless } else { ok(SAMPLE) });
    let server = server(&remote.url(CIF), |c| {
        c.limits.memory_bytes = 4 << 20;
        c.archive.breaker_failures = 1;
    });
    // `archive.max_bytes` is much larger.
    let document = server.get(SURFACE).problem(422, "too-much-memory");
    assert_eq!(
        (&document["limit"], document["actual"].as_u64().is_some_and(|needed| needed > 4 << 20)),
        (&(4 << 20).into(), true)
    );
    http_support::wait_for("the memory", || server.metric("molmesh_memory_held_bytes", &[]) == 0.0);
    // The breaker stays closed, and the first request was not retried.
    assert_eq!((server.get(SURFACE).status, remote.count()), (200, 2));
}

#[test]
fn an_open_circuit_breaker_is_a_metric() {
    let server = server(&unreachable().replace("127.0.0.1", "127.0.0.7"), |c| c.archive.breaker_failures = 1);
    let open = || server.metric("molmesh_archive_breaker_open", &["host=\"127.0.0.7\""]);
    let before = open();
    server.get(SURFACE).problem(424, "archive-unavailable");
    assert!((before, open()) == (0.0, 1.0), "{before} {}", open());
}

#[test]
fn local_entries_stay_within_the_memory_budget() {
    /// Number of entries, each of 20 MB.
    const ENTRIES: usize = 50;
    const BUDGET: u64 = 64 << 20;
    let folder = tempfile::tempdir().unwrap();
    let path = |i: usize| folder.path().join(format!("1a{i:02}.pdb"));
    let remark = format!("REMARK 999 {:<69}\n", "");
    let lines = 20_000_000 / remark.len();
    std::fs::write(path(0), [SAMPLE, remark.repeat(lines).as_bytes()].concat()).unwrap();
    (1..ENTRIES).for_each(|i| std::fs::hard_link(path(0), path(i)).unwrap());
    let server = start(Fake::new(Mode::Octahedra), |c| {
        c.archive.dir = Some(folder.path().to_owned());
        c.archive.url = None;
        c.limits.memory_bytes = BUDGET;
        c.server.client_share = 1.0;
    });
    let held = || server.metric("molmesh_memory_held_bytes", &[]);
    let before = http_support::peak_memory();
    let (ended, mut most) = (AtomicUsize::new(0), 0.0_f64);
    let mut answers = Vec::new();
    let ask = |i: usize| {
        let id = path(i).file_stem().unwrap().to_str().unwrap().to_owned();
        let reply = server.get(&format!("/v1/pdb/{id}/surface.glb?resolution=2"));
        ended.fetch_add(1, Ordering::SeqCst);
        reply
    };
    std::thread::scope(|scope| {
        let ask = &ask;
        let asked: Vec<_> = (0..ENTRIES).map(|i| scope.spawn(move || ask(i))).collect();
        while ended.load(Ordering::SeqCst) < ENTRIES {
            most = most.max(held());
        }
        answers.extend(asked.into_iter().map(|reply| reply.join().unwrap()));
    });
    let n_meshes = answers.iter().filter(|reply| reply.status == 200).count();
    assert!(n_meshes > 0);
    for reply in answers.iter().filter(|reply| reply.status != 200) {
        assert_eq!(reply.status, 503, "{}", reply.text());
    }
    assert!(most >= 20e6 && most <= BUDGET as f64, "{most}");
    // All files at once have 1 GB.
    let grown = http_support::peak_memory().saturating_sub(before);
    assert!(grown < 256 << 20, "{grown}");
    http_support::wait_for("the memory", || held() == 0.0);
}

#[test]
fn long_json_documents_name_entries() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("4pti.pdb"), SAMPLE).unwrap();
    let server = start(Fake::new(Mode::Octahedra), |c| c.archive.dir = Some(folder.path().to_owned()));
    let json = [("content-type", "application/json")];
    let members = "\"color\": null, ".repeat(2000);
    let document = |end: &str| format!("{{{members}\"pdb_id\": \"4pti\"{end}");
    assert!(document("}").len() > 20_000);
    assert_eq!(server.post("/v1/meshes", &json, document("}").as_bytes()).status, 200);
    server.post("/v1/meshes", &json, document("").as_bytes()).problem(400, "bad-request");
    server.post("/v1/meshes", &json, document(", \"x\": [{}]}").as_bytes()).problem(400, "bad-parameter");
}
