//! The driver `odrive`: ODrive motor controllers. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/odrive.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod firmware;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use firmware::Firmware;
pub use options::OdriveOptions;
