//! The driver `optoforce_daq`: OptoForce force sensors. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/optoforce_daq.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod options;
mod protocol;
#[cfg(feature = "recognise")]
mod recognise;

pub use options::OptoforceDaqOptions;
