//! Polynomial fits of the values of a window, and their standard deviations.

use crate::differentiate::basis::{
    CANDIDATES, FIRST_DEGREE, KAPPA, LANES, SHORTEST, STRETCH, TERMS, TOLERANCE,
};
use crate::differentiate::estimate::Estimate;
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

/// Of each window length, `<x, v^k>`, and in the last lane `<x, x>`.
type Moments<const D: usize> = [[[f64; LANES]; D]; CANDIDATES];

impl<const D: usize> WithSimd for Values<'_, D> {
    type Output = Estimate<D>;

    /// The three steps described in the parent module.
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Estimate<D> {
        self.grid.make(self.stamps);
        self.grid.place(self.time);
        let moments = self.moments(simd);
        let Self {
            grid,
            values,
            origin,
            roughness_square,
            least_noise,
            ..
        } = self;
        let mut estimate = Estimate::NONE;
        for component in 0..D {
            let own = roughness_square[component];
            let variance = sum(own) / own.len().max(1) as f64;
            let own = Component {
                values: values[component],
                origin: origin[component],
                // An error uniformly distributed over +-noise has the variance noise^2 / 3.
                noise: (3.0 * variance).sqrt().max(least_noise),
                moments: &moments,
                component,
            };
            own.estimate(grid, &mut estimate);
        }
        estimate
    }
}

impl<const D: usize> Values<'_, D> {
    #[inline(always)]
    fn moments<S: Simd>(&self, simd: S) -> Moments<D> {
        let (mut moments, mut before, mut from) =
            ([[[0.0; LANES]; D]; CANDIDATES], [[0.0; LANES]; D], 0);
        let lengths = &self.grid.lengths[..self.grid.tried];
        for (&samples, moments) in lengths.iter().zip(&mut moments) {
            // The sums of the samples that are new in this window begin at zero, so that none
            // waits for those before it.
            let (mut sums, mut squares) = ([[simd.splat_f64s(0.0); LANES]; D], [0.0; D]);
            let powers = &self.grid.powers[from..samples];
            let mut values: [&[f64]; D] = [&[]; D];
            for (own, all) in values.iter_mut().zip(&self.values) {
                *own = &all[from..samples];
            }
            for i in 0..powers.len() {
                let powers = S::as_simd_f64s(&powers[i]).0;
                for component in 0..D {
                    let x = values[component][i] - self.origin[component];
                    let splat = simd.splat_f64s(x);
                    for (sum, power) in sums[component].iter_mut().zip(powers) {
                        *sum = simd.mul_add_e_f64s(splat, *power, *sum);
                    }
                    squares[component] += x * x;
                }
            }
            for component in 0..D {
                let own = &mut moments[component];
                let vectors = S::as_mut_simd_f64s(own).0.iter_mut();
                for (to, sum) in vectors.zip(&sums[component]) {
                    *to = *sum;
                }
                own[LANES - 1] = squares[component];
                for k in 0..LANES {
                    own[k] += before[component][k];
                }
                before[component] = *own;
            }
            from = samples;
        }
        moments
    }
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
struct Component<'a, const D: usize> {
    values: &'a [f64],
    origin: f64,
    noise: f64,
    moments: &'a Moments<D>,
    component: usize,
}

impl<const D: usize> Component<'_, D> {
    #[inline(always)]
    fn estimate(&self, grid: &mut Grid, estimate: &mut Estimate<D>) {
        let (mut degree, mut end, mut longest) = (0, 0, 0.0);
        for (d, stretch) in STRETCH.into_iter().enumerate() {
            // A degree is not tried if the span of all samples is too short for it.
            if end > 0 && grid.span < stretch * longest {
                continue;
            }
            let (tried, widest) = match d {
                0 => self.grow::<3>(grid),
                1 => self.grow::<4>(grid),
                _ => self.grow::<5>(grid),
            };
            if let Some(widest) = widest
                && (end == 0 || widest >= stretch * longest)
            {
                (degree, end, longest) = (FIRST_DEGREE + d, tried, widest);
            }
        }
        match degree {
            0 => {}
            2 => self.trim::<3>(grid, end, estimate),
            3 => self.trim::<4>(grid, end, estimate),
            _ => self.trim::<5>(grid, end, estimate),
        }
    }

    /// Step 1 for degree `N - 1`: the number of window lengths, from the first on, that fit within
    /// the tolerance; and the span of the longest that gives an estimate \[s\].
    ///
    /// The square sum of a window's residuals grows with its length, and bounds each of them. So
    /// if it is within the square of the tolerance, that window and all shorter ones fit. Only
    /// from the longest such window on, the residuals themselves are computed.
    #[inline(always)]
    fn grow<const N: usize>(&self, grid: &mut Grid) -> (usize, Option<f64>) {
        let tolerance = TOLERANCE * self.noise;
        let (mut fitting, mut widest) = (0, None);
        for number in (0..grid.tried).rev() {
            let samples = grid.lengths[number];
            let basis = &mut grid.bases[number];
            if samples < N || basis.count(samples) < N {
                continue;
            }
            let moments = &self.moments[number][self.component];
            let products = basis.products(moments);
            let all = moments[LANES - 1];
            let mut left = all * (1.0 + ROUNDING);
            for (product, per_norm) in products.iter().zip(&basis.per_norm).take(N) {
                left -= product * product * per_norm;
            }
            // The comparisons use `<=`, so that NaN does not fit.
            if left <= tolerance * tolerance {
                (fitting, widest) = (number + 1, Some(grid.seconds(samples)));
                break;
            }
        }
        let certain = fitting;
        for number in certain..grid.tried {
            let samples = grid.lengths[number];
            let basis = &mut grid.bases[number];
            if samples < N {
                continue;
            }
            if basis.count(samples) >= N {
                let products = basis.products(&self.moments[number][self.component]);
                let polynomial = basis.polynomial::<N>(&products);
                let mut fits = true;
                for (value, v) in self.values[..samples].iter().zip(&grid.times) {
                    let mut fitted = 0.0;
                    for coefficient in polynomial.iter().rev() {
                        fitted = fitted * v + coefficient;
                    }
                    fits &= (value - self.origin - fitted).abs() <= tolerance;
                }
                if !fits {
                    break;
                }
                widest = Some(grid.seconds(samples));
            }
            fitting = number + 1;
        }
        (fitting, widest)
    }

    /// Step 3 for degree `N - 1`, on the first `end` lengths.
    #[inline(always)]
    fn trim<const N: usize>(&self, grid: &mut Grid, end: usize, estimate: &mut Estimate<D>) {
        let component = self.component;
        let most = end.checked_sub(1).map_or(0, |last| grid.lengths[last]);
        let sigma = self.noise / 3.0_f64.sqrt();
        let per_span = 1.0 / grid.span;
        let scale = [1.0, per_span, per_span * per_span];
        let (mut best, mut variance, mut samples) = ([f64::NAN; 3], [f64::NAN; 3], [0; 3]);
        let (mut low, mut high) = ([f64::NEG_INFINITY; 3], [f64::INFINITY; 3]);
        let mut meets = [true; 3];
        for number in 0..end {
            let length = grid.lengths[number];
            let basis = &mut grid.bases[number];
            if (length as f64) < SHORTEST * most as f64 || basis.count(length) < N {
                continue;
            }
            basis.place(grid.at);
            let products = basis.products(&self.moments[number][component]);
            let mut value = [0.0; 3];
            let fitted = products.iter().zip(&basis.per_norm).take(N);
            for ((product, per_norm), here) in fitted.zip(&basis.here) {
                let coefficient = product * per_norm;
                for (value, here) in value.iter_mut().zip(here) {
                    *value += coefficient * here;
                }
            }
            // One degree more, to estimate the truncation error of this one.
            let next = match basis.found > N {
                true => products[N] * basis.per_norm[N],
                false => 0.0,
            };
            for m in 0..3 {
                let s = sigma * scale[m] * basis.deviation[N - 1][m];
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
                let omitted = next * basis.here[N.min(TERMS - 1)][m] * scale[m];
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
