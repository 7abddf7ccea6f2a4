//! The frames of both protocols.

use crate::bytes::{u16_be, u16_le, u32_le};
use crate::{Claim, Id, mit};

/// The outputs.
pub(super) const JOINT: u8 = 0;
pub(super) const MOTOR: u8 = 1;
/// The length of every frame.
pub(super) const LENGTH: usize = 8;

/// Types of frames of the private protocol.
pub(super) mod kind {
    pub(in crate::robstride) const DEVICE: u8 = 0x00;
    pub(in crate::robstride) const STATE: u8 = 0x02;
    pub(in crate::robstride) const PARAMETER: u8 = 0x11;
    pub(in crate::robstride) const FAULT: u8 = 0x15;
    pub(in crate::robstride) const REPORT: u8 = 0x18;
    /// Those that are read.
    pub(in crate::robstride) const READ: [u8; 4] = [STATE, PARAMETER, FAULT, REPORT];
}

/// Parameters.
pub(super) mod parameter {
    pub(in crate::robstride) const POSITION: u16 = 0x7019;
    pub(in crate::robstride) const CURRENT: u16 = 0x701A;
    pub(in crate::robstride) const VELOCITY: u16 = 0x701B;
    /// In the order of questions: the position completes a reading.
    pub(in crate::robstride) const ASKED: [u16; 3] = [VELOCITY, CURRENT, POSITION];
}

/// Mode of a motor that runs.
pub(super) const RUNNING: u8 = 2;
/// Where the faults of a state are in `Actuator::faults`.
pub(super) const OF_STATE: u32 = 24;
/// Faults.
pub(super) mod fault {
    pub(in crate::robstride) const NOT_CALIBRATED: u32 = 1 << 7;
    pub(in crate::robstride) const NOT_INITIALISED: u32 = 1 << 9;
    pub(in crate::robstride) const OVER_TEMPERATURE: u32 = 1 << 26;
    pub(in crate::robstride) const MAGNETIC_ENCODER: u32 = 1 << 27;
    pub(in crate::robstride) const HALL_ENCODER: u32 = 1 << 28;
    pub(in crate::robstride) const STATE_NOT_CALIBRATED: u32 = 1 << 29;
}

/// The identifier of a frame of the private protocol.
pub(super) fn id(kind: u8, upper: u8, lower: u8, destination: u8) -> Id {
    let upper_half = u32::from(kind) << 24 | u32::from(upper) << 16;
    Id::extended(upper_half | u32::from(lower) << 8 | u32::from(destination))
}

/// The identifiers of frames of this kind, whatever the upper byte of their data is.
pub(super) fn claim(kind: u8, address: u8, host: u8) -> Claim {
    Claim {
        id: id(kind, 0, address, host),
        mask: !0x00FF_0000,
        exclusive: true,
    }
}

/// What a motor sends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum RobstrideMessage {
    State(RobstrideState),
    /// Faults, bits 0 to 16.
    Faults(u32),
    /// The value of a parameter; `None`: it can not be read.
    Parameter(u16, Option<f32>),
}

/// A motor's state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct RobstrideState {
    /// Mode and six faults, if they are told.
    pub(super) told: Option<(u8, u8)>,
    /// Position, velocity, torque.
    pub(super) raw: [i64; 3],
    /// Temperature \[0.1 degrees Celsius\].
    pub(super) tenths: u16,
}

impl RobstrideMessage {
    /// A frame of the private protocol; `data` has 8 bytes.
    pub(super) fn of_private(kind: u8, upper: u8, data: &[u8]) -> Self {
        match kind {
            kind::FAULT => Self::Faults(u32_le(data, 0)),
            kind::PARAMETER => {
                let value = f32::from_bits(u32_le(data, 4));
                Self::Parameter(u16_le(data, 0), (upper == 0).then_some(value))
            }
            _ => Self::State(RobstrideState {
                told: Some((upper >> 6, upper & 0x3F)),
                raw: [0, 2, 4].map(|at| i64::from(u16_be(data, at))),
                tenths: u16_be(data, 6),
            }),
        }
    }

    /// A frame of the MIT protocol; `None`: of another motor.
    pub(super) fn of_mit(address: u8, data: &[u8]) -> Option<Self> {
        let rest = data.strip_prefix(&[address])?;
        if let &[a, b, c, d, 0, 0, 0] = rest {
            return Some(Self::Faults(u32::from_le_bytes([a, b, c, d])));
        }
        let (raw, &[high, low]) = mit::unpack(rest)? else {
            return None;
        };
        Some(Self::State(RobstrideState {
            told: None,
            raw,
            tenths: u16::from_be_bytes([high, low]),
        }))
    }
}

impl RobstrideState {
    /// The payload in the private protocol.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // within their ranges
    pub(super) fn pack(&self) -> [u8; 8] {
        let [[p0, p1], [v0, v1], [t0, t1]] = self.raw.map(|raw| (raw as u16).to_be_bytes());
        let [c0, c1] = self.tenths.to_be_bytes();
        [p0, p1, v0, v1, t0, t1, c0, c1]
    }

    /// The payload in the MIT protocol.
    pub(super) fn pack_mit(&self, address: u8) -> [u8; 8] {
        let [p0, p1, v0, both, t1] = mit::pack(self.raw);
        let [c0, c1] = self.tenths.to_be_bytes();
        [address, p0, p1, v0, both, t1, c0, c1]
    }
}
