//! Position, velocity and acceleration at any instant from noisy, quantised, irregularly stamped samples.
//!
//! A [`Window`] keeps the last samples of one channel, `D` numbers each (1 for a joint, 3 for a gyroscope), and
//! evaluates the signal and its first two derivatives at any instant inside the window or shortly beyond it.
//! It depends on the samples and the instant alone, allocates nothing, and reads no clock.
//!
//! # Method
//!
//! Least-squares polynomials on windows that end at the newest sample used, evaluated at the instant asked for: at the
//! end of a window it is lag, not noise, that dominates, and a polynomial evaluated where it is needed has none of the
//! lag of one evaluated at its middle. Written on polynomials orthogonal over the window's own stamps (Forsythe's
//! recurrence), so that irregular stamps are as well conditioned as regular ones and one pass serves every degree:
//!
//! ```text
//! p_0 = 1,  p_{k+1}(u) = (u - a_k) p_k(u) - b_k p_{k-1}(u),   u = (time - newest) / span of the window
//! a_k = <u p_k, p_k> / <p_k, p_k>,   b_k = <p_k, p_k> / <p_{k-1}, p_{k-1}>
//! estimate of derivative m by degree d:   e   = sum_{k <= d} <x, p_k> / <p_k, p_k>  p_k^(m)(u) / span^m
//! its standard deviation from noise:      s^2 = sigma^2 sum_{k <= d} p_k^(m)(u)^2 / <p_k, p_k> / span^2m
//! ```
//!
//! with sigma = noise / sqrt 3, for an error spread evenly over +-noise. The noise is what the channel was said to have, or what its samples show, if that is more: the
//! root mean square of their divided differences over five neighbours, which no smooth motion has, in units in which it is a sample's ([`Window::noise`]). Stamps that are late at random make
//! as much noise as the signal changes meanwhile.
//!
//! How long the window is, is decided in three steps, for each of the `D` numbers by itself:
//!
//! 1. **Growth** (adaptive windowing: Janabi-Sharifi, Hayward, Chen, "Discrete-time adaptive windowing for velocity
//!    estimation", IEEE Trans. Control Systems Technology 8(6), 2000; there for lines). For each degree 2, 3, 4: the
//!    longest window whose samples all lie within `3 noise` of its polynomial. Three, because the best fit is not the
//!    one with the least maximum: at 1 x and 2 x noise a single tick of an encoder at rest cuts the window to a few
//!    samples, which is where spikes of thousands of deg/s^2 come from.
//! 2. **Degree**: a cubic only if its window spans 1.6 times the quadratic's, a quartic only if 1.4 times that of the
//!    better of the two: only then does it earn the noise that it adds. At rest the quadratic is already as long as
//!    can be, and stays.
//! 3. **Trim**, for each derivative by itself: a window as long as growth allows is bias-dominated (its acceleration is
//!    that of its middle, so to speak). Among windows from 0.4 of that length up, in growing order, the longest
//!    whose confidence interval `e +- kappa s` still meets those of all shorter ones (intersection of confidence
//!    intervals: Goldenshluger, Nemirovski, "On spatially adaptive estimation of nonparametric regression", Math.
//!    Methods of Statistics 6, 1997). kappa = 1, 1.5, 2 for value, velocity, acceleration.
//!
//! Windows grow in steps of a third.
//!
//! # Where the speed comes from
//! - Sums over samples are made once, of `v^k` and `x v^k`, `v` the time before the newest sample in units of the whole span, and read off at the end of every window. A window's
//!   recurrence follows from its sums by Chebyshev's algorithm (Gautschi, "Orthogonal Polynomials: Computation and Approximation", Oxford 2004, sect. 2.1.7), at a cost that
//!   does not depend on its length. With degrees up to five and the newest sample as the origin that loses five digits of sixteen, for any window: what is left is some 1e-10 of the
//!   signal's range within the window, far below any noise that a sensor has.
//! - Residuals of samples that have been looked at change, from one window to the next, by the difference of two polynomials, which a few of its values bound. Only where old bound and
//!   change together exceed the tolerance are samples looked at again.
//! - A degree whose windows can not be long enough to be chosen is not tried, and nothing is computed of a window that is not used.
//! - What follows from stamps alone, sums and recurrence and the polynomials at the instant, is shared by channels with the same stamps ([`Grid`]).
//!
//! # Measured
//!
//! RMS errors at the newest sample, windows of 128 samples, `noise` half a quantum (`tests/differentiate.rs`; "plain" is
//! step 1 alone for the quadratic, evaluated at the same place, tolerance 2 x noise):
//!
//! | signal | velocity \[deg/s\] | acceleration \[deg/s^2\] | plain |
//! |---|---|---|---|
//! | sine 20 deg, 0.5 Hz at 100 Hz, quantum 0.055 deg | 0.61 | 14.5 | 2.2, 49 |
//! | the same, stamps 5 to 17 ms apart | 0.65 | 15.2 | 2.2, 48 |
//! | the same, 0.3 quanta of noise added, not declared | 0.64 | 15.8 | 1.9, 74 |
//! | at rest, 0.3 quanta of noise added | 0.05, worst 0.33 | 0.15, worst 1.2 | 0.63, 30, worst 825 |
//! | seven joints, quantum 0.000055 deg, 250 Hz | 0.0066 | 1.35 | 0.035, 15 |
//! | seven joints, quantum 0.000055 deg, 1 kHz | 0.0050 | 1.10 | 0.041, 16 |
//!
//! Windows of 64 samples: 0.71 and 17.3 in the first row, 1.6 deg/s^2 in the last. The standard deviations given cover the error
//! within two of them 77 to 100 % of the time. They cannot know of a motion that has just begun and is still within the
//! tolerance: in the first few samples of an onset the error of the acceleration is the acceleration itself.

use proprio_topics::Nanos;

/// The most samples a [`Window`] can hold.
pub const MAX_SAMPLES: usize = 128;

/// Fewest samples that give an estimate: a second derivative needs three.
pub const MIN_SAMPLES: usize = 3;

/// The degrees fitted: [`FIRST_DEGREE`] and up.
const FITTED: usize = 3;
const FIRST_DEGREE: usize = 2;
/// How far, in units of the noise bound, a sample may lie from the polynomial (step 1).
const TOLERANCE: f64 = 3.0;
/// How much longer than a lower degree's the window of a cubic, a quartic must be (step 2).
const STRETCH: [f64; FITTED] = [0.0, 1.6, 1.4];
/// The shortest window considered, as a share of the longest that fits (step 3).
const SHARE: f64 = 0.4;
/// Width of the confidence intervals of value, first and second derivative (step 3) \[standard deviations\].
const KAPPA: [f64; 3] = [1.0, 1.5, 2.0];
/// Samples whose difference tells the noise.
const ROUGH: usize = 5;
/// Windows tried: 3, 4, 5, 6, then a third longer each time; 15 of them reach 128 samples.
const CANDIDATES: usize = 16;
/// Polynomials of a basis: the degrees fitted, those below, and one more for what they leave out.
const TERMS: usize = FIRST_DEGREE + FITTED + 1;
/// Sums of powers that their norms take.
const MOMENTS: usize = 2 * TERMS - 1;
/// Squared norm of an orthogonal polynomial, in units of its leading power's, below which rounding is most of it. Even stamps: 0.03 to 1e-5.
const DEGENERATE: f64 = 1e-12;

/// What a [`Window`] is told about its channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Peak error of a sample, in its own unit: half the least significant bit, plus the peak of any other noise.
    pub noise: f64,
    /// Samples that an estimate uses at the most, 3 to [`MAX_SAMPLES`]. Fewer than [`MAX_SAMPLES`] leave room for samples that
    /// come while an earlier instant is still waiting: its estimate is then the same, early or late.
    pub capacity: usize,
    /// Samples older than this, seen from the newest one used, are left out.
    pub max_window: Nanos,
    /// Samples further apart than this are not joined: the window starts anew. Also how far beyond the newest sample
    /// an estimate may lie.
    pub max_gap: Nanos,
}

impl Settings {
    /// Settings that suit most channels: [`MAX_SAMPLES`] samples, at most one second, gaps up to 100 ms.
    ///
    /// `noise` as in [`Settings::noise`].
    #[must_use]
    pub const fn new(noise: f64) -> Self {
        Self {
            noise,
            capacity: MAX_SAMPLES,
            max_window: Nanos::from_millis(1000),
            max_gap: Nanos::from_millis(100),
        }
    }
}

/// Why [`Settings`] were refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SettingsError {
    /// The noise bound must be a positive number.
    #[error("noise bound {0} is not a positive number")]
    Noise(f64),
    /// The capacity is out of range.
    #[error("capacity {0} is not within {MIN_SAMPLES} to {MAX_SAMPLES} samples")]
    Capacity(usize),
    /// `max_window` or `max_gap` is not positive.
    #[error("duration {0} s is not positive")]
    Duration(Nanos),
}

/// What [`Window::push`] did with a sample that it took.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pushed {
    /// Added to the window.
    Added,
    /// Added; it does not join the samples before it, which ended longer ago than `max_gap`.
    Restarted {
        /// Time since the sample before.
        gap: Nanos,
    },
}

/// Why [`Window::push`] refused a sample; the window is as before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Refused {
    /// Stamps must increase strictly.
    #[error("sample stamped {got} s is not later than the one before, {newest} s")]
    NotLater {
        /// Stamp of the newest sample kept.
        newest: Nanos,
        /// Stamp of the sample refused.
        got: Nanos,
    },
    /// A component is infinite or not a number.
    #[error("sample is not finite")]
    NotFinite,
}

/// Why there is no estimate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Unavailable {
    /// Too few samples since the start, or since the last gap, for a second derivative.
    #[error("{samples} of {MIN_SAMPLES} samples since the start or the last gap")]
    Starting {
        /// Samples at hand.
        samples: usize,
    },
    /// The instant is later than the newest sample used by more than `max_gap`.
    #[error("the newest sample is {by} s old")]
    Stale {
        /// Its age at the instant asked for.
        by: Nanos,
    },
    /// The instant is earlier than every sample kept.
    #[error("the oldest sample is {by} s later")]
    Before {
        /// Time from the instant asked for to the oldest sample.
        by: Nanos,
    },
    /// The samples are too large for their squares to be represented.
    #[error("the estimate overflows")]
    Overflow,
}

/// A signal and its first two derivatives at one instant.
///
/// The standard deviations hold two parts, added as squares: what the noise bound gives through the window, and how
/// much one degree more would have changed the estimate, which is the size of what the polynomial leaves out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate<const D: usize> {
    /// The signal, in its own unit.
    pub value: [f64; D],
    /// Its first derivative \[unit/s\].
    pub first: [f64; D],
    /// Its second derivative \[unit/s^2\].
    pub second: [f64; D],
    /// Standard deviation of `value`.
    pub value_std: [f64; D],
    /// Standard deviation of `first`.
    pub first_std: [f64; D],
    /// Standard deviation of `second`.
    pub second_std: [f64; D],
    /// Samples that `value`, `first` and `second` were fitted to; the shortest of the `D` windows.
    pub samples: [usize; 3],
    /// How far the newest sample used lies after the instant (negative: the estimate is an extrapolation).
    pub ahead: Nanos,
}

/// The last samples of one channel, and what they say about any instant: see the [module](self).
#[derive(Debug, Clone)]
pub struct Window<const D: usize> {
    settings: Settings,
    ring: Ring,
    values: [[f64; D]; MAX_SAMPLES],
    /// Of each sample, the square of what it and those before it say of the noise ([`Window::roughness`]).
    rough: [[f64; D]; MAX_SAMPLES],
    interrupted: bool,
}

/// What the stamps of the samples used say alone, whatever the values: it makes the better half of an estimate's work.
///
/// Hand the same one to the windows of all channels that are read at the same instants, in turn ([`Window::at_sharing`]): what the channels' stamps have in common is then
/// found once. A channel whose stamps differ finds its own; estimates are the same to the bit either way.
#[derive(Debug, Clone)]
pub struct Grid {
    /// The window that it was made for, as far as stamps go: one with the same need not be looked through.
    ring: Ring,
    settings: (Nanos, Nanos, usize),
    skipped: usize,
    /// How long before the newest sample the others were taken.
    before: [Nanos; MAX_SAMPLES],
    used: usize,
    /// Time from the oldest sample to the newest \[s\]: the unit of `v`.
    span: f64,
    /// `v^0 ... v^5` of each sample, newest first.
    powers: [[f64; TERMS]; MAX_SAMPLES],
    /// Window lengths to try, longer and longer, the last one all samples.
    lengths: [usize; CANDIDATES],
    tried: usize,
    /// Of each of these.
    bases: [Basis; CANDIDATES],
    /// The instant that `Basis::here` is for, in the unit of `v`.
    at: f64,
}

/// Stamps of a window's samples, as they are kept.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Ring {
    stamps: [Nanos; MAX_SAMPLES],
    /// Which samples begin anew: what came before them does not belong to the same motion.
    anew: [bool; MAX_SAMPLES],
    /// Where the newest sample is, and how many there are, oldest at `newest + 1 - len` modulo the length.
    newest: usize,
    len: usize,
}

/// Polynomials orthogonal over the newest samples, and their values at an instant; found as far as they are asked for.
#[derive(Debug, Clone, Copy)]
struct Basis {
    /// `<p_k, v^l>` for the last `k` found and for the one before, from `l = k` on.
    moments: [[f64; MOMENTS]; 2],
    /// What that of `k` alone must exceed by far, or it is rounding: `<v^k, v^k>`.
    scale: [f64; TERMS],
    a: [f64; TERMS],
    b: [f64; TERMS],
    /// `1 / <p_k, p_k>`.
    per_norm: [f64; TERMS],
    /// Coefficients of `p_k` by powers of `v`.
    powers: [[f64; TERMS]; TERMS],
    /// How many degrees are found, and whether there are no more.
    found: usize,
    is_exhausted: bool,
    /// `p_k` and its derivatives by `v` at the instant, and the sums of `p_k^(m)^2 / <p_k, p_k>` up to `k`; for so many `k`.
    here: [[f64; 3]; TERMS],
    variance: [[f64; 3]; TERMS],
    placed: usize,
}

/// The values of the samples used, and what is found from them.
struct Values<const D: usize> {
    /// Newest first, relative to the newest one's, so that no digits go to a constant.
    values: [[f64; MAX_SAMPLES]; D],
    /// `<x, v^k>` over each window length.
    moments: [[[f64; TERMS]; CANDIDATES]; D],
}

impl Ring {
    const EMPTY: Self = Self {
        stamps: [Nanos::ZERO; MAX_SAMPLES],
        anew: [false; MAX_SAMPLES],
        newest: 0,
        len: 0,
    };

    /// Where the sample is that so many came after.
    fn at(&self, age: usize) -> usize {
        (self.newest + MAX_SAMPLES - age) % MAX_SAMPLES
    }
}

impl<const D: usize> Window<D> {
    /// An empty window.
    ///
    /// # Errors
    /// Settings out of range.
    pub fn new(settings: Settings) -> Result<Self, SettingsError> {
        if !(settings.noise.is_finite() && settings.noise > 0.0) {
            return Err(SettingsError::Noise(settings.noise));
        }
        if !(MIN_SAMPLES..=MAX_SAMPLES).contains(&settings.capacity) {
            return Err(SettingsError::Capacity(settings.capacity));
        }
        for duration in [settings.max_window, settings.max_gap] {
            if duration <= Nanos::ZERO {
                return Err(SettingsError::Duration(duration));
            }
        }
        Ok(Self {
            settings,
            ring: Ring::EMPTY,
            values: [[0.0; D]; MAX_SAMPLES],
            rough: [[0.0; D]; MAX_SAMPLES],
            interrupted: false,
        })
    }

    /// Takes the next sample of the channel; the oldest one goes when the window is full.
    ///
    /// # Errors
    /// A stamp that is not later than the newest one's, or a value that is not finite; the window is then unchanged.
    pub fn push(&mut self, stamp: Nanos, value: [f64; D]) -> Result<Pushed, Refused> {
        if !value.iter().all(|v| v.is_finite()) {
            return Err(Refused::NotFinite);
        }
        let mut pushed = Pushed::Added;
        if let Some((newest, _)) = self.newest() {
            if stamp <= newest {
                return Err(Refused::NotLater { newest, got: stamp });
            }
            let gap = stamp - newest;
            if gap > self.settings.max_gap {
                pushed = Pushed::Restarted { gap };
            }
        }
        self.ring.newest = (self.ring.newest + 1) % MAX_SAMPLES;
        if let Some(anew) = self.ring.anew.get_mut(self.ring.newest) {
            *anew = std::mem::take(&mut self.interrupted);
        }
        if let (Some(s), Some(v)) = (
            self.ring.stamps.get_mut(self.ring.newest),
            self.values.get_mut(self.ring.newest),
        ) {
            (*s, *v) = (stamp, value);
        }
        // More are kept than an estimate uses: what came after the samples of an earlier instant must not push those out.
        self.ring.len = (self.ring.len + 1).min(MAX_SAMPLES);
        let rough = self.roughness();
        if let Some(place) = self.rough.get_mut(self.ring.newest) {
            *place = rough;
        }
        Ok(pushed)
    }

    /// Standard deviation of a sample about a smooth motion, that of late stamps included, as the
    /// samples of `max_window` up to `until` show it; of quantisation it knows what a motion across
    /// steps shows.
    #[must_use]
    pub fn noise(&self, until: Nanos) -> [f64; D] {
        const SAMPLES: usize = 64;
        let skipped = self.later_than(until);
        let known = self.ring.len.saturating_sub(skipped + ROUGH - 1).min(SAMPLES);
        // By time, so that who begins later finds the same.
        let is_in = |age: &usize| until - self.ring.stamps[self.ring.at(*age)] <= self.settings.max_window;
        let count = (skipped..skipped + known).take_while(is_in).count();
        let sum = self.sum_of_roughness(skipped, count);
        sum.map(|sum| (sum / count.max(1) as f64).sqrt())
    }

    /// Of so many samples from this age on.
    fn sum_of_roughness(&self, first: usize, count: usize) -> [f64; D] {
        let mut sum = [0.0; D];
        for age in first..first + count {
            for (sum, rough) in sum.iter_mut().zip(&self.rough[self.ring.at(age)]) {
                *sum += rough;
            }
        }
        sum
    }

    /// The newest samples' divided difference over [`ROUGH`] of them, in units in which it has the variance of a sample's noise, squared. A polynomial of degree three has none, and what
    /// a motion has is less than an encoder's step; so it tells noise, that of late stamps included.
    fn roughness(&self) -> [f64; D] {
        let mut samples = [(0.0, &[0.0; D]); ROUGH];
        let Some((newest, _)) = self.get(0) else {
            return [0.0; D];
        };
        for (age, place) in samples.iter_mut().enumerate() {
            let Some((stamp, value)) = self.get(age) else {
                return [0.0; D];
            };
            *place = ((stamp - newest).seconds(), value);
        }
        let (mut sum, mut square) = ([0.0; D], 0.0);
        for (i, (t, value)) in samples.iter().enumerate() {
            let others = samples.iter().enumerate().filter(|(j, _)| *j != i);
            let weight: f64 = others.map(|(_, (other, _))| 1.0 / (t - other)).product();
            square += weight * weight;
            sum.iter_mut().zip(*value).for_each(|(sum, x)| *sum += weight * x);
        }
        sum.map(|sum| if square.is_finite() { sum * sum / square } else { 0.0 })
    }

    /// What came so far does not belong together with what comes next: the next sample begins anew.
    pub fn interrupt(&mut self) {
        self.interrupted = true;
    }

    /// Forgets every sample.
    pub fn clear(&mut self) {
        self.ring.len = 0;
    }

    /// Number of samples kept.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.ring.len
    }

    /// Whether no sample is kept.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.ring.len == 0
    }

    /// What the window was made with.
    #[must_use]
    pub const fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The sample that has `age` later ones: 0 is the newest.
    fn get(&self, age: usize) -> Option<(Nanos, &[f64; D])> {
        if age >= self.ring.len {
            return None;
        }
        let at = self.ring.at(age);
        Some((*self.ring.stamps.get(at)?, self.values.get(at)?))
    }

    /// The newest sample: stamp and value.
    #[must_use]
    pub fn newest(&self) -> Option<(Nanos, [f64; D])> {
        self.get(0).map(|(t, v)| (t, *v))
    }

    /// The oldest sample kept.
    #[must_use]
    pub fn oldest(&self) -> Option<(Nanos, [f64; D])> {
        self.get(self.ring.len.checked_sub(1)?).map(|(t, v)| (t, *v))
    }

    /// The sample stamped exactly `t`, if it is kept.
    #[must_use]
    pub fn exactly(&self, t: Nanos) -> Option<[f64; D]> {
        self.get(self.later_than(t))
            .filter(|(stamp, _)| *stamp == t)
            .map(|(_, v)| *v)
    }

    /// Number of samples kept that are stamped later than `t`.
    fn later_than(&self, t: Nanos) -> usize {
        // Instants asked for are near the newest sample: a search from there looks at one or two.
        (0..self.ring.len)
            .find(|&age| self.get(age).is_some_and(|(stamp, _)| stamp <= t))
            .unwrap_or(self.ring.len)
    }

    /// The stamp of the newest sample that an estimate at `t` uses when it may use samples stamped up to `until`.
    ///
    /// All samples stamped up to `t`, and of the later ones only the first, provided that it is stamped `until` or
    /// before: a rule on stamps alone, so that what arrived early and what arrived late give the same estimate, live
    /// and in a replay. `None` if no sample qualifies.
    #[must_use]
    pub fn newest_for(&self, t: Nanos, until: Nanos) -> Option<Nanos> {
        self.get(self.skipped_for(t, until)).map(|(stamp, _)| stamp)
    }

    /// How many of the newest samples the rule of [`Window::newest_for`] leaves out.
    fn skipped_for(&self, t: Nanos, until: Nanos) -> usize {
        let later = self.later_than(t);
        match later.checked_sub(1).map(|first| (first, self.get(first))) {
            Some((first, Some((stamp, _)))) if stamp <= until => first,
            _ => later.max(self.later_than(until)),
        }
    }

    /// The estimate at `t` from all samples up to `t` and the first later one, if there is one.
    ///
    /// # Errors
    /// See [`Unavailable`].
    pub fn at(&self, t: Nanos) -> Result<Estimate<D>, Unavailable> {
        self.at_using(t, Nanos::MAX)
    }

    /// The estimate at `t` from the samples that the rule of [`Window::newest_for`] allows: none is later than `until`.
    ///
    /// The polynomial is fitted to windows that end at the newest of them, so `t` lies at most one sample inside or
    /// `max_gap` beyond. Depends on those samples and `t` alone, not on samples that came after them, as long as the
    /// oldest one they need is still kept.
    ///
    /// # Errors
    /// See [`Unavailable`].
    pub fn at_using(&self, t: Nanos, until: Nanos) -> Result<Estimate<D>, Unavailable> {
        self.at_sharing(t, until, &mut Grid::new())
    }

    /// The same as [`Window::at_using`], with what the stamps say from the channel before, if that had the same.
    ///
    /// # Errors
    /// See [`Unavailable`].
    pub fn at_sharing(&self, t: Nanos, until: Nanos, grid: &mut Grid) -> Result<Estimate<D>, Unavailable> {
        let skipped = self.skipped_for(t, until);
        let Some((newest, origin)) = self.get(skipped) else {
            return Err(match self.oldest() {
                Some((oldest, _)) => Unavailable::Before {
                    by: oldest - t.min(until),
                },
                None => Unavailable::Starting { samples: 0 },
            });
        };
        let at = |age: usize| self.ring.at(skipped + age);
        let settings = (self.settings.max_gap, self.settings.max_window, self.settings.capacity);
        let (mut used, mut oldest, mut is_shared) = (grid.used, newest, true);
        if used > 0 && grid.skipped == skipped && grid.settings == settings && grid.ring == self.ring {
            oldest = newest - grid.before[used - 1];
        } else {
            used = 0;
            let mut later_begins_anew = false;
            let most = (self.ring.len - skipped).min(self.settings.capacity).min(MAX_SAMPLES);
            for (age, before) in grid.before.iter_mut().enumerate().take(most) {
                let at = at(age);
                let stamp = self.ring.stamps[at];
                // Instants before a gap still have their samples; those after it do not look across. What is kept apart is decided by
                // stamps alone, whenever the samples came.
                let is_apart = oldest - stamp > self.settings.max_gap || newest - stamp > self.settings.max_window;
                if later_begins_anew || is_apart {
                    break;
                }
                later_begins_anew = self.ring.anew[at];
                oldest = stamp;
                is_shared &= *before == newest - stamp;
                *before = newest - stamp;
                used += 1;
            }
            is_shared &= used == grid.used;
            (grid.ring, grid.settings, grid.skipped) = (self.ring, settings, skipped);
        }
        // What it was made for is overwritten.
        if !is_shared {
            grid.used = 0;
        }
        if t < oldest {
            return Err(Unavailable::Before { by: oldest - t });
        }
        if t - newest > self.settings.max_gap {
            return Err(Unavailable::Stale { by: t - newest });
        }
        if used < MIN_SAMPLES {
            return Err(Unavailable::Starting { samples: used });
        }
        if !is_shared {
            grid.make(used);
        }
        grid.place((t - newest).seconds());
        let mut values = [[0.0; MAX_SAMPLES]; D];
        for age in 0..used {
            for ((column, v), o) in values.iter_mut().zip(&self.values[at(age)]).zip(origin) {
                column[age] = v - o;
            }
        }
        // Those that lie on samples used alone.
        let own = used.saturating_sub(ROUGH - 1);
        let rough = self.sum_of_roughness(skipped, own);
        // An error spread evenly over +-noise has a third of its square.
        let noise = rough.map(|sum| (3.0 * sum / own.max(1) as f64).sqrt().max(self.settings.noise));
        let mut estimate = Values::new(values, grid).estimate(grid, &noise, origin);
        estimate.ahead = newest - t;
        if estimate.is_finite() {
            Ok(estimate)
        } else {
            Err(Unavailable::Overflow)
        }
    }
}

impl<const D: usize> Estimate<D> {
    const NONE: Self = Self {
        value: [f64::NAN; D],
        first: [f64::NAN; D],
        second: [f64::NAN; D],
        value_std: [f64::NAN; D],
        first_std: [f64::NAN; D],
        second_std: [f64::NAN; D],
        samples: [MAX_SAMPLES; 3],
        ahead: Nanos::ZERO,
    };

    fn is_finite(&self) -> bool {
        [
            &self.value,
            &self.first,
            &self.second,
            &self.value_std,
            &self.first_std,
            &self.second_std,
        ]
        .into_iter()
        .flatten()
        .all(|v| v.is_finite())
    }
}

/// The next longer window to try, at most `most`.
fn longer(samples: usize, most: usize) -> usize {
    let next = samples + (samples / 3).max(1);
    // A last step of a few samples would cost a whole window and tell nothing.
    if next + next / 8 >= most { most } else { next }
}

impl Default for Grid {
    fn default() -> Self {
        Self::new()
    }
}

impl Grid {
    /// Of no samples.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            ring: Ring::EMPTY,
            settings: (Nanos::ZERO, Nanos::ZERO, 0),
            skipped: 0,
            before: [Nanos::ZERO; MAX_SAMPLES],
            used: 0,
            span: 1.0,
            powers: [[0.0; TERMS]; MAX_SAMPLES],
            lengths: [0; CANDIDATES],
            tried: 0,
            bases: [Basis::NONE; CANDIDATES],
            at: f64::NAN,
        }
    }

    /// For the first `used` stamps.
    fn make(&mut self, used: usize) {
        self.used = used;
        self.at = f64::NAN;
        self.span = self.seconds(used);
        let per_span = 1.0 / self.span;
        self.tried = 0;
        let (mut sums, mut from, mut samples) = ([0.0; MOMENTS], 0, MIN_SAMPLES);
        for (length, basis) in self.lengths.iter_mut().zip(&mut self.bases) {
            let range = from..samples;
            let taken = self.before.get(range.clone()).unwrap_or_default();
            let powers = self.powers.get_mut(range).unwrap_or_default();
            for (before, powers) in taken.iter().zip(powers) {
                let v = -before.seconds() * per_span;
                let mut power = 1.0;
                for (k, sum) in sums.iter_mut().enumerate() {
                    if let Some(place) = powers.get_mut(k) {
                        *place = power;
                    }
                    *sum += power;
                    power *= v;
                }
            }
            *length = samples;
            *basis = Basis::new(sums);
            self.tried += 1;
            if samples == used {
                break;
            }
            (from, samples) = (samples, longer(samples, used));
        }
    }

    /// The instant asked for, after the newest sample \[s\].
    fn place(&mut self, time: f64) {
        let at = time / self.span;
        if at != self.at {
            self.at = at;
            self.bases.iter_mut().for_each(|basis| basis.placed = 0);
        }
    }

    /// The time from the first to the last of so many samples \[s\].
    fn seconds(&self, samples: usize) -> f64 {
        let oldest = samples.checked_sub(1).and_then(|last| self.before.get(last));
        oldest.map_or(0.0, |before| before.seconds())
    }

    /// The same in the unit of `v`.
    fn extent(&self, samples: usize) -> f64 {
        let oldest = samples.checked_sub(1).and_then(|last| self.powers.get(last));
        -oldest.map_or(0.0, |powers| powers[1])
    }
}

impl Basis {
    const NONE: Self = Self {
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

    /// From the sums of `v^0 ... v^10`.
    fn new(sums: [f64; MOMENTS]) -> Self {
        Self {
            moments: [sums, [0.0; MOMENTS]],
            scale: std::array::from_fn(|k| sums[2 * k]),
            is_exhausted: false,
            ..Self::NONE
        }
    }

    /// Finds the polynomials up to this degree, if the `samples` are enough for them: whether they are.
    fn reaches(&mut self, degree: usize, samples: usize) -> bool {
        while self.found <= degree && !self.is_exhausted {
            self.next(samples);
        }
        self.found > degree
    }

    /// One degree more, by Chebyshev's algorithm.
    fn next(&mut self, samples: usize) {
        let k = self.found;
        let [moments, before] = &mut self.moments;
        if k > 0 {
            let (a, b) = (self.a[k - 1], self.b[k - 1]);
            // <p_k, v^l> from those of k - 1 and k - 2; in the place of the latter.
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
                let shifted = if j > 0 { self.powers[k - 1][j - 1] } else { 0.0 };
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

    /// `p_k` up to this degree at the instant `at`; they must be found.
    fn place(&mut self, degree: usize, at: f64) {
        for k in self.placed..=degree.min(TERMS - 1) {
            let none = [0.0; 3];
            self.here[k] = match k {
                0 => [1.0, 0.0, 0.0],
                _ => {
                    let (here, before) = (self.here[k - 1], if k > 1 { self.here[k - 2] } else { none });
                    let (a, b) = (self.a[k - 1], self.b[k - 1]);
                    per_derivative(|m| {
                        let inner = if m > 0 { m as f64 * here[m - 1] } else { 0.0 };
                        (at - a) * here[m] + inner - b * before[m]
                    })
                }
            };
            let so_far = if k > 0 { self.variance[k - 1] } else { none };
            self.variance[k] = per_derivative(|m| so_far[m] + self.here[k][m] * self.here[k][m] * self.per_norm[k]);
            self.placed = k + 1;
        }
    }

    /// The coefficients by `p_0 ... p_{N-1}` of the polynomial nearest to values with these moments.
    fn coefficients<const N: usize>(&self, moments: &[f64; TERMS]) -> [f64; N] {
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

    /// The same by powers of `v`.
    fn polynomial<const N: usize>(&self, moments: &[f64; TERMS]) -> [f64; N] {
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

impl<const D: usize> Values<D> {
    fn new(values: [[f64; MAX_SAMPLES]; D], grid: &Grid) -> Self {
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

    /// The three steps of the module's head.
    fn estimate(&self, grid: &mut Grid, noise: &[f64; D], origin: &[f64; D]) -> Estimate<D> {
        let mut estimate = Estimate::NONE;
        for (component, noise) in noise.iter().enumerate() {
            self.component(component, grid, *noise, origin, &mut estimate);
        }
        estimate
    }

    fn component(&self, component: usize, grid: &mut Grid, noise: f64, origin: &[f64; D], estimate: &mut Estimate<D>) {
        let tolerance = noise * TOLERANCE;
        let (mut degree, mut end, mut longest) = (0, 0, 0.0);
        for (d, stretch) in STRETCH.into_iter().enumerate() {
            // No window is longer than all samples: what can not be long enough is not tried.
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

    /// Step 1 for degree `N - 1`: how many of the window lengths, from the first on, fit within the tolerance; and the span of the longest that gives an estimate \[s\].
    ///
    /// From one length to the next, residuals of samples that were in both change by the difference of the two polynomials. What bounds that, added to what bounded them, mostly
    /// tells that they still fit; only where it does not, they are looked at again.
    fn grow<const N: usize>(&self, component: usize, grid: &mut Grid, tolerance: f64) -> (usize, Option<f64>) {
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
                let kept = bound + greatest(&change, grid.extent(seen));
                // Not `>`: what is not a number does not fit.
                bound = if kept <= tolerance { kept } else { largest(0, seen) }.max(added);
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
    fn trim<const N: usize>(
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
            if (length as f64) < SHARE * most as f64 || !basis.reaches(N - 1, length) {
                continue;
            }
            // One degree more, for what this one leaves out.
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
                // Errors of quantisation do not average out at rest: the value is never better than one sample.
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
        let places = [&mut estimate.value, &mut estimate.first, &mut estimate.second];
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

fn per_derivative(f: impl FnMut(usize) -> f64) -> [f64; 3] {
    core::array::from_fn(f)
}

/// By Horner's rule.
#[inline(always)]
fn evaluate<const N: usize>(polynomial: &[f64; N], v: f64) -> f64 {
    polynomial.iter().rev().fold(0.0, |sum, c| sum * v + c)
}

/// The largest distance of values from a polynomial, over the samples with these powers of `v`; infinite where that is not a number.
#[inline(always)]
fn largest_residual<const N: usize>(polynomial: &[f64; N], values: &[f64], powers: &[[f64; TERMS]]) -> f64 {
    // In four lanes: a single one would wait for itself at every step.
    let mut largest = [0.0_f64; 4];
    let ((values4, values), (powers4, powers)) = (values.as_chunks::<4>(), powers.as_chunks::<4>());
    let residual = |value: f64, powers: &[f64; TERMS]| {
        let distance = (value - evaluate(polynomial, powers[1])).abs();
        if distance.is_nan() { f64::INFINITY } else { distance }
    };
    for (values, powers) in values4.iter().zip(powers4) {
        for i in 0..4 {
            let distance = residual(values[i], &powers[i]);
            largest[i] = if distance > largest[i] { distance } else { largest[i] };
        }
    }
    for (value, powers) in values.iter().zip(powers) {
        largest[0] = largest[0].max(residual(*value, powers));
    }
    largest[0].max(largest[1]).max(largest[2].max(largest[3]))
}

/// A bound of a polynomial's magnitude from `-extent` to 0: its largest one at the extrema of Chebyshev's polynomial of degree 8, by `1 / cos(pi n / 16)` for degree `n` up to 4.
/// (Ehlich, Zeller, "Schwankung von Polynomen zwischen Gitterpunkten", Math. Zeitschrift 86, 1964.)
#[inline(always)]
fn greatest<const N: usize>(polynomial: &[f64; N], extent: f64) -> f64 {
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
