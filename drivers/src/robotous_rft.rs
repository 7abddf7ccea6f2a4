//! The driver `robotous_rft`: Robotous RFT force/torque sensors.
//! What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/robotous_rft.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod options;
mod protocol;
#[cfg(feature = "recognise")]
mod recognise;

pub use options::{RftModel, RobotousRftOptions};
