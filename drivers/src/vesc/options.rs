//! The keys of a controller in gateway.toml, for both sides of the driver.

use super::frames::{ADDRESS_MOST, RAD_PER_COUNT, RAD_PER_S_PER_RPM, RAD_PER_STEP, command};
use crate::keys::{above_zero, address, duration, stated};
use crate::{Id, Spec, SpecError};
use proprio_topics::Nanos;
use serde::Deserialize;

/// Where the position is taken from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum VescPosition {
    /// The PID position in status 4.
    #[default]
    Pid,
    /// The tachometer in status 5.
    Tachometer,
}

/// The keys of `driver = "vesc"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct VescOptions {
    /// Where the position is taken from; default the PID position.
    pub position: VescPosition,
    /// Pairs of the motor's poles.
    pub pole_pairs: Option<u32>,
    /// Turns of the motor per turn of the shaft whose position is read; default 1.
    pub gear_ratio: f64,
    /// Torque of that shaft per current \[Nm/A\]; default: none follows from the current.
    pub torque_constant: Option<f64>,
    /// How long speed and current are used \[ms\]; default 100.
    pub hold_ms: u32,
    /// Period of a simulated controller \[ms\]; default 20.
    pub period_ms: u32,
}

impl Default for VescOptions {
    fn default() -> Self {
        Self {
            position: VescPosition::Pid,
            pole_pairs: None,
            gear_ratio: 1.0,
            torque_constant: None,
            hold_ms: 100,
            period_ms: 20,
        }
    }
}

/// The keys of a controller, checked.
#[derive(Debug, Clone, Copy)]
pub(super) struct VescKeys {
    address: u16,
    pub(super) position: VescPosition,
    /// A step of the position \[rad\], and of the speed \[rad/s\].
    pub(super) position_step: f64,
    pub(super) velocity_step: f64,
    pub(super) torque_constant: Option<f64>,
    pub(super) hold: Nanos,
    pub(super) period: Nanos,
}

impl VescKeys {
    pub(super) fn new(spec: &Spec, options: &VescOptions) -> Result<Self, SpecError> {
        let address = address(spec, 0..=ADDRESS_MOST)?;
        let Some(pairs) = options.pole_pairs else {
            let expected = "given: the speed is in electrical revolutions";
            return Err(SpecError::keys("pole_pairs", expected));
        };
        let pairs = above_zero("pole_pairs", f64::from(pairs))?;
        let electrical = pairs * above_zero("gear_ratio", options.gear_ratio)?;
        Ok(Self {
            address,
            position: options.position,
            position_step: match options.position {
                VescPosition::Pid => RAD_PER_STEP,
                VescPosition::Tachometer => RAD_PER_COUNT / electrical,
            },
            velocity_step: RAD_PER_S_PER_RPM / electrical,
            torque_constant: stated("torque_constant", options.torque_constant)?,
            hold: duration("hold_ms", options.hold_ms)?,
            period: duration("period_ms", options.period_ms)?,
        })
    }

    pub(super) fn id(&self, command: u8) -> Id {
        Id::extended(u32::from(command) << 8 | u32::from(self.address))
    }

    /// The message with the position.
    pub(super) const fn with_position(&self) -> u8 {
        match self.position {
            VescPosition::Pid => command::STATUS_4,
            VescPosition::Tachometer => command::STATUS_5,
        }
    }
}
