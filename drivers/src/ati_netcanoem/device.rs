//! The host's side: asks for the readings, and combines the two halves of each.

use super::calibration::{CalibrationQuery, TIMING};
use super::frames::{STATUS_ANY, STATUS_BUS, STATUS_FAULTS, id, opcode, opcode_of};
use super::options::AtiNetcanoemOptions;
use crate::bringup::Bringup;
use crate::bytes::{i16_be, u16_be};
use crate::family::{Family, Session, Supervised, next_in_step};
use crate::pairing::within;
use crate::received::Received;
use crate::{
    Claim, Command, CommandFailed, CommandOutcome, CommandRefused, Decoded, Device, Driver, Frame,
    Mode, NotSent, OutputInfo, Spec, SpecError, StampedReading,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use proprio_topics::{Counter, Kind, Nanos, Quality, Reading, StampKind, Wrench};

/// So many readings wait for second halves before a half counts as lost.
const DEPTH: usize = 4;
/// And so long: three periods at 100 Hz.
const LIMIT: Nanos = Nanos::from_millis(30);
/// A request that is not answered within this time is given up.
const ANSWER: Nanos = Nanos::from_millis(10);
/// Then its answer may still come for this long: nothing is asked.
const LATE: Nanos = Nanos::from_millis(20);

/// For this long after a reply too many, readings are marked as faulty: each may be an old one.
const UNTRUSTED: Nanos = Nanos::from_millis(1000);

/// A first half: status and gauges 0, 2, 4.
#[derive(Debug, Clone, Copy)]
struct First {
    t: Nanos,
    stamp: StampKind,
    status: u16,
    gauges: [i16; 3],
}

/// The host's side of the sensor.
#[derive(Debug)]
pub(super) struct Netcanoem {
    base: u8,
    mode: Mode,
    period: Nanos,
    /// The halves that wait, each in the order of the requests.
    firsts: ArrayVec<First, DEPTH>,
    seconds: ArrayVec<[i16; 3], DEPTH>,
    /// Nothing was heard yet: the first second half may belong to a request before.
    joined: bool,
    /// Requests that were seen and have had no reply; `None` before the first.
    asked: Option<usize>,
    /// Until then each reply may be an old one.
    untrusted: Nanos,
    /// The request under way: when it is given up.
    open: Option<Nanos>,
    /// When the next is due.
    next: Nanos,
    /// The outcome of a command that was not taken.
    outcome: Option<CommandOutcome>,
}

impl Netcanoem {
    /// Drops the halves that wait.
    fn drop_all(&mut self, session: &mut Session<CalibrationQuery>, frame: &mut Received<'_>) {
        let halves = self.firsts.len() + self.seconds.len();
        if halves > 0 {
            session.bringup.lost();
            frame.faults(Counter::Unpaired, u32::try_from(halves).unwrap_or(1));
        }
        self.firsts.clear();
        self.seconds.clear();
    }

    fn first(
        &mut self,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<CalibrationQuery>,
    ) {
        self.joined = false;
        match &mut self.asked {
            // Which of the replies is that to the last request is not known.
            Some(0) => {
                self.untrusted = frame.t + UNTRUSTED;
                frame.fault(Counter::Unexpected);
            }
            Some(asked) => *asked -= 1,
            None => {}
        }
        let in_time = self
            .firsts
            .first()
            .is_none_or(|first| within((first.t, first.stamp), frame, LIMIT));
        if self.firsts.is_full() || !in_time {
            self.drop_all(session, frame);
        }
        let first = First {
            t: frame.t,
            stamp: frame.stamp,
            status: u16_be(data, 0),
            gauges: [2, 4, 6].map(|at| i16_be(data, at)),
        };
        let _ = self.firsts.try_push(first);
    }

    fn second(
        &mut self,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<CalibrationQuery>,
    ) {
        let in_time = self
            .firsts
            .first()
            .is_some_and(|first| within((first.t, first.stamp), frame, LIMIT));
        if !in_time {
            if !core::mem::take(&mut self.joined) {
                session.lost(Counter::Unpaired, 1, frame);
            }
            return self.drop_all(session, frame);
        }
        let _ = self.seconds.try_push([0, 2, 4].map(|at| i16_be(data, at)));
        if self.seconds.len() < self.firsts.len() {
            return;
        }
        self.open = None;
        let (firsts, seconds) = (self.firsts.take(), self.seconds.take());
        for (first, second) in firsts.into_iter().zip(seconds) {
            let is_trusted = frame.t >= self.untrusted;
            add(first, second, is_trusted, frame, session);
        }
    }
}

/// The reading of two halves.
fn add(
    first: First,
    second: [i16; 3],
    is_trusted: bool,
    frame: &mut Received<'_>,
    session: &mut Session<CalibrationQuery>,
) {
    let Some(per_count) = session.questions.per_count() else {
        if session.bringup.mode() == Mode::Listen {
            session.questions.missed();
        }
        return;
    };
    let ([g0, g2, g4], [g1, g3, g5]) = (first.gauges, second);
    let gauges = [g0, g1, g2, g3, g4, g5].map(f64::from);
    let dot = |row: &[f64; 6]| row.iter().zip(gauges).map(|(m, g)| m * g).sum::<f64>();
    let [fx, fy, fz, tx, ty, tz] = per_count.each_ref().map(dot);
    let reading = Reading::Wrench(Wrench {
        force: [fx, fy, fz],
        torque: [tx, ty, tz],
    });
    let mut quality = Quality::GOOD;
    if gauges.iter().any(|gauge| gauge.abs() >= 32767.0) {
        quality |= Quality::SATURATED;
    }
    let unnamed = first.status & (STATUS_ANY | STATUS_BUS) == STATUS_ANY;
    if first.status & STATUS_FAULTS != 0 || unnamed || !is_trusted {
        quality |= Quality::DEVICE_FAULT;
    }
    let stamped = StampedReading::new(0, frame, quality, reading).at(first.t, first.stamp);
    session.add(stamped, frame);
}

impl Driver for AtiNetcanoemOptions {
    const NAME: &'static str = "ati_netcanoem";
    const ADDRESS: Option<u32> = Some(0x20);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let (base, period) = self.check(spec)?;
        let bringup = Bringup::new(spec, spec.mode, TIMING, id(base, opcode::GAUGES));
        let claim = Claim {
            mask: !0xF,
            ..Claim::exclusive(id(base, 0))
        };
        let calibration = CalibrationQuery::new(base, spec.mode, self);
        let this = Netcanoem {
            base,
            mode: spec.mode,
            period,
            firsts: ArrayVec::new(),
            seconds: ArrayVec::new(),
            joined: true,
            asked: None,
            untrusted: Nanos::MIN,
            open: None,
            next: Nanos::MIN,
            outcome: None,
        };
        Ok(Supervised::boxed([claim], bringup, calibration, this))
    }
}

impl Family for Netcanoem {
    type Questions = CalibrationQuery;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<CalibrationQuery>) {
        let Some(opcode) = opcode_of(frame.id, self.base) else {
            return;
        };
        let Some(data) = frame.payload() else {
            return;
        };
        match (opcode, data) {
            (opcode::GAUGES, []) => self.asked = Some((self.asked.unwrap_or(0) + 1).min(DEPTH)),
            (opcode::COUNTS | opcode::UNITS, []) => {}
            (opcode::GAUGES, data) if data.len() == 8 => self.first(data, frame, session),
            (opcode::GAUGES_SECOND, data) if data.len() == 6 => {
                self.second(data, frame, session);
            }
            (opcode::GAUGES | opcode::GAUGES_SECOND, _) => frame.fault(Counter::Length),
            (opcode::MATRIX, &[row]) if self.mode == Mode::Listen => session.questions.asked(row),
            (opcode::MATRIX, [_]) => {}
            (opcode::MATRIX..=opcode::MATRIX_LAST | opcode::SELECT..=opcode::UNITS, data) => {
                session.questions.answer(opcode, data, frame);
            }
            // Serial number, diagnosis, and what others change.
            _ => {}
        }
    }

    fn reset(&mut self) {
        self.firsts.clear();
        self.seconds.clear();
        self.joined = true;
    }

    fn request(
        &mut self,
        now: Nanos,
        session: &mut Session<CalibrationQuery>,
        out: &mut Decoded,
    ) -> Option<Frame> {
        if now < self.request_at()? {
            return None;
        }
        if self.open.take().is_some() {
            // Not answered: what may still come of its answer must not meet the next.
            session.bringup.lost();
            out.fault(Counter::Lost, 1, id(self.base, opcode::GAUGES));
            self.reset();
            self.next = now + LATE;
            return None;
        }
        self.open = Some(now + ANSWER);
        self.asked = Some(1);
        self.next = next_in_step(self.next, self.period, now);
        Some(Frame::new(id(self.base, opcode::GAUGES), &[]))
    }

    fn request_at(&self) -> Option<Nanos> {
        Some(self.open.unwrap_or(self.next))
    }

    fn on_sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        // After a restart a late outcome may concern a question of before.
        if frame.id == id(self.base, opcode::GAUGES) {
            self.open = (outcome.ok()).and_then(|t| self.open.map(|_| t + ANSWER));
        }
    }

    fn interrupt(&mut self) {
        self.open = None;
        self.next = Nanos::MIN;
    }

    /// The calibration was read at the start: what is in use is known, also while only listening.
    fn command(
        &mut self,
        command: Command,
        _now: Nanos,
        session: &Session<CalibrationQuery>,
    ) -> Result<(), CommandRefused> {
        if command != Command::Calibration {
            return Err(CommandRefused::Unsupported);
        }
        let known = session.questions.in_use();
        let known = known.ok_or(CommandRefused::Unknown("its calibration"))?;
        self.outcome = Some(CommandOutcome::Calibration(known));
        Ok(())
    }

    fn outcome(
        &mut self,
        _session: &Session<CalibrationQuery>,
    ) -> Option<Result<CommandOutcome, CommandFailed>> {
        self.outcome.take().map(Ok)
    }
}
