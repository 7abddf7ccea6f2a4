//! Recognising nodes: by heartbeats, and by what they answer to questions about their identity.

use super::protocol::{NMT, SYNC, emcy, heartbeat, object, sdo_from, sdo_to, tpdo};
use super::{Object, READ};
use crate::bytes::{u16_le, u32_le};
use crate::recognise::{Evidence, Stream, Traffic};
use crate::{Format, Frame, Id};
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;
use core::ops::RangeInclusive;

/// Vendor, product, revision, serial number.
const IDENTITY: [(u8, &str); 4] = [
    (1, "vendor"),
    (2, "product"),
    (3, "revision"),
    (4, "serial"),
];
/// An index of 16 bits and a sub-index of 8 that are its own \[bits\].
const OBJECT: f64 = 24.0;
/// The device profile of drives.
const DRIVE: u32 = 402;
/// States in a heartbeat, without the bit that toggles in node guarding.
const STATES: [u8; 4] = [0x00, 0x04, 0x05, 0x7F];

/// What a node is that has not told.
pub(crate) const NO_PROFILE: &str =
    "CANopen node whose profile (drive, encoder or another) was not heard";

/// A node.
#[derive(Debug, Clone)]
pub(crate) struct Recognised<'t> {
    pub(crate) evidence: Evidence<'t>,
    pub(crate) node: u8,
    /// The device profile, if it has told.
    pub(crate) profile: Option<u16>,
    /// Its identity in words, after a comma; empty if it has not told.
    pub(crate) identity: String,
    /// It sends when a SYNC comes, and none comes.
    pub(crate) needs_sync: bool,
    /// TPDO 1 to 4, if they are sent.
    pub(crate) tpdos: [Option<&'t Stream>; 4],
}

const fn identity(sub: u8) -> Object {
    Object::new(0x1018, sub)
}

/// The value that node `node` has told of `object`.
fn answered(seen: &Traffic, node: u8, object: Object) -> Option<u32> {
    let stream = seen.stream(sdo_from(node))?;
    stream.kept().find_map(|frame| match *frame.data() {
        // Of four bytes so many are unused.
        [0x43 | 0x47 | 0x4B | 0x4F, _, _, sub, _, _, _, _] if sub == object.sub => {
            let unused = frame.data().first().map_or(0, |first| first >> 2 & 3);
            let value = u32_le(frame.data(), 4) & u32::MAX >> (8 * unused);
            (u16_le(frame.data(), 1) == object.index).then_some(value)
        }
        _ => None,
    })
}

/// Whether node `node` has told of a TPDO that it sends when a SYNC comes, and none is heard.
fn needs_sync(seen: &Traffic, node: u8) -> bool {
    let by_sync = |number| {
        let is_on = |id: u32| id >> 31 == 0;
        let by_sync = answered(seen, node, object::tpdo_transmission(number));
        by_sync.is_some_and(|transmission| transmission <= 240)
            && answered(seen, node, object::tpdo_id(number)).is_none_or(is_on)
    };
    seen.stream(SYNC).is_none_or(|sync| sync.frames == 0) && (0..4).any(by_sync)
}

/// Whether it is an answer to an SDO command: 8 bytes, one of about 40 first bytes.
fn is_answer(frame: &Frame) -> bool {
    let command = frame.data().first().copied();
    let is_one = command.is_some_and(|command| {
        matches!(command, 0x00..=0x20 | 0x30 | 0x41..=0x43 | 0x47 | 0x4B | 0x4F | 0x60 | 0x80)
    });
    frame.format == Format::Classic && frame.len() == 8 && is_one
}

fn is_heartbeat(frame: &Frame) -> bool {
    match *frame.data() {
        [state] => STATES.contains(&(state & 0x7F)),
        _ => false,
    }
}

/// The nodes that `seen` shows. Process data alone shows none: anything may be on their
/// identifiers.
pub(crate) fn recognise(seen: &Traffic) -> impl Iterator<Item = Recognised<'_>> {
    (1..=127).filter_map(|node| {
        let mut evidence = Evidence::new(seen, 127);
        let beats = evidence.sends(heartbeat(node), is_heartbeat);
        let answers = evidence.sends(sdo_from(node), is_answer);
        if beats.is_none() && answers.is_none() {
            return None;
        }
        let device_type = answered(seen, node, object::DEVICE_TYPE);
        let mut words = String::new();
        if device_type.is_some() {
            evidence.add(OBJECT);
        }
        for (sub, name) in IDENTITY {
            if let Some(value) = answered(seen, node, identity(sub)) {
                evidence.add(OBJECT);
                words += &format!(", {name} {value:#x}");
            }
        }
        let tpdos =
            [0, 1, 2, 3].map(|number| evidence.sends(tpdo(node, number), |frame| frame.len() <= 8));
        for id in [emcy(node), sdo_to(node)] {
            evidence.belongs(id);
        }
        #[allow(clippy::cast_possible_truncation)] // the low 16 bits
        let profile = device_type.map(|device_type| device_type as u16);
        Some(Recognised {
            evidence,
            node,
            profile,
            identity: words,
            needs_sync: needs_sync(seen, node),
            tpdos,
        })
    })
}

/// On what node `node` takes commands: the network management, and the process data of RPDO 1 to 4.
pub(crate) fn commands(node: u8) -> impl Iterator<Item = RangeInclusive<Id>> {
    let rpdos = [0x200, 0x300, 0x400, 0x500].map(|base| Id::standard(base + u16::from(node)));
    rpdos.into_iter().chain([NMT]).map(|id| id..=id)
}

/// All nodes are asked for their profile, those that have answered for their identity, and drives
/// for what makes them send. To read an object changes nothing.
pub(crate) fn questions(seen: &Traffic) -> Vec<Frame> {
    let read = |node, object: Object| {
        let [low, high] = object.index.to_le_bytes();
        Frame::new(sdo_to(node), &[READ, low, high, object.sub, 0, 0, 0, 0])
    };
    let mut questions = Vec::new();
    for node in 1..=127 {
        questions.push(read(node, object::DEVICE_TYPE));
        let device_type = answered(seen, node, object::DEVICE_TYPE);
        if device_type.is_some() {
            questions.extend(IDENTITY.map(|(sub, _)| read(node, identity(sub))));
        }
        if device_type.is_some_and(|device_type| device_type & 0xFFFF == DRIVE) {
            for number in 0..4 {
                questions.push(read(node, object::tpdo_id(number)));
                questions.push(read(node, object::tpdo_transmission(number)));
            }
        }
    }
    questions
}
