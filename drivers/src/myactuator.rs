//! MyActuator RMD actuators with protocol V3 or V4, and those with V2, as LKMTech's motors have it.
//!
//! The address is the motor's ID, 1 to 32. A motor answers commands and sends nothing by itself. 8
//! bytes, standard identifiers, little-endian; the first byte is the command, of the answer too.
//!
//! | identifier | from | command | content |
//! |---|---|---|---|
//! | `140` + ID | host | | commands, of which `9A`, `9C` and `92` only ask |
//! | `240` + ID (V2: `140` + ID) | motor | 9C, A1 to A9 | temperature i8, current, speed, place |
//! | the same | motor | 92 | angle \[0.01 deg\]: bytes 4 to 7 (V2: 1 to 7), signed |
//! | the same | motor | 9A | temperature i8; errors: bytes 6 and 7 (V2: 7) |
//! | `500` + ID | motor | | V4: ID u8, position u16, velocity u12, torque u12 (big-endian) |
//!
//! - Speed i16 \[deg/s\]. V3: current i16 \[0.01 A\], place i16 \[deg\]. V2: current i16 \[its
//!   steps depend on the model: `ampere_per_step`\], place u16 of an encoder with `encoder_bits`,
//!   which begins anew each turn. A value at an end of its range is SATURATED.
//! - `position` chooses what is a reading of the joint: an `angle` (92), which counts turns and is
//!   fine; the place in a `status` (9C and answers to commands), which is coarse in V3 and within a
//!   turn in V2 (`wraps_rad`, docs/joints.md); or a frame of the `motion` mode. Speed and current
//!   join the angles that follow within `hold_ms`.
//! - V3 measures the output shaft. V2 measures the motor's in most models: `gear_ratio` then
//!   divides angle, place and speed.
//! - The temperature, once a second, has a channel of its own, `<device>_motor`.
//! - Errors are told when they change, and once a second. In V3 `2000`, the encoder's calibration,
//!   is DEVICE_FAULT; any other, in V2 all, DRIVE_FAULT.
//!
//! In V2 commands and answers have one identifier. What cannot be an answer is taken for a command:
//! zeros alone, and A1 to A9 with a temperature of 0 or 1. (An angle of exactly 0 is such a frame:
//! a device that asks itself takes it, one that listens misses it.)
//!
//! # What is sent
//! Without `request_period_ms` nothing: the answers to another program are read. With it, the
//! driver asks that often for `9C`, and for `92` if `position = "angle"`, and once a second for
//! `9A`, with seven zeros each: none of them enables, stops, moves or configures a motor, and it
//! never sends anything else. Whether a question feeds the motor's watchdog (`B3`) is not known.
//!
//! Sources: 2b-t/myactuator_rmd c43980ca (protocol V3.8, with test vectors),
//! yukunlin1124/myactuator_rmd_v4.3 564d3cda, `pylkmotor` 1.0.6, `NekoRMD` 0.2.2. Layouts of V3 and
//! of LKMTech's motors are certain. Highly probable: that a frame of the motion mode has what is
//! measured, not what was commanded; that MyActuator's own V2 has the layout of LKMTech. Steps of
//! current: 33/4096 A (LKMTech MF), 66/4096 A (MG).
//!
//! # Recognition
//! By answers on `240` + ID (V3) and to questions on `140` + ID (V2). A scan asks `9A` and `9C` of
//! all IDs only if `--ask myactuator` is given: other devices may have such an identifier.
//!
//! # Keys
//! ```toml
//! protocol = "v3"         # "v3" (V4 too) or "v2" (LKMTech too)
//! position = "angle"      # "angle", "status" or "motion"
//! gear_ratio = 1.0        # turns of the shaft that is measured per turn of the output
//! encoder_bits = 16       # of the place in a status, 12 to 16 (V2)
//! ampere_per_step = 0.01  # of the current; default 0.01 in V3; V2: the current is absent
//! torque_constant = 1.0   # torque of the output per current [Nm/A]; default: torque is absent
//! position_max = 12.5     # ends of the ranges of the motion mode [rad]
//! velocity_max = 45.0     # [rad/s]
//! torque_max = 24.0       # [Nm]
//! hold_ms = 100           # how long speed and current are used, 1 to 60000
//! request_period_ms = 10  # ask, 1 to 60000; default: do not
//! period_ms = 10          # 1 to 60000; set by its commander; used by the simulated motor
//! ```

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::MyactuatorBoard;
pub use frames::Protocol;
pub use options::{Options, Position};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, Frame, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Motor;
use frames::{JOINT, MOTOR};
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "myactuator";
    const ASKED_BY_NAME: bool = true;

    fn outputs(&self) -> Vec<OutputInfo> {
        let motor = OutputInfo::temperature(MOTOR, "motor");
        [OutputInfo::new(JOINT, Kind::Joint), motor].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Motor::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MyactuatorBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::motors(seen)
    }

    fn questions(_seen: &Traffic) -> Vec<Frame> {
        recognise::questions()
    }
}
