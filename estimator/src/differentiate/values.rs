//! Polynomial fits of the values of a window, and their standard deviations.

use crate::differentiate::basis::{
    CANDIDATES, FIRST_DEGREE, FITTED, KAPPA, SHORTEST, STRETCH, TERMS, TOLERANCE,
};
use crate::differentiate::estimate::{Estimate, MAX_SAMPLES};
use crate::differentiate::grid::Grid;

/// The values of the samples used, and their moments.
pub(crate) struct Values<const D: usize> {
    /// Newest first, relative to the newest one, so that a constant costs no digits.
    pub(crate) values: [[f64; MAX_SAMPLES]; D],
    /// `<x, v^k>` over each window length.
    pub(crate) moments: [[[f64; TERMS]; CANDIDATES]; D],
}

impl<const D: usize> Values<D> {
    pub(crate) fn new(values: [[f64; MAX_SAMPLES]; D], grid: &Grid) -> Self {
        let mut moments = [[[0.0; TERMS]; CANDIDATES]; D];
        for (values, moments) in values.iter().zip(&mut moments) {
            let (mut sums, mut from) = ([0.0; TERMS], 0);
            for (&samples, place) in grid.lengths.iter().zip(moments).take(grid.tried) {
                let range = from..samples;
                let values = values.get(range.clone()).unwrap_or_default();
                let powers = grid.powers.get(range).unwrap_or_default();
                for (value, powers) in values.iter().zip(powers) {
                    for k in 0..TERMS {
                        sums[k] += value * powers[k];
                    }
                }
                *place = sums;
                from = samples;
            }
        }
        Self { values, moments }
    }

    /// The three steps described in the parent module.
    pub(crate) fn estimate(
        &self,
        grid: &mut Grid,
        noise: &[f64; D],
        origin: &[f64; D],
    ) -> Estimate<D> {
        let mut estimate = Estimate::NONE;
        for (component, noise) in noise.iter().enumerate() {
            self.component(component, grid, *noise, origin, &mut estimate);
        }
        estimate
    }

    /// The same for one of the `D` numbers.
    pub(crate) fn component(
        &self,
        component: usize,
        grid: &mut Grid,
        noise: f64,
        origin: &[f64; D],
        estimate: &mut Estimate<D>,
    ) {
        let tolerance = noise * TOLERANCE;
        let (mut degree, mut end, mut longest) = (0, 0, 0.0);
        for (d, stretch) in STRETCH.into_iter().enumerate() {
            // A degree is not tried if the span of all samples is too short for it.
            if end > 0 && grid.span < stretch * longest {
                continue;
            }
            let (tried, widest) = match d {
                0 => self.grow::<3>(component, grid, tolerance),
                1 => self.grow::<4>(component, grid, tolerance),
                _ => self.grow::<5>(component, grid, tolerance),
            };
            if let Some(widest) = widest
                && (end == 0 || widest >= stretch * longest)
            {
                (degree, end, longest) = (FIRST_DEGREE + d, tried, widest);
            }
        }
        match degree {
            0 => {}
            2 => self.trim::<3>(component, grid, end, noise, origin, estimate),
            3 => self.trim::<4>(component, grid, end, noise, origin, estimate),
            _ => self.trim::<5>(component, grid, end, noise, origin, estimate),
        }
    }

    /// Step 1 for degree `N - 1`: the number of window lengths, from the first on, that fit within
    /// the tolerance; and the span of the longest that gives an estimate \[s\].
    ///
    /// From one length to the next, the residuals of samples in both windows change by the
    /// difference of the two polynomials. The old bound of the residuals plus a bound of that
    /// change is mostly below the tolerance. Only where it is not, residuals are computed again.
    pub(crate) fn grow<const N: usize>(
        &self,
        component: usize,
        grid: &mut Grid,
        tolerance: f64,
    ) -> (usize, Option<f64>) {
        let (values, moments) = (&self.values[component], &self.moments[component]);
        let (mut fitting, mut widest) = (0, None);
        let (mut last, mut seen, mut bound) = ([0.0; N], 0, 0.0_f64);
        for (number, moments) in moments.iter().enumerate().take(grid.tried) {
            let samples = grid.lengths[number];
            let basis = &mut grid.bases[number];
            if samples < N {
                continue;
            }
            if basis.reaches(N - 1, samples) {
                let polynomial = basis.polynomial::<N>(moments);
                let largest = |from: usize, to: usize| {
                    let values = values.get(from..to).unwrap_or_default();
                    let powers = grid.powers.get(from..to).unwrap_or_default();
                    largest_residual(&polynomial, values, powers)
                };
                let mut change = [0.0; N];
                for (change, (new, old)) in change.iter_mut().zip(polynomial.iter().zip(&last)) {
                    *change = new - old;
                }
                let added = largest(seen, samples);
                let kept = bound + magnitude_bound(&change, grid.extent(seen));
                // The comparisons use `<=`, so that NaN does not fit.
                bound = if kept <= tolerance {
                    kept
                } else {
                    largest(0, seen)
                }
                .max(added);
                if !(bound <= tolerance && added <= tolerance) {
                    break;
                }
                (last, seen) = (polynomial, samples);
                widest = Some(grid.seconds(samples));
            }
            fitting = number + 1;
        }
        (fitting, widest)
    }

    /// Step 3 for degree `N - 1`, on the first `end` lengths.
    pub(crate) fn trim<const N: usize>(
        &self,
        component: usize,
        grid: &mut Grid,
        end: usize,
        noise: f64,
        origin: &[f64; D],
        estimate: &mut Estimate<D>,
    ) {
        let most = end.checked_sub(1).map_or(0, |last| grid.lengths[last]);
        let sigma = noise / 3.0_f64.sqrt();
        let per_span = 1.0 / grid.span;
        let scale = [1.0, per_span, per_span * per_span];
        let (mut best, mut deviation, mut samples) = ([f64::NAN; 3], [f64::NAN; 3], [0; 3]);
        let (mut low, mut high) = ([f64::NEG_INFINITY; 3], [f64::INFINITY; 3]);
        let mut meets = [true; 3];
        for number in 0..end {
            let length = grid.lengths[number];
            let basis = &mut grid.bases[number];
            if (length as f64) < SHORTEST * most as f64 || !basis.reaches(N - 1, length) {
                continue;
            }
            // One degree more, to estimate the truncation error of this one.
            let degree = if basis.reaches(N, length) { N } else { N - 1 };
            basis.place(degree, grid.at);
            let coefficients = basis.coefficients::<TERMS>(&self.moments[component][number]);
            let mut value = [0.0; 3];
            for (coefficient, here) in coefficients.iter().zip(&basis.here).take(N) {
                for m in 0..3 {
                    value[m] += coefficient * here[m];
                }
            }
            for m in 0..3 {
                let s = sigma * scale[m] * basis.variance[N - 1][m].sqrt();
                if !meets[m] || !s.is_finite() {
                    continue;
                }
                let e = value[m] * scale[m];
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
                let omitted = if degree == N {
                    coefficients[N] * basis.here[N][m] * scale[m]
                } else {
                    0.0
                };
                deviation[m] = (s * s + omitted * omitted).sqrt();
                samples[m] = length;
            }
        }
        let places = [
            &mut estimate.value,
            &mut estimate.first,
            &mut estimate.second,
        ];
        best[0] += origin[component];
        for (place, best) in places.into_iter().zip(best) {
            place[component] = best;
        }
        let places = [
            &mut estimate.value_std,
            &mut estimate.first_std,
            &mut estimate.second_std,
        ];
        for (place, deviation) in places.into_iter().zip(deviation) {
            place[component] = deviation;
        }
        for (kept, samples) in estimate.samples.iter_mut().zip(samples) {
            *kept = (*kept).min(samples);
        }
    }
}

/// The polynomial at `v`, by Horner's rule.
#[inline(always)]
pub(crate) fn evaluate<const N: usize>(polynomial: &[f64; N], v: f64) -> f64 {
    polynomial.iter().rev().fold(0.0, |sum, c| sum * v + c)
}

/// The largest residual of the samples with these powers of `v`; infinite if one is NaN.
#[inline(always)]
pub(crate) fn largest_residual<const N: usize>(
    polynomial: &[f64; N],
    values: &[f64],
    powers: &[[f64; TERMS]],
) -> f64 {
    // Four lanes: with a single one each step would wait for the one before.
    let mut largest = [0.0_f64; 4];
    let ((values4, values), (powers4, powers)) = (values.as_chunks::<4>(), powers.as_chunks::<4>());
    let residual = |value: f64, powers: &[f64; TERMS]| {
        let distance = (value - evaluate(polynomial, powers[1])).abs();
        if distance.is_nan() {
            f64::INFINITY
        } else {
            distance
        }
    };
    for (values, powers) in values4.iter().zip(powers4) {
        for i in 0..4 {
            let distance = residual(values[i], &powers[i]);
            largest[i] = if distance > largest[i] {
                distance
            } else {
                largest[i]
            };
        }
    }
    for (value, powers) in values.iter().zip(powers) {
        largest[0] = largest[0].max(residual(*value, powers));
    }
    largest[0].max(largest[1]).max(largest[2].max(largest[3]))
}

/// An upper bound of a polynomial's magnitude from `-extent` to 0: the largest magnitude at the
/// extrema of the Chebyshev polynomial of degree 8, times `1 / cos(pi n / 16)` for degree `n` up to
/// 4. (Ehlich, Zeller, "Schwankung von Polynomen zwischen Gitterpunkten", Math. Zeitschrift 86,
/// 1964.)
#[inline(always)]
pub(crate) fn magnitude_bound<const N: usize>(polynomial: &[f64; N], extent: f64) -> f64 {
    const PLACES: [f64; 9] = [
        0.0,
        0.038_060_233_744_356_62,
        0.146_446_609_406_726_24,
        0.308_658_283_817_455_1,
        0.5,
        0.691_341_716_182_544_9,
        0.853_553_390_593_273_8,
        0.961_939_766_255_643_4,
        1.0,
    ];
    let mut largest = 0.0_f64;
    for place in PLACES {
        let value = evaluate(polynomial, -extent * place).abs();
        largest = if value > largest { value } else { largest };
    }
    // 1 / cos(pi / 8), 1 / cos(3 pi / 16), 1 / cos(pi / 4), rounded up.
    const BETWEEN: [f64; FITTED] = [1.083, 1.203, 1.415];
    largest * BETWEEN[N - 1 - FIRST_DEGREE]
}
