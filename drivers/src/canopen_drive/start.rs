//! What a drive is asked at its start: its profile, its mapping, and its scales.

use super::layout::{Layout, Quantity};
use super::options::{CurrentUnit, Options};
use crate::canopen::{MAPPED_MOST, Object, Plan, Step, object};
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

/// Mapping and scales of a drive.
#[derive(Debug)]
pub(super) struct Start {
    options: Options,
    /// The mapping is that of the keys.
    configured: bool,
    pub(super) layout: Layout,
    counts: Option<f64>,
    turns: Option<f64>,
    rated_torque: Option<f64>,
    rated_current: Option<f64>,
}

/// SI units per step of what a drive sends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Scales {
    /// In the order of [`Quantity`]: position, velocity, torque, current.
    pub(super) per_step: [f64; Quantity::JOINT],
}

impl Start {
    pub(super) fn new(options: &Options, layout: Layout) -> Self {
        Self {
            configured: !options.pdos.is_empty(),
            layout,
            counts: options.counts_per_turn,
            turns: options.counts_per_turn.map(|_| 1.0),
            rated_torque: options.rated_torque,
            rated_current: options.rated_current,
            options: options.clone(),
        }
    }

    /// The scales, once they are known. Torque and current are not a number if they are not sent.
    pub(super) fn scales(&self) -> Option<Scales> {
        let needs = |quantity, known: Option<f64>| match known {
            Some(known) => Some(known * 1e-3),
            None if self.layout.has(quantity) => None,
            None => Some(f64::NAN),
        };
        let counts_per_turn = self.counts? / self.turns?;
        let torque = needs(Quantity::Torque, self.rated_torque)?;
        let current = match self.options.current_unit {
            CurrentUnit::Milliampere => 1e-3,
            CurrentUnit::PerMille => needs(Quantity::Current, self.rated_current)?,
        };
        Some(Scales {
            per_step: [
                core::f64::consts::TAU / counts_per_turn,
                self.options.velocity_unit.rad_per_s(counts_per_turn),
                torque,
                current,
            ],
        })
    }

    fn asks_current(&self) -> bool {
        self.options.current_unit == CurrentUnit::PerMille && self.layout.has(Quantity::Current)
    }

    /// Takes an entry of a TPDO.
    fn take_pdo(&mut self, object: Object, value: Option<u32>) {
        let [number, kind] = object.index.to_le_bytes();
        let Some(pdo) = self.layout.pdos.get_mut(usize::from(number)) else {
            return;
        };
        #[allow(clippy::cast_possible_truncation)] // these entries are bytes
        match (kind, object.sub) {
            (0x18, 1) => pdo.id = value,
            (0x18, 2) => pdo.transmission = value.map_or(u8::MAX, |v| v as u8),
            (0x1A, 0) => pdo.count = value.map_or(0, |v| v as u8).min(MAPPED_MOST),
            (0x1A, sub) => {
                if let Some(entry) = pdo.mapping.get_mut(usize::from(sub - 1)) {
                    *entry = value.unwrap_or(0);
                }
            }
            _ => {}
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
                if !self.configured {
                    self.take_pdo(object, Some(value));
                }
                Ok(())
            }
            // The drive has fewer of them.
            (_, Err(_)) if is_pdo => {
                if !self.configured {
                    self.take_pdo(object, None);
                }
                Ok(())
            }
            (COUNTS, Ok(Some(told))) if self.options.counts_per_turn.is_none() => {
                settle(&mut self.counts, told, 1.0)
            }
            (TURNS, Ok(Some(told))) if self.options.counts_per_turn.is_none() => {
                settle(&mut self.turns, told, 1.0)
            }
            (RATED_TORQUE, Ok(Some(told))) if self.options.rated_torque.is_none() => {
                settle(&mut self.rated_torque, told, 1e-3)
            }
            (RATED_CURRENT, Ok(Some(told))) if self.options.rated_current.is_none() => {
                settle(&mut self.rated_current, told, 1e-3)
            }
            (object::DEVICE_TYPE | COUNTS | TURNS | RATED_TORQUE | RATED_CURRENT, Err(_)) => {
                Err(Refusal::Rejected {
                    object: object.index,
                })
            }
            _ => Ok(()),
        }
    }

    fn ready(&self) -> Result<(), Refusal> {
        if self.layout.position().is_none() {
            return Err(Refusal::NotMapped);
        }
        self.scales().map(|_| ()).ok_or(Refusal::NoCalibration)
    }

    fn begin(&mut self) {
        // It may be another drive, or set up anew.
        let layout = if self.configured {
            core::mem::take(&mut self.layout)
        } else {
            Layout::default()
        };
        let options = core::mem::take(&mut self.options);
        *self = Self::new(&options, layout);
    }
}
