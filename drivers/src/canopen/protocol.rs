//! The numbers of the protocol: identifiers, NMT commands, objects.

use crate::Id;
use crate::bringup::Timing;
use proprio_topics::Nanos;

/// NMT commands.
pub(crate) mod nmt {
    pub(crate) const START: u8 = 0x01;
    pub(crate) const STOP: u8 = 0x02;
    pub(crate) const PRE_OPERATIONAL: u8 = 0x80;
    pub(crate) const RESET_NODE: u8 = 0x81;
    pub(crate) const RESET_COMMUNICATION: u8 = 0x82;
}

pub(crate) const NMT: Id = Id::standard(0x000);
pub(crate) const SYNC: Id = Id::standard(0x080);

/// The identifiers of a node.
pub(crate) fn emcy(node: u8) -> Id {
    Id::standard(0x080 + u16::from(node))
}
/// TPDO `number`, from 0.
pub(crate) fn tpdo(node: u8, number: u8) -> Id {
    Id::standard(0x180 + 0x100 * u16::from(number & 3) + u16::from(node))
}
pub(crate) fn sdo_from(node: u8) -> Id {
    Id::standard(0x580 + u16::from(node))
}
pub(crate) fn sdo_to(node: u8) -> Id {
    Id::standard(0x600 + u16::from(node))
}
pub(crate) fn heartbeat(node: u8) -> Id {
    Id::standard(0x700 + u16::from(node))
}

/// An entry of the object dictionary.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Object {
    pub(crate) index: u16,
    pub(crate) sub: u8,
}

impl Object {
    pub(crate) const fn new(index: u16, sub: u8) -> Self {
        Self { index, sub }
    }

    /// It as an entry of a PDO mapping, with `bits` bits.
    pub(crate) const fn mapped(self, bits: u8) -> u32 {
        (self.index as u32) << 16 | (self.sub as u32) << 8 | bits as u32
    }
}

/// Objects that all nodes have.
pub(crate) mod object {
    use super::Object;

    /// The low 16 bits are the device profile.
    pub(crate) const DEVICE_TYPE: Object = Object::new(0x1000, 0);
    pub(crate) const HEARTBEAT: Object = Object::new(0x1017, 0);
    /// Identifier of a TPDO; bit 31: it is off.
    pub(crate) const fn tpdo_id(number: u8) -> Object {
        Object::new(0x1800 + number as u16, 1)
    }
    /// 0 to 240: after so many SYNC; 254, 255: by events.
    pub(crate) const fn tpdo_transmission(number: u8) -> Object {
        Object::new(0x1800 + number as u16, 2)
    }
    /// Event timer \[ms\].
    pub(crate) const fn tpdo_timer(number: u8) -> Object {
        Object::new(0x1800 + number as u16, 5)
    }
    /// Mapping of a TPDO; sub-index 0 is the number of entries.
    pub(crate) const fn tpdo_mapping(number: u8, sub: u8) -> Object {
        Object::new(0x1A00 + number as u16, sub)
    }
}

/// A TPDO that is off.
pub(crate) const TPDO_OFF: u32 = 1 << 31;
/// Its identifier must not be asked for with remote frames.
pub(crate) const NO_RTR: u32 = 1 << 30;
/// The most entries of a mapping: 8 bytes.
pub(crate) const MAPPED_MOST: u8 = 8;

/// Nodes answer within milliseconds; writing to memory takes longer.
pub(crate) const TIMING: Timing = Timing {
    power_on_silence: Nanos::ZERO,
    answer_timeout: Nanos::from_millis(50),
    attempts: 5,
    slow_attempt: Nanos::from_millis(500),
    answer_counts: Nanos::from_millis(200),
    start: Nanos::from_millis(200),
    start_most: Nanos::from_millis(2000),
    send_within: Nanos::from_millis(50),
};
