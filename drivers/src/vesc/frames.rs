//! The status messages that are read, and the steps of their values.

use core::f64::consts::TAU;

/// The commands.
pub(super) mod command {
    pub(in crate::vesc) const STATUS: u8 = 0x09;
    pub(in crate::vesc) const STATUS_4: u8 = 0x10;
    pub(in crate::vesc) const STATUS_5: u8 = 0x1B;
}

/// The outputs.
pub(super) const JOINT: u8 = 0;
pub(super) const MOTOR: u8 = 1;
pub(super) const FET: u8 = 2;
/// The length of every status message.
pub(super) const LENGTH: usize = 8;
/// The highest address: 255 is all of them.
pub(super) const ADDRESS_MOST: u16 = 254;
/// A revolution per minute \[rad/s\].
pub(super) const RAD_PER_S_PER_RPM: f64 = TAU / 60.0;
/// A step of the PID position \[rad\]: a fiftieth of a degree. A turn has this many.
pub(super) const RAD_PER_STEP: f64 = TAU / STEPS_PER_TURN as f64;
pub(super) const STEPS_PER_TURN: i64 = 18_000;
/// A step of the tachometer \[rad, electrical\].
pub(super) const RAD_PER_COUNT: f64 = TAU / 6.0;
/// A step of a current \[A\], of a temperature \[K\], and of a duty cycle.
pub(super) const AMPERE_PER_STEP: f64 = 0.1;
pub(super) const KELVIN_PER_STEP: f64 = 0.1;
pub(super) const DUTY_PER_STEP: f64 = 1e-3;
/// The coldest that the parts of a controller work at \[degrees Celsius\]. The input of a
/// thermometer that is not there is read as -87 or so, or as -100.
pub(super) const COLDEST: f64 = -40.0;
