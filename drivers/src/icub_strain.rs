//! The driver `icub_strain`: iCub F/T boards. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_strain.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod exchange;
mod frames;
mod options;
#[cfg(feature = "recognise")]
mod recognise;

pub use options::{IcubStrainOptions, StrainStream};
