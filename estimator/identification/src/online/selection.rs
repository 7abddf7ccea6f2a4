//! Decides which parameters are in use: those that predict later readings better than the previous
//! ones.
//!
//! ```text
//! e_b    = y_b - A_b d                  per channel and block of 0.1 s, minus the line fitted to
//!                                       all blocks since the candidate entered
//! g_b    = sum over channels of rho(e_b(in use) / s) - rho(e_b(candidate) / s)
//! rho(x) = min(x^2, BOUND^2)            s: scale of both
//! ```
//!
//! A candidate is a most probable solution, judged by data after its entry. Both sets have the same
//! freedom: an offset and a drift per channel. The mean of `g` must exceed its standard error,
//! autocorrelation included, by [`LEVEL`]. Several candidates are on trial at a time, with ages
//! roughly in geometric progression: a young one contains more data, an old one was judged by more,
//! and small gains need long trials.
//!
//! A winning candidate is adopted in part: by the fraction of the change from the parameters in use
//! that fits later data best, by least squares, minus one standard error. (Model errors repeat with
//! the motion, so all blocks of [`CYCLE`] count as one.) The remainder of the change is uncertain,
//! and the covariance includes it.
//!
//! Initially the URDF's parameters are in use.

use crate::linear::noise::autocorrelation_time;
use crate::statistics::median;

/// Length of a block \[s\].
pub(crate) const BLOCK: f64 = 0.1;
/// Least motion before a decision, and the greatest that counts \[s\].
const MIN_MOTION: f64 = 4.0;
const MAX_MOTION: f64 = 60.0;
/// Least motion between the entries of two candidates \[s\], and the number of candidates at a
/// time.
const CANDIDATE_INTERVAL: f64 = 1.0;
const MAX_CANDIDATES: usize = 5;
/// In standard errors: a candidate that is no better exceeds it in one of thirty thousand tests.
/// There are at most five tests in a second, mostly of data tested before.
const LEVEL: f64 = 4.0;
/// Greatest loss, in standard deviations: pushes and outliers give no information about parameters.
const BOUND: f64 = 3.0;

/// Period after which a motion repeats \[s\].
const CYCLE: f64 = 4.0;
/// Iterations of robust fits.
const ROBUST_ITERATIONS: usize = 5;

/// The parameters in use and their candidates, of type `P`.
#[derive(Clone, Debug)]
pub(crate) struct ModelSelection<P> {
    channels: usize,
    /// Time of each block \[s\].
    times: Vec<f64>,
    /// The first is in use; then candidates, the oldest first.
    candidates: Vec<TrialParameters<P>>,
}

/// Parameters, the first block after their entry, and the residual of each channel in the blocks
/// since; NaN where the channel was not seen.
#[derive(Clone, Debug)]
struct TrialParameters<P> {
    parameters: P,
    first: usize,
    residuals: Vec<f64>,
}

impl<P> ModelSelection<P> {
    /// With this number of channels, and no candidate.
    pub(crate) fn new(channels: usize, in_use: P) -> Self {
        let mut selection = Self {
            channels,
            times: Vec::new(),
            candidates: Vec::new(),
        };
        selection.replace_all(in_use);
        selection
    }

    /// Puts parameters in use without a trial, and removes all candidates.
    pub(crate) fn replace_all(&mut self, parameters: P) {
        self.times.clear();
        self.candidates = vec![TrialParameters {
            parameters,
            first: 0,
            residuals: Vec::new(),
        }];
    }

    /// The parameters in use.
    pub(crate) fn in_use(&self) -> &P {
        &self.candidates[0].parameters
    }

    /// All parameters, those in use first.
    pub(crate) fn all(&self) -> impl Iterator<Item = &P> {
        self.candidates
            .iter()
            .map(|candidate| &candidate.parameters)
    }

    /// Adds a candidate, if the last one entered long enough ago.
    pub(crate) fn enter(&mut self, parameters: impl FnOnce() -> P) {
        let age =
            |candidate: &TrialParameters<P>| BLOCK * (self.times.len() - candidate.first) as f64;
        let last = self.candidates[1..].last();
        if last.is_some_and(|last| age(last) < CANDIDATE_INTERVAL) {
            return;
        }
        if self.candidates.len() > MAX_CANDIDATES {
            // Removes the candidate whose neighbours in age are nearest to each other.
            let ages: Vec<f64> = self.candidates.iter().map(age).collect();
            let apart =
                |i: usize| ages[i - 1] / ages.get(i + 1).copied().unwrap_or(CANDIDATE_INTERVAL);
            let nearest = (2..ages.len()).min_by(|&a, &b| apart(a).total_cmp(&apart(b)));
            if let Some(place) = nearest {
                self.candidates.remove(place);
            }
        }
        let first = self.times.len();
        self.candidates.push(TrialParameters {
            parameters: parameters(),
            first,
            residuals: Vec::new(),
        });
    }

    /// Takes in a block: the residual of each channel for all parameters, in the order of
    /// [`ModelSelection::all`].
    pub(crate) fn take<'a>(&mut self, t: f64, residuals: impl Iterator<Item = &'a [f64]>) {
        self.times.push(t);
        for (candidate, own) in self.candidates.iter_mut().zip(residuals) {
            candidate.residuals.extend_from_slice(own);
        }
    }

    /// Puts the youngest winning candidate in use, by its fraction, and removes older ones.
    /// `between` mixes two sets of parameters.
    pub(crate) fn decide(&mut self, between: impl FnOnce(&P, &P, f64) -> P) {
        let better = (1..self.candidates.len())
            .rev()
            .find_map(|place| Some((place, self.share(place)?)));
        if let Some((place, share)) = better {
            let old = self.candidates.drain(..place).next();
            if let (Some(old), Some(new)) = (old, self.candidates.first_mut()) {
                new.parameters = between(&old.parameters, &new.parameters, share);
                let before = &old.residuals[(new.first - old.first) * self.channels..];
                for (own, before) in new.residuals.iter_mut().zip(before) {
                    *own = before + share * (*own - before);
                }
            }
        }
        let is_old = |candidate: &TrialParameters<P>, end: usize| {
            BLOCK * (end - candidate.first) as f64 > MAX_MOTION
        };
        let (end, mut place) = (self.times.len(), 0);
        self.candidates.retain(|candidate| {
            place += 1;
            place == 1 || !is_old(candidate, end)
        });
        // Blocks before the oldest candidate are dropped.
        let oldest = self.candidates.get(1);
        let oldest = oldest.map_or(end, |candidate| candidate.first);
        self.times.drain(..oldest);
        for candidate in &mut self.candidates {
            let gone = oldest.saturating_sub(candidate.first);
            candidate.residuals.drain(..gone * self.channels);
            candidate.first = candidate.first.saturating_sub(oldest);
        }
    }

    /// The fraction of a candidate to adopt; None if it is not better than the parameters in use.
    fn share(&self, place: usize) -> Option<f64> {
        let candidate = &self.candidates[place];
        let times = &self.times[candidate.first..];
        if BLOCK * (times.len() as f64) < MIN_MOTION {
            return None;
        }
        let mut gain = vec![f64::NAN; times.len()];
        // Per block and channel: the residual of the parameters in use, and the change of it by the
        // candidate, in units of the candidate's residual.
        let mut pairs = Vec::new();
        for channel in 0..self.channels {
            let [one, other] = [&self.candidates[0], candidate].map(|either| {
                let skipped = (candidate.first - either.first) * self.channels + channel;
                let own = either.residuals.iter().skip(skipped).step_by(self.channels);
                detrended(times, own.copied().collect())
            });
            let scale = scale(one.iter().chain(&other));
            if !(scale > 0.0 && scale.is_finite()) {
                continue;
            }
            let unit = self::scale(other.iter());
            let loss = |residuals: f64| (residuals / scale).clamp(-BOUND, BOUND).powi(2);
            for (block, (one, other)) in one.iter().zip(&other).enumerate() {
                let own = loss(*one) - loss(*other);
                if own.is_finite() {
                    gain[block] = if gain[block].is_nan() {
                        own
                    } else {
                        gain[block] + own
                    };
                    pairs.push((block, one / unit, (one - other) / unit));
                }
            }
        }
        let seen = || gain.iter().filter(|x| x.is_finite());
        let count = seen().count() as f64;
        let mean = seen().sum::<f64>() / count;
        gain.iter_mut().for_each(|x| *x -= mean);
        let (square, time) = autocorrelation_time(&[&gain]);
        if BLOCK * count < MIN_MOTION || mean <= LEVEL * (square * time / count).sqrt() {
            return None;
        }
        // Least squares with Huber's rule, from the whole change.
        let all: f64 = pairs.iter().map(|(_, _, change)| change * change).sum();
        let mut share = 1.0;
        let mut residuals = Vec::new();
        for _ in 0..ROBUST_ITERATIONS {
            residuals = vec![0.0; times.len()];
            for (block, one, change) in &pairs {
                residuals[*block] += change * (one - share * change).clamp(-BOUND, BOUND);
            }
            share += residuals.iter().sum::<f64>() / all;
        }
        let (square, time) = autocorrelation_time(&[&residuals]);
        let time = time.max(CYCLE / BLOCK);
        let share = (share - (square * time * count).sqrt() / all).min(1.0);
        (share > 0.0).then_some(share)
    }
}

/// Robust standard deviation of the finite values, by the median of their magnitudes.
fn scale<'a>(values: impl Iterator<Item = &'a f64>) -> f64 {
    /// Half of the deviations of a normal distribution are less.
    const MEDIAN: f64 = 0.6745;
    let sizes: Vec<f64> = values.filter(|x| x.is_finite()).map(|x| x.abs()).collect();
    match sizes.is_empty() {
        true => f64::NAN,
        false => median(sizes) / MEDIAN,
    }
}

/// Values minus the line through them. Distant values get less weight, down to zero (Tukey's
/// biweight).
fn detrended(times: &[f64], values: Vec<f64>) -> Vec<f64> {
    /// Number of deviations beyond which the weight is zero.
    const BEYOND: f64 = 5.0;
    let mut residuals = values;
    let mut weights = vec![1.0; residuals.len()];
    for _ in 0..ROBUST_ITERATIONS {
        let seen = || {
            times
                .iter()
                .zip(&residuals)
                .zip(&weights)
                .filter(|((_, x), _)| x.is_finite())
        };
        let all: f64 = seen().map(|(_, weight)| weight).sum();
        let (t, x) = seen().fold((0.0, 0.0), |(a, b), ((t, x), weight)| {
            (a + weight * t / all, b + weight * x / all)
        });
        let (square, product) = seen().fold((0.0, 0.0), |(a, b), ((time, value), weight)| {
            (
                a + weight * (time - t) * (time - t),
                b + weight * (time - t) * (value - x),
            )
        });
        let slope = if square > 0.0 { product / square } else { 0.0 };
        for (value, time) in residuals.iter_mut().zip(times) {
            *value -= x + slope * (time - t);
        }
        let beyond = BEYOND * scale(residuals.iter());
        for (weight, value) in weights.iter_mut().zip(&residuals) {
            let u = (value / beyond).abs().min(1.0);
            *weight = if beyond > 0.0 {
                (1.0 - u * u).powi(2)
            } else {
                1.0
            };
        }
    }
    residuals
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    /// Two channels, blocks for some seconds: noise of unit variance. The residual of parameters
    /// `p` also has `p` times a motion, an offset and a drift.
    fn play(selection: &mut ModelSelection<f64>, seconds: f64, seed: u64) {
        let count = (seconds / BLOCK) as usize;
        let noise: Vec<f64> = normals(seed, 2 * count).iter().map(|x| 0.2 * x).collect();
        for block in 0..count {
            let t = selection.times.last().copied().unwrap_or(0.0) + BLOCK;
            let residuals: Vec<[f64; 2]> = (selection.all())
                .map(|wrong| {
                    let reading = |channel: usize| {
                        let motion = (1.7 * t + channel as f64).sin();
                        wrong * motion + noise[2 * block + channel] + 40.0 + 3.0 * t
                    };
                    [reading(0), reading(1)]
                })
                .collect();
            selection.take(t, residuals.iter().map(<[f64; 2]>::as_slice));
            selection.decide(|a, b, share| a + share * (b - a));
        }
    }

    #[test]
    fn the_better_is_adopted_and_never_the_worse() {
        for seed in 0..20 {
            let mut selection = ModelSelection::new(2, 2.0);
            selection.enter(|| 3.0);
            play(&mut selection, 20.0, seed);
            assert_eq!(*selection.in_use(), 2.0);
            selection.enter(|| 0.3);
            play(&mut selection, 20.0, seed + 100);
            let found = *selection.in_use();
            assert!((0.2..0.8).contains(&found), "seed {seed}: {found}");
        }
    }

    #[test]
    fn an_equal_candidate_is_hardly_ever_adopted() {
        let wins = (0..40).filter(|&seed| {
            let mut selection = ModelSelection::new(2, 1.0);
            // An equal error of opposite sign.
            selection.enter(|| -1.0);
            play(&mut selection, 50.0, seed);
            *selection.in_use() < 0.0
        });
        assert!(wins.count() <= 2);
    }

    /// A disturbance that acts on both alike does not prevent the decision.
    #[test]
    fn disturbances_do_not_prevent_the_decision() {
        let mut selection = ModelSelection::new(1, 2.0);
        selection.enter(|| 0.0);
        for (block, noise) in normals(4, 200).iter().enumerate() {
            let t = BLOCK * block as f64;
            let push = if (60..100).contains(&block) {
                80.0
            } else {
                0.0
            };
            let residuals: Vec<[f64; 1]> = (selection.all())
                .map(|wrong| [wrong * (1.7 * t).sin() + 0.2 * noise + push + 4.0])
                .collect();
            selection.take(t, residuals.iter().map(<[f64; 1]>::as_slice));
        }
        selection.decide(|a, b, share| a + share * (b - a));
        assert!(selection.in_use().abs() < 0.4, "{}", selection.in_use());
    }

    /// A candidate that changes twice too much is adopted by half.
    #[test]
    fn a_change_is_adopted_as_far_as_it_explains_something() {
        let mut selection = ModelSelection::new(2, 2.0);
        selection.enter(|| -1.5);
        play(&mut selection, 30.0, 11);
        assert!(
            (0.0..0.6).contains(selection.in_use()),
            "{}",
            selection.in_use()
        );
    }

    #[test]
    fn a_decision_needs_motion_and_the_younger_candidate_wins() {
        let mut selection = ModelSelection::new(2, 9.0);
        selection.enter(|| 5.0);
        play(&mut selection, MIN_MOTION - 0.2, 1);
        assert_eq!(*selection.in_use(), 9.0);
        // Too soon after the other.
        let mut other = ModelSelection::new(2, 9.0);
        other.enter(|| 5.0);
        other.enter(|| 1.0);
        assert_eq!(other.all().count(), 2);
        let mut both = ModelSelection::new(2, 9.0);
        both.enter(|| 8.0);
        play(&mut both, 1.5, 2);
        both.enter(|| 0.0);
        play(&mut both, MIN_MOTION + 1.0, 3);
        assert!(
            *both.in_use() < 1.0 && both.all().count() == 1,
            "{}",
            both.in_use()
        );
    }

    #[test]
    fn old_candidates_are_removed_and_their_number_is_limited() {
        let mut selection = ModelSelection::new(2, 1.0);
        for number in 0..200 {
            selection.enter(|| 1.0 + 1e-9 * f64::from(number));
            play(&mut selection, 1.0, number as u64);
            assert!(selection.all().count() <= MAX_CANDIDATES + 1);
            assert!(selection.times.len() as f64 * BLOCK <= MAX_MOTION + 2.0);
        }
        // Blocks that judge no candidate are dropped.
        let most = selection
            .candidates
            .iter()
            .map(|candidate| candidate.residuals.len())
            .max();
        assert!(most <= Some(2 * selection.times.len()));
    }
}
