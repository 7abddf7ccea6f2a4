//! What a drive is asked at its start: its profile, its mapping, and its scales.

use super::layout::{Layout, Quantity};
use super::options::{CurrentUnit, Options};
use crate::canopen::{MAPPED_MOST, Object, Plan, Step, object, tpdo};
use crate::objects::Objects;
use crate::{Id, Mode, SpecError};
use alloc::format;
use arrayvec::ArrayVec;
use proprio_topics::Refusal;

/// The profile of drives.
pub(super) const PROFILE: u32 = 402;
pub(super) const COUNTS: Object = Object::new(0x608F, 1);
pub(super) const TURNS: Object = Object::new(0x608F, 2);
/// \[mNm\]
pub(super) const RATED_TORQUE: Object = Object::new(0x6076, 0);
/// \[mA\]
pub(super) const RATED_CURRENT: Object = Object::new(0x6075, 0);

/// Entries that are read of each TPDO: identifier, transmission, number of mapped objects, these.
const PER_PDO: usize = 3 + MAPPED_MOST as usize;
/// The first step after all TPDOs.
const SCALES: usize = 1 + 4 * PER_PDO;

/// What a drive, or its file, tells of its scales.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Told {
    counts: Option<f64>,
    turns: Option<f64>,
    /// \[Nm\]
    pub(super) rated_torque: Option<f64>,
    /// \[A\]
    pub(super) rated_current: Option<f64>,
}

impl Told {
    /// What `file` tells of this very drive. (The scales of an EDS are those of some motor.)
    pub(super) fn of_file(file: Option<&Objects>) -> Self {
        let own = |object: Object, unit| {
            let number = file?.own(object.index, object.sub)?;
            Some(f64::from(number) * unit)
        };
        let counts = own(COUNTS, 1.0);
        Self {
            counts,
            turns: own(TURNS, 1.0).or(counts.map(|_| 1.0)),
            rated_torque: own(RATED_TORQUE, 1e-3),
            rated_current: own(RATED_CURRENT, 1e-3),
        }
    }

    pub(super) fn counts_per_turn(&self) -> Option<f64> {
        Some(self.counts? / self.turns?)
    }

    /// The value of `object`.
    const fn value(&mut self, object: Object) -> Option<&mut Option<f64>> {
        match object {
            COUNTS => Some(&mut self.counts),
            TURNS => Some(&mut self.turns),
            RATED_TORQUE => Some(&mut self.rated_torque),
            RATED_CURRENT => Some(&mut self.rated_current),
            _ => None,
        }
    }

    /// These values, and those of `other` where there are none.
    fn or(self, other: Self) -> Self {
        Self {
            counts: self.counts.or(other.counts),
            turns: self.turns.or(other.turns),
            rated_torque: self.rated_torque.or(other.rated_torque),
            rated_current: self.rated_current.or(other.rated_current),
        }
    }
}

/// Mapping and scales of a drive: those of the keys, else what the drive says, else what its file
/// says.
#[derive(Debug)]
pub(super) struct Start {
    options: Options,
    /// The mapping is that of the keys.
    configured: bool,
    /// What is used until the drive says it: nothing, if it is asked.
    initial: (Layout, Told),
    pub(super) layout: Layout,
    /// The identifiers of TPDOs that are received.
    pub(super) ids: ArrayVec<Id, 4>,
    file: Told,
    told: Told,
}

/// SI units per step of what a drive sends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scales {
    /// In the order of [`Quantity`]: position, velocity, torque, current.
    pub(super) per_step: [f64; Quantity::JOINT],
}

impl Start {
    pub(super) fn new(node: u8, mode: Mode, options: &Options) -> Result<Self, SpecError> {
        let configured = !options.pdos.is_empty();
        let of_keys = Layout::of_keys(node, options)?;
        let stated = match &options.objects {
            Some(file) if !configured => Layout::of_file(node, file),
            _ => of_keys,
        };
        if let Some(id) = stated.wrong_id() {
            return Err(SpecError::Description(format!(
                "its file gives a TPDO the identifier {id}, which another one, or CiA 301 itself, \
                 uses"
            )));
        }
        let usual = |number| tpdo(node, number);
        let ids = (0..4).zip(&stated.pdos).filter_map(|(number, pdo)| {
            (pdo.used_id()).or_else(|| (!configured).then(|| usual(number)))
        });
        let ids = ids.collect();
        let file = Told::of_file(options.objects.as_ref());
        let listens = mode == Mode::Listen;
        let initial = (
            if configured || listens {
                stated
            } else {
                Layout::default()
            },
            if listens { file } else { Told::default() },
        );
        Ok(Self {
            configured,
            layout: initial.0.clone(),
            initial,
            ids,
            file,
            told: Told::default(),
            options: options.clone(),
        })
    }

    /// The scales, once they are known. Torque and current are not a number if they are not sent.
    pub(super) fn scales(&self) -> Option<Scales> {
        let (options, told) = (&self.options, self.told.or(self.initial.1));
        let needs = |quantity, known: Option<f64>| match known {
            Some(known) => Some(known * 1e-3),
            None if self.layout.has(quantity) => None,
            None => Some(f64::NAN),
        };
        let counts_per_turn = options.counts_per_turn.or(told.counts_per_turn())?;
        let torque = options.rated_torque.or(told.rated_torque);
        let torque = needs(Quantity::Torque, torque)?;
        let current = options.rated_current.or(told.rated_current);
        let current = match options.current_unit {
            CurrentUnit::Milliampere => 1e-3,
            CurrentUnit::PerMille => needs(Quantity::Current, current)?,
        };
        Some(Scales {
            per_step: [
                core::f64::consts::TAU / counts_per_turn,
                options.velocity_unit.rad_per_s(counts_per_turn),
                torque,
                current,
            ],
        })
    }

    fn asks_current(&self) -> bool {
        self.options.current_unit == CurrentUnit::PerMille && self.layout.has(Quantity::Current)
    }

    /// What the file says of a scale that the drive does not tell.
    fn of_file(&self, object: Object) -> Option<f64> {
        let mut file = self.file;
        file.value(object).and_then(|value| *value)
    }

    /// Takes an entry of a TPDO.
    fn take_pdo(&mut self, object: Object, value: Option<u32>) {
        let [number, _] = object.index.to_le_bytes();
        if let Some(pdo) = self.layout.pdos.get_mut(usize::from(number))
            && !self.configured
        {
            pdo.take(object, value);
        }
    }
}

/// A scale that a drive tells; it may not change.
fn settle(known: &mut Option<f64>, told: u32, unit: f64) -> Result<(), Refusal> {
    let told = f64::from(told) * unit;
    if told <= 0.0 {
        return Err(Refusal::BadCalibration { channel: 0 });
    }
    match *known {
        Some(known) if known != told => Err(Refusal::Changed),
        _ => {
            *known = Some(told);
            Ok(())
        }
    }
}

impl Plan for Start {
    fn step(&self, at: usize) -> Option<Step> {
        let (object, needed) = match at {
            0 => (object::DEVICE_TYPE, true),
            SCALES => (COUNTS, self.options.counts_per_turn.is_none()),
            at if at == SCALES + 1 => (TURNS, self.options.counts_per_turn.is_none()),
            at if at == SCALES + 2 => {
                let asks = self.options.rated_torque.is_none();
                (RATED_TORQUE, asks && self.layout.has(Quantity::Torque))
            }
            at if at > SCALES + 2 => {
                let asks = self.options.rated_current.is_none();
                (RATED_CURRENT, asks && self.asks_current())
            }
            at => {
                #[allow(clippy::cast_possible_truncation)] // at most 4 and 11
                let (number, entry) = (((at - 1) / PER_PDO) as u8, ((at - 1) % PER_PDO) as u8);
                let pdo = self.layout.pdos.get(usize::from(number));
                let (is_on, count) = pdo.map_or((false, 0), |pdo| (pdo.is_on(), pdo.count));
                let (object, needed) = match entry {
                    0 => (object::tpdo_id(number), true),
                    1 => (object::tpdo_transmission(number), is_on),
                    2 => (object::tpdo_mapping(number, 0), is_on),
                    sub => (
                        object::tpdo_mapping(number, sub - 2),
                        is_on && sub - 2 <= count,
                    ),
                };
                (object, needed && !self.configured)
            }
        };
        needed.then_some(Step::Read(object))
    }

    fn steps(&self) -> usize {
        SCALES + 4
    }

    fn take(&mut self, object: Object, answer: Result<Option<u32>, u32>) -> Result<(), Refusal> {
        let is_pdo = matches!(object.index, 0x1800..=0x1803 | 0x1A00..=0x1A03);
        match (object, answer) {
            (object::DEVICE_TYPE, Ok(Some(device))) if device & 0xFFFF != PROFILE => {
                #[allow(clippy::cast_possible_truncation)] // 16 bits
                let profile = (device & 0xFFFF) as u16;
                Err(Refusal::OtherDevice { profile })
            }
            (_, Ok(Some(value))) if is_pdo => {
                self.take_pdo(object, Some(value));
                Ok(())
            }
            // The drive has fewer of them.
            (_, Err(_)) if is_pdo => {
                self.take_pdo(object, None);
                Ok(())
            }
            (COUNTS, Ok(Some(told))) if self.options.counts_per_turn.is_none() => {
                settle(&mut self.told.counts, told, 1.0)
            }
            (TURNS, Ok(Some(told))) if self.options.counts_per_turn.is_none() => {
                settle(&mut self.told.turns, told, 1.0)
            }
            (RATED_TORQUE, Ok(Some(told))) if self.options.rated_torque.is_none() => {
                settle(&mut self.told.rated_torque, told, 1e-3)
            }
            (RATED_CURRENT, Ok(Some(told))) if self.options.rated_current.is_none() => {
                settle(&mut self.told.rated_current, told, 1e-3)
            }
            (object::DEVICE_TYPE | COUNTS | TURNS | RATED_TORQUE | RATED_CURRENT, Err(_)) => {
                let known = self.of_file(object).ok_or(Refusal::Rejected {
                    object: object.index,
                })?;
                if let Some(value) = self.told.value(object) {
                    value.get_or_insert(known);
                }
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn ready(&self) -> Result<(), Refusal> {
        if self.layout.position().is_none() {
            return Err(Refusal::NotMapped);
        }
        let other = self.layout.ids().find(|id| !self.ids.contains(id));
        if let Some(id) = other.or(self.layout.wrong_id()) {
            return Err(Refusal::OtherIdentifier { id: id.raw() });
        }
        self.scales().map(|_| ()).ok_or(Refusal::NoCalibration)
    }

    fn begin(&mut self) {
        // It may be another drive, or set up anew.
        self.layout = self.initial.0.clone();
        self.told = Told::default();
    }
}
