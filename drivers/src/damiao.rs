//! Damiao (DM) actuators, as in OpenArm and many robots of LeRobot: position, velocity and torque
//! of the output shaft.
//!
//! The address is the motor's CAN ID (register 8), 1 to 255. A motor sends nothing by itself: it
//! answers each command, in all its modes (MIT, position, velocity, force), with the same frame on
//! its Master ID (register 7), the key `host_id`. Standard identifiers, 8 bytes, classic CAN or
//! CAN FD.
//!
//! | identifier | from | content |
//! |---|---|---|
//! | `host_id` | motor | ID, state u4, position u16, velocity u12, torque u12, temperatures |
//! | `host_id` | motor | ID u16, `33`, register, value: an answer; `55`, `AA`: to other requests |
//! | `7FF` | host | ID u16, `CC`, 0: asks for the first of these frames |
//! | `7FF` | host | ID u16, `33`, register, 0: asks for a register |
//!
//! - The first byte is the state << 4 | the low half of the ID. ID and values of registers are
//!   little-endian, the rest is big-endian. Raw 0 is the lower end of a range, the largest raw
//!   value its upper end; ranges are symmetric. A value at an end is SATURATED.
//! - Motors may share a `host_id`, if the low halves of their IDs differ: each device takes the
//!   frames with its own.
//! - The temperatures, u8 in degrees Celsius, are those of the power stage and of the rotor, with
//!   channels of their own: `<device>_fet`, `<device>_motor`. They and the state are told once a
//!   second, and when the state changes. `mode` of the actuator reading is 1 if the motor is
//!   enabled, `faults` is the state from 2 on:
//!
//! | state | meaning | effect on a joint reading |
//! |---|---|---|
//! | 0, 1 | disabled, enabled | none |
//! | 5 | sensor | DEVICE_FAULT |
//! | 8, 9, A | over-voltage, under-voltage, over-current | DRIVE_FAULT |
//! | B, C | power stage too hot, rotor too hot | DRIVE_FAULT |
//! | D, E | no commands for longer than register 9 allows, overload | DRIVE_FAULT |
//! | others | (6: a parameter); not known | DRIVE_FAULT |
//!
//! # What is sent
//! Without `request_period_ms` nothing: another program commands the motors, and its answers are
//! read. With it, the driver asks for the state that often; the motor needs not be enabled for
//! that. It never sends anything else than the two frames of the table on `7FF`, with `CC`, and
//! with `33` and the registers 21, 22 and 23: none enables, disables, moves or configures a
//! motor. Not known is whether a question counts as a command for the time-out of register 9: where
//! a program commands the motors as well, do not rely on that time-out.
//!
//! # Ranges
//! A range is that of its key if one is given, else the one that the motor itself tells (registers
//! 21, 22, 23, asked at each start if `request_period_ms` is given, or by another program), else
//! the model's. Without any, the motor's frames count as unexpected until it has told. **A wrong
//! range gives wrong values that look right.** The ranges can be set in the motor; a DM3507 has 50
//! rad/s and 5 Nm or 30 and 10, a DM4340 has 8 or 10 rad/s, as its firmware was made.
//!
//! | model | velocity \[rad/s\] | torque \[Nm\] |
//! |---|---|---|
//! | DM4310 | 30 | 10 |
//! | DM4310_48V | 50 | 10 |
//! | DM4340 | 8 | 28 |
//! | DM4340_48V | 10 | 28 |
//! | DM6006 | 45 | 20 |
//! | DM8006 | 45 | 40 |
//! | DM8009 | 45 | 54 |
//! | DM10010L | 25 | 200 |
//! | DM10010 | 20 | 200 |
//! | DMH3510 | 280 | 1 |
//! | DMH6215 | 45 | 10 |
//! | DMG6220 | 45 | 10 |
//!
//! The position's range is 12.5 rad in all, about two turns to each side. What a motor sends beyond
//! it is not known: if it goes on at the other end, `wraps_rad` (docs/joints.md) counts on.
//!
//! Sources: `openarm_can` 98666042 (enactic), LeRobot 7427f318, `damiao-motor` 1.0.6, `pydamiao`
//! 0.1.4, edometro/DAMIAO_Control_Arduino (states 5 and 6); default ranges of Seeed's wiki on
//! Damiao motors. Layouts and states are certain, but for states 5 and 6 (highly probable); the
//! ranges of the models are highly probable.
//!
//! A frame of a disabled motor whose position is the raw value `0033`, `0055` or `00AA`, hundredths
//! of a radian from the lower end, looks like an answer about a register, and is taken for one.
//!
//! # Recognition
//! By its frames: state, temperatures, and a position that goes on as the velocity says; and by
//! commands or questions that they answer. A scan that asks sends the questions `CC` and `33` for
//! register 21 to the motors 1 to 32, classic frames.
//!
//! # Keys
//! ```toml
//! model = "DM4310"        # default: none
//! host_id = 0             # the motor's Master ID: identifier of its frames, 0 to 0x7FE
//! position_max = 12.5     # end of the range [rad]
//! velocity_max = 30.0     # [rad/s]
//! torque_max = 10.0       # [Nm]
//! request_period_ms = 5   # ask for the state, 1 to 60000; default: do not
//! fd = false              # ask by CAN FD frames, as a motor at more than 1 Mbit/s needs it
//! period_ms = 5           # 1 to 60000; set by its commander; used by the simulated motor
//! ```

mod board;
mod device;
mod frames;
mod options;
mod ranges;
mod recognise;

pub use board::DamiaoBoard;
pub use options::{Model, Options};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Motor;
use frames::{FET, JOINT, MOTOR};
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "damiao";

    fn needs_fd(&self) -> bool {
        self.fd
    }

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Motor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(DamiaoBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::motors(seen)
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }
}
