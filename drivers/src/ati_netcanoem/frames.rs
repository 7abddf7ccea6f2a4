//! The bytes of the board's frames, which both sides use.

use crate::Id;
use serde::Deserialize;

/// Opcodes: the low bits of the identifiers.
pub(super) mod opcode {
    pub(crate) const GAUGES: u8 = 0;
    pub(crate) const GAUGES_SECOND: u8 = 1;
    pub(crate) const MATRIX: u8 = 2;
    pub(crate) const MATRIX_LAST: u8 = 4;
    pub(crate) const SERIAL: u8 = 5;
    pub(crate) const SELECT: u8 = 6;
    pub(crate) const COUNTS: u8 = 7;
    pub(crate) const UNITS: u8 = 8;
}

/// The highest base.
pub(super) const BASE_MOST: u8 = 0x7F;

/// Bits of the status that concern the measurement.
pub(super) const STATUS_FAULTS: u16 = 0b1_1001_1111_1111;
/// An error of the bus, and the bit that is set with any error.
pub(super) const STATUS_BUS: u16 = 1 << 14;
pub(super) const STATUS_ANY: u16 = 1 << 15;

/// The identifier of `opcode`.
pub(super) fn id(base: u8, opcode: u8) -> Id {
    Id::standard(u16::from(base) << 4 | u16::from(opcode))
}

/// The opcode of `id`, if it is one of the board at `base`.
pub(super) fn opcode_of(id: Id, base: u8) -> Option<u8> {
    match id {
        Id::Standard(raw) if raw >> 4 == u16::from(base) => Some(raw.to_le_bytes()[0] & 0xF),
        _ => None,
    }
}

/// A unit of force.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
pub enum ForceUnit {
    /// Pound-force.
    #[serde(rename = "lbf")]
    PoundForce = 1,
    /// Newton.
    #[serde(rename = "N")]
    Newton = 2,
    /// 1000 pound-force.
    #[serde(rename = "klbf")]
    KilopoundForce = 3,
    /// Kilonewton.
    #[serde(rename = "kN")]
    Kilonewton = 4,
    /// Kilogram-force.
    #[serde(rename = "kgf")]
    KilogramForce = 5,
    /// Gram-force.
    #[serde(rename = "gf")]
    GramForce = 6,
}

impl ForceUnit {
    const ALL: [Self; 6] = [
        Self::PoundForce,
        Self::Newton,
        Self::KilopoundForce,
        Self::Kilonewton,
        Self::KilogramForce,
        Self::GramForce,
    ];

    /// The unit with number `code` in the protocol.
    #[must_use]
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|unit| *unit as u8 == code)
    }

    /// One of it \[N\].
    #[must_use]
    pub const fn newton(self) -> f64 {
        match self {
            Self::PoundForce => 4.448_221_615_260_5,
            Self::Newton => 1.0,
            Self::KilopoundForce => 4_448.221_615_260_5,
            Self::Kilonewton => 1000.0,
            Self::KilogramForce => 9.806_65,
            Self::GramForce => 9.806_65e-3,
        }
    }
}

/// A unit of torque.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema, serde::Serialize))]
pub enum TorqueUnit {
    /// Pound-force inch.
    #[serde(rename = "lbf-in")]
    PoundForceInch = 1,
    /// Pound-force foot.
    #[serde(rename = "lbf-ft")]
    PoundForceFoot = 2,
    /// Newton metre.
    #[serde(rename = "Nm")]
    NewtonMetre = 3,
    /// Newton millimetre.
    #[serde(rename = "Nmm")]
    NewtonMillimetre = 4,
    /// Kilogram-force centimetre.
    #[serde(rename = "kgf-cm")]
    KilogramForceCentimetre = 5,
    /// Kilonewton metre.
    #[serde(rename = "kNm")]
    KilonewtonMetre = 6,
}

impl TorqueUnit {
    const ALL: [Self; 6] = [
        Self::PoundForceInch,
        Self::PoundForceFoot,
        Self::NewtonMetre,
        Self::NewtonMillimetre,
        Self::KilogramForceCentimetre,
        Self::KilonewtonMetre,
    ];

    /// The unit with number `code` in the protocol.
    #[must_use]
    pub fn from_code(code: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|unit| *unit as u8 == code)
    }

    /// One of it \[Nm\].
    #[must_use]
    pub const fn newton_metre(self) -> f64 {
        match self {
            Self::PoundForceInch => 0.112_984_829_027_616_7,
            Self::PoundForceFoot => 1.355_817_948_331_400_4,
            Self::NewtonMetre => 1.0,
            Self::NewtonMillimetre => 1e-3,
            Self::KilogramForceCentimetre => 0.098_066_5,
            Self::KilonewtonMetre => 1000.0,
        }
    }
}
