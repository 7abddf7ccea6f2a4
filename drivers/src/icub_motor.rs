//! The driver `icub_motor`: iCub 2FOC motor boards. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_motor.md")]

#[cfg(feature = "boards")]
mod board;
#[cfg(feature = "recognise")]
mod recognise;

use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::icub::{self, class};
use crate::received::Received;
use crate::{Device, Driver, Mode, OutputInfo, Spec, SpecError, bytes};
use alloc::boxed::Box;
use alloc::vec::Vec;
use core::f64::consts::TAU;
use proprio_topics::{Actuator, Counter, JointState, Kind, Quality, Reading};
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
    /// Impossible order of Hall sensor states.
    pub const HALL_SEQUENCE: u32 = 1 << 1;
    /// Checksum of the absolute encoder.
    pub const ENCODER_CHECKSUM: u32 = 1 << 2;
    /// Impossible Hall sensor state.
    pub const HALL_VALUE: u32 = 1 << 3;
    /// Current above its limit.
    pub const OVER_CURRENT: u32 = 1 << 4;
    /// Emergency button pressed.
    pub const EXTERNAL: u32 = 1 << 7;
    /// Calculation of the absolute encoder.
    pub const ENCODER_CALCULATION: u32 = 1 << 17;
    /// Timing of the SPI bus to the encoder.
    pub const SPI_TIMING: u32 = 1 << 18;
    /// Position encoder fault.
    pub const ENCODER: u32 = 1 << 19;
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
        let address = icub::address(spec)?;
        icub::period_ms("period_ms", self.period_ms)?;
        let kinds = [
            kind::TWO_FOC,
            kind::STATUS,
            kind::ADDITIONAL_STATUS,
            kind::OVERFLOW,
        ];
        let watched = icub::stream(class::PERIODIC_MOTOR, address, kind::TWO_FOC);
        let claims = icub::claims(class::PERIODIC_MOTOR, address, &kinds);
        let bringup = Bringup::new(spec, Mode::Listen, Timing::USUAL, watched);
        let this = TwoFoc {
            address,
            velocity: self.velocity,
            status: Quality::GOOD,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
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
struct TwoFoc {
    address: u8,
    velocity: bool,
    /// The quality from the last status.
    status: Quality,
}

impl TwoFoc {
    fn motion(&self, data: &[u8], frame: &mut Received<'_>, session: &mut Session) {
        let velocity = f64::from(bytes::i16_le(data, 2)) * RAD_PER_S_PER_LSB;
        let joint = JointState {
            position: f64::from(bytes::u32_le(data, 4).cast_signed()) * RAD_PER_LSB,
            velocity: if self.velocity { velocity } else { f64::NAN },
            current: f64::from(bytes::i16_le(data, 0)) * AMPERE_PER_LSB,
            ..JointState::ABSENT
        };
        session.joint(0, frame, self.status, joint);
    }

    fn status(&mut self, data: &[u8], frame: &mut Received<'_>) {
        let &[mode, encoder, ..] = data else { return };
        let actuator = Actuator {
            duty: f64::from(bytes::i16_le(data, 2)) * DUTY_PER_LSB,
            mode: u32::from(mode),
            encoder: u32::from(encoder),
            faults: bytes::u32_le(data, 4),
        };
        self.status = quality_of(&actuator);
        frame.tell(0, self.status, Reading::Actuator(actuator));
    }
}

impl Family for TwoFoc {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let Some(stream) = icub::stream_type(frame.id, class::PERIODIC_MOTOR, self.address) else {
            return;
        };
        if !matches!(
            stream,
            kind::TWO_FOC | kind::STATUS | kind::ADDITIONAL_STATUS | kind::OVERFLOW
        ) {
            return;
        }
        let Some(data) = frame.payload() else {
            return;
        };
        match (stream, data.len()) {
            (kind::TWO_FOC, 8) => self.motion(data, frame, session),
            (kind::STATUS, 8) => self.status(data, frame),
            (kind::ADDITIONAL_STATUS, 4) => {}
            (kind::OVERFLOW, _) => frame.fault(Counter::DeviceFault),
            _ => frame.fault(Counter::Length),
        }
    }

    fn reset(&mut self) {
        self.status = Quality::GOOD;
    }
}
