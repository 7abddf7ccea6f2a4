//! Aceinna (Memsic) inertial sensors OpenIMU300RI and OpenIMU335RI and tilt sensors MTLT305D and
//! MTLT335D, which speak SAE J1939.
//!
//! Identifiers have 29 bits: `priority << 26 | PGN << 8 | address`. The address is the J1939 source
//! address of the sensor, 0x80 to 0xF7, 0x80 as delivered. Its messages, little-endian, unsigned
//! with an offset:
//!
//! | PGN | name | bytes | content |
//! |---|---|---|---|
//! | `F029` | SSI2, slope | 8 | pitch, roll u24 (2^-15 deg, - 250 deg); merits; latency |
//! | `F02D` | acceleration | 8 | y x z u16 (0.01 m/s^2, - 320 m/s^2); merits; unused |
//! | `F02A` | ARI, angular rate | 8 | y x z u16 (2^-7 deg/s, - 250 deg/s); merits; latency |
//!
//! - They are sent in this order in each period, without a number or a time: those of `quantities`
//!   are combined by their order and time (`group.rs`). Others are ignored.
//! - Readings are in the axes of the sensor's angles and rates: x forward, y right, z down. At rest
//!   and level the acceleration is (0, 0, -9.81) m/s^2. The acceleration comes with y left and z up
//!   as delivered: the driver turns it into the same axes, by the key `acceleration_z`.
//! - Orientation is that of pitch and roll, in a world with z up; its heading is not measured and
//!   taken as 0. A level sensor has the quaternion (0, 1, 0, 0).
//! - A merit (2 bits a value, from the lowest; in SSI2 pitch in bits 2 and 3, roll in 6 and 7) of 2
//!   means an error: DEVICE_FAULT. 1 means less accuracy, 3 not known (OpenIMU300RI sends only
//!   that). The sensor limits a rate to 250 deg/s either way: an axis at its limit, 3 to 5, is
//!   saturated, whatever its merit.
//! - A value above `FAFF` (`FAFFFF` of an angle) is none by J1939: an error, or not available. Its
//!   message is dropped (counted as a wrong value), and so the reading.
//!
//! Commands, priority 6, to the sensor that the first byte names; none is answered:
//!
//! | PGN | bytes | meaning |
//! |---|---|---|
//! | `FF56` | address, bits: 0 SSI2, 1 ARI, 2 acceleration; `00 00 00` | messages to send |
//! | `FF55` | address, divider of 100 Hz | rate; 0: quiet |
//!
//! OpenIMU335RI reads the zeros, whether they are sent or not: further messages, and priorities to
//! change (none). The others read two bytes.
//!
//! Both are sent at start, and divider 0 at stop; they last until the sensor is reset, because
//! nothing is saved. Until then it sends what it was configured for, all three at 100 Hz as
//! delivered. Their PGNs can be changed in the sensor, and its address as well, if another node
//! claims the same: then this driver does not reach it.
//!
//! Uncertain: the order of the axes. The firmware exchanges x and y as delivered (a bit of its user
//! behaviour), and J1939 says pitch, roll, yaw; the manual and `python-mtlt` say x, y, z, which
//! holds for a sensor without that bit: the key `axes`. Of the MTLT, the order of messages and the
//! limits are taken from the others, whose firmware is public. The rest is certain. OpenIMU300RI
//! cuts values off instead of rounding: they are half a step low, 0.005 m/s^2 and 0.004 deg/s, in
//! the mean.
//!
//! Sources: `UserMessagingCAN.c` (Aceinna/platform-aceinna_imu 03639473), `CANMessaging.c` and
//! `sae_j1939_process.c` (Aceinna/openIMU335RI-lib 487c4fcf), `taskCANcommunicationJ1939.c`
//! (Aceinna/openIMU300-lib 1182d149), `j1939.rst` 1.3.4 (Aceinna/can_j1939_doc f24e0e6c),
//! `CAN_MTLT.py` (Aceinna/python-mtlt 1b99f92e), `Imu.hpp` (leggedrobotics/tcan ed86f6c6).
//!
//! # Recognition
//! By two of its messages from one address; other makers' J1939 sensors may send the same. Nothing
//! is asked.
//!
//! # Keys
//! ```toml
//! quantities = ["acceleration", "angular_velocity"]   # also "orientation"
//! period_ms = 10          # 10, 20, 40, 50, 100, 200, 250 or 500
//! axes = "yxz"            # order of acceleration and angular rate: "yxz" or "xyz"
//! acceleration_z = "up"   # axes of the acceleration: "up" (y left, z up) or "down" (y right)
//! ```

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::OpenImuBoard;
pub use frames::{Axes, Quantity, Upright};
pub use options::Options;

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Sensor;
use frames::{ADDRESSES, DELIVERED};
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "openimu";
    const ADDRESS: Option<u32> = Some(DELIVERED);

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Imu)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Sensor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(OpenImuBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        ADDRESSES
            .filter_map(|address| recognise::sensor(seen, address))
            .collect()
    }
}
