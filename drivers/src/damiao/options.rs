//! The keys of a motor in gateway.toml, for both sides of the driver.

use crate::keys::{address, duration, stated, stated_duration};
use crate::{Id, Spec, SpecError};
use proprio_topics::Nanos;
use serde::Deserialize;

/// A model, for its ranges.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[allow(missing_docs)] // the names say it
#[allow(non_camel_case_types)]
pub enum DamiaoModel {
    DM4310,
    DM4310_48V,
    DM4340,
    DM4340_48V,
    DM6006,
    DM8006,
    DM8009,
    DM10010L,
    DM10010,
    DMH3510,
    DMH6215,
    DMG6220,
}

impl DamiaoModel {
    /// Ends of the ranges of position \[rad\], velocity \[rad/s\] and torque \[Nm\].
    const fn ranges(self) -> [f64; 3] {
        let (velocity, torque) = match self {
            Self::DM4310 => (30.0, 10.0),
            Self::DM4310_48V => (50.0, 10.0),
            Self::DM4340 => (8.0, 28.0),
            Self::DM4340_48V => (10.0, 28.0),
            Self::DM6006 => (45.0, 20.0),
            Self::DM8006 => (45.0, 40.0),
            Self::DM8009 => (45.0, 54.0),
            Self::DM10010L => (25.0, 200.0),
            Self::DM10010 => (20.0, 200.0),
            Self::DMH3510 => (280.0, 1.0),
            Self::DMH6215 | Self::DMG6220 => (45.0, 10.0),
        };
        [12.5, velocity, torque]
    }
}

/// The keys of `driver = "damiao"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct DamiaoOptions {
    /// Its model, for ranges that neither a key nor the motor tells.
    pub model: Option<DamiaoModel>,
    /// Identifier of its frames, 0 to 0x7FE; default 0.
    pub host_id: u16,
    /// End of the range of positions \[rad\].
    pub position_max: Option<f64>,
    /// End of the range of velocities \[rad/s\].
    pub velocity_max: Option<f64>,
    /// End of the range of torques \[Nm\].
    pub torque_max: Option<f64>,
    /// Period of questions for the state \[ms\]; default: none are sent.
    pub request_period_ms: Option<u32>,
    /// Whether questions are CAN FD frames; default false.
    pub fd: bool,
    /// Period of a simulated motor \[ms\]; default 5.
    pub period_ms: u32,
}

impl Default for DamiaoOptions {
    fn default() -> Self {
        Self {
            model: None,
            host_id: 0,
            position_max: None,
            velocity_max: None,
            torque_max: None,
            request_period_ms: None,
            fd: false,
            period_ms: 5,
        }
    }
}

/// The keys of a motor, checked.
#[derive(Debug, Clone, Copy)]
pub(super) struct DamiaoKeys {
    pub(super) address: u8,
    /// Of the motor's frames.
    pub(super) id: Id,
    pub(super) fd: bool,
    /// The ends of the ranges that keys state, and those of the model: position, velocity, torque.
    pub(super) stated: [Option<f64>; 3],
    pub(super) of_model: [Option<f64>; 3],
    pub(super) request_period: Option<Nanos>,
    pub(super) period: Nanos,
}

impl DamiaoKeys {
    pub(super) fn new(spec: &Spec, options: &DamiaoOptions) -> Result<Self, SpecError> {
        let address = address(spec, 1..=0xFF)?;
        if options.host_id > 0x7FE || options.host_id == u16::from(address) {
            let expected = "0 to 0x7FE (2046), and not the motor's address";
            return Err(SpecError::key("host_id", options.host_id, expected));
        }
        let stated = [
            stated("position_max", options.position_max)?,
            stated("velocity_max", options.velocity_max)?,
            stated("torque_max", options.torque_max)?,
        ];
        let of_model = match options.model {
            Some(model) => model.ranges().map(Some),
            None => [None; 3],
        };
        let request_period = stated_duration("request_period_ms", options.request_period_ms)?;
        let known = |(stated, model): (&Option<f64>, &Option<f64>)| stated.or(*model).is_some();
        if request_period.is_none() && !stated.iter().zip(&of_model).all(known) {
            return Err(SpecError::Keys {
                key: "model",
                expected: "given, or position_max, velocity_max and torque_max, or \
                           request_period_ms, with which the motor is asked",
            });
        }
        Ok(Self {
            address,
            id: Id::standard(options.host_id),
            fd: options.fd,
            stated,
            of_model,
            request_period,
            period: duration("period_ms", options.period_ms)?,
        })
    }
}
