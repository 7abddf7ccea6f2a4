//! OptoForce (later OnRobot) three-axis force sensors at a DAQ unit with a CAN interface.
//!
//! The unit sends on one identifier, 100 (hexadecimal) if nobody has changed it, which is the
//! device's `address`. A packet has 16 bytes, big-endian, in two frames:
//!
//! | identifier | name | bytes | content |
//! |---|---|---|---|
//! | `address` | packet, first frame | 8 | `AA 07 08 0A`, counter u16, status u16 |
//! | `address` | packet, second frame | 8 | fx fy fz i16, checksum u16 |
//! | `address` | answer | 7 | `AA 00 50 01`, error u8, checksum u16 |
//!
//! - The sensor measures no torque: the torque of a reading is not a number.
//! - One step of force depends on the sensor: `counts_per_newton` comes from its sensitivity
//!   report.
//! - The checksum is the sum of all bytes before it. A packet whose checksum is wrong is dropped
//!   and counted as a bad value. The sum contains the counter, so frames of two packets do not fit
//!   together either (unless more than 250 packets lie between them).
//! - `counter` counts the packets. A reading with the counter of the one before has FROZEN.
//! - `status`: bits 9 to 4 overload of fx fy fz tx ty tz; 12 to 10 error of the sensor (1 not
//!   detected, 2 failure, 4 temperature); 15 to 13 error of the unit (1 unit, 2 communication);
//!   3 to 0 which sensor. Any error is DEVICE_FAULT. An overload has no sign: the saturated end is
//!   taken from the sign of the value.
//!
//! A configuration has 9 bytes, in two frames on `id_config`:
//!
//! | bytes | meaning |
//! |---|---|
//! | `AA 00 32 03` speed filter zero, checksum u16 | all three settings at once |
//!
//! - speed: the period in ms, 0 stops; filter: 0 none, 1 to 6 for 500, 150, 50, 15, 5, 1.5 Hz;
//!   zero: 255 takes the present load as the zero, 0 is the sensor's own zero.
//! - The unit sends by itself, 100 packets a second with a filter of 15 Hz, unless it was set
//!   otherwise. Without `rate_hz` this driver never transmits.
//! - **Each configuration changes the zero, to one or the other.** Readings from it to its answer,
//!   or for 0.1 s, and the first after that have ZERO_CHANGED.
//!
//! Sources: `optoforce_can.c` and `.h` (Felix Widmaier, for the BLMC boards of
//! open-dynamic-robot-initiative), `OptoforceSensor.cpp` (RCPRG-ros-pkg/optoforce_can 06cff09e),
//! `optoforce` 0.3.0 on PyPI, whose tests hold a recording of the unit's serial interface: packets
//! are the same there. Certain: the packet. Highly probable: the configuration (the first source
//! has its checksum in the other order; the other two, one of them tested, agree with this page).
//! Probable: the answer, which was recorded on the serial interface. Open: whether the
//! configuration's second frame has one byte (first source) or is filled with zeros (second
//! source), therefore `fill` is a key. Packets of other sensors (22 bytes with six axes, 34 with
//! four sensors) are not read.
//!
//! # Recognition
//! By its packets, on any identifier. Nothing is asked.
//!
//! # Keys
//! ```toml
//! counts_per_newton = [26.42, 28.80, 3.02]   # no default: from the sensor's sensitivity report
//! rate_hz = 100       # 10, 30, 100, 333 or 1000; if absent, nothing is configured
//! filter_hz = 15.0    # 1.5, 5, 15, 50, 150, 500 or 0, no filter; with rate_hz only
//! zero = false        # true: each start takes the load as the zero; with rate_hz only
//! fill = true         # whether the configuration's second frame has 8 bytes
//! id_config = 0x101
//! ```

mod board;
mod device;
mod options;
mod protocol;
mod recognise;

pub use board::OptoBoard;
pub use options::Options;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Opto;
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "optoforce_daq";
    const ADDRESS: Option<u32> = Some(0x100);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Wrench)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Opto::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(OptoBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        seen.streams()
            .filter_map(|stream| recognise::unit(seen, stream))
            .collect()
    }
}
