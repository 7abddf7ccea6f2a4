//! The object dictionary of a CANopen device as an EDS or DCF file (CiA 306) states it. The gateway
//! reads the file; drivers get this table.

use alloc::collections::BTreeMap;
use alloc::string::String;

/// What a file says of a device.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Objects {
    /// The node that a DCF configures; `None` in an EDS.
    pub node: Option<u8>,
    /// The bit rate that it configures \[bit/s\].
    pub bit_rate: Option<u32>,
    /// The maker's number (as object 1018 sub 1).
    pub vendor: Option<u32>,
    /// The integers of up to 32 bits, by index and sub-index.
    pub entries: BTreeMap<(u16, u8), ObjectEntry>,
    /// Why others can not be read: told only to somebody who needs them.
    pub unreadable: BTreeMap<(u16, u8), String>,
}

/// The value of an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ObjectEntry {
    /// The number; a negative one in two's complement.
    pub number: u32,
    /// The number of the node is added to it.
    pub plus_node: bool,
    /// It holds for this very device (the ParameterValue of a DCF, or a constant), and is no
    /// default that may have been changed.
    pub own: bool,
}

impl Objects {
    /// The value of an object of `node`; `None` if the file has none.
    #[must_use]
    pub fn value(&self, index: u16, sub: u8, node: u8) -> Option<u32> {
        let entry = self.entries.get(&(index, sub))?;
        let node = if entry.plus_node { node } else { 0 };
        Some(entry.number.wrapping_add(u32::from(node)))
    }

    /// Why one of the objects `wanted` can not be read, if one can not.
    pub(crate) fn problem(&self, wanted: impl Fn(u16) -> bool) -> Option<&str> {
        let found = self
            .unreadable
            .iter()
            .find(|((index, _), _)| wanted(*index));
        found.map(|(_, problem)| problem.as_str())
    }

    /// The value of an object that this very device has ([`ObjectEntry::own`]); `None` for 0, by
    /// which makers mean that it is not stated.
    #[must_use]
    pub fn own(&self, index: u16, sub: u8) -> Option<u32> {
        let entry = self.entries.get(&(index, sub))?;
        (entry.own && entry.number != 0).then_some(entry.number)
    }
}
