//! Opens a domain anew whose files another program has deleted or damaged.
//!
//! The control plane of a daemon looks at its domain ten times a second ([`Domain::renewed`]), and
//! passes a new one to each data plane ([`Renewal`]). The old directory is removed, by which all
//! other processes see that they must open the new one.

use super::lock::FEW_STEPS;
use super::{Domain, DomainError};
use core::sync::atomic::AtomicBool;
use core::sync::atomic::Ordering::{Acquire, Release};
use std::sync::{Mutex, PoisonError};

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
}

/// A new domain, on its way from the control plane to a data plane.
#[derive(Debug, Default)]
pub struct Renewal {
    is_due: AtomicBool,
    domain: Mutex<Option<Domain>>,
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
    #[must_use]
    pub fn take(&self) -> Option<Domain> {
        if !self.is_due.load(Acquire) {
            return None;
        }
        let mut domain = self.domain.lock().unwrap_or_else(PoisonError::into_inner);
        self.is_due.store(false, Release);
        domain.take()
    }
}
