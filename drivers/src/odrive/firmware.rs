//! The two generations of firmware: their messages and their axis errors.

use super::frames::command::{ESTIMATES, HEARTBEAT, IQ, TEMPERATURE, TORQUES};
use crate::family::quality_of;
use proprio_topics::Quality;
use serde::Deserialize;

/// Axis errors that decide the quality, or stand for one in a simulated heartbeat.
pub(super) mod error {
    pub(in crate::odrive) const MISSING_ESTIMATE: u32 = 1 << 3;
    pub(in crate::odrive) const ESTOP_0_6: u32 = 1 << 25;
    pub(in crate::odrive) const SPINOUT: u32 = 1 << 26;
    pub(in crate::odrive) const MOTOR_FAILED: u32 = 1 << 6;
    pub(in crate::odrive) const ENCODER_FAILED: u32 = 1 << 8;
    pub(in crate::odrive) const CONTROLLER_FAILED: u32 = 1 << 9;
    pub(in crate::odrive) const ESTOP_0_5: u32 = 1 << 14;
    pub(in crate::odrive) const UNKNOWN_POSITION: u32 = 1 << 19;
    /// What the flags of firmware 0.5 say: bit 0 of bytes 5, 6 and 7.
    pub(in crate::odrive) const FLAGS: [u32; 3] = [MOTOR_FAILED, ENCODER_FAILED, CONTROLLER_FAILED];
}

/// The generation of an ODrive's firmware.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
pub enum Firmware {
    /// 0.6: ODrive S1, Pro, Micro.
    #[default]
    #[serde(rename = "0.6")]
    V0_6,
    /// 0.5: ODrive v3.
    #[serde(rename = "0.5")]
    V0_5,
}

impl Firmware {
    /// The messages that are read.
    pub(super) const fn commands(self) -> &'static [u8] {
        match self {
            Self::V0_6 => &[HEARTBEAT, ESTIMATES, IQ, TEMPERATURE, TORQUES],
            Self::V0_5 => &[HEARTBEAT, ESTIMATES, IQ],
        }
    }

    /// Those that are asked for: the estimates last, because they complete a reading.
    pub(super) const fn requests(self) -> &'static [u8] {
        match self {
            Self::V0_6 => &[TORQUES, IQ, ESTIMATES],
            Self::V0_5 => &[IQ, ESTIMATES],
        }
    }

    /// The errors that make a position doubtful.
    pub(super) const fn encoder_errors(self) -> u32 {
        match self {
            Self::V0_6 => error::MISSING_ESTIMATE | error::SPINOUT,
            Self::V0_5 => error::ENCODER_FAILED | error::UNKNOWN_POSITION,
        }
    }

    /// The quality of readings under these axis errors.
    pub(super) fn quality(self, errors: u32) -> Quality {
        quality_of(errors, self.encoder_errors())
    }
}
