//! The numbers of a sensor's messages, and what its counts mean.

use crate::{Id, bytes};
use core::f64::consts::PI;
use proprio_topics::Nanos;
use serde::Deserialize;

/// Parameter group numbers.
pub(super) mod pgn {
    pub(in crate::openimu) const SLOPE: u16 = 0xF029;
    pub(in crate::openimu) const ANGULAR_RATE: u16 = 0xF02A;
    pub(in crate::openimu) const ACCELERATION: u16 = 0xF02D;
    pub(in crate::openimu) const PACKET_RATE: u16 = 0xFF55;
    pub(in crate::openimu) const PACKET_TYPE: u16 = 0xFF56;
}

/// The priorities of commands, of acceleration, and of the other messages.
pub(super) const COMMANDS: u32 = 6;
pub(super) const ACCELERATION_PRIORITY: u32 = 2;
pub(super) const PRIORITY: u32 = 3;
/// The priority's bits in an identifier: any is accepted.
pub(super) const ANY_PRIORITY: u32 = 0b111 << 26;
/// The host's source address: that of a service tool. Sensors do not look at it.
pub(super) const HOST: u8 = 0xF9;
/// The addresses of sensors, and that of delivery.
pub(super) const ADDRESSES: core::ops::RangeInclusive<u8> = 0x80..=0xF7;
pub(super) const DELIVERED: u32 = 0x80;
/// The period with divider 1 \[ms\].
pub(super) const BASE_PERIOD_MS: u8 = 10;
/// The dividers that the manual lists.
pub(super) const DIVIDERS: [u8; 8] = [1, 2, 4, 5, 10, 20, 25, 50];

/// How values are sent: step, offset, and the largest count that is a value.
#[derive(Debug, Clone, Copy)]
pub(super) struct Slot {
    lsb: f64,
    offset: f64,
    most: u32,
}

/// One degree \[rad\].
pub(super) const DEGREE: f64 = PI / 180.0;
/// Angles \[rad\].
pub(super) const ANGLE: Slot = Slot {
    lsb: DEGREE / 32768.0,
    offset: -250.0 * DEGREE,
    most: 0xFA_FFFF,
};
/// Angular velocity \[rad/s\].
pub(super) const RATE: Slot = Slot {
    lsb: DEGREE / 128.0,
    offset: -250.0 * DEGREE,
    most: 0xFAFF,
};
/// Acceleration \[m/s^2\].
pub(super) const ACCELERATION: Slot = Slot {
    lsb: 0.01,
    offset: -320.0,
    most: 0xFAFF,
};
/// The count of a rate at the upper limit; the lower one is 0.
pub(super) const RATE_LIMIT: u32 = 500 * 128;

impl Slot {
    /// The value of a count; `None` if it means that there is none.
    pub(super) fn value(&self, count: u32) -> Option<f64> {
        (count <= self.most).then_some(f64::from(count) * self.lsb + self.offset)
    }

    /// The count of a finite value.
    pub(super) fn count(&self, value: f64) -> u32 {
        let count = bytes::quantise(value - self.offset, self.lsb, 0, i64::from(self.most));
        u32::try_from(count).unwrap_or(self.most)
    }
}

/// What the merit of a value says.
pub(super) mod merit {
    pub(in crate::openimu) const ERROR: u8 = 2;
    pub(in crate::openimu) const NOT_KNOWN: u8 = 3;
    /// The lowest bits of the merits of an acceleration or a rate, and of pitch and roll.
    pub(in crate::openimu) const OF_AXES: [u8; 3] = [0, 2, 4];
    pub(in crate::openimu) const OF_ANGLES: [u8; 2] = [2, 6];
}

/// The rate of repetition in an acceleration's merits, which the firmware always sends.
pub(super) const REPETITION: u8 = 2 << 6;

/// The quantities of a sensor, in the order of its messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum OpenImuQuantity {
    /// Pitch and roll.
    Orientation,
    /// Proper acceleration.
    Acceleration,
    /// Angular velocity.
    AngularVelocity,
}

impl OpenImuQuantity {
    pub(super) const ALL: [Self; 3] =
        [Self::Orientation, Self::Acceleration, Self::AngularVelocity];

    /// The number of its messages, their priority, and their bit in a command.
    pub(super) const fn pgn_priority_bit(self) -> (u16, u32, u8) {
        match self {
            Self::Orientation => (pgn::SLOPE, PRIORITY, 1),
            Self::Acceleration => (pgn::ACCELERATION, ACCELERATION_PRIORITY, 1 << 2),
            Self::AngularVelocity => (pgn::ANGULAR_RATE, PRIORITY, 1 << 1),
        }
    }
}

/// The order of x, y and z in a message.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum AxisOrder {
    /// Pitch, roll, yaw.
    #[default]
    Yxz,
    /// As they are named.
    Xyz,
}

impl AxisOrder {
    /// From a message's order to x, y, z, and back.
    pub(super) const fn exchange<T: Copy>(self, [a, b, c]: [T; 3]) -> [T; 3] {
        match self {
            Self::Yxz => [b, a, c],
            Self::Xyz => [a, b, c],
        }
    }
}

/// Where the axes of the acceleration point.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum Upright {
    /// y left and z up.
    #[default]
    Up,
    /// y right and z down.
    Down,
}

impl Upright {
    /// From these axes to forward, right, down, and back.
    pub(super) const fn turn(self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        match self {
            Self::Up => [x, -y, -z],
            Self::Down => [x, y, z],
        }
    }
}

/// An identifier.
pub(super) const fn identifier(priority: u32, pgn: u16, source: u8) -> Id {
    Id::extended(priority << 26 | (pgn as u32) << 8 | source as u32)
}

/// The number and the source of the group that `id` names.
pub(super) fn group_and_source(id: Id) -> Option<(u16, u8)> {
    let Id::Extended(raw) = id else { return None };
    let [page, high, low, source] = (raw & !ANY_PRIORITY).to_be_bytes();
    (page == 0).then_some((u16::from_be_bytes([high, low]), source))
}

pub(super) const fn period(divider: u8) -> Nanos {
    Nanos::from_millis(divider as i64 * BASE_PERIOD_MS as i64)
}

/// The orientation of a sensor with z down in a world with z up, for heading 0.
pub(super) fn quaternion(pitch: f64, roll: f64) -> [f64; 4] {
    let (sin_pitch, cos_pitch) = libm::sincos(pitch / 2.0);
    let (sin_roll, cos_roll) = libm::sincos(roll / 2.0);
    [
        -cos_pitch * sin_roll,
        cos_pitch * cos_roll,
        sin_pitch * sin_roll,
        sin_pitch * cos_roll,
    ]
}

/// Pitch and roll of such an orientation, of any heading.
pub(super) fn pitch_and_roll(orientation: [f64; 4]) -> [f64; 2] {
    // The same in a world with z down: half a turn about x.
    let [a, b, c, d] = orientation;
    let [w, x, y, z] = [b, -a, d, -c];
    let pitch = libm::asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0));
    let roll = libm::atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y));
    [pitch, roll]
}
