//! The buffers of the pipeline: the last samples of each channel.

use super::prediction::Predictor;
use crate::differentiate::Window;
use crate::history::{ChannelValue, History};
use proprio_topics::sanity::{Jumps, LONGEST_COPIES, Repeats};
use proprio_topics::{Nanos, Quality, Reason};

/// The last samples of one channel, and a window for the values that are differentiated.
pub(super) enum ChannelBuffer {
    /// Position, velocity, acceleration; the last two are NaN if not measured.
    Joint(History<3>, Box<Window<1>>),
    /// Force and torque; then temperature of the board. The predictor is there if estimates do not
    /// wait.
    Sensor(History<6>, History<1>, Option<Predictor<6>>),
    /// Proper acceleration, angular velocity, angular acceleration (NaN if not measured).
    /// The predictor of the acceleration is there if estimates do not wait.
    Imu(History<9>, Box<Window<3>>, Option<Predictor<3>>),
}

impl ChannelBuffer {
    pub(super) fn newest(&self) -> Option<Nanos> {
        match self {
            Self::Joint(h, _) => h.newest(),
            Self::Sensor(h, ..) => h.newest(),
            Self::Imu(h, ..) => h.newest(),
        }
    }

    /// The stamp of the last sample up to `t`.
    pub(super) fn newest_at(&self, t: Nanos) -> Option<Nanos> {
        match self {
            Self::Joint(h, _) => h.within(Nanos::MIN, t).next().map(|own| own.0),
            Self::Sensor(h, ..) => h.within(Nanos::MIN, t).next().map(|own| own.0),
            Self::Imu(h, ..) => h.within(Nanos::MIN, t).next().map(|own| own.0),
        }
    }
}

/// Judges the readings of one channel by those before it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sanity {
    repeats: Repeats<6>,
    jumps: Jumps<6>,
    /// Of measured derivatives: velocity and acceleration, or angular acceleration.
    derivatives: Jumps<3>,
    is_encoder: bool,
    /// An encoder's readings repeat themselves as its noise makes impossible, or since it stopped
    /// at once.
    is_still: bool,
    /// It has stopped at once, and an unexplained residual has spoken against it since then.
    is_stuck: bool,
}

impl Sanity {
    /// For an encoder whose error is stated to be at most `peak`. The jitter of a joint that moves
    /// ends when it stands, at one count: no repeat alone tells a stuck encoder from a joint that
    /// stands. So it counts only where F/T residuals tell that something is wrong.
    pub(super) fn of_encoder(peak: f64) -> Self {
        Self {
            is_encoder: true,
            jumps: Jumps::of_encoders([peak; 6]),
            ..Self::of_noisy([peak; 6])
        }
    }

    /// For axes with noise of their own, whose error is stated to be at most `peaks`.
    pub(super) fn of_noisy(peaks: [f64; 6]) -> Self {
        Self {
            repeats: Repeats::default(),
            jumps: Jumps::new(peaks),
            derivatives: Jumps::default(),
            is_encoder: false,
            is_still: false,
            is_stuck: false,
        }
    }

    /// Whether a residual that nothing else explains shows at present that something is wrong.
    pub(super) fn suspect(&mut self, is_unexplained: bool) {
        self.is_stuck |= is_unexplained && self.is_encoder && self.jumps.has_stopped();
    }

    /// Whether this is an encoder that may be stuck; `is_disturbed`: there is a residual at
    /// present. One that has stopped at once, and that an unexplained residual spoke against, may
    /// be stuck until it goes on: in some postures its error hardly shows.
    pub(super) const fn may_be_stuck(&self, is_disturbed: bool) -> bool {
        self.is_stuck || self.is_still && is_disturbed
    }

    /// Whether the last reading does not continue the motion of those before.
    pub(super) fn has_stepped(&self) -> bool {
        self.jumps.has_stepped()
    }

    /// The measured derivatives at `t`, NaN where there are none: none of them if one cannot be
    /// true. They then are what the value itself shows.
    pub(super) fn derivatives(
        &mut self,
        t: Nanos,
        measured: [f64; 3],
        quality: Quality,
    ) -> [f64; 3] {
        // One that stops at once does so with the value itself, which is judged.
        let is_doubtful = self.derivatives.judge(t, &measured, quality);
        match is_doubtful && !self.derivatives.has_stopped() {
            true => [f64::NAN; 3],
            false => measured,
        }
    }

    /// The flags of a reading at `t`, NaN where it has fewer than six values, with `quality` as its
    /// device has it. A reading that repeats itself is no news: after `max_silence` it is frozen,
    /// if its noise makes that impossible.
    pub(super) fn judge(
        &mut self,
        t: Nanos,
        values: &[f64; 6],
        quality: Quality,
        max_silence: Nanos,
    ) -> Quality {
        let jumps = self.jumps.judge(t, values, quality);
        let period = Nanos::from_seconds(self.jumps.period()).0.max(1);
        let least = u32::try_from(max_silence.0 / period).unwrap_or(LONGEST_COPIES);
        let least = least.clamp(2, LONGEST_COPIES);
        let is_repeated = self.repeats.judge(values, quality, least) != 0;
        self.is_still = self.is_encoder && (is_repeated || self.jumps.has_stopped());
        self.is_stuck &= self.jumps.has_stopped();
        let mut flags = quality;
        if is_repeated && !self.is_encoder {
            flags |= Quality::FROZEN;
        }
        if jumps {
            flags |= Quality::IMPLAUSIBLE;
        }
        flags
    }
}

/// The temperature of a sensor's board at `t` \[degrees Celsius\], and its age. It is the last one
/// stamped before `t - max_wait / 2`, however old; NaN if there is none. Estimates do not wait for
/// temperatures: a sample of that stamp has arrived by the time `t` is released.
pub(super) fn temperature_at(
    temperatures: &History<1>,
    t: Nanos,
    max_wait: Nanos,
) -> (f64, Option<Nanos>) {
    let before = t.saturating_sub(Nanos(max_wait.0 / 2 + 1));
    let held = temperatures.at(before, before);
    held.map_or((f64::NAN, None), |held| (held.value[0], Some(held.age)))
}

/// [`Reason::Stale`] if the last sample is older than `max_silence`.
pub(super) fn stale<const D: usize>(held: &ChannelValue<D>, max_silence: Nanos) -> Reason {
    // Also between two samples: the gap between them is too long.
    if held.age > max_silence {
        Reason::Stale
    } else {
        Reason::None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A board that sends each measurement three times: one that comes late is not frozen, and one
    /// that comes for longer than `max_silence` is.
    #[test]
    fn a_late_copy_of_a_measurement_is_not_frozen() {
        let max_silence = Nanos::from_millis(100);
        let mut sanity = Sanity::of_noisy([0.0; 6]);
        let (mut ms, mut frozen) = (0, Vec::new());
        for k in 0..720_i64 {
            ms += if k == 500 { 60 } else { 10 };
            let measurement = k.min(700) / 3;
            let noise = [7919, 6151, 4099, 3571, 2203, 1447]
                .map(|a| a * measurement * measurement % 10_007);
            let t = Nanos::from_millis(ms);
            let flags = sanity.judge(t, &noise.map(|n| n as f64), Quality::GOOD, max_silence);
            if flags.intersects(Quality::FROZEN) {
                frozen.push(k);
            }
        }
        // The first copy of the last measurement is number 699; the period is 10 ms or little more.
        let first = frozen.first().copied().unwrap_or(0);
        assert!((708..=709).contains(&first), "{frozen:?}");
        assert!(frozen.into_iter().eq(first..720));
    }

    /// An encoder that stops at once may stand against something, or be stuck. It is stuck, until
    /// it moves, if an unexplained residual has spoken against it.
    #[test]
    fn an_encoder_that_stopped_at_once_is_stuck_once_a_residual_spoke_against_it() {
        let max_silence = Nanos::from_millis(100);
        let mut sanity = Sanity::of_encoder(0.0);
        let check = |sanity: &mut Sanity, ms: i64, position: f64| {
            let position = [position, f64::NAN, f64::NAN, f64::NAN, f64::NAN, f64::NAN];
            sanity.judge(
                Nanos::from_millis(ms),
                &position,
                Quality::GOOD,
                max_silence,
            );
        };
        let motion = |ms: i64| (ms as f64 / 300.0).sin();
        for ms in (0..300).step_by(5) {
            check(&mut sanity, ms, motion(ms));
            sanity.suspect(true);
            assert!(!sanity.may_be_stuck(true), "{ms}");
        }
        for ms in (300..400).step_by(5) {
            check(&mut sanity, ms, motion(295));
        }
        assert!(sanity.may_be_stuck(true) && !sanity.may_be_stuck(false));
        sanity.suspect(false);
        assert!(!sanity.may_be_stuck(false));
        sanity.suspect(true);
        check(&mut sanity, 400, motion(295));
        assert!(sanity.may_be_stuck(false));
        for ms in (405..500).step_by(5) {
            check(&mut sanity, ms, motion(295) + 0.1 * motion(ms - 400));
        }
        assert!(!sanity.may_be_stuck(true) && !sanity.may_be_stuck(false));
    }
}
