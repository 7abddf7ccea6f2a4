//! The keys of a board in gateway.toml, for both sides of the driver.

use crate::{SpecError, bytes, keys, wrench};
use proprio_topics::Nanos;
use serde::Deserialize;

/// The keys of `driver = "jr3_can"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct Jr3CanOptions {
    /// Full scale of fx fy fz \[N\]; default: the board's own.
    #[serde(deserialize_with = "wrench::three")]
    pub full_scale_n: Option<[f64; 3]>,
    /// Full scale of tx ty tz \[Nm\]; goes with `full_scale_n`.
    #[serde(deserialize_with = "wrench::three")]
    pub full_scale_nm: Option<[f64; 3]>,
    /// Period \[ms\], 1 to 1000; default 10.
    pub period_ms: u32,
    /// Cut-off frequency of the board's filter \[Hz\]; default 0, no filter.
    pub cutoff_hz: f64,
}

impl Default for Jr3CanOptions {
    fn default() -> Self {
        Self {
            full_scale_n: None,
            full_scale_nm: None,
            period_ms: 10,
            cutoff_hz: 0.0,
        }
    }
}

impl Jr3CanOptions {
    /// The configured full scale, force then torque.
    pub(super) fn full_scale(&self) -> Result<Option<[f64; 6]>, SpecError> {
        wrench::full_scale(self.full_scale_n, self.full_scale_nm, false)
    }

    pub(super) fn period(&self) -> Result<Nanos, SpecError> {
        keys::ms(
            "period_ms",
            self.period_ms,
            1..=1000,
            "an integer from 1 to 1000",
        )
    }

    /// The cut-off frequency in the start command.
    pub(super) fn cutoff(&self) -> Result<u16, SpecError> {
        let hz = keys::within(
            "cutoff_hz",
            self.cutoff_hz,
            0.0..=655.35,
            "from 0 to 655.35",
        )?;
        let hundredths = bytes::quantise(hz, 0.01, 0, u16::MAX.into());
        Ok(u16::try_from(hundredths).unwrap_or(u16::MAX))
    }
}
