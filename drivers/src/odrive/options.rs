//! The keys of an axis in gateway.toml, for both sides of the driver.

use super::firmware::Firmware;
use super::frames::NODE_MOST;
use crate::keys::{address, duration, stated, stated_duration};
use crate::{Id, Spec, SpecError};
use proprio_topics::Nanos;
use serde::Deserialize;

/// The keys of `driver = "odrive"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct OdriveOptions {
    /// Its firmware; default 0.6.
    pub firmware: Firmware,
    /// Torque per current \[Nm/A\]; default: the torque that firmware 0.6 sends.
    pub torque_constant: Option<f64>,
    /// How long current and torque are used \[ms\]; default 100.
    pub hold_ms: u32,
    /// Period of requests \[ms\]; default: none are sent.
    pub request_period_ms: Option<u32>,
    /// Period of the estimates of a simulated device \[ms\]; default 10.
    pub period_ms: u32,
}

impl Default for OdriveOptions {
    fn default() -> Self {
        Self {
            firmware: Firmware::V0_6,
            torque_constant: None,
            hold_ms: 100,
            request_period_ms: None,
            period_ms: 10,
        }
    }
}

/// The keys of a device, checked.
#[derive(Debug, Clone, Copy)]
pub(super) struct OdriveKeys {
    pub(super) node: u16,
    pub(super) firmware: Firmware,
    pub(super) torque_constant: Option<f64>,
    pub(super) hold: Nanos,
    pub(super) request_period: Option<Nanos>,
    pub(super) period: Nanos,
}

impl OdriveKeys {
    pub(super) fn new(spec: &Spec, options: &OdriveOptions) -> Result<Self, SpecError> {
        let node = address(spec, 0..=NODE_MOST)?;
        Ok(Self {
            node,
            firmware: options.firmware,
            torque_constant: stated("torque_constant", options.torque_constant)?,
            hold: duration("hold_ms", options.hold_ms)?,
            request_period: stated_duration("request_period_ms", options.request_period_ms)?,
            period: duration("period_ms", options.period_ms)?,
        })
    }

    pub(super) const fn id(&self, command: u8) -> Id {
        Id::standard(self.node << 5 | command as u16)
    }

    /// The command of `id`, if it is a message of this axis that is read.
    pub(super) fn command(&self, id: Id) -> Option<u8> {
        let commands = self.firmware.commands();
        (commands.iter().copied()).find(|command| self.id(*command) == id)
    }
}
