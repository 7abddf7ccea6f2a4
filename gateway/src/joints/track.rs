//! An input's newest state, and how it is carried to another instant.
//!
//! Devices measure at different instants, and a sample has one stamp. So a position is carried to
//! it by the velocity, and a velocity by the acceleration: as reported, or else the difference of
//! the last two readings. Torque and current are held: they have no rate that is worth trusting.
//!
//! What that costs: for an age `h` and readings `T` apart, with acceleration `a` and jerk `j`, a
//! position is off by `a h^2 / 2` with a reported velocity, by `a h (h + T) / 2` without; a
//! velocity by `j h^2 / 2` or `j h (h + T) / 2`. A difference adds noise: up to sqrt(5) times that
//! of a reading at `h = T`. A torque is off by its change during `h`.

use proprio_topics::{JointState, Nanos, Quality, StampKind};

/// The state of a shaft at an instant.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ShaftState {
    /// When it was measured \[ns\].
    pub(crate) acquired: Nanos,
    /// The source of that stamp.
    pub(crate) stamp: StampKind,
    /// The device's own time \[ns\]; [`Nanos::MIN`] if there is none.
    pub(crate) device_time: Nanos,
    /// The device's sequence number, if `quality` has DEVICE_COUNTER.
    pub(crate) device_counter: u32,
    /// Its flags.
    pub(crate) quality: Quality,
    /// The state.
    pub(crate) state: JointState,
    /// The longest time for which it may be used \[ns\].
    pub(crate) max_silence: Nanos,
}

/// The readings of one input.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Track {
    newest: Option<ShaftState>,
    /// The reading that differences are taken from, and how long it was after the one before it
    /// \[ns\].
    base: Option<(ShaftState, Nanos)>,
    /// Rates of the newest reading: of position \[rad/s\] and of velocity \[rad/s^2\]; 0 if
    /// unknown.
    rates: (f64, f64),
}

impl Track {
    /// Takes the next reading.
    pub(crate) fn push(&mut self, now: ShaftState) {
        let state = now.state;
        let (mut rates, mut differences) = ((0.0, 0.0), (f64::NAN, f64::NAN));
        let mut base = (now, Nanos::ZERO);
        if let (Some(before), Some((from, interval))) = (self.newest, self.base) {
            // Across a gap, or from or to an angle that its device doubts, there is no rate.
            let doubtful = Quality::UNTRUSTED_ENCODER | Quality::ZERO_CHANGED;
            let continued = now.acquired - before.acquired <= now.max_silence
                && !now.quality.intersects(doubtful)
                && !before.quality.intersects(Quality::UNTRUSTED_ENCODER);
            let elapsed = now.acquired - from.acquired;
            // Frames that were held up arrive at once: so short a time would give a wild rate.
            if continued && elapsed.0 * 2 < interval.0 {
                base = (from, interval);
            } else if continued {
                base.1 = elapsed;
                differences = (
                    (state.position - from.state.position) / elapsed.seconds(),
                    (state.velocity - from.state.velocity) / elapsed.seconds(),
                );
            }
        }
        // Two readings of one instant give no finite one.
        let known = |reported: f64, difference: f64| {
            [reported, difference]
                .into_iter()
                .find(|rate| rate.is_finite())
        };
        if let Some(rate) = known(state.velocity, differences.0) {
            rates.0 = rate;
        }
        if let Some(rate) = known(state.acceleration, differences.1) {
            rates.1 = rate;
        }
        (self.newest, self.base, self.rates) = (Some(now), Some(base), rates);
    }

    /// The newest reading.
    pub(crate) const fn newest(&self) -> Option<&ShaftState> {
        self.newest.as_ref()
    }

    /// The newest reading carried to `t`, forward or backward; `None` if there is none that is
    /// fresh at `t`.
    pub(crate) fn at(&self, t: Nanos) -> Option<ShaftState> {
        let is_near = |m: &ShaftState| (t - m.acquired).0.abs() <= m.max_silence.0;
        let newest = self.newest.filter(is_near)?;
        let age = (t - newest.acquired).seconds();
        let state = JointState {
            position: newest.state.position + self.rates.0 * age,
            velocity: newest.state.velocity + self.rates.1 * age,
            ..newest.state
        };
        Some(ShaftState { state, ..newest })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ABSENT: JointState = JointState::ABSENT;

    fn measured(ms: i64, state: JointState) -> ShaftState {
        ShaftState {
            acquired: Nanos::from_millis(ms),
            stamp: StampKind::Software,
            device_time: Nanos::MIN,
            device_counter: 0,
            quality: Quality::GOOD,
            state,
            max_silence: Nanos::from_millis(50),
        }
    }

    fn at(track: &Track, ms: i64) -> Option<JointState> {
        track.at(Nanos::from_millis(ms)).map(|m| m.state)
    }

    #[test]
    fn each_quantity_is_carried_by_its_rate() {
        let reported = JointState {
            position: 1.0,
            velocity: 2.0,
            acceleration: -5.0,
            torque: 3.0,
            current: 4.0,
        };
        let mut track = Track::default();
        assert!(track.at(Nanos::ZERO).is_none());
        track.push(measured(0, reported));
        let later = at(&track, 10).unwrap();
        assert_eq!((later.position, later.velocity), (1.02, 1.95));
        assert_eq!(
            (later.acceleration, later.torque, later.current),
            (-5.0, 3.0, 4.0)
        );
        // Backward too: a stamp of the bus's SYNC may be earlier.
        assert_eq!(at(&track, -10).unwrap().position, 0.98);
        assert!(at(&track, -50).is_some() && at(&track, -51).is_none());
        assert!(
            at(&track, 50).is_some() && at(&track, 51).is_none(),
            "fresh or not"
        );
        // Without rates: held at first, then by the difference.
        let plain = |position, velocity| JointState {
            position,
            velocity,
            ..ABSENT
        };
        let mut track = Track::default();
        track.push(measured(0, plain(1.0, f64::NAN)));
        assert_eq!(at(&track, 10).unwrap().position, 1.0);
        track.push(measured(10, plain(1.1, f64::NAN)));
        let later = at(&track, 20).unwrap();
        assert!((later.position - 1.2).abs() < 1e-12 && later.velocity.is_nan());
        track.push(measured(20, plain(1.1, 1.0)));
        track.push(measured(30, plain(1.1, 1.5)));
        let later = at(&track, 40).unwrap();
        assert!((later.position - 1.115).abs() < 1e-12 && (later.velocity - 2.0).abs() < 1e-12);
    }

    #[test]
    fn no_rate_goes_over_a_gap_or_a_doubtful_angle() {
        let position = |position| JointState { position, ..ABSENT };
        let cases = [
            (10, Quality::GOOD, Quality::GOOD, 3.0),
            (50, Quality::GOOD, Quality::GOOD, 2.2),
            (51, Quality::GOOD, Quality::GOOD, 2.0),
            (0, Quality::GOOD, Quality::GOOD, 2.0),
            (10, Quality::GOOD, Quality::ZERO_CHANGED, 2.0),
            (10, Quality::GOOD, Quality::DEVICE_FAULT, 2.0),
            (10, Quality::NOT_CALIBRATED, Quality::GOOD, 2.0),
            (10, Quality::ZERO_CHANGED, Quality::DRIVE_FAULT, 3.0),
        ];
        for (ms, first, second, expected) in cases {
            let mut track = Track::default();
            let mut m = measured(0, position(1.0));
            m.quality = first;
            track.push(m);
            let mut m = measured(ms, position(2.0));
            m.quality = second;
            track.push(m);
            let carried = at(&track, ms + 10).unwrap().position;
            assert!(
                (carried - expected).abs() < 1e-12,
                "{ms} {first} {second}: {carried}"
            );
        }
    }
}
