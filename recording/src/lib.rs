//! Recordings of a robot as MCAP files (<https://mcap.dev>), which Foxglove, PlotJuggler and
//! libraries in many languages read.
//!
//! - [`Recorder`] writes one: what [`proprio_bridge`] says of a robot, and on request raw frames
//!   (`/can/<bus>`: `can_msgs/Frame`; `/can_fd/<bus>`: `ros2_socketcan_msgs/FdFrame`, which do not
//!   tell the bit rate switch).
//! - [`to_table`] turns its samples and declarations back into the table of
//!   [`proprio_topics::csv`], the same to the last bit as if the table itself had been recorded;
//!   [`to_estimates`] makes a table of its estimates,
//!   [`frames`] gives its frames, [`about`] what it says of itself.
//! - [`Ring`] holds the last seconds in memory, for a black box.
//!
//! All messages are in ROS 2's encoding (CDR), with their definitions in the file: who reads it
//! needs no ROS. A file has the robot's name and this program's version as metadata (`proprio`),
//! and files that were taken along, such as the configuration, as attachments. Log times are the
//! wall clock's.
//!
//! A file is written in compressed chunks. What a killed recorder has not flushed is missing; the
//! rest can be read, and the readers say that the end is missing.

mod estimates;
mod read;
mod ring;
mod write;

pub use estimates::to_estimates;
pub use read::{ReadError, RecordingSummary, about, frames, is_mcap, to_table};
pub use ring::{Ring, RingSnapshot};
pub use write::{About, McapFile, Recorder, WriteError};
