//! Signals of the operating system.

#[cfg(unix)]
use tokio::signal::unix::{Signal as UnixSignal, SignalKind, signal};

/// Listener for one signal. It receives the signals that arrive after its creation, and requires a tokio runtime. A
/// signal that the system does not have never arrives.
pub(super) struct Signal {
    #[cfg(unix)]
    inner: Option<UnixSignal>,
    #[cfg(not(unix))]
    is_interrupt: bool,
}

#[cfg(unix)]
impl Signal {
    fn listen(kind: SignalKind, name: &str) -> Self {
        Self { inner: signal(kind).inspect_err(|error| tracing::warn!(%error, "cannot listen for {name}")).ok() }
    }

    pub(super) fn hangup() -> Self {
        Self::listen(SignalKind::hangup(), "SIGHUP")
    }

    pub(super) fn terminate() -> Self {
        Self::listen(SignalKind::terminate(), "SIGTERM")
    }

    pub(super) fn interrupt() -> Self {
        Self::listen(SignalKind::interrupt(), "Ctrl-C")
    }

    /// Waits for the next signal.
    pub(super) async fn next(&mut self) {
        let received = match &mut self.inner {
            Some(signal) => signal.recv().await,
            None => None,
        };
        if received.is_none() {
            std::future::pending::<()>().await;
        }
    }
}

#[cfg(not(unix))]
impl Signal {
    pub(super) fn hangup() -> Self {
        Self { is_interrupt: false }
    }

    pub(super) fn terminate() -> Self {
        Self { is_interrupt: false }
    }

    pub(super) fn interrupt() -> Self {
        Self { is_interrupt: true }
    }

    /// Waits for the next signal.
    pub(super) async fn next(&mut self) {
        if !self.is_interrupt || tokio::signal::ctrl_c().await.is_err() {
            std::future::pending::<()>().await;
        }
    }
}
