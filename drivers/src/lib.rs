//! Converts CAN frames to SI readings and back. One module per device family; no input or output,
//! no clock, `no_std`.
//!
//! | driver | devices | reading |
//! |---|---|---|
//! | [`icub_strain`] | iCub F/T boards strain, strain2, strain2c | wrench, gauges, temperature |
//! | [`icub_imu`] | IMU of strain2, strain2c, mtb4, mtb4c, rfe; legacy frames of mtb | imu |
//! | [`icub_motor`] | 2FOC and its successors amcbldc, amc2c, amcfoc | joint, actuator |
//! | [`icub_mc4`] | older iCub motor boards: mc4, bll | joint, actuator |
//! | [`icub_pos`] | POS encoders: psc, mtb4fap | joint |
//! | [`icub_mais`] | MAIS: Hall sensors of hands | joint |
//! | [`icub_skin`] | skin of mtb, mtb4, mtb4c | skin |
//! | [`ati_netcanoem`] | ATI F/T sensors with the NETCANOEM board | wrench |
//! | [`canopen_drive`] | CANopen drives (CiA 402) | joint, actuator |
//! | [`canopen_encoder`] | CANopen encoders (CiA 406) | joint |
//! | [`canopen_sync`] | sends a CANopen bus its SYNC | none |
//! | [`moteus`] | moteus controllers (CAN FD) | joint, actuator, temperature |
//! | [`odrive`] | ODrive motor controllers | joint, actuator, temperature |
//! | [`cubemars`] | CubeMars AK actuators | joint, actuator, temperature |
//! | [`damiao`] | Damiao actuators | joint, actuator, temperature |
//! | [`myactuator`] | MyActuator RMD and LKMTech motors | joint, actuator, temperature |
//! | [`robstride`] | RobStride actuators, CyberGear | joint, actuator, temperature |
//! | [`vesc`] | VESC motor controllers | joint, actuator, temperature |
//! | [`xsens_mti`] | Xsens MTi-600, Avior, Sirius | imu |
//! | [`openimu`] | Aceinna OpenIMU300RI, OpenIMU335RI, MTLT | imu |
//! | [`robotous_rft`] | Robotous RFT force/torque sensors | wrench |
//! | [`aidin_aft200`] | AIDIN AFT200-D80-C force/torque sensors | wrench |
//! | [`jr3_can`] | JR3 force/torque sensors at UC3M's CAN boards | wrench |
//! | [`optoforce_daq`] | OptoForce three-axis force sensors at a DAQ unit | wrench without torque |
//! | [`dbc`] | any device that a .dbc file describes | any |
//!
//! Each family has two sides. A [`Device`] is the host's side: it decodes the frames of its
//! identifiers into readings and starts its board. A [`Board`] is the board's own side: it answers
//! commands and encodes readings. The simulator, `proprio encode` and the round-trip tests use it.
//!
//! [`recognise()`] tells which devices a bus has, and [`questions()`] what to ask them: each family
//! knows its own.
//!
//! Boards are behind the feature `boards`, recognition behind `recognise`. Both are on by default;
//! a program that only decodes needs neither.
//!
//! To add a family, write a module with a type of its keys in gateway.toml (documented at the top
//! of the module) that implements [`Driver`], [`Simulate`] and [`Recognise`], a `Family` (see
//! `family.rs`) and a `Board`, and add its line to the list in `registry.rs`. Families share
//! `bringup.rs` (starting a board), `configure.rs` (confirming its configuration), `pairing.rs` and
//! `group.rs` (combining two frames, or more), `held.rs` (values of other instants), `bytes.rs`
//! (the numbers of a payload), `wrench.rs` and [`calibration`] (force/torque sensors), `keys.rs`
//! (addresses, identifiers), `board.rs` (what a board can encode) and [`mod@recognise`] (the
//! evidence for a device in the traffic of a bus).
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
    Driver, Fault, Mode, NotSent, Output, OutputInfo, Outputs, Spec, SpecError, State, Transmit,
};
pub use frame::{Format, Frame, Id};
#[cfg(feature = "recognise")]
pub use recognise::{Certainty, Finding, Recognise, Traffic};
pub use registry::{DRIVERS, Options, OptionsError};
#[cfg(feature = "recognise")]
pub use registry::{asked_by_name, questions, recognise};
