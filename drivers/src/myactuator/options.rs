//! The keys of a motor in gateway.toml, for both sides of the driver.

use super::frames::{ANSWERS, COMMANDS, ENCODER_ERROR, MOTION, MyactuatorProtocol};
use crate::family::quality_of;
use crate::keys::{above_zero, address, duration, stated, stated_duration, within};
use crate::mit::{self, Scale};
use crate::{Id, Spec, SpecError};
use core::f64::consts::TAU;
use proprio_topics::{Nanos, Quality};
use serde::Deserialize;

/// Which frames are a reading of the joint.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum MyactuatorPosition {
    /// Answers with an angle.
    #[default]
    Angle,
    /// Answers with a state.
    Status,
    /// Answers of the motion mode.
    Motion,
}

/// The keys of `driver = "myactuator"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct MyactuatorOptions {
    /// Its protocol; default V3.
    pub protocol: MyactuatorProtocol,
    /// Which frames are a reading of the joint; default those with an angle.
    pub position: MyactuatorPosition,
    /// Turns of the shaft that is measured per turn of the output; default 1.
    pub gear_ratio: f64,
    /// Bits of the encoder, 12 to 16; default 16.
    pub encoder_bits: u32,
    /// A step of the current \[A\]; default 0.01 in V3, not known in V2.
    pub ampere_per_step: Option<f64>,
    /// Torque of the output per current \[Nm/A\]; default: none follows from the current.
    pub torque_constant: Option<f64>,
    /// End of the range of positions of the motion mode \[rad\]; default 12.5.
    pub position_max: f64,
    /// End of its range of velocities \[rad/s\]; default 45.
    pub velocity_max: f64,
    /// End of its range of torques \[Nm\]; default 24.
    pub torque_max: f64,
    /// How long speed and current are used \[ms\]; default 100.
    pub hold_ms: u32,
    /// Period of questions \[ms\]; default: none are sent.
    pub request_period_ms: Option<u32>,
    /// Period of a simulated motor \[ms\]; default 10.
    pub period_ms: u32,
}

impl Default for MyactuatorOptions {
    fn default() -> Self {
        Self {
            protocol: MyactuatorProtocol::V3,
            position: MyactuatorPosition::Angle,
            gear_ratio: 1.0,
            encoder_bits: 16,
            ampere_per_step: None,
            torque_constant: None,
            position_max: 12.5,
            velocity_max: 45.0,
            torque_max: 24.0,
            hold_ms: 100,
            request_period_ms: None,
            period_ms: 10,
        }
    }
}

/// A degree \[rad\].
const DEGREE: f64 = TAU / 360.0;

/// The keys of a motor, checked.
#[derive(Debug, Clone, Copy)]
pub(super) struct MyactuatorKeys {
    pub(super) address: u16,
    pub(super) protocol: MyactuatorProtocol,
    pub(super) position: MyactuatorPosition,
    /// Steps of an angle and of a place \[rad\], of a speed \[rad/s\], of a current \[A\].
    pub(super) angle_step: f64,
    pub(super) place_step: f64,
    pub(super) speed_step: f64,
    pub(super) ampere_per_step: f64,
    pub(super) encoder_bits: u32,
    pub(super) torque_constant: f64,
    /// Position, velocity, torque of the motion mode.
    pub(super) scales: [Scale; 3],
    pub(super) hold: Nanos,
    pub(super) request_period: Option<Nanos>,
    pub(super) period: Nanos,
}

impl MyactuatorKeys {
    pub(super) fn new(spec: &Spec, options: &MyactuatorOptions) -> Result<Self, SpecError> {
        let address = address(spec, 1..=32)?;
        let (protocol, position) = (options.protocol, options.position);
        if position == MyactuatorPosition::Motion && protocol == MyactuatorProtocol::V2 {
            let expected = "\"angle\" or \"status\" with protocol = \"v2\"";
            return Err(SpecError::keys("position", expected));
        }
        if position == MyactuatorPosition::Motion && options.request_period_ms.is_some() {
            let expected = "left out with position = \"motion\": what asks for it is a command";
            return Err(SpecError::keys("request_period_ms", expected));
        }
        let encoder_bits = within("encoder_bits", options.encoder_bits, 12..=16, "12 to 16")?;
        let ampere = stated("ampere_per_step", options.ampere_per_step)?;
        let ratio = above_zero("gear_ratio", options.gear_ratio)?;
        Ok(Self {
            address,
            protocol,
            position,
            angle_step: 0.01 * DEGREE / ratio,
            place_step: match protocol {
                MyactuatorProtocol::V3 => DEGREE / ratio,
                MyactuatorProtocol::V2 => TAU / f64::from(1 << encoder_bits) / ratio,
            },
            speed_step: DEGREE / ratio,
            ampere_per_step: match (ampere, protocol) {
                (Some(ampere), _) => ampere,
                (None, MyactuatorProtocol::V3) => 0.01,
                (None, MyactuatorProtocol::V2) => f64::NAN,
            },
            encoder_bits,
            torque_constant: stated("torque_constant", options.torque_constant)?
                .unwrap_or(f64::NAN),
            scales: mit::scales([
                above_zero("position_max", options.position_max)?,
                above_zero("velocity_max", options.velocity_max)?,
                above_zero("torque_max", options.torque_max)?,
            ]),
            hold: duration("hold_ms", options.hold_ms)?,
            request_period: stated_duration("request_period_ms", options.request_period_ms)?,
            period: duration("period_ms", options.period_ms)?,
        })
    }

    /// The identifier of commands, of answers, and of answers of the motion mode.
    pub(super) const fn commands(&self) -> Id {
        Id::standard(COMMANDS + self.address)
    }

    pub(super) const fn answers(&self) -> Id {
        match self.protocol {
            MyactuatorProtocol::V3 => Id::standard(ANSWERS + self.address),
            MyactuatorProtocol::V2 => self.commands(),
        }
    }

    pub(super) const fn motion(&self) -> Id {
        Id::standard(MOTION + self.address)
    }

    /// The errors that make a position doubtful.
    pub(super) const fn encoder_errors(&self) -> u16 {
        match self.protocol {
            MyactuatorProtocol::V3 => ENCODER_ERROR,
            MyactuatorProtocol::V2 => 0,
        }
    }

    /// The quality of readings with these errors.
    pub(super) fn quality(&self, errors: u16) -> Quality {
        quality_of(errors.into(), self.encoder_errors().into())
    }
}
