//! The contract between Proprio's processes: the samples they exchange, the names of the services that carry them and
//! their quality of service. A consumer of Proprio depends on this crate alone.
//!
//! - [`reading`]: what a device measured, in SI units: [`Reading`] and its variants.
//! - [`sample`]: a reading with its channel and its [`Header`]: when, how well, which in the sequence.
//! - [`estimate`]: joint torques and contact wrenches, each with its validity and the reason where it is not valid.
//! - [`inertia`]: identified inertial parameters and F/T offsets, with their standard deviations and what they rest on.
//! - [`description`]: what the channel, joint and contact numbers mean.
//! - [`health`]: how gateway and estimator are doing.
//! - [`time`]: instants as integer nanoseconds.
//! - `csv` (feature `csv`): the same samples as a text table.
//! - `ipc` (feature `ipc`): the ports: a domain in shared memory, writers and readers; `realtime`: how the threads that
//!   use them are scheduled.
//!
//! Every type that crosses a process boundary is `repr(C)`; its size is asserted here at compile time and its layout's
//! version is part of its type name, because the transport itself compares names, sizes and alignments only.
//!
//! # Conventions
//! Angles in rad, forces in N, torques in Nm, right-handed frames. *Absent is not zero*: a quantity that a device does
//! not report is NaN, a sample that should have come and did not is a freshness of the reader, and an estimate that can
//! not be trusted keeps its number with `valid = 0` and the reason.
#![no_std]
#[cfg(any(feature = "std", test))]
extern crate std;

#[cfg(feature = "csv")]
pub mod csv;
pub mod description;
pub mod estimate;
pub mod health;
pub mod inertia;
#[cfg(feature = "ipc")]
pub mod ipc;
pub mod reading;
#[cfg(feature = "ipc")]
pub mod realtime;
pub mod sample;
pub mod time;

pub use description::{Description, Entry, Name, Publisher, Role};
pub use estimate::{
    ContactDeclaration, ContactEstimate, ContactWrench, JointTorque, NO_CAUSE, NO_CONTACT, Reason, Residual,
    TorqueEstimate,
};
pub use health::{BusHealth, Counter, DeviceHealth, EstimatorHealth, GatewayHealth, IdentificationHealth, LinkState};
pub use inertia::{InertiaEstimate, LinkInertia, SensorOffset};
pub use reading::{Actuator, Gauges, Imu, JointState, Kind, Reading, Temperature, Wrench};
pub use sample::{Header, Quality, Sample, Saturation, StampKind};
pub use time::Nanos;

/// The most channels one gateway serves.
pub const MAX_CHANNELS: usize = 128;
/// The most joints one estimate holds.
pub const MAX_JOINTS: usize = 64;
/// The most contacts one estimate holds.
pub const MAX_CONTACTS: usize = 16;
/// The most links one estimate of inertial parameters holds.
pub const MAX_LINKS: usize = 128;
/// The most F/T sensors whose offsets one estimate holds.
pub const MAX_SENSORS: usize = 32;
/// The most sub-trees, pieces of the robot between F/T sensors, one estimate holds.
pub const MAX_SUBTREES: usize = MAX_SENSORS + 1;
/// The most buses one gateway reads; also the most publishers of samples.
pub const MAX_BUSES: usize = 16;
