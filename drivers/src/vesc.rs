//! The driver `vesc`: VESC motor controllers. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/vesc.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use options::{VescOptions, VescPosition};
