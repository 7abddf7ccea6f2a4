//! Input and output types of the differentiator.

use proprio_topics::Nanos;

/// Largest number of samples in a [`super::Window`].
pub const MAX_SAMPLES: usize = 128;

/// Smallest number of samples for an estimate: a second derivative needs three.
pub const MIN_SAMPLES: usize = 3;

/// The settings of a [`super::Window`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Peak error of a sample, in its own unit: half the least significant bit, plus the peak of
    /// any other noise.
    pub noise: f64,
    /// Largest number of samples for an estimate, 3 to [`MAX_SAMPLES`]. Fewer than [`MAX_SAMPLES`]
    /// leave room for samples that come while an earlier instant is still waiting, so that its
    /// estimate does not depend on the time of computation.
    pub capacity: usize,
    /// Samples older than this, relative to the newest one used, are excluded.
    pub max_window: Nanos,
    /// Samples further apart than this are not fitted together: the window restarts. Also the
    /// largest time from the newest sample to an estimate after it.
    pub max_gap: Nanos,
}

impl Settings {
    /// Settings that suit most channels: [`MAX_SAMPLES`] samples, at most one second, gaps up to
    /// 100 ms.
    ///
    /// `noise` as in [`Settings::noise`].
    #[must_use]
    pub const fn new(noise: f64) -> Self {
        Self {
            noise,
            capacity: MAX_SAMPLES,
            max_window: Nanos::from_millis(1000),
            max_gap: Nanos::from_millis(100),
        }
    }
}

/// Why [`Settings`] were refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SettingsError {
    /// The noise bound must be a positive number.
    #[error("noise bound {0} is not a positive number")]
    Noise(f64),
    /// The capacity is out of range.
    #[error("capacity {0} is not within {MIN_SAMPLES} to {MAX_SAMPLES} samples")]
    Capacity(usize),
    /// `max_window` or `max_gap` is not positive.
    #[error("duration {0} s is not positive")]
    Duration(Nanos),
}

/// What [`super::Window::push`] did with a sample that it took.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pushed {
    /// Added to the window.
    Added,
    /// Added; the window restarts, because the sample before is older than `max_gap`.
    Restarted {
        /// Time since the sample before.
        gap: Nanos,
    },
}

/// Why [`super::Window::push`] refused a sample; the window is as before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Refused {
    /// Stamps must increase strictly.
    #[error("sample stamped {got} s is not later than the one before, {newest} s")]
    NotLater {
        /// Stamp of the newest sample kept.
        newest: Nanos,
        /// Stamp of the sample refused.
        got: Nanos,
    },
    /// A component is infinite or not a number.
    #[error("sample is not finite")]
    NotFinite,
}

/// Why there is no estimate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Unavailable {
    /// Too few samples since the start, or since the last gap, for a second derivative.
    #[error("{samples} of {MIN_SAMPLES} samples since the start or the last gap")]
    Starting {
        /// Samples at hand.
        samples: usize,
    },
    /// The instant is later than the newest sample used by more than `max_gap`.
    #[error("the newest sample is {by} s old")]
    Stale {
        /// Its age at the requested instant.
        by: Nanos,
    },
    /// The instant is earlier than every kept sample.
    #[error("the oldest sample is {by} s later")]
    Before {
        /// Time from the requested instant to the oldest sample.
        by: Nanos,
    },
    /// The samples are too large for their squares to be represented.
    #[error("the estimate overflows")]
    Overflow,
}

/// A signal and its first two derivatives at one instant.
///
/// The standard deviations have two parts, added as squares: the noise propagated through the
/// window, and the change of the estimate with a polynomial of one degree more, which estimates the
/// truncation error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SignalEstimate<const D: usize> {
    /// The signal, in its own unit.
    pub value: [f64; D],
    /// Its first derivative \[unit/s\].
    pub first: [f64; D],
    /// Its second derivative \[unit/s^2\].
    pub second: [f64; D],
    /// Standard deviation of `value`.
    pub value_std: [f64; D],
    /// Standard deviation of `first`.
    pub first_std: [f64; D],
    /// Standard deviation of `second`.
    pub second_std: [f64; D],
    /// Samples that `value`, `first` and `second` were fitted to; the shortest of the `D` windows.
    pub samples: [usize; 3],
    /// How far the newest sample used lies after the instant (negative: the estimate is an
    /// extrapolation).
    pub ahead: Nanos,
}

impl<const D: usize> SignalEstimate<D> {
    pub(crate) const NONE: Self = Self {
        value: [f64::NAN; D],
        first: [f64::NAN; D],
        second: [f64::NAN; D],
        value_std: [f64::NAN; D],
        first_std: [f64::NAN; D],
        second_std: [f64::NAN; D],
        samples: [MAX_SAMPLES; 3],
        ahead: Nanos::ZERO,
    };

    pub(crate) fn is_finite(&self) -> bool {
        [
            &self.value,
            &self.first,
            &self.second,
            &self.value_std,
            &self.first_std,
            &self.second_std,
        ]
        .into_iter()
        .flatten()
        .all(|v| v.is_finite())
    }
}
