//! The host's side: takes the replies or uploads of one motor, and watches that they come.

use super::frames::{DRIVE, ENCODER_ERROR, JOINT, Layout, Stage, quality_of};
use super::options::{Checked, Effort, Options};
use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::bytes;
use crate::family::{Family, Link, Supervised};
use crate::held::OnChange;
use crate::{Claim, Decoded, Device, Frame, Mode, Output, Spec, SpecError};
use alloc::boxed::Box;
use proprio_topics::{Actuator, Counter, JointState, Quality, Reading, Temperature};

/// The host's side of a motor.
#[derive(Debug)]
pub(super) struct Motor {
    keys: Checked,
    /// The error of the power stage.
    told: OnChange<u8>,
}

impl Motor {
    pub(super) fn device(spec: &Spec, options: &Options) -> Result<Box<dyn Device>, SpecError> {
        let keys = Checked::new(spec, options)?;
        let claim = match keys.layout {
            Layout::Mit { .. } => Claim::shared(keys.id),
            Layout::Servo => Claim::exclusive(keys.id),
        };
        let bringup = Bringup::new(spec, Mode::Listen, Timing::LISTENED, keys.id);
        let this = Self {
            keys,
            told: OnChange::NOTHING,
        };
        Ok(Supervised::boxed([claim], bringup, NoInquiry, this))
    }

    /// Tells the state of the power stage if its error is new, and now and then.
    fn stage(&mut self, stage: Stage, frame: &Frame, out: &mut Decoded) {
        if !self.told.is_due(stage.error, frame) {
            return;
        }
        let actuator = Reading::Actuator(Actuator {
            duty: f64::NAN,
            mode: 0,
            encoder: u32::from(stage.error == ENCODER_ERROR),
            faults: u32::from(stage.error),
        });
        let quality = quality_of(stage.error);
        out.push(Output::new(JOINT, frame, quality, actuator), frame.id);
        let celsius = stage.celsius;
        let temperature = Reading::Temperature(Temperature { celsius });
        out.push(
            Output::new(DRIVE, frame, Quality::GOOD, temperature),
            frame.id,
        );
    }
}

impl Family for Motor {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &Frame, link: &mut Link<NoInquiry>, out: &mut Decoded) {
        if frame.id != self.keys.id {
            return;
        }
        // Replies of other motors, and commands, are none of this motor's.
        let others = matches!(self.keys.layout, Layout::Mit { .. })
            && frame.data().first() != Some(&self.keys.number);
        if others {
            return;
        }
        let Some(data) = bytes::payload(frame, out) else {
            return;
        };
        let Some((raw, stage)) = self.keys.layout.unpack(data) else {
            return out.fault(Counter::Length, 1, frame.id);
        };
        let mut quality = Quality::GOOD;
        if let Some(stage) = stage {
            quality = quality_of(stage.error);
            self.stage(stage, frame, out);
        }
        let [p, v, e] = self.keys.scales;
        let [position, velocity, effort] = raw;
        if p.is_saturated(position) || v.is_saturated(velocity) || e.is_saturated(effort) {
            quality |= Quality::SATURATED;
        }
        let effort = e.value(effort);
        let (torque, current) = match self.keys.effort {
            Effort::Torque => (effort, f64::NAN),
            Effort::Current => (
                self.keys.torque_constant.map_or(f64::NAN, |k| k * effort),
                effort,
            ),
        };
        let state = JointState {
            position: p.value(position),
            velocity: v.value(velocity),
            torque,
            current,
            ..JointState::ABSENT
        };
        link.joint(JOINT, frame, quality, state, out);
    }

    fn reset(&mut self) {
        self.told = OnChange::NOTHING;
    }
}
