//! The driver `icub_imu`: iCub IMUs. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_imu.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use frames::{Fusion, ImuQuantity, Legacy};
pub use options::IcubImuOptions;
