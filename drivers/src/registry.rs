//! The names of the drivers: the one place that lists all families.

use crate::{Board, Device, Spec, SpecError, icub_imu, icub_motor, icub_pos, icub_strain};
use alloc::boxed::Box;
use proprio_topics::Kind;
use serde::Deserialize;

/// The names of all drivers, as gateway.toml writes them.
pub const DRIVERS: [&str; 4] = ["icub_strain", "icub_imu", "icub_motor", "icub_pos"];

/// A driver with its keys.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub enum Options {
    /// iCub F/T boards.
    IcubStrain(icub_strain::Options),
    /// iCub IMUs.
    IcubImu(icub_imu::Options),
    /// iCub 2FOC motor boards.
    IcubMotor(icub_motor::Options),
    /// iCub POS encoders.
    IcubPos(icub_pos::Options),
}

/// Why a driver's keys cannot be read.
#[derive(Debug, Clone, PartialEq)]
pub enum OptionsError<E> {
    /// There is no driver of that name; [`DRIVERS`] lists them.
    UnknownDriver,
    /// A key is unknown or has a wrong value.
    Keys(E),
}

impl Options {
    /// Reads the keys of driver `driver`.
    ///
    /// # Errors
    /// [`OptionsError`]: no such driver, or an unknown key or wrong value (the deserializer's
    /// message).
    pub fn deserialize<'de, D: serde::Deserializer<'de>>(
        driver: &str,
        keys: D,
    ) -> Result<Self, OptionsError<D::Error>> {
        match driver {
            "icub_strain" => icub_strain::Options::deserialize(keys).map(Self::IcubStrain),
            "icub_imu" => icub_imu::Options::deserialize(keys).map(Self::IcubImu),
            "icub_motor" => icub_motor::Options::deserialize(keys).map(Self::IcubMotor),
            "icub_pos" => icub_pos::Options::deserialize(keys).map(Self::IcubPos),
            _ => return Err(OptionsError::UnknownDriver),
        }
        .map_err(OptionsError::Keys)
    }

    /// The kind of the main reading of this driver's devices.
    #[must_use]
    pub const fn kind(&self) -> Kind {
        match self {
            Self::IcubStrain(_) => Kind::Wrench,
            Self::IcubImu(_) => Kind::Imu,
            Self::IcubMotor(_) | Self::IcubPos(_) => Kind::Joint,
        }
    }

    /// The host's side of one device.
    ///
    /// # Errors
    /// [`SpecError`]: an address, channel or value that is invalid for the family.
    pub fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Ok(match self {
            Self::IcubStrain(o) => Box::new(icub_strain::Strain::new(spec, o)?),
            Self::IcubImu(o) => Box::new(icub_imu::ImuDevice::new(spec, o)?),
            Self::IcubMotor(o) => Box::new(icub_motor::Motor::new(spec, o)?),
            Self::IcubPos(o) => Box::new(icub_pos::Pos::new(spec, o)?),
        })
    }

    /// The device's own side.
    ///
    /// # Errors
    /// As [`Options::device`].
    pub fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(match self {
            Self::IcubStrain(o) => Box::new(icub_strain::StrainBoard::new(spec, o)?),
            Self::IcubImu(o) => Box::new(icub_imu::ImuBoard::new(spec, o)?),
            Self::IcubMotor(o) => Box::new(icub_motor::MotorBoard::new(spec, o)?),
            Self::IcubPos(o) => Box::new(icub_pos::PosBoard::new(spec, o)?),
        })
    }
}
