//! Polynomials orthogonal over the stamps of a window.

use crate::differentiate::estimate::MAX_SAMPLES;

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

/// Numbers of one sample or window that are computed together: a multiple of the vector length of
/// every processor.
pub(crate) const LANES: usize = 8;

/// The last samples, newest first. Each is stored twice, so that any of them in a row are one
/// slice.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Recent<T> {
    places: [T; 2 * MAX_SAMPLES],
    newest: usize,
}

/// Polynomials orthogonal over the newest samples, and their values at an instant; computed on
/// demand.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Basis {
    /// `<v^k, v^l>` by `k + l`.
    sums: [f64; 2 * LANES],
    /// Coefficients of the recurrence.
    a: [f64; TERMS],
    b: [f64; TERMS],
    /// `1 / <p_k, p_k>`; zero for polynomials that do not exist.
    pub(crate) per_norm: [f64; LANES],
    /// The coefficients of `v^j` in all polynomials.
    by_power: [[f64; LANES]; TERMS],
    /// The number of polynomials, once they are computed.
    pub(crate) found: usize,
    is_computed: bool,
    /// `p_k` and its derivatives by `v` at the instant, and the square roots of the sums of
    /// `p_k^(m)^2 / <p_k, p_k>` up to `k`, once they are computed.
    pub(crate) here: [[f64; 3]; TERMS],
    pub(crate) deviation: [[f64; 3]; TERMS],
    is_placed: bool,
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

impl Basis {
    pub(crate) const NONE: Self = Self {
        sums: [0.0; 2 * LANES],
        a: [0.0; TERMS],
        b: [0.0; TERMS],
        per_norm: [0.0; LANES],
        by_power: [[0.0; LANES]; TERMS],
        found: 0,
        is_computed: false,
        here: [[0.0; 3]; TERMS],
        deviation: [[0.0; 3]; TERMS],
        is_placed: false,
    };

    /// A basis from the sums of `v^0 ... v^7` and of `v^8 ...`.
    pub(crate) fn new(low: [f64; LANES], high: [f64; LANES]) -> Self {
        let mut new = Self::NONE;
        new.sums[..LANES].copy_from_slice(&low);
        new.sums[LANES..].copy_from_slice(&high);
        new
    }

    /// Computes the polynomials for this many `samples`, if they are not yet, and returns their
    /// number.
    #[inline(always)]
    pub(crate) fn count(&mut self, samples: usize) -> usize {
        if !self.is_computed {
            self.compute(samples);
        }
        self.found
    }

    /// Chebyshev's algorithm.
    fn compute(&mut self, samples: usize) {
        self.is_computed = true;
        // `<p_k, v^l>` for the last `k` and for the one before, from `l = k` on.
        let (mut moments, mut before) = (self.sums, [0.0; 2 * LANES]);
        for k in 0..TERMS.min(samples) {
            if k > 0 {
                let (a, b) = (self.a[k - 1], self.b[k - 1]);
                // From those of k - 1 and k - 2, in place of the latter.
                for l in k..MOMENTS - k {
                    before[l] = moments[l + 1] - a * moments[l] - b * before[l];
                }
                std::mem::swap(&mut moments, &mut before);
            }
            let norm = moments[k];
            if norm <= DEGENERATE * self.sums[2 * k] || !norm.is_finite() {
                return;
            }
            self.per_norm[k] = 1.0 / norm;
            if k == 0 {
                self.by_power[0][0] = 1.0;
                self.a[0] = moments[1] * self.per_norm[0];
            } else {
                let (a, b) = (self.a[k - 1], self.b[k - 1]);
                for j in 0..=k {
                    let shifted = if j > 0 {
                        self.by_power[j - 1][k - 1]
                    } else {
                        0.0
                    };
                    let own = &mut self.by_power[j];
                    let second = if k > 1 { own[k - 2] } else { 0.0 };
                    own[k] = shifted - a * own[k - 1] - b * second;
                }
                let earlier = self.per_norm[k - 1];
                if k + 1 < TERMS {
                    self.a[k] = moments[k + 1] * self.per_norm[k] - before[k] * earlier;
                }
                self.b[k] = norm * earlier;
            }
            self.found = k + 1;
        }
    }

    /// The instant is another one.
    pub(crate) fn displace(&mut self) {
        self.is_placed = false;
    }

    /// Evaluates the polynomials at the instant `at`, unless that was done.
    #[inline(always)]
    pub(crate) fn place(&mut self, at: f64) {
        if !self.is_placed {
            self.evaluate(at);
        }
    }

    fn evaluate(&mut self, at: f64) {
        self.is_placed = true;
        let mut variance = [0.0; 3];
        for k in 0..self.found {
            let none = [0.0; 3];
            self.here[k] = match k {
                0 => [1.0, 0.0, 0.0],
                _ => {
                    let (here, before) = (
                        self.here[k - 1],
                        if k > 1 { self.here[k - 2] } else { none },
                    );
                    let (a, b) = (self.a[k - 1], self.b[k - 1]);
                    per_derivative(|m| {
                        let inner = if m > 0 { m as f64 * here[m - 1] } else { 0.0 };
                        (at - a) * here[m] + inner - b * before[m]
                    })
                }
            };
            variance = per_derivative(|m| {
                variance[m] + self.here[k][m] * self.here[k][m] * self.per_norm[k]
            });
            self.deviation[k] = variance.map(f64::sqrt);
        }
    }

    /// `<x, p_k>` of all polynomials, for values `x` with these moments.
    #[inline(always)]
    pub(crate) fn products(&self, moments: &[f64; LANES]) -> [f64; LANES] {
        let mut products = [0.0; LANES];
        for (moment, own) in moments.iter().zip(&self.by_power) {
            for k in 0..LANES {
                products[k] += moment * own[k];
            }
        }
        products
    }

    /// The least-squares polynomial of degree `N - 1` for values with these products, in powers of
    /// `v`.
    #[inline(always)]
    pub(crate) fn polynomial<const N: usize>(&self, products: &[f64; LANES]) -> [f64; N] {
        let mut polynomial = [0.0; N];
        for (sum, own) in polynomial.iter_mut().zip(&self.by_power) {
            for k in 0..N {
                *sum += products[k] * self.per_norm[k] * own[k];
            }
        }
        polynomial
    }
}

pub(crate) fn per_derivative(f: impl FnMut(usize) -> f64) -> [f64; 3] {
    core::array::from_fn(f)
}

/// The next longer window to try, at most `most`.
pub(crate) fn longer(samples: usize, most: usize) -> usize {
    let next = samples + (samples / 3).max(1);
    // A last step of a few samples would cost a whole window for no information.
    if next + next / 8 >= most { most } else { next }
}
