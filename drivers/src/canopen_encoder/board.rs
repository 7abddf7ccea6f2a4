//! The device's own side: a node with an object dictionary, and a position in TPDO 1.

use super::{
    BY_EVENT, CanopenEncoderOptions, OPERATING, PER_TURN, POSITION, PROFILE, PositionMapping,
};
use crate::canopen::{self, NO_RTR, SYNC, SimulatedNode, TPDO_OFF, node_of, object, tpdo};
use crate::{Board, EncodeError, Frame, Frames, Mode, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use core::f64::consts::TAU;
use proprio_topics::{Nanos, Quality, Reading};

/// Counts per turn of a simulated encoder without the key, and its turns.
const USUAL_PER_TURN: u32 = 8192;
/// The error code of a simulated encoder with a fault: its hardware.
const HARDWARE: u16 = 0x5000;

/// The encoder's own side.
#[derive(Debug)]
struct EncoderBoard {
    node: SimulatedNode,
    mapping: PositionMapping,
    counts: u32,
    quality: Quality,
}

impl EncoderBoard {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // limited to 32 bits
    fn set(&mut self, position: f64, quality: Quality) {
        let counts_per_turn = f64::from(self.node.value(PER_TURN));
        let counts = bytes::quantise(position * counts_per_turn, TAU, i64::MIN, i64::MAX);
        // It begins anew at the end of its range.
        self.counts = counts.rem_euclid(1 << 32) as u32;
        self.quality = quality;
    }

    fn send(&mut self, out: &mut Frames) {
        let fault = self.quality.contains(Quality::DEVICE_FAULT);
        self.node.report(if fault { HARDWARE } else { 0 }, out);
        let mut data = [0; 8];
        self.mapping.bits.set(self.counts.into(), &mut data);
        let data = data.get(..self.mapping.bits.reach()).unwrap_or_default();
        board::send(self.mapping.id, data, out);
    }
}

impl Simulate for CanopenEncoderOptions {
    /// An encoder after power-on; in [`Mode::Listen`] another program has already started it.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // casts saturate
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        self.check()?;
        let id = node_of(spec)?;
        canopen::check_file(id, self.objects.as_ref())?;
        let mappings = PositionMapping::all(id, self)?;
        let mapping = mappings.first().copied().ok_or(SpecError::keys(
            "eds",
            "a file in which a TPDO has the position (6004), if configure = false",
        ))?;
        let per_turn = self.counts_per_turn.or(self.counts_of_file());
        let per_turn = per_turn.map_or(USUAL_PER_TURN, |n| n as u32);
        // As another program, or the maker's tool, has left it.
        let set = spec.mode == Mode::Listen || !self.configure;
        let (off, map) = if set {
            (0, POSITION.mapped(32))
        } else {
            (TPDO_OFF, 0)
        };
        let transmission = match mapping.sync {
            0 => BY_EVENT,
            n => n,
        };
        let entries = [
            (object::DEVICE_TYPE, 0x0002_0000 | PROFILE, 4),
            (object::HEARTBEAT, 0, 2),
            (object::tpdo_id(0), tpdo(id, 0).raw() | NO_RTR | off, 4),
            (object::tpdo_transmission(0), u32::from(transmission), 1),
            (object::tpdo_timer(0), self.period_ms, 2),
            (object::tpdo_mapping(0, 0), u32::from(set), 1),
            (object::tpdo_mapping(0, 1), map, 4),
            (OPERATING, 0, 2),
            (PER_TURN, per_turn, 4),
        ];
        Ok(Box::new(EncoderBoard {
            node: SimulatedNode::new(id, spec.mode == Mode::Listen, &entries),
            mapping,
            counts: 0,
            quality: Quality::GOOD,
        }))
    }
}

impl Board for EncoderBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let is_due = self.node.on_frame(frame, out) & 1 != 0;
        if is_due && self.node.value(object::tpdo_mapping(0, 1)) == POSITION.mapped(32) {
            self.send(out);
        }
    }

    fn period(&self) -> Option<Nanos> {
        self.node.period(0)
    }

    fn measures_at(&self, frame: &Frame) -> bool {
        frame.id == SYNC
    }

    fn present(&mut self, _output: u8, reading: &Reading, quality: Quality) {
        if let Reading::Joint(joint) = reading
            && joint.position.is_finite()
        {
            self.set(joint.position, quality);
        }
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let Reading::Joint(joint) = reading else {
            return Err(EncodeError::Kind);
        };
        board::only_output(output)?;
        board::finite(&[joint.position])?;
        self.set(joint.position, quality);
        self.send(out);
        Ok(())
    }
}
