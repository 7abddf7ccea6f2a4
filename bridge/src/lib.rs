#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

pub mod cdr;
pub mod definitions;
mod described;
mod diagnostics;
mod listener;
mod messages;

pub use described::{DescriptionReader, first_of, next};
pub use diagnostics::{Level, bus_state, device_state};
pub use listener::{Event, Heard, ListenError, Listener, one_robot, open};
pub use messages::{MessageSink, Messages};
