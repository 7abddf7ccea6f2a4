//! The host's side: takes the frames of one motor, and asks for them if it is told to.

use super::frames::{
    DamiaoMessage, DamiaoState, ENABLED, FET, JOINT, MOTOR, SENSOR, STATE, quality_of, question,
};
use super::options::{DamiaoKeys, DamiaoOptions};
use super::ranges::Ranges;
use crate::bringup::Bringup;
use crate::family::{Family, Rounds, Session, Supervised};
use crate::held::OnChange;
use crate::received::Received;
use crate::{Claim, Decoded, Device, Driver, Frame, OutputInfo, Spec, SpecError, mit};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Actuator, Counter, Kind, Nanos, Quality, Reading};

/// The host's side of a motor.
#[derive(Debug)]
pub(super) struct DamiaoMotor {
    keys: DamiaoKeys,
    /// The motor's state.
    told: OnChange<u8>,
    questions: Rounds,
}

impl DamiaoMotor {
    fn state(
        &mut self,
        told: &DamiaoState,
        frame: &mut Received<'_>,
        session: &mut Session<Ranges>,
    ) {
        let Some(scales) = session.questions.scales() else {
            return frame.fault(Counter::Unexpected);
        };
        let state = told.state;
        let quality = quality_of(state);
        if self.told.is_due(state, frame) {
            let faults = if quality == Quality::GOOD { 0 } else { state };
            let actuator = Reading::Actuator(Actuator {
                duty: f64::NAN,
                mode: u32::from(state == ENABLED),
                encoder: u32::from(state == SENSOR),
                faults: u32::from(faults),
            });
            frame.tell(JOINT, quality, actuator);
            for (output, celsius) in [FET, MOTOR].into_iter().zip(told.celsius) {
                frame.temperature(output, f64::from(celsius));
            }
        }
        let (state, saturated) = mit::measured(scales, told.raw);
        session.joint(JOINT, frame, quality | saturated, state);
    }
}

impl Driver for DamiaoOptions {
    const NAME: &'static str = "damiao";

    fn needs_fd(&self) -> bool {
        self.fd
    }

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let keys = DamiaoKeys::new(spec, self)?;
        let bringup = Bringup::polled(spec, keys.request_period, keys.id);
        let this = DamiaoMotor {
            keys,
            told: OnChange::NOTHING,
            questions: Rounds::new(keys.request_period),
        };
        let claims = [Claim::shared(keys.id)];
        let ranges = Ranges::new(keys, bringup.mode());
        Ok(Supervised::boxed(claims, bringup, ranges, this))
    }
}

impl Family for DamiaoMotor {
    type Questions = Ranges;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session<Ranges>) {
        if frame.id != self.keys.id {
            return;
        }
        let Some(data) = frame.fd_payload() else {
            return;
        };
        if data.len() != 8 {
            return frame.fault(Counter::Length);
        }
        match DamiaoMessage::parse(self.keys.address, data) {
            Some(DamiaoMessage::State(state)) => self.state(&state, frame, session),
            Some(DamiaoMessage::Register(register, value)) => {
                session.questions.answer(register, value, frame);
            }
            // Answers to other programs, and frames of other motors.
            Some(DamiaoMessage::Other) | None => {}
        }
    }

    fn reset(&mut self) {
        self.told = OnChange::NOTHING;
    }

    fn request(
        &mut self,
        now: Nanos,
        _session: &mut Session<Ranges>,
        _out: &mut Decoded,
    ) -> Option<Frame> {
        let command = self.questions.ask(&[STATE], now)?;
        Some(question(self.keys.address, self.keys.fd, command, 0))
    }

    fn request_at(&self) -> Option<Nanos> {
        self.questions.due()
    }
}
