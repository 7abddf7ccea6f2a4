//! The interface between Proprio's processes: the samples and estimates they exchange, the names of
//! the services that carry them, and their quality of service. A consumer of Proprio depends on
//! this crate alone.
//!
//! - [`reading`]: what a device measured, in SI units: [`Reading`] and its variants.
//! - [`sample`]: a reading with its channel number and its [`Header`] (time stamp, quality,
//!   sequence number).
//! - [`estimate`]: joint torques and contact wrenches, each with a validity flag and, if it is not
//!   valid, the reason.
//! - [`budget`]: what a torque rests on, and how much of its variance each input causes.
//! - [`drive`]: the torques that drives report, beside the estimated ones.
//! - [`inertia`]: identified inertial parameters and F/T offsets, with their standard deviations
//!   and the amount of data they come from.
//! - [`description`]: what the channel, joint and contact numbers mean.
//! - [`health`]: state and counters of gateway and estimator.
//! - [`code`]: enumerations as they stand in shared memory: numbers that a reader checks.
//! - [`time`]: instants and durations as integer nanoseconds.
//! - `csv` (feature `csv`): the same samples as a text table.
//! - `ipc` (feature `ipc`): the ports: a domain in shared memory, writers and readers. `realtime`:
//!   scheduling of the threads that use them.
//!
//! Every type that crosses a process boundary is `repr(C)` and holds only integers and floating
//! point numbers, for which every pattern of bits is legal (`zerocopy::FromBytes` proves it). Its
//! size is asserted here at compile time. The version of its layout is part of its type name,
//! because the transport compares only names, sizes and alignments.
//!
//! # Conventions
//! Angles in rad, forces in N, torques in Nm, right-handed frames. *Absent is not zero*: a quantity
//! that a device does not report is NaN. Whether a missing sample is overdue is the reader's
//! [`Freshness`](ipc::Freshness). An estimate that must not be used is withheld: NaN, with `valid =
//! 0` and the reason.
#![no_std]
#[cfg(any(feature = "std", test))]
extern crate std;

pub mod budget;
pub mod code;
#[cfg(feature = "csv")]
pub mod csv;
pub mod description;
pub mod drive;
pub mod estimate;
pub mod health;
pub mod inertia;
#[cfg(feature = "ipc")]
pub mod ipc;
#[cfg(feature = "ipc")]
mod maps;
pub mod reading;
#[cfg(feature = "ipc")]
pub mod realtime;
pub mod sample;
pub mod sanity;
pub mod time;

pub use budget::{BudgetPart, Line, Source, TorqueBudget};
pub use code::{Code, Coded};
pub use description::{
    Description, Entry, Name, Publisher, ROBOT_NAME, Role, TRIGGER, is_robot_name,
};
pub use drive::{Agreement, Candidate, DriveEstimate, DriveTorque, NO_GROUP, NamedCandidate};
pub use estimate::{
    ContactDeclaration, ContactEstimate, ContactState, ContactWrench, JointTorque, NO_CAUSE,
    NO_CONTACT, Reason, Residual, TorqueEstimate,
};
pub use health::{
    BusError, BusHealth, Controller, Counter, DeviceHealth, DeviceState, EstimatorHealth,
    GatewayHealth, IdentificationHealth, InterfaceHealth, LinkState, Refusal, axes,
};
pub use inertia::{InertiaEstimate, LinkInertia, SensorOffset};
pub use reading::{
    Actuator, Gauges, Imu, JointState, Kind, Reading, Skin, Temperature, VALUES, Wrench,
};
pub use sample::{Header, Quality, Sample, Saturation, StampKind};
pub use time::Nanos;

/// Maximum number of channels of one gateway: all joints of an estimate, and as many others.
pub const MAX_CHANNELS: usize = 2 * MAX_JOINTS;
/// Maximum number of joints in one estimate: a humanoid with two hands has 75 to 120. A reader
/// copies 32 bytes for each, 4 KiB in all.
pub const MAX_JOINTS: usize = 128;
/// Maximum number of contacts in one estimate.
pub const MAX_CONTACTS: usize = 16;
/// Maximum number of links in one estimate of inertial parameters.
pub const MAX_LINKS: usize = 128;
/// Maximum number of F/T sensors whose offsets are in one estimate.
pub const MAX_SENSORS: usize = 32;
/// Maximum number of sub-trees (the parts of the robot between F/T sensors) in one estimate.
pub const MAX_SUBTREES: usize = MAX_SENSORS + 1;
/// Maximum number of buses of one gateway; also the maximum number of publishers of samples.
pub const MAX_BUSES: usize = 16;

/// The program in the book compiles.
#[cfg(all(doctest, feature = "ipc"))]
mod documents {
    #[doc = include_str!("../../../docs/book/src/read/rust.md")]
    struct Page;
}
