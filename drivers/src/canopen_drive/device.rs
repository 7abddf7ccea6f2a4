//! The host's side of a drive: puts the values of its TPDOs together.

use super::layout::{DriveQuantity, fields, values};
use super::options::CanopenDriveOptions;
use super::start::{DriveStart, Scales};
use crate::bringup::Bringup;
use crate::canopen::{
    self, Cycle, NMT, NodeState, Rates, SYNC, Script, StartPlan, nmt, node_of, sdo_from, tpdo,
};
use crate::family::{Family, Session, Supervised};
use crate::objects::Objects;
use crate::received::Received;
use crate::{Claim, Device, Driver, Id, OutputInfo, Spec, SpecError, StampedReading};
use alloc::boxed::Box;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use proprio_topics::{
    Actuator, Counter, JointState, Kind, Nanos, Quality, Reading, Refusal, StampKind,
};

/// The fault bit of the status word.
const FAULT: u32 = 1 << 3;

/// A TPDO that is used.
#[derive(Debug, Clone)]
struct Used {
    id: Id,
    /// Its bit in the group.
    bit: u8,
    rank: Rank,
    fields: ArrayVec<super::layout::MappedObject, 8>,
    bytes: usize,
}

/// How its frames are read: made from the mapping once the drive is ready.
#[derive(Debug)]
struct MappingTable {
    scales: Scales,
    used: ArrayVec<Used, 4>,
    /// The TPDOs of one reading that a SYNC causes.
    group: u8,
    /// Those of which each makes a reading.
    alone: u8,
    lacks: Option<Refusal>,
}

impl MappingTable {
    fn new(plan: &DriveStart, scales: Scales) -> (Self, u8) {
        let (layout, mut used) = (&plan.layout, ArrayVec::new());
        for (at, pdo) in (0_u8..).zip(&layout.pdos) {
            let Some(id) = pdo.used_id() else {
                continue;
            };
            let (fields, bytes) = fields(pdo);
            let _ = used.try_push(Used {
                id,
                bit: 1 << at,
                rank: Rank::alone(values(pdo), at),
                fields,
                bytes,
            });
        }
        let (group, every) = layout.group().unwrap_or((0, 0));
        let this = Self {
            scales,
            used,
            group,
            alone: layout.alone(),
            lacks: plan.lacks(),
        };
        (this, if group == 0 { 0 } else { every.max(1) })
    }
}

/// The order of TPDOs that have a position, and come at one rate: those with most values, then the
/// first. The best makes the readings, so that two that an event causes are not two readings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Rank(usize);

impl Rank {
    /// Of TPDO `number` with this number of values.
    fn alone(values: usize, number: u8) -> Self {
        Self(values * 4 + usize::from(3 - number.min(3)))
    }
}

/// The host's side of a drive.
#[derive(Debug)]
pub(super) struct CanopenDrive {
    node: u8,
    hold: Nanos,
    table: Option<MappingTable>,
    cycle: Cycle,
    /// The last SYNC, and what each TPDO of the group has sent since.
    sync: Option<Nanos>,
    since_sync: [Option<ArrayVec<u8, 8>>; 4],
    /// When the current reading was measured.
    measured: Option<(Nanos, StampKind)>,
    /// The TPDOs of it that have come, and when the first one did.
    have: u8,
    began: Nanos,
    /// The reading before was incomplete: a late value of it may be in the next.
    suspect: bool,
    /// The last reading of a SYNC. Those are best: the time is known.
    synced: Option<Nanos>,
    /// Which of the TPDOs makes readings alone.
    rates: Rates,
    last: LastValues,
    state: NodeState,
}

/// What was sent last.
#[derive(Debug, Default)]
struct LastValues {
    /// The values in SI units, and when they came.
    joint: [Option<(Nanos, f64)>; DriveQuantity::JOINT],
    status: u32,
    mode: u32,
    /// The error code, if it is mapped.
    error: Option<u32>,
}

impl LastValues {
    /// Takes what a TPDO says at `t`; returns whether this is more than values of the joint.
    fn take(&mut self, pdo: &Used, scales: &Scales, data: &[u8], t: Nanos) -> bool {
        let mut tells_status = false;
        for field in &pdo.fields {
            let Some(raw) = field.bits.of(data) else {
                continue;
            };
            let number = field.raw.number(raw, field.bits.length());
            let at = field.quantity as usize;
            #[allow(clippy::cast_possible_truncation)] // at most 16 bits
            let word = raw as u32;
            if let (Some(value), Some(per_step)) = (self.joint.get_mut(at), scales.per_step.get(at))
            {
                *value = Some((t, number * per_step));
            } else {
                tells_status = true;
                match field.quantity {
                    DriveQuantity::Status => self.status = word,
                    DriveQuantity::Mode => self.mode = word,
                    _ => self.error = Some(word),
                }
            }
        }
        tells_status
    }
}

impl CanopenDrive {
    /// Makes the table, if all that it needs is known.
    fn prepare(&mut self, plan: &DriveStart) {
        if let (Ok(()), Ok(scales)) = (plan.ready(), plan.scales()) {
            let (table, every) = MappingTable::new(plan, scales);
            self.table = Some(table);
            self.cycle.set_every(every);
        }
    }

    /// A reading ends without some of its values.
    fn abandon(&mut self, frame: &mut Received<'_>, session: &mut Session<Script<DriveStart>>) {
        if core::mem::take(&mut self.have) != 0 {
            session.lost(Counter::Unpaired, 1, frame);
            self.suspect = true;
        }
        self.measured = None;
    }

    fn pdo(
        &mut self,
        data: &[u8],
        frame: &mut Received<'_>,
        session: &mut Session<Script<DriveStart>>,
    ) {
        if self.table.is_none() {
            self.prepare(&session.questions.plan);
        }
        let has_sync = self.sync.is_some_and(|t| self.is_fresh(t, frame.t));
        let Some(table) = &self.table else {
            return session.questions.missed();
        };
        let Some(used) = table.used.iter().find(|used| used.id == frame.id) else {
            return;
        };
        if data.len() < used.bytes {
            return frame.fault(Counter::Length);
        }
        // An adapter or a bridge that gives a frame twice: the second begins no reading.
        if table.group & used.bit != 0
            && let Some(before) = self.since_sync.get_mut(used.bit.trailing_zeros() as usize)
        {
            let is_same = before
                .as_ref()
                .is_some_and(|before| before.as_slice() == data);
            *before = data.try_into().ok();
            if has_sync && is_same {
                return frame.fault(Counter::Unexpected);
            }
        }
        let (bit, rank, group) = (used.bit, used.rank, table.group);
        if self.last.take(used, &table.scales, data, frame.t) {
            let reading = Reading::Actuator(Actuator {
                duty: f64::NAN,
                mode: self.last.mode,
                encoder: self.last.status,
                faults: self.last.error.unwrap_or(u32::from(self.state.error)),
            });
            frame.tell(0, self.quality(), reading);
        }
        if table.alone & bit != 0 {
            let at = |bit: u8| bit.trailing_zeros() as usize;
            let rank_of = |other| table.used.iter().find(|used| at(used.bit) == other);
            let is_better = |other| rank_of(other).is_none_or(|other| rank > other.rank);
            let is_first = self.rates.is_first(at(bit), is_better);
            if is_first && !self.synced.is_some_and(|t| self.is_fresh(t, frame.t)) {
                self.add(None, frame, session);
            }
        } else if group & bit != 0 {
            self.add_to_group(bit, group, frame, session);
        }
    }

    /// A TPDO of `group` has come: the last one completes the reading of a SYNC.
    fn add_to_group(
        &mut self,
        bit: u8,
        group: u8,
        frame: &mut Received<'_>,
        session: &mut Session<Script<DriveStart>>,
    ) {
        let too_long = self.have != 0 && !self.is_fresh(self.began, frame.t);
        if self.have & bit != 0 || too_long {
            self.abandon(frame, session);
        }
        if self.have == 0 {
            self.began = frame.t;
            self.measured = self.cycle.measured(frame);
            self.suspect |= self.measured.is_none();
        }
        self.have |= bit;
        if self.have != group {
            return;
        }
        self.have = 0;
        if core::mem::take(&mut self.suspect) {
            return session.lost(Counter::Unpaired, 1, frame);
        }
        self.synced = Some(frame.t);
        let measured = self.measured.take();
        self.add(measured, frame, session);
    }

    fn quality(&self) -> Quality {
        let mut quality = Quality::GOOD;
        if self.last.status & FAULT != 0 || self.state.error != 0 {
            quality |= Quality::DRIVE_FAULT;
        }
        // Errors of sensors.
        if self.state.error & 0xFF00 == 0x7300 {
            quality |= Quality::DEVICE_FAULT;
        }
        quality
    }

    /// Whether a value that came at `t` is used at `now`.
    fn is_fresh(&self, t: Nanos, now: Nanos) -> bool {
        (t..=t + self.hold).contains(&now)
    }

    /// Makes a reading, measured when `frame` came, or at another time.
    fn add(
        &mut self,
        measured: Option<(Nanos, StampKind)>,
        frame: &mut Received<'_>,
        session: &mut Session<Script<DriveStart>>,
    ) {
        let values = self.last.joint.map(|value| match value {
            Some((t, value)) if self.is_fresh(t, frame.t) => value,
            _ => f64::NAN,
        });
        if !values[0].is_finite() {
            // Only where stamps run backward.
            return frame.fault(Counter::Value);
        }
        let [position, velocity, torque, current] = values;
        let reading = Reading::Joint(JointState {
            position,
            velocity,
            torque,
            current,
            ..JointState::ABSENT
        });
        let mut stamped = StampedReading::new(0, frame, self.quality(), reading);
        (stamped.acquired, stamped.stamp) = measured.unwrap_or((frame.t, frame.stamp));
        session.add(stamped, frame);
    }
}

impl Driver for CanopenDriveOptions {
    const NAME: &'static str = "canopen_drive";

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
        let start = DriveStart::new(node, spec.mode, self)?;
        let mut bringup = Bringup::new(spec, spec.mode, canopen::TIMING, tpdo(node, 0));
        bringup.start_with(NMT, &[nmt::START, node]);
        let pdos = start.ids.iter().map(|id| Claim::exclusive(*id));
        let claims: Vec<Claim> = canopen::claims(node)
            .chain(pdos)
            .chain([Claim::shared(SYNC)])
            .collect();
        let script = Script::new(node, spec.mode, start);
        let this = CanopenDrive {
            node,
            hold: Nanos::from_seconds(self.hold_ms * 1e-3),
            table: None,
            cycle: Cycle::new(0),
            sync: None,
            since_sync: [const { None }; 4],
            measured: None,
            have: 0,
            began: Nanos::MIN,
            suspect: false,
            synced: None,
            rates: Rates::default(),
            last: LastValues::default(),
            state: NodeState::default(),
        };
        Ok(Supervised::boxed(claims, bringup, script, this))
    }
}

impl Family for CanopenDrive {
    type Questions = Script<DriveStart>;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<Script<DriveStart>>) {
        if self.state.on_frame(self.node, frame, session) {
            // An answer may have changed the mapping.
            if frame.id == sdo_from(self.node) {
                self.table = None;
            }
            return;
        }
        let Some(data) = frame.payload() else {
            return;
        };
        if frame.id == SYNC {
            if self.table.as_ref().is_some_and(|table| table.group != 0) {
                self.abandon(frame, session);
            }
            self.cycle.sync(frame);
            self.sync = Some(frame.t);
            self.since_sync = [const { None }; 4];
        } else {
            self.pdo(data, frame, session);
        }
    }

    fn lacks(&self) -> Option<Refusal> {
        self.table.as_ref()?.lacks
    }

    fn reset(&mut self) {
        self.cycle.reset();
        self.sync = None;
        self.have = 0;
        self.measured = None;
        self.suspect = false;
        self.synced = None;
        self.rates = Rates::default();
        self.last.joint = Default::default();
        self.table = None;
    }
}
