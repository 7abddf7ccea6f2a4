//! What the CANopen families share (CiA 301): identifiers, the network management (NMT), expedited
//! SDO transfers as a list of steps, boot-up and emergency messages, and a node's own side.
//!
//! Node `n`, 1 to 127, little-endian:
//!
//! | identifier | name | bytes |
//! |---|---|---|
//! | `000` | NMT | command, node (0: all): 01 start, 02 stop, 80 pre-operational, 81 reset |
//! | `080` | SYNC | none, or a counter |
//! | `080` + n | EMCY | error code u16, error register, 5 of the maker's; code 0: it is over |
//! | `180`, `280`, `380`, `480` + n | TPDO 1 to 4 | as mapped |
//! | `580` + n | SDO answer | `4F`, `4B`, `47`, `43` index sub value; `60` written; `80` refused |
//! | `600` + n | SDO | read: `40` index sub; write: `2F`, `2B`, `27`, `23` index sub value |
//! | `700` + n | heartbeat | 00 boot-up, 04 stopped, 05 operational, 7F pre-operational |
//!
//! Nodes are recognised by heartbeats and by SDO answers that are heard. A scan that asks reads
//! object 1000 (device type) of all nodes, 1018 sub 1 to 4 (identity) of those that answer, and
//! 1800 to 1803 sub 1 and 2 (identifier and transmission of each TPDO) of drives.

#[cfg(feature = "boards")]
mod node;
mod pdo;
mod protocol;
#[cfg(feature = "recognise")]
mod recognise;
mod script;

#[cfg(feature = "boards")]
pub(crate) use node::SimulatedNode;
pub(crate) use pdo::{Pdo, is_free};
pub(crate) use protocol::{
    MAPPED_MOST, NMT, NO_RTR, Object, SYNC, TIMING, TPDO_OFF, nmt, object, sdo_from, sdo_to, tpdo,
};
#[cfg(feature = "recognise")]
pub(crate) use recognise::{NO_PROFILE, Recognised, commands, questions, recognise};
pub(crate) use script::{READ, Script, ScriptStep, StartPlan};

use crate::bytes::u16_le;
use crate::family::Session;
use crate::objects::Objects;
use crate::received::Received;
use crate::{Claim, Frame, Spec, SpecError, keys};
use alloc::format;
use proprio_topics::{Counter, Nanos, StampKind};
use protocol::{emcy, heartbeat};

/// The node of `spec`.
pub(crate) fn node_of(spec: &Spec) -> Result<u8, SpecError> {
    keys::address(spec, 1..=127)
}

/// Refuses a file that configures another node.
pub(crate) fn check_file(node: u8, file: Option<&Objects>) -> Result<(), SpecError> {
    match file.and_then(|file| file.node) {
        Some(of) if of != node => Err(SpecError::Description(format!(
            "its file is that of node {of} (NodeID), and address = {node}"
        ))),
        _ => Ok(()),
    }
}

/// Refuses a file, of name `name`, in which an object that is `wanted` of it can not be read;
/// `remedy` replaces it.
pub(crate) fn check_objects(
    (name, file): (&str, &Objects),
    wanted: impl Fn(u16) -> bool,
    remedy: &str,
) -> Result<(), SpecError> {
    match file.problem(wanted) {
        Some(problem) => Err(SpecError::Description(format!(
            "eds = {name:?}, {problem}: correct it there, or {remedy}"
        ))),
        None => Ok(()),
    }
}

/// Refuses a file in which one of TPDO 1 to 4 that is sent and `has` something of use can not be
/// read; or any, if there is none.
pub(crate) fn check_pdos(
    (name, file): (&str, &Objects),
    node: u8,
    has: impl Fn(&Pdo) -> bool,
    remedy: &str,
) -> Result<(), SpecError> {
    let is_wanted = |number| {
        let (pdo, Object { index, sub }) =
            (Pdo::of_file(file, node, number), object::tpdo_id(number));
        has(&pdo) && (pdo.is_on() || file.unreadable.contains_key(&(index, sub)))
    };
    let none = !(0..4).any(is_wanted);
    check_objects(
        (name, file),
        |index| is_pdo(index) && (none || is_wanted((index & 3) as u8)),
        remedy,
    )
}

/// Whether an object describes TPDO 1 to 4.
pub(crate) const fn is_pdo(index: u16) -> bool {
    matches!(index, 0x1800..=0x1803 | 0x1A00..=0x1A03)
}

/// The identifiers of a node that its device listens to, beside its PDOs; among them what another
/// program writes to it.
pub(crate) fn claims(node: u8) -> impl Iterator<Item = Claim> {
    let from_node = [emcy(node), sdo_from(node), heartbeat(node)].map(Claim::exclusive);
    from_node.into_iter().chain([Claim::shared(sdo_to(node))])
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
        let stamp = (frame.t, frame.stamp);
        let (Some(last), 1..) = (self.last, self.every) else {
            return Some(stamp);
        };
        let is_late = last.1 != StampKind::None && frame.t < last.0;
        if self.every > 1 {
            return if is_late { self.before } else { self.last };
        }
        match self.open {
            0 => Some(stamp),
            1 => {
                self.open = 0;
                // The host may have noted its own SYNC late.
                Some(if is_late { stamp } else { last })
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

/// Which of several TPDOs that have the position makes the readings, so that one position is not
/// two readings. It goes on until another has come more than three times since it came: at more
/// than three times its rate, or after its silence; or until a better one comes as often. Between
/// these nothing changes, because the intervals of both scatter.
#[derive(Debug, Default)]
pub(crate) struct Rates {
    /// The one that makes the readings.
    first: Option<usize>,
    /// Of each TPDO, how often each other has come since it came.
    since: [[u8; 4]; 4],
}

impl Rates {
    /// TPDO `at`, from 0 to 3, has come. Whether it makes a reading; `is_better` says of another
    /// one whether this one is better.
    pub(crate) fn is_first(&mut self, at: usize, is_better: impl Fn(usize) -> bool) -> bool {
        for count in self.since.iter_mut().filter_map(|row| row.get_mut(at)) {
            *count = count.saturating_add(1);
        }
        let count = |of: usize, since: usize| {
            let row = self.since.get(since);
            row.and_then(|row| row.get(of)).copied().unwrap_or(0)
        };
        let is_first = self.first.is_none_or(|first| {
            at == first || count(at, first) > 3 || is_better(first) && count(first, at) <= 1
        });
        if is_first {
            self.first = Some(at);
        }
        if let Some(row) = self.since.get_mut(at) {
            *row = [0; 4];
        }
        is_first
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
    pub(crate) fn on_frame<P: StartPlan>(
        &mut self,
        node: u8,
        frame: &mut Received<'_>,
        session: &mut Session<Script<P>>,
    ) -> bool {
        let ids = [emcy(node), sdo_from(node), heartbeat(node), sdo_to(node)];
        if !ids.contains(&frame.id) {
            return false;
        }
        let Some(data) = frame.payload() else {
            return true;
        };
        if frame.id == sdo_from(node) {
            session.questions.answer(data, frame);
        } else if frame.id == sdo_to(node) {
            session.questions.overhear(data);
        } else if frame.id == emcy(node) {
            match data.len() {
                8 => self.error = u16_le(data, 0),
                _ => frame.fault(Counter::Length),
            }
        } else {
            const OPERATIONAL: u8 = 0x05;
            match *data {
                // The highest bit toggles if a master guards the node.
                [state] if state & 0x7F == OPERATIONAL => {}
                [0] => {
                    self.error = 0;
                    session.bringup.restart();
                }
                [_] if session.bringup.is_watching() => session.bringup.restart(),
                [_] => {}
                _ => frame.fault(Counter::Length),
            }
        }
        true
    }
}
