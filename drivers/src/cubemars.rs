//! The driver `cubemars`: CubeMars actuators. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/cubemars.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use options::{Angle, CubemarsMode, CubemarsModel, CubemarsOptions, Effort};
