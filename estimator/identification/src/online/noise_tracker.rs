//! Estimates the noise of an F/T channel and the drift rate of its offset from its own readings.
//!
//! ```text
//! o_k+1 = o_k + w_k,   w_k ~ N(0, q^2 dt)         the offset, a random walk of the drift rate q
//! y_k = o_k + v_k,     v_k ~ N(0, V / n + b_k)    mean of second k minus the bodies' prediction
//! ```
//!
//! The unit of `q` is N/s^1/2 or Nm/s^1/2. `V` is the variance of one of the second's `n`
//! observations that would give its mean this variance if they were independent. It contains the
//! sensor's noise, its autocorrelation, jitter of stamps, vibration, and all other model errors.
//! `b_k` is the variance of the mean by the uncertainty of the bodies. The bodies are those solved
//! *before* the second, independent of its readings, so that overfitting does not hide noise.
//!
//! For each pair `(V, q)` of a grid a filter of the local level model ([`LocalLevel`]) gives the
//! likelihood of the innovations `y_k - o_k|k-1`. An undeclared disturbance is no noise: each
//! innovation has a mixture distribution, of which a share [`DISTURBED`] is uniform within
//! [`RANGE`]. The estimates of `V` and `q^2` are means over the grid, weighted by likelihood.
//! Initially `V` is hundreds of times the stated variance: readings get their full weight
//! only after their noise was observed.

use crate::linear::noise::LocalLevel;

/// Grid of the noise: `V` over the stated variance, in half decades, `10^0 ... 10^5`. Readings
/// beyond are no noise: the greatest value found on a real leg is 10^4.
const LEVELS: usize = 11;
/// Grid of the drift rate: `q` over the standard deviation of a second's mean, `(V dt)^1/2`. At 1
/// the offset follows in about a second. As off-line, it may not be faster, or it would follow the
/// motion that identifies.
const RATES: [f64; 5] = [0.01, 0.03, 0.1, 0.3, 1.0];
/// Memory of the likelihood \[s\].
const MEMORY: f64 = 60.0;
/// Length of a pause after which the filters restart, since a contact may have changed the offset
/// \[s\]. After a disturbance of this length a filter restarts, too: one that began in a contact
/// would take all that follows for disturbed, and the offset's return for noise.
const PAUSE: f64 = 3.0;
/// Assumed share of seconds with an undeclared disturbance, and the range of its uniform
/// distribution, in stated standard deviations.
const DISTURBED: f64 = 0.02;
const RANGE: f64 = 1000.0;
/// Seconds over which one that is worse than the others fades.
const LATELY: f64 = 10.0;
/// Probability of noise from which on a second's mean is no disturbance.
const LIKELY_NOISE: f64 = 0.5;
/// Limit of the log-likelihood by data at rest, which say little of the noise in motion: `e^3`,
/// odds of twenty.
const AT_REST: f64 = 3.0;

/// Initial correlation of consecutive innovations, and its weight in seconds.
const CORRELATED: (f64, f64) = (0.0, 10.0);

/// Limits of an innovation, in standard deviations, and of the correlation.
const LARGE: f64 = 3.0;
const GREATEST: f64 = 0.9;

/// One filter of the offset, and its log-likelihood.
#[derive(Clone, Copy, Debug, Default)]
struct OffsetFilter {
    offset: LocalLevel,
    likelihood: f64,
    /// How long readings have been disturbed without an end \[s\].
    disturbed: f64,
}

/// The readings of a channel in one second.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SecondMean {
    /// Middle of the second \[s\].
    pub t: f64,
    /// Mean reading minus the bodies' prediction.
    pub mean: f64,
    /// Number of observations.
    pub count: f64,
    /// Variance of the mean by the uncertainty of the bodies.
    pub of_bodies: f64,
    /// Mean square of the observations about their mean.
    pub scatter: f64,
    /// Whether something moved.
    pub is_moving: bool,
}

/// Estimator of one channel's noise and drift rate.
#[derive(Clone, Debug)]
pub(crate) struct NoiseTracker {
    /// The stated variance of an observation.
    stated: f64,
    /// The time between observations \[s\].
    period: f64,
    /// Time of the last second \[s\]; None: the filters restart with the next.
    last: Option<f64>,
    filters: [[OffsetFilter; RATES.len()]; LEVELS],
    /// Normalised innovation of the likeliest filter; the mean product of two consecutive ones, and
    /// the mean square.
    innovation: f64,
    products: (f64, f64),
    /// Mean square of observations about the mean of their second; None before the first.
    scatter: Option<f64>,
    /// The worst scatter of late, which fades with each second; pushes do not count.
    worst: f64,
    /// No push filled the last second.
    was_free: bool,
    /// The scatter in the last second; it counts unless the next one shows that a push began.
    candidate: Option<f64>,
}

impl NoiseTracker {
    pub(crate) fn new(stated: f64, period: f64) -> Self {
        Self {
            stated,
            period,
            last: None,
            filters: [[OffsetFilter::default(); RATES.len()]; LEVELS],
            innovation: f64::NAN,
            products: (CORRELATED.0 * CORRELATED.1, CORRELATED.1),
            scatter: None,
            worst: 0.0,
            was_free: false,
            candidate: None,
        }
    }

    /// `V` of a level.
    fn level(&self, number: usize) -> f64 {
        self.stated * 10f64.powf(0.5 * number as f64)
    }

    /// Shifts the offset after a change of the bodies that predict the mean.
    pub(crate) fn shift(&mut self, by: f64) {
        self.filters
            .as_flattened_mut()
            .iter_mut()
            .for_each(|filter| filter.offset.level += by);
    }

    /// Restarts the filters with the next second.
    pub(crate) fn interrupt(&mut self) {
        self.last = None;
    }

    /// Takes in a second. Returns whether its mean is likely to be noise.
    pub(crate) fn take(&mut self, second: &SecondMean) -> bool {
        if !(second.mean.is_finite() && second.of_bodies.is_finite() && second.count > 0.0) {
            return false;
        }
        let since = (self.last.replace(second.t))
            .map(|last| second.t - last)
            .filter(|dt| (0.0..PAUSE).contains(dt));
        let levels: [f64; LEVELS] = std::array::from_fn(|number| self.level(number));
        let disturbed = DISTURBED / (RANGE * self.stated.sqrt());
        // Of the most likely filter: the innovation, and its share of noise.
        let mut best = (f64::NEG_INFINITY, (f64::NAN, 1.0));
        for (row, level) in self.filters.iter_mut().zip(levels) {
            let noise = level / second.count + second.of_bodies;
            for (filter, rate) in row.iter_mut().zip(RATES) {
                let innovation = match since {
                    None => {
                        filter.offset = LocalLevel::first((second.mean, noise));
                        (f64::NAN, 1.0)
                    }
                    Some(dt) => {
                        let walked = rate * rate * level * self.period * dt;
                        filter.take((second.mean, noise), walked, dt, disturbed)
                    }
                };
                if filter.likelihood >= best.0 {
                    best = (filter.likelihood, innovation);
                }
            }
        }
        for filter in self.filters.as_flattened_mut() {
            filter.likelihood -= best.0;
            if !second.is_moving {
                filter.likelihood = filter.likelihood.max(-AT_REST);
            }
        }
        let (innovation, share) = best.1;
        let scatter = self.scatter.unwrap_or(second.scatter);
        self.scatter = Some(scatter + share * (second.scatter - scatter) / MEMORY);
        let last = std::mem::replace(&mut self.innovation, innovation.clamp(-LARGE, LARGE));
        if (last * self.innovation).is_finite() && second.is_moving {
            let keep = 1.0 - 1.0 / MEMORY;
            self.products.0 = self.products.0 * keep + last * self.innovation;
            self.products.1 = self.products.1 * keep + self.innovation * self.innovation;
        }
        since.is_some() && share > LIKELY_NOISE
    }

    /// Takes in the scatter of a second; None if a push fills the second. One beside such a second
    /// does not count: there the push begins or ends.
    fn take_scatter(&mut self, second: Option<&SecondResiduals>) {
        let confirmed = second.and(self.candidate).unwrap_or(0.0);
        let was_free = std::mem::replace(&mut self.was_free, second.is_some());
        self.candidate = second
            .filter(|own| was_free && own.is_likely_noise)
            .map(|own| own.scatter);
        self.worst = confirmed.max(self.worst * (1.0 - 1.0 / LATELY));
    }

    /// Variance of one reading about its prediction: the scatter within a second, and the changes
    /// between seconds.
    pub(crate) fn reading(&self) -> f64 {
        let slow = self.noise().0 * self.period;
        (self.scatter.unwrap_or(0.0) + slow).max(self.stated)
    }

    /// The worst scatter of late that is no push.
    pub(crate) fn worst(&self) -> f64 {
        self.worst.max(self.candidate.unwrap_or(0.0))
    }

    /// `V`, and the standard deviation of the drift in a second: means over the grid, weighted by
    /// likelihood.
    pub(crate) fn noise(&self) -> (f64, f64) {
        let best = (self.filters.as_flattened().iter())
            .map(|filter| filter.likelihood)
            .fold(f64::NEG_INFINITY, f64::max);
        let (mut sums, mut weights) = ([0.0; 2], 0.0);
        for (number, row) in self.filters.iter().enumerate() {
            let level = self.level(number);
            for (filter, rate) in row.iter().zip(RATES) {
                let weight = (filter.likelihood - best).exp();
                sums[0] += weight * level;
                sums[1] += weight * rate * rate * level * self.period;
                weights += weight;
            }
        }
        let correlation = (self.products.0 / self.products.1).clamp(0.0, GREATEST);
        (
            sums[0] / weights * (1.0 + correlation) / (1.0 - correlation),
            (sums[1] / weights).sqrt(),
        )
    }
}

impl OffsetFilter {
    /// Takes in a mean with its variance, `dt` seconds after the last one, in which the offset's
    /// variance grew by `walked`; `disturbed` is the density of disturbances. Returns the
    /// normalised innovation, and the probability that it is noise.
    fn take(
        &mut self,
        (mean, noise): (f64, f64),
        walked: f64,
        dt: f64,
        disturbed: f64,
    ) -> (f64, f64) {
        let (innovation, total) = self.offset.innovation(walked, (mean, noise));
        let square = innovation * innovation / total;
        let regular =
            (1.0 - DISTURBED) * (-0.5 * square).exp() / (std::f64::consts::TAU * total).sqrt();
        let share = regular / (regular + disturbed);
        self.disturbed = if share > LIKELY_NOISE {
            0.0
        } else {
            self.disturbed + dt
        };
        if self.disturbed >= PAUSE {
            *self = Self {
                offset: LocalLevel::first((mean, noise)),
                likelihood: self.likelihood,
                disturbed: 0.0,
            };
            return (f64::NAN, share);
        }
        // A disturbance gives no information about the offset, which does not drift meanwhile, and
        // does not age earlier innovations.
        self.offset.update(walked, (mean, noise), share);
        self.likelihood *= (-share * dt / MEMORY).exp();
        self.likelihood += (regular + disturbed).ln();
        (innovation / total.sqrt(), share)
    }
}

/// The residuals of one axis in a second.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SecondResiduals {
    /// Their mean, and the mean square about it.
    pub mean: f64,
    pub scatter: f64,
    /// Whether the mean is likely to be noise.
    pub is_likely_noise: bool,
}

impl SecondResiduals {
    pub(crate) const NONE: Self = Self {
        mean: f64::NAN,
        scatter: f64::NAN,
        is_likely_noise: false,
    };
}

/// Takes in the residuals of a sensor in one second, NaN where it has none. The mean of a second
/// that a push fills for the greater part has a larger square than the scatter has.
pub(crate) fn take_scatters(axes: &mut [NoiseTracker], second: &[SecondResiduals]) {
    let excess = (axes.iter().zip(second))
        .map(|(axis, own)| (own.mean * own.mean - own.scatter) / axis.stated)
        .filter(|excess| excess.is_finite())
        .sum::<f64>();
    for (axis, own) in axes.iter_mut().zip(second) {
        axis.take_scatter((excess <= 0.0 && own.scatter.is_finite()).then_some(own));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arithmetic::normals;

    const PERIOD: f64 = 0.01;
    const STATED: f64 = 0.0064;

    /// A channel after some seconds of motion. Its noise is `factor` times the stated variance, its
    /// drift rate is given in deviations of a second's mean, and `acts` is a disturbance.
    fn after(
        seconds: usize,
        factor: f64,
        rate: f64,
        seed: u64,
        acts: impl Fn(usize) -> f64,
    ) -> NoiseTracker {
        let mut channel = NoiseTracker::new(STATED, PERIOD);
        let deviates = normals(seed, 2 * seconds);
        let deviation = (factor * STATED * PERIOD).sqrt();
        let mut offset = 11.0;
        for second in 0..seconds {
            offset += rate * deviation * deviates[2 * second];
            channel.take(&SecondMean {
                t: second as f64,
                mean: offset + deviation * deviates[2 * second + 1] + acts(second),
                count: 100.0,
                of_bodies: 0.0,
                scatter: factor * STATED,
                is_moving: true,
            });
        }
        channel
    }

    #[test]
    fn noise_over_four_decades_and_a_drift_are_found() {
        for seed in 1..=5 {
            for factor in [1.0, 30.0, 1e3, 1e4] {
                for rate in [0.01, 0.3, 1.0] {
                    let (noise, walk) = after(300, factor, rate, seed, |_| 0.0).noise();
                    let ratio = noise / (factor * STATED);
                    assert!(
                        (0.5..2.5).contains(&ratio),
                        "noise {factor}, drift {rate}: {ratio} (seed {seed})"
                    );
                    let found = walk / (factor * STATED * PERIOD).sqrt();
                    let expected = if rate < 0.1 {
                        0.0..0.2
                    } else {
                        0.3 * rate..3.0 * rate
                    };
                    assert!(
                        expected.contains(&found),
                        "noise {factor}, drift {rate}: {found} (seed {seed})"
                    );
                }
            }
        }
    }

    #[test]
    fn the_initial_noise_is_large_and_falls_quickly() {
        let (noise, walk) = NoiseTracker::new(STATED, PERIOD).noise();
        assert!(noise > 1e3 * STATED && walk > (STATED * PERIOD).sqrt());
        // The estimate falls within some seconds.
        assert!(after(10, 1.0, 0.01, 1, |_| 0.0).noise().0 < 30.0 * STATED);
    }

    #[test]
    fn a_push_of_any_length_is_no_noise_but_a_noisy_sensor_is() {
        let pushed = |from: usize, to: usize| {
            move |second| {
                if (from..to).contains(&second) {
                    30.0
                } else {
                    0.0
                }
            }
        };
        let quiet = after(100, 1.0, 0.01, 3, |_| 0.0).noise().0;
        for to in [102, 130, 220] {
            let noise = after(to, 1.0, 0.01, 3, pushed(100, to)).noise().0;
            // The noise over two minutes would be this large if the push were believed.
            assert!(noise < 100.0 * quiet.max(STATED), "{to}: {noise}");
        }
        // Noise with a hundred times the variance is found after half a minute.
        let mut channel = after(60, 1.0, 0.01, 5, |_| 0.0);
        let deviates = normals(6, 40);
        for (second, deviate) in deviates.iter().enumerate() {
            channel.take(&SecondMean {
                t: 60.0 + second as f64,
                mean: 11.0 + (100.0 * STATED * PERIOD).sqrt() * deviate,
                count: 100.0,
                of_bodies: 0.0,
                scatter: STATED,
                is_moving: true,
            });
        }
        assert!(channel.noise().0 > 30.0 * STATED);
    }

    /// Readings come back, after a pause, in the midst of a push, which then ends.
    #[test]
    fn a_push_that_the_filters_begin_in_leaves_no_noise() {
        for seed in 1..=5 {
            let mut channel = after(100, 1.0, 0.01, seed, |_| 0.0);
            for (second, deviate) in normals(seed + 10, 40).iter().enumerate() {
                let push = if second < 3 { 3.0 } else { 0.0 };
                channel.take(&SecondMean {
                    t: 110.0 + second as f64,
                    mean: 11.0 + push + (STATED * PERIOD).sqrt() * deviate,
                    count: 100.0,
                    of_bodies: 0.0,
                    scatter: STATED,
                    is_moving: true,
                });
            }
            let (noise, drift) = channel.noise();
            assert!(noise < 3.0 * STATED, "{noise}, seed {seed}");
            assert!(drift < 0.1, "{drift}, seed {seed}");
        }
    }

    /// Motion overrides the noise estimate at rest within a few seconds.
    #[test]
    fn rest_says_little_of_the_noise_in_motion() {
        let mut channel = NoiseTracker::new(STATED, PERIOD);
        let deviates = normals(7, 70);
        for (second, deviate) in deviates.iter().enumerate() {
            let is_moving = second >= 60;
            let factor = if is_moving { 3e3 } else { 1.0 };
            channel.take(&SecondMean {
                t: second as f64,
                mean: (factor * STATED * PERIOD).sqrt() * deviate,
                count: 100.0,
                of_bodies: 0.0,
                scatter: STATED,
                is_moving,
            });
        }
        assert!(
            channel.noise().0 > 500.0 * STATED,
            "{}",
            channel.noise().0 / STATED
        );
    }

    #[test]
    fn the_uncertainty_of_the_bodies_is_no_noise() {
        let mut sure = NoiseTracker::new(STATED, PERIOD);
        let mut unsure = sure.clone();
        for (second, deviate) in normals(8, 60).iter().enumerate() {
            for (channel, of_bodies) in [(&mut sure, 0.0), (&mut unsure, 0.04)] {
                channel.take(&SecondMean {
                    t: second as f64,
                    mean: 0.2 * deviate,
                    count: 100.0,
                    of_bodies,
                    scatter: STATED,
                    is_moving: true,
                });
            }
        }
        assert!(
            sure.noise().0 > 20.0 * unsure.noise().0,
            "{:?} {:?}",
            sure.noise(),
            unsure.noise()
        );
    }

    #[test]
    fn a_jump_is_no_noise_and_a_shift_moves_the_offset() {
        let second = |t: f64, mean: f64| SecondMean {
            t,
            mean,
            count: 100.0,
            of_bodies: 0.0,
            scatter: STATED,
            is_moving: true,
        };
        let deviates = normals(9, 200);
        let mut channels = [(); 3].map(|()| NoiseTracker::new(STATED, PERIOD));
        for (number, deviate) in deviates.iter().enumerate() {
            let (t, is_later) = (number as f64, number >= 100);
            let mean = 0.008 * deviate + if is_later { 5.0 } else { 0.0 };
            let [paused, shifted, jumped] = &mut channels;
            paused.take(&second(if is_later { t + 5.0 } else { t }, mean));
            if number == 100 {
                shifted.shift(5.0);
            }
            shifted.take(&second(t, mean));
            jumped.take(&second(t, mean));
        }
        let [paused, shifted, jumped] = channels.map(|channel| channel.noise().0 / STATED);
        assert!(
            paused < 3.0 && shifted < 3.0 && jumped < 3.0,
            "{paused} {shifted} {jumped}"
        );
    }

    #[test]
    fn the_variance_of_a_reading_has_scatter_and_drift() {
        let quiet = after(100, 1.0, 0.01, 1, |_| 0.0).reading();
        assert!((1.0..1.3).contains(&(quiet / STATED)), "{quiet}");
        let loud = after(100, 100.0, 0.01, 1, |_| 0.0).reading();
        assert!((70.0..130.0).contains(&(loud / STATED)), "{loud}");
    }

    fn residuals((mean, scatter): (f64, f64)) -> SecondResiduals {
        SecondResiduals {
            mean,
            scatter,
            is_likely_noise: true,
        }
    }

    /// The worst scatter after seconds of a mean and a scatter, on three axes of which the second
    /// is quiet and the third is not measured.
    fn worst(seconds: &[(f64, f64)]) -> f64 {
        let mut axes = [(); 3].map(|()| NoiseTracker::new(STATED, PERIOD));
        for second in seconds {
            let all = [*second, (0.0, STATED), (f64::NAN, f64::NAN)];
            take_scatters(&mut axes, &all.map(residuals));
        }
        axes[0].worst()
    }

    #[test]
    fn what_one_axis_shows_as_a_push_counts_as_noise_on_none() {
        let mut axes = [(); 2].map(|()| NoiseTracker::new(STATED, PERIOD));
        for _ in 0..3 {
            take_scatters(&mut axes, &[(20.0, 1.0), (0.0, 100.0)].map(residuals));
        }
        assert_eq!(axes[1].worst(), 0.0);
        // Too short a push to fill a second: its mean is no likely noise.
        let (quiet, short) = ((0.0, STATED), (8.0, 96.0));
        for second in [quiet, quiet, short, quiet] {
            let mut second = [second, quiet].map(residuals);
            second[0].is_likely_noise = second[0].mean == 0.0;
            take_scatters(&mut axes, &second);
        }
        assert!(axes[0].worst() <= STATED, "{}", axes[0].worst());
    }

    #[test]
    fn a_noisy_second_counts_at_once_and_fades_but_a_push_does_not() {
        let (quiet, noisy) = ((0.0, STATED), (0.0, 100.0));
        assert_eq!(worst(&[quiet, noisy]), 100.0);
        let later = [&[quiet, noisy][..], &[quiet; 11]].concat();
        assert!((30.0..40.0).contains(&worst(&later)), "{}", worst(&later));
        // A push of 20 from some part of a second on, and one that ends there.
        for part in [0.1, 0.4, 0.6, 0.9] {
            let edge = (20.0 * part, 400.0 * part * (1.0 - part));
            let during = (20.0, 1.0);
            for seconds in [
                [quiet, quiet, edge, during, during],
                [during, during, edge, quiet, quiet],
            ] {
                let found = worst(&seconds);
                assert!(found <= STATED, "{part}: {found}");
            }
        }
    }
}
