//! Accept loop: passes connections to hyper, with the timeouts, the connection limit and the drain that `axum::serve`
//! lacks.

use std::convert::Infallible;
use std::error::Error;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::http::header::{CONNECTION, HeaderValue};
use axum::http::{Request, Response, Version};
use futures_util::FutureExt as _;
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::server::conn::auto;
use metrics::{counter, gauge};
use tokio::io::AsyncWriteExt as _;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::JoinSet;
use tokio::time::Instant;
use tower::ServiceExt as _;

use super::guard::Peer;
use super::pace::{self, GaugeGuard, MAX_TIME_FACTOR, Pace, STREAM_BUFFER, Streams};
use super::problem::{MEDIA_TYPE, Problem};
use super::problem_types::ProblemType;
use super::socket::Guarded;
use super::stop::{self, Stop};
use crate::client_shares::{ClientShares, SharePermit};
use crate::config::ServerConfig;
use crate::memory_budget::{Budget, Buffers};
use crate::telemetry::{CONNECTIONS, REJECTED};

/// Time for the first request of a connection after the service begins to stop.
const FIRST_REQUEST: Duration = Duration::from_millis(500);
/// Pause after a failed accept, most likely because no file descriptor is left.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Number of connections beyond the limit that are answered with 503 at the same time; further ones are closed without
/// a response. The limit bounds the file descriptors of refused connections.
const MAX_REFUSALS: usize = 64;
/// HTTP/2 flow control windows per request and per connection, bytes: large enough for long distances.
const WINDOWS: [u32; 2] = [1 << 20, 2 << 20];
/// Send buffer of a socket, bytes. The system accepts more data only when a third of it is free, so with the default of
/// megabytes a slow client seems to stall for a minute.
const SOCKET_BUFFER: usize = 256 << 10;
/// Receive buffer of a connection, bytes, as charged to the memory budget.
const RECEIVE_BUFFER: usize = 64 << 10;
/// Buffers of a connection, bytes.
const CONNECTION_BYTES: u64 = (SOCKET_BUFFER + RECEIVE_BUFFER) as u64;
/// Maximum size of the head of a request, that is its request line and headers, bytes. Browsers and proxies send a few
/// KiB. Larger heads get a 431.
const HEAD_BYTES: u32 = 64 << 10;
/// Maximum number of concurrent requests on one HTTP/2 connection. A page sends a dozen; clients can open further
/// connections, which are counted.
const MAX_STREAMS: u32 = 64;
/// Interval of HTTP/2 pings.
const PING: Duration = Duration::from_secs(20);
/// Time for the last responses, such as those of cancelled jobs.
const LAST_RESPONSES: Duration = Duration::from_secs(1);

/// Creates the memory budget of the service. A request has at least the buffers of its connection.
pub(super) fn budget(limit: u64, client_share: f64) -> Budget {
    Budget::for_service(limit, CONNECTION_BYTES, client_share)
}

/// Serves `router` on `listener` until the drain. Then open requests may finish until [`Stop::Now`], and the responses
/// of cancelled ones for [`LAST_RESPONSES`] after it. Returns true if all requests finished before [`Stop::Now`].
/// Charges the buffers of connections to `budget`.
pub(super) async fn serve(
    listener: TcpListener,
    router: Router,
    config: Arc<ServerConfig>,
    budget: Budget,
    mut stop: watch::Receiver<Stop>,
) -> bool {
    let slots = Arc::new(Semaphore::new(config.connections));
    let shares = ClientShares::new(config.connections, config.client_share);
    let refusals = Arc::new(Semaphore::new(MAX_REFUSALS));
    let write_timeout = Duration::from_millis(config.write_timeout_ms);
    let mut connections = JoinSet::new();
    let mut stopping = false;
    loop {
        let accepted = if stopping {
            // Serves connections that the system accepted before the listener was closed.
            match listener.accept().now_or_never() {
                Some(accepted) => accepted,
                None => break,
            }
        } else {
            tokio::select! {
                accepted = listener.accept() => accepted,
                Some(_ended) = connections.join_next() => continue,
                () = stop::reached(&mut stop, Stop::Drain) => {
                    stopping = true;
                    continue;
                }
            }
        };
        let (stream, peer) = match accepted {
            Ok(accepted) => accepted,
            Err(_) if stopping => break,
            Err(error) => {
                tracing::warn!(%error, "cannot accept a connection");
                tokio::time::sleep(ACCEPT_PAUSE).await;
                continue;
            }
        };
        let peer = Peer(peer.ip());
        let slot = match take_slot(&slots, &shares, &config, peer) {
            Ok(slot) => slot,
            Err(problem) => {
                counter!(REJECTED, "reason" => problem.slug()).increment(1);
                if let Ok(hold) = Arc::clone(&refusals).try_acquire_owned() {
                    refuse(stream, &problem, hold, Pace::new(write_timeout));
                }
                continue;
            }
        };
        if let Err(error) = set_up(&stream) {
            tracing::debug!(%error, "the client disconnected at once");
            continue;
        }
        let pace = Pace::new(write_timeout);
        let stream = Guarded::new(
            stream,
            (slot, GaugeGuard::new(gauge!(CONNECTIONS)), budget.buffers(CONNECTION_BYTES)),
            MAX_TIME_FACTOR * write_timeout,
            Arc::clone(&pace),
        );
        let run = connection(stream, peer, pace, router.clone(), Arc::clone(&config), budget.clone(), stop.clone());
        connections.spawn(run);
    }
    drop(listener);
    let mut all = std::pin::pin!(async { while connections.join_next().await.is_some() {} });
    tokio::select! {
        biased;
        () = stop::reached(&mut stop, Stop::Now) => {
            drop(tokio::time::timeout(LAST_RESPONSES, all).await);
            false
        }
        () = &mut all => true,
    }
}

/// Sets the options of a new connection.
fn set_up(stream: &TcpStream) -> io::Result<()> {
    let socket = socket2::SockRef::from(stream);
    socket.set_send_buffer_size(SOCKET_BUFFER)?;
    // Responses are written in large pieces, which Nagle's algorithm would only delay.
    stream.set_nodelay(true)
}

/// Slot of a connection in `server.connections`, and in the share of its client. A trusted proxy serves many clients,
/// so it has no share.
type ConnectionSlot = (OwnedSemaphorePermit, Option<SharePermit>);

/// Takes a slot for a connection. Fails if there is none.
fn take_slot(
    slots: &Arc<Semaphore>,
    shares: &Arc<ClientShares>,
    config: &ServerConfig,
    peer: Peer,
) -> Result<ConnectionSlot, Problem> {
    let permit = Arc::clone(slots).try_acquire_owned().map_err(|_full| {
        Problem::new(ProblemType::TooManyConnections, "the server has reached its limit of connections")
    })?;
    let is_proxy = config.trusted_proxies.as_ref().is_some_and(|proxies| proxies.contains(peer.0));
    let share = if is_proxy { None } else { Some(shares.take(peer.client().0)?) };
    Ok((permit, share))
}

/// Answers a connection beyond a limit with 503, without reading its request.
fn refuse(stream: TcpStream, problem: &Problem, hold: OwnedSemaphorePermit, pace: Arc<Pace>) {
    let body = problem.document("unknown");
    let head = format!(
        "HTTP/1.1 503 Service Unavailable\r\ncontent-type: {MEDIA_TYPE}\r\ncontent-length: {}\r\n\
         retry-after: 1\r\nconnection: close\r\n\r\n",
        body.len()
    );
    // The send buffer of a new socket holds these few bytes, so this does not wait. Dropping the stream sends them
    // first.
    let mut stream = Guarded::new(stream, hold, Duration::from_secs(1), pace);
    tokio::spawn(async move {
        if let Err(error) = stream.write_all(&[head.as_bytes(), &body].concat()).await {
            tracing::debug!(%error, "a refused client disconnected");
        }
    });
}

/// Activity of a connection.
#[derive(Default)]
struct Activity {
    requests: AtomicUsize,
    begun: AtomicBool,
    /// Set by each request, cleared by each check.
    busy: AtomicBool,
}

/// Counts a request until it is dropped.
struct Working(Arc<Activity>);

impl Working {
    fn on(activity: &Arc<Activity>) -> Self {
        activity.begun.store(true, Ordering::Relaxed);
        activity.requests.fetch_add(1, Ordering::Relaxed);
        Self(Arc::clone(activity))
    }
}

impl Drop for Working {
    fn drop(&mut self) {
        self.0.busy.store(true, Ordering::Relaxed);
        self.0.requests.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Serves one connection.
async fn connection(
    stream: Guarded<(ConnectionSlot, GaugeGuard, Buffers)>,
    peer: Peer,
    pace: Arc<Pace>,
    router: Router,
    config: Arc<ServerConfig>,
    budget: Budget,
    mut stop: watch::Receiver<Stop>,
) {
    let activity = Arc::new(Activity::default());
    let phase = stop.clone();
    let (write_timeout, broken) = (Duration::from_millis(config.write_timeout_ms), Arc::new(Notify::new()));
    let service = service_fn(|request: Request<Incoming>| {
        let working = Working::on(&activity);
        let (phase, pace, version) = (phase.clone(), Arc::clone(&pace), request.version());
        let mut request = request.map(Body::new);
        request.extensions_mut().insert(peer);
        let answer = router.clone().oneshot(request);
        async move {
            let Ok(mut answer): Result<Response<Body>, Infallible> = answer.await;
            drop(working);
            // A client that sees this header opens its next connection to another instance.
            if *phase.borrow() >= Stop::Notice && version < Version::HTTP_2 {
                answer.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
            }
            Ok::<_, Infallible>(Pace::watch(answer, &pace, version))
        }
    });
    let builder = builder(&config, Streams::new(write_timeout, &broken, budget));
    let connection = builder.serve_connection(TokioIo::new(stream), service);
    tokio::pin!(connection);
    let (mut stopping, mut in_grace) = (false, false);
    let mut next_check = Instant::now() + Duration::from_millis(config.header_timeout_ms);
    loop {
        tokio::select! {
            ended = connection.as_mut() => {
                if let Err(error) = ended {
                    report(error.as_ref());
                }
                return;
            }
            () = pace.stalled() => {
                pace::cut_off();
                return;
            }
            () = broken.notified() => return,
            () = stop::reached(&mut stop, Stop::Drain), if !stopping => {
                stopping = true;
                if activity.begun.load(Ordering::Relaxed) {
                    connection.as_mut().graceful_shutdown();
                } else {
                    (next_check, in_grace) = (Instant::now() + FIRST_REQUEST, true);
                }
            }
            () = tokio::time::sleep_until(next_check), if in_grace => {
                in_grace = false;
                connection.as_mut().graceful_shutdown();
                next_check = Instant::now() + Duration::from_millis(config.header_timeout_ms);
            }
            () = tokio::time::sleep_until(next_check), if !in_grace => {
                // hyper starts its own timer only when the protocol version is known.
                if !activity.begun.load(Ordering::Relaxed) {
                    report_timeout();
                    return;
                }
                let busy = activity.busy.swap(false, Ordering::Relaxed) || activity.requests.load(Ordering::Relaxed) > 0;
                if !busy {
                    connection.as_mut().graceful_shutdown();
                }
                next_check = Instant::now() + Duration::from_millis(config.idle_timeout_ms);
            }
        }
    }
}

fn builder(config: &ServerConfig, streams: Streams) -> auto::Builder<Streams> {
    let mut builder = auto::Builder::new(streams);
    builder
        .http1()
        .timer(TokioTimer::new())
        .header_read_timeout(Duration::from_millis(config.header_timeout_ms))
        .max_buf_size(HEAD_BYTES as usize);
    builder
        .http2()
        .timer(TokioTimer::new())
        .keep_alive_interval(PING)
        // A slow client answers a ping after it has read all data before it.
        .keep_alive_timeout(MAX_TIME_FACTOR * Duration::from_millis(config.write_timeout_ms))
        .initial_stream_window_size(WINDOWS[0])
        .initial_connection_window_size(WINDOWS[1])
        .max_concurrent_streams(MAX_STREAMS)
        .max_send_buf_size(STREAM_BUFFER)
        .max_header_list_size(HEAD_BYTES);
    builder
}

/// Counts and logs a connection that ended with an error of the client.
fn report(error: &(dyn Error + Send + Sync + 'static)) {
    let hyper = error.downcast_ref::<hyper::Error>();
    if hyper.is_some_and(hyper::Error::is_timeout) {
        report_timeout();
        return;
    }
    if hyper.is_some_and(hyper::Error::is_parse_too_large) {
        counter!(REJECTED, "reason" => "head-too-large").increment(1);
    }
    let mut cause = Some(error as &(dyn Error + 'static));
    while let Some(error) = cause {
        if error.downcast_ref::<io::Error>().is_some_and(|e| e.kind() == io::ErrorKind::TimedOut) {
            counter!(REJECTED, "reason" => "write-timeout").increment(1);
        }
        cause = error.source();
    }
    tracing::debug!(error, "a connection ended early");
}

/// Counts and logs a connection that sent no request in time.
fn report_timeout() {
    counter!(REJECTED, "reason" => "header-timeout").increment(1);
    tracing::debug!("a connection sent no request in time");
}
