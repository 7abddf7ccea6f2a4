//! The noise of a channel, from its residuals: autocorrelation time and random walk.
//!
//! Source of the random walk: the local level model, A. C. Harvey, "Forecasting, structural time
//! series models and the Kalman filter", 1989, chapter 2.

/// Mean square and integrated autocorrelation time of a residual: `1 + 2 sum rho_k`, in samples, at
/// least 1, summed until the window is six times the sum (Sokal 1997, "Monte Carlo methods in
/// statistical mechanics"). NaN marks a missing sample. Several segments are pooled without
/// correlation across them.
pub(crate) fn autocorrelation_time<S: AsRef<[f64]>>(segments: &[S]) -> (f64, f64) {
    const WINDOW: f64 = 6.0;
    let (mut square, mut count, mut longest) = (0.0, 0.0, 0);
    let segments = || segments.iter().map(AsRef::as_ref);
    for segment in segments() {
        longest = longest.max(segment.len());
        for value in segment.iter().filter(|value| value.is_finite()) {
            square += value * value;
            count += 1.0;
        }
    }
    if count == 0.0 || square == 0.0 {
        return (0.0, 1.0);
    }
    let variance = square / count;
    let mut time = 1.0;
    for lag in 1..longest {
        if lag as f64 > WINDOW * time {
            break;
        }
        let (mut sum, mut pairs) = (0.0, 0.0);
        for segment in segments().filter(|segment| segment.len() > lag) {
            for (x, y) in segment.iter().zip(&segment[lag..]) {
                let product = x * y;
                if product.is_finite() {
                    sum += product;
                    pairs += 1.0;
                }
            }
        }
        if pairs == 0.0 {
            break;
        }
        // Long lags have few pairs: the sum is not extrapolated to the whole.
        time += 2.0 * sum / count / variance;
    }
    (variance, time.max(1.0))
}

/// The filter of the local level model: a level that walks randomly, observed with noise.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LocalLevel {
    pub(crate) level: f64,
    pub(crate) variance: f64,
}

impl LocalLevel {
    /// After a first value with this noise variance, of a level of which nothing was known.
    pub(crate) fn first((level, variance): (f64, f64)) -> Self {
        Self { level, variance }
    }

    /// What a value with this noise variance is expected to differ by after a step with variance
    /// `walk`: the innovation, and its variance.
    pub(crate) fn innovation(&self, walk: f64, (value, noise): (f64, f64)) -> (f64, f64) {
        (value - self.level, self.variance + walk + noise)
    }

    /// Takes in a value with this noise variance after a step with variance `walk`. `weight` is the
    /// probability that the value is one of the level: with 0 nothing changes. Returns the gain.
    pub(crate) fn update(&mut self, walk: f64, (value, noise): (f64, f64), weight: f64) -> f64 {
        let (innovation, total) = self.innovation(walk, (value, noise));
        let gain = weight * (self.variance + walk) / total;
        self.level += gain * innovation;
        self.variance = (self.variance + weight * walk) * (1.0 - gain);
        gain
    }
}

/// A segment of a series in blocks of equal length: the mean of each, NaN where it has no sample.
pub(crate) type BlockMeans = Vec<f64>;

/// Random walk and white noise in a series of block means: the most likely variance of a step and
/// of the noise (exact likelihood of the local level model, diffuse start). The step variance is
/// zero unless it is significant. `bound`: the greatest step variance, relative to the noise
/// variance.
pub(crate) fn random_walk(segments: &[BlockMeans], bound: f64) -> (f64, f64) {
    let evaluate = |ratio: f64| -> (f64, f64) {
        let (mut logs, mut squares, mut count) = (0.0, 0.0, 0.0);
        for segment in segments {
            // Variances are in units of that of the noise.
            let mut state: Option<LocalLevel> = None;
            for &value in segment {
                if let Some(filter) = &mut state {
                    filter.variance += ratio;
                }
                if !value.is_finite() {
                    continue;
                }
                match &mut state {
                    None => state = Some(LocalLevel::first((value, 1.0))),
                    Some(filter) => {
                        let (innovation, total) = filter.innovation(0.0, (value, 1.0));
                        logs += total.ln();
                        squares += innovation * innovation / total;
                        count += 1.0;
                        // With noise of unit variance the gain is the variance.
                        filter.variance = filter.update(0.0, (value, 1.0), 1.0);
                    }
                }
            }
        }
        let variance = if count > 0.0 { squares / count } else { 0.0 };
        (
            -0.5 * (count * variance.max(f64::MIN_POSITIVE).ln() + logs),
            variance,
        )
    };
    let (still, noise) = evaluate(0.0);
    if noise == 0.0 {
        return (0.0, 0.0);
    }
    let (mut low, mut high) = (1e-8_f64.ln(), bound.ln());
    let golden = 0.5 * (5.0_f64.sqrt() - 1.0);
    let at = |x: f64| evaluate(x.exp()).0;
    let (mut a, mut b) = (high - golden * (high - low), low + golden * (high - low));
    let (mut fa, mut fb) = (at(a), at(b));
    for _ in 0..40 {
        if fa > fb {
            (high, b, fb) = (b, a, fa);
            a = high - golden * (high - low);
            fa = at(a);
        } else {
            (low, a, fa) = (a, b, fb);
            b = low + golden * (high - low);
            fb = at(b);
        }
    }
    let ratio = (0.5 * (low + high)).exp();
    let (best, variance) = evaluate(ratio);
    // Twice the gain is chi-square distributed with one degree of freedom: without steps it exceeds
    // 3.84 in one series of twenty.
    if 2.0 * (best - still) > 3.84 {
        (ratio * variance, variance)
    } else {
        (0.0, noise)
    }
}

/// The levels of a series of block means, given the variances of a step and of the noise: a Kalman
/// filter and a backward smoother.
pub(crate) fn levels(segment: &[f64], step: f64, noise: f64) -> Vec<f64> {
    let mut filtered: Vec<LocalLevel> = Vec::with_capacity(segment.len());
    let mut state: Option<LocalLevel> = None;
    for &value in segment {
        if let Some(filter) = &mut state {
            filter.variance += step;
        }
        if value.is_finite() {
            match &mut state {
                None => state = Some(LocalLevel::first((value, noise))),
                Some(filter) => _ = filter.update(0.0, (value, noise), 1.0),
            }
        }
        filtered.push(state.unwrap_or(LocalLevel::first((f64::NAN, f64::NAN))));
    }
    let mut out: Vec<f64> = filtered.iter().map(|filter| filter.level).collect();
    for k in (1..out.len()).rev() {
        let LocalLevel { level, variance: p } = filtered[k - 1];
        if level.is_finite() {
            out[k - 1] = level + p / (p + step) * (out[k] - level);
        } else {
            out[k - 1] = out[k];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    #[test]
    fn autocorrelation_time_is_that_of_an_autoregression() {
        for keep in [0.0, 0.5, 0.9, 0.97] {
            let mut x = 0.0;
            let series: Vec<f64> = normals(3, 40_000)
                .into_iter()
                .map(|e| {
                    x = keep * x + f64::sqrt(1.0 - keep * keep) * e;
                    x
                })
                .collect();
            let (square, time) = autocorrelation_time(&[&series[..15_000], &series[15_000..]]);
            let expected = (1.0 + keep) / (1.0 - keep);
            assert!((square - 1.0).abs() < 0.15, "{keep}: {square}");
            assert!(
                (time / expected - 1.0).abs() < 0.2,
                "{keep}: {time} {expected}"
            );
        }
        assert_eq!(autocorrelation_time(&[&[f64::NAN; 5]]), (0.0, 1.0));
    }

    #[test]
    fn a_random_walk_is_found_only_if_there_is_one() {
        let (steps, noise) = (normals(5, 3000), normals(6, 3000));
        let mut level = 7.0;
        let series: Vec<f64> = steps
            .iter()
            .zip(&noise)
            .map(|(s, n)| {
                level += 0.05 * s;
                level + 0.5 * n
            })
            .collect();
        let (step, variance) = random_walk(std::slice::from_ref(&series), 1.0);
        assert!((step.sqrt() / 0.05 - 1.0).abs() < 0.25, "{step}");
        assert!((variance.sqrt() / 0.5 - 1.0).abs() < 0.05, "{variance}");
        let (slow, rest) = random_walk(&[series], 1e-3);
        assert!(slow / rest < 1.001e-3, "the bound holds");
        let still: Vec<usize> = (0..40)
            .filter(|seed| random_walk(&[normals(100 + *seed as u64, 300)], 1.0).0 == 0.0)
            .collect();
        assert!(
            still.len() >= 35,
            "{} of 40 have a random walk without steps",
            40 - still.len()
        );
    }

    /// The smoother compared with least squares on all levels at once.
    #[test]
    fn levels_are_those_of_least_squares() {
        use nalgebra::{DMatrix, DVector};
        let mut series = normals(9, 30);
        series[4] = f64::NAN;
        series[29] = f64::NAN;
        let (step, noise) = (0.3_f64, 1.7_f64);
        let mut normal = DMatrix::<f64>::zeros(30, 30);
        let mut right = DVector::<f64>::zeros(30);
        for (i, value) in series.iter().enumerate() {
            if value.is_finite() {
                normal[(i, i)] += 1.0 / noise;
                right[i] += value / noise;
            }
            if i > 0 {
                normal[(i, i)] += 1.0 / step;
                normal[(i - 1, i - 1)] += 1.0 / step;
                normal[(i, i - 1)] -= 1.0 / step;
                normal[(i - 1, i)] -= 1.0 / step;
            }
        }
        let expected = normal.cholesky().expect("definite").solve(&right);
        for (got, expected) in levels(&series, step, noise).iter().zip(expected.iter()) {
            assert!((got - expected).abs() < 1e-12, "{got} {expected}");
        }
    }
}
