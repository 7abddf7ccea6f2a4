//! The driver `canopen_encoder`: CANopen encoders. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/canopen_encoder.md")]

#[cfg(feature = "boards")]
mod board;
#[cfg(feature = "recognise")]
mod recognise;

use crate::bringup::Bringup;
use crate::canopen::{
    self, Cycle, NMT, NodeState, Object, Pdo, Rates, SYNC, Script, ScriptStep, StartPlan, is_free,
    nmt, node_of, object, tpdo,
};
use crate::family::{Family, Session, Supervised};
use crate::objects::Objects;
use crate::received::Received;
use crate::signal::Bits;
use crate::{Claim, Device, Driver, Id, Mode, OutputInfo, Spec, SpecError, StampedReading, keys};
use alloc::boxed::Box;
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use core::f64::consts::TAU;
use proprio_topics::{Counter, JointState, Kind, Quality, Reading, Refusal};
use serde::Deserialize;

/// The profile of encoders.
const PROFILE: u32 = 406;
const OPERATING: Object = Object::new(0x6000, 0);
const SCALED: u32 = 1 << 2;
const SCALED_PER_TURN: Object = Object::new(0x6001, 0);
const PER_TURN: Object = Object::new(0x6501, 0);
const POSITION: Object = Object::new(0x6004, 0);
const CYCLE: Object = Object::new(0x6200, 0);
const HEARTBEAT_MS: u32 = 500;
/// Transmission by events, and by the timer.
const BY_EVENT: u8 = 254;

/// The keys of `driver = "canopen_encoder"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct CanopenEncoderOptions {
    /// Period \[ms\], 1 to 65535; default 10.
    pub period_ms: u32,
    /// Counts per turn; default the node's own.
    pub counts_per_turn: Option<f64>,
    /// Send after each n-th SYNC; 0, the default: by the timer.
    pub sync: u8,
    /// Map and time TPDO 1; default true.
    pub configure: bool,
    /// The EDS or DCF file, relative to the configuration.
    pub eds: Option<String>,
    /// The contents of `eds`, which the gateway reads.
    #[serde(skip)]
    pub objects: Option<Objects>,
}

impl Default for CanopenEncoderOptions {
    fn default() -> Self {
        Self {
            period_ms: 10,
            counts_per_turn: None,
            sync: 0,
            configure: true,
            eds: None,
            objects: None,
        }
    }
}

impl CanopenEncoderOptions {
    fn check(&self) -> Result<(), SpecError> {
        keys::within("period_ms", self.period_ms, 1..=65_535, "1 to 65535")?;
        keys::within("sync", self.sync, 0..=240, "0 to 240")?;
        match self.counts_per_turn {
            Some(counts) if !(counts > 0.0 && counts.is_finite()) => {
                Err(SpecError::key("counts_per_turn", counts, "above 0"))
            }
            _ => Ok(()),
        }
    }

    /// The counts per turn of this very encoder by its file: of 6001 if 6000 says that it is
    /// scaled.
    fn counts_of_file(&self) -> Option<f64> {
        let value = |object: Object| self.objects.as_ref()?.own(object.index, object.sub);
        let scaled = value(OPERATING).is_some_and(|parameters| parameters & SCALED != 0);
        value(if scaled { SCALED_PER_TURN } else { PER_TURN }).map(f64::from)
    }
}

/// Where the position is: in which frame, and where in it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct PositionMapping {
    id: Id,
    bits: Bits,
    /// The node sends it after each n-th SYNC; 0: by itself.
    sync: u8,
}

impl PositionMapping {
    /// As the driver maps it, or as the file says of a node that it does not map: those that a SYNC
    /// causes first, and of these the one that most SYNCs cause.
    fn all(node: u8, options: &CanopenEncoderOptions) -> Result<ArrayVec<Self, 4>, SpecError> {
        let name = options.eds.as_deref().unwrap_or_default();
        let mut mappings = ArrayVec::new();
        match &options.objects {
            Some(file) if !options.configure => {
                let has = |pdo: &Pdo| position_of(pdo).is_some();
                let remedy = "set configure = true";
                canopen::check_pdos((name, file), node, has, remedy)?;
                let pdos = [0, 1, 2, 3].map(|number| Pdo::of_file(file, node, number));
                let mut problem = None;
                for (number, pdo) in (0_u8..).zip(&pdos) {
                    match Self::of_file(pdo, &pdos) {
                        Some(Ok(mapping)) => mappings.push(mapping),
                        Some(Err(why)) => problem = problem.or(Some((number, why))),
                        None => {}
                    }
                }
                mappings.sort_by_key(|mapping: &Self| mapping.sync.wrapping_sub(1));
                if mappings.is_empty() {
                    let problem = match problem {
                        Some((number, why)) => format!(
                            ", [{:04X}sub1]: TPDO {} has the position (6004), but {why}",
                            0x1800 + u16::from(number),
                            number + 1
                        ),
                        None => ": no TPDO has the position (6004)".into(),
                    };
                    return Err(SpecError::Description(format!(
                        "eds = {name:?}{problem}: correct it there, or {remedy}"
                    )));
                }
            }
            _ => mappings.extend(Bits::new(0, 32, false).map(|bits| Self {
                id: tpdo(node, 0),
                bits,
                sync: options.sync,
            })),
        }
        Ok(mappings)
    }

    /// The mapping of the position in a TPDO, or why it can not be received; `None` if it has none.
    fn of_file(pdo: &Pdo, all: &[Pdo]) -> Option<Result<Self, &'static str>> {
        let bits = position_of(pdo)?;
        let is_same = |other: &&Pdo| other.used_id() == pdo.used_id();
        Some(match pdo.used_id() {
            None if pdo.is_off() => Err("is switched off (bit 31 of its COB-ID)"),
            None => Err("has no COB-ID"),
            Some(id) if !is_free(id) => {
                Err("has an identifier that CiA 301 keeps for other things")
            }
            Some(_) if all.iter().filter(is_same).count() > 1 => Err("another one has its COB-ID"),
            Some(id) => Ok(Self {
                id,
                bits,
                sync: match pdo.by_sync() {
                    true => pdo.transmission.max(1),
                    false => 0,
                },
            }),
        })
    }
}

/// Where a TPDO has the position, whether it is sent or not.
fn position_of(pdo: &Pdo) -> Option<Bits> {
    let is_position = |(object, _, bits): &(Object, u64, u64)| *object == POSITION && *bits == 32;
    let (_, first, length) = pdo.objects().find(is_position)?;
    Bits::new(first, length, false)
}

impl Driver for CanopenEncoderOptions {
    const NAME: &'static str = "canopen_encoder";

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Joint)].to_vec()
    }

    fn eds(&self) -> Option<&str> {
        self.eds.as_deref()
    }

    fn describe_objects(&mut self, objects: Objects) {
        self.objects = Some(objects);
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        self.check()?;
        let node = node_of(spec)?;
        canopen::check_file(node, self.objects.as_ref())?;
        let mappings = PositionMapping::all(node, self)?;
        let listens = spec.mode == Mode::Listen;
        if let (true, None, Some(file)) = (listens, self.counts_per_turn, &self.objects) {
            let scales = [OPERATING, SCALED_PER_TURN, PER_TURN];
            let is_scale = |index| scales.iter().any(|scale| scale.index == index);
            let name = self.eds.as_deref().unwrap_or_default();
            canopen::check_objects((name, file), is_scale, "set counts_per_turn")?;
        }
        let first = mappings.first().map_or(tpdo(node, 0), |mapping| mapping.id);
        let mut bringup = Bringup::new(spec, spec.mode, canopen::TIMING, first);
        bringup.start_with(NMT, &[nmt::START, node]);
        bringup.stop_with(NMT, &[nmt::PRE_OPERATIONAL, node]);
        let start = EncoderStart {
            node,
            counts_per_turn: self.counts_per_turn,
            of_file: self.counts_of_file().filter(|_| listens),
            options: self.clone(),
            scaled: false,
            no_timer: false,
        };
        let claims = canopen::claims(node)
            .chain(mappings.iter().map(|mapping| Claim::exclusive(mapping.id)))
            .chain([Claim::shared(SYNC)])
            .collect::<Vec<_>>();
        let script = Script::new(node, spec.mode, start);
        let this = Encoder {
            node,
            cycle: Cycle::new(mappings.first().map_or(0, |mapping| mapping.sync)),
            mappings,
            rates: Rates::default(),
            state: NodeState::default(),
        };
        Ok(Supervised::boxed(claims, bringup, script, this))
    }
}

/// The start of an encoder.
#[derive(Debug)]
struct EncoderStart {
    node: u8,
    options: CanopenEncoderOptions,
    scaled: bool,
    counts_per_turn: Option<f64>,
    /// Those of the file, if the node is not asked.
    of_file: Option<f64>,
    /// The node has no timer in object 1800.
    no_timer: bool,
}

/// The steps that set TPDO 1 up. The last one switches it on, after the cycle time.
const FIRST_SETUP: usize = 4;
const CYCLE_STEP: usize = FIRST_SETUP + Pdo::SETUP - 1;
const LAST_SETUP: usize = CYCLE_STEP + 1;

impl StartPlan for EncoderStart {
    fn step(&self, at: usize) -> Option<ScriptStep> {
        let write = |object, value, bytes| ScriptStep::Write {
            object,
            value,
            bytes,
        };
        let asks = self.options.counts_per_turn.is_none();
        let period = self.options.period_ms;
        let pdo = Pdo {
            id: Some(tpdo(self.node, 0).raw()),
            transmission: match self.options.sync {
                0 => BY_EVENT,
                n => n,
            },
            count: 1,
            mapping: [POSITION.mapped(32), 0, 0, 0, 0, 0, 0, 0],
        };
        let setup = |at| pdo.setup(0, period, at).filter(|_| self.options.configure);
        let (step, needed) = match at {
            0 => (ScriptStep::Nmt(nmt::PRE_OPERATIONAL), true),
            1 => (ScriptStep::Read(object::DEVICE_TYPE), true),
            2 => (ScriptStep::Read(OPERATING), asks),
            3 if self.scaled => (ScriptStep::Read(SCALED_PER_TURN), asks),
            3 => (ScriptStep::Read(PER_TURN), asks),
            LAST_SETUP => return setup(Pdo::SETUP - 1),
            at if at < CYCLE_STEP => return setup(at - FIRST_SETUP),
            CYCLE_STEP => {
                let configures = self.options.configure && self.options.sync == 0;
                (write(CYCLE, period, 2), configures && self.no_timer)
            }
            _ => (write(object::HEARTBEAT, HEARTBEAT_MS, 2), true),
        };
        needed.then_some(step)
    }

    fn steps(&self) -> usize {
        LAST_SETUP + 2
    }

    fn take(&mut self, object: Object, answer: Result<Option<u32>, u32>) -> Result<(), Refusal> {
        match (object, answer) {
            (object::DEVICE_TYPE, Ok(Some(device))) if device & 0xFFFF != PROFILE => {
                #[allow(clippy::cast_possible_truncation)] // 16 bits
                let profile = (device & 0xFFFF) as u16;
                Err(Refusal::OtherDevice { profile })
            }
            (OPERATING, Ok(Some(parameters))) => {
                self.scaled = parameters & SCALED != 0;
                Ok(())
            }
            // Old encoders have no scaling.
            (OPERATING, Err(_)) => {
                self.scaled = false;
                Ok(())
            }
            (PER_TURN | SCALED_PER_TURN, Ok(Some(counts))) => {
                // In a log, the one that does not apply may be read too.
                let applies = (object == SCALED_PER_TURN) == self.scaled;
                if self.options.counts_per_turn.is_some() || !applies {
                    return Ok(());
                }
                if counts == 0 {
                    return Err(Refusal::BadCalibration { channel: 0 });
                }
                let counts = f64::from(counts);
                match self.counts_per_turn {
                    Some(known) if known != counts => Err(Refusal::Changed),
                    _ => {
                        self.counts_per_turn = Some(counts);
                        Ok(())
                    }
                }
            }
            (object, Err(_)) if object == object::tpdo_timer(0) => {
                self.no_timer = true;
                Ok(())
            }
            (object::HEARTBEAT, Err(_)) => Ok(()),
            (object, Err(_)) => Err(Refusal::Rejected {
                object: object.index,
            }),
            _ => Ok(()),
        }
    }

    fn ready(&self) -> Result<(), Refusal> {
        let known = self.known();
        known.map(|_| ()).ok_or(Refusal::NoCalibration)
    }

    fn begin(&mut self) {
        // It may be another encoder.
        self.counts_per_turn = self.options.counts_per_turn;
        self.no_timer = false;
    }
}

impl EncoderStart {
    /// The counts per turn: the node's own, else its file's.
    fn known(&self) -> Option<f64> {
        self.counts_per_turn.or(self.of_file)
    }
}

/// The host's side of an encoder.
#[derive(Debug)]
struct Encoder {
    node: u8,
    /// The best first.
    mappings: ArrayVec<PositionMapping, 4>,
    rates: Rates,
    cycle: Cycle,
    state: NodeState,
}

impl Encoder {
    fn position(
        &mut self,
        at: usize,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<Script<EncoderStart>>,
    ) {
        let Some(mapping) = self.mappings.get(at).copied() else {
            return;
        };
        let Some(counts) = mapping.bits.of(data) else {
            return frame.fault(Counter::Length);
        };
        let Some(counts_per_turn) = session.questions.plan.known() else {
            return session.questions.missed();
        };
        if !self.rates.is_first(at, |other| at < other) {
            return;
        }
        let measured = match mapping.sync {
            1.. if at == 0 => self.cycle.measured(frame),
            _ => Some((frame.t, frame.stamp)),
        };
        let Some((acquired, stamp)) = measured else {
            return session.lost(Counter::Unpaired, 1, frame);
        };
        let mut quality = Quality::GOOD;
        if self.state.error != 0 {
            quality |= Quality::DEVICE_FAULT;
        }
        let reading = Reading::Joint(JointState {
            position: counts as f64 / counts_per_turn * TAU,
            ..JointState::ABSENT
        });
        let stamped = StampedReading::new(0, frame, quality, reading).at(acquired, stamp);
        session.add(stamped, frame);
    }
}

impl Family for Encoder {
    type Questions = Script<EncoderStart>;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<Script<EncoderStart>>) {
        if self.state.on_frame(self.node, frame, session) {
            return;
        }
        let Some(data) = frame.payload() else {
            return;
        };
        if frame.id == SYNC {
            self.cycle.sync(frame);
        } else if let Some(at) = self
            .mappings
            .iter()
            .position(|mapping| mapping.id == frame.id)
        {
            self.position(at, data, frame, session);
        }
    }

    fn reset(&mut self) {
        self.cycle.reset();
        self.rates = Rates::default();
    }
}
