//! The driver `ati_netcanoem`: ATI F/T sensors. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/ati_netcanoem.md")]

#[cfg(feature = "boards")]
mod board;
mod calibration;
mod device;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use frames::{ForceUnit, TorqueUnit};
pub use options::AtiNetcanoemOptions;
