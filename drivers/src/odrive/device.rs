//! The host's side: joins current and torque to the estimates, and asks for them if it is told to.

use super::firmware::{Firmware, error};
use super::frames::{FET, JOINT, LENGTH, MOTOR, command, is_request};
use super::options::{OdriveKeys, OdriveOptions};
use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Rounds, Session, Supervised};
use crate::held::HeldValue;
use crate::received::Received;
use crate::{Claim, Decoded, Device, Driver, Frame, Mode, OutputInfo, Spec, SpecError, bytes};
use alloc::boxed::Box;
use alloc::vec::Vec;
use core::f64::consts::TAU;
use proprio_topics::{Actuator, Counter, JointState, Kind, Nanos, Quality, Reading};

/// The float in half `half` of a payload.
fn float(data: &[u8], half: usize) -> f64 {
    f64::from(f32::from_bits(bytes::u32_le(data, 4 * half)))
}

/// The host's side of an axis.
#[derive(Debug)]
pub(super) struct OdriveAxis {
    keys: OdriveKeys,
    /// The quality from the last heartbeat.
    status: Quality,
    current: HeldValue,
    torque: HeldValue,
    requests: Rounds,
}

impl OdriveAxis {
    fn estimates(&self, data: &[u8], frame: &mut Received<'_>, session: &mut Session) {
        let (position, velocity) = (float(data, 0) * TAU, float(data, 1) * TAU);
        if !position.is_finite() {
            return session.lost(Counter::Value, 1, frame);
        }
        let current = self.current.at(frame, self.keys.hold);
        let torque = match self.keys.torque_constant {
            Some(constant) => constant * current,
            None => self.torque.at(frame, self.keys.hold),
        };
        let state = JointState {
            position,
            velocity: if velocity.is_finite() {
                velocity
            } else {
                f64::NAN
            },
            torque,
            current,
            ..JointState::ABSENT
        };
        session.joint(JOINT, frame, self.status, state);
    }

    fn heartbeat(&mut self, data: &[u8], frame: &mut Received<'_>) {
        let &[_, _, _, _, state, ref flags @ ..] = data else {
            return;
        };
        let mut faults = bytes::u32_le(data, 0);
        if self.keys.firmware == Firmware::V0_5 {
            for (flag, error) in flags.iter().zip(error::FLAGS) {
                faults |= if flag & 1 != 0 { error } else { 0 };
            }
        }
        self.status = self.keys.firmware.quality(faults);
        let reading = Reading::Actuator(Actuator {
            duty: f64::NAN,
            mode: u32::from(state),
            encoder: faults & self.keys.firmware.encoder_errors(),
            faults,
        });
        frame.tell(JOINT, self.status, reading);
    }
}

impl Driver for OdriveOptions {
    const NAME: &'static str = "odrive";

    fn outputs(&self) -> Vec<OutputInfo> {
        let temperature = OutputInfo::temperature;
        let joint = OutputInfo::new(JOINT, Kind::Joint);
        match self.firmware {
            Firmware::V0_5 => [joint].to_vec(),
            Firmware::V0_6 => {
                [joint, temperature(MOTOR, "motor"), temperature(FET, "fet")].to_vec()
            }
        }
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let keys = OdriveKeys::new(spec, self)?;
        let mode = match keys.request_period {
            Some(_) => spec.mode,
            None => Mode::Listen,
        };
        let bringup = Bringup::new(spec, mode, Timing::LISTENED, keys.id(command::ESTIMATES));
        let commands = keys.firmware.commands().iter();
        let claims = commands.map(|command| Claim::exclusive(keys.id(*command)));
        let this = OdriveAxis {
            keys,
            status: Quality::GOOD,
            current: HeldValue::ABSENT,
            torque: HeldValue::ABSENT,
            requests: Rounds::new(keys.request_period),
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for OdriveAxis {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let Some(command) = self.keys.command(frame.id) else {
            return;
        };
        if is_request(frame) {
            return;
        }
        let Some(data) = frame.payload_of(usize::from(LENGTH)) else {
            return;
        };
        match command {
            command::ESTIMATES => self.estimates(data, frame, session),
            command::IQ => self.current = HeldValue::new(frame, float(data, 1)),
            command::TORQUES => self.torque = HeldValue::new(frame, float(data, 1)),
            command::TEMPERATURE => {
                frame.temperature(FET, float(data, 0));
                frame.temperature(MOTOR, float(data, 1));
            }
            _ => self.heartbeat(data, frame),
        }
    }

    fn reset(&mut self) {
        self.status = Quality::GOOD;
        (self.current, self.torque) = (HeldValue::ABSENT, HeldValue::ABSENT);
    }

    fn request(&mut self, now: Nanos, _session: &mut Session, _out: &mut Decoded) -> Option<Frame> {
        let command = self.requests.ask(self.keys.firmware.requests(), now)?;
        Some(Frame::remote(self.keys.id(command), LENGTH))
    }

    fn request_at(&self) -> Option<Nanos> {
        self.requests.due()
    }
}
