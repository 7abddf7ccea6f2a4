//! The frames of the protocols V3 and V2.

use crate::bytes::{i16_le, u16_le, u32_le};
use serde::Deserialize;

/// A motor's protocol.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum MyactuatorProtocol {
    /// V3 and V4.
    #[default]
    V3,
    /// V2, and LKMTech's.
    V2,
}

/// The outputs.
pub(super) const JOINT: u8 = 0;
pub(super) const MOTOR: u8 = 1;
/// The length of every frame.
pub(super) const LENGTH: usize = 8;
/// What is added to an address.
pub(super) const COMMANDS: u16 = 0x140;
pub(super) const ANSWERS: u16 = 0x240;
pub(super) const MOTION: u16 = 0x500;

/// The commands that ask.
pub(super) mod command {
    pub(in crate::myactuator) const ANGLE: u8 = 0x92;
    pub(in crate::myactuator) const ERRORS: u8 = 0x9A;
    pub(in crate::myactuator) const STATE: u8 = 0x9C;
    /// The first and the last of those that move, and are answered as [`STATE`] is.
    pub(in crate::myactuator) const MOVES: core::ops::RangeInclusive<u8> = 0xA1..=0xA9;
}

/// The error of V3 that makes a position doubtful.
pub(super) const ENCODER_ERROR: u16 = 0x2000;
/// The error that stands for any other in a simulated motor: over-voltage in V3, stall in V2.
pub(super) const ANY_ERROR: u16 = 0x40;

/// What a motor answers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Answer {
    State(MotorStatus),
    /// Hundredths of a degree.
    Angle(i64),
    Errors(u16),
}

/// A motor's state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MotorStatus {
    /// Temperature \[degrees Celsius\].
    pub(super) celsius: i8,
    /// Current, in steps, and speed \[deg/s\].
    pub(super) current: i16,
    pub(super) speed: i16,
    /// Degrees in V3, steps of the encoder in V2.
    pub(super) place: i32,
}

impl Answer {
    /// Reads a payload of 8 bytes; `None`: another command's, or no answer.
    pub(super) fn parse(protocol: MyactuatorProtocol, asks: bool, data: &[u8]) -> Option<Self> {
        let &[command, second, .., last] = data else {
            return None;
        };
        let is_state = command == command::STATE || command::MOVES.contains(&command);
        if protocol == MyactuatorProtocol::V2 {
            // The same identifier has commands: an answer tells a temperature.
            let is_question = data.iter().skip(1).all(|byte| *byte == 0);
            let is_command = command::MOVES.contains(&command) && second < 2;
            if is_command || is_question && !asks {
                return None;
            }
        }
        let signed = second.cast_signed();
        match (command, protocol) {
            _ if is_state => Some(Self::State(MotorStatus {
                celsius: signed,
                current: i16_le(data, 2),
                speed: i16_le(data, 4),
                place: match protocol {
                    MyactuatorProtocol::V3 => i32::from(i16_le(data, 6)),
                    MyactuatorProtocol::V2 => i32::from(u16_le(data, 6)),
                },
            })),
            (command::ANGLE, MyactuatorProtocol::V3) => {
                Some(Self::Angle(i64::from(u32_le(data, 4).cast_signed())))
            }
            (command::ANGLE, MyactuatorProtocol::V2) => {
                let high = i64::from(u32_le(data, 4).cast_signed());
                Some(Self::Angle(high << 24 | i64::from(u32_le(data, 0) >> 8)))
            }
            (command::ERRORS, MyactuatorProtocol::V3) => Some(Self::Errors(u16_le(data, 6))),
            (command::ERRORS, MyactuatorProtocol::V2) => Some(Self::Errors(u16::from(last))),
            _ => None,
        }
    }

    /// The payload; a state's as the answer to a question.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // within their ranges
    pub(super) fn pack(self, protocol: MyactuatorProtocol, celsius: i8) -> [u8; 8] {
        match (self, protocol) {
            (Self::State(state), _) => {
                let [c0, c1] = state.current.to_le_bytes();
                let [s0, s1] = state.speed.to_le_bytes();
                let [p0, p1] = (state.place as u16).to_le_bytes();
                let celsius = state.celsius.cast_unsigned();
                [command::STATE, celsius, c0, c1, s0, s1, p0, p1]
            }
            (Self::Angle(angle), MyactuatorProtocol::V3) => {
                let [a, b, c, d] = (angle as i32).to_le_bytes();
                [command::ANGLE, 0, 0, 0, a, b, c, d]
            }
            (Self::Angle(angle), MyactuatorProtocol::V2) => {
                let [a, b, c, d, e, f, g, _] = angle.to_le_bytes();
                [command::ANGLE, a, b, c, d, e, f, g]
            }
            (Self::Errors(errors), protocol) => {
                let [low, high] = errors.to_le_bytes();
                let celsius = celsius.cast_unsigned();
                match protocol {
                    MyactuatorProtocol::V3 => [command::ERRORS, celsius, 0, 1, 0, 0, low, high],
                    MyactuatorProtocol::V2 => [command::ERRORS, celsius, 0, 0, 0, 0, 0, low],
                }
            }
        }
    }
}
