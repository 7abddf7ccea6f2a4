//! The frames of a motor and of its host.

use crate::mit;
use crate::{Format, Frame, Id};
use proprio_topics::Quality;

/// The outputs.
pub(super) const JOINT: u8 = 0;
pub(super) const MOTOR: u8 = 1;
pub(super) const FET: u8 = 2;
/// The identifier of questions to all motors.
pub(super) const QUESTIONS: Id = Id::standard(0x7FF);
/// What is asked.
pub(super) const STATE: u8 = 0xCC;
pub(super) const READ: u8 = 0x33;
const WRITE: u8 = 0x55;
const SAVE: u8 = 0xAA;
/// The registers with the ends of the ranges: position, velocity, torque.
pub(super) const RANGES: [u8; 3] = [21, 22, 23];
/// States without a fault.
pub(super) const DISABLED: u8 = 0;
pub(super) const ENABLED: u8 = 1;
/// States with one.
pub(super) const SENSOR: u8 = 5;
pub(super) const OVERLOAD: u8 = 0xE;

/// The quality of readings in this state.
pub(super) const fn quality_of(state: u8) -> Quality {
    match state {
        DISABLED | ENABLED => Quality::GOOD,
        SENSOR => Quality::DEVICE_FAULT,
        _ => Quality::DRIVE_FAULT,
    }
}

/// A frame of 8 bytes, in CAN FD if `fd`.
pub(super) fn frame(id: Id, fd: bool, data: [u8; 8]) -> Frame {
    let format = Format::fd(true, false);
    let frame = fd.then(|| Frame::with_format(id, format, &data)).flatten();
    frame.unwrap_or_else(|| Frame::new(id, &data))
}

/// A question to motor `address`.
pub(super) fn question(address: u8, fd: bool, command: u8, register: u8) -> Frame {
    frame(QUESTIONS, fd, [address, 0, command, register, 0, 0, 0, 0])
}

/// What a motor sends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum DamiaoMessage {
    State(DamiaoState),
    /// The value of a register, or of one that was written.
    Register(u8, f32),
    /// The answer to another request.
    Other,
}

/// A motor's state.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DamiaoState {
    pub(super) state: u8,
    /// Position, velocity, torque.
    pub(super) raw: [i64; 3],
    /// Of power stage and rotor \[degrees Celsius\].
    pub(super) celsius: [u8; 2],
}

impl DamiaoMessage {
    /// What a payload of 8 bytes tells of motor `address`; `None`: it is another motor's.
    pub(super) fn parse(address: u8, data: &[u8]) -> Option<Self> {
        let (&first, rest) = data.split_first()?;
        if let (true, &[0, command @ (READ | WRITE | SAVE), register, a, b, c, d]) =
            (first == address, rest)
        {
            return Some(match command {
                SAVE => Self::Other,
                _ => Self::Register(register, f32::from_le_bytes([a, b, c, d])),
            });
        }
        if first & 0xF != address & 0xF {
            return None;
        }
        let (raw, &[fet, rotor]) = mit::unpack(rest)? else {
            return None;
        };
        Some(Self::State(DamiaoState {
            state: first >> 4,
            raw,
            celsius: [fet, rotor],
        }))
    }
}

impl DamiaoState {
    pub(super) fn pack(&self, address: u8) -> [u8; 8] {
        let [p0, p1, v0, both, e1] = mit::pack(self.raw);
        let [fet, rotor] = self.celsius;
        let first = self.state << 4 | address & 0xF;
        [first, p0, p1, v0, both, e1, fet, rotor]
    }
}
