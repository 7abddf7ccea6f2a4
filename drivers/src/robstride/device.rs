//! The host's side: takes the frames of one motor, and reads its parameters if it is told to.

use super::frames::{
    JOINT, LENGTH, MOTOR, OF_STATE, RUNNING, RobstrideMessage, RobstrideState, claim, id, kind,
    parameter,
};
use super::options::{RobstrideKeys, RobstrideOptions, RobstrideProtocol};
use crate::bringup::{Bringup, NoInquiry};
use crate::family::{Family, Rounds, Session, Supervised, quality_of};
use crate::held::{HeldValue, OnChange};
use crate::received::Received;
use crate::{Claim, Decoded, Device, Driver, Frame, Id, OutputInfo, Spec, SpecError, mit};
use alloc::boxed::Box;
use alloc::vec::Vec;
use proprio_topics::{Actuator, Counter, JointState, Kind, Nanos, Quality, Reading};

/// The host's side of a motor.
#[derive(Debug)]
pub(super) struct RobstrideMotor {
    keys: RobstrideKeys,
    /// As they were told last: mode; faults of a frame of their own; those of a state.
    mode: u8,
    faults: u32,
    of_state: u32,
    told: OnChange<(u8, u32)>,
    velocity: HeldValue,
    current: HeldValue,
    questions: Rounds,
}

impl RobstrideMotor {
    /// Tells mode and faults if they are new, and now and then. Returns whether it did.
    fn tell(&mut self, frame: &mut Received<'_>) -> bool {
        let faults = self.faults | self.of_state;
        let due = self.told.is_due((self.mode, faults), frame);
        if due {
            let reading = Reading::Actuator(Actuator {
                duty: f64::NAN,
                mode: u32::from(self.mode),
                encoder: faults & self.keys.encoder,
                faults,
            });
            frame.tell(JOINT, self.quality(), reading);
        }
        due
    }

    fn quality(&self) -> Quality {
        quality_of(self.faults | self.of_state, self.keys.encoder)
    }

    fn state(&mut self, state: &RobstrideState, frame: &mut Received<'_>, session: &mut Session) {
        if let Some((mode, faults)) = state.told {
            self.mode = mode;
            self.of_state = u32::from(faults) << OF_STATE;
            if mode == RUNNING && faults == 0 {
                self.faults = 0;
            }
        }
        if self.tell(frame) {
            frame.temperature(MOTOR, f64::from(state.tenths) / 10.0);
        }
        if self.keys.request_period.is_some() {
            return;
        }
        let (state, saturated) = mit::measured(self.keys.scales, state.raw);
        session.joint(JOINT, frame, self.quality() | saturated, state);
    }

    fn parameter(
        &mut self,
        (parameter, value): (u16, f64),
        frame: &mut Received<'_>,
        session: &mut Session,
    ) {
        // Answers to another program.
        let Some(period) = self.keys.request_period else {
            return;
        };
        match parameter {
            parameter::VELOCITY => self.velocity = HeldValue::new(frame, value),
            parameter::CURRENT => self.current = HeldValue::new(frame, value),
            parameter::POSITION if value.is_finite() => {
                let current = self.current.at(frame, period);
                let state = JointState {
                    position: value,
                    velocity: self.velocity.at(frame, period),
                    torque: self.keys.torque_constant.unwrap_or(f64::NAN) * current,
                    current,
                    ..JointState::ABSENT
                };
                session.joint(JOINT, frame, self.quality(), state);
            }
            parameter::POSITION => frame.fault(Counter::Value),
            _ => {}
        }
    }

    /// What `frame` tells.
    fn message(&self, frame: &mut Received<'_>) -> Option<RobstrideMessage> {
        let (address, host) = (self.keys.address, self.keys.host);
        let kind = match self.keys.protocol {
            RobstrideProtocol::Private => {
                let mut kinds = kind::READ.into_iter();
                Some(kinds.find(|kind| claim(*kind, address, host).matches(frame.id))?)
            }
            RobstrideProtocol::Mit if frame.id == Id::standard(host.into()) => None,
            RobstrideProtocol::Mit => return None,
        };
        let data = frame.payload_of(LENGTH)?;
        let [_, _, upper, _] = frame.id.raw().to_le_bytes();
        match kind {
            Some(kind) => Some(RobstrideMessage::of_private(kind, upper, data)),
            None => RobstrideMessage::of_mit(address, data),
        }
    }
}

impl Driver for RobstrideOptions {
    const NAME: &'static str = "robstride";

    fn outputs(&self) -> Vec<OutputInfo> {
        let motor = OutputInfo::temperature(MOTOR, "motor");
        [OutputInfo::new(JOINT, Kind::Joint), motor].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let keys = RobstrideKeys::new(spec, self)?;
        let (address, host) = (keys.address, keys.host);
        let mut claims = match keys.protocol {
            RobstrideProtocol::Private => {
                kind::READ.map(|kind| claim(kind, address, host)).to_vec()
            }
            RobstrideProtocol::Mit => [Claim::shared(Id::standard(host.into()))].to_vec(),
        };
        // What is watched is the first.
        if keys.request_period.is_some() {
            claims.swap(0, 1);
        }
        let watched = claims.first().map_or(Id::standard(0), |claim| claim.id);
        let bringup = Bringup::polled(spec, keys.request_period, watched);
        let this = RobstrideMotor {
            keys,
            mode: 0,
            faults: 0,
            of_state: 0,
            told: OnChange::NOTHING,
            velocity: HeldValue::ABSENT,
            current: HeldValue::ABSENT,
            questions: Rounds::new(keys.request_period),
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

impl Family for RobstrideMotor {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        match self.message(frame) {
            Some(RobstrideMessage::State(state)) => self.state(&state, frame, session),
            Some(RobstrideMessage::Faults(faults)) => {
                self.faults = faults & ((1 << OF_STATE) - 1);
                self.tell(frame);
            }
            Some(RobstrideMessage::Parameter(parameter, Some(value))) => {
                self.parameter((parameter, f64::from(value)), frame, session);
            }
            Some(RobstrideMessage::Parameter(parameter, None))
                if self.keys.request_period.is_some() && parameter::ASKED.contains(&parameter) =>
            {
                frame.fault(Counter::Value);
            }
            Some(RobstrideMessage::Parameter(_, None)) | None => {}
        }
    }

    fn reset(&mut self) {
        (self.mode, self.faults, self.of_state) = (0, 0, 0);
        self.told = OnChange::NOTHING;
        (self.velocity, self.current) = (HeldValue::ABSENT, HeldValue::ABSENT);
    }

    fn request(&mut self, now: Nanos, _session: &mut Session, _out: &mut Decoded) -> Option<Frame> {
        let [low, high] = (self.questions.ask(&parameter::ASKED, now)?).to_le_bytes();
        let id = id(kind::PARAMETER, 0, self.keys.host, self.keys.address);
        Some(Frame::new(id, &[low, high, 0, 0, 0, 0, 0, 0]))
    }

    fn request_at(&self) -> Option<Nanos> {
        self.questions.due()
    }
}
