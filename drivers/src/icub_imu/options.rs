//! The keys of an IMU in gateway.toml. They are checked here and converted to a plan, which both
//! sides of the driver use.

use super::frames::{Fusion, ImuQuantity, LEGACY_ACCELEROMETERS, LEGACY_GYROSCOPE, Legacy};
use crate::icub::{self, command};
use crate::{Spec, SpecError};
use alloc::vec::Vec;
use serde::Deserialize;

/// The keys of `driver = "icub_imu"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IcubImuOptions {
    /// The quantities of a reading; default acceleration and angular velocity.
    pub quantities: Vec<ImuQuantity>,
    /// Period \[ms\], 1 to 255; default 10.
    pub period_ms: u32,
    /// The chip's operation mode; default ndof.
    pub mode: Fusion,
    /// Placement P0 to P7; default the board's own.
    pub placement: Option<u8>,
    /// Legacy frames; default none.
    pub legacy: Legacy,
    /// Legacy sensors; default 6: internal accelerometer, external gyroscope.
    pub legacy_mask: Option<u8>,
    /// Silence kept after power-on \[ms\]; default 0.
    pub power_on_silence_ms: u32,
}

impl Default for IcubImuOptions {
    fn default() -> Self {
        Self {
            quantities: [ImuQuantity::Acceleration, ImuQuantity::AngularVelocity].to_vec(),
            period_ms: 10,
            mode: Fusion::Ndof,
            placement: None,
            legacy: Legacy::None,
            legacy_mask: None,
            power_on_silence_ms: 0,
        }
    }
}

/// Default legacy sensors: internal accelerometer and external gyroscope.
const LEGACY_MASK: u8 = 0b110;

/// The plan that results from the keys.
#[derive(Debug, Clone, Copy)]
pub(super) struct ImuKeys {
    pub(super) address: u8,
    pub(super) period_ms: u8,
    /// The mask of the quantities of a reading.
    pub(super) want: u16,
    /// IMU_CONFIG_SET.
    pub(super) configuration: [u8; 8],
    pub(super) legacy: Legacy,
    pub(super) legacy_mask: u8,
}

impl ImuKeys {
    pub(super) fn new(spec: &Spec, options: &IcubImuOptions) -> Result<Self, SpecError> {
        let address = icub::address(spec)?;
        let period_ms = icub::period_ms("period_ms", options.period_ms)?;
        let want = options
            .quantities
            .iter()
            .fold(0, |mask, quantity| mask | quantity.bit());
        let inertial = ImuQuantity::Acceleration.bit() | ImuQuantity::AngularVelocity.bit();
        // Every reading needs a frame with SEQ, which identifies its acquisition.
        if want & (inertial | ImuQuantity::MagneticField.bit()) == 0 {
            let expected =
                "a list with at least one of acceleration, angular_velocity, magnetic_field";
            return Err(SpecError::keys("quantities", expected));
        }
        let legacy_mask = options.legacy_mask.unwrap_or(LEGACY_MASK);
        if options.legacy == Legacy::None {
            if options.legacy_mask.is_some() {
                return Err(SpecError::keys("legacy_mask", "absent without legacy"));
            }
        } else {
            if want & !inertial != 0 {
                let expected = "acceleration or angular_velocity or both, with legacy frames";
                return Err(SpecError::keys("quantities", expected));
            }
            let lacks = (want & ImuQuantity::Acceleration.bit() != 0
                && legacy_mask & LEGACY_ACCELEROMETERS == 0)
                || (want & ImuQuantity::AngularVelocity.bit() != 0
                    && legacy_mask & LEGACY_GYROSCOPE == 0);
            if lacks || legacy_mask > 0xF {
                let expected = "at most 15, with bit 2 for angular_velocity and bit 0, 1 or 3 for \
                     acceleration";
                return Err(SpecError::key("legacy_mask", legacy_mask, expected));
            }
        }
        let orientation = match options.placement {
            None => 0,
            Some(placement @ 0..=7) => 0x80 | placement,
            Some(other) => {
                return Err(SpecError::key("placement", other, "0 to 7"));
            }
        };
        let [low, high] = want.to_le_bytes();
        let configuration = [
            command::IMU_CONFIG_SET,
            low,
            high,
            options.mode.code(),
            orientation,
            0,
            0,
            0,
        ];
        Ok(Self {
            address,
            period_ms,
            want,
            configuration,
            legacy: options.legacy,
            legacy_mask,
        })
    }
}
