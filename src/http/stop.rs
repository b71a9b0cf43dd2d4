//! Phases of the shutdown, and the signals that start them.

use tokio::sync::watch;

use super::signal::Signal;

/// Phase of the shutdown. Later phases include the restrictions of earlier ones.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stop {
    /// All requests are served.
    #[default]
    Serve,
    /// `/readyz` answers 503 and connections are closed after a response; all requests are served.
    Notice,
    /// The listener is closed; running requests are finished.
    Drain,
    /// Unfinished requests are cancelled.
    Now,
}

impl Stop {
    /// Returns the next phase.
    #[must_use]
    pub const fn next(self) -> Self {
        match self {
            Self::Serve => Self::Notice,
            Self::Notice => Self::Drain,
            Self::Drain | Self::Now => Self::Now,
        }
    }
}

/// Waits for phase `step` or a later one. A dropped sender counts as [`Stop::Drain`].
pub(super) async fn reached(orders: &mut watch::Receiver<Stop>, step: Stop) {
    if orders.wait_for(|stop| *stop >= step).await.is_err() && step > Stop::Drain {
        std::future::pending::<()>().await;
    }
}

/// Waits for a further order.
pub(super) async fn further(orders: &mut watch::Receiver<Stop>) {
    if orders.changed().await.is_err() {
        std::future::pending::<()>().await;
    }
}

/// Returns the orders that signals give: SIGTERM starts with the termination notice, SIGINT (Ctrl-C) with the drain;
/// each further signal starts the next phase. Must be called on a tokio runtime.
#[must_use]
pub fn shutdown_signals() -> watch::Receiver<Stop> {
    let (order, orders) = watch::channel(Stop::Serve);
    tokio::spawn(async move {
        let (mut terminate, mut interrupt) = (Signal::terminate(), Signal::interrupt());
        loop {
            let first = tokio::select! {
                () = terminate.next() => Stop::Notice,
                () = interrupt.next() => Stop::Drain,
            };
            order.send_modify(|stop| *stop = (*stop).next().max(first));
        }
    });
    orders
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_signal_starts_the_next_phase_and_ctrl_c_skips_the_notice() {
        let order = |stop: Stop, signal: Stop| stop.next().max(signal);
        let (terminate, interrupt) = (Stop::Notice, Stop::Drain);
        assert_eq!(order(Stop::Serve, terminate), Stop::Notice);
        assert_eq!(order(Stop::Serve, interrupt), Stop::Drain);
        assert_eq!(order(Stop::Notice, terminate), Stop::Drain);
        assert_eq!(order(Stop::Notice, interrupt), Stop::Drain);
        assert_eq!(order(Stop::Drain, terminate), Stop::Now);
        assert_eq!(order(Stop::Now, interrupt), Stop::Now);
    }
}
