#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]
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

/// The first `count` of `entries`.
fn valid<E>(entries: &[E], count: u32) -> &[E] {
    entries.get(..count as usize).unwrap_or(entries)
}

/// The program in the book compiles.
#[cfg(all(doctest, feature = "ipc"))]
mod documents {
    #[doc = include_str!("../../../docs/book/src/read/rust.md")]
    struct Page;
}
