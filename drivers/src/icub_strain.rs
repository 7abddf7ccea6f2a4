//! iCub F/T boards strain, strain2 and strain2c: wrench, uncalibrated gauges, temperature.
//!
//! Streams of address `a`, little-endian, class 3:
//!
//! | identifier | name | bytes | content |
//! |---|---|---|---|
//! | `3aA` | FORCE_VECTOR | 6 or 7 | fx fy fz u16, then `sat` |
//! | `3aB` | TORQUE_VECTOR | 6 or 7 | tx ty tz u16, then `sat` |
//! | `3a8` | UNCALIBFORCE_VECTOR | 6 or 7 | gauges 0 to 2 u16, then `sat` |
//! | `3a9` | UNCALIBTORQUE_VECTOR | 6 or 7 | gauges 3 to 5 u16, then `sat` |
//! | `3aE` or `3aF` | THERMOMETER_MEASURE | 5 | mask u8, 0.1 degC i16, 2 bytes unused |
//!
//! - value = (u16 - 0x8000) / 32768 x full scale of its axis, force in N, torque in Nm.
//! - `sat` is there only while at least one of the six gauges is saturated: bits 1:0 = 1; then two bits for each of the
//!   frame's three gauges, 0 within range, 1 low, 2 high. **While it is there the calibrated output is frozen** at the last
//!   vector that was not saturated: such readings carry SATURATED and FROZEN. Saturation is known per *gauge*; gauge k is
//!   told as axis k of [`Quality::saturation`], though through the calibration matrix each gauge bears on every axis.
//! - Nothing numbers the frames: force and torque are paired by order and time ([`crate::icub`], "Pairing" in its source).
//! - A thermometer frame has type E by the document and the shared header, F by the strain2 firmware's enumeration: both are
//!   taken.
//!
//! Commands on `20a`, answers on `2a0` (full scales big-endian, in whole N and Nm):
//!
//! | bytes | meaning | answer |
//! |---|---|---|
//! | `18 ch` | full scale of axis ch, 0 to 5 | `18 ch high low` |
//! | `08 ms` | period | none |
//! | `07 00`, `07 03`, `07 04`, `07 01` | send calibrated, uncalibrated, both; stop | none |
//! | `39 01`, `3A s` | which thermometer; its period in s, 0 stops | none |
//!
//! Sources: `TSD-ICUBUNIT-canprotocol-sensorboards.docx` v1.12 and `embot_app_application_theSTRAIN.cpp` (icub-firmware
//! b4299211), `canBusAnalogSensor` (icub-main 24c1a003). Certain, but for the thermometer's type.
//!
//! A board never tells its scale in the stream, and a wrong one gives plausible nonsense: **without a full scale there is
//! no reading**. It comes from the configuration, else from the board; asked for in vain it is [`Refusal::NoFullScale`], and
//! the board is asked on, twice a second, so that one that gets power later comes up. A full scale of zero (a corrupt
//! memory) is [`Refusal::ZeroFullScale`]. One that differs from what the board told before is [`Refusal::Changed`], for
//! good: what came in between can not be trusted.
//!
//! # Keys
//! ```toml
//! full_scale_n = [1804, 1804, 1804]  # both or neither; overrides what the board tells
//! full_scale_nm = [31, 31, 31]
//! period_ms = 10                     # 1 to 255; strain2 needs 2 or more for full accuracy
//! stream = "calibrated"              # "calibrated", "uncalibrated" or "both"
//! temperature_period_s = 1           # none if absent
//! pair_timeout_ms = 5.0              # longest time from force to torque; default half a period
//! power_on_silence_ms = 0            # see `crate::icub`
//! listen = false                     # true: somebody else commands this board; never transmit
//! ```

use crate::icub::{self, Ask, Bringup, Inquiry, Paired, Pairing, class, command};
use crate::{
    Board, Claim, Decoded, Device, EncodeError, Frame, Frames, Id, Mode, Refusal, Spec, SpecError, State, Transmit,
    device,
};
use arrayvec::ArrayVec;
use proprio_topics::{Counter, Gauges, Kind, Nanos, Quality, Reading, Saturation, StampKind, Temperature, Wrench};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};

/// Types of the streams.
mod kind {
    pub(super) const RAW_FORCE: u8 = 0x8;
    pub(super) const RAW_TORQUE: u8 = 0x9;
    pub(super) const FORCE: u8 = 0xA;
    pub(super) const TORQUE: u8 = 0xB;
    pub(super) const THERMOMETER: u8 = 0xE;
    pub(super) const THERMOMETER_FIRMWARE: u8 = 0xF;
}

/// What stands for zero in a stream.
const ZERO: u16 = 0x8000;
/// Steps in a full scale.
const STEPS: f64 = 32768.0;
/// One step of a temperature \[degC\].
const CELSIUS_PER_LSB: f64 = 0.1;
/// What a board has if nobody configured it: the iCub's usual sensor \[N, Nm\]. A simulated board tells it when asked.
const USUAL_FULL_SCALE: [f64; 6] = [1804.0, 1804.0, 1804.0, 31.0, 31.0, 31.0];

/// What to stream.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stream {
    /// Wrenches.
    #[default]
    Calibrated,
    /// Raw gauges; needs no full scale.
    Uncalibrated,
    /// Both.
    Both,
}

impl Stream {
    /// The mode of SET_TXMODE.
    const fn code(self) -> u8 {
        match self {
            Self::Calibrated => 0,
            Self::Uncalibrated => 3,
            Self::Both => 4,
        }
    }

    /// What mode `code` streams; `None`: nothing.
    const fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::Calibrated),
            3 => Some(Self::Uncalibrated),
            4 => Some(Self::Both),
            _ => None,
        }
    }
}

/// Exactly three: an array alone takes the first ones of more.
fn three<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<[f64; 3]>, D::Error> {
    let numbers = alloc::vec::Vec::<f64>::deserialize(deserializer)?;
    let three = <[f64; 3]>::try_from(numbers.as_slice());
    three
        .map(Some)
        .map_err(|_| D::Error::invalid_length(numbers.len(), &"3 numbers"))
}

/// The keys of `driver = "icub_strain"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Full scale of fx fy fz \[N\]; default: what the board tells.
    #[serde(deserialize_with = "three")]
    pub full_scale_n: Option<[f64; 3]>,
    /// Full scale of tx ty tz \[Nm\]; goes with `full_scale_n`.
    #[serde(deserialize_with = "three")]
    pub full_scale_nm: Option<[f64; 3]>,
    /// Period \[ms\], 1 to 255; default 10.
    pub period_ms: u32,
    /// What to stream; default calibrated.
    pub stream: Stream,
    /// Period of the temperature \[s\], 1 to 255; default none.
    pub temperature_period_s: Option<u32>,
    /// Longest time from a force frame to its torque frame \[ms\]; default half a period.
    pub pair_timeout_ms: Option<f64>,
    /// Silence kept after power-on \[ms\]; default 0.
    pub power_on_silence_ms: u32,
    /// Somebody else commands this board; default false.
    pub listen: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            full_scale_n: None,
            full_scale_nm: None,
            period_ms: 10,
            stream: Stream::Calibrated,
            temperature_period_s: None,
            pair_timeout_ms: None,
            power_on_silence_ms: 0,
            listen: false,
        }
    }
}

impl Options {
    /// The configured full scale, force then torque. `least` is what it may not be below.
    fn full_scale(&self, zero_allowed: bool) -> Result<Option<[f64; 6]>, SpecError> {
        let incomplete = |given, missing| Err(SpecError::Incomplete { given, missing });
        let ([fx, fy, fz], [tx, ty, tz]) = match (self.full_scale_n, self.full_scale_nm) {
            (None, None) => return Ok(None),
            (Some(_), None) => return incomplete("full_scale_n", "full_scale_nm"),
            (None, Some(_)) => return incomplete("full_scale_nm", "full_scale_n"),
            (Some(force), Some(torque)) => (force, torque),
        };
        let all = [fx, fy, fz, tx, ty, tz];
        for (axis, value) in all.into_iter().enumerate() {
            // The upper end is what a board can tell in its 16 bits.
            let legal =
                value.is_finite() && value <= f64::from(u16::MAX) && (value > 0.0 || (zero_allowed && value == 0.0));
            if !legal {
                let key = if axis < 3 { "full_scale_n" } else { "full_scale_nm" };
                return Err(SpecError::Key {
                    key,
                    value,
                    expected: "above 0 and at most 65535",
                });
            }
        }
        Ok(Some(all))
    }
}

/// One frame of a pair.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Half {
    counts: [u16; 3],
    /// Its saturation byte, 0 if there is none.
    saturation: u8,
}

impl Half {
    fn parse(data: &[u8]) -> Result<Self, Counter> {
        let saturation = match *data {
            [_, _, _, _, _, _] => 0,
            // The flag is what the byte is there for, and two bits of a gauge are never both set.
            [_, _, _, _, _, _, sat] if sat & 3 == 1 && sat & sat >> 1 & 0b0101_0100 == 0 => sat,
            [_, _, _, _, _, _, _] => return Err(Counter::Value),
            _ => return Err(Counter::Length),
        };
        Ok(Self {
            counts: [icub::u16_le(data, 0), icub::u16_le(data, 2), icub::u16_le(data, 4)],
            saturation,
        })
    }

    /// `quality` with what this half says of gauges `first..first + 3`.
    fn mark(self, mut quality: Quality, first: u32) -> Quality {
        if self.saturation == 0 {
            return quality;
        }
        quality |= Quality::SATURATED;
        for k in 0..3 {
            let saturation = match self.saturation >> (2 * (k + 1)) & 3 {
                1 => Saturation::Low,
                2 => Saturation::High,
                _ => Saturation::None,
            };
            quality = quality.with_saturation(first + k, saturation);
        }
        quality
    }

    fn frame(self, id: Id) -> Frame {
        let [[a, b], [c, d], [e, f]] = self.counts.map(u16::to_le_bytes);
        if self.saturation == 0 {
            Frame::new(id, &[a, b, c, d, e, f])
        } else {
            Frame::new(id, &[a, b, c, d, e, f, self.saturation])
        }
    }
}

/// The full scales: configured, or asked for one axis after the other, or overheard.
#[derive(Debug)]
struct FullScales {
    /// A configured scale, or none to be known because only raw gauges are streamed: nothing to ask.
    settled: bool,
    /// N or Nm per step of the stream, once all six are known.
    per_step: Option<[f64; 6]>,
    told: [Option<u16>; 6],
    refusal: Option<Refusal>,
    address: u8,
    /// The axis being asked for; 6: all answered.
    axis: u8,
    attempts: u8,
    /// When the next question may go.
    ask_at: Nanos,
    /// Questions per axis whose answers may still come, until `counts_until`.
    open: [u8; 6],
    counts_until: Nanos,
}

impl FullScales {
    fn new(address: u8, configured: Option<[f64; 6]>, stream: Stream) -> Self {
        Self {
            settled: configured.is_some() || stream == Stream::Uncalibrated,
            per_step: configured.map(|all| all.map(|full_scale| full_scale / STEPS)),
            told: [None; 6],
            refusal: None,
            address,
            axis: 0,
            attempts: 0,
            ask_at: Nanos::MIN,
            open: [0; 6],
            counts_until: Nanos::MIN,
        }
    }

    /// Takes an answer of the board: `[18, axis, high, low]`.
    fn answer(&mut self, data: &[u8], mode: Mode, frame: &Frame, out: &mut Decoded) {
        let &[_, channel, high, low] = data else {
            return out.fault(Counter::Length, 1, frame.id);
        };
        if channel >> 4 != 0 {
            // Of a regulation set that is stored, not of the one in use.
            if channel & 0xF > 5 || channel >> 4 > 3 {
                out.fault(Counter::Value, 1, frame.id);
            }
            return;
        }
        let axis = usize::from(channel);
        let (Some(told), Some(open)) = (self.told.get_mut(axis), self.open.get_mut(axis)) else {
            return out.fault(Counter::Value, 1, frame.id);
        };
        let value = u16::from_be_bytes([high, low]);
        let differs = told.is_some_and(|known| known != value);
        if differs {
            out.fault(Counter::Changed, 1, frame.id);
        }
        if mode == Mode::Supervise {
            if *open == 0 || frame.t > self.counts_until {
                return out.fault(Counter::Unexpected, 1, frame.id);
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
            // Asked again, slowly: it may be repaired while we run.
            self.attempts = icub::ATTEMPTS;
            self.ask_at = frame.t + icub::SLOW_ATTEMPT;
            return;
        }
        *told = Some(value);
        if channel == self.axis {
            self.axis += 1;
            self.attempts = 0;
            self.ask_at = Nanos::MIN;
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

impl Inquiry for FullScales {
    fn begin(&mut self) {
        self.axis = 0;
        self.attempts = 0;
        self.ask_at = Nanos::MIN;
    }

    fn poll(&mut self, now: Nanos) -> Ask {
        if self.settled || self.axis > 5 {
            return Ask::Done;
        }
        if self.refusal == Some(Refusal::Changed) || now < self.ask_at {
            return Ask::Wait;
        }
        if self.attempts < icub::ATTEMPTS {
            self.attempts += 1;
            self.ask_at = now + icub::ANSWER_TIMEOUT;
        } else {
            if self.per_step.is_none() && self.refusal.is_none() {
                self.refusal = Some(Refusal::NoFullScale);
            }
            self.ask_at = now + icub::SLOW_ATTEMPT;
        }
        if now > self.counts_until {
            self.open = [0; 6];
        }
        if let Some(open) = self.open.get_mut(usize::from(self.axis)) {
            *open = open.saturating_add(1);
        }
        self.counts_until = now + icub::ANSWER_COUNTS;
        Ask::Send(Frame::new(
            icub::to_board(class::POLLING_ANALOG, self.address),
            &[command::GET_FULL_SCALES, self.axis],
        ))
    }

    fn wake(&self) -> Option<Nanos> {
        (self.refusal != Some(Refusal::Changed)).then_some(self.ask_at)
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
    first: Half,
    second: Half,
    quality: Quality,
}

/// One of the two streams: its halves, and whether a reading was lost since the last.
#[derive(Debug)]
struct Pair {
    pairing: Pairing<Half>,
    gap: bool,
}

impl Pair {
    const fn new(timeout: Nanos) -> Self {
        Self {
            pairing: Pairing::new(timeout, true),
            gap: false,
        }
    }

    /// Takes a half; yields both, and what is known against them.
    fn push(&mut self, second: bool, data: &[u8], frame: &Frame, out: &mut Decoded) -> Option<Whole> {
        let half = match Half::parse(data) {
            Ok(half) => half,
            Err(counter) => {
                out.fault(counter, 1, frame.id);
                self.gap = true;
                return None;
            }
        };
        let mut unpaired = 0;
        let paired = self.pairing.push(second, frame, half, &mut unpaired);
        if unpaired > 0 {
            out.fault(Counter::Unpaired, unpaired, frame.id);
            self.gap = true;
        }
        let Paired::With(acquired, stamp, first) = paired else {
            return None;
        };
        let quality = half.mark(first.mark(Quality::GOOD, 0), 3);
        Some(Whole {
            acquired,
            stamp,
            first,
            second: half,
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
pub struct Strain {
    address: u8,
    claims: ArrayVec<Claim, 7>,
    bringup: Bringup,
    scales: FullScales,
    calibrated: Pair,
    raw: Pair,
    /// A reading has been given: from then on a restart leaves a gap.
    seen: bool,
}

impl Strain {
    /// A board that nothing is known of yet.
    ///
    /// # Errors
    /// [`SpecError`]: an address outside 1 to 14, joints, a period or time out of range, a full scale that is not positive
    /// or not complete.
    pub fn new(spec: &Spec, options: &Options) -> Result<Self, SpecError> {
        let address = icub::address(spec)?;
        icub::no_joints(spec)?;
        let period = icub::period_ms("period_ms", options.period_ms)?;
        let configured = options.full_scale(false)?;
        let silence = icub::power_on_silence(options.power_on_silence_ms)?;
        let timeout = match options.pair_timeout_ms {
            None => Nanos::from_micros(i64::from(period) * 500),
            Some(ms) if ms.is_finite() && ms > 0.0 && ms <= 1000.0 => Nanos::from_seconds(ms * 1e-3),
            Some(value) => {
                return Err(SpecError::Key {
                    key: "pair_timeout_ms",
                    value,
                    expected: "above 0 and at most 1000",
                });
            }
        };
        let mode = if options.listen { Mode::Listen } else { spec.mode };
        let (force, command_id) = (
            icub::stream(class::PERIODIC_ANALOG, address, kind::FORCE),
            icub::to_board(class::POLLING_ANALOG, address),
        );
        let watched = match options.stream {
            Stream::Uncalibrated => icub::stream(class::PERIODIC_ANALOG, address, kind::RAW_FORCE),
            Stream::Calibrated | Stream::Both => force,
        };
        let mut bringup = Bringup::new(spec, mode, silence, watched);
        bringup.start_with(command_id, &[command::SET_CANDATARATE, period]);
        if let Some(seconds) = options.temperature_period_s {
            let seconds = icub::period_ms("temperature_period_s", seconds)?;
            bringup.start_with(command_id, &[command::THERMOMETER_CONFIG_SET, 1]);
            bringup.start_with(command_id, &[command::THERMOMETER_TRANSMIT, seconds]);
            bringup.stop_with(command_id, &[command::THERMOMETER_TRANSMIT, 0]);
        }
        bringup.start_with(command_id, &[command::SET_TXMODE, options.stream.code()]);
        bringup.stop_with(command_id, &[command::SET_TXMODE, 1]);
        let mut claims: ArrayVec<Claim, 7> = icub::claims(
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
        Ok(Self {
            address,
            claims,
            bringup,
            scales: FullScales::new(address, configured, options.stream),
            calibrated: Pair::new(timeout),
            raw: Pair::new(timeout),
            seen: false,
        })
    }

    /// Gives a reading that two frames make up.
    fn give(&mut self, whole: &Whole, quality: Quality, reading: Reading, frame: &Frame, out: &mut Decoded) {
        self.seen = true;
        if quality.contains(Quality::SATURATED) {
            out.fault(Counter::Saturated, 1, frame.id);
        }
        let gap = if self.bringup.reading(frame.t) {
            Quality::GAP_BEFORE
        } else {
            Quality::GOOD
        };
        let output = device::Output {
            output: 0,
            acquired: whole.acquired,
            stamp: whole.stamp,
            device_counter: 0,
            quality: quality | gap,
            reading,
        };
        out.push(output, frame.id);
    }

    fn wrench(&mut self, second: bool, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let Some(whole) = self.calibrated.push(second, data, frame, out) else {
            return;
        };
        let Some(per_step) = self.scales.per_step else {
            if self.bringup.mode() == Mode::Listen && !self.scales.settled && self.scales.refusal.is_none() {
                // Nobody has told the scale of a board that streams already, and nobody will ask on our behalf.
                self.scales.refusal = Some(Refusal::NoFullScale);
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
        let quality = whole.quality | frozen | self.calibrated.take_gap();
        self.give(&whole, quality, reading, frame, out);
    }

    fn gauges(&mut self, second: bool, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let Some(whole) = self.raw.push(second, data, frame, out) else {
            return;
        };
        let ([a, b, c], [d, e, f]) = (whole.first.counts, whole.second.counts);
        let reading = Reading::Gauges(Gauges {
            counts: [a, b, c, d, e, f].map(i32::from),
        });
        let quality = whole.quality | self.raw.take_gap();
        self.give(&whole, quality, reading, frame, out);
    }
}

impl Device for Strain {
    fn kind(&self) -> Kind {
        Kind::Wrench
    }

    fn claims(&self) -> &[Claim] {
        &self.claims
    }

    fn on_frame(&mut self, frame: &Frame, out: &mut Decoded) {
        if !self.bringup.active() {
            return;
        }
        if let Some(stream) = icub::stream_type(frame.id, class::PERIODIC_ANALOG, self.address) {
            let known = matches!(stream, kind::RAW_FORCE..=kind::TORQUE | kind::THERMOMETER..);
            let Some(data) = known.then(|| icub::payload(frame, out)).flatten() else {
                return;
            };
            match stream {
                kind::FORCE => self.wrench(false, data, frame, out),
                kind::TORQUE => self.wrench(true, data, frame, out),
                kind::RAW_FORCE => self.gauges(false, data, frame, out),
                kind::RAW_TORQUE => self.gauges(true, data, frame, out),
                _ => temperature(data, frame, out),
            }
        } else if frame.id == icub::to_host(class::POLLING_ANALOG, self.address)
            && let Some(data) = icub::payload(frame, out)
        {
            match data.first() {
                Some(&command::GET_FULL_SCALES) => self.scales.answer(data, self.bringup.mode(), frame, out),
                // Answers to other questions are for others.
                Some(_) => {}
                None => out.fault(Counter::Length, 1, frame.id),
            }
        }
    }

    fn poll_transmit(&mut self, now: Nanos, out: &mut Decoded) -> Option<Transmit> {
        self.bringup.poll(now, &mut self.scales, out)
    }

    fn next_wake(&self) -> Option<Nanos> {
        self.bringup.next_wake(&self.scales)
    }

    fn state(&self) -> State {
        self.bringup.state(&self.scales)
    }

    fn stop(&mut self, _now: Nanos) {
        self.bringup.stop();
    }

    fn restart(&mut self, _now: Nanos) {
        self.bringup.restart();
        for pair in [&mut self.calibrated, &mut self.raw] {
            pair.pairing.reset();
            pair.gap |= self.seen;
        }
    }
}

/// The reading of a thermometer frame.
fn temperature(data: &[u8], frame: &Frame, out: &mut Decoded) {
    match *data {
        [mask, _, _, _, _] if mask & 1 == 1 => {
            let celsius = f64::from(icub::i16_le(data, 1)) * CELSIUS_PER_LSB;
            let output = device::Output {
                output: 0,
                acquired: frame.t,
                stamp: frame.stamp,
                device_counter: 0,
                quality: Quality::GOOD,
                reading: Reading::Temperature(Temperature { celsius }),
            };
            out.push(output, frame.id);
        }
        [_, _, _, _, _] => out.fault(Counter::Value, 1, frame.id),
        _ => out.fault(Counter::Length, 1, frame.id),
    }
}

/// The board's own side.
///
/// It behaves as a strain2 with the unit calibration matrix: its raw gauges are its axes. Its memory holds the configured
/// full scales, else 1804 N and 31 Nm.
#[derive(Debug)]
pub struct StrainBoard {
    address: u8,
    full_scale: [f64; 6],
    /// Its reader knows the scale: from the same configuration, or by having asked.
    scale_known: bool,
    period: Nanos,
    /// What it was told to stream; `None` while it is silent.
    stream: Option<Stream>,
    /// The counts of the last vector that was not saturated.
    last_good: Option<[u16; 6]>,
}

impl StrainBoard {
    /// A board just powered. With `listen` somebody else has started it already.
    ///
    /// # Errors
    /// As [`Strain::new`], but a full scale of zero is legal: a board with a corrupt memory.
    pub fn new(spec: &Spec, options: &Options) -> Result<Self, SpecError> {
        let address = icub::address(spec)?;
        icub::no_joints(spec)?;
        let configured = options.full_scale(true)?;
        let period = Nanos::from_millis(i64::from(icub::period_ms("period_ms", options.period_ms)?));
        Ok(Self {
            address,
            full_scale: configured.unwrap_or(USUAL_FULL_SCALE),
            scale_known: configured.is_some(),
            period,
            stream: options.listen.then_some(options.stream),
            last_good: None,
        })
    }

    /// The frames of both halves.
    fn send(&self, first_kind: u8, counts: [u16; 6], saturation: [u8; 2], out: &mut Frames) {
        let [a, b, c, d, e, f] = counts;
        for (kind, counts, saturation) in [
            (first_kind, [a, b, c], saturation[0]),
            (first_kind + 1, [d, e, f], saturation[1]),
        ] {
            let id = icub::stream(class::PERIODIC_ANALOG, self.address, kind);
            let _ = out.try_push(Half { counts, saturation }.frame(id));
        }
    }
}

/// The saturation bytes of both frames for what `quality` tells.
fn saturation_bytes(quality: Quality) -> [u8; 2] {
    if !quality.contains(Quality::SATURATED) {
        return [0, 0];
    }
    let byte = |first: u32| {
        (0..3).fold(1_u8, |byte, k| {
            let code = match quality.saturation(first + k) {
                Saturation::None => 0,
                Saturation::Low => 1,
                Saturation::High => 2,
            };
            byte | code << (2 * (k + 1))
        })
    };
    [byte(0), byte(3)]
}

impl Board for StrainBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        icub::answer_management(frame, class::POLLING_ANALOG, self.address, icub::board::STRAIN2, out);
        match icub::command_for(frame, class::POLLING_ANALOG, self.address) {
            Some(&[command::GET_FULL_SCALES, channel]) => {
                let Some(&full_scale) = self.full_scale.get(usize::from(channel & 0xF)) else {
                    return;
                };
                #[allow(clippy::cast_sign_loss, clippy::cast_possible_truncation)] // limited to 16 bits
                let [high, low] = (icub::quantise(full_scale, 1.0, 0, i64::from(u16::MAX)) as u16).to_be_bytes();
                let id = icub::to_host(class::POLLING_ANALOG, self.address);
                let _ = out.try_push(Frame::new(id, &[command::GET_FULL_SCALES, channel, high, low]));
                self.scale_known = true;
            }
            Some(&[command::SET_CANDATARATE, ms]) if ms > 0 => self.period = Nanos::from_millis(i64::from(ms)),
            Some(&[command::SET_TXMODE, mode]) => self.stream = Stream::from_code(mode),
            _ => {}
        }
    }

    fn period(&self) -> Option<Nanos> {
        self.stream.is_some().then_some(self.period)
    }

    fn encode(&mut self, output: u8, reading: &Reading, quality: Quality, out: &mut Frames) -> Result<(), EncodeError> {
        if output != 0 {
            return Err(EncodeError::Output(output));
        }
        match reading {
            Reading::Wrench(wrench) => {
                let ([fx, fy, fz], [tx, ty, tz]) = (wrench.force, wrench.torque);
                let values = [fx, fy, fz, tx, ty, tz];
                if !values.iter().all(|value| value.is_finite()) {
                    return Err(EncodeError::NotFinite);
                }
                if !self.scale_known {
                    return Err(EncodeError::NoFullScale);
                }
                let mut quality = quality;
                let mut counts = [ZERO; 6];
                for (axis, ((count, value), full_scale)) in
                    (0..).zip(counts.iter_mut().zip(values).zip(self.full_scale))
                {
                    // A full scale of zero (a corrupt memory) makes a board say zero, whatever it feels.
                    let per_step = if full_scale > 0.0 {
                        full_scale / STEPS
                    } else {
                        f64::INFINITY
                    };
                    let steps =
                        icub::quantise(value, per_step, i64::from(i32::MIN), i64::from(i32::MAX)) + i64::from(ZERO);
                    *count = u16::try_from(steps).unwrap_or_else(|_| {
                        let high = steps > 0;
                        quality = quality.with_saturation(axis, if high { Saturation::High } else { Saturation::Low });
                        if high { u16::MAX } else { 0 }
                    });
                }
                let raw = counts;
                if !quality.contains(Quality::SATURATED) {
                    self.last_good = Some(counts);
                } else if !quality.contains(Quality::FROZEN) {
                    // (A reading that is FROZEN already is a recorded one: it *is* the last good vector.)
                    counts = self.last_good.unwrap_or(counts);
                }
                let saturation = saturation_bytes(quality);
                // A board that nobody started yet encodes a recording: a wrench is a calibrated reading there.
                let stream = self.stream.unwrap_or_default();
                if stream != Stream::Uncalibrated {
                    self.send(kind::FORCE, counts, saturation, out);
                }
                if stream != Stream::Calibrated {
                    self.send(kind::RAW_FORCE, raw, saturation, out);
                }
            }
            Reading::Gauges(gauges) => {
                #[allow(clippy::cast_sign_loss, clippy::cast_possible_truncation)] // limited to 16 bits
                let counts = gauges.counts.map(|count| count.clamp(0, i32::from(u16::MAX)) as u16);
                self.send(kind::RAW_FORCE, counts, saturation_bytes(quality), out);
            }
            Reading::Temperature(Temperature { celsius }) => {
                if !celsius.is_finite() {
                    return Err(EncodeError::NotFinite);
                }
                let [low, high] = icub::quantise_i16(*celsius, CELSIUS_PER_LSB).to_le_bytes();
                let id = icub::stream(class::PERIODIC_ANALOG, self.address, kind::THERMOMETER);
                let _ = out.try_push(Frame::new(id, &[1, low, high, 0, 0]));
            }
            Reading::Joint(_) | Reading::Imu(_) | Reading::Actuator(_) => return Err(EncodeError::Kind),
        }
        Ok(())
    }
}
