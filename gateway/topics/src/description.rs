//! The meaning of the numbers in the payloads: name, kind, bus and maximum silence of each channel,
//! joint and contact.

use crate::code::coded;
use crate::{Code, Header, Kind, Nanos, valid};
use core::fmt;
use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;
use zerocopy::FromBytes;

/// A name of at most 63 bytes of UTF-8, ended by a zero byte.
#[repr(C)]
#[derive(Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend, FromBytes)]
pub struct Name {
    bytes: [u8; 64],
}

impl Name {
    /// The longest name \[bytes\].
    pub const CAPACITY: usize = 63;
    /// No name.
    pub const EMPTY: Self = Self { bytes: [0; 64] };

    /// `text` as a name; `None` if it is longer than [`Name::CAPACITY`] bytes or holds a zero byte.
    #[must_use]
    pub fn new(text: &str) -> Option<Self> {
        let mut bytes = [0; 64];
        if text.len() > Self::CAPACITY || text.bytes().any(|b| b == 0) {
            return None;
        }
        bytes
            .get_mut(..text.len())?
            .copy_from_slice(text.as_bytes());
        Some(Self { bytes })
    }

    /// The text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        let end = self
            .bytes
            .iter()
            .position(|&b| b == 0)
            .unwrap_or(Self::CAPACITY);
        let bytes = self.bytes.get(..end).unwrap_or_default();
        core::str::from_utf8(bytes).unwrap_or("?")
    }
}

impl fmt::Debug for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), f)
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

coded! {
    /// The sender of a description.
    pub enum Publisher {
        /// The gateway: channels of `<robot>/samples`.
        Gateway = 0 => "gateway",
        /// The estimator: joints of `<robot>/estimate/torque`, contacts of
        /// `<robot>/estimate/contact`, and the channels that `cause` refers to.
        Estimator = 1 => "estimator",
    }
}

/// The origin of the channel whose samples are the instants of the estimates.
pub const TRIGGER: &str = "trigger";

coded! {
    /// What an entry's number is an index of.
    pub enum Role {
        /// `Sample::channel` (from the gateway), `JointTorque::cause` (from the estimator).
        Channel = 0 => "channel",
        /// The index into `TorqueEstimate::joints`.
        Joint = 1 => "joint",
        /// The index into `ContactEstimate::contacts`.
        Contact = 2 => "contact",
        /// The index into `ContactEstimate::residuals`; the name is that of the sub-tree's top
        /// link.
        SubTree = 3 => "sub_tree",
    }
}

/// One named number.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, ZeroCopySend, FromBytes)]
pub struct Entry {
    /// Its name.
    pub name: Name,
    /// What it belongs to: for a contact or a sub-tree, the frame its wrench is expressed in (axes
    /// and point); for a channel of the gateway, its device; for the channel of the estimator whose
    /// samples are the instants of the estimates, [`TRIGGER`]. Otherwise empty.
    pub origin: Name,
    /// Maximum silence: the longest normal time between two samples \[ns\]; 0 where it has no
    /// meaning.
    pub max_silence: Nanos,
    /// What `index` is an index of.
    pub role: Code<Role>,
    /// The index.
    pub index: u32,
    /// The kind of a channel; `Kind::Joint` for a joint, `Kind::Wrench` for a contact or sub-tree.
    pub kind: Code<Kind>,
    /// The bus that a channel is on.
    pub bus: u32,
}

/// The names of all numbers of one publisher: the payload of `<robot>/description`. A reader that
/// opens late receives the last one.
#[repr(C)]
#[derive(Debug, Clone, Copy, ZeroCopySend, FromBytes)]
#[type_name("proprio/Description/3")]
pub struct Description {
    /// Time stamps and sequence number; `epoch` is that of the publisher's other payloads.
    pub header: Header,
    /// The sender.
    pub publisher: Code<Publisher>,
    /// Number of valid entries in `entries`.
    pub count: u32,
    /// The entries.
    pub entries: [Entry; Self::CAPACITY],
}

impl Entry {
    /// An unused entry.
    pub const NONE: Self = Self {
        name: Name::EMPTY,
        origin: Name::EMPTY,
        max_silence: Nanos::ZERO,
        role: Role::Channel.in_memory(),
        index: 0,
        kind: Kind::Joint.in_memory(),
        bus: 0,
    };
}

impl Description {
    /// The description that `publisher` sends; entries beyond [`Description::CAPACITY`] are
    /// omitted.
    #[must_use]
    pub fn new(publisher: Publisher, entries: impl IntoIterator<Item = Entry>) -> Self {
        let mut description = Self {
            header: Header::default(),
            publisher: publisher.in_memory(),
            count: 0,
            entries: [Entry::NONE; Self::CAPACITY],
        };
        for (place, entry) in description.entries.iter_mut().zip(entries) {
            *place = entry;
            description.count += 1;
        }
        description
    }

    /// Maximum number of entries.
    pub const CAPACITY: usize =
        crate::MAX_CHANNELS + crate::MAX_JOINTS + crate::MAX_CONTACTS + crate::MAX_SUBTREES;

    /// The valid entries.
    #[must_use]
    pub fn entries(&self) -> &[Entry] {
        valid(&self.entries, self.count)
    }

    /// The entry for number `index` of `role`.
    #[must_use]
    pub fn find(&self, role: Role, index: u32) -> Option<&Entry> {
        self.entries()
            .iter()
            .find(|e| e.role == role && e.index == index)
    }

    /// The number that `name` has in `role`.
    #[must_use]
    pub fn index(&self, role: Role, name: &str) -> Option<u32> {
        self.entries()
            .iter()
            .find(|e| e.role == role && e.name.as_str() == name)
            .map(|e| e.index)
    }
}

const _: () = assert!(
    size_of::<Entry>() == 152 && size_of::<Description>() == 64 + 152 * Description::CAPACITY
);

/// What a robot's name is, in words: see [`is_robot_name`].
pub const ROBOT_NAME: &str = "a robot's name begins with a letter or a digit and has at most 63 \
                              letters, digits, `-`, `_` or `.`";

/// Whether `name` can be a robot's: it is part of the names of services, of files, and of command
/// lines.
#[must_use]
pub fn is_robot_name(name: &str) -> bool {
    let legal = |c: u8| c.is_ascii_alphanumeric() || matches!(c, b'-' | b'_' | b'.');
    name.len() <= Name::CAPACITY
        && name.bytes().all(legal)
        && name
            .bytes()
            .next()
            .is_some_and(|c| c.is_ascii_alphanumeric())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robots_name_begins_with_a_letter_or_a_digit() {
        let longest = "x".repeat(63);
        for name in ["r", "7", "iCub_2.left-arm", "a..", longest.as_str()] {
            assert!(is_robot_name(name), "{name}");
        }
        let longer = "x".repeat(64);
        for name in [
            "",
            ".",
            "..",
            "-x",
            "_x",
            ".r",
            "../x",
            "a/b",
            "a b",
            "r\u{f6}bi",
            "r\0",
            "r\n",
            longer.as_str(),
        ] {
            assert!(!is_robot_name(name), "{name:?}");
        }
    }
    use std::string::ToString;

    #[test]
    fn names_hold_63_bytes_of_utf8() {
        assert_eq!(
            Name::new("l_elbow").map(|n| n.to_string()).as_deref(),
            Some("l_elbow")
        );
        let longest = "x".repeat(63);
        assert_eq!(
            Name::new(&longest).as_ref().map(Name::as_str),
            Some(longest.as_str())
        );
        assert!(Name::new(&"x".repeat(64)).is_none());
        assert!(Name::new("a\0b").is_none());
    }
}
