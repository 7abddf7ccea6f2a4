//! A device that reports its angle within a range, at a shaft that goes beyond: the turns are
//! counted.
//!
//! Between two readings the shaft is taken to have gone the shorter way. That is certain as long as
//! it could not have turned by half the range, which its highest speed tells. At start, and after a
//! longer gap, the turn nearest to the centre is chosen: right if the shaft cannot be further than
//! half a range from the centre, a guess otherwise.

use proprio_topics::Nanos;

/// The range of a device's angle. All angles are the device's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wrap {
    /// The lower end \[rad\].
    pub low: f64,
    /// The width: here the angle begins anew \[rad\].
    pub range: f64,
    /// The angle to which the turn is chosen nearest \[rad\].
    pub centre: f64,
    /// The longest time between two readings over which the turn is certain \[ns\].
    pub certain: Nanos,
}

impl Wrap {
    /// What the device reports at `angle` \[rad\].
    #[must_use]
    pub fn reported(&self, angle: f64) -> f64 {
        self.low + (angle - self.low).rem_euclid(self.range)
    }

    /// The angle nearest to `to` at which the device reports `reported` \[rad\].
    fn nearest(&self, reported: f64, to: f64) -> f64 {
        reported + ((to - reported) / self.range).round() * self.range
    }
}

/// The turns counted so far.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Turns {
    /// The last angle that is to be relied on, and when it was measured.
    last: Option<(Nanos, f64)>,
}

impl Turns {
    /// The continuous angle at `t` \[rad\], and whether the turn was chosen anew, so that the angle
    /// may be off by whole ranges from the ones before. A reading that is not `trusted` is placed,
    /// but the next one does not rest on it.
    pub(crate) fn unwrap(
        &mut self,
        wrap: &Wrap,
        t: Nanos,
        reported: f64,
        trusted: bool,
    ) -> (f64, bool) {
        let known = self.last.filter(|(then, _)| t - *then < wrap.certain);
        let anew = known.is_none() && self.last.is_some();
        let angle = wrap.nearest(reported, known.map_or(wrap.centre, |(_, last)| last));
        self.last = if trusted && angle.is_finite() {
            Some((t, angle))
        } else {
            known
        };
        (angle, anew)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::{PI, TAU};

    const WRAP: Wrap = Wrap {
        low: -PI,
        range: TAU,
        centre: 0.0,
        certain: Nanos::from_millis(100),
    };

    #[test]
    fn an_angle_is_continuous_over_the_ends_of_its_range() {
        let mut turns = Turns::default();
        let mut at = |ms, angle| turns.unwrap(&WRAP, Nanos::from_millis(ms), angle, true);
        assert_eq!(at(0, 3.0), (3.0, false));
        assert_eq!(at(10, -3.0), (-3.0 + TAU, false));
        assert_eq!(at(20, 3.0), (3.0, false));
        // Two turns on, in steps of a third.
        let last = (1..=6).fold(0.0, |_, k| {
            let angle = 3.0 + f64::from(k) * TAU / 3.0;
            at(20 + i64::from(k), WRAP.reported(angle)).0
        });
        assert!((last - (3.0 + 2.0 * TAU)).abs() < 1e-12, "{last}");
    }

    #[test]
    fn after_a_long_gap_the_turn_is_chosen_anew() {
        let mut turns = Turns::default();
        let mut at = |ms, angle| turns.unwrap(&WRAP, Nanos::from_millis(ms), angle, true);
        assert_eq!(at(0, 3.0).0, 3.0);
        assert_eq!(at(99, -3.0).0, TAU - 3.0);
        assert_eq!(at(199, -3.0), (-3.0, true), "nearest to the centre");
        assert_eq!(at(200, 3.0), (3.0 - TAU, false));
    }

    /// An angle that its device doubts is half a turn off and comes back: nothing rests on it. It
    /// does not extend the time for which the turn is known either.
    #[test]
    fn nothing_rests_on_an_angle_that_is_not_trusted() {
        let mut turns = Turns::default();
        let mut at = |ms, angle, ok| turns.unwrap(&WRAP, Nanos::from_millis(ms), angle, ok);
        at(0, 3.0, true);
        let doubtful = [(10, -1.0), (20, 1.0), (30, f64::NAN), (90, -2.5)];
        for (ms, angle) in doubtful {
            at(ms, angle, false);
        }
        assert_eq!(at(99, 3.1, true), (3.1, false));
        at(150, 0.0, false);
        assert_eq!(at(199, 3.0, true), (3.0, true));
    }

    /// A device that never trusts itself: its angles are near the centre, and are no news.
    #[test]
    fn an_angle_that_is_never_trusted_is_near_the_centre() {
        let mut turns = Turns::default();
        for ms in [0, 500, 501] {
            let t = Nanos::from_millis(ms);
            assert_eq!(turns.unwrap(&WRAP, t, 4.0, false), (4.0 - TAU, false));
        }
    }

    proptest! {
        /// A smooth motion, sampled with jitter and losses: as long as the shaft turns by less than
        /// half the range between two readings that arrive, the angle is the true one.
        #[test]
        fn the_angle_is_the_true_one(
            waves in prop::collection::vec((0.1..3.0_f64, 0.2..8.0_f64, 0.0..TAU), 1..4),
            drift in -20.0..20.0_f64,
            low in -10.0..10.0_f64,
            range in 0.5..20.0_f64,
            // Between readings, as a share of the limit: jitter, and up to nine of ten lost.
            steps in prop::collection::vec(0.05..0.99_f64, 200),
        ) {
            let truth = |t: f64| {
                let wave = |(a, w, phase): &(f64, f64, f64)| a * (w * t + phase).sin();
                drift * t + waves.iter().map(wave).sum::<f64>()
            };
            let speed = drift.abs() + waves.iter().map(|(a, w, _)| a * w).sum::<f64>();
            let certain = Nanos::from_seconds(0.5 * range / speed);
            let centre = truth(0.0) + 0.49 * range;
            let wrap = Wrap { low, range, centre, certain };
            let mut turns = Turns::default();
            let mut t = Nanos::ZERO;
            for step in steps {
                let angle = truth(t.seconds());
                let reported = wrap.reported(angle);
                prop_assert!((low..=low + range).contains(&reported));
                let (found, anew) = turns.unwrap(&wrap, t, reported, true);
                prop_assert!((found - angle).abs() < 1e-9, "{found} for {angle} at {t}");
                prop_assert!(!anew);
                t += Nanos::from_seconds(step * certain.seconds());
            }
        }
    }
}
