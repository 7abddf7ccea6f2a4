//! The host's side: takes the answers of one motor, and asks for them if it is told to.

use super::frames::{Answer, JOINT, LENGTH, MOTOR, MotorStatus, MyactuatorProtocol, command};
use super::options::{MyactuatorKeys, MyactuatorOptions, MyactuatorPosition};
use crate::bringup::{Bringup, NoInquiry};
use crate::family::{Family, Rounds, Session, Supervised};
use crate::held::{HeldValue, OnChange};
use crate::received::Received;
use crate::{Claim, Decoded, Device, Driver, Frame, Mode, OutputInfo, Spec, SpecError, mit};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Actuator, Counter, JointState, Kind, Nanos, Quality, Reading};

/// How often the errors are asked for.
const ERRORS_PERIOD: Nanos = Nanos::from_millis(1000);

/// The host's side of a motor.
#[derive(Debug)]
pub(super) struct MyactuatorMotor {
    keys: MyactuatorKeys,
    errors: u16,
    told: OnChange<u16>,
    temperature: OnChange<()>,
    velocity: HeldValue,
    current: HeldValue,
    /// The questions for what is measured, and the one for the errors.
    questions: Rounds,
    of_errors: Rounds,
}

impl MyactuatorMotor {
    /// A reading at `position`, with the speed and the current that are known.
    fn joint(
        &self,
        position: f64,
        saturated: bool,
        frame: &mut Received<'_>,
        session: &mut Session,
    ) {
        let mut quality = self.keys.quality(self.errors);
        if saturated {
            quality |= Quality::SATURATED;
        }
        let current = self.current.at(frame, self.keys.hold);
        let state = JointState {
            position,
            velocity: self.velocity.at(frame, self.keys.hold),
            torque: self.keys.torque_constant * current,
            current,
            ..JointState::ABSENT
        };
        session.joint(JOINT, frame, quality, state);
    }

    fn state(&mut self, state: MotorStatus, frame: &mut Received<'_>, session: &mut Session) {
        let MyactuatorKeys {
            speed_step,
            ampere_per_step,
            place_step,
            ..
        } = self.keys;
        self.velocity = HeldValue::new(frame, f64::from(state.speed) * speed_step);
        self.current = HeldValue::new(frame, f64::from(state.current) * ampere_per_step);
        if self.temperature.is_due((), frame) {
            frame.temperature(MOTOR, f64::from(state.celsius));
        }
        if self.keys.position != MyactuatorPosition::Status {
            return;
        }
        let is_end = |value: i16| value == i16::MIN || value == i16::MAX;
        // An encoder begins anew.
        let place = match self.keys.protocol {
            MyactuatorProtocol::V3 => i16::try_from(state.place).is_ok_and(is_end),
            MyactuatorProtocol::V2 => false,
        };
        let saturated = place || is_end(state.speed) || is_end(state.current);
        let position = f64::from(state.place) * place_step;
        self.joint(position, saturated, frame, session);
    }

    fn errors(&mut self, errors: u16, frame: &mut Received<'_>) {
        self.errors = errors;
        if self.told.is_due(errors, frame) {
            let reading = Reading::Actuator(Actuator {
                duty: f64::NAN,
                mode: 0,
                encoder: u32::from(errors & self.keys.encoder_errors()),
                faults: u32::from(errors),
            });
            let quality = self.keys.quality(errors);
            frame.tell(JOINT, quality, reading);
        }
    }

    fn motion(&self, data: &[u8], frame: &mut Received<'_>, session: &mut Session) {
        let measured = (data.split_first()).filter(|(id, _)| u16::from(**id) == self.keys.address);
        let Some((raw, _)) = measured.and_then(|(_, measured)| mit::unpack(measured)) else {
            return frame.fault(Counter::Value);
        };
        let (state, saturated) = mit::measured(self.keys.scales, raw);
        let quality = self.keys.quality(self.errors) | saturated;
        session.joint(JOINT, frame, quality, state);
    }
}

impl Driver for MyactuatorOptions {
    const NAME: &'static str = "myactuator";

    fn outputs(&self) -> Vec<OutputInfo> {
        let motor = OutputInfo::temperature(MOTOR, "motor");
        [OutputInfo::new(JOINT, Kind::Joint), motor].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let keys = MyactuatorKeys::new(spec, self)?;
        let mut claims = [Claim::exclusive(keys.answers())].to_vec();
        if keys.position == MyactuatorPosition::Motion {
            claims.insert(0, Claim::exclusive(keys.motion()));
        }
        let watched = claims.first().map_or(keys.answers(), |claim| claim.id);
        let bringup = Bringup::polled(spec, keys.request_period, watched);
        let this = MyactuatorMotor {
            keys,
            errors: 0,
            told: OnChange::NOTHING,
            temperature: OnChange::NOTHING,
            velocity: HeldValue::ABSENT,
            current: HeldValue::ABSENT,
            questions: Rounds::new(keys.request_period),
            of_errors: Rounds::new(keys.request_period.map(|_| ERRORS_PERIOD)),
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for MyactuatorMotor {
    type Questions = NoInquiry;

    #[allow(clippy::cast_precision_loss)] // an angle of 2^53 steps is none
    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let is_motion =
            self.keys.position == MyactuatorPosition::Motion && frame.id == self.keys.motion();
        if !is_motion && frame.id != self.keys.answers() {
            return;
        }
        let Some(data) = frame.payload_of(LENGTH) else {
            return;
        };
        if is_motion {
            return self.motion(data, frame, session);
        }
        let asks = session.bringup.mode() == Mode::Supervise;
        match Answer::parse(self.keys.protocol, asks, data) {
            Some(Answer::State(state)) => self.state(state, frame, session),
            Some(Answer::Angle(angle)) if self.keys.position == MyactuatorPosition::Angle => {
                self.joint(angle as f64 * self.keys.angle_step, false, frame, session);
            }
            Some(Answer::Errors(errors)) => self.errors(errors, frame),
            // Answers to other programs.
            Some(Answer::Angle(_)) | None => {}
        }
    }

    fn reset(&mut self) {
        self.errors = 0;
        self.told = OnChange::NOTHING;
        self.temperature = OnChange::NOTHING;
        (self.velocity, self.current) = (HeldValue::ABSENT, HeldValue::ABSENT);
    }

    fn request(&mut self, now: Nanos, _session: &mut Session, _out: &mut Decoded) -> Option<Frame> {
        let round: &[u8] = match self.keys.position {
            MyactuatorPosition::Angle => &[command::STATE, command::ANGLE],
            MyactuatorPosition::Status | MyactuatorPosition::Motion => &[command::STATE],
        };
        let errors = self.of_errors.ask(&[command::ERRORS], now);
        let command = errors.or_else(|| self.questions.ask(round, now))?;
        let data = [command, 0, 0, 0, 0, 0, 0, 0];
        Some(Frame::new(self.keys.commands(), &data))
    }

    fn request_at(&self) -> Option<Nanos> {
        self.questions.due().min(self.of_errors.due())
    }
}
