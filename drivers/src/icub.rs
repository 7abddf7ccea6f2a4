//! Common parts of the CAN protocol of iCub, R1 and ergoCub boards: identifiers, commands,
//! bring-up, management.
//!
//! | part of the 11-bit identifier | bits | meaning |
//! |---|---|---|
//! | CLS | 10:8 | class: [`class`] |
//! | SRC | 7:4 | address of the sender: 0 the host, 1 to 14 the boards |
//! | X | 3:0 | command class (0, 2, 7): address of the receiver, 15 for all |
//! | | | streaming class: type of the stream |
//!
//! In a command class the first byte is the command and a reply swaps sender and receiver: `20A`
//! asks board 10, `2A0` answers. In a streaming class there is no command byte. Most commands that
//! set or start something are not acknowledged.
//!
//! (Their silence after power-up: docs/book/src/devices/index.md.)
//!
//! # Recognition
//! A scan sends DISCOVER to all boards (`70F`, `FF`), and GET_ADDITIONAL_INFO (`70a`, `0C`) to
//! those that have answered. It does not ask for the protocol's version: the identifier of that
//! question, `20a`, is a command to the motor of a CANopen drive. Without questions boards are
//! recognised by their streams, or by what they answer to another program.
//!
//! Sources: robotology/icub-firmware `TSD-ICUBUNIT-canprotocol-sensorboards.docx` v1.12 (25 Nov
//! 2024) and the firmware under `emBODY/eBcode/arch-arm/embot` at b4299211;
//! robotology/icub-firmware-shared `can/canProtocolLib` at 62f2818a; the hosts in
//! robotology/icub-main at 24c1a003. Certain (document and independent code agree), unless stated
//! otherwise.

#[cfg(feature = "boards")]
mod management;
#[cfg(feature = "recognise")]
mod recognise;

#[cfg(feature = "boards")]
pub(crate) use management::answer_management;
#[cfg(feature = "recognise")]
pub(crate) use recognise::{questions, recognise};

use crate::bringup::Timing;
use crate::{Claim, Id, Spec, SpecError, keys};
use alloc::vec::Vec;
use proprio_topics::{Nanos, Quality};

/// The classes of messages: bits 10:8 of the identifier.
pub mod class {
    /// Commands to motor boards.
    pub const POLLING_MOTOR: u16 = 0;
    /// Streams of motor boards.
    pub const PERIODIC_MOTOR: u16 = 1;
    /// Commands to sensor boards.
    pub const POLLING_ANALOG: u16 = 2;
    /// Streams of F/T sensors, encoders and thermometers.
    pub const PERIODIC_ANALOG: u16 = 3;
    /// Streams of tactile sensors.
    pub const PERIODIC_SKIN: u16 = 4;
    /// Streams of IMUs.
    pub const PERIODIC_INERTIAL: u16 = 5;
    /// Bootloader and management.
    pub const MANAGEMENT: u16 = 7;
}

/// Commands: the first byte in a command class.
pub mod command {
    /// Class 2: `[03, set << 4 | row, column, high, low]`: an entry of the calibration matrix, in
    /// 1/32768; set 0 is the one in use.
    pub const SET_MATRIX_RC: u8 = 0x03;
    /// Class 2: start or stop streaming, `[07, mode]`.
    pub const SET_TXMODE: u8 = 0x07;
    /// Class 2: period of the streams, `[08, ms]`. (The document's drawing shows 07; its example,
    /// the header and the code 08.)
    pub const SET_CANDATARATE: u8 = 0x08;
    /// Class 2: `[0A, set << 4 | row, column]`, answered by `[0A, set << 4 | row, column, high,
    /// low]`.
    pub const GET_MATRIX_RC: u8 = 0x0A;
    /// Class 2, mais: `[10, code]`: the resolution; 2 is 8 bits.
    pub const SET_RESOLUTION: u8 = 0x10;
    /// Class 2: `[15, mode]`, or `[15, 2, channel, high, low]`: what the board adds to each
    /// calibrated axis. Mode 0 nothing, 1 minus the present load, 2 a given value of one channel.
    pub const SET_CURR_TARE: u8 = 0x15;
    /// Class 2: `[16, channel]`, answered by `[16, channel, high, low]`.
    pub const GET_CURR_TARE: u8 = 0x16;
    /// Class 2: `[18, set << 4 | channel]`, answered by `[18, set << 4 | channel, high, low]`.
    pub const GET_FULL_SCALES: u8 = 0x18;
    /// Class 2: `[1C, protocol major, minor]`, answered by `[1C, board, major, minor, build,
    /// protocol major, minor, fits]`.
    pub const GET_FIRMWARE_VERSION: u8 = 0x1C;
    /// Class 2: `[33]`, answered by 8 bytes like those of [`IMU_CONFIG_SET`].
    pub const IMU_CONFIG_GET: u8 = 0x33;
    /// Class 2: `[34, mask low, mask high, mode, orientation, 0, 0, 0]`.
    pub const IMU_CONFIG_SET: u8 = 0x34;
    /// Class 2: `[35, period in ms]`, 0 stops.
    pub const IMU_TRANSMIT: u8 = 0x35;
    /// Class 2: `[39, mask]`: the thermometers in use.
    pub const THERMOMETER_CONFIG_SET: u8 = 0x39;
    /// Class 2: `[3A, period in s]`, 0 stops.
    pub const THERMOMETER_TRANSMIT: u8 = 0x3A;
    /// Class 2, skin: `[4D, compensation, period in ms, value without load]`.
    pub const SKIN_CONFIG: u8 = 0x4D;
    /// Class 2: `[4F, mask, period in ms]`: legacy accelerometer and gyroscope.
    pub const ACC_GYRO_SETUP: u8 = 0x4F;
    /// Class 2, skin: `[50, first, last, shift, enabled, offset low, high]`: the triangles in use.
    pub const SKIN_TRIANGLES: u8 = 0x50;
    /// Class 2: `[51, type]`, answered by 8 bytes like those of [`POS_CONFIG_SET`].
    pub const POS_CONFIG_GET: u8 = 0x51;
    /// Class 2: `[52, id << 4 | type, sensor 0 (3 bytes), sensor 1 (3 bytes)]`.
    pub const POS_CONFIG_SET: u8 = 0x52;
    /// Class 2: `[53, period in ms]`, 0 stops.
    pub const POS_TRANSMIT: u8 = 0x53;
    /// Class 0: as [`GET_FIRMWARE_VERSION`].
    pub const MOTOR_GET_FIRMWARE_VERSION: u8 = 0x5B;
    /// Class 7: `[FF]` to everyone, answered by `[FF, board, major, minor, build]`; in the
    /// bootloader without `build`.
    pub const DISCOVER: u8 = 0xFF;
    /// Class 7: `[0C]`, answered by eight frames `[0C, number, 4 characters]`: a text that was
    /// written into the board.
    pub const GET_ADDITIONAL_INFO: u8 = 0x0C;
}

/// Board types, as boards name themselves.
pub mod board {
    /// mc4: control of four DC motors.
    pub const MC4: u8 = 0x03;
    /// bll: control of brushless motors.
    pub const BLL: u8 = 0x04;
    /// mtb: skin and legacy inertial sensors.
    pub const MTB: u8 = 0x05;
    /// strain: F/T.
    pub const STRAIN: u8 = 0x06;
    /// mais: Hall sensors.
    pub const MAIS: u8 = 0x07;
    /// 2foc: motor control.
    pub const TWO_FOC: u8 = 0x08;
    /// mtb4: skin and IMU.
    pub const MTB4: u8 = 0x0B;
    /// strain2: F/T and IMU.
    pub const STRAIN2: u8 = 0x0C;
    /// rfe: face expressions and IMU.
    pub const RFE: u8 = 0x0D;
    /// psc: finger encoders.
    pub const PSC: u8 = 0x0F;
    /// mtb4w: as mtb4.
    pub const MTB4W: u8 = 0x10;
    /// amcbldc: motor control.
    pub const AMCBLDC: u8 = 0x12;
    /// mtb4c: as mtb4.
    pub const MTB4C: u8 = 0x14;
    /// amc2c: motor control.
    pub const AMC2C: u8 = 0x15;
    /// strain2c: as strain2.
    pub const STRAIN2C: u8 = 0x16;
    /// amcfoc2c: motor control.
    pub const AMCFOC2C: u8 = 0x18;

    /// The types and their names.
    pub const NAMES: [(u8, &str); 16] = [
        (MC4, "mc4"),
        (BLL, "bll"),
        (MTB, "mtb"),
        (STRAIN, "strain"),
        (MAIS, "mais"),
        (TWO_FOC, "2foc"),
        (MTB4, "mtb4"),
        (STRAIN2, "strain2"),
        (RFE, "rfe"),
        (PSC, "psc"),
        (MTB4W, "mtb4w"),
        (AMCBLDC, "amcbldc"),
        (MTB4C, "mtb4c"),
        (AMC2C, "amc2c"),
        (STRAIN2C, "strain2c"),
        (AMCFOC2C, "amcfoc2c"),
    ];
}

/// The address that all boards listen to.
pub const BROADCAST: u8 = 15;
/// The lowest and the highest address of a board.
pub const ADDRESSES: core::ops::RangeInclusive<u8> = 1..=14;

/// A command from the host to board `address` in a command class.
#[must_use]
pub const fn to_board(class: u16, address: u8) -> Id {
    Id::standard(class << 8 | (address as u16 & 0xF))
}

/// A reply of board `address` to the host in a command class.
#[must_use]
pub const fn to_host(class: u16, address: u8) -> Id {
    Id::standard(class << 8 | (address as u16 & 0xF) << 4)
}

/// The stream of type `kind` of board `address` in a streaming class.
#[must_use]
pub const fn stream(class: u16, address: u8, kind: u8) -> Id {
    Id::standard(class << 8 | (address as u16 & 0xF) << 4 | (kind as u16 & 0xF))
}

/// The address of `spec`, if boards of this protocol can have it.
///
/// # Errors
/// [`SpecError::Address`].
pub fn address(spec: &Spec) -> Result<u8, SpecError> {
    keys::address(spec, ADDRESSES)
}

/// [`Timing::USUAL`] with the silence after power-on of the key `power_on_silence_ms`. (A board
/// answers within a few ms; icub-main repeats 15 times after 20 ms. An IMU changes its fusion mode
/// before its first reading.)
///
/// # Errors
/// [`SpecError::Key`] above a minute.
pub(crate) fn timing(ms: u32) -> Result<Timing, SpecError> {
    Ok(Timing {
        power_on_silence: keys::ms("power_on_silence_ms", ms, 0..=60_000, "at most 60000")?,
        ..Timing::USUAL
    })
}

/// A period in ms that fits in a byte.
///
/// # Errors
/// [`SpecError::Key`] outside 1 to 255.
pub(crate) fn period_ms(key: &'static str, ms: u32) -> Result<u8, SpecError> {
    match u8::try_from(ms) {
        Ok(byte) if byte > 0 => Ok(byte),
        _ => Err(SpecError::key(key, ms, "an integer from 1 to 255")),
    }
}

/// As [`period_ms`], of the key of this name, in the unit of stamps.
pub(crate) fn period(ms: u32) -> Result<Nanos, SpecError> {
    period_ms("period_ms", ms).map(|ms| Nanos::from_millis(i64::from(ms)))
}

/// The type of a frame of streaming class `class` of board `address`, if it is one.
pub(crate) const fn stream_type(id: Id, class: u16, address: u8) -> Option<u8> {
    match id {
        Id::Standard(raw) if raw >> 4 == class << 4 | address as u16 => Some((raw & 0xF) as u8),
        _ => None,
    }
}

/// Claims on the streams `kinds` of a class.
pub(crate) fn claims(class: u16, address: u8, kinds: &[u8]) -> Vec<Claim> {
    let claim = |kind: &u8| Claim::exclusive(stream(class, address, *kind));
    kinds.iter().map(claim).collect()
}

/// Which of the up to 16 outputs of a board follow a gap with their next reading, one bit each.
#[derive(Debug, Default)]
pub(crate) struct OutputGaps {
    gap: u16,
    /// Those that have been read.
    seen: u16,
}

impl OutputGaps {
    /// The board was silent.
    pub(crate) const fn all(&mut self) {
        self.gap = self.seen;
    }

    /// Something of output `output` was lost.
    pub(crate) const fn one(&mut self, output: u8) {
        self.gap |= 1 << output & self.seen;
    }

    /// GAP_BEFORE, if the reading of output `output` is the first after a gap.
    pub(crate) const fn take(&mut self, output: u8) -> Quality {
        let bit = 1 << output;
        let quality = match self.gap & bit {
            0 => Quality::GOOD,
            _ => Quality::GAP_BEFORE,
        };
        self.gap &= !bit;
        self.seen |= bit;
        quality
    }
}
