//! CAN frames to SI readings and back: one file per device family, without input or output, without a clock, `no_std`.
//!
//! | driver | devices | reading |
//! |---|---|---|
//! | [`icub_strain`] | iCub F/T boards strain, strain2, strain2c | wrench, gauges, temperature |
//! | [`icub_imu`] | the IMU of strain2, strain2c, mtb4, mtb4c, rfe; legacy gyroscope and accelerometer frames | imu |
//! | [`icub_motor`] | 2FOC and its successors amcbldc, amc2c, amcfoc | joint, actuator |
//! | [`icub_pos`] | POS encoders: psc, mtb4fap | joint |
//!
//! Each family has two sides. A [`Device`] is the host's side: it takes the frames of its identifiers, yields readings,
//! and brings its board up. A [`Board`] is the board's own side: it answers commands and encodes readings; the simulator
//! and `proprio encode` are built on it, and so are the round-trip tests.
//!
//! To add a family: write one file with an `Options` type (its keys in gateway.toml, documented at its top), a `Device`
//! and a `Board`, and add it to [`Options`] in `registry.rs`; the compiler names the places that remain.
#![no_std]
extern crate alloc;
#[cfg(test)]
extern crate std;

pub mod device;
pub mod frame;
pub mod icub;
pub mod icub_imu;
pub mod icub_motor;
pub mod icub_pos;
pub mod icub_strain;
mod registry;

pub use device::{
    Board, Claim, Decoded, Device, EncodeError, Fault, Frames, Mode, Output, Outputs, Refusal, Spec, SpecError, State,
    Transmit,
};
pub use frame::{Format, Frame, Id};
pub use registry::{DRIVERS, Options, OptionsError};
