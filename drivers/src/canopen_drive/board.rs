//! A drive's own side: a node with mapped process data.

use super::layout::{DriveQuantity, MappedObject, PdoMapping, fields};
use super::options::{CanopenDriveOptions, CurrentUnit, RatedTorqueUnit, VelocityUnit};
use super::start::{COUNTS, PROFILE, RATED_CURRENT, RATED_TORQUE, ScaleObjects, TURNS};
use crate::canopen::{
    NO_RTR, Pdo, SYNC, SimulatedNode, TPDO_OFF, check_file, node_of, object, tpdo,
};
use crate::{Board, EncodeError, Frame, Frames, Mode, Simulate, Spec, SpecError, board};
use alloc::boxed::Box;
use alloc::vec::Vec;
use core::f64::consts::TAU;
use proprio_topics::{JointState, Nanos, Quality, Reading};

/// A simulated drive without keys: an encoder of 1024 lines, 1 Nm, 5 A. It sends no torque, because
/// a simulated joint has none.
const COUNTS_PER_TURN: f64 = 4096.0;
const TORQUE: f64 = 1.0;
const CURRENT: f64 = 5.0;
/// Operation enabled; with a fault.
const ENABLED: f64 = 0x0627 as f64;
const FAULTY: f64 = 0x0628 as f64;
/// Cyclic synchronous torque.
const CST: f64 = 10.0;
/// The error code of a simulated fault: of the position sensor, or of the drive.
const SENSOR: u16 = 0x7305;
const OVERCURRENT: u16 = 0x2310;

/// The drive's own side.
#[derive(Debug)]
struct DriveBoard {
    node: SimulatedNode,
    /// SI units per step of position, velocity, torque and current.
    per_step: [f64; DriveQuantity::JOINT],
    state: JointState,
    quality: Quality,
}

impl DriveBoard {
    /// Its mapping, as it is set now.
    fn layout(&self) -> PdoMapping {
        let of_node = |number| Pdo::of_node(number, |object| self.node.value(object));
        PdoMapping {
            pdos: [0, 1, 2, 3].map(of_node),
        }
    }

    /// The raw number of a field; 0 for a value that the joint does not have.
    fn raw(&self, field: &MappedObject) -> f64 {
        let JointState {
            position,
            velocity,
            torque,
            current,
            ..
        } = self.state;
        let has_fault = self
            .quality
            .intersects(Quality::DRIVE_FAULT | Quality::DEVICE_FAULT);
        let value = match field.quantity {
            DriveQuantity::Position => position,
            DriveQuantity::Velocity => velocity,
            DriveQuantity::Torque => torque,
            DriveQuantity::Current => current,
            DriveQuantity::Status => return if has_fault { FAULTY } else { ENABLED },
            DriveQuantity::Mode => return CST,
            DriveQuantity::Error => return f64::from(self.error()),
        };
        let per_step = self.per_step.get(field.quantity as usize);
        let steps = value / per_step.copied().unwrap_or(1.0);
        if steps.is_finite() { steps } else { 0.0 }
    }

    const fn error(&self) -> u16 {
        board::fault_code(self.quality, [0, SENSOR, OVERCURRENT])
    }

    /// Sends the TPDOs in `which`, one bit each.
    fn send(&mut self, which: u8, out: &mut Frames) {
        self.node.report(self.error(), out);
        for (number, pdo) in (0_u8..).zip(&self.layout().pdos) {
            if which & 1 << number == 0 || !pdo.is_on() {
                continue;
            }
            let (fields, bytes) = fields(pdo);
            let mut data = [0; 8];
            for field in &fields {
                let raw = field.raw.bits(self.raw(field), field.bits.length());
                field.bits.set(raw, &mut data);
            }
            let data = data.get(..bytes).unwrap_or_default();
            board::send(self.node.tpdo_id(number), data, out);
        }
    }
}

impl Simulate for CanopenDriveOptions {
    /// A drive after power-on; in [`Mode::Listen`] another program has already started it.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // casts saturate
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        self.check()?;
        let id = node_of(spec)?;
        check_file(id, self.objects.as_ref())?;
        let pdos = self.pdos();
        let of_file = self.objects.as_ref().filter(|_| pdos.is_empty());
        let of_file = of_file.map(|file| PdoMapping::of_file(id, file));
        let layout = match of_file.filter(|file| file.position().is_some()) {
            Some(layout) => layout,
            // As its maker delivers it: nothing is mapped.
            None if self.configure && spec.mode == Mode::Supervise => PdoMapping::default(),
            None if pdos.is_empty() => PdoMapping::of_keys(id, &self.usual_pdos())?,
            None => PdoMapping::of_keys(id, &pdos)?,
        };
        let file = ScaleObjects::of_file(self.objects.as_ref());
        let counts_per_turn = self.counts_per_turn.or(file.counts_per_turn());
        let counts_per_turn = counts_per_turn.unwrap_or(COUNTS_PER_TURN);
        let torque_unit = self.rated_torque_unit.unwrap_or(RatedTorqueUnit::Milli);
        let of_file = file.rated_torque(self.rated_torque_unit);
        let torque = self.rated_torque.or(of_file).unwrap_or(TORQUE);
        let current = self.rated_current.or(file.rated_current());
        let current = current.unwrap_or(CURRENT);
        let velocity = self.velocity_unit.unwrap_or(VelocityUnit::Counts);
        let mut entries = Vec::from([
            (object::DEVICE_TYPE, 0x0002_0000 | PROFILE, 4),
            (COUNTS, counts_per_turn as u32, 4),
            (TURNS, 1, 4),
            (
                RATED_TORQUE,
                libm::round(torque / torque_unit.newton_metres()) as u32,
                4,
            ),
            (RATED_CURRENT, (current * 1e3) as u32, 4),
        ]);
        for (number, pdo) in (0_u8..).zip(&layout.pdos) {
            let id = pdo.id.unwrap_or(tpdo(id, number).raw() | TPDO_OFF);
            entries.push((object::tpdo_id(number), id | NO_RTR, 4));
            entries.push((
                object::tpdo_transmission(number),
                pdo.transmission.into(),
                1,
            ));
            entries.push((object::tpdo_timer(number), self.period_ms, 2));
            entries.push((object::tpdo_mapping(number, 0), pdo.count.into(), 1));
            for (sub, entry) in (1..).zip(&pdo.mapping) {
                entries.push((object::tpdo_mapping(number, sub), *entry, 4));
            }
        }
        Ok(Box::new(DriveBoard {
            node: SimulatedNode::new(id, spec.mode == Mode::Listen, &entries),
            per_step: [
                TAU / counts_per_turn,
                velocity.unit().radians(TAU / counts_per_turn),
                torque * 1e-3,
                match self.current_unit {
                    CurrentUnit::Milliampere => 1e-3,
                    CurrentUnit::PerMille => current * 1e-3,
                },
            ],
            state: JointState::ABSENT,
            quality: Quality::GOOD,
        }))
    }
}

impl Board for DriveBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let due = self.node.on_frame(frame, out);
        if due != 0 {
            self.send(due, out);
        }
    }

    fn period(&self) -> Option<Nanos> {
        let number = u8::try_from(self.layout().position()?).ok()?;
        self.node.period(number)
    }

    fn measures_at(&self, frame: &Frame) -> bool {
        frame.id == SYNC
    }

    fn present(&mut self, _output: u8, reading: &Reading, quality: Quality) {
        if let Reading::Joint(joint) = reading {
            (self.state, self.quality) = (*joint, quality);
        }
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let joint = match reading {
            Reading::Joint(joint) => joint,
            // Its status is sent with the joint's state.
            Reading::Actuator(_) => return Ok(()),
            _ => return Err(EncodeError::Kind),
        };
        board::only_output(output)?;
        board::finite(&[joint.position])?;
        (self.state, self.quality) = (*joint, quality);
        self.send(0b1111, out);
        Ok(())
    }
}
