//! Sample logs as CSV: one row per instant, one column per quantity, SI units, an empty cell for no
//! sample.
//!
//! | column | meaning |
//! |---|---|
//! | `t` | stamp \[s\], decimal, read as integer nanoseconds; empty where a log has no stamps |
//! | `joint/<joint>/position` `velocity` `acceleration` | \[rad, rad/s, rad/s^2\] |
//! | `joint/<joint>/torque` `current` | \[Nm, A\] |
//! | `wrench/<sensor>/fx` `fy` `fz` `tx` `ty` `tz` | \[N, Nm\], sensor axes |
//! | `wrench/<sensor>/temperature` | \[degrees Celsius\] |
//! | `wrench/<sensor>/g0` to `g5` | uncalibrated gauge counts |
//! | `imu/<sensor>/ax` `ay` `az` | proper acceleration \[m/s^2\], IMU axes |
//! | `imu/<sensor>/gx` `gy` `gz` | angular velocity \[rad/s\] |
//! | `imu/<sensor>/alx` `aly` `alz` | angular acceleration \[rad/s^2\] |
//! | `imu/<sensor>/mx` `my` `mz`, `qw` `qx` `qy` `qz` | magnetic field \[T\], orientation |
//! | `joint/<joint>/duty` `mode` `encoder` `faults` | the motor board's own state |
//! | `<channel>/quality` | the bits of [`Quality`](crate::Quality), as a number |
//! | `contact/<name>/active` | 0 or 1: whether a contact is present from this instant on |
//! | `contact/<name>/px` `py` `pz` `p_std` | where, and its standard deviation \[m\]; optional |
//! | `contact/<name>/dx` `dy` `dz` | the direction of a `force_along`; optional |
//! | `skin/<channel>/triangle` `p0` to `p11` | one triangle of a skin and its taxels, in counts |
//!
//! The components of one vector (`fx` to `tz`; `ax` to `az`; ...) are all present or all empty. A
//! row that breaks this rule or holds a cell that is not a finite number is skipped, counted and
//! reported by [`TableReader::report`].

mod columns;
mod reader;
mod writer;

pub use columns::{Series, SeriesKind, Value};
pub use reader::{BadRow, Row, SeriesValue, TableError, TableReader, TableReport};
pub use writer::{Columns, TableWriter};
