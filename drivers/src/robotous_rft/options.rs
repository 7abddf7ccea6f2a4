//! The keys of a sensor in gateway.toml, for both sides of the driver.

use super::protocol::{RATES, RftIds};
use crate::{Id, Spec, SpecError, keys};
use serde::Deserialize;

/// The models, which differ in their scales.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
pub enum RftModel {
    /// RFT40-SA01.
    #[default]
    #[serde(rename = "RFT40-SA01")]
    Rft40Sa01,
    /// RFT44-SB01.
    #[serde(rename = "RFT44-SB01")]
    Rft44Sb01,
    /// RFT60-HA01.
    #[serde(rename = "RFT60-HA01")]
    Rft60Ha01,
    /// RFT64-SB01.
    #[serde(rename = "RFT64-SB01")]
    Rft64Sb01,
    /// RFT64-6A01.
    #[serde(rename = "RFT64-6A01")]
    Rft64A01,
    /// RFT76-HA01.
    #[serde(rename = "RFT76-HA01")]
    Rft76Ha01,
    /// RFT80-6A01.
    #[serde(rename = "RFT80-6A01")]
    Rft80A01,
    /// RFT80-6A02.
    #[serde(rename = "RFT80-6A02")]
    Rft80A02,
    /// RFT80-6A03.
    #[serde(rename = "RFT80-6A03")]
    Rft80A03,
}

impl RftModel {
    /// Their names, in the order of the variants.
    pub(super) const NAMES: [&'static str; 9] = [
        "RFT40-SA01",
        "RFT44-SB01",
        "RFT60-HA01",
        "RFT64-SB01",
        "RFT64-6A01",
        "RFT76-HA01",
        "RFT80-6A01",
        "RFT80-6A02",
        "RFT80-6A03",
    ];

    /// Steps per N for forces, per Nm for torques.
    pub(super) const fn divisors(self) -> [f64; 6] {
        let (force, torque) = match self {
            Self::Rft40Sa01
            | Self::Rft44Sb01
            | Self::Rft60Ha01
            | Self::Rft64Sb01
            | Self::Rft76Ha01 => (50.0, 2000.0),
            Self::Rft64A01 | Self::Rft80A01 | Self::Rft80A02 => (50.0, 1000.0),
            Self::Rft80A03 => (25.0, 500.0),
        };
        [force, force, force, torque, torque, torque]
    }
}

/// The keys of `driver = "robotous_rft"`.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct RobotousRftOptions {
    /// The model; default RFT40-SA01.
    pub model: RftModel,
    /// Readings per second \[Hz\], one of the sensor's; default 200.
    pub rate_hz: u32,
    /// Identifier of a response's first frame, 1 to 255; default 1.
    pub id_first: u16,
    /// Identifier of its second frame; default 2.
    pub id_second: u16,
}

impl Default for RobotousRftOptions {
    fn default() -> Self {
        Self {
            model: RftModel::default(),
            rate_hz: 200,
            id_first: 1,
            id_second: 2,
        }
    }
}

impl RobotousRftOptions {
    pub(super) fn ids(&self, spec: &Spec) -> Result<RftIds, SpecError> {
        let expected = "from 1 to 255";
        let ids = RftIds {
            command: Id::standard(keys::address(spec, 1..=255)?),
            first: keys::id("id_first", self.id_first, 1..=255, expected)?,
            second: keys::id("id_second", self.id_second, 1..=255, expected)?,
        };
        if ids.first == ids.second || ids.command == ids.first || ids.command == ids.second {
            let expected = "another identifier than id_first, and both others than address";
            return Err(SpecError::keys("id_second", expected));
        }
        Ok(ids)
    }

    pub(super) fn rate_code(&self) -> Result<u8, SpecError> {
        let found = RATES.iter().find(|(hz, _)| *hz == self.rate_hz);
        found.map(|(_, code)| *code).ok_or(SpecError::key(
            "rate_hz",
            self.rate_hz,
            "10, 20, 50, 100, 200, 300, 333, 500 or 1000",
        ))
    }
}
