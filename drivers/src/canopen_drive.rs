//! The driver `canopen_drive`: CANopen drives. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/canopen_drive.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod layout;
mod options;
#[cfg(feature = "recognise")]
mod recognise;
mod start;

pub use options::{CanopenDriveOptions, CurrentUnit, PdoKeys, VelocityUnit};
