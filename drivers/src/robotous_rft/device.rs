//! The host's side of a sensor. It sets the rate, starts the sensor, and combines the two halves of
//! each response.

use super::options::RobotousRftOptions;
use super::protocol::{DEFAULT_RATE, OVERLOAD_FX, RftIds, SET, command, period, send};
use crate::bringup::{Ask, Attempts, Bringup, Inquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::pairing::{HalfOrder, Limit, Paired, Pairing};
use crate::received::Received;
use crate::wrench::{self, NewZero, TareCommand};
use crate::{
    Claim, Command, CommandFailed, CommandOutcome, CommandRefused, Decoded, Device, Driver, Frame,
    Id, Mode, NotSent, OutputInfo, Spec, SpecError, StampedReading,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Counter, Kind, Nanos, Quality, Reading, StampKind, Wrench};

/// A tare has taken effect within this time: it is not answered.
const TARED: Nanos = Nanos::from_millis(100);

/// The next step of [`Rate`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RateStep {
    Stop,
    Get,
    Set,
    Done,
}

/// Stops the sensor, asks for its rate, and sets it if it is another one.
#[derive(Debug)]
pub(super) struct Rate {
    id: Id,
    code: u8,
    attempts: Attempts,
    step: RateStep,
    /// The step of the last frame; its answer may have come since.
    sent: RateStep,
}

impl Rate {
    /// Takes the sensor's answer, in `frame`.
    fn answer(&mut self, code: u8, frame: &mut Received<'_>) {
        if !self.attempts.counts(frame.t) {
            return frame.fault(Counter::Unexpected);
        }
        self.attempts.again();
        self.step = match code {
            0 if self.code == DEFAULT_RATE => RateStep::Done,
            _ if code == self.code => RateStep::Done,
            _ if self.attempts.exhausted() => {
                frame.fault(Counter::Changed);
                RateStep::Done
            }
            _ => RateStep::Set,
        };
    }
}

impl Inquiry for Rate {
    fn begin(&mut self) {
        self.step = RateStep::Stop;
        self.attempts.begin();
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        self.sent = self.step;
        Ask::Send(match self.step {
            RateStep::Stop => send(self.id, command::STOP, 0),
            RateStep::Set => send(self.id, command::SET_RATE, self.code),
            RateStep::Get if now < self.attempts.next() => return Ask::Wait,
            RateStep::Get if !self.attempts.exhausted() => {
                self.attempts.ask(now);
                send(self.id, command::GET_RATE, 0)
            }
            RateStep::Get | RateStep::Done => {
                self.step = RateStep::Done;
                return Ask::Done;
            }
        })
    }

    fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        match self.sent {
            RateStep::Stop | RateStep::Set if outcome.is_ok() => self.step = RateStep::Get,
            RateStep::Get => self.attempts.sent(outcome),
            _ => {}
        }
    }

    fn wake(&self) -> Option<Nanos> {
        Some(self.attempts.next())
    }
}

/// The host's side of a sensor.
#[derive(Debug)]
pub(super) struct Rft {
    ids: RftIds,
    divisors: [f64; 6],
    pairing: Pairing<[u8; 8]>,
    tare: TareCommand,
    zero: NewZero,
}

impl Rft {
    /// The reading of both frames' bytes.
    fn wrench(&self, first: [u8; 8], second: [u8; 8]) -> (Wrench, Quality) {
        let [_, fx, fx_low, fy, fy_low, fz, fz_low, tx] = first;
        let [tx_low, ty, ty_low, tz, tz_low, overload, _, _] = second;
        let mut values = self.divisors;
        let mut quality = Quality::GOOD;
        let counts = [
            [fx, fx_low],
            [fy, fy_low],
            [fz, fz_low],
            [tx, tx_low],
            [ty, ty_low],
            [tz, tz_low],
        ];
        for (axis, (value, count)) in (0..).zip(values.iter_mut().zip(counts)) {
            *value = f64::from(i16::from_be_bytes(count)) / *value;
            if overload >> (OVERLOAD_FX - axis) & 1 == 1 {
                quality = wrench::overloaded(quality, axis, *value);
            }
        }
        let [fx, fy, fz, tx, ty, tz] = values;
        let (force, torque) = ([fx, fy, fz], [tx, ty, tz]);
        (Wrench { force, torque }, quality)
    }

    fn add(
        &mut self,
        halves: [[u8; 8]; 2],
        first: (Nanos, StampKind),
        frame: &mut Received<'_>,
        session: &mut Session<Rate>,
    ) {
        let [a, b] = halves;
        let (wrench, mut quality) = self.wrench(a, b);
        quality |= self.zero.mark(frame.t);
        let (acquired, stamp) = first;
        let stamped =
            StampedReading::new(0, frame, quality, Reading::Wrench(wrench)).at(acquired, stamp);
        session.add(stamped, frame);
    }
}

impl Driver for RobotousRftOptions {
    const NAME: &'static str = "robotous_rft";
    const ADDRESS: Option<u32> = Some(0x64);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let ids = self.ids(spec)?;
        let rate = Rate {
            id: ids.command,
            code: self.rate_code()?,
            attempts: Attempts::new(Timing::USUAL),
            step: RateStep::Stop,
            sent: RateStep::Stop,
        };
        let mut bringup = Bringup::new(spec, spec.mode, Timing::USUAL, ids.first);
        bringup.start_with(ids.command, send(ids.command, command::START, 0).data());
        bringup.stop_with(ids.command, send(ids.command, command::STOP, 0).data());
        let claims = [ids.first, ids.second].map(Claim::exclusive);
        let this = Rft {
            ids,
            divisors: self.model.divisors(),
            pairing: Pairing::new(Limit::of_period(period(self.rate_hz)), HalfOrder::Usual),
            tare: TareCommand::default(),
            zero: NewZero::default(),
        };
        Ok(Supervised::boxed(claims, bringup, rate, this))
    }
}

impl Family for Rft {
    type Questions = Rate;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<Rate>) {
        let second = frame.id == self.ids.second;
        if !second && frame.id != self.ids.first {
            return;
        }
        let data = frame.payload_of(8);
        let Some(&half) = data.and_then(|data| data.first_chunk()) else {
            return;
        };
        let mut unpaired = 0;
        let paired = self.pairing.push(second, frame, half, &mut unpaired);
        session.lost(Counter::Unpaired, unpaired, frame);
        let Paired::With(acquired, stamp, halves) = paired else {
            return;
        };
        match halves[0] {
            [command::START, ..] => {
                self.add(halves, (acquired, stamp), frame, session);
            }
            [command::GET_RATE, code, ..] if session.bringup.mode() == Mode::Supervise => {
                session.questions.answer(code, frame);
            }
            // Answers to other questions are for other programs.
            _ => {}
        }
    }

    fn reset(&mut self) {
        self.pairing.reset();
    }

    fn request(
        &mut self,
        now: Nanos,
        _session: &mut Session<Rate>,
        _out: &mut Decoded,
    ) -> Option<Frame> {
        let due = self.tare.poll(now);
        due.then(|| send(self.ids.command, command::BIAS, SET))
    }

    fn request_at(&self) -> Option<Nanos> {
        self.tare.wake()
    }

    fn on_sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        if frame.id == self.ids.command && frame.data().first() == Some(&command::BIAS) {
            if let Ok(t) = outcome {
                self.zero.expect(t + TARED);
            }
            self.tare.sent(outcome, None);
        }
    }

    fn interrupt(&mut self) {
        self.tare.interrupt();
    }

    fn command(
        &mut self,
        command: Command,
        now: Nanos,
        session: &Session<Rate>,
    ) -> Result<(), CommandRefused> {
        if command != Command::Tare {
            return Err(CommandRefused::Unsupported);
        }
        session.takes_command()?;
        if self.tare.is_open() {
            return Err(CommandRefused::Busy);
        }
        self.tare.begin(now);
        Ok(())
    }

    fn outcome(
        &mut self,
        _session: &Session<Rate>,
    ) -> Option<Result<CommandOutcome, CommandFailed>> {
        self.tare.outcome()
    }
}
