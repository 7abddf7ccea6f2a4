//! The driver `icub_motor`: iCub 2FOC motor boards. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_motor.md")]

use crate::bringup::{Bringup, NoInquiry};
use crate::bytes;
use crate::family::{Family, Link, Supervised};
use crate::icub::{self, class};
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{
    Board, Claim, Decoded, Device, Driver, EncodeError, Frame, Frames, Mode, Output, OutputInfo,
    Spec, SpecError,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use core::f64::consts::TAU;
use proprio_topics::{Actuator, Counter, JointState, Kind, Nanos, Quality, Reading};
use serde::Deserialize;

/// Types of the streams.
mod kind {
    pub(super) const TWO_FOC: u8 = 0x0;
    pub(super) const STATUS: u8 = 0x3;
    pub(super) const OVERFLOW: u8 = 0x5;
    pub(super) const ADDITIONAL_STATUS: u8 = 0xC;
}

/// Bits of `Actuator::faults`.
pub mod fault {
    /// An illegal command was received.
    pub const CAN_INVALID_PROTOCOL: u32 = 1;
    /// Impossible order of Hall sensor states.
    pub const HALL_SEQUENCE: u32 = 1 << 1;
    /// Checksum of the absolute encoder.
    pub const ENCODER_CHECKSUM: u32 = 1 << 2;
    /// Impossible Hall sensor state.
    pub const HALL_VALUE: u32 = 1 << 3;
    /// Current above its limit.
    pub const OVER_CURRENT: u32 = 1 << 4;
    /// Supply above its limit.
    pub const OVER_VOLTAGE: u32 = 1 << 5;
    /// Supply below its limit.
    pub const UNDER_VOLTAGE: u32 = 1 << 6;
    /// Emergency button pressed.
    pub const EXTERNAL: u32 = 1 << 7;
    /// Temperature above its limit.
    pub const OVER_HEATING: u32 = 1 << 9;
    /// No command in time.
    pub const SETPOINT_EXPIRED: u32 = 1 << 14;
    /// Calculation of the absolute encoder.
    pub const ENCODER_CALCULATION: u32 = 1 << 17;
    /// Timing of the SPI bus to the encoder.
    pub const SPI_TIMING: u32 = 1 << 18;
    /// Position encoder fault.
    pub const ENCODER: u32 = 1 << 19;
    /// Mean current above its limit.
    pub const I2T: u32 = 1 << 22;
    /// Bits that make a position doubtful.
    pub const POSITION: u32 =
        HALL_SEQUENCE | ENCODER_CHECKSUM | HALL_VALUE | ENCODER_CALCULATION | SPI_TIMING | ENCODER;
    /// Bits that concern only the bus: 10 to 13 (warning and passive states), 15 (buffer overrun),
    /// 27 to 31 (illegal length, past states, remote requests). Past states stay set until the
    /// board is reset.
    pub const BUS: u32 = 0b1111 << 10 | 1 << 15 | 0b11111 << 27;
    /// All others: the drive has a fault, and the position is good.
    pub const DRIVE: u32 = !(POSITION | BUS);
}

/// Bits of `Actuator::encoder`.
pub mod encoder {
    /// Any of dirty, stuck, index broken, phase broken.
    pub const BROKEN: u32 = 0b1111;
    /// Not calibrated.
    pub const NOT_CALIBRATED: u32 = 1 << 4;
}

/// Values of `Actuator::mode` that affect the quality.
pub mod mode {
    /// The power stage or its supervision failed.
    pub const HARDWARE_FAULT: u32 = 0xA0;
    /// The board has not received its motor's parameters.
    pub const NOT_CONFIGURED: u32 = 0xB0;
    /// All modes.
    pub const ALL: [u32; 8] = [0, 1, 6, 9, 0x0A, 0x50, HARDWARE_FAULT, NOT_CONFIGURED];
}

/// One icubdeg \[rad\].
const RAD_PER_LSB: f64 = TAU / 65536.0;
/// One icubdeg per ms \[rad/s\].
const RAD_PER_S_PER_LSB: f64 = RAD_PER_LSB * 1000.0;
/// One step of current \[A\].
const AMPERE_PER_LSB: f64 = 1e-3;
/// One step of duty.
const DUTY_PER_LSB: f64 = 1.0 / 32000.0;

/// The keys of `driver = "icub_motor"`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IcubMotorOptions {
    /// Period of its commander's requests \[ms\], 1 to 255; default 1.
    pub period_ms: u32,
    /// Whether readings contain the board's velocity; default true.
    pub velocity: bool,
}

impl Default for IcubMotorOptions {
    fn default() -> Self {
        Self {
            period_ms: 1,
            velocity: true,
        }
    }
}

impl Driver for IcubMotorOptions {
    const NAME: &'static str = "icub_motor";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Joint)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Motor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MotorBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let types = [
            icub::board::TWO_FOC,
            icub::board::AMCBLDC,
            icub::board::AMC2C,
            icub::board::AMCFOC2C,
        ];
        icub::recognise(seen, Self::NAME, &types, &[], |evidence, address, _| {
            let id = |kind| icub::stream(class::PERIODIC_MOTOR, address, kind);
            let motion = evidence.sends_length(id(kind::TWO_FOC), 8);
            let is_status = |frame: &Frame| match *frame.data() {
                [mode, encoder, _, _, _, _, _, _] => {
                    mode::ALL.contains(&u32::from(mode)) && encoder < 32
                }
                _ => false,
            };
            // Older boards have a status of the same identifier.
            if let Some(motion) = motion {
                if let Some(status) = evidence.sends(id(kind::STATUS), is_status) {
                    evidence.together(motion, status);
                }
                evidence.sends_length(id(kind::ADDITIONAL_STATUS), 4);
            }
            let keys = Key::period_ms(motion.and_then(Stream::period), 1, 255);
            (keys.into_iter().collect(), Vec::from([0]))
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}

/// The quality flags of the readings after a status frame.
fn quality_of(actuator: &Actuator) -> Quality {
    let mut quality = Quality::GOOD;
    if actuator.encoder & encoder::BROKEN != 0 || actuator.faults & fault::POSITION != 0 {
        quality |= Quality::DEVICE_FAULT;
    }
    if actuator.faults & fault::DRIVE != 0 || actuator.mode == mode::HARDWARE_FAULT {
        quality |= Quality::DRIVE_FAULT;
    }
    if actuator.encoder & encoder::NOT_CALIBRATED != 0 || actuator.mode == mode::NOT_CONFIGURED {
        quality |= Quality::NOT_CALIBRATED;
    }
    quality
}

/// The host's side of a motor board.
#[derive(Debug)]
struct Motor {
    address: u8,
    velocity: bool,
    /// The quality from the last status.
    status: Quality,
}

impl Motor {
    fn device(spec: &Spec, options: &IcubMotorOptions) -> Result<Box<dyn Device>, SpecError> {
        let address = icub::address(spec)?;
        icub::period_ms("period_ms", options.period_ms)?;
        let kinds = [
            kind::TWO_FOC,
            kind::STATUS,
            kind::ADDITIONAL_STATUS,
            kind::OVERFLOW,
        ];
        let watched = icub::stream(class::PERIODIC_MOTOR, address, kind::TWO_FOC);
        let claims: ArrayVec<Claim, 4> = icub::claims(class::PERIODIC_MOTOR, address, &kinds);
        let bringup = Bringup::new(spec, Mode::Listen, icub::TIMING, watched);
        let this = Self {
            address,
            velocity: options.velocity,
            status: Quality::GOOD,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }

    fn motion(&self, data: &[u8], frame: &Frame, link: &mut Link<NoInquiry>, out: &mut Decoded) {
        let mut quality = self.status;
        if quality.contains(Quality::DEVICE_FAULT) {
            out.fault(Counter::DeviceFault, 1, frame.id);
        }
        if quality.contains(Quality::DRIVE_FAULT) {
            out.fault(Counter::DriveFault, 1, frame.id);
        }
        if link.bringup.reading(frame.t) {
            quality |= Quality::GAP_BEFORE;
        }
        let velocity = f64::from(bytes::i16_le(data, 2)) * RAD_PER_S_PER_LSB;
        let reading = Reading::Joint(JointState {
            position: f64::from(bytes::u32_le(data, 4).cast_signed()) * RAD_PER_LSB,
            velocity: if self.velocity { velocity } else { f64::NAN },
            current: f64::from(bytes::i16_le(data, 0)) * AMPERE_PER_LSB,
            ..JointState::ABSENT
        });
        out.push(Output::new(0, frame, quality, reading), frame.id);
    }

    fn status(&mut self, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let &[mode, encoder, ..] = data else { return };
        let actuator = Actuator {
            duty: f64::from(bytes::i16_le(data, 2)) * DUTY_PER_LSB,
            mode: u32::from(mode),
            encoder: u32::from(encoder),
            faults: bytes::u32_le(data, 4),
        };
        self.status = quality_of(&actuator);
        out.push(
            Output::new(0, frame, self.status, Reading::Actuator(actuator)),
            frame.id,
        );
    }
}

impl Family for Motor {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &Frame, link: &mut Link<NoInquiry>, out: &mut Decoded) {
        let Some(stream) = icub::stream_type(frame.id, class::PERIODIC_MOTOR, self.address) else {
            return;
        };
        if !matches!(
            stream,
            kind::TWO_FOC | kind::STATUS | kind::ADDITIONAL_STATUS | kind::OVERFLOW
        ) {
            return;
        }
        let Some(data) = bytes::payload(frame, out) else {
            return;
        };
        match (stream, data.len()) {
            (kind::TWO_FOC, 8) => self.motion(data, frame, link, out),
            (kind::STATUS, 8) => self.status(data, frame, out),
            (kind::ADDITIONAL_STATUS, 4) => {}
            (kind::OVERFLOW, _) => out.fault(Counter::DeviceFault, 1, frame.id),
            _ => out.fault(Counter::Length, 1, frame.id),
        }
    }

    fn reset(&mut self) {
        self.status = Quality::GOOD;
    }
}

/// The board's own side: it streams without commands, as if it were commanded once a period.
#[derive(Debug)]
pub struct MotorBoard {
    address: u8,
    period: Nanos,
    velocity: bool,
    /// The quality in its last status.
    status: Quality,
}

impl MotorBoard {
    /// A board that streams at once.
    ///
    /// # Errors
    /// [`SpecError`]: an address outside 1 to 14, a period out of range.
    pub fn new(spec: &Spec, options: &IcubMotorOptions) -> Result<Self, SpecError> {
        let period =
            Nanos::from_millis(i64::from(icub::period_ms("period_ms", options.period_ms)?));
        Ok(Self {
            address: icub::address(spec)?,
            period,
            velocity: options.velocity,
            status: Quality::GOOD,
        })
    }

    fn send_status(&mut self, actuator: &Actuator, out: &mut Frames) -> Result<(), EncodeError> {
        if !actuator.duty.is_finite() {
            return Err(EncodeError::NotFinite);
        }
        #[allow(clippy::cast_possible_truncation)] // both are bytes on the wire
        let (mode, encoder) = (actuator.mode as u8, actuator.encoder as u8);
        #[allow(clippy::cast_possible_truncation)] // limited to 16 bits
        let [d0, d1] =
            (bytes::quantise(actuator.duty, DUTY_PER_LSB, -32000, 32000) as i16).to_le_bytes();
        let [f0, f1, f2, f3] = actuator.faults.to_le_bytes();
        let id = icub::stream(class::PERIODIC_MOTOR, self.address, kind::STATUS);
        let _ = out.try_push(Frame::new(id, &[mode, encoder, d0, d1, f0, f1, f2, f3]));
        self.status = quality_of(actuator);
        Ok(())
    }
}

impl Board for MotorBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        icub::answer_management(
            frame,
            class::POLLING_MOTOR,
            self.address,
            icub::board::TWO_FOC,
            out,
        );
    }

    fn period(&self) -> Option<Nanos> {
        Some(self.period)
    }

    /// If the faults differ from the last status, a status frame precedes the joint reading. The
    /// frame has no field for torque and acceleration; an absent current is sent as 0.
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        if output != 0 {
            return Err(EncodeError::Output(output));
        }
        match reading {
            Reading::Joint(joint) => {
                let velocity = if self.velocity { joint.velocity } else { 0.0 };
                if !joint.position.is_finite() || !velocity.is_finite() {
                    return Err(EncodeError::NotFinite);
                }
                let told = Quality::DEVICE_FAULT | Quality::DRIVE_FAULT | Quality::NOT_CALIBRATED;
                if self.status.0 & told.0 != quality.0 & told.0 {
                    let mut actuator = Actuator {
                        duty: 0.0,
                        mode: 6,
                        encoder: 0,
                        faults: 0,
                    };
                    if quality.contains(Quality::DEVICE_FAULT) {
                        actuator.faults |= fault::ENCODER;
                    }
                    if quality.contains(Quality::DRIVE_FAULT) {
                        actuator.faults |= fault::EXTERNAL;
                    }
                    if quality.contains(Quality::NOT_CALIBRATED) {
                        actuator.encoder = encoder::NOT_CALIBRATED;
                    }
                    self.send_status(&actuator, out)?;
                }
                let current = if joint.current.is_finite() {
                    joint.current
                } else {
                    0.0
                };
                let [c0, c1] = bytes::quantise_i16(current, AMPERE_PER_LSB).to_le_bytes();
                let [v0, v1] = bytes::quantise_i16(velocity, RAD_PER_S_PER_LSB).to_le_bytes();
                let position = bytes::quantise(
                    joint.position,
                    RAD_PER_LSB,
                    i64::from(i32::MIN),
                    i64::from(i32::MAX),
                );
                #[allow(clippy::cast_possible_truncation)] // limited to 32 bits
                let [p0, p1, p2, p3] = (position as i32).to_le_bytes();
                let id = icub::stream(class::PERIODIC_MOTOR, self.address, kind::TWO_FOC);
                let _ = out.try_push(Frame::new(id, &[c0, c1, v0, v1, p0, p1, p2, p3]));
                Ok(())
            }
            Reading::Actuator(actuator) => self.send_status(actuator, out),
            _ => Err(EncodeError::Kind),
        }
    }
}
