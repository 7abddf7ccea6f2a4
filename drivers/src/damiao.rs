//! The driver `damiao`: Damiao actuators. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/damiao.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod frames;
mod options;
mod ranges;
#[cfg(feature = "recognise")]
mod recognise;

pub use options::{DamiaoModel, DamiaoOptions};
