//! The driver `openimu`: Aceinna OpenIMU and MTLT. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/openimu.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use frames::{AxisOrder, OpenImuQuantity, Upright};
pub use options::OpenImuOptions;
