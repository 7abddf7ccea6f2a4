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
//! A board that sends no reading after `Timing::attempts` starts is silent too. One that is only
//! listened to has as much time.
//!
//! A family gives a [`Bringup`] its [`Timing`], its start and stop commands, and an [`Inquiry`]:
//! the questions that a board must answer before it is started ([`NoInquiry`] if there are none).
//! One frame is under way at a time. A question or a start command that was not sent is tried again
//! after `Timing::answer_timeout`, and such a question is no attempt: a device does not count as
//! silent because the host's own bus could not send. A stop command is sent once.
//!
//! Its device tells the bring-up of every reading ([`Bringup::reading`]); `family.rs` passes on the
//! calls of [`crate::Device`].

use crate::{Decoded, Frame, Id, Mode, NotSent, Spec, State, Transmit};
use arrayvec::ArrayVec;
use proprio_topics::{Counter, Nanos, Refusal};

/// The questions that a board must answer before it can be started.
pub(crate) trait Inquiry {
    /// Starts again: the board may have been reset or replaced.
    fn begin(&mut self) {}
    /// The next step at `now`. A question counts as sent at `now` until [`Inquiry::sent`] says
    /// otherwise, because its answer may come before that call.
    fn poll(&mut self, now: Nanos) -> Ask {
        let _ = now;
        Ask::Done
    }
    /// The last question was sent at this time, or not at all.
    fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        let _ = outcome;
    }
    /// Time of the next poll; `None`: only a frame can make it advance. Without a question: now.
    fn wake(&self) -> Option<Nanos> {
        Some(Nanos::MIN)
    }
    /// Why the board cannot be used.
    fn refusal(&self) -> Option<Refusal> {
        None
    }
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

impl Inquiry for NoInquiry {}

/// How long the host waits for boards of a family.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Timing {
    /// Silence kept after power-on and before each attempt to wake a silent board; 0: none.
    pub(crate) power_on_silence: Nanos,
    /// Time to wait for an answer before the question is repeated.
    pub(crate) answer_timeout: Nanos,
    /// Number of attempts at that pace; then the board counts as not answering. Also the number of
    /// starts without a reading after which it counts as silent.
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
    /// A command that could not be sent for this long is given up and tried again.
    pub(crate) send_within: Nanos,
}

impl Timing {
    /// Of devices of which nothing else is known: they answer within milliseconds, and one that is
    /// powered later starts within a second, at the cost of a few frames.
    pub(crate) const USUAL: Self = Self {
        power_on_silence: Nanos::ZERO,
        answer_timeout: Nanos::from_millis(20),
        attempts: 15,
        slow_attempt: Nanos::from_millis(500),
        answer_counts: Nanos::from_millis(1000),
        start: Nanos::from_millis(250),
        start_most: Nanos::from_millis(500),
        send_within: Nanos::from_millis(100),
    };

    /// Of devices that send by themselves, or that another program commands. Only the watching
    /// counts: one that was not heard of for a second and a half is silent.
    pub(crate) const LISTENED: Self = Self {
        attempts: 3,
        answer_counts: Nanos::from_millis(100),
        ..Self::USUAL
    };

    /// Of motors that answer each request with a reading. One that was not taken by the bus within
    /// 5 ms is useless.
    pub(crate) const POLLED: Self = Self {
        attempts: 5,
        answer_counts: Nanos::from_millis(100),
        start: Nanos::from_millis(100),
        start_most: Nanos::from_millis(2000),
        send_within: Nanos::from_millis(5),
        ..Self::USUAL
    };
}

/// The pace of one question: it is repeated after `Timing::answer_timeout`, and after
/// `Timing::attempts` times every `Timing::slow_attempt`.
#[derive(Debug)]
pub(crate) struct Attempts {
    timing: Timing,
    /// How often it was sent, at most `Timing::attempts`.
    count: u8,
    /// Earliest time of the next attempt.
    next: Nanos,
    /// Time from the last attempt to the next.
    pause: Nanos,
    /// Answers may still arrive until then.
    counts_until: Nanos,
    /// `count` and `counts_until` before the last attempt.
    before: (u8, Nanos),
}

impl Attempts {
    pub(crate) const fn new(timing: Timing) -> Self {
        Self {
            timing,
            count: 0,
            next: Nanos::MIN,
            pause: Nanos::ZERO,
            counts_until: Nanos::MIN,
            before: (0, Nanos::MIN),
        }
    }

    /// A new question, to be asked at once. Answers to the last one may still arrive.
    pub(crate) const fn begin(&mut self) {
        self.count = 0;
        self.next = Nanos::MIN;
    }

    /// The question is asked at `now`.
    pub(crate) fn ask(&mut self, now: Nanos) {
        self.before = (self.count, self.counts_until);
        self.pause = if self.exhausted() {
            self.timing.slow_attempt
        } else {
            self.count += 1;
            self.timing.answer_timeout
        };
        self.asked(now);
    }

    fn asked(&mut self, t: Nanos) {
        self.next = t + self.pause;
        self.counts_until = t + self.timing.answer_counts;
    }

    /// The time of the last attempt; one that was not sent does not count.
    pub(crate) fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        match outcome {
            Ok(t) => self.asked(t),
            Err(_) => (self.count, self.counts_until) = self.before,
        }
    }

    /// The answer at `t` cannot be used: asks slowly from now on.
    pub(crate) fn slow_down(&mut self, t: Nanos) {
        self.count = self.timing.attempts;
        self.next = t + self.timing.slow_attempt;
    }

    /// The answer cannot be used: asks again at once.
    pub(crate) const fn again(&mut self) {
        self.next = Nanos::MIN;
    }

    /// Whether the board counts as not answering.
    pub(crate) const fn exhausted(&self) -> bool {
        self.count >= self.timing.attempts
    }

    /// Earliest time of the next attempt.
    pub(crate) const fn next(&self) -> Nanos {
        self.next
    }

    /// Answers may arrive until then.
    pub(crate) const fn counted_until(&self) -> Nanos {
        self.counts_until
    }

    /// Whether an answer at `t` may belong to an attempt.
    pub(crate) fn counts(&self, t: Nanos) -> bool {
        t <= self.counts_until
    }
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

/// A frame whose outcome is not known yet.
#[derive(Debug, Clone, Copy, PartialEq)]
struct UnderWay {
    frame: Frame,
    /// If it is not sent, nothing is tried again before this.
    again: Nanos,
}

/// Asks, starts, watches, restarts and stops one board (state machine in the module documentation).
#[derive(Debug)]
pub(crate) struct Bringup {
    mode: Mode,
    max_silence: Nanos,
    timing: Timing,
    start: ArrayVec<Frame, 8>,
    stop: ArrayVec<Frame, 4>,
    /// The stream that is watched, for the faults.
    watched: Id,
    phase: Phase,
    under_way: Option<UnderWay>,
    /// After a frame that was not sent: nothing is asked or started before this.
    hold: Nanos,
    /// Time to the first reading, in addition to the maximum silence, of the next attempt.
    start_wait: Nanos,
    /// Time of the last reading; `None` while the board is silent.
    last: Option<Nanos>,
    silent: bool,
    /// Starts since the last reading, at most `Timing::attempts`: then it counts as silent.
    starts: u8,
    /// Whether a start sequence was begun since the last known power-on.
    begun: bool,
    /// Whether there was a reading: from then on a restart leaves a gap.
    seen: bool,
    /// Readings were lost since the last one.
    gap: bool,
}

impl Bringup {
    pub(crate) fn new(spec: &Spec, mode: Mode, timing: Timing, watched: Id) -> Self {
        Self {
            mode,
            max_silence: spec.max_silence,
            timing,
            start: ArrayVec::new(),
            stop: ArrayVec::new(),
            watched,
            phase: Phase::Fresh,
            under_way: None,
            hold: Nanos::MIN,
            start_wait: timing.start,
            last: None,
            silent: false,
            starts: 0,
            begun: false,
            seen: false,
            gap: false,
        }
    }

    /// Of a motor that is asked for its readings if there is a period of requests, and listened to
    /// otherwise.
    pub(crate) fn polled(spec: &Spec, requests: Option<Nanos>, watched: Id) -> Self {
        match requests {
            Some(_) => Self::new(spec, spec.mode, Timing::POLLED, watched),
            None => Self::new(spec, Mode::Listen, Timing::LISTENED, watched),
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

    /// Changes the maximum silence from now on.
    pub(crate) const fn set_max_silence(&mut self, max_silence: Nanos) {
        self.max_silence = max_silence;
    }

    /// Whether the board is started and nothing is under way: what its device wants to send beside
    /// the bring-up may be sent.
    pub(crate) fn is_idle(&self) -> bool {
        matches!(self.phase, Phase::Watching { .. }) && self.under_way.is_none()
    }

    /// Whether its device may send a request: [`Bringup::is_idle`], of a board that is commanded.
    pub(crate) fn may_lend(&self) -> bool {
        self.mode == Mode::Supervise && self.is_idle()
    }

    /// Whether the board is started, and not about to be started again.
    pub(crate) const fn is_watching(&self) -> bool {
        matches!(self.phase, Phase::Watching { .. })
    }

    /// Sends `frame` of its device at `now`; [`Bringup::on_sent`] must be told of it as of others.
    pub(crate) fn lend(&mut self, frame: Frame, now: Nanos) -> Transmit {
        self.under_way = Some(UnderWay {
            frame,
            again: now + self.timing.answer_timeout,
        });
        self.in_time(frame, now)
    }

    fn in_time(&self, frame: Frame, now: Nanos) -> Transmit {
        Transmit {
            frame,
            deadline: now + self.timing.send_within,
        }
    }

    /// Whether it has been silent for too long.
    pub(crate) const fn is_silent(&self) -> bool {
        self.silent
    }

    /// Whether frames are still processed.
    pub(crate) const fn active(&self) -> bool {
        !matches!(self.phase, Phase::Stopping { .. } | Phase::Stopped)
    }

    /// Records that readings were lost.
    pub(crate) const fn lost(&mut self) {
        self.gap = true;
    }

    /// Records a reading at `t`. Returns whether it is the first after a gap: after a silence, a
    /// restart, or [`Bringup::lost`].
    pub(crate) fn reading(&mut self, t: Nanos) -> bool {
        self.last = Some(t);
        self.seen = true;
        self.starts = 0;
        if let Phase::Waiting { .. } = self.phase {
            // A board that streams has left its bootloader.
            self.phase = Phase::Waiting { until: Nanos::MIN };
        }
        core::mem::take(&mut self.silent) | core::mem::take(&mut self.gap)
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
                self.start_wait = self.timing.start;
                self.phase = Phase::Fresh;
            }
        }
        if self.under_way.is_some() {
            return None;
        }
        let transmit = self.step(now, inquiry, out)?;
        self.under_way = Some(UnderWay {
            frame: transmit.frame,
            again: now + self.timing.answer_timeout,
        });
        Some(transmit)
    }

    /// The next frame to send at `now`, if none is under way.
    fn step(
        &mut self,
        now: Nanos,
        inquiry: &mut impl Inquiry,
        out: &mut Decoded,
    ) -> Option<Transmit> {
        // A turn that begins a wait returns: that wait is over at a later call, whatever the clock
        // says. Every other turn returns or advances to a later phase, so the loop ends.
        loop {
            match self.phase {
                Phase::Fresh if self.mode == Mode::Listen => {
                    let until = if self.silent {
                        Nanos::MAX
                    } else {
                        now + self.timing.power_on_silence + self.listens_for()
                    };
                    self.phase = Phase::Watching { until };
                    return None;
                }
                Phase::Fresh if self.timing.power_on_silence > Nanos::ZERO => {
                    let until = now + self.timing.power_on_silence;
                    self.phase = Phase::Waiting { until };
                    return None;
                }
                Phase::Fresh => self.phase = Phase::Waiting { until: Nanos::MIN },
                Phase::Waiting { until } if now < until => return None,
                Phase::Waiting { .. } => {
                    out.fault(Counter::Starts, 1, self.watched);
                    self.begun = true;
                    inquiry.begin();
                    self.phase = Phase::Asking;
                }
                Phase::Asking | Phase::Starting { .. } if now < self.hold => return None,
                Phase::Asking => match inquiry.poll(now) {
                    Ask::Send(frame) => {
                        return Some(Transmit {
                            frame,
                            deadline: now + self.timing.answer_timeout,
                        });
                    }
                    Ask::Wait => return None,
                    Ask::Done => self.phase = Phase::Starting { next: 0 },
                },
                Phase::Starting { next } => {
                    if let Some(&frame) = self.start.get(next) {
                        return Some(self.in_time(frame, now));
                    }
                    self.phase = Phase::Watching {
                        until: now + self.max_silence + self.start_wait,
                    };
                    self.start_wait = self
                        .timing
                        .start_most
                        .min(self.start_wait + self.start_wait);
                    return None;
                }
                Phase::Watching { until } if self.last.is_some() || now < until => return None,
                Phase::Watching { .. } if self.mode == Mode::Listen => {
                    self.starts = self.timing.attempts;
                    self.phase = Phase::Watching { until: Nanos::MAX };
                    return None;
                }
                Phase::Watching { .. } => {
                    self.starts = self.timing.attempts.min(self.starts.saturating_add(1));
                    self.phase = Phase::Fresh;
                }
                Phase::Stopping { next } => {
                    if let Some(&frame) = self.stop.get(next) {
                        return Some(self.in_time(frame, now));
                    }
                    self.phase = Phase::Stopped;
                }
                Phase::Stopped => return None,
            }
        }
    }

    /// The time that all starts of a silent board take.
    fn listens_for(&self) -> Nanos {
        let start = self.max_silence + self.timing.start_most;
        Nanos(i64::from(self.timing.attempts) * start.0)
    }

    /// Takes the outcome of a frame that [`Bringup::poll`] gave.
    pub(crate) fn on_sent(
        &mut self,
        frame: &Frame,
        outcome: Result<Nanos, NotSent>,
        inquiry: &mut impl Inquiry,
    ) {
        // After a restart a late outcome may concern an earlier frame.
        let Some(under_way) = self.under_way.take_if(|last| last.frame == *frame) else {
            return;
        };
        if outcome.is_err() {
            self.hold = under_way.again;
        }
        match &mut self.phase {
            Phase::Asking => inquiry.sent(outcome),
            Phase::Starting { next } => *next += usize::from(outcome.is_ok()),
            Phase::Stopping { next } if self.stop.get(*next) == Some(frame) => *next += 1,
            _ => {}
        }
    }

    pub(crate) fn next_wake(&self, inquiry: &impl Inquiry) -> Option<Nanos> {
        let silence = self.last.map(|last| last + self.max_silence + Nanos(1));
        let phase = match self.phase {
            // Its outcome is the next event.
            _ if self.under_way.is_some() => None,
            Phase::Fresh | Phase::Stopping { .. } => Some(Nanos::MIN),
            Phase::Starting { .. } => Some(self.hold),
            Phase::Waiting { until } => Some(until),
            Phase::Asking => inquiry.wake().map(|wake| wake.max(self.hold)),
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
            _ if self.silent || self.starts >= self.timing.attempts => State::Silent,
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
            || (waiting && self.timing.power_on_silence > Nanos::ZERO);
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
            self.under_way = None;
            self.hold = Nanos::MIN;
            self.start_wait = self.timing.start;
            self.last = None;
            self.silent = false;
            self.starts = 0;
            self.gap |= self.seen;
        }
    }
}
