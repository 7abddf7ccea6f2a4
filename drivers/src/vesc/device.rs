//! The host's side: joins speed and current to the positions.

use super::frames::{
    AMPERE_PER_STEP, COLDEST, DUTY_PER_STEP, FET, JOINT, KELVIN_PER_STEP, LENGTH, MOTOR, command,
};
use super::options::{VescKeys, VescOptions, VescPosition};
use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::bytes::{i16_be, u32_be};
use crate::family::{Family, Session, Supervised};
use crate::held::HeldValue;
use crate::received::Received;
use crate::{Claim, Device, Driver, Mode, OutputInfo, Spec, SpecError};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Actuator, JointState, Kind, Quality, Reading};

/// The host's side of a controller.
#[derive(Debug)]
pub(super) struct VescController {
    keys: VescKeys,
    velocity: HeldValue,
    /// Positive along the shaft's axis.
    current: HeldValue,
}

impl VescController {
    fn status(&mut self, data: &[u8], frame: &mut Received<'_>) {
        let [current, duty] = [4, 6].map(|at| i16_be(data, at));
        let velocity = f64::from(u32_be(data, 0).cast_signed()) * self.keys.velocity_step;
        self.velocity = HeldValue::new(frame, velocity);
        let amperes = match (current, duty) {
            (0, _) => 0.0,
            (_, 0) => f64::NAN,
            _ => f64::from(current) * f64::from(duty.signum()) * AMPERE_PER_STEP,
        };
        self.current = HeldValue::new(frame, amperes);
        let actuator = Reading::Actuator(Actuator {
            duty: f64::from(duty) * DUTY_PER_STEP,
            mode: 0,
            encoder: 0,
            faults: 0,
        });
        frame.tell(JOINT, Quality::GOOD, actuator);
    }

    fn position(&self, raw: i32, frame: &mut Received<'_>, session: &mut Session) {
        let hold = self.keys.hold;
        let current = self.current.at(frame, hold);
        let constant = self.keys.torque_constant.unwrap_or(f64::NAN);
        let state = JointState {
            position: f64::from(raw) * self.keys.position_step,
            velocity: self.velocity.at(frame, hold),
            torque: constant * current,
            current,
            ..JointState::ABSENT
        };
        session.joint(JOINT, frame, Quality::GOOD, state);
    }
}

impl Driver for VescOptions {
    const NAME: &'static str = "vesc";

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let keys = VescKeys::new(spec, self)?;
        let watched = keys.id(keys.with_position());
        let bringup = Bringup::new(spec, Mode::Listen, Timing::LISTENED, watched);
        let commands = [command::STATUS, command::STATUS_4, command::STATUS_5];
        let claims = commands.map(|command| Claim::exclusive(keys.id(command)));
        let this = VescController {
            keys,
            velocity: HeldValue::ABSENT,
            current: HeldValue::ABSENT,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for VescController {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let commands = [command::STATUS, command::STATUS_4, command::STATUS_5];
        let is_its = |command: &u8| self.keys.id(*command) == frame.id;
        let Some(command) = commands.into_iter().find(is_its) else {
            return;
        };
        let Some(data) = frame.payload_of(LENGTH) else {
            return;
        };
        match (command, self.keys.position) {
            (command::STATUS, _) => self.status(data, frame),
            (command::STATUS_4, position) => {
                for (output, at) in [(FET, 0), (MOTOR, 2)] {
                    let celsius = f64::from(i16_be(data, at)) * KELVIN_PER_STEP;
                    if celsius >= COLDEST {
                        frame.temperature(output, celsius);
                    }
                }
                if position == VescPosition::Pid {
                    self.position(i32::from(i16_be(data, 6)), frame, session);
                }
            }
            (_, VescPosition::Tachometer) => {
                self.position(u32_be(data, 0).cast_signed(), frame, session);
            }
            _ => {}
        }
    }

    fn reset(&mut self) {
        (self.velocity, self.current) = (HeldValue::ABSENT, HeldValue::ABSENT);
    }
}
