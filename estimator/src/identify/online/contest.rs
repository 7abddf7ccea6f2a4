//! Which parameters are in force: those that have predicted what came after them better than the
//! ones before.
//!
//! ```text
//! e_b = y_b - A_b d,   per channel and block of 0.1 s, less the line through them since the candidate entered
//! g_b = sum over channels of rho(e_b(in force) / s) - rho(e_b(candidate) / s),   rho(x) = min(x^2, BOUND^2), s their scale
//! ```
//!
//! A candidate is what was most probable when it entered, and it is judged by what came later. Both
//! sets have the same freedom: of each channel an offset, and a drift of it. The mean of `g` must
//! exceed its own standard error, autocorrelation included, by [`LEVEL`]. Some candidates are on
//! trial at a time, their ages about in geometric progression: a young one knows more, an old one
//! has been judged by more, and small gains take long to show.
//!
//! Of the change from those in force to a candidate that wins as much is made as its gain exceeds
//! its own standard error: the share of it that goes best with what came later, by least squares,
//! less one standard error. (What a model lacks comes back with the motion, so that all blocks of
//! [`CYCLE`] count as one.) What is left of the change is not known, and the covariance says so.
//!
//! Before anything is known the URDF's parameters are in force.

use crate::identify::noise::autocorrelation_time;

/// Length of a block \[s\].
pub(super) const BLOCK: f64 = 0.1;
/// How much motion a trial needs before it can be decided, and how much counts \[s\].
const LEAST: f64 = 4.0;
const MOST: f64 = 60.0;
/// How much motion lies between the entries of two candidates at least \[s\], and how many there
/// are at a time.
const APART: f64 = 1.0;
const TOGETHER: usize = 5;
/// In standard errors: of candidates that are no better one in thirty thousand looks does as well.
/// There are at most five looks in a second, most of them at what was looked at before.
const LEVEL: f64 = 4.0;
/// What lies farther off, in standard deviations, is no worse: pushes and outliers say nothing of
/// parameters.
const BOUND: f64 = 3.0;

/// How long a motion takes before it comes back \[s\].
const CYCLE: f64 = 4.0;
/// Rounds of robust fits.
const ROUNDS: usize = 5;

/// Who competes, `P` being parameters.
#[derive(Clone, Debug)]
pub(super) struct Contest<P> {
    channels: usize,
    /// When each block was \[s\].
    times: Vec<f64>,
    /// The oldest first, which is in force.
    entrants: Vec<Entrant<P>>,
}

/// Parameters, the first block after they entered, and what each channel has left of them in the
/// blocks since; NaN where it was not seen.
#[derive(Clone, Debug)]
struct Entrant<P> {
    parameters: P,
    first: usize,
    left: Vec<f64>,
}

impl<P> Contest<P> {
    /// Of so many channels, with nobody else.
    pub(super) fn new(channels: usize, in_force: P) -> Self {
        let mut contest = Self {
            channels,
            times: Vec::new(),
            entrants: Vec::new(),
        };
        contest.enthrone(in_force);
        contest
    }

    /// Puts these in force, come what may.
    pub(super) fn enthrone(&mut self, parameters: P) {
        self.times.clear();
        self.entrants = vec![Entrant {
            parameters,
            first: 0,
            left: Vec::new(),
        }];
    }

    /// Those in force.
    pub(super) fn in_force(&self) -> &P {
        &self.entrants[0].parameters
    }

    /// Everybody's, those in force first.
    pub(super) fn all(&self) -> impl Iterator<Item = &P> {
        self.entrants.iter().map(|entrant| &entrant.parameters)
    }

    /// Lets parameters compete, if the last have done so for long enough.
    pub(super) fn enter(&mut self, parameters: impl FnOnce() -> P) {
        let age = |entrant: &Entrant<P>| BLOCK * (self.times.len() - entrant.first) as f64;
        if self.entrants[1..].last().is_some_and(|last| age(last) < APART) {
            return;
        }
        if self.entrants.len() > TOGETHER {
            // The candidate goes whose neighbours in age are nearest to each other.
            let ages: Vec<f64> = self.entrants.iter().map(age).collect();
            let apart = |i: usize| ages[i - 1] / ages.get(i + 1).copied().unwrap_or(APART);
            let nearest = (2..ages.len()).min_by(|&a, &b| apart(a).total_cmp(&apart(b)));
            nearest.into_iter().for_each(|place| drop(self.entrants.remove(place)));
        }
        let first = self.times.len();
        self.entrants.push(Entrant {
            parameters: parameters(),
            first,
            left: Vec::new(),
        });
    }

    /// Takes a block in: what each channel has left of everybody's parameters, in the order of
    /// [`Contest::all`].
    pub(super) fn take<'a>(&mut self, t: f64, left: impl Iterator<Item = &'a [f64]>) {
        self.times.push(t);
        for (entrant, own) in self.entrants.iter_mut().zip(left) {
            entrant.left.extend_from_slice(own);
        }
    }

    /// Puts the youngest in force that has shown to be better, as far as it has, and lets go of
    /// whoever is older. `between` gives parameters so far from the first to the second.
    pub(super) fn decide(&mut self, between: impl FnOnce(&P, &P, f64) -> P) {
        let better = (1..self.entrants.len())
            .rev()
            .find_map(|place| Some((place, self.share(place)?)));
        if let Some((place, share)) = better {
            let old = self.entrants.drain(..place).next();
            if let (Some(old), Some(new)) = (old, self.entrants.first_mut()) {
                new.parameters = between(&old.parameters, &new.parameters, share);
                let before = &old.left[(new.first - old.first) * self.channels..];
                for (own, before) in new.left.iter_mut().zip(before) {
                    *own = before + share * (*own - before);
                }
            }
        }
        let is_old = |entrant: &Entrant<P>, end: usize| BLOCK * (end - entrant.first) as f64 > MOST;
        let (end, mut place) = (self.times.len(), 0);
        self.entrants.retain(|entrant| {
            place += 1;
            place == 1 || !is_old(entrant, end)
        });
        // What nobody is judged by is forgotten.
        let oldest = self.entrants.get(1).map_or(end, |entrant| entrant.first);
        self.times.drain(..oldest);
        for entrant in &mut self.entrants {
            let gone = oldest.saturating_sub(entrant.first);
            entrant.left.drain(..gone * self.channels);
            entrant.first = entrant.first.saturating_sub(oldest);
        }
    }

    /// If a candidate is better than those in force, by which share.
    fn share(&self, place: usize) -> Option<f64> {
        let candidate = &self.entrants[place];
        let times = &self.times[candidate.first..];
        if BLOCK * (times.len() as f64) < LEAST {
            return None;
        }
        let mut gain = vec![f64::NAN; times.len()];
        // Of each block and channel, what those in force leave and how much of that the candidate
        // changes, in units of what this leaves.
        let mut pairs = Vec::new();
        for channel in 0..self.channels {
            let [one, other] = [&self.entrants[0], candidate].map(|entrant| {
                let skipped = (candidate.first - entrant.first) * self.channels + channel;
                let own = entrant.left.iter().skip(skipped).step_by(self.channels);
                detrended(times, own.copied().collect())
            });
            let scale = scale(one.iter().chain(&other));
            if !(scale > 0.0 && scale.is_finite()) {
                continue;
            }
            let unit = self::scale(other.iter());
            let loss = |left: f64| (left / scale).clamp(-BOUND, BOUND).powi(2);
            for (block, (one, other)) in one.iter().zip(&other).enumerate() {
                let own = loss(*one) - loss(*other);
                if own.is_finite() {
                    gain[block] = if gain[block].is_nan() { own } else { gain[block] + own };
                    pairs.push((block, one / unit, (one - other) / unit));
                }
            }
        }
        let seen = || gain.iter().filter(|x| x.is_finite());
        let count = seen().count() as f64;
        let mean = seen().sum::<f64>() / count;
        gain.iter_mut().for_each(|x| *x -= mean);
        let (square, time) = autocorrelation_time(&[&gain]);
        if BLOCK * count < LEAST || mean <= LEVEL * (square * time / count).sqrt() {
            return None;
        }
        // Least squares by Huber's rule, from the whole of the change.
        let all: f64 = pairs.iter().map(|(_, _, change)| change * change).sum();
        let mut share = 1.0;
        let mut left = Vec::new();
        for _ in 0..ROUNDS {
            left = vec![0.0; times.len()];
            for (block, one, change) in &pairs {
                left[*block] += change * (one - share * change).clamp(-BOUND, BOUND);
            }
            share += left.iter().sum::<f64>() / all;
        }
        let (square, time) = autocorrelation_time(&[&left]);
        let time = time.max(CYCLE / BLOCK);
        let share = (share - (square * time * count).sqrt() / all).min(1.0);
        (share > 0.0).then_some(share)
    }
}

/// Standard deviation of numbers, by the median of their sizes; of those that are finite.
fn scale<'a>(values: impl Iterator<Item = &'a f64>) -> f64 {
    /// Of a normal distribution's deviations half are less.
    const MEDIAN: f64 = 0.6745;
    let mut sizes: Vec<f64> = values.filter(|x| x.is_finite()).map(|x| x.abs()).collect();
    if sizes.is_empty() {
        return f64::NAN;
    }
    let middle = sizes.len() / 2;
    *sizes.select_nth_unstable_by(middle, f64::total_cmp).1 / MEDIAN
}

/// Values less the line through them; what lies far off counts less, down to nothing (Tukey's
/// biweight).
fn detrended(times: &[f64], values: Vec<f64>) -> Vec<f64> {
    /// Beyond so many deviations nothing counts.
    const BEYOND: f64 = 5.0;
    let mut left = values;
    let mut weights = vec![1.0; left.len()];
    for _ in 0..ROUNDS {
        let seen = || {
            times
                .iter()
                .zip(&left)
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
        for (value, time) in left.iter_mut().zip(times) {
            *value -= x + slope * (time - t);
        }
        let beyond = BEYOND * scale(left.iter());
        for (weight, value) in weights.iter_mut().zip(&left) {
            let u = (value / beyond).abs().min(1.0);
            *weight = if beyond > 0.0 { (1.0 - u * u).powi(2) } else { 1.0 };
        }
    }
    left
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identify::normals;

    /// Two channels, blocks for so many seconds: noise of unit variance; what is left of parameters
    /// `p` has `p` times a motion besides, an offset and a drift.
    fn play(contest: &mut Contest<f64>, seconds: f64, seed: u64) {
        let count = (seconds / BLOCK) as usize;
        let noise: Vec<f64> = normals(seed, 2 * count).iter().map(|x| 0.2 * x).collect();
        for block in 0..count {
            let t = contest.times.last().copied().unwrap_or(0.0) + BLOCK;
            let left: Vec<[f64; 2]> = (contest.all())
                .map(|wrong| {
                    let of = |channel: usize| {
                        let motion = (1.7 * t + channel as f64).sin();
                        wrong * motion + noise[2 * block + channel] + 40.0 + 3.0 * t
                    };
                    [of(0), of(1)]
                })
                .collect();
            contest.take(t, left.iter().map(<[f64; 2]>::as_slice));
            contest.decide(|a, b, share| a + share * (b - a));
        }
    }

    #[test]
    fn the_better_comes_in_force_and_never_the_worse() {
        for seed in 0..20 {
            let mut contest = Contest::new(2, 2.0);
            contest.enter(|| 3.0);
            play(&mut contest, 20.0, seed);
            assert_eq!(*contest.in_force(), 2.0);
            contest.enter(|| 0.3);
            play(&mut contest, 20.0, seed + 100);
            let found = *contest.in_force();
            assert!((0.2..0.8).contains(&found), "seed {seed}: {found}");
        }
    }

    #[test]
    fn who_is_as_good_hardly_ever_comes_in_force() {
        let wins = (0..40).filter(|&seed| {
            let mut contest = Contest::new(2, 1.0);
            // As wrong the other way round.
            contest.enter(|| -1.0);
            play(&mut contest, 50.0, seed);
            *contest.in_force() < 0.0
        });
        assert!(wins.count() <= 2);
    }

    /// What acts for a while on both alike hides nothing.
    #[test]
    fn pushes_do_not_hide_who_is_better() {
        let mut contest = Contest::new(1, 2.0);
        contest.enter(|| 0.0);
        for (block, noise) in normals(4, 200).iter().enumerate() {
            let t = BLOCK * block as f64;
            let push = if (60..100).contains(&block) { 80.0 } else { 0.0 };
            let left: Vec<[f64; 1]> = (contest.all())
                .map(|wrong| [wrong * (1.7 * t).sin() + 0.2 * noise + push + 4.0])
                .collect();
            contest.take(t, left.iter().map(<[f64; 1]>::as_slice));
        }
        contest.decide(|a, b, share| a + share * (b - a));
        assert!(contest.in_force().abs() < 0.4, "{}", contest.in_force());
    }

    /// A candidate that goes twice as far as it should comes in force half the way.
    #[test]
    fn a_change_is_made_as_far_as_it_explains_something() {
        let mut contest = Contest::new(2, 2.0);
        contest.enter(|| -1.5);
        play(&mut contest, 30.0, 11);
        assert!((0.0..0.6).contains(contest.in_force()), "{}", contest.in_force());
    }

    #[test]
    fn it_takes_some_motion_and_the_younger_goes_before_the_older() {
        let mut contest = Contest::new(2, 9.0);
        contest.enter(|| 5.0);
        play(&mut contest, LEAST - 0.2, 1);
        assert_eq!(*contest.in_force(), 9.0);
        // Too soon after the other.
        let mut other = Contest::new(2, 9.0);
        other.enter(|| 5.0);
        other.enter(|| 1.0);
        assert_eq!(other.all().count(), 2);
        let mut both = Contest::new(2, 9.0);
        both.enter(|| 8.0);
        play(&mut both, 1.5, 2);
        both.enter(|| 0.0);
        play(&mut both, LEAST + 1.0, 3);
        assert!(*both.in_force() < 1.0 && both.all().count() == 1, "{}", both.in_force());
    }

    #[test]
    fn old_candidates_go_and_so_many_compete_at_a_time() {
        let mut contest = Contest::new(2, 1.0);
        for number in 0..200 {
            contest.enter(|| 1.0 + 1e-9 * f64::from(number));
            play(&mut contest, 1.0, number as u64);
            assert!(contest.all().count() <= TOGETHER + 1);
            assert!(contest.times.len() as f64 * BLOCK <= MOST + 2.0);
        }
        // What nobody was judged by is not kept.
        let most = contest.entrants.iter().map(|entrant| entrant.left.len()).max();
        assert!(most <= Some(2 * contest.times.len()));
    }
}
