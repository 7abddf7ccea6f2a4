//! Xsens (Movella) MTi-600, Avior and Sirius inertial sensors on CAN.
//!
//! Messages, big-endian, with the identifiers that they are delivered with:
//!
//! | identifier | name | bytes | content |
//! |---|---|---|---|
//! | `001` | Error | 1 | u8; 1: the output buffer was full, and a message was dropped |
//! | `005` | SampleTime | 4 | u32, time of the sample in the sensor's own clock |
//! | `006` | GroupCounter | 2 | u16, goes up by one with each sample |
//! | `011` | StatusWord | 4 | u32, see below |
//! | `021` | Quaternion | 8 | w x y z i16, in 1/32767: orientation, world from sensor |
//! | `032` | RateOfTurn | 6 | x y z i16, in 2^-9 rad/s |
//! | `034` | Acceleration | 6 | x y z i16, in 2^-8 m/s^2, gravity included |
//! | `041` | MagneticField | 6 | x y z i16, in 2^-10 of the field at the calibration |
//! | `061` | RateOfTurnHR | 6 | as RateOfTurn, at a high rate |
//! | `062` | AccelerationHR | 6 | as Acceleration, at a high rate |
//!
//! - The messages of a sample come in the order of their identifiers. The first of `quantities`
//!   opens a sample, and a reading is complete when the others have come, each within half a period
//!   after the one before (`group.rs`). An incomplete sample is dropped and counted as unpaired. If
//!   it had begun, so is the next one, because the missing message may only be late.
//! - All of `quantities` must be sent at the same rate. With SampleTime or GroupCounter among them
//!   a sample is opened by a message without a measurement, as the ROS driver expects it.
//! - SampleTime gives the device's time of a reading; it goes on when the 32 bits overflow.
//!   GroupCounter gives its device counter: a gap is counted as lost.
//! - With StatusWord a reading has the sensor's own opinion of the sample:
//!
//! | bit | meaning | effect |
//! |---|---|---|
//! | 0 | self-test passed | if not: DEVICE_FAULT |
//! | 1 | orientation filter valid | if not: DEVICE_FAULT, with orientation in `quantities` |
//! | 8, 9, 10 | accelerometer clipped x, y, z | saturation of axis 0, 1, 2 |
//! | 11, 12, 13 | gyroscope clipped x, y, z | saturation of axis 3, 4, 5 |
//! | 14, 15, 16 | magnetometer clipped x, y, z | SATURATED |
//! | 19 | clipping of any kind | SATURATED, if no axis is named |
//!
//!   Only sensors in use count. Which end of its range an axis is at is the sign of its value.
//! - An Error message means lost data: the next reading has GAP_BEFORE.
//!
//! Nothing is sent to the sensor: its messages, their identifiers and rates are set over its serial
//! port (delivered without any message on CAN, 250 kbit/s). `address` is added to all identifiers:
//! a second sensor on the bus may be set to the same ones plus a number. Other messages (Euler
//! angles, increments, pressure, GNSS) are ignored; the driver `dbc` reads them.
//!
//! Uncertain, each with a key: the unit of SampleTime (1 us by MT1604P and the .dbc file, 100 us by
//! today's manual and the ROS driver, which uses it), the step of the quaternion (1/32767 by manual
//! and driver, 2^-15 by the .dbc file), the order of the HR messages (a copy of MT1604P has them
//! swapped). Whether messages with changed identifiers are still sent in ascending order is not
//! documented. The rest is certain.
//!
//! Sources: document MT1604P rev. A (16 Sept 2019), mtidocs.movella.com/canmessages, `xsens.dbc`
//! and `xsens_parser.cpp` of jiminghe/Xsens_MTi_CAN_ROS_Driver e305ce34.
//!
//! # Recognition
//! By the messages and lengths of delivery, with 11 or 29 bits. Nothing is asked.
//!
//! # Keys
//! ```toml
//! quantities = ["sample_time", "angular_velocity", "acceleration"]
//!                           # also "group_counter", "status", "orientation", "magnetic_field"
//! period_ms = 10.0          # of the samples, as set in the sensor: 0.5 to 1000
//! sample_time_unit_us = 100 # 100 or 1
//! quaternion_one = 32767    # the count that means 1: 32767 or 32768
//! high_rate = "none"        # "rate_first" (rate 061, acceleration 062) or "acceleration_first":
//!                           # the HR messages in place of the others
//! extended = false          # whether identifiers have 29 bits
//! magnetic_unit = 50e-6     # field at the calibration [T], for "magnetic_field"; no default
//! # Identifiers that were changed in the sensor, by the names of quantities; also `error`.
//! identifiers = { acceleration = 0x034 }
//! ```

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::MtiBoard;
pub use frames::{HighRate, Message};
pub use options::Options;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Mti;
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "xsens_mti";
    const ADDRESS: Option<u32> = Some(0);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Mti::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MtiBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let found = [false, true].map(|extended| recognise::sensor(seen, extended));
        found.into_iter().flatten().collect()
    }
}
