//! The driver `robstride`: RobStride actuators and CyberGear. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/robstride.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use options::{RobstrideModel, RobstrideOptions, RobstrideProtocol};
