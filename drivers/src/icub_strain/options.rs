//! The keys of an F/T board in gateway.toml, for both sides of the driver.

use crate::SpecError;
use crate::wrench;
use serde::Deserialize;

/// The streamed quantities.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
#[serde(rename_all = "snake_case")]
pub enum StrainStream {
    /// Wrenches.
    #[default]
    Calibrated,
    /// Raw gauges; needs no full scale.
    Uncalibrated,
    /// Both.
    Both,
}

impl StrainStream {
    /// The mode of SET_TXMODE.
    pub(super) const fn code(self) -> u8 {
        match self {
            Self::Calibrated => 0,
            Self::Uncalibrated => 3,
            Self::Both => 4,
        }
    }

    /// The stream of mode `code`; `None`: nothing is streamed.
    pub(super) const fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::Calibrated),
            3 => Some(Self::Uncalibrated),
            4 => Some(Self::Both),
            _ => None,
        }
    }
}

/// The keys of `driver = "icub_strain"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IcubStrainOptions {
    /// Full scale of fx fy fz \[N\]; default: the board's own.
    #[serde(deserialize_with = "wrench::three")]
    pub full_scale_n: Option<[f64; 3]>,
    /// Full scale of tx ty tz \[Nm\]; goes with `full_scale_n`.
    #[serde(deserialize_with = "wrench::three")]
    pub full_scale_nm: Option<[f64; 3]>,
    /// Period \[ms\], 1 to 255; default 10.
    pub period_ms: u32,
    /// The streamed quantities; default calibrated.
    pub stream: StrainStream,
    /// Period of the temperature \[s\], 1 to 255; default none.
    pub temperature_period_s: Option<u32>,
    /// Longest time from a force frame to its torque frame \[ms\]; default by the period.
    pub pair_timeout_ms: Option<f64>,
    /// Silence kept after power-on \[ms\]; default 0.
    pub power_on_silence_ms: u32,
}

impl Default for IcubStrainOptions {
    fn default() -> Self {
        Self {
            full_scale_n: None,
            full_scale_nm: None,
            period_ms: 10,
            stream: StrainStream::Calibrated,
            temperature_period_s: None,
            pair_timeout_ms: None,
            power_on_silence_ms: 0,
        }
    }
}

impl IcubStrainOptions {
    /// The configured full scale, force then torque.
    pub(super) fn full_scale(&self, zero_allowed: bool) -> Result<Option<[f64; 6]>, SpecError> {
        wrench::full_scale(self.full_scale_n, self.full_scale_nm, zero_allowed)
    }
}
