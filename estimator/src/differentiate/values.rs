//! Polynomial fits of the values of a window, and their standard deviations.

use crate::differentiate::basis::{
    CANDIDATES, FIRST_DEGREE, KAPPA, LANES, NONE, PerWindow, SHORTEST, STRETCH, TERMS, TOLERANCE,
    set, vector,
};
use crate::differentiate::estimate::SignalEstimate;
use crate::differentiate::grid::Grid;
use proprio_topics::Nanos;
use pulp::{Simd, WithSimd};

/// Relative rounding error of the square sum of residuals.
const ROUNDING: f64 = 1e-9;

/// The samples used for an estimate, newest first.
pub(crate) struct Values<'a, const D: usize> {
    pub(crate) grid: &'a mut Grid,
    pub(crate) stamps: &'a [Nanos],
    pub(crate) values: [&'a [f64]; D],
    /// The newest ones, which the fits are relative to, so that a constant costs no digits.
    pub(crate) origin: [f64; D],
    /// The squared divided differences of these samples alone.
    pub(crate) roughness_square: [&'a [f64]; D],
    /// The least peak noise.
    pub(crate) least_noise: f64,
    /// Time of the instant after the newest sample \[s\].
    pub(crate) time: f64,
}

impl<const D: usize> WithSimd for Values<'_, D> {
    type Output = SignalEstimate<D>;

    /// The three steps described in the parent module.
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> SignalEstimate<D> {
        self.grid.make(simd, self.stamps);
        self.grid.place(simd, self.time);
        let grid = &*self.grid;
        let mut estimate = SignalEstimate::NONE;
        for component in 0..D {
            let squares = self.roughness_square[component];
            let variance = sum(squares) / squares.len().max(1) as f64;
            let (values, origin) = (self.values[component], self.origin[component]);
            let moments = moments(simd, grid, values, origin);
            let fit = Component {
                grid,
                values,
                origin,
                // An error uniformly distributed over +-noise has the variance noise^2 / 3.
                noise: (3.0 * variance).sqrt().max(self.least_noise),
                square: moments[LANES - 1],
                products: grid.bases.products(simd, &moments),
                component,
            };
            fit.estimate(simd, &mut estimate);
        }
        estimate
    }
}

/// Of each window, `<x, v^k>`, and last `<x, x>`; `x` are the values less `origin`.
#[inline(always)]
fn moments<S: Simd>(simd: S, grid: &Grid, values: &[f64], origin: f64) -> [PerWindow; LANES] {
    const LAST: [f64; LANES] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let vectors = LANES / S::F64_LANES;
    let last = S::as_simd_f64s(&LAST).0[vectors - 1];
    let (mut moments, mut before, mut from) = ([NONE; LANES], [0.0; LANES], 0);
    for (window, &samples) in grid.lengths[..grid.tried].iter().enumerate() {
        // The sums of the samples that are new in this window begin at zero, so that none waits for
        // those before it.
        let mut sums = [simd.splat_f64s(0.0); LANES];
        let all = grid.powers[from..samples].iter();
        for (powers, value) in all.zip(&values[from..samples]) {
            let x = simd.splat_f64s(value - origin);
            let powers = S::as_simd_f64s(powers).0;
            for i in 0..vectors - 1 {
                sums[i] = simd.mul_add_e_f64s(x, powers[i], sums[i]);
            }
            // `x` is the last factor besides the powers.
            let factors = simd.mul_add_e_f64s(x, last, powers[vectors - 1]);
            sums[vectors - 1] = simd.mul_add_e_f64s(x, factors, sums[vectors - 1]);
        }
        let mut parts = [0.0; LANES];
        for (to, sum) in S::as_mut_simd_f64s(&mut parts).0.iter_mut().zip(&sums) {
            *to = *sum;
        }
        for k in 0..LANES {
            before[k] += parts[k];
            moments[k][window] = before[k];
        }
        from = samples;
    }
    moments
}

/// The sum of many numbers, in parts that do not wait for each other.
#[inline(always)]
pub(crate) fn sum(numbers: &[f64]) -> f64 {
    let (whole, rest) = numbers.as_chunks::<LANES>();
    let mut sums = [0.0; LANES];
    for eight in whole {
        for k in 0..LANES {
            sums[k] += eight[k];
        }
    }
    let mut total = 0.0;
    for number in sums.iter().chain(rest) {
        total += number;
    }
    total
}

/// One of the `D` numbers.
struct Component<'a> {
    grid: &'a Grid,
    values: &'a [f64],
    origin: f64,
    noise: f64,
    /// `<x, x>` and `<x, p_k>`.
    square: PerWindow,
    products: [PerWindow; TERMS],
    component: usize,
}

impl Component<'_> {
    #[inline(always)]
    fn estimate<S: Simd, const D: usize>(&self, simd: S, estimate: &mut SignalEstimate<D>) {
        let (mut degree, mut end, mut longest) = (0, 0, 0.0);
        for (d, stretch) in STRETCH.into_iter().enumerate() {
            // A degree is not tried if the span of all samples is too short for it.
            if end > 0 && self.grid.span < stretch * longest {
                continue;
            }
            let (tried, widest) = match d {
                0 => self.grow::<S, 3>(simd),
                1 => self.grow::<S, 4>(simd),
                _ => self.grow::<S, 5>(simd),
            };
            if let Some(widest) = widest
                && (end == 0 || widest >= stretch * longest)
            {
                (degree, end, longest) = (FIRST_DEGREE + d, tried, widest);
            }
        }
        match degree {
            0 => {}
            2 => self.trim::<S, 3, D>(simd, end, estimate),
            3 => self.trim::<S, 4, D>(simd, end, estimate),
            _ => self.trim::<S, 5, D>(simd, end, estimate),
        }
    }

    /// Step 1 for degree `N - 1`: the number of window lengths, from the first on, that fit within
    /// the tolerance; and the span of the longest that gives an estimate \[s\].
    ///
    /// The square sum of a window's residuals grows with its length, and bounds each of them. So
    /// if it is within the square of the tolerance, that window and all shorter ones fit. Only
    /// from the longest such window on, the residuals themselves are computed.
    #[inline(always)]
    fn grow<S: Simd, const N: usize>(&self, simd: S) -> (usize, Option<f64>) {
        let (grid, bases) = (self.grid, &self.grid.bases);
        let tolerance = TOLERANCE * self.noise;
        let mut left = NONE;
        for i in 0..CANDIDATES / S::F64_LANES {
            let all = vector::<S>(&self.square, i);
            let mut sum = simd.mul_f64s(all, simd.splat_f64s(1.0 + ROUNDING));
            for k in 0..N {
                let product = vector::<S>(&self.products[k], i);
                let square = simd.mul_f64s(product, product);
                sum = simd.sub_f64s(
                    sum,
                    simd.mul_f64s(square, vector::<S>(&bases.per_norm[k], i)),
                );
            }
            set::<S>(&mut left, i, sum);
        }
        // The comparisons use `<=`, so that NaN does not fit.
        let certain = (0..grid.tried)
            .rev()
            .find(|&window| bases.has(N, window) && left[window] <= tolerance * tolerance);
        let mut widest = certain.map(|window| grid.seconds(grid.lengths[window]));
        let first = certain.map_or(0, |window| window + 1);
        let mut fitting = first;
        for window in first..grid.tried {
            let samples = grid.lengths[window];
            if samples < N {
                continue;
            }
            if bases.has(N, window) {
                let polynomial = bases.polynomial::<N>(&self.products, window);
                if !self.fits(simd, &polynomial, samples, tolerance) {
                    break;
                }
                widest = Some(grid.seconds(samples));
            }
            fitting = window + 1;
        }
        (fitting, widest)
    }

    /// Whether the residuals of so many samples are within the tolerance.
    #[inline(always)]
    fn fits<S: Simd>(&self, simd: S, polynomial: &[f64], samples: usize, tolerance: f64) -> bool {
        let (values, rest) = S::as_simd_f64s(&self.values[..samples]);
        let (times, times_of_rest) = S::as_simd_f64s(&self.grid.times[..samples]);
        let (least, most) = (simd.splat_f64s(-tolerance), simd.splat_f64s(tolerance));
        let origin = simd.splat_f64s(self.origin);
        let mut fits = simd.less_than_or_equal_f64s(least, most);
        for (value, v) in values.iter().zip(times) {
            let mut fitted = simd.splat_f64s(0.0);
            for coefficient in polynomial.iter().rev() {
                fitted = simd.mul_add_e_f64s(fitted, *v, simd.splat_f64s(*coefficient));
            }
            let residual = simd.sub_f64s(simd.sub_f64s(*value, origin), fitted);
            for is_within in [
                simd.less_than_or_equal_f64s(least, residual),
                simd.less_than_or_equal_f64s(residual, most),
            ] {
                fits = simd.and_m64s(fits, is_within);
            }
        }
        let misses = simd.select_f64s(fits, simd.splat_f64s(0.0), simd.splat_f64s(1.0));
        let mut fits = simd.reduce_sum_f64s(misses) == 0.0;
        for (value, v) in rest.iter().zip(times_of_rest) {
            let fitted = (polynomial.iter().rev()).fold(0.0, |sum, own| sum * v + own);
            fits &= (value - self.origin - fitted).abs() <= tolerance;
        }
        fits
    }

    /// Step 3 for degree `N - 1`, on the first `end` lengths.
    #[inline(always)]
    fn trim<S: Simd, const N: usize, const D: usize>(
        &self,
        simd: S,
        end: usize,
        estimate: &mut SignalEstimate<D>,
    ) {
        let (grid, bases) = (self.grid, &self.grid.bases);
        let component = self.component;
        let most = end.checked_sub(1).map_or(0, |last| grid.lengths[last]);
        let sigma = self.noise / 3.0_f64.sqrt();
        let per_span = 1.0 / grid.span;
        let scale = [1.0, per_span, per_span * per_span];
        let mut values = [NONE; 3];
        for i in 0..CANDIDATES / S::F64_LANES {
            let mut sums = [simd.splat_f64s(0.0); 3];
            for k in 0..N {
                let product = vector::<S>(&self.products[k], i);
                let coefficient = simd.mul_f64s(product, vector::<S>(&bases.per_norm[k], i));
                for (sum, here) in sums.iter_mut().zip(&bases.here[k]) {
                    let part = simd.mul_f64s(coefficient, vector::<S>(here, i));
                    *sum = simd.add_f64s(*sum, part);
                }
            }
            for (to, sum) in values.iter_mut().zip(sums) {
                set::<S>(to, i, sum);
            }
        }
        let (mut best, mut variance, mut samples) = ([f64::NAN; 3], [f64::NAN; 3], [0; 3]);
        let (mut low, mut high) = ([f64::NEG_INFINITY; 3], [f64::INFINITY; 3]);
        let mut meets = [true; 3];
        for (window, &length) in grid.lengths[..end].iter().enumerate() {
            if (length as f64) < SHORTEST * most as f64 || !bases.has(N, window) {
                continue;
            }
            // One degree more, to estimate the truncation error of this one.
            let next = self.products[N][window] * bases.per_norm[N][window];
            for m in 0..3 {
                let s = sigma * scale[m] * bases.variance[N - 1][m][window].sqrt();
                if !meets[m] || !s.is_finite() {
                    continue;
                }
                let e = values[m][window] * scale[m];
                low[m] = low[m].max(e - KAPPA[m] * s);
                high[m] = high[m].min(e + KAPPA[m] * s);
                meets[m] = low[m] <= high[m];
                if !meets[m] {
                    continue;
                }
                best[m] = e;
                // Quantisation errors do not average out at rest, so the value is not better than
                // one sample.
                let s = if m == 0 { s.max(sigma) } else { s };
                let omitted = next * bases.here[N][m][window] * scale[m];
                variance[m] = s * s + omitted * omitted;
                samples[m] = length;
            }
        }
        let places = [
            &mut estimate.value,
            &mut estimate.first,
            &mut estimate.second,
        ];
        best[0] += self.origin;
        for (place, best) in places.into_iter().zip(best) {
            place[component] = best;
        }
        let places = [
            &mut estimate.value_std,
            &mut estimate.first_std,
            &mut estimate.second_std,
        ];
        for (place, deviation) in places.into_iter().zip(variance.map(f64::sqrt)) {
            place[component] = deviation;
        }
        for (kept, samples) in estimate.samples.iter_mut().zip(samples) {
            *kept = (*kept).min(samples);
        }
    }
}
