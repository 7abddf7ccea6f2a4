//! The keys of a motor in gateway.toml, for both sides of the driver.

use super::frames::{PayloadLayout, SERVO_STATUS};
use crate::keys::{above_zero, address, duration, id, known, stated, within};
use crate::mit::{self, Scale};
use crate::{Id, Spec, SpecError};
use core::f64::consts::TAU;
use proprio_topics::Nanos;
use serde::Deserialize;

/// The mode that a motor is configured for.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum CubemarsMode {
    /// MIT mode.
    #[default]
    Mit,
    /// Servo mode.
    Servo,
}

/// The third value of MIT mode.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum Effort {
    /// A torque \[Nm\].
    #[default]
    Torque,
    /// A current \[A\].
    Current,
}

/// The degrees of a position in servo mode.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum Angle {
    /// Of the output shaft.
    #[default]
    Output,
    /// Electrical ones: times the pole pairs and the gear ratio.
    Electrical,
}

/// A model, for its ranges, pole pairs and gear ratio.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[allow(missing_docs)] // the names say it
pub enum CubemarsModel {
    #[serde(rename = "AK10-9")]
    Ak10_9,
    #[serde(rename = "AK60-6")]
    Ak60_6,
    #[serde(rename = "AK70-10")]
    Ak70_10,
    #[serde(rename = "AK80-6")]
    Ak80_6,
    #[serde(rename = "AK80-8")]
    Ak80_8,
    #[serde(rename = "AK80-9")]
    Ak80_9,
    #[serde(rename = "AK80-64")]
    Ak80_64,
}

impl CubemarsModel {
    /// Ends of the ranges of velocity \[rad/s\] and torque \[Nm\], pole pairs, gear ratio.
    const fn numbers(self) -> (f64, f64, u32, f64) {
        match self {
            Self::Ak10_9 => (50.0, 65.0, 21, 9.0),
            Self::Ak60_6 => (45.0, 15.0, 14, 6.0),
            Self::Ak70_10 => (50.0, 25.0, 21, 10.0),
            Self::Ak80_6 => (76.0, 12.0, 21, 6.0),
            Self::Ak80_8 => (37.5, 32.0, 21, 8.0),
            Self::Ak80_9 => (50.0, 18.0, 21, 9.0),
            Self::Ak80_64 => (8.0, 144.0, 21, 64.0),
        }
    }
}

/// The keys of `driver = "cubemars"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct CubemarsOptions {
    /// The motor's mode; default MIT.
    pub mode: CubemarsMode,
    /// Its model, for the defaults of other keys.
    pub model: Option<CubemarsModel>,
    /// Identifier of the replies in MIT mode, 0 to 2047; default 0.
    pub host_id: u16,
    /// End of the range of positions in MIT mode \[rad\]; default 12.5.
    pub position_max: f64,
    /// End of the range of velocities in MIT mode \[rad/s\]; default: the model's.
    pub velocity_max: Option<f64>,
    /// End of the range of the third value in MIT mode \[Nm or A\]; default: the model's torque.
    pub effort_max: Option<f64>,
    /// The third value of MIT mode; default a torque.
    pub effort: Effort,
    /// The temperature that byte 0 means in MIT mode \[degrees Celsius\]; default -40.
    pub celsius_at_zero: f64,
    /// Pole pairs, for servo mode; default: the model's.
    pub pole_pairs: Option<u32>,
    /// Turns of the rotor per turn of the output shaft, for servo mode; default: the model's.
    pub gear_ratio: Option<f64>,
    /// The degrees of a position in servo mode; default the output shaft's.
    pub angle: Angle,
    /// Torque of the output shaft per current \[Nm/A\]; default: none follows from the current.
    pub torque_constant: Option<f64>,
    /// Period of a simulated motor \[ms\]; default 2.
    pub period_ms: u32,
}

impl Default for CubemarsOptions {
    fn default() -> Self {
        Self {
            mode: CubemarsMode::Mit,
            model: None,
            host_id: 0,
            position_max: 12.5,
            velocity_max: None,
            effort_max: None,
            effort: Effort::Torque,
            celsius_at_zero: -40.0,
            pole_pairs: None,
            gear_ratio: None,
            angle: Angle::Output,
            torque_constant: None,
            period_ms: 2,
        }
    }
}

/// The highest number of a motor. (The first byte of a special command is 255.)
const NUMBER_MOST: u8 = 254;
/// A tenth of a degree \[rad\].
const RAD_PER_STEP: f64 = TAU / 3600.0;
/// Ten revolutions per minute \[rad/s\].
const RAD_PER_S_PER_STEP: f64 = TAU / 6.0;
/// A step of current \[A\].
const AMPERE_PER_STEP: f64 = 0.01;

/// The keys of a motor, checked.
#[derive(Debug, Clone, Copy)]
pub(super) struct CubemarsKeys {
    pub(super) number: u8,
    /// Of the frames with its measurement.
    pub(super) id: Id,
    pub(super) layout: PayloadLayout,
    /// Position \[rad\], velocity \[rad/s\], effort \[Nm or A\].
    pub(super) scales: [Scale; 3],
    pub(super) effort: Effort,
    pub(super) torque_constant: Option<f64>,
    pub(super) period: Nanos,
}

impl CubemarsKeys {
    pub(super) fn new(spec: &Spec, options: &CubemarsOptions) -> Result<Self, SpecError> {
        let number = address(spec, 0..=NUMBER_MOST)?;
        let host = id("host_id", options.host_id, 0..=0x7FF, "0 to 2047")?;
        let celsius_at_zero = options.celsius_at_zero;
        within(
            "celsius_at_zero",
            celsius_at_zero,
            -100.0..=100.0,
            "-100 to 100",
        )?;
        let torque_constant = stated("torque_constant", options.torque_constant)?;
        let model = options.model.map(CubemarsModel::numbers);
        let (id, layout, scales, effort) = match options.mode {
            CubemarsMode::Mit => {
                let position = above_zero("position_max", options.position_max)?;
                let of_model = model.map(|(velocity, ..)| velocity);
                let velocity = known("velocity_max", options.velocity_max, of_model)?;
                // A model has no range of currents.
                let of_model = model.map(|(_, torque, ..)| torque);
                let of_model = of_model.filter(|_| options.effort == Effort::Torque);
                let effort = known("effort_max", options.effort_max, of_model)?;
                let scales = mit::scales([position, velocity, effort]);
                let layout = PayloadLayout::Mit { celsius_at_zero };
                (host, layout, scales, options.effort)
            }
            CubemarsMode::Servo => {
                let of_model = model.map(|(_, _, pairs, _)| f64::from(pairs));
                let pairs = known("pole_pairs", options.pole_pairs.map(f64::from), of_model)?;
                let of_model = model.map(|(.., ratio)| ratio);
                let ratio = known("gear_ratio", options.gear_ratio, of_model)?;
                let per_turn = match options.angle {
                    Angle::Output => 1.0,
                    Angle::Electrical => pairs * ratio,
                };
                let scales = [
                    Scale::steps(RAD_PER_STEP / per_turn, 32000),
                    Scale::steps(RAD_PER_S_PER_STEP / (pairs * ratio), 32000),
                    Scale::steps(AMPERE_PER_STEP, 6000),
                ];
                let id = Id::extended(SERVO_STATUS | u32::from(number));
                (id, PayloadLayout::Servo, scales, Effort::Current)
            }
        };
        Ok(Self {
            number,
            id,
            layout,
            scales,
            effort,
            torque_constant,
            period: duration("period_ms", options.period_ms)?,
        })
    }
}
