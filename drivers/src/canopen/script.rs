//! The start of a node: a list of SDO transfers, one at a time, each repeated until it is answered.

use super::protocol::{NMT, Object, TIMING, sdo_to};
use crate::bringup::{Ask, Attempts, Inquiry};
use crate::bytes::{u16_le, u32_le};
use crate::received::Received;
use crate::{Frame, Mode, NotSent};
use proprio_topics::{Counter, Nanos, Refusal};

/// One step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum ScriptStep {
    /// An NMT command, which is not answered.
    Nmt(u8),
    /// Read an entry.
    Read(Object),
    /// Write the `bytes` low bytes of `value`.
    Write {
        object: Object,
        value: u32,
        bytes: u8,
    },
}

/// What a family does at the start of a node.
pub(crate) trait StartPlan: Send {
    /// The step number `at`; `None`: it is not needed.
    fn step(&self, at: usize) -> Option<ScriptStep>;

    /// The number of steps.
    fn steps(&self) -> usize;

    /// Takes the value that was read, or that the node has written (`None`); or why the node
    /// refuses the step: the abort code. In [`Mode::Listen`], what it answers to another program,
    /// and the value that the other program has written.
    ///
    /// # Errors
    /// Why the node cannot be used.
    fn take(&mut self, object: Object, answer: Result<Option<u32>, u32>) -> Result<(), Refusal>;

    /// Whether all is known that readings need.
    ///
    /// # Errors
    /// What is missing.
    fn ready(&self) -> Result<(), Refusal>;

    /// It starts from the beginning.
    fn begin(&mut self);
}

/// An [`Inquiry`] that follows a [`StartPlan`].
#[derive(Debug)]
pub(crate) struct Script<P> {
    node: u8,
    mode: Mode,
    pub(crate) plan: P,
    at: usize,
    /// The step needs no answer, and was sent.
    told: bool,
    attempts: Attempts,
    refusal: Option<Refusal>,
    /// What another program writes, until the node confirms it.
    writes: Option<(Object, u32)>,
}

/// Bytes of an SDO command: the low bits are the number of unused bytes, and that it is stated.
pub(crate) const READ: u8 = 0x40;
const WRITE: u8 = 0x23;
const WRITTEN: u8 = 0x60;
const ABORT: u8 = 0x80;
const UPLOAD: u8 = 0x43;
/// The number of unused bytes.
const UNUSED: u8 = 0b1100;

impl<P: StartPlan> Script<P> {
    pub(crate) fn new(node: u8, mode: Mode, plan: P) -> Self {
        Self {
            node,
            mode,
            plan,
            at: 0,
            told: false,
            attempts: Attempts::new(TIMING),
            refusal: None,
            writes: None,
        }
    }

    /// A reading came, and what it needs was not overheard ([`StartPlan::ready`]).
    pub(crate) fn missed(&mut self) {
        if self.mode == Mode::Listen
            && let Err(refusal) = self.plan.ready()
        {
            self.refusal.get_or_insert(refusal);
        }
    }

    /// Takes an SDO frame of another program to the node. In [`Mode::Listen`] its writes in one
    /// frame are of interest; else the node answers the host alone.
    pub(crate) fn overhear(&mut self, data: &[u8]) {
        const KIND: u8 = 0b1110_0010;
        self.writes = None;
        if self.mode == Mode::Listen
            && let &[command, _, _, sub, ..] = data
            && data.len() == 8
            && command & KIND == 0x22
        {
            let unused = if command & 1 == 1 {
                u32::from(command & UNUSED) * 2
            } else {
                0
            };
            let value = u32_le(data, 4) & u32::MAX >> unused;
            self.writes = Some((Object::new(u16_le(data, 1), sub), value));
        }
    }

    fn current(&self) -> Option<ScriptStep> {
        self.plan.step(self.at)
    }

    /// Takes an SDO frame of the node.
    pub(crate) fn answer(&mut self, data: &[u8], frame: &mut Received<'_>) {
        let &[command, _, _, sub, ..] = data else {
            return frame.fault(Counter::Length);
        };
        if data.len() != 8 {
            return frame.fault(Counter::Length);
        }
        let object = Object::new(u16_le(data, 1), sub);
        let value = u32_le(data, 4);
        let answer = match command {
            // A write that is refused changes nothing.
            ABORT if self.writes.take().is_some_and(|(to, _)| to == object) => return,
            ABORT => Err(value),
            WRITTEN => {
                let written = self.writes.take().filter(|(to, _)| *to == object);
                Ok(written.map(|(_, value)| value))
            }
            _ if command & !UNUSED == UPLOAD => {
                let unused = u32::from(command & UNUSED) * 2;
                Ok(Some(value & u32::MAX >> unused))
            }
            // Without its size.
            0x42 => Ok(Some(value)),
            // Segments of longer entries, for another program.
            _ => return,
        };
        if self.mode == Mode::Supervise {
            let mine = match self.current() {
                Some(ScriptStep::Read(asked)) => asked == object && answer != Ok(None),
                Some(ScriptStep::Write { object: asked, .. }) => {
                    asked == object && !matches!(answer, Ok(Some(_)))
                }
                _ => false,
            };
            // Another program may use the same channel.
            if !mine || !self.attempts.counts(frame.t) {
                return;
            }
        }
        match self.plan.take(object, answer) {
            Ok(()) => {
                self.refusal = None;
                if self.mode == Mode::Supervise {
                    self.next();
                }
            }
            Err(refusal) => {
                frame.fault(Counter::Value);
                self.refusal = Some(refusal);
                self.attempts.slow_down(frame.t);
            }
        }
    }

    fn next(&mut self) {
        self.at += 1;
        self.told = false;
        self.attempts.begin();
    }
}

impl<P: StartPlan> Inquiry for Script<P> {
    fn begin(&mut self) {
        self.at = 0;
        self.told = false;
        self.attempts.begin();
        self.plan.begin();
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        while self.at < self.plan.steps() && (self.told || self.current().is_none()) {
            self.next();
        }
        if self.at >= self.plan.steps() {
            let Err(refusal) = self.plan.ready() else {
                return Ask::Done;
            };
            // Again from the beginning, slowly: somebody may set the node up.
            self.refusal = Some(refusal);
            self.begin();
            self.attempts.slow_down(now);
        }
        let Some(step) = self.current() else {
            return Ask::Wait;
        };
        if now < self.attempts.next() {
            return Ask::Wait;
        }
        if self.attempts.exhausted() {
            self.refusal.get_or_insert(Refusal::NoAnswer);
        }
        self.attempts.ask(now);
        let command = |command, object: Object, value: u32| {
            let ([low, high], [a, b, c, d]) = (object.index.to_le_bytes(), value.to_le_bytes());
            let data = [command, low, high, object.sub, a, b, c, d];
            Ask::Send(Frame::new(sdo_to(self.node), &data))
        };
        match step {
            ScriptStep::Nmt(command) => {
                self.told = true;
                Ask::Send(Frame::new(NMT, &[command, self.node]))
            }
            ScriptStep::Read(object) => command(READ, object, 0),
            ScriptStep::Write {
                object,
                value,
                bytes,
            } => {
                let unused = 4_u8.saturating_sub(bytes.clamp(1, 4));
                command(WRITE | unused << 2, object, value)
            }
        }
    }

    fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        self.told &= outcome.is_ok();
        self.attempts.sent(outcome);
    }

    fn wake(&self) -> Option<Nanos> {
        Some(if self.told {
            Nanos::MIN
        } else {
            self.attempts.next()
        })
    }

    fn refusal(&self) -> Option<Refusal> {
        self.refusal
    }
}
