//! Transmit process data (TPDO): which objects a node sends in which frame, from its objects 1800
//! and 1A00, as the node or a file tells them.

use super::protocol::{MAPPED_MOST, NO_RTR, Object, TPDO_OFF, object};
use super::script::ScriptStep;
use crate::Id;
use crate::objects::Objects;

/// A TPDO.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Pdo {
    /// Object 1800 sub 1; `None`: there is none.
    pub(crate) id: Option<u32>,
    /// 0 to 240: by SYNC.
    pub(crate) transmission: u8,
    /// How many entries of the mapping count.
    pub(crate) count: u8,
    pub(crate) mapping: [u32; 8],
}

/// The identifier in a COB-ID.
fn identifier(cob_id: u32) -> Id {
    const EXTENDED: u32 = 1 << 29;
    #[allow(clippy::cast_possible_truncation)] // 11 bits
    match cob_id & EXTENDED {
        0 => Id::standard((cob_id & 0x7FF) as u16),
        _ => Id::extended(cob_id & 0x1FFF_FFFF),
    }
}

/// Whether CiA 301 leaves `id` to process data.
pub(crate) fn is_free(id: Id) -> bool {
    match id {
        Id::Standard(raw) => matches!(raw, 0x181..=0x580 | 0x680..=0x6DF),
        Id::Extended(_) => true,
    }
}

impl Pdo {
    /// TPDO `number`, from 0, of `node` as a file states it.
    pub(crate) fn of_file(objects: &Objects, node: u8, number: u8) -> Self {
        let value = |object: Object| objects.value(object.index, object.sub, node);
        let mut this = Self::default();
        this.take(object::tpdo_id(number), value(object::tpdo_id(number)));
        this.take(
            object::tpdo_transmission(number),
            value(object::tpdo_transmission(number)),
        );
        let count = value(object::tpdo_mapping(number, 0));
        this.take(
            object::tpdo_mapping(number, 0),
            count.or(Some(MAPPED_MOST.into())),
        );
        for sub in 1..=this.count {
            let entry = object::tpdo_mapping(number, sub);
            let Some(told) = value(entry) else {
                // Makers leave out the number of entries, or entries that are not used. Where
                // those after a missing one are is not known.
                this.count = sub - 1;
                break;
            };
            this.take(entry, Some(told));
        }
        this
    }

    /// TPDO `number` of a node whose objects have these values.
    pub(crate) fn of_node(number: u8, value: impl Fn(Object) -> u32) -> Self {
        let mut this = Self::default();
        let entries = (0..=MAPPED_MOST).map(|sub| object::tpdo_mapping(number, sub));
        let objects = [object::tpdo_id(number), object::tpdo_transmission(number)];
        for object in objects.into_iter().chain(entries) {
            this.take(object, Some(value(object)));
        }
        this
    }

    /// The number of steps of [`Pdo::setup`].
    pub(crate) const SETUP: usize = 6 + MAPPED_MOST as usize;

    /// Step `at` of those that set TPDO `number` of a pre-operational node to this: it is off while
    /// its mapping changes. What no SYNC causes is sent each `timer_ms`. `None`: the step is not
    /// needed.
    pub(crate) fn setup(&self, number: u8, timer_ms: u32, at: usize) -> Option<ScriptStep> {
        const ID: usize = Pdo::SETUP - 1;
        const TIMER: usize = Pdo::SETUP - 2;
        const TRANSMISSION: usize = Pdo::SETUP - 3;
        const COUNT: usize = Pdo::SETUP - 4;
        let id = self.id? & !TPDO_OFF | NO_RTR;
        #[allow(clippy::cast_possible_truncation)] // at most 8
        let (object, value, bytes) = match at {
            0 => (object::tpdo_id(number), id | TPDO_OFF, 4),
            1 => (object::tpdo_mapping(number, 0), 0, 1),
            COUNT => (object::tpdo_mapping(number, 0), self.count.into(), 1),
            TRANSMISSION => {
                let transmission = self.transmission.into();
                (object::tpdo_transmission(number), transmission, 1)
            }
            TIMER if self.by_sync() => return None,
            TIMER => (object::tpdo_timer(number), timer_ms, 2),
            ID => (object::tpdo_id(number), id, 4),
            at => {
                let mapped = self.mapping.iter().take(usize::from(self.count));
                let entry = mapped.copied().nth(at - 2)?;
                (object::tpdo_mapping(number, at as u8 - 1), entry, 4)
            }
        };
        Some(ScriptStep::Write {
            object,
            value,
            bytes,
        })
    }

    /// Takes the value of one of its objects; `None`: the node does not have it.
    pub(crate) fn take(&mut self, object: Object, value: Option<u32>) {
        let [_, kind] = object.index.to_le_bytes();
        #[allow(clippy::cast_possible_truncation)] // these entries are bytes
        match (kind, object.sub) {
            // Makers write 0 where there is none.
            (0x18, 1) => self.id = value.filter(|id| *id != 0),
            (0x18, 2) => self.transmission = value.map_or(u8::MAX, |v| v as u8),
            // Above 64 there is no mapping: each frame says which object it has.
            (0x1A, 0) => {
                let count = value.filter(|count| *count <= 64);
                self.count = count.map_or(0, |v| v as u8).min(MAPPED_MOST);
            }
            (0x1A, sub) => {
                if let Some(entry) = self.mapping.get_mut(usize::from(sub.wrapping_sub(1))) {
                    *entry = value.unwrap_or(0);
                }
            }
            _ => {}
        }
    }

    /// Whether it is sent at all.
    pub(crate) fn is_on(&self) -> bool {
        self.id.is_some_and(|id| id & TPDO_OFF == 0)
    }

    /// Whether it could be sent, and is switched off.
    pub(crate) fn is_off(&self) -> bool {
        self.id.is_some_and(|id| id & TPDO_OFF != 0)
    }

    /// Its identifier, if it is sent and holds something.
    pub(crate) fn used_id(&self) -> Option<Id> {
        let id = self.id.filter(|_| self.is_on() && self.count > 0)?;
        Some(identifier(id))
    }

    pub(crate) fn by_sync(&self) -> bool {
        self.transmission <= 240
    }

    /// The mapped objects, each with its first bit and its length \[bits\].
    pub(crate) fn objects(&self) -> impl Iterator<Item = (Object, u64, u64)> {
        let mapped = self.mapping.iter().take(usize::from(self.count));
        mapped.scan(0, |at, entry| {
            let [bits, sub, low, high] = entry.to_le_bytes();
            let (first, length) = (*at, u64::from(bits));
            *at += length;
            let index = u16::from_le_bytes([low, high]);
            Some((Object::new(index, sub), first, length))
        })
    }
}
