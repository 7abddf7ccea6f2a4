//! The keys of the sensor in gateway.toml.

use super::frames::{BASE_MOST, ForceUnit, TorqueUnit};
use crate::{Spec, SpecError, keys};
use alloc::boxed::Box;
use proprio_topics::Nanos;
use serde::Deserialize;

/// The keys of `driver = "ati_netcanoem"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct AtiNetcanoemOptions {
    /// Period of the requests \[ms\], 1 to 1000; default 2.
    pub period_ms: u32,
    /// The calibration to select at start; default: the one in use.
    pub calibration: Option<u8>,
    /// Counts per unit of force; default the sensor's.
    pub counts_per_force: Option<f64>,
    /// Counts per unit of torque; default the sensor's.
    pub counts_per_torque: Option<f64>,
    /// Unit of the forces; default the sensor's.
    pub force_unit: Option<ForceUnit>,
    /// Unit of the torques; default the sensor's.
    pub torque_unit: Option<TorqueUnit>,
    /// Calibration matrix, row by row; default the sensor's.
    pub matrix: Option<Box<[[f64; 6]; 6]>>,
}

impl Default for AtiNetcanoemOptions {
    fn default() -> Self {
        Self {
            period_ms: 2,
            calibration: None,
            counts_per_force: None,
            counts_per_torque: None,
            force_unit: None,
            torque_unit: None,
            matrix: None,
        }
    }
}

impl AtiNetcanoemOptions {
    /// Base and period.
    pub(super) fn check(&self, spec: &Spec) -> Result<(u8, Nanos), SpecError> {
        let base = keys::address(spec, 0..=BASE_MOST)?;
        let period = keys::ms("period_ms", self.period_ms, 1..=1000, "1 to 1000")?;
        if let Some(calibration) = self.calibration {
            keys::within("calibration", calibration, 0..=15, "0 to 15")?;
        }
        for (name, value) in [
            ("counts_per_force", self.counts_per_force),
            ("counts_per_torque", self.counts_per_torque),
        ] {
            if let Some(value) = value.filter(|value| !(*value > 0.0 && value.is_finite())) {
                return Err(SpecError::key(name, value, "above 0"));
            }
        }
        pair(
            ("counts_per_force", self.counts_per_force.is_some()),
            ("counts_per_torque", self.counts_per_torque.is_some()),
        )?;
        pair(
            ("force_unit", self.force_unit.is_some()),
            ("torque_unit", self.torque_unit.is_some()),
        )?;
        if let Some(matrix) = &self.matrix
            && !matrix.iter().all(is_row)
        {
            let expected = "six rows of six finite numbers, none of them only zeros";
            return Err(SpecError::keys("matrix", expected));
        }
        Ok((base, period))
    }

    /// Both counts, if given.
    pub(super) fn counts(&self) -> Option<[f64; 2]> {
        Some([self.counts_per_force?, self.counts_per_torque?])
    }

    /// Both units in SI, if given.
    pub(super) fn units(&self) -> Option<[f64; 2]> {
        Some([self.force_unit?.newton(), self.torque_unit?.newton_metre()])
    }
}

/// Whether numbers can be a row of a calibration matrix.
pub(super) fn is_row(row: &[f64; 6]) -> bool {
    row.iter().all(|x| x.is_finite()) && row.iter().any(|x| *x != 0.0)
}

/// Two keys that belong together.
fn pair(a: (&'static str, bool), b: (&'static str, bool)) -> Result<(), SpecError> {
    match (a, b) {
        ((given, true), (missing, false)) | ((missing, false), (given, true)) => {
            Err(SpecError::Incomplete { given, missing })
        }
        _ => Ok(()),
    }
}
