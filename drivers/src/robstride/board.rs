//! The device's own side: a motor that answers questions, or sends its state as if it were
//! commanded once a period.

use super::frames::{
    JOINT, LENGTH, MOTOR, OF_STATE, RUNNING, RobstrideState, fault, id, kind, parameter,
};
use super::options::{RobstrideKeys, RobstrideOptions, RobstrideProtocol};
use crate::family::quality_of;
use crate::{
    Board, EncodeError, Format, Frame, Frames, Id, Simulate, Spec, SpecError, board, bytes, mit,
};
use alloc::boxed::Box;
use proprio_topics::{JointState, Nanos, Quality, Reading};

/// The number of a simulated motor's processor.
const UID: [u8; 8] = [0x36, 0x31, 0x30, 0x14, 0x0B, 0x33, 0x33, 0x31];

/// A simulated motor.
#[derive(Debug)]
struct RobstrideBoard {
    keys: RobstrideKeys,
    joint: JointState,
    mode: u8,
    /// The six faults of a state, and those of a frame of their own.
    of_state: u8,
    faults: u32,
    /// Temperature \[0.1 degrees Celsius\].
    tenths: u16,
}

impl RobstrideBoard {
    /// The current state; an absent torque is 0.
    fn state(&self) -> Frame {
        let RobstrideKeys { address, host, .. } = self.keys;
        let state = RobstrideState {
            told: None,
            raw: mit::raw(self.keys.scales, &self.joint),
            tenths: self.tenths,
        };
        match self.keys.protocol {
            RobstrideProtocol::Private => {
                let upper = self.mode << 6 | self.of_state;
                Frame::new(id(kind::STATE, upper, address, host), &state.pack())
            }
            RobstrideProtocol::Mit => {
                Frame::new(Id::standard(host.into()), &state.pack_mit(address))
            }
        }
    }

    /// The frame about its faults.
    fn told_faults(&self) -> Frame {
        let RobstrideKeys { address, host, .. } = self.keys;
        let [a, b, c, d] = self.faults.to_le_bytes();
        match self.keys.protocol {
            RobstrideProtocol::Private => {
                let data = [a, b, c, d, 0, 0, 0, 0];
                Frame::new(id(kind::FAULT, 0, address, host), &data)
            }
            RobstrideProtocol::Mit => {
                Frame::new(Id::standard(host.into()), &[address, a, b, c, d, 0, 0, 0])
            }
        }
    }

    /// Sets the faults of a frame of their own, and sends it if they are new.
    fn set_faults(&mut self, faults: u32, out: &mut Frames) {
        if core::mem::replace(&mut self.faults, faults) != faults {
            let _ = out.try_push(self.told_faults());
        }
    }
}

impl Simulate for RobstrideOptions {
    /// A running motor at 25 degrees Celsius.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(RobstrideBoard {
            keys: RobstrideKeys::new(spec, self)?,
            joint: JointState {
                position: 0.0,
                velocity: 0.0,
                ..JointState::ABSENT
            },
            mode: RUNNING,
            of_state: 0,
            faults: 0,
            tenths: 250,
        }))
    }
}

impl Board for RobstrideBoard {
    /// Answers questions for its number and for parameters.
    #[allow(clippy::cast_possible_truncation)] // parameters have single precision
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let RobstrideKeys { address, .. } = self.keys;
        if self.keys.protocol == RobstrideProtocol::Mit
            || frame.format != Format::Classic
            || frame.len() != LENGTH
        {
            return;
        }
        let [destination, host, 0, kind] = frame.id.raw().to_le_bytes() else {
            return;
        };
        if destination != address || !matches!(frame.id, Id::Extended(_)) {
            return;
        }
        let answer = match kind {
            kind::DEVICE => Frame::new(id(kind::DEVICE, 0, address, 0xFE), &UID),
            kind::PARAMETER => {
                let asked = bytes::u16_le(frame.data(), 0);
                let (upper, value) = match asked {
                    parameter::POSITION => (0, self.joint.position),
                    parameter::VELOCITY => (0, self.joint.velocity),
                    parameter::CURRENT if self.joint.current.is_finite() => (0, self.joint.current),
                    parameter::CURRENT => (0, 0.0),
                    _ => (1, 0.0),
                };
                let ([low, high], [a, b, c, d]) =
                    (asked.to_le_bytes(), (value as f32).to_le_bytes());
                let data = [low, high, 0, 0, a, b, c, d];
                Frame::new(id(kind::PARAMETER, upper, address, host), &data)
            }
            _ => return,
        };
        let _ = out.try_push(answer);
    }

    fn period(&self) -> Option<Nanos> {
        let asked = self.keys.request_period.is_some();
        (!asked).then_some(self.keys.period)
    }

    fn present(&mut self, output: u8, reading: &Reading, quality: Quality) {
        let _ = self.encode(output, reading, quality, &mut Frames::new());
    }

    /// Faults beyond those of a state precede it in a frame of their own. The temperature is sent
    /// with the next joint reading.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // limited or masked
    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        match (output, reading) {
            (JOINT, Reading::Joint(joint)) => {
                board::finite(&[joint.position, joint.velocity])?;
                board::finite_or_absent(&[joint.torque])?;
                self.joint = *joint;
                let all = u32::from(self.of_state) << OF_STATE | self.faults;
                if board::has_other_faults(quality, quality_of(all, self.keys.encoder)) {
                    let set = |flag, bits: u32| if quality.contains(flag) { bits } else { 0 };
                    let of_state = set(Quality::DEVICE_FAULT, fault::MAGNETIC_ENCODER)
                        | set(Quality::DRIVE_FAULT, fault::OVER_TEMPERATURE);
                    self.of_state = (of_state >> OF_STATE) as u8;
                    let faults = match self.keys.protocol {
                        RobstrideProtocol::Private => 0,
                        // Bit 0: too hot.
                        RobstrideProtocol::Mit => {
                            set(Quality::DEVICE_FAULT, fault::NOT_CALIBRATED)
                                | set(Quality::DRIVE_FAULT, 1)
                        }
                    };
                    self.set_faults(faults, out);
                }
                let _ = out.try_push(self.state());
            }
            (JOINT, Reading::Actuator(actuator)) => {
                self.mode = actuator.mode as u8 & 3;
                self.of_state = (actuator.faults >> OF_STATE) as u8 & 0x3F;
                self.set_faults(actuator.faults & ((1 << OF_STATE) - 1), out);
            }
            (MOTOR, Reading::Temperature(temperature)) => {
                board::finite(&[temperature.celsius])?;
                self.tenths = bytes::quantise(temperature.celsius, 0.1, 0, 0xFFFF) as u16;
            }
            (JOINT | MOTOR, _) => return Err(EncodeError::Kind),
            _ => return Err(EncodeError::Output(output)),
        }
        Ok(())
    }
}
