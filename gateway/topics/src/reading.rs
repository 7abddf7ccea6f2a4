//! A device's measurement in SI units, one variant per kind of quantity.

use iceoryx2_bb_derive_macros::ZeroCopySend;
use iceoryx2_bb_elementary_traits::zero_copy_send::ZeroCopySend;

/// A joint's (or a motor shaft's) state, positive along the axis that the configuration states.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct JointState {
    /// Position \[rad, or m for a prismatic joint\]. NaN if this device does not report it.
    pub position: f64,
    /// Velocity \[rad/s or m/s\] as the device reports it. NaN if not reported.
    pub velocity: f64,
    /// Acceleration \[rad/s^2 or m/s^2\]. NaN if not reported.
    pub acceleration: f64,
    /// Measured torque \[Nm, or N\], by the parent link on the child link along the axis. NaN if
    /// not measured.
    pub torque: f64,
    /// Motor current \[A\]. NaN if not reported.
    pub current: f64,
}

impl JointState {
    /// Nothing reported yet.
    pub const ABSENT: Self = Self {
        position: f64::NAN,
        velocity: f64::NAN,
        acceleration: f64::NAN,
        torque: f64::NAN,
        current: f64::NAN,
    };
}

/// A six-axis force/torque sensor's reading, in the sensor's own axes and about the sensor's own
/// origin.
///
/// The gateway passes on the device's values in SI units. The body that the wrench acts on and the
/// pose of the sensor frame are in the estimator's configuration (`[[force_torque]]`: `frame`,
/// `direction`).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct Wrench {
    /// Force \[N\], sensor axes.
    pub force: [f64; 3],
    /// Torque \[Nm\], sensor axes, about the sensor's origin.
    pub torque: [f64; 3],
}

/// An inertial measurement unit's reading, in the IMU's axes.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct Imu {
    /// Proper acceleration of the IMU's origin \[m/s^2\]: classical acceleration minus gravity. At
    /// rest it points up.
    pub proper_acceleration: [f64; 3],
    /// Angular velocity \[rad/s\] with respect to an inertial frame.
    pub angular_velocity: [f64; 3],
    /// Angular acceleration \[rad/s^2\]. NaN if not reported.
    pub angular_acceleration: [f64; 3],
    /// Magnetic field \[T\]. NaN if not reported.
    pub magnetic_field: [f64; 3],
    /// Orientation as a unit quaternion w, x, y, z (world from IMU, by the device's own filter).
    /// NaN if not reported.
    pub orientation: [f64; 4],
}

impl Imu {
    /// Nothing reported yet.
    pub const ABSENT: Self = Self {
        proper_acceleration: [f64::NAN; 3],
        angular_velocity: [f64::NAN; 3],
        angular_acceleration: [f64::NAN; 3],
        magnetic_field: [f64::NAN; 3],
        orientation: [f64::NAN; 4],
    };
}

/// Raw strain gauge counts of a force/torque sensor, before its calibration matrix.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, ZeroCopySend)]
pub struct Gauges {
    /// Analog-to-digital counts of channels 0 to 5, as the device sends them.
    pub counts: [i32; 6],
}

/// A device's temperature.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct Temperature {
    /// Temperature \[degrees Celsius\].
    pub celsius: f64,
}

/// A motor board's state.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub struct Actuator {
    /// Duty cycle of the power stage, -1 to 1. NaN if not reported.
    pub duty: f64,
    /// Control mode, the device's own code (see the driver).
    pub mode: u32,
    /// Encoder state, the device's own bits (see the driver).
    pub encoder: u32,
    /// Fault bits, the device's own (see the driver); 0 is no fault.
    pub faults: u32,
    /// Unused, zero.
    pub reserved: u32,
}

/// One reading of one channel.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
pub enum Reading {
    /// A joint's state.
    Joint(JointState),
    /// A force/torque sensor's wrench.
    Wrench(Wrench),
    /// An inertial measurement unit's accelerations, rates and orientation.
    Imu(Imu),
    /// A force/torque sensor's uncalibrated gauges.
    Gauges(Gauges),
    /// A temperature.
    Temperature(Temperature),
    /// A motor board's state.
    Actuator(Actuator),
}

/// The kind of a channel, after its main reading.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, ZeroCopySend)]
pub enum Kind {
    /// A joint: [`Reading::Joint`], and [`Reading::Actuator`] or [`Reading::Temperature`] of its
    /// motor.
    Joint = 0,
    /// A force/torque sensor: [`Reading::Wrench`], and [`Reading::Gauges`],
    /// [`Reading::Temperature`].
    Wrench = 1,
    /// An inertial measurement unit: [`Reading::Imu`].
    Imu = 2,
}

impl Kind {
    /// Its name in configuration files and CSV columns.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Joint => "joint",
            Self::Wrench => "wrench",
            Self::Imu => "imu",
        }
    }
}

const _: () =
    assert!(size_of::<Imu>() == 128 && size_of::<Wrench>() == 48 && size_of::<JointState>() == 40);
const _: () = assert!(size_of::<Reading>() == 136 && align_of::<Reading>() == 8);
