//! The stamp-dependent part of differentiation, shared by channels with equal stamps.

use crate::differentiate::basis::{Basis, CANDIDATES, MOMENTS, Ring, TERMS, longer};
use crate::differentiate::estimate::{MAX_SAMPLES, MIN_SAMPLES};
use proprio_topics::Nanos;

/// The results that depend on the stamps of the samples alone, not on the values: more than half of
/// the work of an estimate.
///
/// Pass the same grid to the windows of all channels that are evaluated at the same instants, in
/// turn ([`Window::at_sharing`](super::Window::at_sharing)). Then channels with equal stamps share
/// it. For a channel with other stamps it is computed again. The estimates are the same to the bit.
#[derive(Debug, Clone)]
pub struct Grid {
    /// The stamps of the window that it was computed for: an equal window need not be searched.
    pub(crate) ring: Ring,
    pub(crate) settings: (Nanos, Nanos, usize),
    pub(crate) skipped: usize,
    /// The time from each sample to the newest one.
    pub(crate) before: [Nanos; MAX_SAMPLES],
    pub(crate) used: usize,
    /// Time from the oldest sample to the newest \[s\]: the unit of `v`.
    pub(crate) span: f64,
    /// `v^0 ... v^5` of each sample, newest first.
    pub(crate) powers: [[f64; TERMS]; MAX_SAMPLES],
    /// Window lengths to try, in growing order; the last one is all samples.
    pub(crate) lengths: [usize; CANDIDATES],
    pub(crate) tried: usize,
    /// The basis of each window length.
    pub(crate) bases: [Basis; CANDIDATES],
    /// The instant that `Basis::here` is for, in the unit of `v`.
    pub(crate) at: f64,
}

impl Default for Grid {
    fn default() -> Self {
        Self::new()
    }
}

impl Grid {
    /// A grid without samples.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            ring: Ring::EMPTY,
            settings: (Nanos::ZERO, Nanos::ZERO, 0),
            skipped: 0,
            before: [Nanos::ZERO; MAX_SAMPLES],
            used: 0,
            span: 1.0,
            powers: [[0.0; TERMS]; MAX_SAMPLES],
            lengths: [0; CANDIDATES],
            tried: 0,
            bases: [Basis::NONE; CANDIDATES],
            at: f64::NAN,
        }
    }

    /// Computes the grid for the first `used` stamps.
    pub(crate) fn make(&mut self, used: usize) {
        self.used = used;
        self.at = f64::NAN;
        self.span = self.seconds(used);
        let per_span = 1.0 / self.span;
        self.tried = 0;
        let (mut sums, mut from, mut samples) = ([0.0; MOMENTS], 0, MIN_SAMPLES);
        for (length, basis) in self.lengths.iter_mut().zip(&mut self.bases) {
            let range = from..samples;
            let taken = self.before.get(range.clone()).unwrap_or_default();
            let powers = self.powers.get_mut(range).unwrap_or_default();
            for (before, powers) in taken.iter().zip(powers) {
                let v = -before.seconds() * per_span;
                let mut power = 1.0;
                for (k, sum) in sums.iter_mut().enumerate() {
                    if let Some(place) = powers.get_mut(k) {
                        *place = power;
                    }
                    *sum += power;
                    power *= v;
                }
            }
            *length = samples;
            *basis = Basis::new(sums);
            self.tried += 1;
            if samples == used {
                break;
            }
            (from, samples) = (samples, longer(samples, used));
        }
    }

    /// Sets the requested instant, as time after the newest sample \[s\].
    pub(crate) fn place(&mut self, time: f64) {
        let at = time / self.span;
        if at != self.at {
            self.at = at;
            self.bases.iter_mut().for_each(|basis| basis.placed = 0);
        }
    }

    /// The time from the oldest to the newest of this number of samples \[s\].
    pub(crate) fn seconds(&self, samples: usize) -> f64 {
        let oldest = samples
            .checked_sub(1)
            .and_then(|last| self.before.get(last));
        oldest.map_or(0.0, |before| before.seconds())
    }

    /// The same in the unit of `v`.
    pub(crate) fn extent(&self, samples: usize) -> f64 {
        let oldest = samples
            .checked_sub(1)
            .and_then(|last| self.powers.get(last));
        -oldest.map_or(0.0, |powers| powers[1])
    }
}
