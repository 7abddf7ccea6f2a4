//! The ends of a motor's ranges: of the keys, as the motor tells them, or of its model.

use super::frames::{RANGES, READ, question};
use super::options::DamiaoKeys;
use crate::bringup::{Ask, Attempts, Inquiry, Timing};
use crate::mit::{self, Scale};
use crate::received::Received;
use crate::{Mode, NotSent};
use proprio_topics::{Counter, Nanos, Refusal};

/// Asks a motor for the ranges that no key states.
#[derive(Debug)]
pub(super) struct Ranges {
    keys: DamiaoKeys,
    mode: Mode,
    /// As the motor has told them.
    told: [Option<f64>; 3],
    /// Which of [`RANGES`] is asked.
    next: usize,
    attempts: Attempts,
}

impl Ranges {
    pub(super) const fn new(keys: DamiaoKeys, mode: Mode) -> Self {
        Self {
            keys,
            mode,
            told: [None; 3],
            next: 0,
            attempts: Attempts::new(Timing::POLLED),
        }
    }

    /// The end of range `index`, if it is known.
    fn end(&self, index: usize) -> Option<f64> {
        let end = |ends: &[Option<f64>; 3]| ends.get(index).copied().flatten();
        end(&self.keys.stated)
            .or_else(|| end(&self.told))
            .or_else(|| end(&self.keys.of_model))
    }

    /// Position, velocity and torque, if all are known.
    pub(super) fn scales(&self) -> Option<[Scale; 3]> {
        Some(mit::scales([self.end(0)?, self.end(1)?, self.end(2)?]))
    }

    /// The motor has told the value of a register in `frame`.
    pub(super) fn answer(&mut self, register: u8, value: f32, frame: &mut Received<'_>) {
        let Some(index) = RANGES.iter().position(|range| *range == register) else {
            // Another program's question.
            return;
        };
        if !(value > 0.0 && value.is_finite()) {
            return frame.fault(Counter::Value);
        }
        let value = f64::from(value);
        let before = self
            .told
            .get_mut(index)
            .and_then(|told| told.replace(value));
        if before.is_some_and(|told| told != value) {
            frame.fault(Counter::Changed);
        }
        if index == self.next && self.mode == Mode::Supervise {
            self.next += 1;
            self.attempts.begin();
        }
    }

    /// The next range to ask for, from `index` on.
    fn unstated(&self, index: usize) -> usize {
        let later = self.keys.stated.iter().skip(index);
        index + later.take_while(|stated| stated.is_some()).count()
    }
}

impl Inquiry for Ranges {
    fn begin(&mut self) {
        self.next = 0;
        self.attempts.begin();
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        self.next = self.unstated(self.next);
        // Old firmware does not answer.
        if self.attempts.exhausted() && self.scales().is_some() && now >= self.attempts.next() {
            self.next = RANGES.len();
        }
        let Some(register) = RANGES.get(self.next) else {
            return Ask::Done;
        };
        if now < self.attempts.next() {
            return Ask::Wait;
        }
        self.attempts.ask(now);
        Ask::Send(question(self.keys.address, self.keys.fd, READ, *register))
    }

    fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        self.attempts.sent(outcome);
    }

    fn wake(&self) -> Option<Nanos> {
        Some(self.attempts.next())
    }

    fn refusal(&self) -> Option<Refusal> {
        let waits = self.attempts.exhausted() && self.scales().is_none();
        waits.then_some(Refusal::NoAnswer)
    }
}
