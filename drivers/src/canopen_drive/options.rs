//! The keys of a drive in gateway.toml.

use crate::SpecError;
use crate::objects::Objects;
use alloc::string::String;
use alloc::vec::Vec;
use core::f64::consts::TAU;
use serde::Deserialize;

/// The unit of object 606C.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub enum VelocityUnit {
    /// Counts per second.
    #[default]
    #[serde(rename = "counts/s")]
    Counts,
    /// A tenth of it.
    #[serde(rename = "0.1 counts/s")]
    TenthCounts,
    /// Turns per minute.
    #[serde(rename = "rpm")]
    TurnsPerMinute,
    /// A tenth of it.
    #[serde(rename = "0.1 rpm")]
    TenthTurnsPerMinute,
}

impl VelocityUnit {
    /// One of it \[rad/s\], with so many counts per turn.
    pub(super) fn rad_per_s(self, counts_per_turn: f64) -> f64 {
        match self {
            Self::Counts => TAU / counts_per_turn,
            Self::TenthCounts => 0.1 * TAU / counts_per_turn,
            Self::TurnsPerMinute => TAU / 60.0,
            Self::TenthTurnsPerMinute => 0.1 * TAU / 60.0,
        }
    }
}

/// The unit of object 6078.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
pub enum CurrentUnit {
    /// A thousandth of the rated current.
    #[default]
    #[serde(rename = "per_mille")]
    PerMille,
    /// Milliampere.
    #[serde(rename = "mA")]
    Milliampere,
}

/// The mapping of one TPDO.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PdoKeys {
    /// 1 to 4.
    pub number: u8,
    /// Its objects, in their order.
    pub objects: Vec<u16>,
    /// After each n-th SYNC; 0, the default: by events or a timer.
    #[serde(default)]
    pub sync: u8,
    /// Its identifier; default that of CiA 301.
    pub id: Option<u16>,
}

/// The keys of `driver = "canopen_drive"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Counts per turn of the motor; default the drive's own.
    pub counts_per_turn: Option<f64>,
    /// Unit of the velocity; default counts per second.
    pub velocity_unit: VelocityUnit,
    /// Rated torque \[Nm\]; default the drive's own.
    pub rated_torque: Option<f64>,
    /// Rated current \[A\]; default the drive's own.
    pub rated_current: Option<f64>,
    /// Unit of the current; default a thousandth of the rated one.
    pub current_unit: CurrentUnit,
    /// How long a value of another TPDO is used \[ms\]; default 100.
    pub hold_ms: f64,
    /// The mapping; default the drive's own.
    pub pdos: Vec<PdoKeys>,
    /// The EDS or DCF file, relative to the configuration.
    pub eds: Option<String>,
    /// The contents of `eds`, which the gateway reads.
    #[serde(skip)]
    pub objects: Option<Objects>,
    /// Period of a simulated drive \[ms\]; default 10.
    pub period_ms: u32,
    /// After each n-th SYNC a simulated drive sends; 0, the default: by a timer.
    pub sync: u8,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            counts_per_turn: None,
            velocity_unit: VelocityUnit::Counts,
            rated_torque: None,
            rated_current: None,
            current_unit: CurrentUnit::PerMille,
            hold_ms: 100.0,
            pdos: Vec::new(),
            eds: None,
            objects: None,
            period_ms: 10,
            sync: 0,
        }
    }
}

impl Options {
    pub(super) fn check(&self) -> Result<(), SpecError> {
        for (key, value) in [
            ("counts_per_turn", self.counts_per_turn),
            ("rated_torque", self.rated_torque),
            ("rated_current", self.rated_current),
        ] {
            if let Some(value) = value.filter(|value| !(*value > 0.0 && value.is_finite())) {
                let expected = "above 0";
                return Err(SpecError::Key {
                    key,
                    value,
                    expected,
                });
            }
        }
        let (key, value, expected) = if !(0.0..=60_000.0).contains(&self.hold_ms) {
            ("hold_ms", self.hold_ms, "0 to 60000")
        } else if !(1..=65_535).contains(&self.period_ms) {
            ("period_ms", f64::from(self.period_ms), "1 to 65535")
        } else if self.sync > 240 {
            ("sync", f64::from(self.sync), "0 to 240")
        } else {
            return Ok(());
        };
        Err(SpecError::Key {
            key,
            value,
            expected,
        })
    }
}
