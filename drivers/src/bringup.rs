//! Asks, starts, watches, restarts and stops one board: the part of a [`crate::Device`] that any
//! family with a bring-up shares.
//!
//! ```text
//! Waiting --power_on_silence--> Asking --answers--> Starting --first reading--> Streaming
//!                                 ^                    |                          | (2)
//!                                 |                    v (1)                      v
//!                                 +--------------------+<----------------------- Silent
//! ```
//! (1) No reading: again, doubling the wait. (2) No reading for `max_silence`: counted once.
//!
//! A family gives a [`Bringup`] its [`Patience`], its start and stop commands, and an [`Inquiry`]:
//! the questions that a board must answer before it is started ([`NoInquiry`] if there are none).
//! Its device tells the bring-up of every reading ([`Bringup::reading`]) and passes on the calls of
//! [`crate::Device`].

use crate::{Decoded, Frame, Id, Mode, Spec, State, Transmit};
use arrayvec::ArrayVec;
use proprio_topics::{Counter, Nanos, Refusal};

/// The questions that a board must answer before it can be started.
pub(crate) trait Inquiry {
    /// Starts again: the board may have been reset or replaced.
    fn begin(&mut self);
    /// The next step at `now`.
    fn poll(&mut self, now: Nanos) -> Ask;
    /// Time of the next poll.
    fn wake(&self) -> Option<Nanos>;
    /// Why the board cannot be used.
    fn refusal(&self) -> Option<Refusal>;
}

/// The next step of an [`Inquiry`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Ask {
    /// Send this question.
    Send(Frame),
    /// Wait for the answer.
    Wait,
    /// All questions are answered.
    Done,
}

/// An inquiry without questions.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NoInquiry;

impl Inquiry for NoInquiry {
    fn begin(&mut self) {}
    fn poll(&mut self, _now: Nanos) -> Ask {
        Ask::Done
    }
    fn wake(&self) -> Option<Nanos> {
        None
    }
    fn refusal(&self) -> Option<Refusal> {
        None
    }
}

/// How long the host waits for boards of a family.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Patience {
    /// Silence kept after power-on and before each attempt to wake a silent board; 0: none.
    pub(crate) power_on_silence: Nanos,
    /// Time to wait for an answer before the question is repeated.
    pub(crate) answer_timeout: Nanos,
    /// Number of attempts at that pace; then the board counts as not answering.
    pub(crate) attempts: u8,
    /// Interval between attempts after that.
    pub(crate) slow_attempt: Nanos,
    /// How long after a question its answer is accepted: a slow board answers the first attempt
    /// after the second was sent.
    pub(crate) answer_counts: Nanos,
    /// Time from start to first reading, in addition to the maximum silence; doubled with each
    /// attempt up to `start_most`.
    pub(crate) start: Nanos,
    /// The longest time between two attempts to start.
    pub(crate) start_most: Nanos,
    /// A command that could not be sent for this long is dropped; the next attempt sends it again.
    pub(crate) send_within: Nanos,
}

/// The phase of the bring-up.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Phase {
    /// Not begun.
    Fresh,
    /// Keeping silent.
    Waiting { until: Nanos },
    /// Asking.
    Asking,
    /// Sending the start commands.
    Starting { next: usize },
    /// All start commands sent; repeated if no reading arrives.
    Watching { until: Nanos },
    /// Sending the stop commands.
    Stopping { next: usize },
    /// Done.
    Stopped,
}

/// Asks, starts, watches, restarts and stops one board (state machine in the module documentation).
#[derive(Debug)]
pub(crate) struct Bringup {
    mode: Mode,
    max_silence: Nanos,
    patience: Patience,
    start: ArrayVec<Frame, 8>,
    stop: ArrayVec<Frame, 4>,
    /// The stream that is watched, for the faults.
    watched: Id,
    phase: Phase,
    /// Time to the first reading, in addition to the maximum silence, of the next attempt.
    start_patience: Nanos,
    /// Time of the last reading; `None` while the board is silent.
    last: Option<Nanos>,
    silent: bool,
    /// Whether a start sequence was begun since the last known power-on.
    begun: bool,
}

impl Bringup {
    pub(crate) fn new(spec: &Spec, mode: Mode, patience: Patience, watched: Id) -> Self {
        Self {
            mode,
            max_silence: spec.max_silence,
            patience,
            start: ArrayVec::new(),
            stop: ArrayVec::new(),
            watched,
            phase: Phase::Fresh,
            start_patience: patience.start,
            last: None,
            silent: false,
            begun: false,
        }
    }

    /// Adds a start command.
    pub(crate) fn start_with(&mut self, id: Id, data: &[u8]) {
        let fits = self.start.try_push(Frame::new(id, data));
        debug_assert!(
            fits.is_ok(),
            "no family here has more than 8 start commands"
        );
    }

    /// Adds a stop command.
    pub(crate) fn stop_with(&mut self, id: Id, data: &[u8]) {
        let fits = self.stop.try_push(Frame::new(id, data));
        debug_assert!(fits.is_ok(), "no family here has more than 4 stop commands");
    }

    pub(crate) const fn mode(&self) -> Mode {
        self.mode
    }

    /// Whether it has been silent for too long.
    pub(crate) const fn is_silent(&self) -> bool {
        self.silent
    }

    /// Whether frames are still processed.
    pub(crate) const fn active(&self) -> bool {
        !matches!(self.phase, Phase::Stopping { .. } | Phase::Stopped)
    }

    /// Records a reading at `t`. Returns whether it is the first after a silence.
    pub(crate) fn reading(&mut self, t: Nanos) -> bool {
        self.last = Some(t);
        if let Phase::Waiting { .. } = self.phase {
            // A board that streams has left its bootloader.
            self.phase = Phase::Waiting { until: Nanos::MIN };
        }
        core::mem::take(&mut self.silent)
    }

    pub(crate) fn poll(
        &mut self,
        now: Nanos,
        inquiry: &mut impl Inquiry,
        out: &mut Decoded,
    ) -> Option<Transmit> {
        if self.active()
            && let Some(last) = self.last
            && now - last > self.max_silence
        {
            self.last = None;
            self.silent = true;
            out.fault(Counter::Silences, 1, self.watched);
            if matches!(self.phase, Phase::Watching { .. }) {
                self.start_patience = self.patience.start;
                self.phase = Phase::Fresh;
            }
        }
        // Each turn returns or advances to a later phase, so the loop ends.
        loop {
            match self.phase {
                Phase::Fresh if self.mode == Mode::Listen => {
                    self.phase = Phase::Watching { until: Nanos::MAX }
                }
                Phase::Fresh => {
                    let until = if self.patience.power_on_silence > Nanos::ZERO {
                        now + self.patience.power_on_silence
                    } else {
                        Nanos::MIN
                    };
                    self.phase = Phase::Waiting { until };
                }
                Phase::Waiting { until } if now < until => return None,
                Phase::Waiting { .. } => {
                    out.fault(Counter::Starts, 1, self.watched);
                    self.begun = true;
                    inquiry.begin();
                    self.phase = Phase::Asking;
                }
                Phase::Asking => match inquiry.poll(now) {
                    Ask::Send(frame) => {
                        return Some(Transmit {
                            frame,
                            deadline: now + self.patience.answer_timeout,
                        });
                    }
                    Ask::Wait => return None,
                    Ask::Done => self.phase = Phase::Starting { next: 0 },
                },
                Phase::Starting { next } => {
                    if let Some(&frame) = self.start.get(next) {
                        self.phase = Phase::Starting { next: next + 1 };
                        return Some(Transmit {
                            frame,
                            deadline: now + self.patience.send_within,
                        });
                    }
                    self.phase = Phase::Watching {
                        until: now + self.max_silence + self.start_patience,
                    };
                    self.start_patience = self
                        .patience
                        .start_most
                        .min(self.start_patience + self.start_patience);
                    return None;
                }
                Phase::Watching { until } if self.last.is_some() || now < until => return None,
                Phase::Watching { .. } if self.mode == Mode::Listen => return None,
                Phase::Watching { .. } => self.phase = Phase::Fresh,
                Phase::Stopping { next } => {
                    if let Some(&frame) = self.stop.get(next) {
                        self.phase = Phase::Stopping { next: next + 1 };
                        return Some(Transmit {
                            frame,
                            deadline: now + self.patience.send_within,
                        });
                    }
                    self.phase = Phase::Stopped;
                }
                Phase::Stopped => return None,
            }
        }
    }

    pub(crate) fn next_wake(&self, inquiry: &impl Inquiry) -> Option<Nanos> {
        let silence = self.last.map(|last| last + self.max_silence + Nanos(1));
        let phase = match self.phase {
            Phase::Fresh | Phase::Starting { .. } | Phase::Stopping { .. } => Some(Nanos::MIN),
            Phase::Waiting { until } => Some(until),
            Phase::Asking => inquiry.wake(),
            Phase::Watching { until } => {
                (self.last.is_none() && until < Nanos::MAX).then_some(until)
            }
            Phase::Stopped => return None,
        };
        match (silence, phase) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }

    pub(crate) fn state(&self, inquiry: &impl Inquiry) -> State {
        if self.phase == Phase::Stopped {
            return State::Stopped;
        }
        if let Some(refusal) = inquiry.refusal() {
            return State::Refused(refusal);
        }
        match self.phase {
            _ if self.last.is_some() => State::Streaming,
            _ if self.silent => State::Silent,
            Phase::Fresh if self.mode == Mode::Listen => State::Starting,
            Phase::Fresh | Phase::Waiting { .. } => State::Waiting,
            Phase::Asking => State::Asking,
            Phase::Starting { .. }
            | Phase::Watching { .. }
            | Phase::Stopping { .. }
            | Phase::Stopped => State::Starting,
        }
    }

    pub(crate) fn stop(&mut self) {
        // Sends nothing while the bus must be silent, or to a board that another program commands.
        let waiting = matches!(self.phase, Phase::Fresh | Phase::Waiting { .. });
        let quiet = self.mode == Mode::Listen
            || !self.begun
            || (waiting && self.patience.power_on_silence > Nanos::ZERO);
        if self.active() {
            self.phase = if quiet {
                Phase::Stopped
            } else {
                Phase::Stopping { next: 0 }
            };
        }
        self.last = None;
    }

    pub(crate) fn restart(&mut self) {
        if self.active() {
            self.phase = Phase::Fresh;
            self.start_patience = self.patience.start;
            self.last = None;
            self.silent = false;
        }
    }
}
