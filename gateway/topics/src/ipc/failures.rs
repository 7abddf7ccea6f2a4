//! Connections that a port could not make, as when the process may open no more files.
//!
//! iceoryx2 tries each connection once, when the port on the other side appears, and tells of a
//! failure only in its own log. The port would never hear of the other side again. Therefore each
//! port notes a failure and tries again.

use super::monotonic;
use crate::Nanos;
use core::sync::atomic::AtomicBool;
use core::sync::atomic::Ordering::Relaxed;
use iceoryx2::port::{DegradationAction, DegradationFn};
use std::sync::Arc;

/// The time between two attempts.
const PERIOD: Nanos = Nanos::from_millis(100);

/// What a port knows of its connections.
#[derive(Debug, Default)]
pub(super) struct Failures {
    failed: Arc<AtomicBool>,
    next: Nanos,
}

impl Failures {
    /// What iceoryx2 calls when a connection fails.
    pub(super) fn handler(&self) -> impl DegradationFn + 'static {
        let failed = Arc::clone(&self.failed);
        move |_, _: &_| {
            failed.store(true, Relaxed);
            // The other connections go on.
            DegradationAction::Ignore
        }
    }

    /// Whether a connection has failed since the last attempt.
    pub(super) fn any(&self) -> bool {
        self.failed.load(Relaxed)
    }

    /// Whether it is time for another attempt. Reads the clock only after a failure.
    pub(super) fn is_due(&mut self) -> bool {
        if !self.any() {
            return false;
        }
        let now = monotonic();
        let due = now >= self.next;
        if due {
            self.next = now + PERIOD;
        }
        due
    }

    /// Notes a failure.
    pub(super) fn note(&self) {
        self.failed.store(true, Relaxed);
    }

    /// Forgets the failures: the port's connections are made anew.
    pub(super) fn forget(&self) {
        self.failed.store(false, Relaxed);
    }
}
