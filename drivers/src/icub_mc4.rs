//! The driver `icub_mc4`: Older iCub motor boards. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/icub_mc4.md")]

#[cfg(feature = "boards")]
mod board;
#[cfg(feature = "recognise")]
mod recognise;

use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::family::{Family, Session, Supervised, quality_of};
use crate::held::HeldValue;
use crate::icub::{self, class};
use crate::icub_motor::mode;
use crate::received::Received;
use crate::{Device, Driver, Mode, OutputInfo, Outputs, Spec, SpecError, bytes, keys};
use alloc::boxed::Box;
use alloc::vec::Vec;
use core::f64::consts::TAU;
use proprio_topics::{Actuator, JointState, Kind, Nanos, Quality, Reading};
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
struct StepSizes {
    position: f64,
    velocity: f64,
}

impl IcubMc4Options {
    fn hold(&self) -> Result<Nanos, SpecError> {
        keys::ms("hold_ms", self.hold_ms, 1..=1000, "1 to 1000")
    }

    fn scales(&self) -> Result<[StepSizes; JOINTS], SpecError> {
        for ticks in self.ticks_per_turn {
            keys::above_zero("ticks_per_turn", ticks)?;
        }
        for shift in self.velocity_shift {
            keys::within("velocity_shift", shift, 0..=15, "0 to 15")?;
        }
        let [ticks0, ticks1] = self.ticks_per_turn;
        let [shift0, shift1] = self.velocity_shift;
        Ok([(ticks0, shift0), (ticks1, shift1)].map(|(ticks, shift)| {
            let position = TAU / ticks;
            let velocity = position * 1000.0 / f64::from(1_u32 << shift);
            StepSizes { position, velocity }
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
        let address = icub::address(spec)?;
        icub::period_ms("period_ms", self.period_ms)?;
        let hold = self.hold()?;
        let joints = self.scales()?.map(|scale| Mc4Joint {
            scale,
            velocity: HeldValue::ABSENT,
            status: Quality::GOOD,
        });
        let kinds = [kind::POSITION, kind::STATUS, kind::VELOCITY];
        let claims = icub::claims(class::PERIODIC_MOTOR, address, &kinds);
        let watched = icub::stream(class::PERIODIC_MOTOR, address, kind::POSITION);
        let bringup = Bringup::new(spec, Mode::Listen, Timing::USUAL, watched);
        let this = Mc4 {
            address,
            outputs: spec.outputs.clone(),
            hold,
            joints,
        };
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

/// The quality of a joint's readings under these faults, in this mode.
fn status_quality(faults: u32, mode: u32) -> Quality {
    let mut quality = quality_of(faults, fault::POSITION);
    if mode == mode::HARDWARE_FAULT {
        quality |= Quality::DRIVE_FAULT;
    }
    if matches!(mode, CALIBRATION | mode::NOT_CONFIGURED) {
        quality |= Quality::NOT_CALIBRATED;
    }
    quality
}

/// A joint of a board, as the host knows it.
#[derive(Debug)]
struct Mc4Joint {
    scale: StepSizes,
    velocity: HeldValue,
    /// The quality from the last status.
    status: Quality,
}

/// The host's side of a board.
#[derive(Debug)]
struct Mc4 {
    address: u8,
    outputs: Outputs,
    hold: Nanos,
    joints: [Mc4Joint; JOINTS],
}

impl Mc4 {
    fn positions(&self, data: &[u8], frame: &mut Received<'_>, session: &mut Session) {
        let gap = session.bringup.reading(frame.t);
        for (joint, output) in self.joints.iter().zip(0_u8..) {
            if !self.outputs.0.contains(&output) {
                continue;
            }
            let mut quality = joint.status;
            frame.faults_in(quality);
            if gap {
                quality |= Quality::GAP_BEFORE;
            }
            let ticks = bytes::u32_le(data, 4 * usize::from(output)).cast_signed();
            let reading = Reading::Joint(JointState {
                position: f64::from(ticks) * joint.scale.position,
                velocity: joint.velocity.at(frame, self.hold),
                ..JointState::ABSENT
            });
            frame.tell(output, quality, reading);
        }
    }

    fn status(&mut self, data: &[u8], frame: &mut Received<'_>) {
        let &[faults0, mode0, faults1, mode1, _, shared, ..] = data else {
            return;
        };
        let reports = [(faults0, mode0), (faults1, mode1)];
        let joints = self.joints.iter_mut().zip(reports).zip(fault::BOARD);
        for (((joint, (faults, mode)), mask), output) in joints.zip(0_u8..) {
            let faults = u32::from(faults) | u32::from(shared) << 8 & mask;
            let mode = u32::from(mode);
            joint.status = status_quality(faults, mode);
            let reading = Reading::Actuator(Actuator {
                duty: f64::NAN,
                mode,
                encoder: faults & fault::POSITION,
                faults,
            });
            if self.outputs.0.contains(&output) {
                frame.tell(output, joint.status, reading);
            }
        }
    }
}

impl Family for Mc4 {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        let stream = icub::stream_type(frame.id, class::PERIODIC_MOTOR, self.address);
        let Some(kind @ (kind::POSITION | kind::STATUS | kind::VELOCITY)) = stream else {
            return;
        };
        let Some(data) = frame.payload_of(FRAME) else {
            return;
        };
        match kind {
            kind::POSITION => self.positions(data, frame, session),
            kind::STATUS => self.status(data, frame),
            _ => {
                for (joint, at) in self.joints.iter_mut().zip([0, 2]) {
                    let steps = f64::from(bytes::i16_le(data, at));
                    joint.velocity = HeldValue::new(frame, steps * joint.scale.velocity);
                }
            }
        }
    }

    fn reset(&mut self) {
        for joint in &mut self.joints {
            (joint.velocity, joint.status) = (HeldValue::ABSENT, Quality::GOOD);
        }
    }
}
