//! The device's own side: a controller that answers queries.

use super::{
    Cursor, ENCODER_FAULT, MODE_FAULT, MoteusOptions, NOTHING, QUERY, READ, REPLY, TOO_HOT, Type,
    fd, id, register,
};
use crate::{
    Board, EncodeError, Format, Frame, Frames, Id, Simulate, Spec, SpecError, board, bytes,
};
use alloc::boxed::Box;
use arrayvec::ArrayVec;
use core::f64::consts::TAU;
use proprio_topics::{JointState, Nanos, Quality, Reading, Temperature};

/// The controller's own side: answers queries with the joint's state.
#[derive(Debug)]
struct MoteusBoard {
    node: u8,
    /// The host to which readings are encoded that nobody has asked for.
    host: u8,
    joint: JointState,
    celsius: f64,
    quality: Quality,
}

/// The supply of a simulated controller \[V\].
const SUPPLY: f64 = 24.0;

impl MoteusBoard {
    /// The value of a register in its unit.
    fn value(&self, register: u32) -> f64 {
        let (sensor, drive) = (
            self.quality.contains(Quality::DEVICE_FAULT),
            self.quality.contains(Quality::DRIVE_FAULT),
        );
        match register {
            register::MODE if sensor || drive => MODE_FAULT,
            register::POSITION => self.joint.position / TAU,
            register::VELOCITY => self.joint.velocity / TAU,
            register::TORQUE => self.joint.torque,
            register::VOLTAGE => SUPPLY,
            register::TEMPERATURE => self.celsius,
            register::FAULT if sensor => ENCODER_FAULT,
            register::FAULT if drive => TOO_HOT,
            // Without a fault the mode is 0, stopped; and so is a register that it does not have.
            _ => 0.0,
        }
    }

    /// The reply to `query`; `None` if it is no query.
    fn reply(&self, query: &[u8]) -> Option<ArrayVec<u8, 64>> {
        let (mut reply, mut cursor) = (ArrayVec::new(), Cursor(query));
        while let Some(opcode) = cursor.byte() {
            if opcode == NOTHING {
                continue;
            }
            if !(READ..REPLY).contains(&opcode) {
                return None;
            }
            let (kind, count, first) = cursor.registers(opcode)?;
            let low = u8::try_from(count).ok().filter(|count| *count <= 32)?;
            reply
                .try_push(REPLY | opcode & 0xC | if low > 3 { 0 } else { low })
                .ok()?;
            if low > 3 {
                reply.try_push(low).ok()?;
            }
            reply
                .try_push(u8::try_from(first).ok().filter(|first| *first < 0x80)?)
                .ok()?;
            for register in first..first + count {
                let value = self.value(register);
                reply
                    .try_extend_from_slice(&number(kind, register, value))
                    .ok()?;
            }
        }
        (!reply.is_empty()).then_some(reply)
    }
}

/// The bytes of `value`, in a register's unit.
#[allow(clippy::cast_possible_truncation)] // quantised to the type
fn number(kind: Type, register: u32, value: f64) -> ArrayVec<u8, 4> {
    let step = kind.step(register);
    let whole = |most: i64| match value {
        value if value.is_finite() => bytes::quantise(value, step, -most, most),
        _ => -most - 1,
    };
    let mut number = ArrayVec::new();
    let _ = match kind {
        Type::I8 => number.try_extend_from_slice(&(whole(127) as i8).to_le_bytes()),
        Type::I16 => number.try_extend_from_slice(&(whole(32767) as i16).to_le_bytes()),
        Type::I32 => {
            number.try_extend_from_slice(&(whole(i64::from(i32::MAX)) as i32).to_le_bytes())
        }
        Type::F32 => number.try_extend_from_slice(&(value as f32).to_le_bytes()),
    };
    number
}

impl Simulate for MoteusOptions {
    /// A controller after power-on.
    fn board(&self, spec: &Spec) -> Result<Box<dyn Board>, SpecError> {
        Ok(Box::new(MoteusBoard {
            node: self.check(spec)?.0,
            host: self.host,
            joint: JointState::ABSENT,
            celsius: 25.0,
            quality: Quality::GOOD,
        }))
    }
}

impl Board for MoteusBoard {
    fn on_frame(&mut self, frame: &Frame, out: &mut Frames) {
        let Id::Extended(raw) = frame.id else { return };
        let [node, source, 0, 0] = raw.to_le_bytes() else {
            return;
        };
        if node != self.node || source & 0x80 == 0 || frame.format == Format::Remote {
            return;
        }
        let reply = self.reply(frame.data());
        let reply = reply.and_then(|data| fd(id(self.node, source & 0x7F, 0), &data));
        out.extend(reply.into_iter().take(out.remaining_capacity()));
    }

    fn period(&self) -> Option<Nanos> {
        None
    }

    fn present(&mut self, _output: u8, reading: &Reading, quality: Quality) {
        match reading {
            Reading::Joint(joint) => (self.joint, self.quality) = (*joint, quality),
            Reading::Temperature(Temperature { celsius }) => self.celsius = *celsius,
            _ => {}
        }
    }

    fn encode(
        &mut self,
        output: u8,
        reading: &Reading,
        quality: Quality,
        out: &mut Frames,
    ) -> Result<(), EncodeError> {
        let joint = match reading {
            Reading::Joint(joint) => joint,
            // They are sent with the joint's state.
            Reading::Actuator(_) | Reading::Temperature(_) => {
                self.present(output, reading, quality);
                return Ok(());
            }
            _ => return Err(EncodeError::Kind),
        };
        board::only_output(output)?;
        board::finite(&[joint.position])?;
        (self.joint, self.quality) = (*joint, quality);
        let reply = self.reply(&QUERY);
        let reply = reply.and_then(|data| fd(id(self.node, self.host, 0), &data));
        out.extend(reply.into_iter().take(out.remaining_capacity()));
        Ok(())
    }
}
