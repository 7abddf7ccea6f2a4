//! The driver `moteus`: moteus controllers. What follows is its page of the book.
#![doc = include_str!("../../docs/book/src/devices/moteus.md")]

#[cfg(feature = "boards")]
mod board;
#[cfg(feature = "recognise")]
mod recognise;

use crate::bringup::{Bringup, NoInquiry, Timing};
use crate::bytes::{i16_le, u32_le};
use crate::family::{Family, Session, Supervised, next_in_step};
use crate::held::OnChange;
use crate::received::Received;
use crate::{
    Claim, Decoded, Device, Driver, Format, Frame, Id, Mode, NotSent, OutputInfo, Spec, SpecError,
    keys,
};
use alloc::boxed::Box;
use alloc::vec::Vec;
use arrayvec::ArrayVec;
use core::f64::consts::TAU;
use proprio_topics::{Actuator, Counter, JointState, Kind, Nanos, Quality, Reading, Temperature};
use serde::Deserialize;

/// Registers.
mod register {
    pub(super) const MODE: u32 = 0x0;
    pub(super) const POSITION: u32 = 0x1;
    pub(super) const VELOCITY: u32 = 0x2;
    pub(super) const TORQUE: u32 = 0x3;
    pub(super) const VOLTAGE: u32 = 0xD;
    pub(super) const TEMPERATURE: u32 = 0xE;
    pub(super) const FAULT: u32 = 0xF;
}

/// Opcodes without type and count.
const READ: u8 = 0x10;
const REPLY: u8 = 0x20;
const WRITE_ERROR: u8 = 0x30;
const READ_ERROR: u8 = 0x31;
const NOTHING: u8 = 0x50;
/// Mode and three others as i8, three as f32.
const QUERY: [u8; 6] = [0x11, 0x00, 0x1F, 0x01, 0x13, 0x0D];
/// Asks for a reply.
const WANTED: u16 = 0x8000;
/// Mode of a controller with a fault.
const MODE_FAULT: f64 = 1.0;
/// Faults that concern the position.
const POSITION_FAULTS: [u32; 4] = [35, 36, 42, 43];
/// The fault of a simulated controller: of the encoder, or too hot.
const ENCODER_FAULT: f64 = 35.0;
const TOO_HOT: f64 = 38.0;

/// The keys of `driver = "moteus"`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[cfg_attr(test, derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields, default)]
pub struct MoteusOptions {
    /// Period of the queries \[ms\], 1 to 1000; default 2.
    pub period_ms: u32,
    /// The host's own address; default 0.
    pub host: u8,
}

impl Default for MoteusOptions {
    fn default() -> Self {
        Self {
            period_ms: 2,
            host: 0,
        }
    }
}

impl MoteusOptions {
    /// The controller's address and the period.
    fn check(&self, spec: &Spec) -> Result<(u8, Nanos), SpecError> {
        let node = keys::address(spec, 1..=127)?;
        let period = keys::ms("period_ms", self.period_ms, 1..=1000, "1 to 1000")?;
        if self.host > 127 || self.host == node {
            let expected = "0 to 127, and not the controller's address";
            return Err(SpecError::key("host", self.host, expected));
        }
        Ok((node, period))
    }
}

impl Driver for MoteusOptions {
    const NAME: &'static str = "moteus";
    const ADDRESS: Option<u32> = Some(1);

    fn needs_fd(&self) -> bool {
        true
    }

    fn outputs(&self) -> Vec<OutputInfo> {
        [OutputInfo::new(0, Kind::Joint)].to_vec()
    }

    fn device(&self, spec: &Spec) -> Result<Box<dyn Device>, SpecError> {
        let (node, period) = self.check(spec)?;
        let reply = id(node, self.host, 0);
        let query = id(self.host, node, WANTED);
        let bringup = Bringup::new(spec, spec.mode, Timing::POLLED, reply);
        let Some(query) = fd(query, &QUERY) else {
            return Err(SpecError::Joints("the query does not fit a frame"));
        };
        let this = MoteusController {
            query,
            reply,
            period,
            next: Nanos::MIN,
            asked: false,
            mode: 0,
            fault: 0,
            actuator: OnChange::NOTHING,
            temperature: OnChange::NOTHING,
        };
        let claims = [Claim::exclusive(reply)];
        Ok(Supervised::boxed(claims, bringup, NoInquiry, this))
    }
}

/// The identifier of a frame from `source` to `destination`.
fn id(source: u8, destination: u8, flags: u16) -> Id {
    let raw = flags | u16::from(source) << 8 | u16::from(destination);
    if raw > 0x7FF {
        Id::extended(u32::from(raw))
    } else {
        Id::standard(raw)
    }
}

/// A frame with `data`, filled up to a length that CAN FD has.
fn fd(id: Id, data: &[u8]) -> Option<Frame> {
    const LENGTHS: [usize; 7] = [12, 16, 20, 24, 32, 48, 64];
    let length = match data.len() {
        short @ 0..=8 => short,
        long => LENGTHS.into_iter().find(|length| *length >= long)?,
    };
    let mut filled: ArrayVec<u8, 64> = data.iter().copied().take(64).collect();
    while filled.len() < length {
        filled.push(NOTHING);
    }
    let format = Format::fd(true, false);
    Frame::with_format(id, format, &filled)
}

/// The type of the numbers of a subframe.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Type {
    I8,
    I16,
    I32,
    F32,
}

impl Type {
    const fn of(opcode: u8) -> Self {
        match opcode >> 2 & 3 {
            0 => Self::I8,
            1 => Self::I16,
            2 => Self::I32,
            _ => Self::F32,
        }
    }

    const fn bytes(self) -> usize {
        match self {
            Self::I8 => 1,
            Self::I16 => 2,
            Self::I32 | Self::F32 => 4,
        }
    }

    /// The number in `data`; the lowest integer is not a number.
    fn number(self, data: &[u8]) -> f64 {
        let integer = |value: i32, lowest: i32| match value {
            value if value == lowest => f64::NAN,
            value => f64::from(value),
        };
        match self {
            Self::I8 => {
                let byte = data.first().map_or(0, |byte| byte.cast_signed());
                integer(i32::from(byte), i32::from(i8::MIN))
            }
            Self::I16 => integer(i32::from(i16_le(data, 0)), i32::from(i16::MIN)),
            Self::I32 => integer(u32_le(data, 0).cast_signed(), i32::MIN),
            Self::F32 => f64::from(f32::from_bits(u32_le(data, 0))),
        }
    }

    /// One step of `register` in this type, in the register's unit.
    fn step(self, register: u32) -> f64 {
        let steps = match register {
            register::POSITION => [0.01, 1e-4, 1e-5],
            register::VELOCITY => [0.1, 2.5e-4, 1e-5],
            register::TORQUE => [0.5, 0.01, 0.001],
            register::VOLTAGE => [0.5, 0.1, 0.001],
            register::TEMPERATURE => [1.0, 0.1, 0.001],
            _ => [1.0; 3],
        };
        let [i8_step, i16_step, i32_step] = steps;
        match self {
            Self::I8 => i8_step,
            Self::I16 => i16_step,
            Self::I32 => i32_step,
            Self::F32 => 1.0,
        }
    }
}

/// Reads the numbers of a frame from the left.
#[derive(Debug)]
struct Cursor<'d>(&'d [u8]);

impl<'d> Cursor<'d> {
    fn take(&mut self, bytes: usize) -> Option<&'d [u8]> {
        let (taken, rest) = self.0.split_at_checked(bytes)?;
        self.0 = rest;
        Some(taken)
    }

    fn byte(&mut self) -> Option<u8> {
        self.take(1)?.first().copied()
    }

    /// Seven bits a byte, the lowest first; the highest bit of a byte says that one follows.
    fn varuint(&mut self) -> Option<u32> {
        let mut value = 0;
        for shift in [0, 7, 14, 21] {
            let byte = self.byte()?;
            value |= u32::from(byte & 0x7F) << shift;
            if byte & 0x80 == 0 {
                return Some(value);
            }
        }
        None
    }

    /// The type, the count and the first register of the subframe with this opcode.
    fn registers(&mut self, opcode: u8) -> Option<(Type, u32, u32)> {
        let count = match opcode & 3 {
            0 => self.varuint()?,
            count => u32::from(count),
        };
        Some((Type::of(opcode), count, self.varuint()?))
    }
}

/// What a reply tells.
#[derive(Debug, Clone, Copy, Default)]
struct Reply {
    mode: Option<f64>,
    position: Option<f64>,
    velocity: Option<f64>,
    torque: Option<f64>,
    temperature: Option<f64>,
    fault: Option<f64>,
    /// The bits of its form: what arbitrary bytes do not have.
    structure: u32,
}

/// Four bits of an opcode are fixed, and four of a register that is read here; all of a filler.
const BITS: u32 = 4;

impl Reply {
    /// Reads a reply; `None` if it is none, or cut off.
    fn parse(data: &[u8]) -> Option<Self> {
        let (mut told, mut cursor) = (Self::default(), Cursor(data));
        let mut replies = false;
        while let Some(opcode) = cursor.byte() {
            match opcode {
                REPLY..WRITE_ERROR => {
                    let (kind, count, first) = cursor.registers(opcode)?;
                    replies = true;
                    told.structure += BITS + if first <= register::FAULT { BITS } else { 0 };
                    for register in first..first.checked_add(count)? {
                        let number = kind.number(cursor.take(kind.bytes())?);
                        told.set(register, number * kind.step(register));
                    }
                }
                WRITE_ERROR | READ_ERROR => {
                    cursor.varuint()?;
                    cursor.varuint()?;
                    replies = true;
                }
                NOTHING => told.structure += 2 * BITS,
                _ => return None,
            }
        }
        replies.then_some(told)
    }

    const fn set(&mut self, register: u32, value: f64) {
        let place = match register {
            register::MODE => &mut self.mode,
            register::POSITION => &mut self.position,
            register::VELOCITY => &mut self.velocity,
            register::TORQUE => &mut self.torque,
            register::TEMPERATURE => &mut self.temperature,
            register::FAULT => &mut self.fault,
            _ => return,
        };
        *place = Some(value);
    }
}

/// The host's side of a controller.
#[derive(Debug)]
struct MoteusController {
    query: Frame,
    reply: Id,
    period: Nanos,
    next: Nanos,
    /// Whether a query has no reply yet.
    asked: bool,
    /// The last mode and fault.
    mode: u32,
    fault: u32,
    actuator: OnChange<(u32, u32)>,
    temperature: OnChange<()>,
}

impl MoteusController {
    fn quality(&self) -> Quality {
        let mut quality = Quality::GOOD;
        if f64::from(self.mode) == MODE_FAULT {
            quality |= Quality::DRIVE_FAULT;
            if POSITION_FAULTS.contains(&self.fault) {
                quality |= Quality::DEVICE_FAULT;
            }
        }
        quality
    }
}

impl Family for MoteusController {
    type Questions = NoInquiry;

    fn on_frame(&mut self, frame: &mut Received<'_>, session: &mut Session) {
        // Short frames are sent as classic ones by some programs.
        let Some(data) = frame.fd_payload() else {
            return;
        };
        if frame.id != self.reply {
            return;
        }
        let Some(told) = Reply::parse(data) else {
            return frame.fault(Counter::Value);
        };
        // A reply to nobody is an old one, which a queue of an adapter has held back.
        if session.bringup.mode() == Mode::Supervise && !core::mem::take(&mut self.asked) {
            return frame.fault(Counter::Unexpected);
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // casts saturate
        let code = |value: f64| value.max(0.0) as u32;
        if let Some(fault) = told.fault {
            self.fault = code(fault);
        }
        if let Some(mode) = told.mode {
            self.mode = code(mode);
        }
        if (told.mode.is_some() || told.fault.is_some())
            && self.actuator.is_due((self.mode, self.fault), frame)
        {
            let reading = Reading::Actuator(Actuator {
                duty: f64::NAN,
                mode: self.mode,
                encoder: 0,
                faults: self.fault,
            });
            frame.tell(0, self.quality(), reading);
        }
        if let Some(celsius) = told.temperature.filter(|celsius| celsius.is_finite())
            && self.temperature.is_due((), frame)
        {
            let reading = Reading::Temperature(Temperature { celsius });
            frame.tell(0, Quality::GOOD, reading);
        }
        let Some(position) = told.position else {
            return;
        };
        if !position.is_finite() {
            return frame.fault(Counter::Value);
        }
        let finite = |value: Option<f64>| value.filter(|v| v.is_finite()).unwrap_or(f64::NAN);
        let state = JointState {
            position: position * TAU,
            velocity: finite(told.velocity) * TAU,
            torque: finite(told.torque),
            ..JointState::ABSENT
        };
        session.joint(0, frame, self.quality(), state);
    }

    fn reset(&mut self) {
        (self.mode, self.fault) = (0, 0);
        (self.actuator, self.temperature) = (OnChange::NOTHING, OnChange::NOTHING);
    }

    fn request(&mut self, now: Nanos, _session: &mut Session, _out: &mut Decoded) -> Option<Frame> {
        if now < self.next {
            return None;
        }
        self.next = next_in_step(self.next, self.period, now);
        self.asked = true;
        Some(self.query)
    }

    fn on_sent(&mut self, _frame: &Frame, outcome: Result<Nanos, NotSent>) {
        self.asked &= outcome.is_ok();
    }

    fn interrupt(&mut self) {
        self.asked = false;
    }

    fn request_at(&self) -> Option<Nanos> {
        Some(self.next)
    }
}
