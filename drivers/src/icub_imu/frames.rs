//! The contents of an IMU's frames: types of its streams, numbers of its sensors and modes, and the
//! step of each quantity.

use core::f64::consts::PI;
use serde::Deserialize;

/// Types of the streams.
pub(super) mod kind {
    pub(in crate::icub_imu) const LEGACY_GYROSCOPE: u8 = 0;
    pub(in crate::icub_imu) const LEGACY_ACCELEROMETER: u8 = 1;
    pub(in crate::icub_imu) const TRIPLE: u8 = 3;
    pub(in crate::icub_imu) const QUATERNION: u8 = 4;
    pub(in crate::icub_imu) const STATUS: u8 = 5;
}

/// SNS, and bits of the mask.
pub(super) mod sensor {
    pub(in crate::icub_imu) const ACCELERATION: u8 = 0;
    pub(in crate::icub_imu) const MAGNETIC_FIELD: u8 = 1;
    pub(in crate::icub_imu) const ANGULAR_VELOCITY: u8 = 2;
    pub(in crate::icub_imu) const EULER: u8 = 3;
    pub(in crate::icub_imu) const QUATERNION: u8 = 4;
    pub(in crate::icub_imu) const LINEAR_ACCELERATION: u8 = 5;
    pub(in crate::icub_imu) const GRAVITY: u8 = 6;
    pub(in crate::icub_imu) const STATUS: u8 = 15;
}

/// One step of acceleration \[m/s^2\].
pub(super) const ACCELERATION_LSB: f64 = 0.01;
/// One step of the magnetic field \[T\].
pub(super) const FIELD_LSB: f64 = 1e-6 / 16.0;
/// One step of angular velocity \[rad/s\].
pub(super) const RATE_LSB: f64 = PI / 180.0 / 16.0;
/// One step of a quaternion.
pub(super) const QUATERNION_LSB: f64 = 1.0 / 16384.0;
/// One step of a legacy mtb accelerometer: 2 g over 2^15 \[m/s^2\].
const MTB_ACCELERATION_LSB: f64 = 2.0 * 9.80665 / 32768.0;
/// One step of a legacy mtb gyroscope: 250 deg/s over 2^15 \[rad/s\].
const MTB_RATE_LSB: f64 = 250.0 / 32768.0 * PI / 180.0;

/// The quantities of an IMU.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum ImuQuantity {
    /// Proper acceleration.
    Acceleration,
    /// Magnetic field.
    MagneticField,
    /// Angular velocity.
    AngularVelocity,
    /// Orientation as a quaternion.
    Orientation,
    /// Its calibration status.
    Status,
}

impl ImuQuantity {
    /// Its bit in the mask.
    pub(super) const fn bit(self) -> u16 {
        1 << match self {
            Self::Acceleration => sensor::ACCELERATION,
            Self::MagneticField => sensor::MAGNETIC_FIELD,
            Self::AngularVelocity => sensor::ANGULAR_VELOCITY,
            Self::Orientation => sensor::QUATERNION,
            Self::Status => sensor::STATUS,
        }
    }
}

/// The chip's operation mode.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum Fusion {
    /// Fusion of all three sensors.
    #[default]
    Ndof,
    /// Mode 0: raw sensors by the document, fusion without magnetometer by the firmware.
    RawOrImu,
    /// Accelerometer only.
    Acconly,
    /// Magnetometer only.
    Magonly,
    /// Gyroscope only.
    Gyronly,
    /// Accelerometer and magnetometer.
    Accmag,
    /// Accelerometer and gyroscope.
    Accgyro,
    /// Magnetometer and gyroscope.
    Maggyro,
    /// All three, no fusion.
    Amg,
    /// Fusion of accelerometer and gyroscope.
    Imu,
    /// Compass (heading).
    Compass,
    /// Magnetometer instead of gyroscope (M4G).
    M4g,
    /// As `ndof`, with fast magnetometer calibration off.
    NdofFmcOff,
}

impl Fusion {
    /// The mode byte: 0x80 marks a Bosch operation mode.
    pub(super) const fn code(self) -> u8 {
        match self {
            Self::RawOrImu => 0x00,
            Self::Ndof => 0x01,
            Self::Acconly => 0x81,
            Self::Magonly => 0x82,
            Self::Gyronly => 0x83,
            Self::Accmag => 0x84,
            Self::Accgyro => 0x85,
            Self::Maggyro => 0x86,
            Self::Amg => 0x87,
            Self::Imu => 0x88,
            Self::Compass => 0x89,
            Self::M4g => 0x8A,
            Self::NdofFmcOff => 0x8B,
        }
    }
}

/// The kind of legacy frames, which determines their scale.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum Legacy {
    /// No legacy frames: IMU_TRIPLE and the others.
    #[default]
    None,
    /// An mtb's discrete sensors.
    Mtb,
    /// A BNO055 in legacy mode.
    Bno055,
}

impl Legacy {
    /// Steps of acceleration \[m/s^2\] and angular velocity \[rad/s\].
    pub(super) const fn lsb(self) -> [f64; 2] {
        match self {
            Self::Mtb => [MTB_ACCELERATION_LSB, MTB_RATE_LSB],
            Self::None | Self::Bno055 => [ACCELERATION_LSB, RATE_LSB],
        }
    }
}

/// The legacy gyroscope's bit; the others are accelerometers.
pub(super) const LEGACY_GYROSCOPE: u8 = 0b100;
/// All legacy accelerometers.
pub(super) const LEGACY_ACCELEROMETERS: u8 = 0b1011;
