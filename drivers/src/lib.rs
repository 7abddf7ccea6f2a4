#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]
#![no_std]
// Without a feature, what only its modules use is not used.
#![cfg_attr(
    not(all(feature = "boards", feature = "recognise")),
    allow(dead_code, unused_imports)
)]
extern crate alloc;
#[cfg(test)]
extern crate std;

pub mod aidin_aft200;
pub mod ati_netcanoem;
#[cfg(feature = "boards")]
pub mod board;
mod bringup;
mod bytes;
pub mod calibration;
mod canopen;
pub mod canopen_drive;
pub mod canopen_encoder;
pub mod canopen_sync;
mod configure;
pub mod cubemars;
pub mod damiao;
pub mod dbc;
pub mod device;
mod family;
pub mod frame;
mod group;
mod held;
pub mod icub;
pub mod icub_imu;
pub mod icub_mais;
pub mod icub_mc4;
pub mod icub_motor;
pub mod icub_pos;
pub mod icub_skin;
pub mod icub_strain;
pub mod jr3_can;
mod keys;
mod mit;
pub mod moteus;
pub mod myactuator;
pub mod objects;
pub mod odrive;
pub mod openimu;
pub mod optoforce_daq;
mod pairing;
mod received;
#[cfg(feature = "recognise")]
pub mod recognise;
mod registry;
pub mod robotous_rft;
pub mod robstride;
#[cfg(test)]
#[path = "../../tests/schema.rs"]
mod schema;
pub mod signal;
mod unit;
pub mod vesc;
mod wrench;
pub mod xsens_mti;

#[cfg(feature = "boards")]
pub use board::{Board, EncodeError, Frames, Simulate};
pub use calibration::Calibration;
pub use device::{
    COMMAND_TIME, Claim, Command, CommandFailed, CommandOutcome, CommandRefused, Decoded, Device,
    Driver, Fault, Mode, NotSent, OutputInfo, Outputs, Spec, SpecError, StampedReading, State,
    Transmit,
};
pub use frame::{Format, Frame, Id};
#[cfg(feature = "recognise")]
pub use recognise::{Certainty, Finding, Recognise, Traffic};
pub use registry::{DRIVERS, Options, OptionsError};
#[cfg(feature = "recognise")]
pub use registry::{asked_by_name, questions, recognise};
