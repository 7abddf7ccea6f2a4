//! Derivatives in the middle of a window of samples, for identification, which may wait for later
//! samples.

use crate::history::History;
use proprio_topics::{Nanos, Quality, Reason};
use pulp::{Arch, Simd, WithSimd};

/// How far an identification instant lies before its estimate, and the half width of the window of
/// samples that it is differentiated from.
pub(super) const DELAY: Nanos = Nanos::from_millis(250);

/// Largest number of points that a polynomial is fitted to: more samples are averaged in groups of
/// neighbours.
pub(crate) const POINTS: usize = 80;

/// The window at rest: its half width as a share of [`DELAY`], and the polynomial's degree.
pub(crate) const REST_WINDOW: (f64, usize) = (1.0, 2);

/// The windows in motion, narrowest first.
pub(crate) const WINDOWS: [(f64, usize); 3] = [(0.32, 4), (0.6, 4), (1.0, 4)];

/// Least-squares polynomials about an instant, on the stamps of the samples, in polynomials
/// orthogonal over these stamps (Forsythe 1957): value and two derivatives.
///
/// At rest a parabola over the whole window is used, because its derivatives have little noise: it
/// is taken where its residual variance does not exceed that of a quartic over a narrower window.
///
/// In motion a quartic is used. Over a window of `+-h` its relative error for a sine of angular
/// frequency `w` grows with the fourth power of `w h`. This is a bias `b`, proportional to the
/// derivative `s` itself, and gives the parameters a relative error `b / s`. Noise of variance `n`
/// in the derivative is motion without a force (errors in variables) and gives them a relative
/// error `n / s^2`. So the wider window is taken where `b s` plus its own noise variance is less
/// than the noise variance of the narrower one. `b` is the difference between the two windows
/// beyond their noise, as the root mean square of the last second ([`SignalStatistics`]). Where the
/// noise of the samples is not known, the narrowest window is taken.
///
/// What depends on the stamps alone is kept for the next channel with equal stamps.
pub(super) struct Centred {
    count: usize,
    /// Number of samples in each point's mean.
    share: usize,
    points: usize,
    times: [f64; POINTS],
    signals: [[f64; POINTS]; 9],
    /// The number of signals.
    width: usize,
    /// At rest, then in motion.
    bases: [Basis; 1 + WINDOWS.len()],
}

/// The polynomials of one window.
#[derive(Clone, Copy)]
struct Basis {
    /// The first point and their number, which is zero if there are too few.
    first: usize,
    points: usize,
    degree: usize,
    /// Of each point, padded to whole vectors.
    values: [[f64; 8]; POINTS],
    norms: [f64; 5],
    /// Value and two derivatives of each at the instant.
    at: [[f64; 3]; 5],
}

impl Default for Centred {
    fn default() -> Self {
        let basis = Basis {
            first: 0,
            points: 0,
            degree: 0,
            values: [[0.0; 8]; POINTS],
            norms: [0.0; 5],
            at: [[0.0; 3]; 5],
        };
        Self {
            count: 0,
            share: 1,
            points: 0,
            times: [0.0; POINTS],
            signals: [[0.0; POINTS]; 9],
            width: 0,
            bases: [basis; 1 + WINDOWS.len()],
        }
    }
}

/// A value or derivative of a signal, and its standard error.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Estimated {
    pub(crate) value: f64,
    pub(crate) error: f64,
}

/// Fewest samples for a derivative.
pub(crate) const MIN_SAMPLES: usize = 5;

/// Fewest samples beyond the number of a polynomial's coefficients, for its residual variance to
/// show the noise.
pub(crate) const MIN_FREEDOM: usize = 10;

/// Weight of one instant at rest in the exponential mean of the samples' noise.
pub(crate) const REST_WEIGHT: f64 = 0.05;

/// Weight of one instant in the exponential means that the window is chosen by.
pub(crate) const MOVING_WEIGHT: f64 = 0.01;

/// Running statistics of one signal.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SignalStatistics {
    /// Variance of its samples at rest; NaN before any instant at rest.
    pub(crate) rest_variance: f64,
    /// Mean square of the derivative: an exponential mean ([`MOVING_WEIGHT`]).
    pub(crate) derivative_square: f64,
    /// Mean square of the difference between neighbouring windows, less the noise of that
    /// difference: an exponential mean.
    pub(crate) bias_square: [f64; WINDOWS.len() - 1],
}

impl Default for SignalStatistics {
    fn default() -> Self {
        Self {
            rest_variance: f64::NAN,
            derivative_square: f64::NAN,
            bias_square: [f64::NAN; WINDOWS.len() - 1],
        }
    }
}

impl SignalStatistics {
    /// Of the quartics of growing windows, the one whose derivative of this order gives the
    /// smallest parameter error; `sigma` is the standard deviation of the samples.
    pub(crate) fn choose(
        &mut self,
        fits: [Option<Fit>; WINDOWS.len()],
        (sigma, order): (f64, usize),
    ) -> Option<Fit> {
        let update_mean = |mean: &mut f64, value: f64| {
            *mean = if mean.is_nan() {
                value
            } else {
                *mean + MOVING_WEIGHT * (value - *mean)
            }
        };
        let mut chosen: Option<Fit> = None;
        let mut noise = f64::NAN;
        for (number, fit) in fits.into_iter().enumerate() {
            let Some(fit) = fit else { continue };
            let (Some(value), Some(error)) = (fit.at.get(order), fit.errors.get(order)) else {
                continue;
            };
            let own = (sigma * error).powi(2);
            let Some(narrower) = chosen else {
                update_mean(&mut self.derivative_square, value * value);
                (chosen, noise) = (Some(fit), own);
                continue;
            };
            let Some(bias_square) = number
                .checked_sub(1)
                .and_then(|place| self.bias_square.get_mut(place))
            else {
                continue;
            };
            // The windows share samples: the noise of the difference is the difference of the
            // variances.
            update_mean(
                bias_square,
                (value - narrower.at.get(order).unwrap_or(value)).powi(2) - (noise - own).max(0.0),
            );
            let is_better =
                bias_square.max(0.0).sqrt() * self.derivative_square.sqrt() + own < noise;
            if !is_better {
                break;
            }
            (chosen, noise) = (Some(fit), own);
        }
        chosen
    }
}

impl Centred {
    /// Averages the samples of a channel between two instants to at most [`POINTS`] points, with
    /// times relative to the middle in units of [`DELAY`].
    ///
    /// # Errors
    /// Why they cannot be differentiated.
    #[allow(
        clippy::indexing_slicing,
        reason = "there are at most POINTS groups, and nine signals"
    )]
    pub(crate) fn gather<const D: usize>(
        &mut self,
        history: &History<D>,
        from: Nanos,
        to: Nanos,
        max_silence: Nanos,
        untrusted: Quality,
    ) -> Result<(), Reason> {
        let mut samples = history.within(from, to);
        (self.count, self.width) = (samples.len(), D);
        self.share = self.count.div_ceil(POINTS).max(1);
        let centre = from + Nanos((to - from).0 / 2);
        let mut quality = Quality::GOOD;
        let mut newest = to;
        let mut gap = Nanos::ZERO;
        let (mut points, mut is_same) = (0, true);
        while samples.len() > 0 {
            let (mut time, mut sums, mut count) = (0.0, [0.0; D], 0.0);
            for (t, value, q) in samples.by_ref().take(self.share) {
                gap = gap.max(newest - t);
                newest = t;
                quality |= q;
                time += (t - centre).seconds();
                for (sum, x) in sums.iter_mut().zip(value) {
                    *sum += x;
                }
                count += 1.0;
            }
            let share = 1.0 / count;
            let time = time * share / DELAY.seconds();
            is_same &= self.times[points] == time;
            self.times[points] = time;
            for (signal, sum) in self.signals.iter_mut().zip(sums) {
                signal[points] = sum * share;
            }
            points += 1;
        }
        gap = gap.max(newest - from);
        if !is_same || points != self.points {
            self.points = points;
            let windows = [REST_WINDOW].into_iter().chain(WINDOWS);
            for (basis, (reach, degree)) in self.bases.iter_mut().zip(windows) {
                basis.compute(&self.times[..points], reach, degree);
            }
        }
        match Reason::of_quality(quality, untrusted) {
            Reason::None if history.newest().is_none() => Err(Reason::NeverSeen),
            Reason::None if self.count < MIN_SAMPLES => Err(Reason::Starting),
            // Samples must reach both ends, without a gap between.
            Reason::None if gap > max_silence || gap.0 > (to - from).0 / 3 => Err(Reason::Stale),
            Reason::None => Ok(()),
            reason => Err(reason),
        }
    }

    /// Whether every sample has this signal.
    pub(crate) fn is_complete(&self, number: usize) -> bool {
        let signal = self.signals.get(number).filter(|_| number < self.width);
        let signal = signal.and_then(|signal| signal.get(..self.points));
        signal.is_some_and(|signal| !signal.is_empty() && signal.iter().all(|x| x.is_finite()))
    }

    /// A signal in the middle: value, first and second derivative, each with its standard error.
    ///
    /// `statistics` are those of the signal. Two arguments select the window: the standard
    /// deviation of the samples, NaN if it is not known, and the order of the derivative that
    /// matters. The standard errors use the noise at rest, because in motion a polynomial's
    /// residual is not noise alone. They are zero before the first instant at rest.
    pub(crate) fn fit(
        &self,
        number: usize,
        statistics: &mut SignalStatistics,
        sample_std: f64,
        order: usize,
    ) -> [Estimated; 3] {
        const NONE: Estimated = Estimated {
            value: f64::NAN,
            error: 0.0,
        };
        if self.count < MIN_SAMPLES || number >= self.signals.len() {
            return [NONE; 3];
        }
        let sigma = sample_std / (self.share as f64).sqrt();
        let signal = &self.signals[number];
        let [rest, short, middle, wide] = Arch::new().dispatch(Fits {
            bases: &self.bases,
            signal,
        });
        // A fit with few degrees of freedom can seem exact by chance.
        let middle = middle.filter(|fit| fit.points > WINDOWS[1].1 + MIN_FREEDOM);
        let short = short.filter(|fit| fit.points > WINDOWS[0].1 + 3);
        let is_quiet = match (&rest, &middle) {
            // Up to two standard deviations of the middle window's variance more.
            (Some(rest), Some(middle)) => {
                rest.variance <= middle.variance * (1.0 + 2.0 * (2.0 / middle.freedom).sqrt())
            }
            _ => false,
        };
        let moving = statistics.choose(
            [short, middle, wide.filter(|_| short.is_some())],
            (sigma, order),
        );
        let chosen = if is_quiet { rest } else { moving.or(rest) };
        if let (true, Some(rest)) = (is_quiet, &rest) {
            let mean = &mut statistics.rest_variance;
            *mean = match mean.is_nan() {
                true => rest.variance,
                false => *mean + REST_WEIGHT * (rest.variance - *mean),
            };
        }
        let point_std = statistics.rest_variance.max(0.0).sqrt();
        chosen.map_or([NONE; 3], |fit| {
            std::array::from_fn(|i| Estimated {
                value: fit.at[i],
                error: fit.errors[i] * point_std,
            })
        })
    }

    /// Standard deviation of a signal's samples as found at rest, updated with these;
    /// `statistics` as for [`Centred::fit`].
    pub(crate) fn sample_std(&self, number: usize, statistics: &mut SignalStatistics) -> f64 {
        self.fit(number, statistics, f64::NAN, 0);
        // The polynomial was fitted to means of this many samples.
        (statistics.rest_variance.max(0.0) * self.share as f64).sqrt()
    }
}

impl Basis {
    /// The polynomials up to this degree on the points within `reach` of the instant.
    #[allow(clippy::indexing_slicing, reason = "as many points as were averaged")]
    fn compute(&mut self, times: &[f64], reach: f64, degree: usize) {
        (self.points, self.degree) = (0, degree);
        // Newest first.
        let first = times.iter().position(|u| *u <= reach);
        let last = times.iter().rposition(|u| *u >= -reach);
        let (Some(first), Some(last)) = (first, last) else {
            return;
        };
        if last < first + degree {
            return;
        }
        self.first = first;
        let times = &times[first..=last];
        let n = times.len();
        let (mut current, mut previous) = ([1.0; POINTS], [0.0; POINTS]);
        // The orthogonal polynomials of this degree and of the one below, each with its first two
        // derivatives, at the instant.
        let (mut at, mut below) = ([1.0, 0.0, 0.0], [0.0; 3]);
        let mut norm_below = 1.0;
        for k in 0..=degree {
            let (mut norm, mut moment) = (0.0, 0.0);
            for ((p, u), values) in current.iter().zip(times).zip(&mut self.values) {
                values[k] = *p;
                norm += p * p;
                moment += u * p * p;
            }
            if norm < 1e-14 * n as f64 {
                return;
            }
            (self.norms[k], self.at[k]) = (norm, at);
            let (a, b) = (moment / norm, if k == 0 { 0.0 } else { norm / norm_below });
            for ((p, old), u) in current.iter_mut().zip(&mut previous).zip(times) {
                let next = (u - a) * *p - b * *old;
                *old = std::mem::replace(p, next);
            }
            let next = [
                -a * at[0] - b * below[0],
                at[0] - a * at[1] - b * below[1],
                2.0 * at[1] - a * at[2] - b * below[2],
            ];
            below = std::mem::replace(&mut at, next);
            norm_below = norm;
        }
        self.points = n;
    }

    /// The least-squares polynomial of a signal.
    #[inline(always)]
    #[allow(clippy::indexing_slicing, reason = "as many points as were averaged")]
    fn fit(&self, signal: &[f64; POINTS]) -> Option<Fit> {
        let (n, signal) = (self.points, &signal[self.first..]);
        let level = signal.first().filter(|_| n > 0)?;
        let (mut products, mut left) = ([0.0; 8], 0.0);
        for (x, values) in signal[..n].iter().zip(&self.values) {
            let x = x - level;
            left += x * x;
            for k in 0..8 {
                products[k] += x * values[k];
            }
        }
        let (mut result, mut squares) = ([0.0; 3], [0.0; 3]);
        let fitted = products.iter().zip(&self.norms).take(self.degree + 1);
        for ((product, norm), at) in fitted.zip(&self.at) {
            left -= product * product / norm;
            for ((result, square), value) in result.iter_mut().zip(&mut squares).zip(at) {
                *result += product / norm * value;
                *square += value * value / norm;
            }
        }
        let scale = DELAY.seconds();
        let freedom = (n - self.degree - 1) as f64;
        Some(Fit {
            at: [
                result[0] + level,
                result[1] / scale,
                result[2] / (scale * scale),
            ],
            errors: [
                squares[0].sqrt(),
                squares[1].sqrt() / scale,
                squares[2].sqrt() / (scale * scale),
            ],
            // At least the rounding error, even if the fit is exact.
            variance: left.max(1e-20 * n as f64) / freedom.max(1.0),
            freedom: freedom.max(1.0),
            points: n,
        })
    }
}

/// The polynomials of all windows for a signal.
struct Fits<'a> {
    bases: &'a [Basis; 1 + WINDOWS.len()],
    signal: &'a [f64; POINTS],
}

impl WithSimd for Fits<'_> {
    type Output = [Option<Fit>; 1 + WINDOWS.len()];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        let [rest, short, middle, wide] = self.bases;
        [
            rest.fit(self.signal),
            short.fit(self.signal),
            middle.fit(self.signal),
            wide.fit(self.signal),
        ]
    }
}

/// A polynomial and its derivatives at the instant, and its residual variance.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fit {
    pub(crate) at: [f64; 3],
    /// Standard errors for points of unit variance.
    pub(crate) errors: [f64; 3],
    pub(crate) variance: f64,
    pub(crate) freedom: f64,
    pub(crate) points: usize,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One untrusted sample anywhere in the window is enough: a fit uses all of them.
    #[test]
    fn the_quality_of_every_sample_in_the_window_counts() {
        let untrusted = Quality::SATURATED | Quality::DEVICE_FAULT;
        let count = 20;
        let stamp = |k: usize| Nanos::from_millis(10 * i64::try_from(k).unwrap());
        let gathered = |qualities: &dyn Fn(usize) -> Quality| {
            let mut history = History::<1>::default();
            for k in 0..count {
                history.push(stamp(k), [k as f64], qualities(k));
            }
            let silence = Nanos::from_millis(30);
            Centred::default().gather(&history, stamp(2), stamp(17), silence, untrusted)
        };
        assert_eq!(gathered(&|_| Quality::GOOD), Ok(()));
        for bad in 0..count {
            let quality = |k: usize| {
                if k == bad {
                    Quality::SATURATED
                } else {
                    Quality::GOOD
                }
            };
            let expected = if (2..=17).contains(&bad) {
                Err(Reason::Saturated)
            } else {
                Ok(())
            };
            assert_eq!(gathered(&quality), expected, "sample {bad}");
        }
    }
}
