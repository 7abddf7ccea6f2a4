//! The driver `icub_mc4`: Older iCub motor boards. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_mc4.md")]

use crate::bringup::{Bringup, NoInquiry};
use crate::bytes;
use crate::family::{Family, Link, Supervised};
use crate::held::Held;
use crate::icub::{self, class};
use crate::icub_motor::mode;
use crate::recognise::{Finding, Key, Stream, Traffic};
use crate::{
    Board, Claim, Decoded, Device, Driver, EncodeError, Frame, Frames, Mode, Output, OutputInfo,
    Outputs, Spec, SpecError,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use core::f64::consts::TAU;
use proprio_topics::{Actuator, Counter, JointState, Kind, Nanos, Quality, Reading};
use serde::Deserialize;

/// Types of the streams.
mod kind {
    pub(super) const POSITION: u8 = 0x1;
    pub(super) const STATUS: u8 = 0x3;
    pub(super) const VELOCITY: u8 = 0x7;
}

/// Bits of `Actuator::faults`.
pub mod fault {
    /// Emergency button pressed.
    pub const EXTERNAL: u32 = 1 << 2;
    /// The absolute encoder.
    pub const ABSOLUTE_ENCODER: u32 = 1 << 5;
    /// Bits that make a position doubtful: Hall sensors, absolute and optical encoder.
    pub const POSITION: u32 = 0b111 << 4;
    /// The bits of the board's byte that concern each joint: over-temperature, thermometer.
    pub const BOARD: [u32; JOINTS] = [0b01010 << 8, 0b10100 << 8];
    use super::JOINTS;
}

/// The mode of a joint that moves to its end, which tells its zero.
const CALIBRATION: u32 = 0x60;
/// The mode of a simulated joint.
const POSITION_CONTROL: u8 = 1;
/// The joints of an address.
const JOINTS: usize = 2;
/// The length of each frame.
const FRAME: usize = 8;
/// The modes of a joint.
const MODES: [u8; 8] = [0x00, 0x01, 0x02, 0x03, 0x50, 0x60, 0xA0, 0xB0];

/// The keys of `driver = "icub_mc4"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct IcubMc4Options {
    /// Ticks in a turn of each joint; default 65536.
    pub ticks_per_turn: [f64; JOINTS],
    /// How many bits a velocity is shifted, 0 to 15; default 5.
    pub velocity_shift: [u8; JOINTS],
    /// How long a velocity is used \[ms\], 1 to 1000; default 20.
    pub hold_ms: u32,
    /// Period of a simulated board \[ms\], 1 to 255; default 10.
    pub period_ms: u32,
}

impl Default for IcubMc4Options {
    fn default() -> Self {
        Self {
            ticks_per_turn: [65536.0; JOINTS],
            velocity_shift: [5; JOINTS],
            hold_ms: 20,
            period_ms: 10,
        }
    }
}

/// A step of a joint's position \[rad\] and velocity \[rad/s\].
#[derive(Debug, Clone, Copy)]
struct Scale {
    position: f64,
    velocity: f64,
}

impl IcubMc4Options {
    fn scales(&self) -> Result<[Scale; JOINTS], SpecError> {
        let wrong = |key, value, expected| SpecError::Key {
            key,
            value,
            expected,
        };
        if !(1..=1000).contains(&self.hold_ms) {
            return Err(wrong("hold_ms", f64::from(self.hold_ms), "1 to 1000"));
        }
        for ticks in self.ticks_per_turn {
            if !(ticks > 0.0 && ticks.is_finite()) {
                return Err(wrong("ticks_per_turn", ticks, "a number above 0"));
            }
        }
        for shift in self.velocity_shift {
            if shift > 15 {
                return Err(wrong("velocity_shift", f64::from(shift), "0 to 15"));
            }
        }
        let [ticks0, ticks1] = self.ticks_per_turn;
        let [shift0, shift1] = self.velocity_shift;
        Ok([(ticks0, shift0), (ticks1, shift1)].map(|(ticks, shift)| {
            let position = TAU / ticks;
            let velocity = position * 1000.0 / f64::from(1_u32 << shift);
            Scale { position, velocity }
        }))
    }
}

impl Driver for IcubMc4Options {
    const NAME: &'static str = "icub_mc4";

    fn outputs(&self) -> Vec<OutputInfo> {
        [0, 1]
            .map(|joint| OutputInfo::new(joint, Kind::Joint))
            .to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        Mc4::device(spec, self)
    }

    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(Mc4Board::new(spec, self)?))
    }

    fn recognise(seen: &Traffic) -> Vec<Finding> {
        let types = [icub::board::MC4, icub::board::BLL];
        icub::recognise(seen, Self::NAME, &types, &[], |evidence, address, _| {
            let id = |kind| icub::stream(class::PERIODIC_MOTOR, address, kind);
            let positions = evidence.sends_length(id(kind::POSITION), FRAME);
            // Newer boards have a status of the same identifier.
            if let Some(positions) = positions {
                if let Some(velocities) = evidence.sends_length(id(kind::VELOCITY), FRAME) {
                    evidence.together(velocities, positions);
                }
                evidence.sends(id(kind::STATUS), |frame| match *frame.data() {
                    [_, a, _, b, _, _, _, _] => MODES.contains(&a) && MODES.contains(&b),
                    _ => false,
                });
            }
            let keys = Key::period_ms(positions.and_then(Stream::period), 1, 255);
            (keys.into_iter().collect(), Vec::from([0, 1]))
        })
    }

    fn questions(seen: &Traffic) -> Vec<Frame> {
        icub::questions(seen)
    }
}

/// The quality of a joint's readings under these faults, in this mode.
fn quality_of(faults: u32, mode: u32) -> Quality {
    let mut quality = Quality::GOOD;
    if faults & fault::POSITION != 0 {
        quality |= Quality::DEVICE_FAULT;
    }
    if faults & !fault::POSITION != 0 || mode == mode::HARDWARE_FAULT {
        quality |= Quality::DRIVE_FAULT;
    }
    if matches!(mode, CALIBRATION | mode::NOT_CONFIGURED) {
        quality |= Quality::NOT_CALIBRATED;
    }
    quality
}

/// A joint of a board, as the host knows it.
#[derive(Debug)]
struct Joint {
    scale: Scale,
    velocity: Held,
    /// The quality from the last status.
    status: Quality,
}

/// The host's side of a board.
#[derive(Debug)]
struct Mc4 {
    address: u8,
    outputs: Outputs,
    hold: Nanos,
    joints: [Joint; JOINTS],
}

impl Mc4 {
    fn device(spec: &Spec, options: &IcubMc4Options) -> Result<Box<dyn Device>, SpecError> {
        let address = icub::address(spec)?;
        icub::period_ms("period_ms", options.period_ms)?;
        let joints = options.scales()?.map(|scale| Joint {
            scale,
            velocity: Held::ABSENT,
            status: Quality::GOOD,
        });
        let kinds = [kind::POSITION, kind::STATUS, kind::VELOCITY];
        let claims: ArrayVec<Claim, 3> = icub::claims(class::PERIODIC_MOTOR, address, &kinds);
        let watched = icub::stream(class::PERIODIC_MOTOR, address, kind::POSITION);
        let bringup = Bringup::new(spec, Mode::Listen, icub::TIMING, watched);
        let this = Self {
            address,
            outputs: spec.outputs.clone(),
            hold: Nanos::from_millis(i64::from(options.hold_ms)),
            joints,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }

    fn positions(&self, data: &[u8], frame: &Frame, link: &mut Link<NoInquiry>, out: &mut Decoded) {
        let gap = link.bringup.reading(frame.t);
        for (joint, output) in self.joints.iter().zip(0_u8..) {
            if !self.outputs.0.contains(&output) {
                continue;
            }
            let mut quality = joint.status;
            if quality.contains(Quality::DEVICE_FAULT) {
                out.fault(Counter::DeviceFault, 1, frame.id);
            }
            if quality.contains(Quality::DRIVE_FAULT) {
                out.fault(Counter::DriveFault, 1, frame.id);
            }
            if gap {
                quality |= Quality::GAP_BEFORE;
            }
            let ticks = bytes::u32_le(data, 4 * usize::from(output)).cast_signed();
            let reading = Reading::Joint(JointState {
                position: f64::from(ticks) * joint.scale.position,
                velocity: joint.velocity.at(frame, self.hold),
                ..JointState::ABSENT
            });
            out.push(Output::new(output, frame, quality, reading), frame.id);
        }
    }

    fn status(&mut self, data: &[u8], frame: &Frame, out: &mut Decoded) {
        let &[faults0, mode0, faults1, mode1, _, board, ..] = data else {
            return;
        };
        let told = [(faults0, mode0), (faults1, mode1)];
        let joints = self.joints.iter_mut().zip(told).zip(fault::BOARD);
        for (((joint, (faults, mode)), mask), output) in joints.zip(0_u8..) {
            let faults = u32::from(faults) | u32::from(board) << 8 & mask;
            let mode = u32::from(mode);
            joint.status = quality_of(faults, mode);
            let reading = Reading::Actuator(Actuator {
                duty: f64::NAN,
                mode,
                encoder: faults & fault::POSITION,
                faults,
            });
            if self.outputs.0.contains(&output) {
                out.push(Output::new(output, frame, joint.status, reading), frame.id);
            }
        }
    }
}

impl Family for Mc4 {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &Frame, link: &mut Link<NoInquiry>, out: &mut Decoded) {
        let stream = icub::stream_type(frame.id, class::PERIODIC_MOTOR, self.address);
        let Some(kind @ (kind::POSITION | kind::STATUS | kind::VELOCITY)) = stream else {
            return;
        };
        let Some(data) = bytes::payload(frame, out) else {
            return;
        };
        if data.len() != FRAME {
            return out.fault(Counter::Length, 1, frame.id);
        }
        match kind {
            kind::POSITION => self.positions(data, frame, link, out),
            kind::STATUS => self.status(data, frame, out),
            _ => {
                for (joint, at) in self.joints.iter_mut().zip([0, 2]) {
                    let steps = f64::from(bytes::i16_le(data, at));
                    joint.velocity = Held::new(frame, steps * joint.scale.velocity);
                }
            }
        }
    }

    fn reset(&mut self) {
        for joint in &mut self.joints {
            (joint.velocity, joint.status) = (Held::ABSENT, Quality::GOOD);
        }
    }
}

/// A joint of a simulated board.
#[derive(Debug)]
struct Simulated {
    scale: Scale,
    ticks: i32,
    /// None as long as no velocity is given.
    steps: Option<i16>,
    faults: u8,
    mode: u8,
}

/// The board's own side: it streams without commands. It sends positions when all its joints in use
/// are new.
#[derive(Debug)]
pub struct Mc4Board {
    address: u8,
    period: Nanos,
    joints: [Simulated; JOINTS],
    /// The joints in use, and those of them that are new, one bit each.
    used: u8,
    fresh: u8,
}

impl Mc4Board {
    /// A board that streams at once.
    ///
    /// # Errors
    /// [`SpecError`]: an address outside 1 to 14, a key out of range.
    pub fn new(spec: &Spec, options: &IcubMc4Options) -> Result<Self, SpecError> {
        let period = icub::period_ms("period_ms", options.period_ms)?;
        Ok(Self {
            address: icub::address(spec)?,
            period: Nanos::from_millis(i64::from(period)),
            joints: options.scales()?.map(|scale| Simulated {
                scale,
                ticks: 0,
                steps: None,
                faults: 0,
                mode: POSITION_CONTROL,
            }),
            used: spec.outputs.0.iter().fold(0, |all, joint| all | 1 << joint),
            fresh: 0,
        })
    }

    fn send(&self, kind: u8, data: [u8; FRAME], out: &mut Frames) {
        let id = icub::stream(class::PERIODIC_MOTOR, self.address, kind);
        let _ = out.try_push(Frame::new(id, &data));
    }

    fn send_status(&self, out: &mut Frames) {
        let [a, b] = &self.joints;
        let data = [a.faults, a.mode, b.faults, b.mode, 0, 0, 0, 0];
        self.send(kind::STATUS, data, out);
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
        let told = Quality::DEVICE_FAULT | Quality::DRIVE_FAULT | Quality::NOT_CALIBRATED;
        let known = quality_of(u32::from(joint.faults), u32::from(joint.mode));
        if known.0 != quality.0 & told.0 {
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
