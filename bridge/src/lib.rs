//! What every program that carries a robot's state elsewhere shares: recorders, viewers, ROS 2.
//!
//! ```text
//! shared memory -> Listener -> Heard -> Messages -> a Sink: a file, a viewer, a network
//!                  (restarts,  (stamps,  (CDR, topics,
//!                   names)      values)   definitions)
//! ```
//!
//! - [`Listener`] follows one robot over restarts of its daemons, and damage of its domain.
//! - [`Messages`] says what it hears in ROS 2's encoding (CDR), with the definitions of the
//!   messages: standard ones where they exist, `proprio_msgs` where they would lose something.
//! - [`MessageSink`] is where messages go.
//!
//! | topic | type | what |
//! |---|---|---|
//! | `/samples/<kind>/<name>` | `proprio_msgs/msg/<Kind>` | a reading: its stamp, quality, values |
//! | `/declared/<contact>` | `proprio_msgs/msg/Declared` | a contact is declared, and where |
//! | `/torques` | `proprio_msgs/msg/Torques` | torques, deviations, validity, reasons, causes |
//! | `/torque/<joint>` | `proprio_msgs/msg/JointTorque` | one of them with a band, for plots |
//! | `/contacts` | `proprio_msgs/msg/Contacts` | the same of contact wrenches |
//! | `/joint_states` | `sensor_msgs/msg/JointState` | positions; efforts: torques, NaN: withheld |
//! | `/ft/<sensor>` | `geometry_msgs/msg/WrenchStamped` | what an F/T sensor reports |
//! | `/imu/<sensor>` | `sensor_msgs/msg/Imu` | what an IMU reports |
//! | `/contact/<name>` | `geometry_msgs/msg/WrenchStamped` | the wrench of a contact, while valid |
//! | `/external/<link>` | `geometry_msgs/msg/WrenchStamped` | F/T beyond model and known contacts |
//! | `/diagnostics` | `diagnostic_msgs/msg/DiagnosticArray` | buses, devices, estimator |
//!
//! Stamps of standard messages are the wall clock's; `acquired` is CLOCK_MONOTONIC \[ns\].

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
