//! The identifiers and numbers of the protocol.

use crate::{Id, Spec, SpecError, keys};
use proprio_topics::Nanos;

/// Operations: the identifier without the board's number.
pub(super) mod op {
    pub(in crate::jr3_can) const ACKNOWLEDGE: u16 = 0x100;
    pub(in crate::jr3_can) const START_SYNC: u16 = 0x180;
    pub(in crate::jr3_can) const START: u16 = 0x200;
    pub(in crate::jr3_can) const STOP: u16 = 0x280;
    pub(in crate::jr3_can) const ZERO: u16 = 0x300;
    pub(in crate::jr3_can) const FILTER: u16 = 0x380;
    pub(in crate::jr3_can) const GET_STATE: u16 = 0x400;
    pub(in crate::jr3_can) const GET_FORCE_SCALES: u16 = 0x480;
    pub(in crate::jr3_can) const GET_MOMENT_SCALES: u16 = 0x500;
    pub(in crate::jr3_can) const RESET: u16 = 0x580;
    pub(in crate::jr3_can) const FORCE: u16 = 0x600;
    pub(in crate::jr3_can) const MOMENT: u16 = 0x680;
    pub(in crate::jr3_can) const BOOT_UP: u16 = 0x700;
}

/// The state in an acknowledgement.
pub(super) const READY: u8 = 0;
/// Steps in a full scale.
pub(super) const STEPS: f64 = 16384.0;
/// One step of a board's full scale of moments \[Nm\]; that of forces is 1 N.
pub(super) const NEWTON_METRE_PER_LSB: f64 = 0.1;
/// The time between two samples of the sensor.
pub(super) const SAMPLE: Nanos = Nanos(128_500);

/// The board's number.
pub(super) fn node(spec: &Spec) -> Result<u16, SpecError> {
    keys::address(spec, 1..=0x7F)
}

/// The identifier of operation `op` of board `node`.
pub(super) const fn id(op: u16, node: u16) -> Id {
    Id::standard(op | node)
}

/// The operation of a frame of board `node`, if it is one.
pub(super) const fn op_of(id: Id, node: u16) -> Option<u16> {
    match id {
        Id::Standard(raw) if raw & 0x7F == node => Some(raw & !0x7F),
        _ => None,
    }
}
