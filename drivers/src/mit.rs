//! Numbers of a motor's measurement as raw values of a range, and the three of the MIT's Mini
//! Cheetah, which many makers send: position of 16 bits, velocity and torque of 12 bits each.

use crate::bytes;
use proprio_topics::{JointState, Quality};

/// A raw value in SI units: `offset` + `step` x raw. At `least` and `most` it is saturated.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scale {
    step: f64,
    offset: f64,
    least: i64,
    most: i64,
}

impl Scale {
    /// From -`end` to `end` in `bits` bits.
    pub(crate) fn range(end: f64, bits: u32) -> Self {
        let most = (1_i64 << bits) - 1;
        Self {
            step: 2.0 * end / most as f64,
            offset: -end,
            least: 0,
            most,
        }
    }

    /// Steps of `step` on both sides of zero, up to `most`.
    pub(crate) const fn steps(step: f64, most: i64) -> Self {
        Self {
            step,
            offset: 0.0,
            least: -most,
            most,
        }
    }

    pub(crate) fn value(&self, raw: i64) -> f64 {
        self.offset + self.step * raw as f64
    }

    pub(crate) const fn is_saturated(&self, raw: i64) -> bool {
        raw <= self.least || raw >= self.most
    }

    /// The raw value nearest to `value`, limited to the range.
    pub(crate) fn raw(&self, value: f64) -> i64 {
        bytes::quantise(value - self.offset, self.step, self.least, self.most)
    }
}

/// The scales of position, velocity and torque, from minus these ends to them.
pub(crate) fn scales([position, velocity, torque]: [f64; 3]) -> [Scale; 3] {
    [
        Scale::range(position, 16),
        Scale::range(velocity, 12),
        Scale::range(torque, 12),
    ]
}

/// The state that these raw values of position, velocity and torque tell; SATURATED if one is at an
/// end of its range.
pub(crate) fn measured(scales: [Scale; 3], raw: [i64; 3]) -> (JointState, Quality) {
    let ([p, v, t], [position, velocity, torque]) = (scales, raw);
    let state = JointState {
        position: p.value(position),
        velocity: v.value(velocity),
        torque: t.value(torque),
        ..JointState::ABSENT
    };
    let mut ends = scales.iter().zip(raw);
    match ends.any(|(scale, raw)| scale.is_saturated(raw)) {
        true => (state, Quality::SATURATED),
        false => (state, Quality::GOOD),
    }
}

/// The raw position, velocity and torque nearest to `state`; an absent torque is 0.
pub(crate) fn raw([p, v, t]: [Scale; 3], state: &JointState) -> [i64; 3] {
    let torque = if state.torque.is_nan() {
        0.0
    } else {
        state.torque
    };
    [p.raw(state.position), v.raw(state.velocity), t.raw(torque)]
}

/// The raw position, velocity and torque in the first five bytes, and the bytes after them.
pub(crate) fn unpack(data: &[u8]) -> Option<([i64; 3], &[u8])> {
    let (&[p0, p1, v0, both, e1], rest) = data.split_first_chunk()?;
    let position = u16::from_be_bytes([p0, p1]);
    let velocity = u16::from(v0) << 4 | u16::from(both >> 4);
    let effort = u16::from(both & 0xF) << 8 | u16::from(e1);
    Some(([position, velocity, effort].map(i64::from), rest))
}

/// The five bytes of a raw position, velocity and torque, which are within their ranges.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(crate) fn pack(raw: [i64; 3]) -> [u8; 5] {
    let [position, velocity, effort] = raw.map(|raw| raw as u16);
    let ([p0, p1], [e0, e1]) = (position.to_be_bytes(), effort.to_be_bytes());
    let [v0, v1] = (velocity << 4).to_be_bytes();
    [p0, p1, v0, v1 | e0, e1]
}
