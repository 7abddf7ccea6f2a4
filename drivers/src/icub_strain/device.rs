//! The host's side of an F/T board. It reads the full scales, starts the board, and combines the
//! two halves of each reading.

use super::exchange::{Exchange, Told};
use super::frames::{CELSIUS_PER_LSB, STEPS, StrainHalf, ZERO, kind};
use super::options::{IcubStrainOptions, StrainStream};
use crate::bringup::{Ask, Attempts, Bringup, Inquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::icub::{self, class, command};
use crate::pairing::{HalfOrder, Limit, Paired, Pairing};
use crate::received::Received;
use crate::{
    Calibration, Claim, Command, CommandFailed, CommandOutcome, CommandRefused, Decoded, Device,
    Driver, Frame, Mode, NotSent, OutputInfo, Spec, SpecError, StampedReading, bytes,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{
    Counter, Gauges, Kind, Nanos, Quality, Reading, Refusal, StampKind, Temperature, Wrench,
};

/// The full scales: configured, requested axis by axis, or from replies to another program.
#[derive(Debug)]
pub(super) struct StrainScales {
    /// The scale is configured, or not needed because only raw gauges are streamed: nothing to ask.
    settled: bool,
    /// N or Nm per step of the stream, once all six are known.
    per_step: Option<[f64; 6]>,
    told: [Option<u16>; 6],
    refusal: Option<Refusal>,
    address: u8,
    /// The axis of the current question; 6: all answered.
    axis: u8,
    attempts: Attempts,
    /// The axis of the last question.
    asked: u8,
    /// Questions per axis whose answers may still arrive.
    open: [u8; 6],
}

impl StrainScales {
    fn new(address: u8, configured: Option<[f64; 6]>, stream: StrainStream) -> Self {
        Self {
            settled: configured.is_some() || stream == StrainStream::Uncalibrated,
            per_step: configured.map(|all| all.map(|full_scale| full_scale / STEPS)),
            told: [None; 6],
            refusal: None,
            address,
            axis: 0,
            attempts: Attempts::new(Timing::USUAL),
            asked: 0,
            open: [0; 6],
        }
    }

    /// Takes an answer of the board: `[18, axis, high, low]`.
    fn answer(&mut self, data: &[u8], mode: Mode, frame: &mut Received<'_>) {
        let &[_, channel, high, low] = data else {
            return frame.fault(Counter::Length);
        };
        if channel >> 4 != 0 {
            // This answer is about a stored regulation set, not the one in use.
            if channel & 0xF > 5 || channel >> 4 > 3 {
                frame.fault(Counter::Value);
            }
            return;
        }
        let axis = usize::from(channel);
        let (Some(told), Some(open)) = (self.told.get_mut(axis), self.open.get_mut(axis)) else {
            return frame.fault(Counter::Value);
        };
        let value = u16::from_be_bytes([high, low]);
        let differs = told.is_some_and(|known| known != value);
        if differs {
            frame.fault(Counter::Changed);
        }
        if mode == Mode::Supervise {
            if *open == 0 || !self.attempts.counts(frame.t) {
                return frame.fault(Counter::Unexpected);
            }
            *open -= 1;
        }
        if self.settled || self.refusal == Some(Refusal::Changed) {
            return;
        }
        if differs {
            self.refusal = Some(Refusal::Changed);
            self.per_step = None;
            return;
        }
        if value == 0 {
            self.refusal = Some(Refusal::ZeroFullScale { channel });
            // Ask again slowly: the board may be repaired meanwhile.
            self.attempts.slow_down(frame.t);
            return;
        }
        *told = Some(value);
        if channel == self.axis {
            self.axis += 1;
            self.attempts.begin();
        }
        match self.refusal {
            Some(Refusal::ZeroFullScale { channel: refused }) if refused != channel => {}
            _ => self.refusal = None,
        }
        if self.told.iter().all(Option::is_some) {
            self.per_step = Some(self.told.map(|told| f64::from(told.unwrap_or(0)) / STEPS));
            self.refusal = None;
        }
    }
}

impl Inquiry for StrainScales {
    fn begin(&mut self) {
        self.axis = 0;
        self.attempts.begin();
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        if self.settled || self.axis > 5 {
            return Ask::Done;
        }
        if self.refusal == Some(Refusal::Changed) || now < self.attempts.next() {
            return Ask::Wait;
        }
        if self.attempts.exhausted() && self.per_step.is_none() && self.refusal.is_none() {
            self.refusal = Some(Refusal::NoFullScale);
        }
        if !self.attempts.counts(now) {
            self.open = [0; 6];
        }
        self.attempts.ask(now);
        if let Some(open) = self.open.get_mut(usize::from(self.axis)) {
            *open = open.saturating_add(1);
        }
        self.asked = self.axis;
        Ask::Send(Frame::new(
            icub::to_board(class::POLLING_ANALOG, self.address),
            &[command::GET_FULL_SCALES, self.axis],
        ))
    }

    fn sent(&mut self, outcome: Result<Nanos, NotSent>) {
        // If the answer is here already, the next question is another one.
        if self.asked == self.axis {
            self.attempts.sent(outcome);
        }
        if outcome.is_err()
            && let Some(open) = self.open.get_mut(usize::from(self.asked))
        {
            *open = open.saturating_sub(1);
        }
    }

    fn wake(&self) -> Option<Nanos> {
        (self.refusal != Some(Refusal::Changed)).then_some(self.attempts.next())
    }

    fn refusal(&self) -> Option<Refusal> {
        self.refusal
    }
}

/// Both halves of a reading.
#[derive(Debug, Clone, Copy)]
struct Whole {
    acquired: Nanos,
    stamp: StampKind,
    first: StrainHalf,
    second: StrainHalf,
    quality: Quality,
}

impl Whole {
    fn output(&self, quality: Quality, reading: Reading, frame: &Frame) -> StampedReading {
        StampedReading::new(0, frame, quality, reading).at(self.acquired, self.stamp)
    }
}

/// One of the two streams: its halves, and whether a reading was lost since the last one.
#[derive(Debug)]
struct Pair {
    pairing: Pairing<StrainHalf>,
    gap: bool,
}

impl Pair {
    const fn new(limit: Limit) -> Self {
        Self {
            pairing: Pairing::new(limit, HalfOrder::Usual),
            gap: false,
        }
    }

    /// Adds a half; returns both halves with their quality flags when complete.
    fn push(&mut self, second: bool, data: &[u8], frame: &mut Received<'_>) -> Option<Whole> {
        let half = match StrainHalf::parse(data) {
            Ok(half) => half,
            Err(counter) => {
                frame.fault(counter);
                self.gap = true;
                return None;
            }
        };
        let mut unpaired = 0;
        let paired = self.pairing.push(second, frame, half, &mut unpaired);
        if unpaired > 0 {
            frame.faults(Counter::Unpaired, unpaired);
            self.gap = true;
        }
        let Paired::With(acquired, stamp, [first, second]) = paired else {
            return None;
        };
        let quality = second.mark(first.mark(Quality::GOOD, 0), 3);
        Some(Whole {
            acquired,
            stamp,
            first,
            second,
            quality,
        })
    }

    /// GAP_BEFORE if something was lost since the last reading.
    fn take_gap(&mut self) -> Quality {
        if core::mem::take(&mut self.gap) {
            Quality::GAP_BEFORE
        } else {
            Quality::GOOD
        }
    }
}

/// The host's side of an F/T board.
#[derive(Debug)]
pub(super) struct Strain {
    address: u8,
    exchange: Exchange,
    stream: StrainStream,
    calibrated: Pair,
    raw: Pair,
}

impl Strain {
    fn wrench(
        &mut self,
        second: bool,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<StrainScales>,
    ) {
        let Some(whole) = self.calibrated.push(second, data, frame) else {
            return;
        };
        let Some(per_step) = session.questions.per_step else {
            if session.bringup.mode() == Mode::Listen
                && !session.questions.settled
                && session.questions.refusal.is_none()
            {
                // The board streams already, its scale is unknown, and no other program will
                // request it for this host.
                session.questions.refusal = Some(Refusal::NoFullScale);
            }
            return;
        };
        let [fx, fy, fz, tx, ty, tz] = per_step;
        let value = |count: u16, per_step: f64| (f64::from(count) - f64::from(ZERO)) * per_step;
        let ([a, b, c], [d, e, f]) = (whole.first.counts, whole.second.counts);
        let reading = Reading::Wrench(Wrench {
            force: [value(a, fx), value(b, fy), value(c, fz)],
            torque: [value(d, tx), value(e, ty), value(f, tz)],
        });
        let frozen = if whole.quality.contains(Quality::SATURATED) {
            Quality::FROZEN
        } else {
            Quality::GOOD
        };
        let step = if self.exchange.take_step() {
            Quality::ZERO_CHANGED
        } else {
            Quality::GOOD
        };
        let quality = whole.quality | frozen | step | self.calibrated.take_gap();
        session.add(whole.output(quality, reading, frame), frame);
    }

    fn gauges(
        &mut self,
        second: bool,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<StrainScales>,
    ) {
        let Some(whole) = self.raw.push(second, data, frame) else {
            return;
        };
        let ([a, b, c], [d, e, f]) = (whole.first.counts, whole.second.counts);
        let reading = Reading::Gauges(Gauges {
            counts: [a, b, c, d, e, f].map(i32::from),
        });
        let quality = whole.quality | self.raw.take_gap();
        session.add(whole.output(quality, reading, frame), frame);
    }
}

impl Driver for IcubStrainOptions {
    const NAME: &'static str = "icub_strain";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let address = icub::address(spec)?;
        let period = icub::period_ms("period_ms", self.period_ms)?;
        let configured = self.full_scale(false)?;
        let timing = icub::timing(self.power_on_silence_ms)?;
        let limit = match self.pair_timeout_ms {
            None => Limit::of_period(Nanos::from_millis(i64::from(period))),
            Some(ms) if ms > 0.0 && ms <= 1000.0 => Limit::fixed(Nanos::from_seconds(ms * 1e-3)),
            Some(value) => {
                let expected = "above 0 and at most 1000";
                return Err(SpecError::key("pair_timeout_ms", value, expected));
            }
        };
        let (force, command_id) = (
            icub::stream(class::PERIODIC_ANALOG, address, kind::FORCE),
            icub::to_board(class::POLLING_ANALOG, address),
        );
        let watched = match self.stream {
            StrainStream::Uncalibrated => {
                icub::stream(class::PERIODIC_ANALOG, address, kind::RAW_FORCE)
            }
            StrainStream::Calibrated | StrainStream::Both => force,
        };
        let mut bringup = Bringup::new(spec, spec.mode, timing, watched);
        bringup.start_with(command_id, &[command::SET_CANDATARATE, period]);
        if let Some(seconds) = self.temperature_period_s {
            let seconds = icub::period_ms("temperature_period_s", seconds)?;
            bringup.start_with(command_id, &[command::THERMOMETER_CONFIG_SET, 1]);
            bringup.start_with(command_id, &[command::THERMOMETER_TRANSMIT, seconds]);
            bringup.stop_with(command_id, &[command::THERMOMETER_TRANSMIT, 0]);
        }
        bringup.start_with(command_id, &[command::SET_TXMODE, self.stream.code()]);
        bringup.stop_with(command_id, &[command::SET_TXMODE, 1]);
        let mut claims = icub::claims(
            class::PERIODIC_ANALOG,
            address,
            &[
                kind::FORCE,
                kind::TORQUE,
                kind::RAW_FORCE,
                kind::RAW_TORQUE,
                kind::THERMOMETER,
                kind::THERMOMETER_FIRMWARE,
            ],
        );
        claims.push(Claim::shared(icub::to_host(class::POLLING_ANALOG, address)));
        let scales = StrainScales::new(address, configured, self.stream);
        let this = Strain {
            address,
            exchange: Exchange::new(address),
            stream: self.stream,
            calibrated: Pair::new(limit),
            raw: Pair::new(limit),
        };
        Ok(Supervised::boxed(claims, bringup, scales, this))
    }
}

impl Family for Strain {
    type Questions = StrainScales;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<StrainScales>) {
        if let Some(stream) = icub::stream_type(frame.id, class::PERIODIC_ANALOG, self.address) {
            let known = matches!(stream, kind::RAW_FORCE..=kind::TORQUE | kind::THERMOMETER..);
            let Some(data) = known.then(|| frame.payload()).flatten() else {
                return;
            };
            match stream {
                kind::FORCE => self.wrench(false, data, frame, session),
                kind::TORQUE => self.wrench(true, data, frame, session),
                kind::RAW_FORCE => self.gauges(false, data, frame, session),
                kind::RAW_TORQUE => self.gauges(true, data, frame, session),
                _ => temperature(data, frame),
            }
        } else if frame.id == icub::to_host(class::POLLING_ANALOG, self.address)
            && let Some(data) = frame.payload()
        {
            match data.first() {
                Some(&command::GET_FULL_SCALES) if !self.exchange.expects(data) => {
                    session
                        .questions
                        .answer(data, session.bringup.mode(), frame);
                }
                // As with full scales: live and in a log the same answers are malformed.
                Some(&command::GET_MATRIX_RC) => {
                    self.exchange.answer(data, session.bringup.mode(), frame);
                }
                Some(&(command::GET_FULL_SCALES | command::GET_CURR_TARE))
                    if session.bringup.mode() == Mode::Supervise =>
                {
                    self.exchange.answer(data, Mode::Supervise, frame);
                }
                // Answers to other questions are for other devices.
                Some(_) => {}
                None => frame.fault(Counter::Length),
            }
        }
    }

    fn reset(&mut self) {
        self.calibrated.pairing.reset();
        self.raw.pairing.reset();
    }

    fn request(
        &mut self,
        now: Nanos,
        _session: &mut Session<StrainScales>,
        _out: &mut Decoded,
    ) -> Option<Frame> {
        self.exchange.poll(now)
    }

    fn request_at(&self) -> Option<Nanos> {
        self.exchange.wake()
    }

    fn on_sent(&mut self, frame: &Frame, outcome: Result<Nanos, NotSent>) {
        self.exchange.sent(frame, outcome);
    }

    fn interrupt(&mut self) {
        self.exchange.interrupt();
    }

    fn command(
        &mut self,
        command: Command,
        now: Nanos,
        session: &Session<StrainScales>,
    ) -> Result<(), CommandRefused> {
        let tares = command == Command::Tare;
        if tares
            && self.stream == StrainStream::Uncalibrated
            && session.bringup.mode() != Mode::Listen
        {
            return Err(CommandRefused::Useless(
                "this device streams raw gauges alone, which a tare does not change",
            ));
        }
        session.takes_command()?;
        if self.exchange.is_open() {
            return Err(CommandRefused::Busy);
        }
        self.exchange.begin(command, now);
        Ok(())
    }

    fn outcome(
        &mut self,
        session: &Session<StrainScales>,
    ) -> Option<Result<CommandOutcome, CommandFailed>> {
        Some(match self.exchange.outcome()? {
            Ok((Command::Tare, told)) => {
                let per_step = session.questions.per_step.unwrap_or([f64::NAN; 6]);
                Ok(CommandOutcome::Tared(Some(added(told, per_step))))
            }
            Ok((Command::Calibration, told)) => Ok(CommandOutcome::Calibration(calibration(told))),
            Err(failed) => Err(failed),
        })
    }
}

/// What a tare has read back.
fn added(told: Told, per_step: [f64; 6]) -> Wrench {
    let [a, b, c, d, e, f, ..] = told.map(|count| f64::from(count.cast_signed()));
    let [fx, fy, fz, tx, ty, tz] = per_step;
    Wrench {
        force: [a * fx, b * fy, c * fz],
        torque: [d * tx, e * ty, f * tz],
    }
}

/// What the answers about the calibration say.
fn calibration(told: Told) -> Calibration {
    let ([a, b, c, d, e, f, ..], mut matrix) = (told, [[0; 6]; 6]);
    let entries = told.iter().skip(6);
    for (to, from) in matrix.iter_mut().flatten().zip(entries) {
        *to = from.cast_signed();
    }
    Calibration::Fractions {
        full_scale: [a, b, c, d, e, f],
        matrix,
    }
}

/// The reading of a thermometer frame.
fn temperature(data: &[u8], frame: &mut Received<'_>) {
    match *data {
        [mask, _, _, _, _] if mask & 1 == 1 => {
            let celsius = f64::from(bytes::i16_le(data, 1)) * CELSIUS_PER_LSB;
            let reading = Reading::Temperature(Temperature { celsius });
            frame.tell(0, Quality::GOOD, reading);
        }
        [_, _, _, _, _] => frame.fault(Counter::Value),
        _ => frame.fault(Counter::Length),
    }
}
