//! Which bits of which TPDO are which quantity: from a drive's mapping.

use super::options::PdoKeys;
use crate::canopen::{Object, Pdo, is_free, tpdo};
use crate::objects::Objects;
use crate::signal::{Bits, Raw};
use crate::{Id, SpecError};
use arrayvec::ArrayVec;

/// Transmission by events and the timer. (Drives have 255, of the profile, rather than 254, of the
/// maker.)
const BY_EVENT: u8 = 255;

/// What a drive sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum DriveQuantity {
    Position,
    Velocity,
    Torque,
    Current,
    Status,
    Mode,
    Error,
}

impl DriveQuantity {
    /// The quantities that make a joint reading.
    pub(super) const JOINT: usize = 4;

    /// The quantity of an object, and the length of the object \[bits\].
    pub(super) const fn of(object: Object) -> Option<(Self, u8)> {
        if object.sub != 0 {
            return None;
        }
        match object.index {
            0x6064 | 0x6063 => Some((Self::Position, 32)),
            0x606C => Some((Self::Velocity, 32)),
            0x6077 => Some((Self::Torque, 16)),
            0x6078 => Some((Self::Current, 16)),
            0x6041 => Some((Self::Status, 16)),
            0x6061 => Some((Self::Mode, 8)),
            0x603F => Some((Self::Error, 16)),
            _ => None,
        }
    }

    const fn raw(self) -> Raw {
        match self {
            Self::Status | Self::Error => Raw::Unsigned,
            _ => Raw::Signed,
        }
    }
}

/// One number in a TPDO.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct MappedObject {
    pub(super) quantity: DriveQuantity,
    pub(super) bits: Bits,
    pub(super) raw: Raw,
}

/// The quantities of `pdo` that are used, and the length of its frames \[bytes\]. An object of
/// another length than the profile's is not used.
pub(super) fn fields(pdo: &Pdo) -> (ArrayVec<MappedObject, 8>, usize) {
    let (mut fields, mut end) = (ArrayVec::new(), 0);
    for (object, at, length) in pdo.objects() {
        if let Some((quantity, expected)) = DriveQuantity::of(object)
            && length == u64::from(expected)
            && let Some(bits) = Bits::new(at, length, false)
        {
            let raw = quantity.raw();
            let _ = fields.try_push(MappedObject {
                quantity,
                bits,
                raw,
            });
        }
        end = at + length;
    }
    (
        fields,
        usize::try_from(end.div_ceil(8)).unwrap_or(usize::MAX),
    )
}

fn has(pdo: &Pdo, wanted: DriveQuantity) -> bool {
    pdo.is_on() && fields(pdo).0.iter().any(|field| field.quantity == wanted)
}

/// All TPDOs of a drive.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct PdoMapping {
    pub(super) pdos: [Pdo; 4],
}

impl PdoMapping {
    /// As the keys state it, with the identifiers that CiA 301 gives a node.
    pub(super) fn of_keys(node: u8, pdos: &[PdoKeys]) -> Result<Self, SpecError> {
        let mut this = Self::default();
        for keys in pdos {
            let error = |expected| SpecError::keys("pdos", expected);
            let number = keys.number.wrapping_sub(1);
            let Some(pdo) = this.pdos.get_mut(usize::from(number)) else {
                return Err(error("numbers 1 to 4"));
            };
            if pdo.is_on() || keys.sync > 240 {
                return Err(error("each number once, with sync from 0 to 240"));
            }
            pdo.id = Some(keys.id.map_or(tpdo(node, number).raw(), u32::from));
            pdo.transmission = if keys.sync == 0 { BY_EVENT } else { keys.sync };
            let mut bits = 0;
            for index in &keys.objects {
                let object = Object::new(*index, 0);
                let Some((_, length)) = DriveQuantity::of(object) else {
                    return Err(error(
                        "of objects 0x6041, 0x6061, 0x6063, 0x6064, 0x606C, 0x6077, 0x6078, 0x603F",
                    ));
                };
                bits += u32::from(length);
                if let Some(entry) = pdo.mapping.get_mut(usize::from(pdo.count)) {
                    *entry = object.mapped(length);
                    pdo.count += 1;
                }
            }
            if bits > 64 || bits == 0 {
                return Err(error("of 1 to 8 bytes per number"));
            }
        }
        if !pdos.is_empty() && this.position().is_none() {
            return Err(SpecError::keys("pdos", "with a position, 0x6064 or 0x6063"));
        }
        if this.wrong_id().is_some() {
            let expected = "each with another id, from 0x181 to 0x580 or from 0x680 to 0x6DF";
            return Err(SpecError::keys("pdos", expected));
        }
        Ok(this)
    }

    /// As a file states it for `node`.
    pub(super) fn of_file(node: u8, file: &Objects) -> Self {
        Self {
            pdos: [0, 1, 2, 3].map(|number| Pdo::of_file(file, node, number)),
        }
    }

    /// The TPDO that has something of use, with its identifier, if another one has that, too, or
    /// CiA 301 keeps it for other things.
    pub(super) fn wrong_id(&self) -> Option<(usize, Id)> {
        let sent = |at: usize| self.pdos.get(at).and_then(Pdo::used_id);
        let of_use = (0..self.pdos.len()).filter(|at| {
            let pdo = self.pdos.get(*at);
            pdo.is_some_and(|pdo| !fields(pdo).0.is_empty())
        });
        of_use
            .filter_map(|at| Some((at, sent(at)?)))
            .find(|(at, id)| {
                let is_same = |other| other != *at && sent(other) == Some(*id);
                !is_free(*id) || (0..self.pdos.len()).any(is_same)
            })
    }

    /// The number of a TPDO that has the position, and is switched off.
    pub(super) fn off(&self) -> Option<u8> {
        let has_position = |pdo: &Pdo| {
            let (fields, _) = fields(pdo);
            fields.iter().any(|f| f.quantity == DriveQuantity::Position)
        };
        let mut pdos = (0..).zip(&self.pdos);
        let found = pdos.find(|(_, pdo)| pdo.is_off() && has_position(pdo));
        found.map(|(number, _)| number)
    }

    /// The number of the TPDO that has the position.
    pub(super) fn position(&self) -> Option<usize> {
        self.pdos
            .iter()
            .position(|pdo| has(pdo, DriveQuantity::Position))
    }

    /// Whether some TPDO has `wanted`.
    pub(super) fn has(&self, wanted: DriveQuantity) -> bool {
        self.pdos.iter().any(|pdo| has(pdo, wanted))
    }

    /// The identifiers of the TPDOs that have something of use.
    pub(super) fn ids(&self) -> impl Iterator<Item = Id> + '_ {
        let of_use = self.pdos.iter().filter(|pdo| !fields(pdo).0.is_empty());
        of_use.filter_map(Pdo::used_id)
    }

    /// The TPDOs that make one reading with a position, one bit each, if a SYNC causes them; and
    /// after how many.
    pub(super) fn group(&self) -> Option<(u8, u8)> {
        let has_position = |pdo: &&Pdo| pdo.by_sync() && has(pdo, DriveQuantity::Position);
        let every = self.pdos.iter().find(has_position)?.transmission;
        let belongs = |pdo: &Pdo| pdo.transmission == every && pdo.is_on() && values(pdo) > 0;
        Some((self.bits(belongs), every))
    }

    /// The TPDOs of which each makes a reading, one bit each: those with a position that no SYNC
    /// causes.
    pub(super) fn alone(&self) -> u8 {
        self.bits(|pdo| !pdo.by_sync() && has(pdo, DriveQuantity::Position))
    }

    fn bits(&self, which: impl Fn(&Pdo) -> bool) -> u8 {
        let bits = self.pdos.iter().enumerate();
        bits.fold(0, |all, (at, pdo)| all | u8::from(which(pdo)) << at)
    }
}

/// How many values of a joint a TPDO has.
pub(super) fn values(pdo: &Pdo) -> usize {
    let (fields, _) = fields(pdo);
    let is_joint = |field: &&MappedObject| (field.quantity as usize) < DriveQuantity::JOINT;
    fields.iter().filter(is_joint).count()
}
