//! The keys of a drive in gateway.toml.

use crate::objects::Objects;
use crate::{SpecError, keys};
use alloc::string::String;
use alloc::vec::Vec;
use core::f64::consts::TAU;
use serde::Deserialize;

/// The unit of object 606C.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
pub enum VelocityUnit {
    /// Counts per second.
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
    pub(super) const fn unit(self) -> StepUnit {
        match self {
            Self::Counts => StepUnit::Positions(1.0),
            Self::TenthCounts => StepUnit::Positions(0.1),
            Self::TurnsPerMinute => StepUnit::Radians(TAU / 60.0),
            Self::TenthTurnsPerMinute => StepUnit::Radians(0.1 * TAU / 60.0),
        }
    }
}

/// A unit of positions, or of velocities per second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum StepUnit {
    /// So many steps of the position (of a position: counts).
    Positions(f64),
    /// So many radians.
    Radians(f64),
}

impl StepUnit {
    /// The unit that objects 60A8 (position) and 60A9 (velocity) code: a power of ten, a unit, and
    /// the time that it is divided by (CiA 303-2). `None`: not an angle, or unknown.
    pub(super) fn of_code(code: u32) -> Option<Self> {
        let [_, over, of, power] = code.to_le_bytes();
        let seconds = match over {
            0 | 0x03 => 1.0,
            0x47 => 60.0,
            _ => return None,
        };
        let factor = libm::pow(10.0, f64::from(power.cast_signed())) / seconds;
        match of {
            0x10 => Some(Self::Radians(factor)),
            0x41 => Some(Self::Radians(factor * TAU / 360.0)),
            0xB4 => Some(Self::Radians(factor * TAU)),
            0xB5 => Some(Self::Positions(factor)),
            _ => None,
        }
    }

    /// It \[rad\], where one step of the position is `position` \[rad\].
    pub(super) const fn radians(self, position: f64) -> f64 {
        match self {
            Self::Positions(steps) => steps * position,
            Self::Radians(radians) => radians,
        }
    }
}

/// The unit of object 6076.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
pub enum RatedTorqueUnit {
    /// Of CiA 402: a thousandth of a newton metre.
    #[serde(rename = "mNm")]
    Milli,
    /// A millionth.
    #[serde(rename = "uNm")]
    Micro,
}

impl RatedTorqueUnit {
    /// That of a maker. maxon's EPOS4 has millionths: of its file, 512871 is the product of 4.760 A
    /// (object 3001 sub 1) and 107746 uNm/A (sub 5).
    pub(super) const fn of_vendor(vendor: Option<u32>) -> Self {
        const MAXON: u32 = 0xFB;
        match vendor {
            Some(MAXON) => Self::Micro,
            _ => Self::Milli,
        }
    }

    /// One of it \[Nm\].
    pub(super) const fn newton_metres(self) -> f64 {
        match self {
            Self::Milli => 1e-3,
            Self::Micro => 1e-6,
        }
    }
}

/// The unit of object 6078.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
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
#[cfg_attr(test, derive(schemars::JsonSchema))]
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
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct CanopenDriveOptions {
    /// Counts per turn of the motor; default the drive's own.
    pub counts_per_turn: Option<f64>,
    /// Unit of the velocity; default the drive's own, else counts per second.
    pub velocity_unit: Option<VelocityUnit>,
    /// Rated torque \[Nm\]; default the drive's own.
    pub rated_torque: Option<f64>,
    /// Unit of the drive's own; default its maker's.
    pub rated_torque_unit: Option<RatedTorqueUnit>,
    /// Rated current \[A\]; default the drive's own.
    pub rated_current: Option<f64>,
    /// Unit of the current; default a thousandth of the rated one.
    pub current_unit: CurrentUnit,
    /// How long a value of another TPDO is used \[ms\]; default 100.
    pub hold_ms: f64,
    /// The mapping; default the drive's own.
    pub pdos: Vec<PdoKeys>,
    /// Set the drive to `pdos`, or to the usual ones; default false.
    pub configure: bool,
    /// The EDS or DCF file, relative to the configuration.
    pub eds: Option<String>,
    /// The contents of `eds`, which the gateway reads.
    #[serde(skip)]
    pub objects: Option<Objects>,
    /// Period of a drive that is configured, or simulated \[ms\]; default 10.
    pub period_ms: u32,
    /// After each n-th SYNC it sends the usual ones; 0, the default: by a timer.
    pub sync: u8,
}

impl Default for CanopenDriveOptions {
    fn default() -> Self {
        Self {
            counts_per_turn: None,
            velocity_unit: None,
            rated_torque: None,
            rated_torque_unit: None,
            rated_current: None,
            current_unit: CurrentUnit::PerMille,
            hold_ms: 100.0,
            pdos: Vec::new(),
            configure: false,
            eds: None,
            objects: None,
            period_ms: 10,
            sync: 0,
        }
    }
}

impl CanopenDriveOptions {
    /// The process data that the keys state: none if the drive is to be asked.
    pub(super) fn pdos(&self) -> Vec<PdoKeys> {
        match self.configure && self.pdos.is_empty() {
            true => self.usual_pdos(),
            false => self.pdos.clone(),
        }
    }

    /// The process data that a drive is set to without `pdos`: status, position, mode; velocity.
    pub(super) fn usual_pdos(&self) -> Vec<PdoKeys> {
        let pdo = |number, objects: &[u16]| PdoKeys {
            number,
            objects: objects.to_vec(),
            sync: self.sync,
            id: None,
        };
        Vec::from([pdo(1, &[0x6041, 0x6064, 0x6061]), pdo(2, &[0x606C])])
    }

    pub(super) fn check(&self) -> Result<(), SpecError> {
        for (key, value) in [
            ("counts_per_turn", self.counts_per_turn),
            ("rated_torque", self.rated_torque),
            ("rated_current", self.rated_current),
        ] {
            if let Some(value) = value.filter(|value| !(*value > 0.0 && value.is_finite())) {
                return Err(SpecError::key(key, value, "above 0"));
            }
        }
        keys::within("hold_ms", self.hold_ms, 0.0..=60_000.0, "0 to 60000")?;
        keys::within("period_ms", self.period_ms, 1..=65_535, "1 to 65535")?;
        keys::within("sync", self.sync, 0..=240, "0 to 240")?;
        Ok(())
    }
}
