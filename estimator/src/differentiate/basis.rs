//! Polynomials orthogonal over the stamps of a window.

use crate::differentiate::estimate::MAX_SAMPLES;
use pulp::Simd;

/// The number of degrees fitted, from [`FIRST_DEGREE`] up.
pub(crate) const FITTED: usize = 3;

/// The lowest degree fitted.
pub(crate) const FIRST_DEGREE: usize = 2;

/// Largest residual of a sample, in units of the noise bound (step 1).
pub(crate) const TOLERANCE: f64 = 3.0;

/// How much longer the window of a cubic or quartic must be than that of a lower degree (step 2).
pub(crate) const STRETCH: [f64; FITTED] = [0.0, 1.6, 1.4];

/// The shortest window considered, as a share of the longest that fits (step 3).
pub(crate) const SHORTEST: f64 = 0.4;

/// Width of the confidence intervals of value, first and second derivative (step 3) \[standard
/// deviations\].
pub(crate) const KAPPA: [f64; 3] = [1.0, 1.5, 2.0];

/// Number of samples in the divided difference that measures noise.
pub(crate) const DIFFERENCE_SAMPLES: usize = 5;

/// Number of windows tried: 3, 4, 5, 6 samples, then a third longer each time; 15 of them reach 128
/// samples.
pub(crate) const CANDIDATES: usize = 16;

/// Polynomials of a basis: the degrees fitted, those below, and one more for the truncation error.
pub(crate) const TERMS: usize = FIRST_DEGREE + FITTED + 1;

/// Number of sums of powers needed for their norms.
pub(crate) const MOMENTS: usize = 2 * TERMS - 1;

/// Squared norm of an orthogonal polynomial, relative to that of its leading power, below which it
/// is mostly rounding error. With regular stamps it is 0.03 to 1e-5.
pub(crate) const DEGENERATE: f64 = 1e-12;

/// Numbers of one sample that are computed together: a multiple of the vector length of every
/// processor.
pub(crate) const LANES: usize = 8;

/// One number of each window. Windows are computed together, so that their numbers fill vectors.
pub(crate) type PerWindow = [f64; CANDIDATES];

pub(crate) const NONE: PerWindow = [0.0; CANDIDATES];

/// The last samples, newest first. Each is stored twice, so that any of them in a row are one
/// slice.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Recent<T> {
    places: [T; 2 * MAX_SAMPLES],
    newest: usize,
}

/// The polynomials orthogonal over the samples of each window, and their values at an instant.
#[derive(Debug, Clone)]
pub(crate) struct Bases {
    /// `<v^k, v^l>` by `k + l`.
    pub(crate) sums: [PerWindow; MOMENTS],
    /// Coefficients of the recurrence.
    a: [PerWindow; TERMS],
    b: [PerWindow; TERMS],
    /// `1 / <p_k, p_k>`; zero for polynomials that do not exist.
    pub(crate) per_norm: [PerWindow; TERMS],
    /// By polynomial, its coefficients of `v^j`.
    pub(crate) by_power: [[PerWindow; TERMS]; TERMS],
    /// `p_k` and its derivatives by `v` at the instant, and the sums of `p_k^(m)^2 / <p_k, p_k>` up
    /// to `k`.
    pub(crate) here: [[PerWindow; 3]; TERMS],
    pub(crate) variance: [[PerWindow; 3]; TERMS],
}

impl<T: Copy> Recent<T> {
    /// All samples are `none` so far.
    pub(crate) const fn new(none: T) -> Self {
        Self {
            places: [none; 2 * MAX_SAMPLES],
            newest: 0,
        }
    }

    pub(crate) fn push(&mut self, value: T) {
        self.newest = (self.newest + MAX_SAMPLES - 1) % MAX_SAMPLES;
        let (first, second) = self.places.split_at_mut(MAX_SAMPLES);
        for place in [first, second] {
            place[self.newest] = value;
        }
    }

    /// Newest first.
    pub(crate) fn all(&self) -> &[T] {
        &self.places[self.newest..][..MAX_SAMPLES]
    }
}

impl Bases {
    pub(crate) const NONE: Self = Self {
        sums: [NONE; MOMENTS],
        a: [NONE; TERMS],
        b: [NONE; TERMS],
        per_norm: [NONE; TERMS],
        by_power: [[NONE; TERMS]; TERMS],
        here: [[NONE; 3]; TERMS],
        variance: [[NONE; 3]; TERMS],
    };

    /// Whether a window has this many polynomials.
    pub(crate) fn has(&self, terms: usize, window: usize) -> bool {
        self.per_norm[terms - 1][window] > 0.0
    }

    /// Computes the polynomials from the sums: Chebyshev's algorithm. Those that a window does not
    /// have become finite numbers, which its `per_norm` of zero makes ineffective.
    #[inline(always)]
    pub(crate) fn compute<S: Simd>(&mut self, simd: S) {
        let zero = simd.splat_f64s(0.0);
        for i in 0..CANDIDATES / S::F64_LANES {
            let sums = self.sums.each_ref().map(|own| vector::<S>(own, i));
            // `<p_k, v^l>` for the last `k` and for the one before, from `l = k` on.
            let (mut moments, mut before) = (sums, [zero; MOMENTS]);
            let (mut a, mut b, mut per_norm) = (zero, zero, zero);
            let mut by_power = [[zero; TERMS]; 3];
            let mut has = simd.greater_than_f64s(sums[0], zero);
            for k in 0..TERMS {
                let [last, second, own] = &mut by_power;
                if k == 0 {
                    own[0] = simd.splat_f64s(1.0);
                } else {
                    // From those of k - 1 and k - 2, in place of the latter.
                    for l in k..MOMENTS - k {
                        let known = simd.sub_f64s(moments[l + 1], simd.mul_f64s(a, moments[l]));
                        before[l] = simd.sub_f64s(known, simd.mul_f64s(b, before[l]));
                    }
                    std::mem::swap(&mut moments, &mut before);
                    for j in 0..=k {
                        let shifted = if j > 0 { last[j - 1] } else { zero };
                        let known = simd.sub_f64s(shifted, simd.mul_f64s(a, last[j]));
                        own[j] = simd.sub_f64s(known, simd.mul_f64s(b, second[j]));
                    }
                }
                let norm = moments[k];
                let least = simd.mul_f64s(simd.splat_f64s(DEGENERATE), sums[2 * k]);
                for is_met in [
                    simd.greater_than_f64s(norm, least),
                    simd.greater_than_f64s(simd.splat_f64s(f64::INFINITY), norm),
                    simd.greater_than_f64s(sums[0], simd.splat_f64s(k as f64)),
                ] {
                    has = simd.and_m64s(has, is_met);
                }
                let earlier = per_norm;
                per_norm = simd.select_f64s(has, simd.div_f64s(simd.splat_f64s(1.0), norm), zero);
                if k + 1 < TERMS {
                    let known = simd.mul_f64s(moments[k + 1], per_norm);
                    a = simd.sub_f64s(known, simd.mul_f64s(before[k], earlier));
                    b = simd.mul_f64s(norm, earlier);
                }
                set::<S>(&mut self.a[k], i, a);
                set::<S>(&mut self.b[k], i, b);
                set::<S>(&mut self.per_norm[k], i, per_norm);
                for (to, own) in self.by_power[k].iter_mut().zip(*own) {
                    set::<S>(to, i, own);
                }
                by_power = [*own, *last, [zero; TERMS]];
            }
        }
    }

    /// Evaluates the polynomials at the instant `at`.
    #[inline(always)]
    pub(crate) fn place<S: Simd>(&mut self, simd: S, at: f64) {
        let zero = simd.splat_f64s(0.0);
        let at = simd.splat_f64s(at);
        for i in 0..CANDIDATES / S::F64_LANES {
            let mut last = [simd.splat_f64s(1.0), zero, zero];
            let (mut before, mut sums) = ([zero; 3], [zero; 3]);
            for k in 0..TERMS {
                if k > 0 {
                    let a = vector::<S>(&self.a[k - 1], i);
                    let b = vector::<S>(&self.b[k - 1], i);
                    // Not with `array::from_fn`: its closures are not compiled for these registers.
                    let mut own = [zero; 3];
                    for m in 0..3 {
                        let known = simd.mul_f64s(simd.sub_f64s(at, a), last[m]);
                        let inner = match m {
                            0 => zero,
                            _ => simd.mul_f64s(simd.splat_f64s(m as f64), last[m - 1]),
                        };
                        let grown = simd.add_f64s(known, inner);
                        own[m] = simd.sub_f64s(grown, simd.mul_f64s(b, before[m]));
                    }
                    (before, last) = (last, own);
                }
                let per_norm = vector::<S>(&self.per_norm[k], i);
                for m in 0..3 {
                    let square = simd.mul_f64s(simd.mul_f64s(last[m], last[m]), per_norm);
                    sums[m] = simd.add_f64s(sums[m], square);
                    set::<S>(&mut self.here[k][m], i, last[m]);
                    set::<S>(&mut self.variance[k][m], i, sums[m]);
                }
            }
        }
    }

    /// `<x, p_k>` of all polynomials, for values `x` with these moments.
    #[inline(always)]
    pub(crate) fn products<S: Simd>(
        &self,
        simd: S,
        moments: &[PerWindow; LANES],
    ) -> [PerWindow; TERMS] {
        let mut products = [NONE; TERMS];
        for i in 0..CANDIDATES / S::F64_LANES {
            let moments = moments.each_ref().map(|own| vector::<S>(own, i));
            for (k, product) in products.iter_mut().enumerate() {
                let mut sum = simd.splat_f64s(0.0);
                for (moment, own) in moments.iter().zip(&self.by_power[k]).take(k + 1) {
                    sum = simd.add_f64s(sum, simd.mul_f64s(*moment, vector::<S>(own, i)));
                }
                set::<S>(product, i, sum);
            }
        }
        products
    }

    /// The least-squares polynomial of degree `N - 1` of one window, for values with these
    /// products, in powers of `v`.
    #[inline(always)]
    pub(crate) fn polynomial<const N: usize>(
        &self,
        products: &[PerWindow; TERMS],
        window: usize,
    ) -> [f64; N] {
        let mut polynomial = [0.0; N];
        let norms = self.per_norm.iter().zip(&self.by_power);
        for (product, (per_norm, own)) in products.iter().zip(norms).take(N) {
            let coefficient = product[window] * per_norm[window];
            for (sum, own) in polynomial.iter_mut().zip(own) {
                *sum += coefficient * own[window];
            }
        }
        polynomial
    }
}

/// Vector number `i` of one number of each window.
#[inline(always)]
pub(crate) fn vector<S: Simd>(numbers: &PerWindow, i: usize) -> S::f64s {
    S::as_simd_f64s(numbers).0[i]
}

#[inline(always)]
pub(crate) fn set<S: Simd>(numbers: &mut PerWindow, i: usize, to: S::f64s) {
    S::as_mut_simd_f64s(numbers).0[i] = to;
}

/// The next longer window to try, at most `most`.
pub(crate) fn longer(samples: usize, most: usize) -> usize {
    let next = samples + (samples / 3).max(1);
    // A last step of a few samples would cost a whole window for no information.
    if next + next / 8 >= most { most } else { next }
}
