//! The host's side of a device: what its family has of its own ([`Family`]), and what all families
//! share ([`Supervised`]).
//!
//! A family decodes its frames. Its boards' bring-up, silence and restarts are those of
//! `bringup.rs`, which needs their start and stop commands and the questions that they must answer.
//! A family whose boards do not stream also says when to ask for the next reading.

use crate::bringup::{Bringup, Inquiry, NoInquiry};
use crate::received::Received;
use crate::{
    Claim, Command, CommandFailed, CommandOutcome, CommandRefused, Decoded, Device, Frame, Mode,
    NotSent, StampedReading, State, Transmit,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, JointState, Nanos, Quality, Reading, Refusal};

/// What the host's side of a family has of its own.
pub(crate) trait Family: Send {
    /// What a board is asked before it is started.
    type Questions: Inquiry + Send;

    /// As [`Device::on_frame`], until the board is stopped.
    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<Self::Questions>);

    /// The board was silent, or may have been reset: an incomplete reading stays incomplete.
    fn reset(&mut self) {}

    /// A frame for a board that is started, if one is due: a request for a reading, for example.
    fn request(
        &mut self,
        now: Nanos,
        session: &mut Session<Self::Questions>,
        out: &mut Decoded,
    ) -> Option<Frame> {
        let _ = (now, session, out);
        None
    }

    /// When the next one is due.
    fn request_at(&self) -> Option<Nanos> {
        None
    }

    /// What became of a frame, of the bring-up's too.
    fn on_sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        let _ = (frame, outcome);
    }

    /// The board is not started: requests are not sent, and their answers do not come.
    fn interrupt(&mut self) {}

    /// As [`Device::lacks`].
    fn lacks(&self) -> Option<Refusal> {
        None
    }

    /// As [`Device::full_scale`].
    fn full_scale(&self, session: &Session<Self::Questions>) -> Option<[f64; 6]> {
        let _ = session;
        None
    }

    /// As [`Device::command`].
    fn command(
        &mut self,
        command: Command,
        now: Nanos,
        session: &Session<Self::Questions>,
    ) -> Result<(), CommandRefused> {
        let _ = (command, now, session);
        Err(CommandRefused::Unsupported)
    }

    /// As [`Device::outcome`].
    fn outcome(
        &mut self,
        session: &Session<Self::Questions>,
    ) -> Option<Result<CommandOutcome, CommandFailed>> {
        let _ = session;
        None
    }
}

/// When the next periodic request is due, after one that was due at `due` (MIN: there was none) and
/// left at `now`: in step with it; those that were missed are left out.
pub(crate) fn next_in_step(due: Nanos, period: Nanos, now: Nanos) -> Nanos {
    if due == Nanos::MIN {
        return now + period;
    }
    let passed = (now - due).0.max(0) / period.0.max(1);
    due + Nanos(period.0.saturating_mul(passed + 1))
}

/// Questions that are asked one after another, in rounds; without a period, none is.
#[derive(Debug)]
pub(crate) struct Rounds {
    period: Option<Nanos>,
    /// The place of the next question in its round, and when that round is due.
    next: usize,
    due: Nanos,
}

impl Rounds {
    pub(crate) const fn new(period: Option<Nanos>) -> Self {
        Self {
            period,
            next: 0,
            due: Nanos::MIN,
        }
    }

    /// The next of `questions`, those of a round, if it is due at `now`.
    pub(crate) fn ask<T: Copy>(&mut self, questions: &[T], now: Nanos) -> Option<T> {
        let period = self.period.filter(|_| now >= self.due)?;
        let question = *questions.get(self.next)?;
        self.next += 1;
        if self.next == questions.len() {
            self.next = 0;
            self.due = next_in_step(self.due, period, now);
        }
        Some(question)
    }

    /// When the next question is due.
    pub(crate) fn due(&self) -> Option<Nanos> {
        self.period.map(|_| self.due)
    }
}

/// The quality of readings with these faults, of which those in `position` make the position
/// doubtful.
pub(crate) fn quality_of(faults: u32, position: u32) -> Quality {
    let mut quality = Quality::GOOD;
    if faults & position != 0 {
        quality |= Quality::DEVICE_FAULT;
    }
    if faults & !position != 0 {
        quality |= Quality::DRIVE_FAULT;
    }
    quality
}

/// The session with a board: its bring-up, and what it has been asked.
#[derive(Debug)]
pub(crate) struct Session<Q = NoInquiry> {
    pub(crate) bringup: Bringup,
    pub(crate) questions: Q,
}

impl<Q: Inquiry> Session<Q> {
    pub(crate) fn state(&self) -> State {
        self.bringup.state(&self.questions)
    }

    /// Adds the joint's state in `frame`, and counts the faults in `quality`.
    pub(crate) fn joint(
        &mut self,
        output: u8,
        frame: &mut Received<'_>,
        quality: Quality,
        state: JointState,
    ) {
        let reading = Reading::Joint(state);
        let stamped = StampedReading::new(output, frame, quality, reading);
        self.add(stamped, frame);
    }

    /// Adds a main reading that `frame` completes, counts the faults in its quality, and marks the
    /// first one after a gap.
    pub(crate) fn add(&mut self, mut stamped: StampedReading, frame: &mut Received<'_>) {
        frame.faults_in(stamped.quality);
        if self.bringup.reading(frame.t) {
            stamped.quality |= Quality::GAP_BEFORE;
        }
        frame.push(stamped);
    }

    /// Readings were lost: they are counted, and the next one is marked.
    pub(crate) fn lost(&mut self, counter: Counter, count: u32, frame: &mut Received<'_>) {
        if count > 0 {
            self.bringup.lost();
            frame.faults(counter, count);
        }
    }

    /// Whether a command can be sent to the board now.
    pub(crate) fn takes_command(&self) -> Result<(), CommandRefused> {
        if self.bringup.mode() == Mode::Listen {
            Err(CommandRefused::ListenOnly)
        } else if self.state() != State::Streaming {
            Err(CommandRefused::NotStreaming)
        } else if !self.bringup.is_idle() {
            Err(CommandRefused::Busy)
        } else {
            Ok(())
        }
    }
}

/// A device of family `F`.
#[derive(Debug)]
pub(crate) struct Supervised<F: Family> {
    claims: Vec<Claim>,
    session: Session<F::Questions>,
    family: F,
}

impl<F: Family + 'static> Supervised<F> {
    pub(crate) fn boxed(
        claims: impl IntoIterator<Item = Claim>,
        bringup: Bringup,
        questions: F::Questions,
        family: F,
    ) -> Box<dyn Device>
    where
        F::Questions: 'static,
    {
        Box::new(Self {
            claims: claims.into_iter().collect(),
            session: Session { bringup, questions },
            family,
        })
    }
}

impl<F: Family> Device for Supervised<F> {
    fn claims(&self) -> &[Claim] {
        &self.claims
    }

    fn on_frame(&mut self, frame: &Frame, out: &mut Decoded) {
        if self.session.bringup.active() {
            let frame = &mut Received::new(frame, out);
            self.family.on_frame(frame, &mut self.session);
        }
    }

    fn overhear(&mut self, frame: &Frame, out: &mut Decoded) {
        if self.claims.iter().any(|claim| claim.matches(frame.id)) {
            self.on_frame(frame, out);
        }
    }

    fn poll_transmit(&mut self, now: Nanos, out: &mut Decoded) -> Option<Transmit> {
        let Session { bringup, questions } = &mut self.session;
        let was_silent = bringup.is_silent();
        let transmit = bringup.poll(now, questions, out);
        if bringup.is_silent() && !was_silent {
            self.family.reset();
        }
        if !bringup.is_watching() {
            self.family.interrupt();
        }
        if transmit.is_some() || !bringup.may_lend() {
            return transmit;
        }
        let frame = self.family.request(now, &mut self.session, out)?;
        Some(self.session.bringup.lend(frame, now))
    }

    fn on_sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        let Session { bringup, questions } = &mut self.session;
        bringup.on_sent(frame, outcome, questions);
        self.family.on_sent(frame, outcome);
    }

    fn next_wake(&self) -> Option<Nanos> {
        let Session { bringup, questions } = &self.session;
        let request = (self.family.request_at()).filter(|_| bringup.may_lend());
        let bringup = bringup.next_wake(questions);
        bringup.into_iter().chain(request).min()
    }

    fn state(&self) -> State {
        self.session.state()
    }

    fn stop(&mut self, _now: Nanos) {
        self.session.bringup.stop();
        self.family.interrupt();
    }

    fn restart(&mut self, _now: Nanos) {
        self.session.bringup.restart();
        self.family.interrupt();
        self.family.reset();
    }

    fn lacks(&self) -> Option<Refusal> {
        self.family.lacks()
    }

    fn full_scale(&self) -> Option<[f64; 6]> {
        self.family.full_scale(&self.session)
    }

    fn set_max_silence(&mut self, max_silence: Nanos) {
        self.session.bringup.set_max_silence(max_silence);
    }

    fn command(&mut self, command: Command, now: Nanos) -> Result<(), CommandRefused> {
        self.family.command(command, now, &self.session)
    }

    fn outcome(&mut self) -> Option<Result<CommandOutcome, CommandFailed>> {
        self.family.outcome(&self.session)
    }
}
