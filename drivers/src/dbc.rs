//! The driver `dbc`: Devices that a .dbc file describes. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/dbc.md")]

#[cfg(feature = "boards")]
mod board;
mod device;
mod layout;
mod options;

pub use options::{DbcOptions, ReadingKeys};

#[cfg(feature = "recognise")]
impl crate::Recognise for DbcOptions {}
