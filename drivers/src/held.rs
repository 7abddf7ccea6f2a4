//! Values that come in other frames than the reading they belong to, and at another rate; and
//! states that come in every frame, and are not told with each.

use crate::Frame;
use crate::pairing::within;
use proprio_topics::{Nanos, StampKind};

/// A value that joins the readings after it, for a while.
#[derive(Debug, Clone, Copy)]
pub(crate) struct HeldValue {
    t: Nanos,
    stamp: StampKind,
    value: f64,
}

impl HeldValue {
    /// No value.
    pub(crate) const ABSENT: Self = Self {
        t: Nanos::MIN,
        stamp: StampKind::None,
        value: f64::NAN,
    };

    /// The value in `frame`; not a finite number: none.
    pub(crate) fn new(frame: &Frame, value: f64) -> Self {
        Self {
            t: frame.t,
            stamp: frame.stamp,
            value: if value.is_finite() { value } else { f64::NAN },
        }
    }

    /// The value for a reading in `frame`; NaN if it is older than `hold`, or later.
    pub(crate) fn at(self, frame: &Frame, hold: Nanos) -> f64 {
        if within((self.t, self.stamp), frame, hold) {
            self.value
        } else {
            f64::NAN
        }
    }
}

/// How long a state that stays the same is not told again.
const TOLD: Nanos = Nanos::from_millis(1000);

/// A state that is told when it is new, and once a second.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OnChange<T>(Option<(T, Nanos, StampKind)>);

impl<T: PartialEq + Copy> OnChange<T> {
    /// Nothing told.
    pub(crate) const NOTHING: Self = Self(None);

    /// Whether `state`, in `frame`, is to be told.
    pub(crate) fn is_due(&mut self, state: T, frame: &Frame) -> bool {
        let known = self
            .0
            .is_some_and(|(told, t, stamp)| told == state && within((t, stamp), frame, TOLD));
        if !known {
            self.0 = Some((state, frame.t, frame.stamp));
        }
        !known
    }
}
