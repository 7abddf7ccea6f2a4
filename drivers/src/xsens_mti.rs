//! The driver `xsens_mti`: Xsens MTi. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/xsens_mti.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use frames::{HighRate, MtiMessage};
pub use options::XsensMtiOptions;
