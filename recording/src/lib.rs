#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

mod estimates;
mod read;
mod ring;
mod write;

pub use estimates::to_estimates;
pub use read::{ReadError, RecordingSummary, about, frames, is_mcap, to_table};
pub use ring::{Ring, RingSnapshot};
pub use write::{About, McapFile, Recorder, WriteError};
