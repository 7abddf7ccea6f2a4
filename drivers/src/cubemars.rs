//! CubeMars (T-Motor) actuators of the AK series, in MIT mode or servo mode.
//!
//! The address is the motor's number, 0 to 254, nn below in hexadecimal digits. Big-endian.
//!
//! | mode | identifier | bytes | content |
//! |---|---|---|---|
//! | MIT | `host_id`, 11 bits | 6 | number u8, position u16, velocity u12, torque u12 |
//! | MIT | `host_id`, 11 bits | 8 | the same, temperature u8, error u8 |
//! | servo | `29nn`, 29 bits | 8 | position, speed, current i16, temperature i8, error u8 |
//!
//! - MIT mode: raw 0 is the lower end of a range, the largest raw value its upper end; ranges are
//!   symmetric. A value at an end is SATURATED: the position does not go on beyond its range. The
//!   motor only replies to commands, which another program sends to its number as an identifier.
//! - Servo mode: steps of 0.1 deg, 10 electrical revolutions per minute, 0.01 A; SATURATED from
//!   32000, 32000, 6000 steps on. Uploaded 1 to 500 times a second, as configured in the motor.
//!   Boards of version 3 (AK60-6 V3.0 and others) send this also when commanded in the MIT way.
//! - Position, velocity and torque are those of the output shaft.
//! - Temperature (of the power stage) and error come once a second, and when the error changes. The
//!   temperature's channel is `<device>_drive`; `faults` of the actuator reading is the error.
//!
//! | error | meaning | effect on a joint reading |
//! |---|---|---|
//! | 5 | encoder | DEVICE_FAULT |
//! | 1, 2 | over-temperature, over-current | DRIVE_FAULT |
//! | 3, 4 | over-voltage, under-voltage | DRIVE_FAULT |
//! | 6 | phases; on boards of version 3 MOSFET over-temperature | DRIVE_FAULT |
//! | 7, others | stall; not known | DRIVE_FAULT |
//!
//! Several motors share `host_id`: each device takes the replies with its number. A motor whose
//! firmware replies with its own number as identifier has that as `host_id`. A command then has the
//! same identifier, and is taken for a reply if its first byte, the upper half of a position, is
//! the number: keep numbers far below 128, the byte near position zero.
//!
//! The driver never transmits; another program commands the motors.
//!
//! | model | velocity \[rad/s\] | torque \[Nm\] | pole pairs | gear ratio |
//! |---|---|---|---|---|
//! | AK10-9 | 50 | 65 | 21 | 9 |
//! | AK60-6 | 45 | 15 | 14 | 6 |
//! | AK70-10 | 50 | 25 | 21 | 10 |
//! | AK80-6 | 76 | 12 | 21 | 6 |
//! | AK80-8 | 37.5 | 32 | 21 | 8 |
//! | AK80-9 | 50 | 18 | 21 | 9 |
//! | AK80-64 | 8 | 144 | 21 | 64 |
//!
//! **A wrong range gives wrong values that look right**: compare one known motion. Ranges depend on
//! the firmware: an AK80-9 may have 22.5 or 25.64 rad/s, an AK60-6 50 rad/s, an AK80-6 V1 95.5 rad,
//! 45 rad/s and 18 Nm (V1.1: 12.5 rad, 22.5 rad/s, 12 Nm).
//!
//! Sources: CubeMars "AK Series Actuator Driver Manual" V1.0.8, pages 39, 40 and 49; the table of
//! ranges of later editions in KMR_CubeMars 2b6fd024 and cubemars-ak-c-drivers 2b0343a1 (highly
//! probable); `TMotorCANControl` 1.2.6, `epicallypowerful` 1.0.7 (pole pairs and gear ratios),
//! `motor-python` 0.0.11. Layouts and errors are certain.
//! Sources differ in what these keys choose:
//!
//! - The third value of MIT mode is a current in the manual's words, with a range in Nm: `effort`.
//! - The temperature in MIT mode is the byte minus 40 in later editions, the byte in older
//!   programs: `celsius_at_zero`.
//! - Servo positions are degrees of the output shaft (manual, three programs); two programs take
//!   them for electrical degrees: `angle`.
//! - The identifier of replies is "0x00 + drive ID" in the manual, 0 in the MIT's own program:
//!   `host_id`.
//!
//! # Recognition
//! By uploads in servo mode, and by replies in MIT mode on identifier 0 or the motor's own number,
//! while another program commands it. Nothing is asked: each question would be a command.
//!
//! # Keys
//! ```toml
//! mode = "mit"            # "mit" or "servo"
//! model = "AK80-9"        # default: none; all keys marked * must be given then
//! host_id = 0             # identifier of the replies, 0 to 2047 (MIT)
//! position_max = 12.5     # end of the range [rad] (MIT)
//! velocity_max = 50.0     # * [rad/s] (MIT)
//! effort_max = 18.0       # * [Nm or A] (MIT)
//! effort = "torque"       # "torque" or "current": the third value (MIT)
//! celsius_at_zero = -40.0 # temperature of byte 0 (MIT)
//! pole_pairs = 21         # * (servo)
//! gear_ratio = 9.0        # * (servo)
//! angle = "output"        # "output" or "electrical": the degrees of the position (servo)
//! torque_constant = 1.0   # torque of the output shaft per current [Nm/A]; default: torque is
//!                         # absent where the motor sends a current
//! period_ms = 2           # 1 to 60000; set by its commander; used by the simulated motor
//! ```

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::CubemarsBoard;
pub use options::{Angle, Effort, Mode, Model, Options};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Motor;
use frames::{DRIVE, JOINT};
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "cubemars";

    fn outputs(&self) -> Vec<OutputInfo> {
        let drive = OutputInfo::temperature(DRIVE, "drive");
        [OutputInfo::new(JOINT, Kind::Joint), drive].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Motor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(CubemarsBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::motors(seen)
    }
}
