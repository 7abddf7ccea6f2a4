//! The device's own side: a board that streams at once.

use super::{
    CALIBRATION, FRAME, IcubMc4Options, JOINTS, POSITION_CONTROL, StepSizes, fault, kind,
    status_quality,
};
use crate::icub::{self, class};
use crate::{Board, EncodeError, Frame, Frames, Simulate, Spec, SpecError, board, bytes};
use alloc::boxed::Box;
use proprio_topics::{Nanos, Quality, Reading};

/// A joint of a simulated board.
#[derive(Debug)]
struct SimulatedJoint {
    scale: StepSizes,
    ticks: i32,
    /// None as long as no velocity is given.
    steps: Option<i16>,
    faults: u8,
    mode: u8,
}

/// The board's own side: it streams without commands. It sends positions when all its joints in use
/// are new.
#[derive(Debug)]
struct Mc4Board {
    address: u8,
    period: Nanos,
    joints: [SimulatedJoint; JOINTS],
    /// The joints in use, and those of them that are new, one bit each.
    used: u8,
    fresh: u8,
}

impl Mc4Board {
    fn send(&self, kind: u8, data: [u8; FRAME], out: &mut Frames) {
        let id = icub::stream(class::PERIODIC_MOTOR, self.address, kind);
        board::send(id, &data, out);
    }

    fn send_status(&self, out: &mut Frames) {
        let [a, b] = &self.joints;
        let data = [a.faults, a.mode, b.faults, b.mode, 0, 0, 0, 0];
        self.send(kind::STATUS, data, out);
    }
}

impl Simulate for IcubMc4Options {
    /// A board that streams at once.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        self.hold()?;
        let period = icub::period(self.period_ms)?;
        Ok(Box::new(Mc4Board {
            address: icub::address(spec)?,
            period,
            joints: self.scales()?.map(|scale| SimulatedJoint {
                scale,
                ticks: 0,
                steps: None,
                faults: 0,
                mode: POSITION_CONTROL,
            }),
            used: spec.outputs.0.iter().fold(0, |all, joint| all | 1 << joint),
            fresh: 0,
        }))
    }
}

impl Board for Mc4Board {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let (class, board) = (class::POLLING_MOTOR, icub::board::MC4);
        icub::answer_management(frame, class, self.address, board, out);
    }

    fn period(&self) -> Option<Nanos> {
        Some(self.period)
    }

    /// If a joint's faults differ from the last status, a status precedes its reading. Velocities
    /// precede the positions, if all joints in use have one. The faults of the board's byte cannot
    /// be simulated.
    #[allow(clippy::cast_possible_truncation)] // limited to their ranges
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let Some(joint) = self.joints.get_mut(usize::from(output)) else {
            return Err(EncodeError::Output(output));
        };
        let state = match reading {
            Reading::Joint(state) if state.position.is_finite() => state,
            Reading::Joint(_) => return Err(EncodeError::NotFinite),
            Reading::Actuator(actuator) => {
                (joint.faults, joint.mode) = (actuator.faults as u8, actuator.mode as u8);
                self.send_status(out);
                return Ok(());
            }
            _ => return Err(EncodeError::Kind),
        };
        let (least, most) = (i64::from(i32::MIN), i64::from(i32::MAX));
        joint.ticks = bytes::quantise(state.position, joint.scale.position, least, most) as i32;
        let velocity = Some(state.velocity).filter(|velocity| velocity.is_finite());
        joint.steps = velocity.map(|v| bytes::quantise_i16(v, joint.scale.velocity));
        let carried = Quality::DEVICE_FAULT | Quality::DRIVE_FAULT | Quality::NOT_CALIBRATED;
        let known = status_quality(u32::from(joint.faults), u32::from(joint.mode));
        if known.0 != quality.0 & carried.0 {
            let set = |flag, bit: u32| if quality.contains(flag) { bit as u8 } else { 0 };
            joint.faults = set(Quality::DEVICE_FAULT, fault::ABSOLUTE_ENCODER)
                | set(Quality::DRIVE_FAULT, fault::EXTERNAL);
            joint.mode = match quality.contains(Quality::NOT_CALIBRATED) {
                true => CALIBRATION as u8,
                false => POSITION_CONTROL,
            };
            self.send_status(out);
        }
        self.fresh |= 1 << output;
        if self.fresh & self.used != self.used {
            return Ok(());
        }
        self.fresh = 0;
        let [a, b] = &self.joints;
        let steps = [a, b].map(|joint| joint.steps.unwrap_or(0).to_le_bytes());
        let [[v0, v1], [v2, v3]] = steps;
        let ([p0, p1, p2, p3], [p4, p5, p6, p7]) = (a.ticks.to_le_bytes(), b.ticks.to_le_bytes());
        let mut used = [a, b]
            .into_iter()
            .zip([1, 2])
            .filter(|(_, bit)| self.used & bit != 0);
        if used.all(|(joint, _)| joint.steps.is_some()) {
            self.send(kind::VELOCITY, [v0, v1, v2, v3, 0, 0, 0, 0], out);
        }
        self.send(kind::POSITION, [p0, p1, p2, p3, p4, p5, p6, p7], out);
        Ok(())
    }
}
