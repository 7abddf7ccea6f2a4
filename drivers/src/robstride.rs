//! RobStride actuators RS00 to RS06 and EL05, and Xiaomi's CyberGear: position, velocity and torque
//! of the output shaft.
//!
//! The address is the motor's CAN ID, 1 to 253 (as delivered 127). A motor answers each command on
//! the bus; it sends by itself only if its active report was turned on.
//!
//! # Private protocol
//! Extended identifiers: type (5 bits) << 24 | data (16 bits) << 8 | destination. The data are two
//! bytes; from the motor the lower is its address, and the destination is the host, `host_id`.
//!
//! | type | from | upper byte | content |
//! |---|---|---|---|
//! | 02, 18 | motor | mode << 6, faults | position, velocity, torque u16, temperature u16 |
//! | 15 | motor | | faults u32, warnings u32 |
//! | 11 | motor | 0: read | parameter u16, 0, value f32: an answer |
//! | 11 | host | 0 | parameter u16, 0: a question |
//!
//! The temperature is in 0.1 deg. Values of 02 (and 18, the active report) are big-endian, the
//! others little-endian. Raw 0 is the lower end of a range, 65535 its upper end; a value at an end
//! is SATURATED. Positions go on at the other end of their range, four turns away, in newer
//! firmware: `wraps_rad = [-12.566370614359172, 12.566370614359172]` (docs/joints.md).
//!
//! # MIT protocol
//! With `protocol = "mit"`, as LeRobot sets these motors: standard identifiers, frames of 8 bytes
//! on `host_id`: address u8, position u16, velocity u12, torque u12, temperature u16 \[0.1 deg\].
//! One whose last three bytes are 0 is an answer about faults (u32, little-endian, after the
//! address). Motors may share a `host_id`.
//!
//! # State
//! Temperature and faults are told once a second, and when the faults or the mode change. The
//! temperature's channel is `<device>_motor`; `mode` of the actuator reading is 0 reset, 1
//! calibration, 2 running. `faults`: bits 0 to 16 are those of a frame 15 (or of the MIT protocol),
//! bits 24 to 29 the six of a frame 02. A frame 15 holds until the next one, or until the motor
//! runs without faults.
//!
//! | bits | meaning | effect on a joint reading |
//! |---|---|---|
//! | 7, 29 | encoder not calibrated | DEVICE_FAULT |
//! | 27; 28 of a CyberGear | magnetic encoder; Hall encoder | DEVICE_FAULT |
//! | 9, but of a CyberGear | position not initialised | DEVICE_FAULT |
//! | others | voltage, current, temperature, driver, stall, overload | DRIVE_FAULT |
//!
//! # What is sent
//! Without `request_period_ms` nothing: another program commands the motors, or has turned their
//! active report on. With it, the driver reads the parameters 701B, 701A and 7019 that often:
//! velocity, current, position, of which the last counts its turns. It never sends anything but
//! these questions (type 11): none enables, stops, moves or configures a motor. Then the position
//! comes from these answers alone, and frames 02 give the state. Not known is whether a question
//! counts as a command for the motor's time-out (7028).
//!
//! | model | velocity \[rad/s\]: private, MIT | torque \[Nm\] |
//! |---|---|---|
//! | RS00 | 33, 33 | 14 |
//! | RS01 | 44, 44 | 17 |
//! | RS02 | 44, 33 | 17 |
//! | RS03 | 20, 33 | 60 |
//! | RS04 | 15, 33 | 120 |
//! | RS05 | 50, 50 | 5.5 |
//! | RS06 | 50, 50 | 36 |
//! | EL05 | 50, 50 | 6 |
//! | CyberGear | 30, 30 | 12 |
//!
//! **A wrong range gives wrong values that look right.** Other programs have other numbers (the
//! maker's `robstride_dynamics` 50 rad/s and 17 Nm for an RS00, 50 rad/s for an RS03, 33 rad/s and
//! 17 Nm for an RS05; LeRobot 20 Nm for an RS02): compare one known motion, and state
//! `velocity_max` and `torque_max` where they differ. The position's range is 4 pi; programs for
//! CyberGears have 12.5 for it.
//!
//! Sources: the maker's user manuals of 2026-04-28 (RobStride/Product_Information), sections 3.3.7,
//! 4.1, 4.2 and 6; `robstride` 0.1.0, `robstride-dynamics` 0.0.1, `python-cybergear` 0.1.2,
//! `CyberGearDriver` 0.2.0; LeRobot 7427f318. Layouts are certain. Highly probable: the ranges, and
//! the frame about faults of the MIT protocol.
//!
//! # Recognition
//! By frames 02 and 18, and by answers. A scan asks for the number of each motor (type 00, host FD)
//! only if `--ask robstride` is given: on the identifier of a moteus controller's commands.
//!
//! # Keys
//! ```toml
//! model = "RS03"          # default: none; the keys marked * must be given then
//! protocol = "private"    # "private" or "mit"
//! host_id = 0xFD          # the host to which the motor answers, 0 to 255
//! position_max = 12.566370614359172  # end of the range [rad]
//! velocity_max = 20.0     # * [rad/s]
//! torque_max = 60.0       # * [Nm]
//! request_period_ms = 10  # read the parameters, 1 to 60000; default: do not
//! torque_constant = 1.0   # torque of the output shaft per current [Nm/A], for parameters;
//!                         # default: torque is absent
//! period_ms = 10          # 1 to 60000; set by its commander; used by the simulated motor
//! ```

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::RobstrideBoard;
pub use options::{Model, Options, Protocol};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Motor;
use frames::{JOINT, MOTOR};
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "robstride";
    const ASKED_BY_NAME: bool = true;

    fn outputs(&self) -> Vec<OutputInfo> {
        let motor = OutputInfo::temperature(MOTOR, "motor");
        [OutputInfo::new(JOINT, Kind::Joint), motor].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Motor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(RobstrideBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::motors(seen)
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }
}
