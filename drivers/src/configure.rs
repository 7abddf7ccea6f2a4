//! Sends a board its configuration, reads it back, and repeats it until both agree: for boards that
//! do not acknowledge a configuration.

use crate::bringup::{Ask, Attempts, Inquiry, Timing};
use crate::received::Received;
use crate::{Frame, Mode, NotSent, Spec};
use core::ops::Range;
use proprio_topics::{Counter, Nanos, Refusal};

/// A board's configuration in its protocol.
#[derive(Debug)]
pub(crate) struct Setting {
    /// The command that sets it.
    pub(crate) set: Frame,
    /// The question for it. The answer has the form of `set`.
    pub(crate) get: Frame,
    /// The bytes of `set` and of the answer that must agree.
    pub(crate) compared: Range<usize>,
}

/// An [`Inquiry`] that sets, asks and compares. It ends when the board confirms its configuration,
/// and also when it does not answer (old firmware) or never agrees (counted as changed).
#[derive(Debug)]
pub(crate) struct Configure {
    setting: Option<Setting>,
    attempts: Attempts,
    /// `set` is sent, and `get` follows.
    told: bool,
    settled: bool,
    confirmed: bool,
}

impl Configure {
    /// Sends `setting`. If it is `None`, the board keeps its own, and in [`Mode::Listen`] another
    /// program sets it: there is nothing to confirm.
    pub(crate) fn new(spec: &Spec, setting: Option<Setting>, timing: Timing) -> Self {
        let setting = setting.filter(|_| spec.mode == Mode::Supervise);
        Self {
            settled: setting.is_none(),
            confirmed: setting.is_none(),
            setting,
            attempts: Attempts::new(timing),
            told: false,
        }
    }

    /// Whether the board has the configuration that was set since its last start.
    pub(crate) const fn confirmed(&self) -> bool {
        self.confirmed
    }

    /// Takes the board's answer in `frame`.
    pub(crate) fn answer(&mut self, data: &[u8], frame: &mut Received<'_>) {
        let Some(setting) = &self.setting else {
            return;
        };
        if data.len() != setting.set.len() {
            return frame.fault(Counter::Length);
        }
        if !self.attempts.counts(frame.t) {
            return frame.fault(Counter::Unexpected);
        }
        let compared = &setting.compared;
        let agrees = data.get(compared.clone()) == setting.set.data().get(compared.clone());
        if self.settled {
            // A late answer to an earlier question.
            self.confirmed |= agrees;
            return;
        }
        self.confirmed = agrees;
        self.settled = agrees || self.attempts.exhausted();
        if !agrees {
            self.told = false;
            self.attempts.again();
            if self.settled {
                frame.fault(Counter::Changed);
            }
        }
    }
}

impl Inquiry for Configure {
    fn begin(&mut self) {
        self.settled = self.setting.is_none();
        self.confirmed = self.settled;
        self.told = false;
        self.attempts.begin();
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        let Some(setting) = self.setting.as_ref().filter(|_| !self.settled) else {
            return Ask::Done;
        };
        if now < self.attempts.next() {
            return Ask::Wait;
        }
        if self.told {
            self.told = false;
            self.attempts.ask(now);
            return Ask::Send(setting.get);
        }
        if self.attempts.exhausted() {
            self.settled = true;
            return Ask::Done;
        }
        self.told = true;
        Ask::Send(setting.set)
    }

    fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        if self.told {
            self.told = outcome.is_ok();
        } else {
            // A question that was not sent is asked again, without a second `set`.
            self.told = outcome.is_err();
            self.attempts.sent(outcome);
        }
    }

    fn wake(&self) -> Option<Nanos> {
        Some(self.attempts.next())
    }

    fn refusal(&self) -> Option<Refusal> {
        None
    }
}
