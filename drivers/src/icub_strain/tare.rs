//! The host's side of a tare: the command, and reading back what the board adds from then on.

use crate::bringup::Attempts;
use crate::icub::{self, class, command};
use crate::{COMMAND_TIME, CommandFailed, Decoded, Frame, NotSent};
use proprio_topics::{Counter, Nanos};

/// The mode of SET_CURR_TARE that takes minus the present force and torque of every axis.
pub(super) const MINUS_PRESENT: u8 = 1;

/// What a tare has read back: steps of the stream per axis.
pub(super) type Counts = [i16; 6];

#[derive(Debug, Clone, Copy, PartialEq)]
enum Step {
    Idle,
    /// The command is to be sent, or on its way.
    Commanding,
    /// The command was sent; the axis of the current question.
    Confirming {
        axis: u8,
    },
}

/// A tare. The command is sent once; the questions after it are repeated at the pace of those of
/// the bring-up.
#[derive(Debug)]
pub(super) struct Tare {
    address: u8,
    step: Step,
    /// Given up after this.
    limit: Nanos,
    attempts: Attempts,
    under_way: Option<Frame>,
    /// Questions per axis whose answers may still arrive.
    open: [u8; 6],
    counts: Counts,
    /// Whether the next reading may be the first with the new zero.
    may_step: bool,
    outcome: Option<Result<Counts, CommandFailed>>,
}

impl Tare {
    pub(super) const fn new(address: u8) -> Self {
        Self {
            address,
            step: Step::Idle,
            limit: Nanos::MIN,
            attempts: Attempts::new(icub::TIMING),
            under_way: None,
            open: [0; 6],
            counts: [0; 6],
            may_step: false,
            outcome: None,
        }
    }

    /// Whether one has begun and its outcome has not been taken.
    pub(super) const fn is_open(&self) -> bool {
        !matches!(self.step, Step::Idle) || self.outcome.is_some()
    }

    /// Whether this reading may be the first with the new zero: each one from the command to the
    /// end of the tare, and the next.
    pub(super) fn take_step(&mut self) -> bool {
        core::mem::take(&mut self.may_step) || matches!(self.step, Step::Confirming { .. })
    }

    pub(super) fn begin(&mut self, now: Nanos) {
        self.step = Step::Commanding;
        self.limit = now + COMMAND_TIME;
        self.open = [0; 6];
    }

    fn command(&self) -> Frame {
        let id = icub::to_board(class::POLLING_ANALOG, self.address);
        Frame::new(id, &[command::SET_CURR_TARE, MINUS_PRESENT])
    }

    /// The next frame to send at `now`.
    pub(super) fn poll(&mut self, now: Nanos) -> Option<Frame> {
        if self.step == Step::Idle || self.under_way.is_some() {
            return None;
        }
        if now > self.limit {
            self.give_up(CommandFailed::NoAnswer);
            return None;
        }
        self.under_way = match self.step {
            Step::Confirming { axis } if now >= self.attempts.next() => {
                self.attempts.ask(now);
                if let Some(open) = self.open.get_mut(usize::from(axis)) {
                    *open = open.saturating_add(1);
                }
                let id = icub::to_board(class::POLLING_ANALOG, self.address);
                Some(Frame::new(id, &[command::GET_CURR_TARE, axis]))
            }
            Step::Commanding => Some(self.command()),
            Step::Confirming { .. } | Step::Idle => None,
        };
        self.under_way
    }

    /// Takes the outcome of a frame that [`Tare::poll`] gave.
    pub(super) fn sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        if self.under_way.take_if(|last| last == frame).is_none() {
            return;
        }
        let commanded = *frame == self.command();
        // A command that was given up on its way takes effect, too.
        self.may_step |= commanded && outcome.is_ok();
        match (self.step, frame.data()) {
            (Step::Commanding, _) if commanded && outcome.is_ok() => {
                self.step = Step::Confirming { axis: 0 };
                self.attempts.begin();
            }
            (Step::Commanding, _) if commanded => self.end(Err(CommandFailed::NotSent)),
            (Step::Confirming { axis }, &[_, asked]) if !commanded => {
                // If the answer is here already, the next question is another one.
                if asked == axis {
                    self.attempts.sent(outcome);
                }
                if outcome.is_err()
                    && let Some(open) = self.open.get_mut(usize::from(asked))
                {
                    *open = open.saturating_sub(1);
                }
            }
            _ => {}
        }
    }

    /// Takes an answer of the board: `[16, axis, high, low]`.
    pub(super) fn answer(&mut self, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let &[_, channel, high, low] = data else {
            out.fault(Counter::Length, 1, frame.id);
            return;
        };
        let at = usize::from(channel);
        let (Some(open), Some(count)) = (self.open.get_mut(at), self.counts.get_mut(at)) else {
            out.fault(Counter::Value, 1, frame.id);
            return;
        };
        if *open == 0 {
            out.fault(Counter::Unexpected, 1, frame.id);
            return;
        }
        *open -= 1;
        let Step::Confirming { axis } = &mut self.step else {
            return;
        };
        if channel != *axis {
            return;
        }
        *count = i16::from_be_bytes([high, low]);
        *axis += 1;
        self.attempts.begin();
        if *axis > 5 {
            self.end(Ok(self.counts));
        }
    }

    /// Ends it, if it is under way: the device is started again or stopped.
    pub(super) fn interrupt(&mut self) {
        self.give_up(CommandFailed::Interrupted);
    }

    fn give_up(&mut self, why: CommandFailed) {
        match self.step {
            Step::Idle => {}
            Step::Commanding if self.under_way.is_none() => self.end(Err(CommandFailed::NotSent)),
            Step::Commanding | Step::Confirming { .. } => self.end(Err(why)),
        }
    }

    fn end(&mut self, outcome: Result<Counts, CommandFailed>) {
        self.may_step |= matches!(self.step, Step::Confirming { .. });
        self.step = Step::Idle;
        self.outcome = Some(outcome);
    }

    pub(super) fn outcome(&mut self) -> Option<Result<Counts, CommandFailed>> {
        self.outcome.take()
    }

    /// Time of the next poll.
    pub(super) fn wake(&self) -> Option<Nanos> {
        match self.step {
            _ if self.under_way.is_some() => None,
            Step::Idle => None,
            Step::Commanding => Some(Nanos::MIN),
            Step::Confirming { .. } => Some(self.attempts.next().min(self.limit + Nanos(1))),
        }
    }
}
