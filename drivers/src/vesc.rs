//! VESC motor controllers (VESC 4 to 6, and the many boards with the firmware bldc), by the status
//! messages that they send.
//!
//! The address is the controller's "VESC ID", 0 to 254. Extended identifiers: command << 8 |
//! address. Big-endian.
//!
//! | command | name | bytes | content |
//! |---|---|---|---|
//! | 09 | status | 8 | electrical speed i32 \[rpm\], current i16 \[0.1 A\], duty i16 \[0.1 %\] |
//! | 0E | status 2 | 8 | charge i32: used, charged \[0.1 mAh\] |
//! | 0F | status 3 | 8 | energy i32: used, charged \[0.1 mWh\] |
//! | 10 | status 4 | 8 | temperature i16: FET, motor \[0.1 deg Celsius\]; input current, position |
//! | 1B | status 5 | 8 | tachometer i32 \[1/6 electrical rev\], input voltage i16, 0 |
//! | 3A | status 6 | 8 | ADC 1 to 3, servo input |
//!
//! - **Position**: that of status 4 is the "PID position" i16 \[0.02 deg\], 0 to 360 deg of the
//!   shaft for which the VESC is configured: where that goes beyond a turn, count the turns
//!   (`wraps_rad = [0.0, 6.283185307179586]`, docs/joints.md). The tachometer goes on; it is 0 at
//!   power-on, wherever the shaft is, and without an encoder it is a count of commutations.
//! - Each frame with the position is a reading of the joint. Speed and current of status 1 join
//!   the readings that follow within `hold_ms`, and are absent after that.
//! - **The current's sign is not the torque's**: positive drives the motor, negative brakes it. The
//!   direction is that of the duty cycle, so current and torque are the current times its sign.
//!   With a duty of 0 and a current that is not 0, both are absent: the direction is lost in
//!   rounding.
//! - Velocity and torque are those of the shaft whose position is read: `gear_ratio` and
//!   `torque_constant` say how many turns and how much torque that is. `ratio` in the joint's table
//!   makes them the joint's, if there is a gear after it.
//! - Each status 1 is an actuator reading with the duty. Temperatures have channels of their own,
//!   `<device>_fet` and `<device>_motor`; below -40 deg is a thermometer that is not there.
//! - **Faults are not in these messages**: a VESC that has stopped with a fault looks like one at
//!   rest.
//!
//! The driver never transmits. In VESC Tool, "App Settings", "General": CAN mode VESC, status 1 and
//! 4 (or 5) in "CAN Status Messages Rate 1" at the rate at which positions are wanted.
//!
//! Sources: `comm/comm_can.c`, `documentation/comm_can.md`, `motor/mcpwm_foc.c` and
//! `motor/mc_interface.c` (vedderb/bldc b9d287b3, firmware 6). Layouts, the sign of the current and
//! the range of the position are certain. Highly probable: that the same holds for motors in BLDC
//! mode.
//!
//! # Recognition
//! By the status messages. Nothing is asked.
//!
//! # Keys
//! ```toml
//! position = "pid"        # "pid" (status 4) or "tachometer" (status 5)
//! pole_pairs = 7          # of the motor; must be given
//! gear_ratio = 1.0        # turns of the motor per turn of the shaft whose position is read
//! torque_constant = 0.08  # torque of that shaft per current [Nm/A]; default: torque is absent
//! hold_ms = 100           # how long speed and current are used, 1 to 60000
//! period_ms = 20          # set in the VESC, 1 to 60000; used by the simulated one
//! ```

mod board;
mod device;
mod frames;
mod options;
mod recognise;

pub use board::VescBoard;
pub use options::{Options, Position};

use crate::recognise::{Finding, Traffic};
use crate::{Board, Device, Driver, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use device::Controller;
use frames::{FET, JOINT, MOTOR};
use proprio_topics::Kind;

impl Driver for Options {
    const NAME: &'static str = "vesc";

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Controller::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(VescBoard::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        recognise::controllers(seen)
    }
}
