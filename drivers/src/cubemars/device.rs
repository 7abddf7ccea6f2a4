//! The host's side: takes the replies or uploads of one motor, and watches that they come.

use super::frames::{DRIVE, ENCODER_ERROR, JOINT, PayloadLayout, Stage, quality_of};
use super::options::{CubemarsKeys, CubemarsOptions, Effort};
use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Session, Supervised};
use crate::held::OnChange;
use crate::received::Received;
use crate::{Claim, Device, Driver, Mode, OutputInfo, Spec, SpecError, mit};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Actuator, Counter, Kind, Reading};

/// The host's side of a motor.
#[derive(Debug)]
pub(super) struct CubemarsMotor {
    keys: CubemarsKeys,
    /// The error of the power stage.
    told: OnChange<u8>,
}

impl CubemarsMotor {
    /// Tells the state of the power stage if its error is new, and now and then.
    fn stage(&mut self, stage: Stage, frame: &mut Received<'_>) {
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
        frame.tell(JOINT, quality, actuator);
        frame.temperature(DRIVE, stage.celsius);
    }
}

impl Driver for CubemarsOptions {
    const NAME: &'static str = "cubemars";

    fn outputs(&self) -> Vec<OutputInfo> {
        let drive = OutputInfo::temperature(DRIVE, "drive");
        [OutputInfo::new(JOINT, Kind::Joint), drive].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let keys = CubemarsKeys::new(spec, self)?;
        let claim = match keys.layout {
            PayloadLayout::Mit { .. } => Claim::shared(keys.id),
            PayloadLayout::Servo => Claim::exclusive(keys.id),
        };
        let bringup = Bringup::new(spec, Mode::Listen, Timing::LISTENED, keys.id);
        let this = CubemarsMotor {
            keys,
            told: OnChange::NOTHING,
        };
        Ok(Supervised::boxed([claim], bringup, NoInquiry, this))
    }
}

impl Family for CubemarsMotor {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        if frame.id != self.keys.id {
            return;
        }
        // Replies of other motors, and commands, are none of this motor's.
        let others = matches!(self.keys.layout, PayloadLayout::Mit { .. })
            && frame.data().first() != Some(&self.keys.number);
        if others {
            return;
        }
        let Some(data) = frame.payload() else {
            return;
        };
        let Some((raw, stage)) = self.keys.layout.unpack(data) else {
            return frame.fault(Counter::Length);
        };
        let (mut state, mut quality) = mit::measured(self.keys.scales, raw);
        if let Some(stage) = stage {
            quality |= quality_of(stage.error);
            self.stage(stage, frame);
        }
        if self.keys.effort == Effort::Current {
            state.current = state.torque;
            state.torque = self.keys.torque_constant.unwrap_or(f64::NAN) * state.current;
        }
        session.joint(JOINT, frame, quality, state);
    }

    fn reset(&mut self) {
        self.told = OnChange::NOTHING;
    }
}
