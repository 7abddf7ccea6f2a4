//! The driver `jr3_can`: JR3 force/torque sensors. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/jr3_can.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod options;
mod protocol;
#[cfg(feature = "recognise")]
mod recognise;
mod scales;

pub use options::Jr3CanOptions;
