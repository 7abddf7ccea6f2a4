//! The two generations of firmware: their messages and their axis errors.

use super::frames::command::{ESTIMATES, HEARTBEAT, IQ, TEMPERATURE, TORQUES};
use core::fmt;
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

/// The axis errors of firmware 0.6 by bit, in the maker's words.
const ERRORS_0_6: &[(u32, &str)] = &[
    (0, "initializing"),
    (1, "system level"),
    (2, "timing error"),
    (3, "missing estimate"),
    (4, "bad config"),
    (5, "DRV fault"),
    (6, "missing input"),
    (8, "DC bus over voltage"),
    (9, "DC bus under voltage"),
    (10, "DC bus over current"),
    (11, "DC bus over regen current"),
    (12, "current limit violation"),
    (13, "motor over temp"),
    (14, "inverter over temp"),
    (15, "velocity limit violation"),
    (16, "position limit violation"),
    (17, "requested current too high"),
    (24, "watchdog timer expired"),
    (25, "estop requested"),
    (26, "spinout detected"),
    (27, "brake resistor disarmed"),
    (28, "thermistor disconnected"),
    (30, "calibration error"),
];

/// Those of all versions of firmware 0.5.
const ERRORS_0_5: &[(u32, &str)] = &[
    (0, "invalid state"),
    (1, "DC bus under voltage"),
    (2, "DC bus over voltage"),
    (3, "current measurement timeout"),
    (4, "brake resistor disarmed"),
    (5, "motor disarmed"),
    (6, "motor failed"),
    (7, "sensorless estimator failed"),
    (8, "encoder failed"),
    (9, "controller failed"),
    (10, "pos ctrl during sensorless"),
    (11, "watchdog timer expired"),
    (12, "min endstop pressed"),
    (13, "max endstop pressed"),
    (14, "estop requested"),
    (17, "homing without endstop"),
    (18, "over temp"),
    (19, "unknown position"),
];

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
        let mut quality = Quality::GOOD;
        if errors & self.encoder_errors() != 0 {
            quality |= Quality::DEVICE_FAULT;
        }
        if errors & !self.encoder_errors() != 0 {
            quality |= Quality::DRIVE_FAULT;
        }
        quality
    }
}

/// The axis errors `faults` (`Actuator::faults`) of an ODrive in words, for a log: "DRV
/// fault, bit 7" where bit 7 has no name.
#[must_use]
pub fn error_words(firmware: Firmware, faults: u32) -> impl fmt::Display {
    ErrorWords { firmware, faults }
}

struct ErrorWords {
    firmware: Firmware,
    faults: u32,
}

impl fmt::Display for ErrorWords {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = match self.firmware {
            Firmware::V0_6 => ERRORS_0_6,
            Firmware::V0_5 => ERRORS_0_5,
        };
        if self.faults == 0 {
            return f.write_str("no error");
        }
        let mut separator = "";
        for bit in (0..32).filter(|bit| self.faults >> bit & 1 != 0) {
            f.write_str(core::mem::replace(&mut separator, ", "))?;
            match names.iter().find(|(named, _)| *named == bit) {
                Some((_, name)) => f.write_str(name)?,
                None => write!(f, "bit {bit}")?,
            }
        }
        Ok(())
    }
}
