//! The motors of a coupling, brought together to one instant.
//!
//! The joints of a coupling have a state when every motor has given a new reading since the last
//! one. It has the stamp of the newest reading; the others are carried to that stamp
//! ([`super::track`]). They are younger than the period of their own device, or, where frames are
//! lost, than its maximum silence. While a motor is silent there is no state, and the joints'
//! channels become stale.

use super::matrix::Matrix;
use super::track::{ShaftState, Track};
use proprio_topics::{Nanos, Quality, StampKind};

/// Flags of what happened since the reading before; the others tell of one reading alone.
const EVENTS: Quality = Quality(Quality::GAP_BEFORE.0 | Quality::ZERO_CHANGED.0);

#[derive(Debug, Clone, Copy, Default)]
struct MotorTrack {
    track: Track,
    is_new: bool,
    /// Events since the last state.
    events: Quality,
    /// Its part of the present state.
    now: Option<ShaftState>,
}

/// A coupling while it runs.
#[derive(Debug)]
pub(crate) struct CoupledMotors {
    matrix: Matrix,
    motors: Vec<MotorTrack>,
}

impl CoupledMotors {
    /// A coupling without readings.
    pub(crate) fn new(matrix: Matrix, motors: usize) -> Self {
        Self {
            matrix,
            motors: vec![MotorTrack::default(); motors],
        }
    }

    /// Takes a state of motor number `place`. Whether the joints have a new state with it, which
    /// [`CoupledMotors::joint`] gives.
    pub(crate) fn push(&mut self, place: usize, measured: ShaftState) -> bool {
        if let Some(motor) = self.motors.get_mut(place) {
            motor.events |= Quality(measured.quality.0 & EVENTS.0);
            motor.track.push(measured);
            motor.is_new = true;
        }
        let newest = |motor: &MotorTrack| motor.track.newest().filter(|_| motor.is_new).copied();
        if self.motors.iter().any(|motor| newest(motor).is_none()) {
            return false;
        }
        let stamps = self
            .motors
            .iter()
            .filter_map(newest)
            .map(|m| (m.acquired, m.stamp));
        let (t, stamp) = (stamps.max_by_key(|(t, _)| *t)).unwrap_or((Nanos::MIN, StampKind::None));
        for motor in &mut self.motors {
            // One that is no longer fresh has to give another.
            motor.is_new = motor.track.at(t).is_some();
        }
        if !self.motors.iter().all(|motor| motor.is_new) {
            return false;
        }
        for motor in &mut self.motors {
            motor.is_new = false;
            let events = std::mem::take(&mut motor.events);
            motor.now = motor.track.at(t).map(|now| ShaftState {
                acquired: t,
                stamp,
                quality: Quality(now.quality.0 & !EVENTS.0) | events,
                ..now
            });
        }
        true
    }

    /// The present state of joint number `joint`; its flags are those of the motors that move it. A
    /// drive's fault counts too if its torque is in that of the joint.
    pub(crate) fn joint(&self, joint: usize) -> Option<ShaftState> {
        let motors = self.motors.iter().filter_map(|motor| motor.now.as_ref());
        let first = motors.clone().next()?;
        let mut quality = Quality::GOOD;
        let weights = self.matrix.row(joint).zip(self.matrix.torque_row(joint));
        for ((motion, torque), motor) in weights.zip(motors.clone()) {
            if motion != 0.0 {
                quality |= motor.quality;
            } else if torque != 0.0 && motor.quality.contains(Quality::DRIVE_FAULT) {
                quality |= Quality::DRIVE_FAULT;
            }
        }
        let max_silence = motors.clone().map(|motor| motor.max_silence).max();
        Some(ShaftState {
            device_time: Nanos::MIN,
            device_counter: 0,
            quality: Quality(quality.0 & !Quality::DEVICE_COUNTER.0),
            state: self.matrix.joint(joint, motors.map(|motor| motor.state)),
            max_silence: max_silence.unwrap_or(first.max_silence),
            ..*first
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::JointState;
    use proptest::prelude::*;

    /// A state that several devices have made has no device's time, number or counter.
    #[test]
    fn a_coupled_state_is_no_single_devices() {
        let matrix = Matrix::new(&[vec![1.0, 1.0], vec![1.0, -1.0]], 2).unwrap();
        let mut coupling = CoupledMotors::new(matrix, 2);
        let measured = |ms, stamp| ShaftState {
            acquired: Nanos::from_millis(ms),
            stamp,
            device_time: Nanos(7),
            device_counter: 9,
            quality: Quality::DEVICE_COUNTER,
            state: JointState::ABSENT,
            max_silence: Nanos::from_millis(ms),
        };
        assert!(!coupling.push(0, measured(50, StampKind::Hardware)));
        assert!(coupling.push(1, measured(60, StampKind::Software)));
        let joint = coupling.joint(1).unwrap();
        assert_eq!((joint.device_time, joint.device_counter), (Nanos::MIN, 0));
        assert_eq!(
            (joint.quality, joint.stamp),
            (Quality::GOOD, StampKind::Software)
        );
        assert_eq!(joint.acquired, Nanos::from_millis(60));
        assert_eq!(
            joint.max_silence,
            Nanos::from_millis(60),
            "that of the slowest"
        );
    }

    proptest! {
        /// However readings come, stamps never run backward, and each state has a reading of each
        /// motor that no state before had.
        #[test]
        fn stamps_never_run_backward(
            steps in prop::collection::vec((0..3_usize, 0..20_i64), 1..200),
        ) {
            let unit = |k: usize| (0..3).map(|j| f64::from(u8::from(j == k))).collect();
            let matrix = Matrix::new(&[unit(0), unit(1), unit(2)], 3).unwrap();
            let mut coupling = CoupledMotors::new(matrix, 3);
            let (mut now, mut last, mut given) = ([0; 3], Nanos::MIN, [0; 3]);
            for (motor, step) in steps {
                // Each motor has stamps of its own, which may be behind the others'.
                now[motor] += step;
                given[motor] += 1;
                let is_new = coupling.push(motor, ShaftState {
                    acquired: Nanos(now[motor]),
                    stamp: StampKind::Software,
                    device_time: Nanos::MIN,
                    device_counter: 0,
                    quality: Quality::GOOD,
                    state: JointState::ABSENT,
                    max_silence: Nanos(100),
                });
                if is_new {
                    prop_assert!(given.iter().all(|n| *n > 0));
                    given = [0; 3];
                    let t = coupling.joint(0).unwrap().acquired;
                    prop_assert!(t >= last && t.0 == *now.iter().max().unwrap());
                    last = t;
                }
            }
        }
    }
}
