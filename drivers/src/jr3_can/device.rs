//! The host's side of a board. It asks for the full scales, starts the board, and combines the
//! frames of force and moment.

use super::options::Jr3CanOptions;
use super::protocol::{READY, SAMPLE, STEPS, id, node, op, op_of};
use super::scales::{Jr3Scales, Question};
use crate::bringup::{Bringup, Timing};
use crate::family::{Family, Session, Supervised};
use crate::received::Received;
use crate::wrench::{NewZero, TareCommand, at_end};
use crate::{
    Calibration, Claim, Command, CommandFailed, CommandOutcome, CommandRefused, Decoded, Device,
    Driver, Frame, Mode, NotSent, OutputInfo, Spec, SpecError, StampedReading, bytes,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, Kind, Nanos, Quality, Reading, Refusal, StampKind, Wrench};

/// A command that is not acknowledged within this time has taken effect, or was lost.
const ACKNOWLEDGED: Nanos = Nanos::from_millis(100);

/// One frame of a reading.
#[derive(Debug, Clone, Copy)]
struct Jr3Half {
    counts: [i16; 3],
    counter: u16,
}

impl Jr3Half {
    fn parse(data: &[u8]) -> Option<Self> {
        let &[a, b, c, d, e, f, g, h] = data else {
            return None;
        };
        Some(Self {
            counts: [[a, b], [c, d], [e, f]].map(i16::from_le_bytes),
            counter: u16::from_le_bytes([g, h]),
        })
    }
}

/// The host's side of a board.
#[derive(Debug)]
pub(super) struct Jr3 {
    node: u16,
    period: Nanos,
    /// The force that waits for its moment, and its stamp.
    waiting: Option<(Nanos, StampKind, Jr3Half)>,
    /// Whether a force was heard: the moment of an earlier one is not missing anything.
    joined: bool,
    /// The counter of the last reading.
    last: Option<u16>,
    zero: NewZero,
    tare: TareCommand,
    /// The outcome of another command that was not taken.
    outcome: Option<CommandOutcome>,
}

impl Jr3 {
    /// A command that changes the zero was sent at `t`.
    fn expect_zero(&mut self, t: Nanos) {
        self.zero.expect(t + ACKNOWLEDGED);
    }

    fn acknowledge(
        &mut self,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<Jr3Scales>,
    ) {
        match *data {
            [state] => {
                self.zero.confirm(frame.t);
                if state == READY {
                    self.tare.confirm();
                } else {
                    frame.fault(Counter::DeviceFault);
                }
            }
            [state, ref scales @ ..] if scales.len() == 6 => {
                let scales = [0, 2, 4].map(|at| bytes::u16_le(scales, at));
                let mode = session.bringup.mode();
                session.questions.answer(state, scales, mode, frame);
            }
            _ => frame.fault(Counter::Length),
        }
    }

    fn force(&mut self, half: Jr3Half, frame: &mut Received<'_>, session: &mut Session<Jr3Scales>) {
        self.joined = true;
        if self.waiting.replace((frame.t, frame.stamp, half)).is_some() {
            session.lost(Counter::Unpaired, 1, frame);
        }
    }

    fn moment(
        &mut self,
        half: Jr3Half,
        frame: &mut Received<'_>,
        session: &mut Session<Jr3Scales>,
    ) {
        let force = (self.waiting).take_if(|(_, _, force)| force.counter == half.counter);
        let Some((acquired, stamp, force)) = force else {
            if self.joined {
                session.lost(Counter::Unpaired, 1, frame);
            }
            return;
        };
        let mut quality = Quality::DEVICE_COUNTER;
        if let Some(last) = self.last.replace(half.counter) {
            match half.counter.wrapping_sub(last) {
                0 => quality |= Quality::FROZEN,
                samples => {
                    let lost = self.periods(samples).saturating_sub(1);
                    session.lost(Counter::Lost, lost, frame);
                }
            }
        }
        let Some(per_step) = session.questions.per_step else {
            if session.bringup.mode() == Mode::Listen && session.questions.refusal.is_none() {
                // The board streams already, and no other program asks for this host.
                session.questions.refusal = Some(Refusal::NoFullScale);
            }
            return;
        };
        let ([a, b, c], [d, e, f]) = (force.counts, half.counts);
        let mut values = per_step;
        for (axis, (value, count)) in (0..).zip(values.iter_mut().zip([a, b, c, d, e, f])) {
            *value *= f64::from(count);
            quality = quality.with_saturation(axis, at_end(count, i16::MIN, i16::MAX));
        }
        quality |= self.zero.mark(frame.t);
        let [fx, fy, fz, tx, ty, tz] = values;
        let (force, torque) = ([fx, fy, fz], [tx, ty, tz]);
        let stamped = StampedReading {
            acquired,
            stamp,
            device_counter: u32::from(half.counter),
            ..StampedReading::new(0, frame, quality, Reading::Wrench(Wrench { force, torque }))
        };
        session.add(stamped, frame);
    }

    /// The number of periods in which the sensor takes `samples`, to the nearest.
    fn periods(&self, samples: u16) -> u32 {
        let passed = i64::from(samples) * SAMPLE.0;
        u32::try_from((passed + self.period.0 / 2) / self.period.0).unwrap_or(0)
    }
}

impl Driver for Jr3CanOptions {
    const NAME: &'static str = "jr3_can";
    const ADDRESS: Option<u32> = Some(1);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let node = node(spec)?;
        let (period, cutoff) = (self.period()?, self.cutoff()?);
        let scales = Jr3Scales::new(node, self.full_scale()?);
        let mut bringup = Bringup::new(spec, spec.mode, Timing::USUAL, id(op::FORCE, node));
        let [c0, c1] = cutoff.to_le_bytes();
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // at most a second
        let [p0, p1, p2, p3] = ((period.0 / 1000) as u32).to_le_bytes();
        bringup.start_with(id(op::START, node), &[c0, c1, p0, p1, p2, p3]);
        bringup.stop_with(id(op::STOP, node), &[]);
        let codes = [op::FORCE, op::MOMENT, op::ACKNOWLEDGE, op::BOOT_UP];
        let heard = [
            op::START_SYNC,
            op::START,
            op::ZERO,
            op::GET_FORCE_SCALES,
            op::GET_MOMENT_SCALES,
        ];
        let exclusive = codes.map(|op| Claim::exclusive(id(op, node)));
        let heard = heard.map(|op| Claim::shared(id(op, node)));
        let this = Jr3 {
            node,
            period,
            waiting: None,
            joined: false,
            last: None,
            zero: NewZero::default(),
            tare: TareCommand::default(),
            outcome: None,
        };
        let claims = exclusive.into_iter().chain(heard);
        Ok(Supervised::boxed(claims, bringup, scales, this))
    }
}

impl Family for Jr3 {
    type Questions = Jr3Scales;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<Jr3Scales>) {
        let Some(op) = op_of(frame.id, self.node) else {
            return;
        };
        match op {
            op::START | op::START_SYNC | op::ZERO => return self.expect_zero(frame.t),
            op::GET_FORCE_SCALES if session.bringup.mode() == Mode::Listen => {
                return session.questions.overhear(Question::Forces);
            }
            op::GET_MOMENT_SCALES if session.bringup.mode() == Mode::Listen => {
                return session.questions.overhear(Question::Moments);
            }
            op::FORCE | op::MOMENT | op::ACKNOWLEDGE | op::BOOT_UP => {}
            _ => return,
        }
        let Some(data) = frame.payload() else {
            return;
        };
        match (op, Jr3Half::parse(data)) {
            (op::ACKNOWLEDGE, _) => self.acknowledge(data, frame, session),
            (op::FORCE, Some(half)) => self.force(half, frame, session),
            (op::MOMENT, Some(half)) => self.moment(half, frame, session),
            (op::BOOT_UP, _) if data.is_empty() => {
                session.bringup.restart();
                self.reset();
                self.zero.expect(frame.t);
            }
            _ => frame.fault(Counter::Length),
        }
    }

    fn full_scale(&self, session: &Session<Jr3Scales>) -> Option<[f64; 6]> {
        Some(session.questions.per_step?.map(|step| step * STEPS))
    }

    fn reset(&mut self) {
        self.waiting = None;
        self.joined = false;
        self.last = None;
    }

    fn request(
        &mut self,
        now: Nanos,
        _session: &mut Session<Jr3Scales>,
        _out: &mut Decoded,
    ) -> Option<Frame> {
        let due = self.tare.poll(now);
        due.then(|| Frame::new(id(op::ZERO, self.node), &[]))
    }

    fn request_at(&self) -> Option<Nanos> {
        self.tare.wake()
    }

    fn on_sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        let tares = frame.id == id(op::ZERO, self.node);
        if let Ok(t) = outcome
            && (tares || frame.id == id(op::START, self.node))
        {
            self.expect_zero(t);
        }
        if tares {
            self.tare.sent(outcome, Some(ACKNOWLEDGED));
        }
    }

    fn interrupt(&mut self) {
        self.tare.interrupt();
    }

    fn command(
        &mut self,
        command: Command,
        now: Nanos,
        session: &Session<Jr3Scales>,
    ) -> Result<(), CommandRefused> {
        if self.tare.is_open() {
            return Err(CommandRefused::Busy);
        }
        match command {
            Command::Tare => {
                session.takes_command()?;
                self.tare.begin(now);
            }
            // They were read at the start.
            Command::Calibration => {
                let known = self.full_scale(session);
                let scales = known.ok_or(CommandRefused::Unknown("its full scale"))?;
                let scales = Calibration::FullScale(scales);
                self.outcome = Some(CommandOutcome::Calibration(scales));
            }
        }
        Ok(())
    }

    fn outcome(
        &mut self,
        _session: &Session<Jr3Scales>,
    ) -> Option<Result<CommandOutcome, CommandFailed>> {
        self.outcome.take().map(Ok).or_else(|| self.tare.outcome())
    }
}
