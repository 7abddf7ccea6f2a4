//! The numbers of an MTi's messages.

use serde::Deserialize;

/// One step of angular velocity \[rad/s\].
pub(super) const RATE_LSB: f64 = 1.0 / 512.0;
/// One step of acceleration \[m/s^2\].
pub(super) const ACCELERATION_LSB: f64 = 1.0 / 256.0;
/// One step of the magnetic field, in `magnetic_unit`.
pub(super) const FIELD_LSB: f64 = 1.0 / 1024.0;
/// The error code of a full output buffer.
pub(super) const BUFFER_OVERFLOW: u8 = 1;

/// Bits of the status word.
pub(super) mod status {
    pub(in crate::xsens_mti) const SELF_TEST: u32 = 1;
    pub(in crate::xsens_mti) const FILTER_VALID: u32 = 1 << 1;
    /// The first of the accelerometer's and the gyroscope's, x y z each: six axes, as the
    /// saturation of a reading numbers them.
    pub(in crate::xsens_mti) const FIRST_AXIS: u32 = 8;
    pub(in crate::xsens_mti) const MAGNETOMETER: u32 = 0b111 << 14;
    /// Some axis, of any sensor.
    pub(in crate::xsens_mti) const CLIPPED: u32 = 1 << 19;
    /// The bits that name an axis.
    pub(in crate::xsens_mti) const AXES: u32 = 0b11_1111 << FIRST_AXIS | MAGNETOMETER;
}

/// The messages that this driver reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum MtiMessage {
    /// Error.
    Error,
    /// Time of the sample.
    SampleTime,
    /// Number of the sample.
    GroupCounter,
    /// Status word.
    Status,
    /// Orientation as a quaternion.
    Orientation,
    /// Angular velocity.
    AngularVelocity,
    /// Proper acceleration.
    Acceleration,
    /// Magnetic field.
    MagneticField,
}

impl MtiMessage {
    /// What a sensor measures, in order.
    pub(super) const MEASURED: [Self; 4] = [
        Self::Orientation,
        Self::AngularVelocity,
        Self::Acceleration,
        Self::MagneticField,
    ];

    /// The identifier that it is delivered with.
    pub(super) const fn identifier(self, high_rate: HighRate) -> u32 {
        match (self, high_rate) {
            (Self::Error, _) => 0x001,
            (Self::SampleTime, _) => 0x005,
            (Self::GroupCounter, _) => 0x006,
            (Self::Status, _) => 0x011,
            (Self::Orientation, _) => 0x021,
            (Self::AngularVelocity, HighRate::None) => 0x032,
            (Self::Acceleration, HighRate::None) => 0x034,
            (Self::MagneticField, _) => 0x041,
            (Self::AngularVelocity, HighRate::RateFirst)
            | (Self::Acceleration, HighRate::AccelerationFirst) => 0x061,
            (Self::AngularVelocity, HighRate::AccelerationFirst)
            | (Self::Acceleration, HighRate::RateFirst) => 0x062,
        }
    }

    /// Its length \[bytes\].
    pub(super) const fn length(self) -> usize {
        match self {
            Self::Error => 1,
            Self::GroupCounter => 2,
            Self::SampleTime | Self::Status => 4,
            Self::AngularVelocity | Self::Acceleration | Self::MagneticField => 6,
            Self::Orientation => 8,
        }
    }
}

/// Which messages hold angular velocity and acceleration.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum HighRate {
    /// The usual ones.
    #[default]
    None,
    /// The HR messages, the angular velocity in the lower identifier.
    RateFirst,
    /// The HR messages, the acceleration in the lower identifier.
    AccelerationFirst,
}
