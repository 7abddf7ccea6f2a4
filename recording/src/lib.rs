//! Recordings of a robot as MCAP files (<https://mcap.dev>), which Foxglove, PlotJuggler and
//! libraries in many languages read.
//!
//! - [`Recorder`] writes one: the samples and declarations of a table, without loss, and beside
//!   them what viewers know: `sensor_msgs/JointState`, `sensor_msgs/Imu`,
//!   `geometry_msgs/WrenchStamped`; torques with deviations and reasons.
//! - [`to_table`] turns its samples and declarations back into the table of
//!   [`proprio_topics::csv`], the same to the last bit as if the table itself had been recorded.
//!
//! | topic | type | what |
//! |---|---|---|
//! | `/samples/<kind>/<name>` | `proprio_msgs/msg/<Kind>` | a reading: its stamp, quality, values |
//! | `/declared/<contact>` | `proprio_msgs/msg/Declared` | a contact is declared, and where |
//! | `/torques` | `proprio_msgs/msg/Torques` | torques, deviations, validity, reasons, causes |
//! | `/joint_states` | `sensor_msgs/msg/JointState` | positions; efforts: torques, NaN: withheld |
//! | `/ft/<sensor>` | `geometry_msgs/msg/WrenchStamped` | what an F/T sensor reports |
//! | `/imu/<sensor>` | `sensor_msgs/msg/Imu` | what an IMU reports |
//! | `/contact/<name>` | `geometry_msgs/msg/WrenchStamped` | the wrench of a contact, while valid |
//!
//! All are in ROS 2's encoding (CDR), with their definitions in the file: who reads it needs no
//! ROS. A file has the robot's name and this program's version as metadata (`proprio`). Log times
//! are the wall clock's; `acquired` is CLOCK_MONOTONIC \[ns\].
//!
//! A file is written in compressed chunks. What a killed recorder has not flushed is missing; the
//! rest can be read, and [`to_table`] says that the end is missing.

mod cdr;
mod definitions;
mod read;
mod write;

pub use read::{ReadError, Summary, is_mcap, to_table};
pub use write::{Recorder, WriteError};
