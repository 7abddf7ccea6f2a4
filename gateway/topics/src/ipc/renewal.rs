//! Opens a domain anew whose files another program has deleted or damaged.
//!
//! The control plane of a daemon looks at its domain ten times a second ([`Domain::renewed`]), and
//! passes a new one to each data plane ([`Renewal`], [`Renewing`]). The old directory is removed,
//! by which all other processes see that they must open the new one.

use super::lock::FEW_STEPS;
use super::{Domain, DomainError};
use crate::Nanos;
use core::sync::atomic::AtomicBool;
use core::sync::atomic::Ordering::{Acquire, Release};
use std::sync::{Arc, Mutex, PoisonError};

impl Domain {
    /// `None` if the domain is intact ([`Domain::is_intact`]). Else gives it up, and opens it anew:
    /// all ports must be created again in the new one. Neither this nor they wait long for another
    /// process: what fails is tried again.
    ///
    /// # Errors
    /// As [`Domain::open`]: call it again later.
    pub fn renewed(&self) -> Option<Result<Self, DomainError>> {
        (!self.is_intact()).then(|| {
            self.abandon();
            Self::create(self.config(), FEW_STEPS)
        })
    }

    /// As [`Domain::renewed`], for who only reads: it waits for those who write to make the domain
    /// anew, and removes nothing.
    ///
    /// # Errors
    /// As [`Domain::open_existing`]: call it again later.
    pub fn reopened(&self) -> Option<Result<Self, DomainError>> {
        (!self.is_intact()).then(|| {
            self.give_up();
            Self::open_existing(self.config())
        })
    }
}

/// How often a data plane tries again to create its ports.
const RETRY: Nanos = Nanos::from_millis(100);

/// A new domain, on its way from the control plane to a data plane.
#[derive(Debug, Default)]
pub struct Renewal {
    is_due: AtomicBool,
    domain: Mutex<Option<Domain>>,
}

/// A data plane's end of a [`Renewal`].
#[derive(Debug)]
pub struct Renewing {
    renewal: Arc<Renewal>,
    /// The domain in which the ports are still to be created, and when that is tried (again).
    next: Option<(Domain, Nanos)>,
    has_failed: bool,
}

impl Renewing {
    /// The other end of `renewal`.
    #[must_use]
    pub fn new(renewal: Arc<Renewal>) -> Self {
        Self {
            renewal,
            next: None,
            has_failed: false,
        }
    }

    /// The ports that `create` makes in a domain that was passed; `None` if there is none to be
    /// made at `now`. One load from memory then. What fails is tried again ten times a second.
    ///
    /// # Errors
    /// Those of `create`, the first time only.
    pub fn ports<P, E>(
        &mut self,
        now: Nanos,
        create: impl FnOnce(&Domain) -> Result<P, E>,
    ) -> Option<Result<P, E>> {
        if let Some(domain) = self.renewal.take() {
            self.next = Some((domain, now));
        }
        let (domain, _) = self.next.take_if(|(_, t)| *t <= now)?;
        let created = create(&domain);
        let is_repeated = std::mem::replace(&mut self.has_failed, created.is_err());
        if created.is_err() {
            self.next = Some((domain, now + RETRY));
        }
        (created.is_ok() || !is_repeated).then_some(created)
    }
}

impl Renewal {
    /// Passes `domain`.
    pub fn pass(&self, domain: Domain) {
        let mut place = self.domain.lock().unwrap_or_else(PoisonError::into_inner);
        let before = place.replace(domain);
        drop(place);
        drop(before);
        self.is_due.store(true, Release);
    }

    /// A domain that was passed. One load from memory if there is none.
    fn take(&self) -> Option<Domain> {
        if !self.is_due.load(Acquire) {
            return None;
        }
        let mut domain = self.domain.lock().unwrap_or_else(PoisonError::into_inner);
        self.is_due.store(false, Release);
        domain.take()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ipc::DomainConfig;

    #[test]
    fn what_fails_is_told_once_and_tried_again() {
        let base = tempfile::tempdir().unwrap();
        let domain = Domain::open(&DomainConfig::new(base.path(), "test")).unwrap();
        let renewal = Arc::new(Renewal::default());
        let mut own = Renewing::new(Arc::clone(&renewal));
        let t = Nanos::from_millis(1000);
        assert_eq!(own.ports(t, |_| Ok::<_, ()>(1)), None, "none was passed");
        renewal.pass(domain);
        assert_eq!(own.ports(t, |_| Err::<u8, _>("no")), Some(Err("no")));
        let soon = t + RETRY - Nanos(1);
        assert_eq!(own.ports(soon, |_| Ok::<_, &str>(2)), None, "not yet");
        assert_eq!(own.ports(t + RETRY, |_| Err::<u8, _>("no")), None, "told");
        let later = t + RETRY + RETRY;
        assert_eq!(own.ports(later, |_| Ok::<_, &str>(3)), Some(Ok(3)));
        assert_eq!(own.ports(later + RETRY, |_| Ok::<_, &str>(4)), None, "done");
    }
}
