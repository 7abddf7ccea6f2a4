//! What a drive is asked at its start: its profile, its mapping, and its scales.

use super::layout::{DriveQuantity, PdoMapping, fields};
use super::options::{CanopenDriveOptions, CurrentUnit, RatedTorqueUnit, StepUnit};
use crate::canopen::{
    self, MAPPED_MOST, Object, Pdo, ScriptStep, StartPlan, is_free, nmt, object, tpdo,
};
use crate::objects::Objects;
use crate::{Id, Mode, SpecError};
use alloc::format;
use arrayvec::ArrayVec;
use core::f64::consts::TAU;
use core::ops::RangeInclusive;
use proprio_topics::Refusal;

/// The profile of drives.
pub(super) const PROFILE: u32 = 402;
pub(super) const COUNTS: Object = Object::new(0x608F, 1);
pub(super) const TURNS: Object = Object::new(0x608F, 2);
pub(super) const RATED_TORQUE: Object = Object::new(0x6076, 0);
/// \[mA\]
pub(super) const RATED_CURRENT: Object = Object::new(0x6075, 0);
/// Units as [`StepUnit::of_code`] reads them.
const POSITION_UNIT: Object = Object::new(0x60A8, 0);
const VELOCITY_UNIT: Object = Object::new(0x60A9, 0);
/// \[rpm\]
const MOST_SPEED: Object = Object::new(0x6080, 0);
const VENDOR: Object = Object::new(0x1018, 1);

/// What a drive is asked of its scales. Its unit of the position tells whether counts are needed.
const SCALES: [Object; 8] = [
    POSITION_UNIT,
    COUNTS,
    TURNS,
    VELOCITY_UNIT,
    VENDOR,
    RATED_TORQUE,
    RATED_CURRENT,
    MOST_SPEED,
];

/// Above this a greatest speed says nothing of a motor: drives have it as a default \[rpm\].
const FASTEST: f64 = 10_000.0;
/// No joint of a robot has more \[W\]. A torque of millionths that is read as thousandths is a
/// thousandfold: it is found from 50 W on.
const MOST_POWER: f64 = 50e3;
/// Rated torque by rated current \[Nm/A\]. A motor turns at no more than its voltage by this: at
/// 48 V at 917000 rpm with the least one, at 9 rpm with the greatest.
const TORQUE_CONSTANTS: RangeInclusive<f64> = 5e-4..=50.0;

/// Entries that are read of each TPDO: identifier, transmission, number of mapped objects, these.
const PER_PDO: usize = 3 + MAPPED_MOST as usize;
/// The first of the steps that ask for the TPDOs, that set them, and that ask for the scales.
const MAPPING: usize = 2;
const SETUP: usize = MAPPING + 4 * PER_PDO;
const FIRST_SCALE: usize = SETUP + 4 * Pdo::SETUP;

/// What a drive, or its file, tells of its scales: the values of [`SCALES`]; none is 0, by which
/// makers mean that it is not stated.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct ScaleObjects([Option<u32>; SCALES.len()]);

impl ScaleObjects {
    /// What `file` tells of this very drive. (The scales of an EDS are those of some motor; its
    /// units and its maker are those of all drives of the kind.)
    pub(super) fn of_file(file: Option<&Objects>) -> Self {
        let value = |object: Object| {
            let (file, Object { index, sub }) = (file?, object);
            match object {
                VENDOR => file.value(index, sub, 0).or(file.vendor),
                POSITION_UNIT | VELOCITY_UNIT => file.value(index, sub, 0),
                TURNS => {
                    let counts = file.own(COUNTS.index, COUNTS.sub);
                    file.own(index, sub).or(counts.map(|_| 1))
                }
                _ => file.own(index, sub),
            }
        };
        let mut this = Self::default();
        for scale in SCALES {
            if let Some(told) = value(scale) {
                this.set(scale, told);
            }
        }
        this
    }

    fn at(object: Object) -> Option<usize> {
        SCALES.iter().position(|scale| *scale == object)
    }

    fn value(&self, object: Object) -> Option<u32> {
        *self.0.get(Self::at(object)?)?
    }

    fn set(&mut self, object: Object, told: u32) {
        if let Some(value) = Self::at(object).and_then(|at| self.0.get_mut(at)) {
            *value = (told != 0).then_some(told);
        }
    }

    pub(super) fn counts_per_turn(&self) -> Option<f64> {
        Some(f64::from(self.value(COUNTS)?) / f64::from(self.value(TURNS)?))
    }

    /// \[Nm\], in the unit of the keys, else in that of its maker.
    pub(super) fn rated_torque(&self, unit: Option<RatedTorqueUnit>) -> Option<f64> {
        let unit = unit.unwrap_or(RatedTorqueUnit::of_vendor(self.value(VENDOR)));
        Some(f64::from(self.value(RATED_TORQUE)?) * unit.newton_metres())
    }

    /// \[A\]
    pub(super) fn rated_current(&self) -> Option<f64> {
        Some(f64::from(self.value(RATED_CURRENT)?) * 1e-3)
    }

    /// These values, and those of `other` where there are none.
    fn or(self, other: Self) -> Self {
        let mut both = self;
        for (value, other) in both.0.iter_mut().zip(other.0) {
            *value = value.or(other);
        }
        both
    }
}

/// Mapping and scales of a drive: those of the keys, else what the drive says, else what its file
/// says.
#[derive(Debug)]
pub(super) struct DriveStart {
    options: CanopenDriveOptions,
    /// The mapping is that of the keys.
    configured: bool,
    /// The drive is set to it.
    sets: bool,
    /// What is used until the drive says it: nothing, if it is asked.
    initial: (PdoMapping, ScaleObjects),
    pub(super) layout: PdoMapping,
    /// The identifiers of TPDOs that are received.
    pub(super) ids: ArrayVec<Id, 4>,
    file: ScaleObjects,
    told: ScaleObjects,
}

/// SI units per step of what a drive sends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scales {
    /// In the order of [`DriveQuantity`]: position, velocity, torque, current.
    pub(super) per_step: [f64; DriveQuantity::JOINT],
}

/// Refuses a file without what is needed of it: it has `stated`, unless keys state that
/// (`configured`).
fn check_file(
    node: u8,
    options: &CanopenDriveOptions,
    objects: &Objects,
    stated: &PdoMapping,
    configured: bool,
) -> Result<(), SpecError> {
    let name = options.eds.as_deref().unwrap_or_default();
    let file = (name, objects);
    if !configured {
        let has = |pdo: &Pdo| !fields(pdo).0.is_empty();
        canopen::check_pdos(file, node, has, "state pdos")?;
        if let Some((number, id)) = stated.wrong_id() {
            return Err(SpecError::Description(format!(
                "eds = {name:?}, [{:04X}sub1]: TPDO {} has the identifier {id}, which \
                 another one, or CiA 301 itself, uses: correct it there, or state pdos",
                0x1800 + number,
                number + 1
            )));
        }
    }
    // Torque and current of the file are left out if their scale is not known.
    let asked = |quantity| configured && stated.has(quantity);
    let per_mille = options.current_unit == CurrentUnit::PerMille;
    for (object, key, wanted) in [
        (COUNTS, "counts_per_turn", options.counts_per_turn.is_none()),
        (
            RATED_TORQUE,
            "rated_torque",
            options.rated_torque.is_none() && asked(DriveQuantity::Torque),
        ),
        (
            RATED_CURRENT,
            "rated_current",
            options.rated_current.is_none() && per_mille && asked(DriveQuantity::Current),
        ),
    ] {
        let is_wanted = |index| wanted && index == object.index;
        canopen::check_objects(file, is_wanted, &format!("set {key}"))?;
    }
    Ok(())
}

impl DriveStart {
    pub(super) fn new(
        node: u8,
        mode: Mode,
        options: &CanopenDriveOptions,
    ) -> Result<Self, SpecError> {
        let file = options.objects.as_ref();
        let of_keys = PdoMapping::of_keys(node, &options.pdos())?;
        let configured = of_keys.position().is_some();
        let listens = mode == Mode::Listen;
        let stated = match file {
            Some(file) if !configured => PdoMapping::of_file(node, file),
            _ => of_keys,
        };
        // One that is asked need not have them in its file.
        if let (Some(file), true) = (file, listens) {
            check_file(node, options, file, &stated, configured)?;
        }
        let mut ids = ArrayVec::<Id, 4>::new();
        for (number, pdo) in (0..4).zip(&stated.pdos) {
            let usual = || (!configured).then(|| tpdo(node, number));
            let id = pdo.used_id().filter(|id| is_free(*id)).or_else(usual);
            if let Some(id) = id.filter(|id| !ids.contains(id)) {
                let _ = ids.try_push(id);
            }
        }
        let file = ScaleObjects::of_file(file);
        let initial = (
            if configured || listens {
                stated
            } else {
                PdoMapping::default()
            },
            if listens {
                file
            } else {
                ScaleObjects::default()
            },
        );
        Ok(Self {
            configured,
            sets: options.configure && !listens,
            layout: initial.0.clone(),
            initial,
            ids,
            file,
            told: ScaleObjects::default(),
            options: options.clone(),
        })
    }

    /// What is known.
    fn known(&self) -> ScaleObjects {
        self.told.or(self.initial.1)
    }

    /// One step of the position \[rad\].
    fn position(&self) -> Option<f64> {
        if let Some(counts) = self.options.counts_per_turn {
            return Some(TAU / counts);
        }
        let known = self.known();
        let unit = known.value(POSITION_UNIT);
        match unit.map_or(Some(StepUnit::Positions(1.0)), StepUnit::of_code)? {
            StepUnit::Radians(radians) => Some(radians),
            StepUnit::Positions(counts) => Some(counts * TAU / known.counts_per_turn()?),
        }
    }

    /// The unit of the velocity; `None`: one that is not known.
    fn velocity(&self) -> Option<StepUnit> {
        if let Some(unit) = self.options.velocity_unit {
            return Some(unit.unit());
        }
        let code = self.known().value(VELOCITY_UNIT);
        code.map_or(Some(StepUnit::Positions(1.0)), StepUnit::of_code)
    }

    fn rated_torque(&self) -> Option<f64> {
        let rated = self.known().rated_torque(self.options.rated_torque_unit);
        self.options.rated_torque.or(rated)
    }

    fn rated_current(&self) -> Option<f64> {
        self.options.rated_current.or(self.known().rated_current())
    }

    /// The scales; or what is needed and not known. Torque and current are not a number if theirs
    /// is not known.
    pub(super) fn scales(&self) -> Result<Scales, Refusal> {
        let needs = |object: Object, known: Option<f64>| match known {
            None if self.needs(object) => Err(Refusal::Untold {
                object: object.index,
            }),
            known => Ok(known.unwrap_or(f64::NAN)),
        };
        let position = needs(COUNTS, self.position())?;
        let velocity = self.velocity().map(|unit| unit.radians(position));
        let current = match self.options.current_unit {
            CurrentUnit::Milliampere => 1e-3,
            CurrentUnit::PerMille => needs(RATED_CURRENT, self.rated_current())? * 1e-3,
        };
        Ok(Scales {
            per_step: [
                position,
                velocity.unwrap_or(f64::NAN),
                needs(RATED_TORQUE, self.rated_torque())? * 1e-3,
                current,
            ],
        })
    }

    /// What is sent, and left out because its scale is not known.
    pub(super) fn lacks(&self) -> Option<Refusal> {
        let is_lacking = |object: &Object| match *object {
            RATED_TORQUE => self.layout.has(DriveQuantity::Torque) && self.rated_torque().is_none(),
            _ => self.scales_current() && self.rated_current().is_none(),
        };
        let lacking = [RATED_TORQUE, RATED_CURRENT].into_iter().find(is_lacking)?;
        Some(Refusal::Untold {
            object: lacking.index,
        })
    }

    /// Whether the current is sent in thousandths of the rated one.
    fn scales_current(&self) -> bool {
        self.options.current_unit == CurrentUnit::PerMille
            && self.layout.has(DriveQuantity::Current)
    }

    /// Whether what is told of `object` counts: no key states it.
    fn counts(&self, object: Object) -> bool {
        let options = &self.options;
        match object {
            COUNTS | TURNS | POSITION_UNIT => options.counts_per_turn.is_none(),
            VELOCITY_UNIT => options.velocity_unit.is_none(),
            VENDOR | MOST_SPEED => {
                options.rated_torque.is_none() && options.rated_torque_unit.is_none()
            }
            RATED_TORQUE => options.rated_torque.is_none(),
            _ => options.rated_current.is_none(),
        }
    }

    /// Whether there are no readings without `object`.
    fn needs(&self, object: Object) -> bool {
        // What the drive, or its file, maps is left out then; what the keys ask for is needed.
        let is_needed = match object {
            COUNTS | TURNS => {
                let unit = self
                    .known()
                    .value(POSITION_UNIT)
                    .and_then(StepUnit::of_code);
                !matches!(unit, Some(StepUnit::Radians(_)))
            }
            RATED_TORQUE => self.configured && self.layout.has(DriveQuantity::Torque),
            RATED_CURRENT => self.configured && self.scales_current(),
            _ => false,
        };
        is_needed && self.counts(object)
    }

    /// Whether the drive is asked for `object`.
    fn asks(&self, object: Object) -> bool {
        let is_of_use = match object {
            POSITION_UNIT => true,
            VELOCITY_UNIT => self.layout.has(DriveQuantity::Velocity),
            VENDOR | MOST_SPEED => self.checks_torque(),
            RATED_TORQUE => self.layout.has(DriveQuantity::Torque),
            RATED_CURRENT => self.scales_current() || self.checks_torque(),
            _ => self.needs(object),
        };
        is_of_use && self.counts(object)
    }

    /// Whether the rated torque is the drive's own, in a unit that no key states.
    fn checks_torque(&self) -> bool {
        self.layout.has(DriveQuantity::Torque) && self.counts(VENDOR)
    }

    /// The object whose value can not be, if there is one.
    fn implausible(&self) -> Option<u16> {
        let known = self.known();
        let (has_velocity, units) = (
            self.layout.has(DriveQuantity::Velocity),
            [POSITION_UNIT, VELOCITY_UNIT],
        );
        let unknown = |unit: &Object| {
            let code = known.value(*unit);
            code.is_some_and(|code| StepUnit::of_code(code).is_none())
                && self.counts(*unit)
                && (*unit == POSITION_UNIT || has_velocity)
        };
        if let Some(unit) = units.into_iter().find(unknown) {
            return Some(unit.index);
        }
        let torque = self.rated_torque().filter(|_| self.checks_torque())?;
        let speed = known.value(MOST_SPEED).map_or(0.0, f64::from).min(FASTEST);
        let is_wrong = |current: f64| !TORQUE_CONSTANTS.contains(&(torque / current));
        (torque * speed * TAU / 60.0 > MOST_POWER || self.rated_current().is_some_and(is_wrong))
            .then_some(RATED_TORQUE.index)
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

    /// Takes a value of [`SCALES`].
    fn take_scale(
        &mut self,
        object: Object,
        answer: Result<Option<u32>, u32>,
    ) -> Result<(), Refusal> {
        // What only other values depend on may change.
        let is_fixed = matches!(object, COUNTS | TURNS | RATED_TORQUE | RATED_CURRENT);
        let value = match answer {
            _ if !self.counts(object) => return Ok(()),
            Ok(None) => return Ok(()),
            Ok(Some(0)) if self.needs(object) => {
                return Err(Refusal::BadCalibration { channel: 0 });
            }
            Ok(Some(told)) => told,
            Err(_) => match self.told.value(object).or(self.file.value(object)) {
                Some(known) => known,
                None if self.needs(object) => {
                    return Err(Refusal::Rejected {
                        object: object.index,
                    });
                }
                None => return Ok(()),
            },
        };
        if is_fixed && self.told.value(object).is_some_and(|known| known != value) {
            return Err(Refusal::Changed);
        }
        self.told.set(object, value);
        Ok(())
    }
}

impl StartPlan for DriveStart {
    fn step(&self, at: usize) -> Option<ScriptStep> {
        #[allow(clippy::cast_possible_truncation)] // at most 4
        let part = |at: usize, of: usize| ((at / of) as u8, at % of);
        let object = match at {
            0 => return self.sets.then_some(ScriptStep::Nmt(nmt::PRE_OPERATIONAL)),
            1 => Some(object::DEVICE_TYPE),
            MAPPING..SETUP => {
                let (number, entry) = part(at - MAPPING, PER_PDO);
                let pdo = self.layout.pdos.get(usize::from(number));
                let (is_on, count) = pdo.map_or((false, 0), |pdo| (pdo.is_on(), pdo.count));
                #[allow(clippy::cast_possible_truncation)] // at most 10
                let (object, needed) = match entry as u8 {
                    0 => (object::tpdo_id(number), true),
                    1 => (object::tpdo_transmission(number), is_on),
                    2 => (object::tpdo_mapping(number, 0), is_on),
                    sub => (
                        object::tpdo_mapping(number, sub - 2),
                        is_on && sub - 2 <= count,
                    ),
                };
                (needed && !self.configured).then_some(object)
            }
            SETUP..FIRST_SCALE => {
                let (number, entry) = part(at - SETUP, Pdo::SETUP);
                let pdo = self.layout.pdos.get(usize::from(number))?;
                let is_set = self.sets && pdo.is_on();
                return pdo
                    .setup(number, self.options.period_ms, entry)
                    .filter(|_| is_set);
            }
            at => {
                let scale = SCALES.get(at - FIRST_SCALE).copied();
                scale.filter(|scale| self.asks(*scale))
            }
        };
        object.map(ScriptStep::Read)
    }

    fn steps(&self) -> usize {
        FIRST_SCALE + SCALES.len()
    }

    fn take(&mut self, object: Object, answer: Result<Option<u32>, u32>) -> Result<(), Refusal> {
        let is_pdo = canopen::is_pdo(object.index);
        match (object, answer) {
            (object::DEVICE_TYPE, Ok(Some(device))) if device & 0xFFFF != PROFILE => {
                #[allow(clippy::cast_possible_truncation)] // 16 bits
                let profile = (device & 0xFFFF) as u16;
                Err(Refusal::OtherDevice { profile })
            }
            (object::DEVICE_TYPE, Err(_)) => Err(Refusal::Rejected {
                object: object.index,
            }),
            (_, Err(_)) if is_pdo && self.sets => Err(Refusal::Rejected {
                object: object.index,
            }),
            (_, Ok(Some(value))) if is_pdo => {
                self.take_pdo(object, Some(value));
                Ok(())
            }
            // The drive has fewer of them.
            (_, Err(_)) if is_pdo => {
                self.take_pdo(object, None);
                Ok(())
            }
            _ if ScaleObjects::at(object).is_some() => self.take_scale(object, answer),
            _ => Ok(()),
        }
    }

    fn ready(&self) -> Result<(), Refusal> {
        if self.layout.position().is_none() {
            let off = self.layout.off().map(|number| Refusal::SwitchedOff {
                object: object::tpdo_id(number).index,
            });
            return Err(off.unwrap_or(Refusal::NotMapped));
        }
        let other = self.layout.ids().find(|id| !self.ids.contains(id));
        if let Some(id) = other.or(self.layout.wrong_id().map(|(_, id)| id)) {
            return Err(Refusal::OtherIdentifier { id: id.raw() });
        }
        if let Some(object) = self.implausible() {
            return Err(Refusal::Implausible { object });
        }
        self.scales().map(|_| ())
    }

    fn begin(&mut self) {
        // It may be another drive, or set up anew.
        self.layout = self.initial.0.clone();
        self.told = ScaleObjects::default();
    }
}
