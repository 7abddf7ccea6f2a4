//! The driver `canopen_sync`: The SYNC of a CANopen bus. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/canopen_sync.md")]

#[cfg(feature = "boards")]
mod board;

use crate::bringup::{Bringup, NoInquiry};
use crate::canopen::{self, SYNC};
use crate::family::{Family, Session, Supervised, next_in_step};
use crate::received::Received;
use crate::{Decoded, Device, Driver, Frame, OutputInfo, Spec, SpecError, keys};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::Nanos;
use serde::Deserialize;

/// The keys of `driver = "canopen_sync"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct CanopenSyncOptions {
    /// Period \[ms\], 0.5 to 1000; default 10.
    pub period_ms: f64,
}

impl Default for CanopenSyncOptions {
    fn default() -> Self {
        Self { period_ms: 10.0 }
    }
}

impl CanopenSyncOptions {
    fn period(&self, spec: &Spec) -> Result<Nanos, SpecError> {
        let key = "period_ms";
        let ms = keys::within(key, self.period_ms, 0.5..=1000.0, "0.5 to 1000")?;
        let period = Nanos::from_seconds(ms * 1e-3);
        if period >= spec.max_silence {
            return Err(SpecError::key(key, ms, "less than max_silence_ms"));
        }
        Ok(period)
    }
}

impl Driver for CanopenSyncOptions {
    const NAME: &'static str = "canopen_sync";
    const ADDRESS: Option<u32> = Some(0);

    fn outputs(&self) -> Vec<OutputInfo> {
        Vec::new()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let bringup = Bringup::new(spec, spec.mode, canopen::TIMING, SYNC);
        let this = Producer {
            period: self.period(spec)?,
            next: Nanos::MIN,
        };
        Ok(Supervised::boxed([], bringup, NoInquiry, this))
    }
}

/// The host's side: all of it.
#[derive(Debug)]
struct Producer {
    period: Nanos,
    next: Nanos,
}

impl Family for Producer {
    type Questions = NoInquiry;

    fn on_frame(&mut self, _frame: &mut Received<'_>, _session: &mut Session) {}

    fn request(&mut self, now: Nanos, session: &mut Session, _out: &mut Decoded) -> Option<Frame> {
        if now < self.next {
            return None;
        }
        self.next = next_in_step(self.next, self.period, now);
        // It works as long as the bus takes them.
        session.bringup.reading(now);
        Some(Frame::new(SYNC, &[]))
    }

    fn request_at(&self) -> Option<Nanos> {
        Some(self.next)
    }
}

#[cfg(feature = "recognise")]
impl crate::Recognise for CanopenSyncOptions {}
