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
//! with sigma = noise / sqrt 3, for an error spread evenly over +-noise.
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
//! Windows grow in steps of a third, so the search costs a few times the window's length, not its square.
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
//! Windows of 64 samples: 0.71 and 17.3 in the first row, 1.6 deg/s^2 in the last. One estimate of one joint takes about
//! 3 us with 64 samples, 3 to 4.5 us with 128 (x86-64, release build). The standard deviations given cover the error
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
/// Windows tried: 3, 4, 5, 6, then a third longer each time; 15 of them reach 128 samples.
const CANDIDATES: usize = 16;
/// Squared norm of an orthogonal polynomial, per sample and in units of the span, below which rounding is all it is.
const DEGENERATE: f64 = 1e-24;

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
    stamps: [Nanos; MAX_SAMPLES],
    values: [[f64; D]; MAX_SAMPLES],
    /// Which samples begin anew: what came before them does not belong to the same motion.
    anew: [bool; MAX_SAMPLES],
    interrupted: bool,
    /// Where the newest sample is, and how many there are, oldest at `newest + 1 - len` modulo the length.
    newest: usize,
    len: usize,
}

/// One window length tried, with the fits of every degree that it allows.
#[derive(Clone, Copy)]
struct Candidate<const D: usize> {
    samples: usize,
    span: f64,
    /// Standard deviation by degree and derivative, for sigma = 1.
    noise: [[f64; 3]; FITTED],
    /// Estimate by degree, component and derivative.
    estimate: [[[f64; 3]; D]; FITTED],
    /// What one degree more adds to it.
    omitted: [[[f64; 3]; D]; FITTED],
}

/// Values newest first, times relative to the newest \[s\], and room for the recurrence.
struct Scratch<const D: usize> {
    times: [f64; MAX_SAMPLES],
    values: [[f64; MAX_SAMPLES]; D],
    scaled: [f64; MAX_SAMPLES],
    current: [f64; MAX_SAMPLES],
    previous: [f64; MAX_SAMPLES],
    residual: [[f64; MAX_SAMPLES]; D],
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
            stamps: [Nanos::ZERO; MAX_SAMPLES],
            values: [[0.0; D]; MAX_SAMPLES],
            anew: [false; MAX_SAMPLES],
            interrupted: false,
            newest: 0,
            len: 0,
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
        self.newest = (self.newest + 1) % MAX_SAMPLES;
        if let Some(anew) = self.anew.get_mut(self.newest) {
            *anew = std::mem::take(&mut self.interrupted);
        }
        if let (Some(s), Some(v)) = (self.stamps.get_mut(self.newest), self.values.get_mut(self.newest)) {
            (*s, *v) = (stamp, value);
        }
        // More are kept than an estimate uses: what came after the samples of an earlier instant must not push those out.
        self.len = (self.len + 1).min(MAX_SAMPLES);
        Ok(pushed)
    }

    /// What came so far does not belong together with what comes next: the next sample begins anew.
    pub fn interrupt(&mut self) {
        self.interrupted = true;
    }

    fn begins_anew(&self, age: usize) -> bool {
        self.anew
            .get((self.newest + MAX_SAMPLES - age) % MAX_SAMPLES)
            .copied()
            .unwrap_or(false)
    }

    /// Forgets every sample.
    pub fn clear(&mut self) {
        self.len = 0;
    }

    /// Number of samples kept.
    #[must_use]
    pub const fn len(&self) -> usize {
        self.len
    }

    /// Whether no sample is kept.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// What the window was made with.
    #[must_use]
    pub const fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The sample that has `age` later ones: 0 is the newest.
    fn get(&self, age: usize) -> Option<(Nanos, &[f64; D])> {
        if age >= self.len {
            return None;
        }
        let at = (self.newest + MAX_SAMPLES - age) % MAX_SAMPLES;
        Some((*self.stamps.get(at)?, self.values.get(at)?))
    }

    /// The newest sample: stamp and value.
    #[must_use]
    pub fn newest(&self) -> Option<(Nanos, [f64; D])> {
        self.get(0).map(|(t, v)| (t, *v))
    }

    /// The oldest sample kept.
    #[must_use]
    pub fn oldest(&self) -> Option<(Nanos, [f64; D])> {
        self.get(self.len.checked_sub(1)?).map(|(t, v)| (t, *v))
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
        (0..self.len)
            .find(|&age| self.get(age).is_some_and(|(stamp, _)| stamp <= t))
            .unwrap_or(self.len)
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
        let skipped = self.skipped_for(t, until);
        let Some((newest, origin)) = self.get(skipped) else {
            return Err(match self.oldest() {
                Some((oldest, _)) => Unavailable::Before {
                    by: oldest - t.min(until),
                },
                None => Unavailable::Starting { samples: 0 },
            });
        };
        let mut scratch = Scratch::new();
        let mut used = 0;
        let mut oldest = newest;
        let mut later_begins_anew = false;
        for age in skipped..self.len {
            let Some((stamp, value)) = self.get(age) else { break };
            // Instants before a gap still have their samples; those after it do not look across. What is kept apart is decided by
            // stamps alone, whenever the samples came.
            if used > 0 && (later_begins_anew || oldest - stamp > self.settings.max_gap) {
                break;
            }
            later_begins_anew = self.begins_anew(age);
            if used == self.settings.capacity || newest - stamp > self.settings.max_window {
                break;
            }
            oldest = stamp;
            scratch.set(used, (stamp - newest).seconds(), value, origin);
            used += 1;
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
        let mut estimate = scratch.estimate(used, (t - newest).seconds(), self.settings.noise, origin);
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

impl<const D: usize> Candidate<D> {
    const NONE: Self = Self {
        samples: 0,
        span: 0.0,
        noise: [[f64::INFINITY; 3]; FITTED],
        estimate: [[[f64::NAN; 3]; D]; FITTED],
        omitted: [[[0.0; 3]; D]; FITTED],
    };
}

/// The next longer window to try, at most `most`.
fn longer(samples: usize, most: usize) -> usize {
    let next = samples + (samples / 3).max(1);
    // A last step of a few samples would cost a whole window and tell nothing.
    if next + next / 8 >= most { most } else { next }
}

impl<const D: usize> Scratch<D> {
    const fn new() -> Self {
        Self {
            times: [0.0; MAX_SAMPLES],
            values: [[0.0; MAX_SAMPLES]; D],
            scaled: [0.0; MAX_SAMPLES],
            current: [0.0; MAX_SAMPLES],
            previous: [0.0; MAX_SAMPLES],
            residual: [[0.0; MAX_SAMPLES]; D],
        }
    }

    /// Sets sample `age`: values relative to the newest one's, so that no digits go to a constant.
    fn set(&mut self, age: usize, time: f64, value: &[f64; D], origin: &[f64; D]) {
        if let Some(slot) = self.times.get_mut(age) {
            *slot = time;
        }
        for ((column, v), o) in self.values.iter_mut().zip(value).zip(origin) {
            if let Some(slot) = column.get_mut(age) {
                *slot = v - o;
            }
        }
    }

    /// The three steps of the module's head, on the first `used` samples, at `time` after the newest \[s\].
    fn estimate(&mut self, used: usize, time: f64, noise: f64, origin: &[f64; D]) -> Estimate<D> {
        let mut candidates = [Candidate::<D>::NONE; CANDIDATES];
        // Step 1. How many candidates, from the first that the degree allows on, fit within the tolerance.
        let mut fitting = [[0_usize; D]; FITTED];
        let mut growing = [[true; D]; FITTED];
        let (mut tried, mut samples) = (0, MIN_SAMPLES);
        for candidate in &mut candidates {
            tried += 1;
            *candidate = self.fit(samples, time, noise * TOLERANCE, &mut growing);
            for ((fitting, growing), degree) in fitting.iter_mut().zip(&growing).zip(FIRST_DEGREE..) {
                for (fitting, growing) in fitting.iter_mut().zip(growing) {
                    if *growing && samples > degree {
                        *fitting = tried;
                    }
                }
            }
            if samples == used || growing.iter().flatten().all(|growing| !growing) {
                break;
            }
            samples = longer(samples, used);
        }
        let mut estimate = Estimate::NONE;
        for component in 0..D {
            select(&candidates, &fitting, component, noise, origin, &mut estimate);
        }
        estimate
    }

    /// Fits every degree that still grows to the newest `samples`; marks in `growing` where a residual exceeds
    /// `tolerance`, component by component.
    fn fit(&mut self, samples: usize, time: f64, tolerance: f64, growing: &mut [[bool; D]; FITTED]) -> Candidate<D> {
        let mut candidate = Candidate {
            samples,
            ..Candidate::NONE
        };
        let used = samples.min(MAX_SAMPLES);
        let (times, _) = self.times.split_at(used);
        let (scaled, _) = self.scaled.split_at_mut(used);
        let (mut current, _) = self.current.split_at_mut(used);
        let (mut previous, _) = self.previous.split_at_mut(used);
        let span = -times.last().copied().unwrap_or(0.0);
        candidate.span = span;
        let (per_span, at) = (1.0 / span, time / span);
        for (scaled, time) in scaled.iter_mut().zip(times) {
            *scaled = time * per_span;
        }
        current.fill(1.0);
        previous.fill(0.0);
        for (residual, values) in self.residual.iter_mut().zip(&self.values) {
            for (residual, value) in residual.iter_mut().zip(values).take(used) {
                *residual = *value;
            }
        }
        // p_k, p_k', p_k'' at the instant, of this k and the one before.
        let (mut here, mut before) = ([1.0, 0.0, 0.0], [0.0; 3]);
        let scale = [1.0, per_span, per_span * per_span];
        let mut norm_before = 1.0;
        let (mut estimate, mut variance) = ([[0.0; 3]; D], [0.0; 3]);
        let highest = (0..FITTED)
            .rev()
            .find(|&d| growing.get(d).is_some_and(|g| g.contains(&true)))
            .unwrap_or(0);
        // One more than is fitted, for what it leaves out.
        let last = (FIRST_DEGREE + highest + 1).min(used - 1);
        for degree in 0..=last {
            // <p, p> and <u p, p>.
            let (norm, moment) = norms(current, scaled);
            if norm <= DEGENERATE * samples as f64 || !norm.is_finite() {
                break;
            }
            let share = per_derivative(|m| here[m] * scale[m]);
            for (component, residual) in self.residual.iter_mut().enumerate() {
                let residual = residual.split_at_mut(used).0;
                let coefficient = dot(current, residual) / norm;
                let term = per_derivative(|m| coefficient * share[m]);
                if let Some(estimate) = estimate.get_mut(component) {
                    // What this degree adds is what the one below left out.
                    if let Some(omitted) = degree
                        .checked_sub(FIRST_DEGREE + 1)
                        .and_then(|d| candidate.omitted.get_mut(d))
                        .and_then(|o| o.get_mut(component))
                    {
                        *omitted = term;
                    }
                    *estimate = per_derivative(|m| estimate[m] + term[m]);
                }
                if degree > FIRST_DEGREE + highest {
                    continue;
                }
                let largest = subtract(residual, coefficient, current);
                if let Some(growing) = degree
                    .checked_sub(FIRST_DEGREE)
                    .and_then(|d| growing.get_mut(d))
                    .and_then(|g| g.get_mut(component))
                {
                    // Not `largest > tolerance`: what is not a number does not fit.
                    *growing &= largest <= tolerance;
                }
            }
            variance = per_derivative(|m| variance[m] + share[m] * share[m] / norm);
            if let Some(d) = degree.checked_sub(FIRST_DEGREE) {
                if let Some(kept) = candidate.estimate.get_mut(d) {
                    *kept = estimate;
                }
                if let Some(kept) = candidate.noise.get_mut(d) {
                    *kept = variance.map(f64::sqrt);
                }
            }
            if degree == last {
                break;
            }
            let a = moment / norm;
            let b = norm / norm_before;
            for ((previous, current), u) in previous.iter_mut().zip(&*current).zip(&*scaled) {
                *previous = (u - a) * current - b * *previous;
            }
            (current, previous) = (previous, current);
            let next = per_derivative(|m| {
                let inner = if m > 0 { m as f64 * here[m - 1] } else { 0.0 };
                (at - a) * here[m] + inner - b * before[m]
            });
            (before, here) = (here, next);
            norm_before = norm;
        }
        candidate
    }
}

/// Steps 2 and 3 of the module's head, for one component.
fn select<const D: usize>(
    candidates: &[Candidate<D>; CANDIDATES],
    fitting: &[[usize; D]; FITTED],
    component: usize,
    noise: f64,
    origin: &[f64; D],
    estimate: &mut Estimate<D>,
) {
    let (mut degree, mut end, mut longest) = (0, 0, 0.0);
    for (d, (fitting, stretch)) in fitting.iter().zip(STRETCH).enumerate() {
        let tried = fitting.get(component).copied().unwrap_or(0);
        let widest = candidates
            .iter()
            .take(tried)
            .rfind(|c| c.noise.get(d).is_some_and(|n| n[2].is_finite()));
        if let Some(widest) = widest
            && (end == 0 || widest.span >= stretch * longest)
        {
            (degree, end, longest) = (d, tried, widest.span);
        }
    }
    let most = candidates.iter().take(end).map(|c| c.samples).max().unwrap_or(0);
    let usable = |c: &&Candidate<D>| c.samples as f64 >= SHARE * most as f64;
    let sigma = noise / 3.0_f64.sqrt();
    let (mut best, mut deviation, mut samples) = ([f64::NAN; 3], [f64::NAN; 3], [0; 3]);
    for m in 0..3 {
        let (mut low, mut high) = (f64::NEG_INFINITY, f64::INFINITY);
        for candidate in candidates.iter().take(end).filter(usable) {
            let Some(((e, omitted), noise)) = candidate
                .estimate
                .get(degree)
                .and_then(|e| e.get(component))
                .zip(candidate.omitted.get(degree).and_then(|o| o.get(component)))
                .zip(candidate.noise.get(degree))
            else {
                continue;
            };
            let s = sigma * noise[m];
            if !s.is_finite() {
                continue;
            }
            low = low.max(e[m] - KAPPA[m] * s);
            high = high.min(e[m] + KAPPA[m] * s);
            if low > high {
                break;
            }
            best[m] = e[m];
            // Errors of quantisation do not average out at rest: the value is never better than one sample.
            let s = if m == 0 { s.max(sigma) } else { s };
            deviation[m] = (s * s + omitted[m] * omitted[m]).sqrt();
            samples[m] = candidate.samples;
        }
    }
    let set = |array: &mut [f64; D], v: f64| {
        if let Some(slot) = array.get_mut(component) {
            *slot = v;
        }
    };
    set(
        &mut estimate.value,
        best[0] + origin.get(component).copied().unwrap_or(f64::NAN),
    );
    set(&mut estimate.first, best[1]);
    set(&mut estimate.second, best[2]);
    set(&mut estimate.value_std, deviation[0]);
    set(&mut estimate.first_std, deviation[1]);
    set(&mut estimate.second_std, deviation[2]);
    for (kept, samples) in estimate.samples.iter_mut().zip(samples) {
        *kept = (*kept).min(samples);
    }
}

fn per_derivative(f: impl FnMut(usize) -> f64) -> [f64; 3] {
    core::array::from_fn(f)
}

/// The inner product of `a` and `b`, in four partial sums: a single one would wait for itself at every step.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a4, a_rest) = a.as_chunks::<4>();
    let (b4, b_rest) = b.as_chunks::<4>();
    let mut sum = [0.0; 4];
    for (a, b) in a4.iter().zip(b4) {
        for i in 0..4 {
            sum[i] += a[i] * b[i];
        }
    }
    for (a, b) in a_rest.iter().zip(b_rest) {
        sum[0] += a * b;
    }
    (sum[0] + sum[1]) + (sum[2] + sum[3])
}

/// Sums of `p^2` and of `u p^2`.
fn norms(p: &[f64], u: &[f64]) -> (f64, f64) {
    let (p4, p_rest) = p.as_chunks::<4>();
    let (u4, u_rest) = u.as_chunks::<4>();
    let (mut norm, mut moment) = ([0.0; 4], [0.0; 4]);
    for (p, u) in p4.iter().zip(u4) {
        for i in 0..4 {
            let square = p[i] * p[i];
            norm[i] += square;
            moment[i] += u[i] * square;
        }
    }
    for (p, u) in p_rest.iter().zip(u_rest) {
        norm[0] += p * p;
        moment[0] += u * p * p;
    }
    (
        (norm[0] + norm[1]) + (norm[2] + norm[3]),
        (moment[0] + moment[1]) + (moment[2] + moment[3]),
    )
}

/// `a -= factor b`; gives the largest magnitude of what is left.
fn subtract(a: &mut [f64], factor: f64, b: &[f64]) -> f64 {
    let mut largest = [0.0_f64; 4];
    let (a4, a_rest) = a.as_chunks_mut::<4>();
    let (b4, b_rest) = b.as_chunks::<4>();
    for (a, b) in a4.iter_mut().zip(b4) {
        for i in 0..4 {
            a[i] -= factor * b[i];
            let magnitude = a[i].abs();
            largest[i] = if magnitude > largest[i] { magnitude } else { largest[i] };
        }
    }
    for (a, b) in a_rest.iter_mut().zip(b_rest) {
        *a -= factor * b;
        largest[0] = largest[0].max(a.abs());
    }
    largest[0].max(largest[1]).max(largest[2].max(largest[3]))
}
