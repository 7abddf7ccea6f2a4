//! The driver `icub_pos`: iCub POS encoders. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_pos.md")]

use crate::bringup::Bringup;
use crate::bytes;
use crate::configure::{Configure, Setting};
use crate::family::{Family, Link, Supervised};
use crate::icub::{self, class, command};
use crate::recognise::{Finding, Key, Traffic};
use crate::{
    Board, Claim, Decoded, Device, Driver, EncodeError, Frame, Frames, Mode, Output, OutputInfo,
    Outputs, Spec, SpecError,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use core::f64::consts::TAU;
use proprio_topics::{Counter, JointState, Kind, Nanos, Quality, Reading};
use serde::Deserialize;

/// Type of the stream.
const POS: u8 = 1;
/// How many values fit a frame.
const VALUES: u8 = 3;
/// The highest label.
const LABEL_MOST: u8 = 15;
/// 0.1 deg \[rad\].
const RAD_PER_LSB: f64 = TAU / 3600.0;
/// 0.1 mm \[m\].
const METRE_PER_LSB: f64 = 1e-4;

/// What a POS board measures.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// Angles \[rad\].
    #[default]
    Angle,
    /// Lengths \[m\].
    Length,
}

impl Quantity {
    /// Its number in a frame, and one step \[rad or m\].
    const fn code_and_lsb(self) -> (u8, f64) {
        match self {
            Self::Angle => (0, RAD_PER_LSB),
            Self::Length => (1, METRE_PER_LSB),
        }
    }
}

/// The configuration of one sensor of a board.
#[derive(Debug, Clone, Copy, Default, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct Sensor {
    /// Its label, which is the joint's channel.
    pub label: u8,
    /// Negate its value; default false.
    pub inverted: bool,
    /// Added before the zero is subtracted \[deg\]: 0, 90, 180 or -90; default 0.
    pub rotation_deg: i32,
    /// The zero position \[deg\]; default 0.
    pub zero_deg: f64,
}

impl Sensor {
    /// Its three bytes in POS_CONFIG_SET.
    fn bytes(&self) -> Result<[u8; 3], SpecError> {
        let rotation = match self.rotation_deg {
            0 => 0,
            180 => 1,
            90 => 2,
            -90 => 3,
            other => {
                let expected = "0, 90, 180 or -90";
                return Err(SpecError::Key {
                    key: "rotation_deg",
                    value: f64::from(other),
                    expected,
                });
            }
        };
        if self.label > LABEL_MOST {
            return Err(SpecError::Key {
                key: "label",
                value: f64::from(self.label),
                expected: "at most 15",
            });
        }
        if !(self.zero_deg >= -360.0 && self.zero_deg <= 360.0) {
            return Err(SpecError::Key {
                key: "zero_deg",
                value: self.zero_deg,
                expected: "from -360 to 360",
            });
        }
        let [low, high] = bytes::quantise_i16(self.zero_deg, 0.1).to_le_bytes();
        Ok([
            0x80 | u8::from(self.inverted) << 6 | rotation << 4 | self.label,
            low,
            high,
        ])
    }
}

/// The keys of `driver = "icub_pos"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IcubPosOptions {
    /// Period \[ms\], 1 to 255; default 10.
    pub period_ms: u32,
    /// The quantity that the board sends; default angles.
    pub quantity: Quantity,
    /// Silence kept after power-on \[ms\]; default 0.
    pub power_on_silence_ms: u32,
    /// Configuration of its sensors, at most two; default: keep the board's own.
    pub sensors: Option<Vec<Sensor>>,
}

impl Default for IcubPosOptions {
    fn default() -> Self {
        Self {
            period_ms: 10,
            quantity: Quantity::Angle,
            power_on_silence_ms: 0,
            sensors: None,
        }
    }
}

impl IcubPosOptions {
    /// The bytes of POS_CONFIG_SET, if the sensors are to be configured.
    fn configuration(&self) -> Result<Option<[u8; 8]>, SpecError> {
        let Some(sensors) = &self.sensors else {
            return Ok(None);
        };
        let (first, second) = match sensors.as_slice() {
            [first] => (first.bytes()?, [0; 3]),
            [first, second] => (first.bytes()?, second.bytes()?),
            _ => {
                return Err(SpecError::Keys {
                    key: "sensors",
                    expected: "a list of one or two sensors",
                });
            }
        };
        let ([a, b, c], [d, e, f]) = (first, second);
        // Identity 0: all of a psc.
        Ok(Some([
            command::POS_CONFIG_SET,
            self.quantity.code_and_lsb().0,
            a,
            b,
            c,
            d,
            e,
            f,
        ]))
    }
}

impl Driver for IcubPosOptions {
    const NAME: &'static str = "icub_pos";

    fn outputs(&self) -> Vec<OutputInfo> {
        (0..=LABEL_MOST)
            .map(|label| OutputInfo::new(label, Kind::Joint))
            .collect()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Pos::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(PosBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let types = [icub::board::PSC, icub::board::MTB4];
        let maybe = [icub::board::MTB4];
        icub::recognise(seen, Self::NAME, &types, &maybe, |evidence, address, _| {
            let id = icub::stream(class::PERIODIC_ANALOG, address, POS);
            let stream = evidence.sends(id, |frame| match *frame.data() {
                [quantity, values, ref bytes @ ..] if frame.len() == 8 => {
                    let count = values & 0xF;
                    let (values, _) = bytes.as_chunks();
                    let mut own = values.iter().take(count.into());
                    // A length may be any.
                    let is_angle = |value| i16::from_le_bytes(value).unsigned_abs() <= 3600;
                    quantity < 2
                        && (1..=VALUES).contains(&count)
                        && own.all(|value| quantity == 1 || is_angle(*value))
                }
                _ => false,
            });
            let Some(stream) = stream else {
                return (Vec::new(), Vec::from([0, 1]));
            };
            let mut keys: Vec<Key> = Vec::new();
            let mut joints: Vec<u8> = Vec::new();
            for frame in stream.kept() {
                let &[quantity, values, ..] = frame.data() else {
                    continue;
                };
                let (label, count) = (values >> 4, values & 0xF);
                joints.extend(label..(label + count).min(LABEL_MOST + 1));
                if quantity == 1 && keys.is_empty() {
                    keys.push(Key::new("quantity", "\"length\""));
                }
            }
            joints.sort_unstable();
            joints.dedup();
            let first = |frame: &Frame| {
                let label = frame.data().get(1).map(|values| values >> 4);
                label == joints.first().copied()
            };
            keys.extend(Key::period_ms(stream.period_of(first), 1, 255));
            (keys, joints)
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}

/// The host's side of a POS board.
#[derive(Debug)]
struct Pos {
    address: u8,
    quantity: Quantity,
    outputs: Outputs,
    /// Labels whose next reading follows a gap, one bit each.
    gap: u16,
    /// Labels that have been read, one bit each.
    seen: u16,
}

impl Pos {
    fn device(spec: &Spec, options: &IcubPosOptions) -> Result<Box<dyn Device>, SpecError> {
        let address = icub::address(spec)?;
        let period = icub::period_ms("period_ms", options.period_ms)?;
        let timing = icub::timing(options.power_on_silence_ms)?;
        let watched = icub::stream(class::PERIODIC_ANALOG, address, POS);
        let mut bringup = Bringup::new(spec, spec.mode, timing, watched);
        let id = icub::to_board(class::POLLING_ANALOG, address);
        let setting = options.configuration()?.map(|set| Setting {
            get: Frame::new(
                id,
                &[command::POS_CONFIG_GET, options.quantity.code_and_lsb().0],
            ),
            set: Frame::new(id, &set),
            compared: 1..8,
        });
        bringup.start_with(id, &[command::POS_TRANSMIT, period]);
        bringup.stop_with(id, &[command::POS_TRANSMIT, 0]);
        let mut claims: ArrayVec<Claim, 2> = icub::claims(class::PERIODIC_ANALOG, address, &[POS]);
        if setting.is_some() {
            claims.push(Claim::shared(icub::to_host(class::POLLING_ANALOG, address)));
        }
        let configure = Configure::new(spec, setting, icub::TIMING);
        let this = Self {
            address,
            quantity: options.quantity,
            outputs: spec.outputs.clone(),
            gap: 0,
            seen: 0,
        };
        Ok(Supervised::boxed(claims, bringup, configure, this))
    }
}

impl Family for Pos {
    type Questions = Configure;

    fn on_frame(&mut self, frame: &Frame, link: &mut Link<Configure>, out: &mut Decoded) {
        if frame.id == icub::to_host(class::POLLING_ANALOG, self.address) {
            // Answers to other questions are for other devices.
            if let Some(data) = bytes::payload(frame, out)
                && data.first() == Some(&command::POS_CONFIG_GET)
            {
                link.questions.answer(data, frame, out);
            }
            return;
        }
        if icub::stream_type(frame.id, class::PERIODIC_ANALOG, self.address) != Some(POS) {
            return;
        }
        let Some(data) = bytes::payload(frame, out) else {
            return;
        };
        let &[quantity, label_and_count, ref values @ ..] = data else {
            return out.fault(Counter::Length, 1, frame.id);
        };
        if values.len() != 2 * usize::from(VALUES) {
            return out.fault(Counter::Length, 1, frame.id);
        }
        let (label, count) = (label_and_count >> 4, label_and_count & 0xF);
        let (code, lsb) = self.quantity.code_and_lsb();
        if quantity != code || !(1..=VALUES).contains(&count) || label + count - 1 > LABEL_MOST {
            return out.fault(Counter::Value, 1, frame.id);
        }
        if link.bringup.reading(frame.t) {
            self.gap = self.seen;
        }
        for (output, value) in (label..)
            .zip(values.chunks_exact(2))
            .take(usize::from(count))
        {
            if !self.outputs.0.contains(&output) {
                continue;
            }
            let bit = 1 << output;
            let mut quality = Quality::GOOD;
            if self.gap & bit != 0 {
                quality |= Quality::GAP_BEFORE;
            }
            if !link.questions.confirmed() {
                quality |= Quality::NOT_CALIBRATED;
            }
            self.gap &= !bit;
            self.seen |= bit;
            let position = f64::from(bytes::i16_le(value, 0)) * lsb;
            let reading = Reading::Joint(JointState {
                position,
                ..JointState::ABSENT
            });
            let output = Output::new(output, frame, quality, reading);
            out.push(output, frame.id);
        }
    }
}

/// The board's own side. It sends each value in a separate frame (n = 1), which the protocol
/// allows.
#[derive(Debug)]
pub struct PosBoard {
    address: u8,
    period: Nanos,
    streaming: bool,
    quantity: Quantity,
    /// The configuration received, in the form of POS_CONFIG_SET.
    configuration: [u8; 8],
}

impl PosBoard {
    /// A board after power-on; in [`Mode::Listen`] another program has already started it.
    ///
    /// # Errors
    /// [`SpecError`]: an address outside 1 to 14, a key out of range.
    pub fn new(spec: &Spec, options: &IcubPosOptions) -> Result<Self, SpecError> {
        options.configuration()?;
        let period =
            Nanos::from_millis(i64::from(icub::period_ms("period_ms", options.period_ms)?));
        Ok(Self {
            address: icub::address(spec)?,
            period,
            streaming: spec.mode == Mode::Listen,
            quantity: options.quantity,
            configuration: [0; 8],
        })
    }
}

impl Board for PosBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        icub::answer_management(
            frame,
            class::POLLING_ANALOG,
            self.address,
            icub::board::PSC,
            out,
        );
        match icub::command_for(frame, class::POLLING_ANALOG, self.address) {
            Some(&[command::POS_CONFIG_SET, a, b, c, d, e, f, g]) => {
                // As in the firmware, a new configuration stops the stream.
                self.streaming = false;
                self.configuration = [command::POS_CONFIG_SET, a, b, c, d, e, f, g];
            }
            Some(&[command::POS_CONFIG_GET, kind]) => {
                let [_, _, sensors @ ..] = self.configuration;
                let [b, c, d, e, f, g] = sensors;
                let id = icub::to_host(class::POLLING_ANALOG, self.address);
                let answer = [command::POS_CONFIG_GET, kind, b, c, d, e, f, g];
                let _ = out.try_push(Frame::new(id, &answer));
            }
            Some(&[command::POS_TRANSMIT, ms]) => {
                self.streaming = ms > 0;
                self.period = Nanos::from_millis(i64::from(ms));
            }
            _ => {}
        }
    }

    fn period(&self) -> Option<Nanos> {
        self.streaming.then_some(self.period)
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        _quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let Reading::Joint(joint) = reading else {
            return Err(EncodeError::Kind);
        };
        if output > LABEL_MOST {
            return Err(EncodeError::Output(output));
        }
        if !joint.position.is_finite() {
            return Err(EncodeError::NotFinite);
        }
        let (code, lsb) = self.quantity.code_and_lsb();
        let [low, high] = bytes::quantise_i16(joint.position, lsb).to_le_bytes();
        let id = icub::stream(class::PERIODIC_ANALOG, self.address, POS);
        let _ = out.try_push(Frame::new(
            id,
            &[code, output << 4 | 1, low, high, 0, 0, 0, 0],
        ));
        Ok(())
    }
}
