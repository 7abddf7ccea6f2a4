//! What the CANopen families share (CiA 301): identifiers, the network management (NMT), expedited
//! SDO transfers as a list of steps, boot-up and emergency messages, and a node's own side.
//!
//! Node `n`, 1 to 127, little-endian:
//!
//! | identifier | name | bytes |
//! |---|---|---|
//! | `000` | NMT | command, node (0: all): 01 operational, 02 stopped, 80 pre-operational, 81 reset |
//! | `080` | SYNC | none, or a counter |
//! | `080` + n | EMCY | error code u16, error register, 5 of the maker's; code 0: no error any more |
//! | `180`, `280`, `380`, `480` + n | TPDO 1 to 4 | as mapped |
//! | `580` + n | SDO from the node | `4F`, `4B`, `47`, `43` index sub value; `60` written; `80` refused |
//! | `600` + n | SDO to the node | `40` index sub: read; `2F`, `2B`, `27`, `23` index sub value: write |
//! | `700` + n | heartbeat | 00 boot-up, 04 stopped, 05 operational, 7F pre-operational |

mod node;
mod script;

pub(crate) use node::Node;
pub(crate) use script::{Plan, Script, Step};

use crate::bringup::Timing;
use crate::bytes::u16_le;
use crate::family::Link;
use crate::{Claim, Decoded, Frame, Id, Spec, SpecError, bytes};
use proprio_topics::{Counter, Nanos, StampKind};

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

/// The node of `spec`.
pub(crate) fn node_of(spec: &Spec) -> Result<u8, SpecError> {
    let address = spec.address;
    let node = u8::try_from(address).ok();
    node.filter(|node| (1..=127).contains(node))
        .ok_or(SpecError::Address {
            address,
            least: 1,
            most: 127,
        })
}

/// The identifiers of a node that its device listens to, beside its PDOs.
pub(crate) fn claims(node: u8) -> [Claim; 3] {
    [emcy(node), sdo_from(node), heartbeat(node)].map(Claim::exclusive)
}

/// Which SYNC a node answers.
///
/// A node that answers each SYNC answers one before the next. If it does not, its next answer may
/// be a late one or that of the newest SYNC; only its stamp can tell, if it is before the newest
/// SYNC. Else it is dropped, and so are others until one SYNC is left, or the next one comes: then
/// an answer was lost.
#[derive(Debug)]
pub(crate) struct Cycle {
    /// The node answers each n-th; 0: it does not measure by SYNC.
    every: u8,
    /// The last two.
    last: Option<(Nanos, StampKind)>,
    before: Option<(Nanos, StampKind)>,
    /// How many are not answered.
    open: u8,
    /// An answer was dropped since the last one.
    dropped: bool,
}

impl Cycle {
    pub(crate) const fn new(every: u8) -> Self {
        Self {
            every,
            last: None,
            before: None,
            open: 0,
            dropped: false,
        }
    }

    pub(crate) const fn set_every(&mut self, every: u8) {
        self.every = every;
    }

    /// A SYNC.
    pub(crate) fn sync(&mut self, frame: &Frame) {
        self.before = self.last.replace((frame.t, frame.stamp));
        if core::mem::take(&mut self.dropped) {
            self.open = 0;
        }
        self.open = self.open.saturating_add(1);
    }

    /// When the node measured what `frame` holds: at its SYNC; at its own stamp if it measures by
    /// itself, or no SYNC is heard. `None` if it is not known which SYNC was its.
    pub(crate) fn measured(&mut self, frame: &Frame) -> Option<(Nanos, StampKind)> {
        let own = (frame.t, frame.stamp);
        let (Some(last), 1..) = (self.last, self.every) else {
            return Some(own);
        };
        let is_late = last.1 != StampKind::None && frame.t < last.0;
        if self.every > 1 {
            return if is_late { self.before } else { self.last };
        }
        match self.open {
            0 => Some(own),
            1 => {
                self.open = 0;
                Some(last)
            }
            _ => {
                self.open -= 1;
                match self.before.filter(|_| is_late && self.open == 1) {
                    None => {
                        self.dropped = true;
                        None
                    }
                    before => before,
                }
            }
        }
    }

    pub(crate) const fn reset(&mut self) {
        *self = Self::new(self.every);
    }
}

/// What a node says of itself.
#[derive(Debug, Default)]
pub(crate) struct NodeState {
    /// The code of its last emergency message: 0 is no error.
    pub(crate) error: u16,
}

impl NodeState {
    /// Takes a frame of the node that is no PDO, if it is one. A node that has booted or left the
    /// operational state is started again.
    pub(crate) fn on_frame<P: Plan>(
        &mut self,
        node: u8,
        frame: &Frame,
        link: &mut Link<Script<P>>,
        out: &mut Decoded,
    ) -> bool {
        if !claims(node).iter().any(|claim| claim.matches(frame.id)) {
            return false;
        }
        let Some(data) = bytes::payload(frame, out) else {
            return true;
        };
        if frame.id == sdo_from(node) {
            link.questions.answer(data, frame, out);
        } else if frame.id == emcy(node) {
            match data.len() {
                8 => self.error = u16_le(data, 0),
                _ => out.fault(Counter::Length, 1, frame.id),
            }
        } else {
            const OPERATIONAL: u8 = 0x05;
            match *data {
                // The highest bit toggles if a master guards the node.
                [state] if state & 0x7F == OPERATIONAL => {}
                [0] => {
                    self.error = 0;
                    link.bringup.restart();
                }
                [_] if link.bringup.is_watching() => link.bringup.restart(),
                [_] => {}
                _ => out.fault(Counter::Length, 1, frame.id),
            }
        }
        true
    }
}
