//! A shaft (a joint, or a motor of a coupling) and its inputs: one state out of what each gives.
//!
//! The input of the position makes the samples: its stamp, flags and sequence number are the
//! shaft's. The others' newest values are carried along ([`super::track`]) while they are fresh,
//! else they are absent. A fault belongs to what it spoils: an encoder's fault in another input
//! takes that input's velocity and acceleration away, and leaves the position as it is. A fault of
//! a device without a position, such as a torque sensor's, takes all that it gives away. A drive's
//! fault is passed on, as it condemns nothing.

use super::track::{ShaftState, Track};
use super::wrap::Turns;
use crate::config::JointQuantity;
use proprio_topics::{JointState, Nanos, Quality};

/// What is taken of an input: a set of quantities.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Takes(u8);

impl Takes {
    /// Everything.
    pub const ALL: Self = Self(0b1_1111);

    /// The quantities of a list.
    #[must_use]
    pub fn of(list: &[JointQuantity]) -> Self {
        Self(list.iter().fold(0, |set, q| set | 1 << *q as u8))
    }

    /// Whether `quantity` is in it.
    #[must_use]
    pub const fn has(self, quantity: JointQuantity) -> bool {
        self.0 >> quantity as u8 & 1 == 1
    }

    /// Its quantities.
    pub fn quantities(self) -> impl Iterator<Item = JointQuantity> {
        let all = [
            JointQuantity::Position,
            JointQuantity::Velocity,
            JointQuantity::Acceleration,
            JointQuantity::Torque,
            JointQuantity::Current,
        ];
        all.into_iter().filter(move |q| self.has(*q))
    }

    /// Puts these quantities of `from` in the place of those of `into`.
    fn copy(self, from: &JointState, into: &mut JointState) {
        for quantity in self.quantities() {
            match quantity {
                JointQuantity::Position => into.position = from.position,
                JointQuantity::Velocity => into.velocity = from.velocity,
                JointQuantity::Acceleration => into.acceleration = from.acceleration,
                JointQuantity::Torque => into.torque = from.torque,
                JointQuantity::Current => into.current = from.current,
            }
        }
    }
}

/// An input of a shaft while it runs.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RunningInput {
    takes: Takes,
    track: Track,
    /// The turns of a device that wraps.
    pub(crate) turns: Turns,
    /// The stamp of its last reading.
    pub(crate) last: Nanos,
    /// Its device or conversion was replaced: the next reading has ZERO_CHANGED.
    pub(crate) replaced: bool,
    /// The longest time for which a reading may be used \[ns\].
    pub(crate) max_silence: Nanos,
}

/// A shaft.
#[derive(Debug)]
pub(crate) struct Shaft {
    pub(crate) inputs: Vec<RunningInput>,
}

impl Shaft {
    /// A shaft whose inputs give this, and may be silent for so long \[ns\].
    pub(crate) fn new(inputs: impl Iterator<Item = (Takes, Nanos)>) -> Self {
        let input = |(takes, max_silence)| RunningInput {
            takes,
            track: Track::default(),
            turns: Turns::default(),
            last: Nanos::MIN,
            replaced: false,
            max_silence,
        };
        Self {
            inputs: inputs.map(input).collect(),
        }
    }

    /// Takes a reading of input number `place`. The shaft's state, if that input gives its
    /// position.
    pub(crate) fn push(&mut self, place: usize, measured: ShaftState) -> Option<ShaftState> {
        let input = self.inputs.get_mut(place)?;
        if !input.takes.has(JointQuantity::Position) {
            input.track.push(measured);
            return None;
        }
        let mut whole = ShaftState {
            state: JointState::ABSENT,
            ..measured
        };
        input.takes.copy(&measured.state, &mut whole.state);
        let others = (0..).zip(&self.inputs).filter(|(other, _)| *other != place);
        for (_, other) in others {
            let Some(mut held) = other.track.at(measured.acquired) else {
                continue;
            };
            if held.quality.contains(Quality::DEVICE_FAULT) && held.state.position.is_nan() {
                continue;
            }
            if held.quality.intersects(Quality::UNTRUSTED_ENCODER) {
                held.state.velocity = f64::NAN;
                held.state.acceleration = f64::NAN;
            }
            if held.quality.contains(Quality::DRIVE_FAULT) {
                whole.quality |= Quality::DRIVE_FAULT;
            }
            other.takes.copy(&held.state, &mut whole.state);
        }
        Some(whole)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::StampKind;

    /// What a fault of the second input takes away depends on whether it has a position.
    #[test]
    fn a_torque_sensors_fault_takes_its_torque() {
        let (good, fault) = (Quality::GOOD, Quality::DEVICE_FAULT);
        for (position, quality, torque_is_lost) in [
            (f64::NAN, good, false),
            (f64::NAN, fault, true),
            (7.0, good, false),
            (7.0, fault, false),
        ] {
            let takes =
                [[JointQuantity::Position], [JointQuantity::Torque]].map(|list| Takes::of(&list));
            let mut shaft = Shaft::new(takes.into_iter().map(|takes| (takes, Nanos(100))));
            let measured = |position, torque, quality| ShaftState {
                acquired: Nanos(0),
                stamp: StampKind::Software,
                device_time: Nanos::MIN,
                device_counter: 0,
                quality,
                state: JointState {
                    position,
                    torque,
                    ..JointState::ABSENT
                },
                max_silence: Nanos(100),
            };
            assert!(shaft.push(1, measured(position, 2.0, quality)).is_none());
            let whole = shaft.push(0, measured(1.0, f64::NAN, good)).unwrap();
            assert_eq!((whole.quality, whole.state.position), (good, 1.0));
            assert_eq!(whole.state.torque.is_nan(), torque_is_lost);
        }
    }
}
