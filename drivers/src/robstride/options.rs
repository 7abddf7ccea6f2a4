//! The keys of a motor in gateway.toml, for both sides of the driver.

use super::frames::fault;
use crate::keys::{above_zero, address, duration, known, stated, stated_duration};
use crate::mit::Scale;
use crate::{Spec, SpecError};
use core::f64::consts::TAU;
use proprio_topics::Nanos;
use serde::Deserialize;

/// The protocol that a motor is set to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum RobstrideProtocol {
    /// Extended identifiers.
    #[default]
    Private,
    /// Standard identifiers.
    Mit,
}

/// A model, for its ranges.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[allow(missing_docs)] // the names say it
pub enum RobstrideModel {
    RS00,
    RS01,
    RS02,
    RS03,
    RS04,
    RS05,
    RS06,
    EL05,
    CyberGear,
}

impl RobstrideModel {
    /// Ends of the ranges of velocity \[rad/s\], in the private and the MIT protocol, and of torque
    /// \[Nm\].
    const fn ranges(self) -> (f64, f64, f64) {
        match self {
            Self::RS00 => (33.0, 33.0, 14.0),
            Self::RS01 => (44.0, 44.0, 17.0),
            Self::RS02 => (44.0, 33.0, 17.0),
            Self::RS03 => (20.0, 33.0, 60.0),
            Self::RS04 => (15.0, 33.0, 120.0),
            Self::RS05 => (50.0, 50.0, 5.5),
            Self::RS06 => (50.0, 50.0, 36.0),
            Self::EL05 => (50.0, 50.0, 6.0),
            Self::CyberGear => (30.0, 30.0, 12.0),
        }
    }
}

/// The keys of `driver = "robstride"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct RobstrideOptions {
    /// Its model, for the defaults of other keys.
    pub model: Option<RobstrideModel>,
    /// Its protocol; default the private one.
    pub protocol: RobstrideProtocol,
    /// The host to which it answers; default 0xFD.
    pub host_id: u8,
    /// End of the range of positions \[rad\]; default 4 pi.
    pub position_max: f64,
    /// End of the range of velocities \[rad/s\]; default: the model's.
    pub velocity_max: Option<f64>,
    /// End of the range of torques \[Nm\]; default: the model's.
    pub torque_max: Option<f64>,
    /// Period of questions for the parameters \[ms\]; default: none are sent.
    pub request_period_ms: Option<u32>,
    /// Torque of the output shaft per current \[Nm/A\]; default: none follows from the current.
    pub torque_constant: Option<f64>,
    /// Period of a simulated motor \[ms\]; default 10.
    pub period_ms: u32,
}

impl Default for RobstrideOptions {
    fn default() -> Self {
        Self {
            model: None,
            protocol: RobstrideProtocol::Private,
            host_id: 0xFD,
            position_max: 2.0 * TAU,
            velocity_max: None,
            torque_max: None,
            request_period_ms: None,
            torque_constant: None,
            period_ms: 10,
        }
    }
}

/// The keys of a motor, checked.
#[derive(Debug, Clone, Copy)]
pub(super) struct RobstrideKeys {
    pub(super) address: u8,
    pub(super) host: u8,
    pub(super) protocol: RobstrideProtocol,
    /// Position, velocity, torque.
    pub(super) scales: [Scale; 3],
    /// The faults that concern the position.
    pub(super) encoder: u32,
    pub(super) request_period: Option<Nanos>,
    pub(super) torque_constant: Option<f64>,
    pub(super) period: Nanos,
}

impl RobstrideKeys {
    pub(super) fn new(spec: &Spec, options: &RobstrideOptions) -> Result<Self, SpecError> {
        let address = address(spec, 1..=0xFD)?;
        let (protocol, host) = (options.protocol, options.host_id);
        if host == address {
            let expected = "0 to 255, and not the motor's address";
            return Err(SpecError::key("host_id", host, expected));
        }
        if options.request_period_ms.is_some() && protocol == RobstrideProtocol::Mit {
            let expected =
                "left out with protocol = \"mit\": it has no question that is no command";
            return Err(SpecError::keys("request_period_ms", expected));
        }
        let ranges = options.model.map(RobstrideModel::ranges);
        let of_model = ranges.map(|(private, mit, _)| match protocol {
            RobstrideProtocol::Private => private,
            RobstrideProtocol::Mit => mit,
        });
        let position = above_zero("position_max", options.position_max)?;
        let velocity = known("velocity_max", options.velocity_max, of_model)?;
        let of_model = ranges.map(|(.., torque)| torque);
        let torque = known("torque_max", options.torque_max, of_model)?;
        let bits = match protocol {
            RobstrideProtocol::Private => 16,
            RobstrideProtocol::Mit => 12,
        };
        let encoder = fault::NOT_CALIBRATED | fault::MAGNETIC_ENCODER | fault::STATE_NOT_CALIBRATED;
        let encoder = encoder
            | match options.model {
                Some(RobstrideModel::CyberGear) => fault::HALL_ENCODER,
                _ => fault::NOT_INITIALISED,
            };
        Ok(Self {
            address,
            host,
            protocol,
            scales: [
                Scale::range(position, 16),
                Scale::range(velocity, bits),
                Scale::range(torque, bits),
            ],
            encoder,
            request_period: stated_duration("request_period_ms", options.request_period_ms)?,
            torque_constant: stated("torque_constant", options.torque_constant)?,
            period: duration("period_ms", options.period_ms)?,
        })
    }
}
