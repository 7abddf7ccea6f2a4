//! The keys of a unit in gateway.toml, for both sides of the driver.

use super::protocol::{DEFAULT_FILTER, FILTERS, OptoIds, OptoSettings, RATES, ZERO_HERE, ZERO_OWN};
use crate::{Id, Spec, SpecError, keys, wrench};
use serde::Deserialize;

/// The keys of `driver = "optoforce_daq"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct OptoforceDaqOptions {
    /// Steps per N of fx fy fz. Needed.
    #[serde(deserialize_with = "wrench::three")]
    pub counts_per_newton: Option<[f64; 3]>,
    /// Readings per second \[Hz\]; default: the unit is not configured.
    pub rate_hz: Option<u32>,
    /// Cut-off frequency of the unit's filter \[Hz\], 0 for none; default 15.
    pub filter_hz: Option<f64>,
    /// Whether each start takes the present load as the zero; default false.
    pub zero: Option<bool>,
    /// Whether the second frame of a configuration has 8 bytes; default true.
    pub fill: bool,
    /// Identifier of the configuration; default 0x101.
    pub id_config: u16,
}

impl Default for OptoforceDaqOptions {
    fn default() -> Self {
        Self {
            counts_per_newton: None,
            rate_hz: None,
            filter_hz: None,
            zero: None,
            fill: true,
            id_config: 0x101,
        }
    }
}

impl OptoforceDaqOptions {
    pub(super) fn scale(&self) -> Result<[f64; 3], SpecError> {
        let key = "counts_per_newton";
        let expected = "three numbers above 0, from the sensor's sensitivity report";
        let Some(counts) = self.counts_per_newton else {
            return Err(SpecError::keys(key, expected));
        };
        match counts.iter().find(|n| !(n.is_finite() && **n > 0.0)) {
            Some(&value) => Err(SpecError::key(key, value, expected)),
            None => Ok(counts),
        }
    }

    pub(super) fn settings(&self) -> Result<Option<OptoSettings>, SpecError> {
        let Some(rate) = self.rate_hz else {
            let given = match (self.filter_hz, self.zero) {
                (None, None) => return Ok(None),
                (Some(_), _) => "filter_hz",
                (None, Some(_)) => "zero",
            };
            let missing = "rate_hz";
            return Err(SpecError::Incomplete { given, missing });
        };
        let speed = RATES.iter().find(|(hz, _)| *hz == rate);
        let &(_, speed) =
            speed.ok_or(SpecError::key("rate_hz", rate, "10, 30, 100, 333 or 1000"))?;
        let value = self.filter_hz.unwrap_or(DEFAULT_FILTER);
        let filter = (0..).zip(FILTERS).find(|(_, hz)| *hz == value);
        let (filter, _) = filter.ok_or(SpecError::key(
            "filter_hz",
            value,
            "0, 1.5, 5, 15, 50, 150 or 500",
        ))?;
        let zero = match self.zero {
            Some(true) => ZERO_HERE,
            _ => ZERO_OWN,
        };
        Ok(Some(OptoSettings {
            speed,
            filter,
            zero,
        }))
    }

    pub(super) fn ids(&self, spec: &Spec) -> Result<OptoIds, SpecError> {
        let address = keys::address(spec, 0..=0x7FF)?;
        let expected = "from 0 to 0x7FF";
        let ids = OptoIds {
            data: Id::standard(address),
            config: keys::id("id_config", self.id_config, 0..=0x7FF, expected)?,
        };
        if ids.data == ids.config {
            let expected = "another identifier than address";
            return Err(SpecError::keys("id_config", expected));
        }
        Ok(ids)
    }
}
