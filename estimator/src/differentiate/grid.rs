//! The stamp-dependent part of differentiation, shared by channels with equal stamps.

use crate::differentiate::basis::{Bases, CANDIDATES, LANES, longer};
use crate::differentiate::estimate::{MAX_SAMPLES, MIN_SAMPLES};
use proprio_topics::Nanos;
use pulp::Simd;

/// The binary digits of 0 to 7, lowest first, and their complements.
const DIGITS: [([f64; LANES], [f64; LANES]); 3] = [
    (
        [0., 1., 0., 1., 0., 1., 0., 1.],
        [1., 0., 1., 0., 1., 0., 1., 0.],
    ),
    (
        [0., 0., 1., 1., 0., 0., 1., 1.],
        [1., 1., 0., 0., 1., 1., 0., 0.],
    ),
    (
        [0., 0., 0., 0., 1., 1., 1., 1.],
        [1., 1., 1., 1., 0., 0., 0., 0.],
    ),
];

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
    /// `v^0 ... v^6` of each sample, and a zero.
    pub(crate) powers: [[f64; LANES]; MAX_SAMPLES],
    /// Window lengths to try, in growing order; the last one is all samples.
    pub(crate) lengths: [usize; CANDIDATES],
    pub(crate) tried: usize,
    pub(crate) bases: Bases,
    /// The instant that `Bases::here` is for, in the unit of `v`.
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
            bases: Bases::NONE,
            at: f64::NAN,
        }
    }

    /// Computes the grid for these stamps, newest first, unless they are those of the last one but
    /// for a shift. Call it with at least [`MIN_SAMPLES`] of them.
    #[inline(always)]
    pub(crate) fn make<S: Simd>(&mut self, simd: S, stamps: &[Nanos]) {
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
        self.bases.sums = Bases::NONE.sums;
        let (mut low, mut high) = ([0.0; LANES], [0.0; LANES]);
        let (mut from, mut samples) = (0, MIN_SAMPLES);
        for (window, length) in self.lengths.iter_mut().enumerate() {
            let times = &self.times[from..samples];
            for (v, powers) in times.iter().zip(&mut self.powers[from..samples]) {
                let square = v * v;
                let fourth = square * square;
                let eighth = simd.splat_f64s(fourth * fourth);
                let factors = [*v, square, fourth].map(|power| simd.splat_f64s(power));
                let sums = (S::as_mut_simd_f64s(&mut low).0.iter_mut())
                    .zip(S::as_mut_simd_f64s(&mut high).0);
                let own = S::as_mut_simd_f64s(powers).0.iter_mut();
                for (i, (power, (low, high))) in own.zip(sums).enumerate() {
                    // A product of powers of two, so that none waits for the one before.
                    let mut product = simd.splat_f64s(1.0);
                    for ((with, without), factor) in DIGITS.iter().zip(factors) {
                        let with = S::as_simd_f64s(with).0[i];
                        let without = S::as_simd_f64s(without).0[i];
                        product =
                            simd.mul_f64s(product, simd.mul_add_e_f64s(factor, with, without));
                    }
                    *power = product;
                    *low = simd.add_f64s(*low, product);
                    *high = simd.mul_add_e_f64s(product, eighth, *high);
                }
                powers[LANES - 1] = 0.0;
            }
            for (own, sum) in self.bases.sums.iter_mut().zip(low.iter().chain(&high)) {
                own[window] = *sum;
            }
            *length = samples;
            self.tried += 1;
            if samples == used {
                break;
            }
            (from, samples) = (samples, longer(samples, used));
        }
        self.bases.compute(simd);
    }

    /// Sets the requested instant, as time after the newest sample \[s\].
    #[inline(always)]
    pub(crate) fn place<S: Simd>(&mut self, simd: S, time: f64) {
        let at = time / self.span;
        if at != self.at {
            self.at = at;
            self.bases.place(simd, at);
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
