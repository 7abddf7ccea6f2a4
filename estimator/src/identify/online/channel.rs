//! How much an F/T channel's noise is and how fast its offset wanders, told from its own readings.
//!
//! ```text
//! o_k+1 = o_k + w_k,   w_k ~ N(0, q^2 dt)         the offset, a random walk of the rate q [N/s^1/2, Nm/s^1/2]
//! y_k   = o_k + v_k,   v_k ~ N(0, V / n + b_k)    the channel's mean over second k, less what the bodies explain
//! ```
//!
//! `V` is the variance of one of the second's `n` instants that would give its mean this variance
//! if they were independent: it holds the sensor's noise, its autocorrelation, stamps' jitter,
//! vibration, and whatever else the model lacks. `b_k` is what the bodies' own uncertainty makes of
//! the mean. The bodies are those known *before* the second: its readings have had no say in them,
//! so that a fit which is too close to its data does not show as little noise.
//!
//! For each of some pairs `(V, q)` a Kalman filter of one state gives the likelihood of the
//! innovations `y_k - o_k|k-1`. A second in which something undeclared acts is no noise: each
//! innovation is of a mixture, a share [`DISTURBED`] of them being anything within [`RANGE`]. The
//! pairs' likelihoods and a prior weigh the estimates of `V` and `q^2`. Before anything is known
//! `V` is hundreds of times what the sensor was stated to have: readings are not believed before
//! their noise has shown.
//!
//! Source: the local level model, A. C. Harvey, "Forecasting, structural time series models and the
//! Kalman filter", 1989, chapter 2.

/// The noise's grid: `V` by the stated variance, in half decades, `10^0 ... 10^5`. Beyond that what
/// is read is no noise: on a real leg 10^4 is the greatest found.
const LEVELS: usize = 11;
/// The walk's grid: `q` by the standard deviation of a second's mean, `(V dt)^1/2`. At 1 the offset
/// follows in about a second, and as in identification from logs it may be no faster, or it would
/// follow the motion that identifies.
const RATES: [f64; 5] = [0.01, 0.03, 0.1, 0.3, 1.0];
/// The walk's prior: log-normal about this, its standard deviation a factor of three.
const RATE: f64 = 0.1;
const SPREAD: f64 = 1e3;
/// How long an innovation counts \[s\].
const MEMORY: f64 = 60.0;
/// After a pause of so long the filters begin afresh: what happened meanwhile may have been a
/// contact \[s\].
const PAUSE: f64 = 3.0;
/// The share of seconds in which something undeclared is supposed to act, and up to what it does
/// then, in stated standard deviations: all of it as likely.
const DISTURBED: f64 = 0.02;
const RANGE: f64 = 1000.0;
/// Rest tells the noise of motion at odds of no more than twenty: `e^3`.
const AT_REST: f64 = 3.0;

/// The correlation of innovations in a row before it is known, and how many seconds' worth that
/// counts.
const CORRELATED: (f64, f64) = (0.0, 10.0);

/// An innovation counts as no larger, in standard deviations, and no correlation as greater.
const LARGE: f64 = 3.0;
const GREATEST: f64 = 0.9;

/// One filter: offset, its variance, logarithm of the likelihood.
#[derive(Clone, Copy, Debug, Default)]
struct Filter {
    offset: f64,
    variance: f64,
    likelihood: f64,
}

/// A second of a channel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Second {
    /// Its middle \[s\].
    pub t: f64,
    /// What the channel reads in the mean, less what the bodies explain.
    pub mean: f64,
    /// How many instants that is the mean of.
    pub count: f64,
    /// Variance of the mean by what is uncertain of the bodies.
    pub of_bodies: f64,
    /// Mean square of its instants about their mean.
    pub scatter: f64,
    /// Whether something moved.
    pub is_moving: bool,
}

/// One channel's noise and walk.
#[derive(Clone, Debug)]
pub(super) struct Channel {
    /// The stated variance of an instant.
    stated: f64,
    /// The time between instants \[s\].
    period: f64,
    /// When the last second was \[s\]; none: the filters begin with the next.
    last: Option<f64>,
    filters: [[Filter; RATES.len()]; LEVELS],
    /// Normalised innovation of the likeliest filter, the mean product of two in a row, the mean
    /// square.
    innovation: f64,
    products: (f64, f64),
    /// Mean square of instants about the mean of their second; none before the first.
    scatter: Option<f64>,
}

impl Channel {
    pub(super) fn new(stated: f64, period: f64) -> Self {
        Self {
            stated,
            period,
            last: None,
            filters: [[Filter::default(); RATES.len()]; LEVELS],
            innovation: f64::NAN,
            products: (CORRELATED.0 * CORRELATED.1, CORRELATED.1),
            scatter: None,
        }
    }

    /// `V` of a level.
    fn level(&self, number: usize) -> f64 {
        self.stated * 10f64.powf(0.5 * number as f64)
    }

    /// Puts the offset elsewhere by so much: the bodies that it is told with are others.
    pub(super) fn shift(&mut self, by: f64) {
        self.filters
            .as_flattened_mut()
            .iter_mut()
            .for_each(|filter| filter.offset += by);
    }

    /// What comes next has nothing to do with what was.
    pub(super) fn interrupt(&mut self) {
        self.last = None;
    }

    /// Takes a second in.
    pub(super) fn take(&mut self, second: &Second) {
        if !(second.mean.is_finite() && second.of_bodies.is_finite() && second.count > 0.0) {
            return;
        }
        let since = (self.last.replace(second.t))
            .map(|last| second.t - last)
            .filter(|dt| (0.0..PAUSE).contains(dt));
        let levels: [f64; LEVELS] = std::array::from_fn(|number| self.level(number));
        let disturbed = DISTURBED / (RANGE * self.stated.sqrt());
        // Of the most likely: the innovation, and the share of noise in it.
        let mut best = (f64::NEG_INFINITY, (f64::NAN, 1.0));
        for (row, level) in self.filters.iter_mut().zip(levels) {
            let noise = level / second.count + second.of_bodies;
            for (filter, rate) in row.iter_mut().zip(RATES) {
                let innovation = match since {
                    None => {
                        (filter.offset, filter.variance) = (second.mean, noise);
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
    }

    /// Variance of one reading about what the model says of it: what scatters within a second, and
    /// what changes from one to the next.
    pub(super) fn reading(&self) -> f64 {
        let slow = self.noise().0 * self.period;
        (self.scatter.unwrap_or(0.0) + slow).max(self.stated)
    }

    /// `V`, and the standard deviation of a second of drift: means over the grid by likelihood and
    /// prior.
    pub(super) fn noise(&self) -> (f64, f64) {
        let best = (self.filters.as_flattened().iter())
            .map(|filter| filter.likelihood)
            .fold(f64::NEG_INFINITY, f64::max);
        let (mut sums, mut weights) = ([0.0; 2], 0.0);
        for (number, row) in self.filters.iter().enumerate() {
            let level = self.level(number);
            for (filter, rate) in row.iter().zip(RATES) {
                let apart = (rate / RATE).ln() / SPREAD;
                let weight = (filter.likelihood - best - 0.5 * apart * apart).exp();
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

impl Filter {
    /// A mean with its variance, `dt` seconds after the last one, in which the offset's variance
    /// grew by `walked`; the density of what is no noise. Returns the innovation, normalised, and
    /// how far it is noise.
    fn take(&mut self, (mean, noise): (f64, f64), walked: f64, dt: f64, disturbed: f64) -> (f64, f64) {
        let grown = self.variance + walked;
        let total = grown + noise;
        let innovation = mean - self.offset;
        let square = innovation * innovation / total;
        let regular = (1.0 - DISTURBED) * (-0.5 * square).exp() / (std::f64::consts::TAU * total).sqrt();
        let share = regular / (regular + disturbed);
        // What is no noise says nothing of the offset, which stands still meanwhile, nor does it
        // make older innovations older.
        let gain = share * grown / total;
        self.offset += gain * innovation;
        self.variance = (self.variance + share * walked) * (1.0 - gain);
        self.likelihood *= (-share * dt / MEMORY).exp();
        self.likelihood += (regular + disturbed).ln();
        (innovation / total.sqrt(), share)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identify::normals;

    const PERIOD: f64 = 0.01;
    const STATED: f64 = 0.0064;

    /// A channel after so many seconds of motion: its noise `factor` times the stated variance, its
    /// walk of rate `q`, in deviations of a second's mean; something acts on it in some of them.
    fn after(seconds: usize, factor: f64, rate: f64, seed: u64, acts: impl Fn(usize) -> f64) -> Channel {
        let mut channel = Channel::new(STATED, PERIOD);
        let deviates = normals(seed, 2 * seconds);
        let deviation = (factor * STATED * PERIOD).sqrt();
        let mut offset = 11.0;
        for second in 0..seconds {
            offset += rate * deviation * deviates[2 * second];
            channel.take(&Second {
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
    fn noise_over_four_decades_is_found_and_a_walk_beside_it() {
        for seed in 1..=5 {
            for factor in [1.0, 30.0, 1e3, 1e4] {
                for rate in [0.01, 0.3, 1.0] {
                    let (noise, walk) = after(300, factor, rate, seed, |_| 0.0).noise();
                    let ratio = noise / (factor * STATED);
                    assert!(
                        (0.5..2.5).contains(&ratio),
                        "noise {factor}, walk {rate}: {ratio} (seed {seed})"
                    );
                    let found = walk / (factor * STATED * PERIOD).sqrt();
                    let expected = if rate < 0.1 { 0.0..0.2 } else { 0.3 * rate..3.0 * rate };
                    assert!(
                        expected.contains(&found),
                        "noise {factor}, walk {rate}: {found} (seed {seed})"
                    );
                }
            }
        }
    }

    #[test]
    fn nothing_is_believed_before_it_has_shown() {
        let (noise, walk) = Channel::new(STATED, PERIOD).noise();
        assert!(noise > 1e3 * STATED && walk > (STATED * PERIOD).sqrt());
        // It shows within some seconds.
        assert!(after(10, 1.0, 0.01, 1, |_| 0.0).noise().0 < 30.0 * STATED);
    }

    #[test]
    fn a_push_is_no_noise_however_long_and_a_sensor_that_is_really_noisy_is() {
        let pushed = |from: usize, to: usize| move |second| if (from..to).contains(&second) { 30.0 } else { 0.0 };
        let quiet = after(100, 1.0, 0.01, 3, |_| 0.0).noise().0;
        for to in [102, 130, 220] {
            let noise = after(to, 1.0, 0.01, 3, pushed(100, to)).noise().0;
            // As a sum over two minutes of it might, were it believed.
            assert!(noise < 100.0 * quiet.max(STATED), "{to}: {noise}");
        }
        // A hundred times louder from some second on: known after half a minute.
        let mut channel = after(60, 1.0, 0.01, 5, |_| 0.0);
        let deviates = normals(6, 40);
        for (second, deviate) in deviates.iter().enumerate() {
            channel.take(&Second {
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

    /// What rest says of the noise is given up within a few seconds of motion.
    #[test]
    fn rest_tells_little_of_motion() {
        let mut channel = Channel::new(STATED, PERIOD);
        let deviates = normals(7, 70);
        for (second, deviate) in deviates.iter().enumerate() {
            let is_moving = second >= 60;
            let factor = if is_moving { 3e3 } else { 1.0 };
            channel.take(&Second {
                t: second as f64,
                mean: (factor * STATED * PERIOD).sqrt() * deviate,
                count: 100.0,
                of_bodies: 0.0,
                scatter: STATED,
                is_moving,
            });
        }
        assert!(channel.noise().0 > 500.0 * STATED, "{}", channel.noise().0 / STATED);
    }

    #[test]
    fn what_the_bodies_may_make_of_a_mean_is_no_noise() {
        let mut sure = Channel::new(STATED, PERIOD);
        let mut unsure = sure.clone();
        for (second, deviate) in normals(8, 60).iter().enumerate() {
            for (channel, of_bodies) in [(&mut sure, 0.0), (&mut unsure, 0.04)] {
                channel.take(&Second {
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
    fn a_jump_across_a_pause_is_no_drift_and_a_shift_moves_what_is_expected() {
        let second = |t: f64, mean: f64| Second {
            t,
            mean,
            count: 100.0,
            of_bodies: 0.0,
            scatter: STATED,
            is_moving: true,
        };
        let deviates = normals(9, 200);
        let mut channels = [(); 3].map(|()| Channel::new(STATED, PERIOD));
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
        assert!(jumped > 3.0, "a jump that nothing explains is no quiet channel");
        assert!(paused < 3.0 && shifted < 3.0, "{paused} {shifted}");
    }

    #[test]
    fn a_reading_is_as_noisy_as_it_scatters_and_its_mean_wanders() {
        let quiet = after(100, 1.0, 0.01, 1, |_| 0.0).reading();
        assert!((1.0..1.3).contains(&(quiet / STATED)), "{quiet}");
        let loud = after(100, 100.0, 0.01, 1, |_| 0.0).reading();
        assert!((70.0..130.0).contains(&(loud / STATED)), "{loud}");
    }
}
