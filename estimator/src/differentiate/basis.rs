//! Polynomials orthogonal over the stamps of a window.

use crate::differentiate::estimate::MAX_SAMPLES;
use proprio_topics::Nanos;

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

/// The stamps of a window's samples, in a ring buffer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Ring {
    pub(crate) stamps: [Nanos; MAX_SAMPLES],
    /// Which samples restart the window: they are not fitted together with earlier ones.
    pub(crate) restarts: [bool; MAX_SAMPLES],
    /// The index of the newest sample. The oldest is at `newest + 1 - len` modulo the array length.
    pub(crate) newest: usize,
    pub(crate) len: usize,
}

/// Polynomials orthogonal over the newest samples, and their values at an instant; computed on
/// demand.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Basis {
    /// `<p_k, v^l>` for the last `k` computed and for the one before, from `l = k` on.
    pub(crate) moments: [[f64; MOMENTS]; 2],
    /// `<v^k, v^k>`: the scale of the rounding error of `<p_k, p_k>`.
    pub(crate) scale: [f64; TERMS],
    /// Coefficients of the recurrence.
    pub(crate) a: [f64; TERMS],
    pub(crate) b: [f64; TERMS],
    /// `1 / <p_k, p_k>`.
    pub(crate) per_norm: [f64; TERMS],
    /// Coefficients of `p_k` by powers of `v`.
    pub(crate) powers: [[f64; TERMS]; TERMS],
    /// The number of polynomials computed, and whether there are no more.
    pub(crate) found: usize,
    pub(crate) is_exhausted: bool,
    /// `p_k` and its derivatives by `v` at the instant, and the sums of `p_k^(m)^2 / <p_k, p_k>` up
    /// to `k`; for `k < placed`.
    pub(crate) here: [[f64; 3]; TERMS],
    pub(crate) variance: [[f64; 3]; TERMS],
    pub(crate) placed: usize,
}

impl Ring {
    pub(crate) const EMPTY: Self = Self {
        stamps: [Nanos::ZERO; MAX_SAMPLES],
        restarts: [false; MAX_SAMPLES],
        newest: 0,
        len: 0,
    };

    /// The index of the sample that has `age` later ones.
    pub(crate) fn at(&self, age: usize) -> usize {
        (self.newest + MAX_SAMPLES - age) % MAX_SAMPLES
    }
}

impl Basis {
    pub(crate) const NONE: Self = Self {
        moments: [[0.0; MOMENTS]; 2],
        scale: [0.0; TERMS],
        a: [0.0; TERMS],
        b: [0.0; TERMS],
        per_norm: [0.0; TERMS],
        powers: [[0.0; TERMS]; TERMS],
        found: 0,
        is_exhausted: true,
        here: [[0.0; 3]; TERMS],
        variance: [[0.0; 3]; TERMS],
        placed: 0,
    };

    /// A basis from the sums of `v^0 ... v^10`.
    pub(crate) fn new(sums: [f64; MOMENTS]) -> Self {
        Self {
            moments: [sums, [0.0; MOMENTS]],
            scale: std::array::from_fn(|k| sums[2 * k]),
            is_exhausted: false,
            ..Self::NONE
        }
    }

    /// Computes the polynomials up to this degree. False if the `samples` are too few.
    pub(crate) fn reaches(&mut self, degree: usize, samples: usize) -> bool {
        while self.found <= degree && !self.is_exhausted {
            self.next(samples);
        }
        self.found > degree
    }

    /// One degree more, by Chebyshev's algorithm.
    pub(crate) fn next(&mut self, samples: usize) {
        let k = self.found;
        let [moments, before] = &mut self.moments;
        if k > 0 {
            let (a, b) = (self.a[k - 1], self.b[k - 1]);
            // <p_k, v^l> from those of k - 1 and k - 2, in place of the latter.
            for l in k..MOMENTS - k {
                before[l] = moments[l + 1] - a * moments[l] - b * before[l];
            }
            std::mem::swap(moments, before);
        }
        let norm = moments[k];
        if k >= samples || norm <= DEGENERATE * self.scale[k] || !norm.is_finite() {
            self.is_exhausted = true;
            return;
        }
        self.per_norm[k] = 1.0 / norm;
        if k == 0 {
            self.powers[0][0] = 1.0;
            self.a[0] = moments[1] * self.per_norm[0];
        } else {
            let (a, b) = (self.a[k - 1], self.b[k - 1]);
            for j in 0..=k {
                let shifted = if j > 0 {
                    self.powers[k - 1][j - 1]
                } else {
                    0.0
                };
                let second = if k > 1 { self.powers[k - 2][j] } else { 0.0 };
                self.powers[k][j] = shifted - a * self.powers[k - 1][j] - b * second;
            }
            let earlier = self.per_norm[k - 1];
            if k + 1 < TERMS {
                self.a[k] = moments[k + 1] * self.per_norm[k] - before[k] * earlier;
            }
            self.b[k] = norm * earlier;
        }
        self.found += 1;
        self.is_exhausted = self.found == TERMS;
    }

    /// Evaluates `p_k` up to this degree at the instant `at`; they must have been computed.
    pub(crate) fn place(&mut self, degree: usize, at: f64) {
        for k in self.placed..=degree.min(TERMS - 1) {
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
            let so_far = if k > 0 { self.variance[k - 1] } else { none };
            self.variance[k] = per_derivative(|m| {
                so_far[m] + self.here[k][m] * self.here[k][m] * self.per_norm[k]
            });
            self.placed = k + 1;
        }
    }

    /// The coefficients of the least-squares polynomial in `p_0 ... p_{N-1}`, for values with these
    /// moments.
    pub(crate) fn coefficients<const N: usize>(&self, moments: &[f64; TERMS]) -> [f64; N] {
        let (mut of, mut before) = (*moments, [0.0; TERMS]);
        std::array::from_fn(|k| {
            if k > 0 {
                let (a, b) = (self.a[k - 1], self.b[k - 1]);
                for l in 0..N - k {
                    before[l] = of[l + 1] - a * of[l] - b * before[l];
                }
                std::mem::swap(&mut of, &mut before);
            }
            of[0] * self.per_norm[k]
        })
    }

    /// The same in powers of `v`.
    pub(crate) fn polynomial<const N: usize>(&self, moments: &[f64; TERMS]) -> [f64; N] {
        let coefficients = self.coefficients::<N>(moments);
        let mut polynomial = [0.0; N];
        for (coefficient, powers) in coefficients.iter().zip(&self.powers) {
            for (sum, power) in polynomial.iter_mut().zip(powers) {
                *sum += coefficient * power;
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
