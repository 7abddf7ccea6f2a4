//! The driver `myactuator`: MyActuator RMD actuators. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/myactuator.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use frames::MyactuatorProtocol;
pub use options::{MyactuatorOptions, MyactuatorPosition};
