//! A node's own side: its object dictionary, NMT state and SDO server.

use super::protocol::{
    NMT, Object, SYNC, TPDO_OFF, emcy, heartbeat, nmt, object, sdo_from, sdo_to,
};
use crate::bytes::{u16_le, u32_le};
use crate::{Format, Frame, Frames, Id, board};
use alloc::collections::BTreeMap;
use proprio_topics::Nanos;

/// The value of an entry, and its length \[bytes\].
type Entry = (u32, u8);

/// A simulated node.
#[derive(Debug)]
pub(crate) struct SimulatedNode {
    id: u8,
    operational: bool,
    /// The entries after power-on.
    memory: BTreeMap<Object, Entry>,
    entries: BTreeMap<Object, Entry>,
    /// SYNC since the last TPDO, per TPDO.
    syncs: [u8; 4],
    /// The code of its last emergency message.
    error: u16,
}

/// SDO abort codes.
const NO_OBJECT: u32 = 0x0602_0000;
const LENGTH: u32 = 0x0607_0010;
const COMMAND: u32 = 0x0504_0001;

impl SimulatedNode {
    /// A node with these entries; `operational`: another program has started it.
    pub(crate) fn new(id: u8, operational: bool, entries: &[(Object, u32, u8)]) -> Self {
        // The identity of a simulated node: no vendor; its number is its serial number.
        let identity = [
            (0, 4, 1),
            (1, 0, 4),
            (2, 0, 4),
            (3, 0, 4),
            (4, id.into(), 4),
        ]
        .map(|(sub, value, bytes)| (Object::new(0x1018, sub), value, bytes));
        let memory: BTreeMap<_, _> = (identity.iter().chain(entries))
            .map(|(object, value, bytes)| (*object, (*value, *bytes)))
            .collect();
        Self {
            id,
            operational,
            entries: memory.clone(),
            memory,
            syncs: [0; 4],
            error: 0,
        }
    }

    /// The value of an entry; 0 if it has none.
    pub(crate) fn value(&self, object: Object) -> u32 {
        self.entries.get(&object).map_or(0, |entry| entry.0)
    }

    /// Whether TPDO `number` is sent while the node is operational.
    pub(crate) fn sends(&self, number: u8) -> bool {
        let id = self.entries.get(&object::tpdo_id(number));
        self.operational && id.is_some_and(|(id, _)| id & TPDO_OFF == 0)
    }

    /// The identifier of TPDO `number`.
    pub(crate) fn tpdo_id(&self, number: u8) -> Id {
        #[allow(clippy::cast_possible_truncation)] // 11 bits
        Id::standard((self.value(object::tpdo_id(number)) & 0x7FF) as u16)
    }

    /// The period of TPDO `number`, if a timer sends it.
    pub(crate) fn period(&self, number: u8) -> Option<Nanos> {
        let by_timer = self.value(object::tpdo_transmission(number)) >= 254;
        let ms = i64::from(self.value(object::tpdo_timer(number)));
        (self.sends(number) && by_timer && ms > 0).then(|| Nanos::from_millis(ms))
    }

    /// An emergency message, if `code` is new.
    pub(crate) fn report(&mut self, code: u16, out: &mut Frames) {
        if core::mem::replace(&mut self.error, code) != code {
            let [low, high] = code.to_le_bytes();
            let register = u8::from(code != 0);
            let data = [low, high, register, 0, 0, 0, 0, 0];
            board::send(emcy(self.id), &data, out);
        }
    }

    /// Answers a frame from the bus. Returns the TPDOs that are to be sent now, one bit each.
    pub(crate) fn on_frame(&mut self, frame: &Frame, out: &mut Frames) -> u8 {
        if frame.format != Format::Classic {
            return 0;
        }
        match (frame.id, frame.data()) {
            (NMT, &[command, to]) if to == 0 || to == self.id => self.manage(command, out),
            (SYNC, [] | [_]) => return self.sync(),
            (id, data) if id == sdo_to(self.id) && data.len() == 8 => self.serve(data, out),
            _ => {}
        }
        0
    }

    fn manage(&mut self, command: u8, out: &mut Frames) {
        match command {
            nmt::START => self.operational = true,
            nmt::STOP | nmt::PRE_OPERATIONAL => self.operational = false,
            nmt::RESET_NODE | nmt::RESET_COMMUNICATION => {
                self.operational = false;
                self.entries = self.memory.clone();
                board::send(heartbeat(self.id), &[0], out);
            }
            _ => {}
        }
    }

    fn sync(&mut self) -> u8 {
        let mut due = 0;
        for number in 0..4_u8 {
            let every = self.value(object::tpdo_transmission(number));
            let Some(count) = self.syncs.get_mut(usize::from(number)) else {
                continue;
            };
            *count = count.saturating_add(1);
            if (1..=240).contains(&every) && u32::from(*count) >= every {
                *count = 0;
                due |= u8::from(self.sends(number)) << number;
            }
        }
        due
    }

    fn serve(&mut self, data: &[u8], out: &mut Frames) {
        let &[command, low, high, sub, ..] = data else {
            return;
        };
        let object = Object::new(u16_le(data, 1), sub);
        let entry = self.entries.get_mut(&object);
        let (reply, value) = match (command, entry) {
            (0x40, Some((value, bytes))) => (0x43 | (4 - *bytes) << 2, *value),
            (0x23 | 0x27 | 0x2B | 0x2F, Some((value, bytes)))
                if 4 - (command >> 2 & 3) == *bytes =>
            {
                let unused = 32 - 8 * u32::from(*bytes);
                *value = u32_le(data, 4) & u32::MAX >> unused;
                (0x60, 0)
            }
            (0x23 | 0x27 | 0x2B | 0x2F, Some(_)) => (0x80, LENGTH),
            (0x40 | 0x23 | 0x27 | 0x2B | 0x2F, None) => (0x80, NO_OBJECT),
            _ => (0x80, COMMAND),
        };
        let [a, b, c, d] = value.to_le_bytes();
        let data = [reply, low, high, sub, a, b, c, d];
        board::send(sdo_from(self.id), &data, out);
    }
}
