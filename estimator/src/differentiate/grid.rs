//! The stamp-dependent part of differentiation, shared by channels with equal stamps.

use crate::differentiate::basis::{Basis, CANDIDATES, LANES, longer};
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
    /// The time from each sample to the newest one.
    pub(crate) before: [Nanos; MAX_SAMPLES],
    pub(crate) used: usize,
    /// Time from the oldest sample to the newest \[s\]: the unit of `v`.
    pub(crate) span: f64,
    /// `v` of each sample, newest first.
    pub(crate) times: [f64; MAX_SAMPLES],
    /// `v^0 ... v^7` of each sample.
    pub(crate) powers: [[f64; LANES]; MAX_SAMPLES],
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
            before: [Nanos::ZERO; MAX_SAMPLES],
            used: 0,
            span: 1.0,
            times: [0.0; MAX_SAMPLES],
            powers: [[0.0; LANES]; MAX_SAMPLES],
            lengths: [0; CANDIDATES],
            tried: 0,
            bases: [Basis::NONE; CANDIDATES],
            at: f64::NAN,
        }
    }

    /// Computes the grid for these stamps, newest first, unless they are those of the last one but
    /// for a shift. Call it with at least [`MIN_SAMPLES`] of them.
    #[inline(always)]
    pub(crate) fn make(&mut self, stamps: &[Nanos]) {
        let newest = stamps[0].0;
        let mut difference = i64::from(self.used != stamps.len());
        for (stamp, before) in stamps.iter().zip(&self.before) {
            difference |= (newest - stamp.0) ^ before.0;
        }
        if difference == 0 {
            return;
        }
        for (before, stamp) in self.before.iter_mut().zip(stamps) {
            *before = Nanos(newest - stamp.0);
        }
        let used = stamps.len();
        self.used = used;
        self.at = f64::NAN;
        self.span = self.seconds(used);
        let per_span = 1.0 / self.span;
        for (v, before) in self.times.iter_mut().zip(&self.before).take(used) {
            *v = -before.seconds() * per_span;
        }
        self.tried = 0;
        let (mut low, mut high) = ([0.0; LANES], [0.0; LANES]);
        let (mut from, mut samples) = (0, MIN_SAMPLES);
        for (length, basis) in self.lengths.iter_mut().zip(&mut self.bases) {
            let times = &self.times[from..samples];
            for (v, powers) in times.iter().zip(&mut self.powers[from..samples]) {
                let mut own = [1.0; LANES];
                for k in 1..LANES {
                    own[k] = own[k - 1] * v;
                }
                let eighth = own[LANES - 1] * v;
                for k in 0..LANES {
                    low[k] += own[k];
                    high[k] += own[k] * eighth;
                }
                *powers = own;
            }
            *length = samples;
            *basis = Basis::new(low, high);
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
            self.bases.iter_mut().for_each(Basis::displace);
        }
    }

    /// The time from the oldest to the newest of this number of samples \[s\].
    pub(crate) fn seconds(&self, samples: usize) -> f64 {
        let oldest = samples
            .checked_sub(1)
            .and_then(|last| self.before.get(last));
        oldest.map_or(0.0, |before| before.seconds())
    }
}
