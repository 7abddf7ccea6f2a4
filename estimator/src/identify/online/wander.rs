//! How fast an F/T offset wanders, told from its own channel.
//!
//! ```text
//! o_k+1 = o_k + w_k,   w_k ~ N(0, q^2 dt)        the offset, a random walk of the rate q [N/s^1/2, Nm/s^1/2]
//! y_k   = o_k + v_k,   v_k ~ N(0, r_k)           what the channel reads in the mean over a second, less what the bodies explain
//! ```
//!
//! For each of some rates a Kalman filter of one state gives the likelihood of the innovations `y_k - o_k|k-1`. Old ones fade, so that a sensor that has warmed up is trusted
//! again. The rate is the geometric mean of all, weighted by likelihood and by a wide prior about [`GUESS`]: between the least and the greatest of them by construction.
//!
//! Source: the local level model, A. C. Harvey, "Forecasting, structural time series models and the Kalman filter", 1989, chapter 2.

/// What is supposed before anything is known, in standard deviations of the channel's noise in a second.
pub(super) const GUESS: f64 = 0.1;
/// The rates, in the same unit.
const RATES: [f64; 7] = [0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0];
/// The prior's standard deviation, in powers of e: a factor of three.
const SPREAD: f64 = 1.1;
/// How long an innovation counts [s].
const MEMORY: f64 = 300.0;
/// After a pause of so long the filters begin afresh: what happened meanwhile may have been a contact [s].
const PAUSE: f64 = 3.0;

/// One channel's walk.
#[derive(Clone, Debug)]
pub(super) struct Walk {
    /// The unit of the rates: the standard deviation of the channel's noise.
    unit: f64,
    /// When the last mean was taken [s]; none: the filters begin with the next.
    last: Option<f64>,
    /// Per rate: the offset, its variance, the logarithm of the likelihood.
    filters: [(f64, f64, f64); RATES.len()],
}

impl Walk {
    pub(super) fn new(unit: f64) -> Self {
        Self {
            unit,
            last: None,
            filters: [(0.0, 0.0, 0.0); RATES.len()],
        }
    }

    /// What comes next has nothing to do with what was.
    pub(super) fn interrupt(&mut self) {
        self.last = None;
    }

    /// Takes what the channel reads in the mean about `t` [s], with the variance of that.
    pub(super) fn take(&mut self, t: f64, apparent: f64, variance: f64) {
        if !(apparent.is_finite() && variance.is_finite() && variance > 0.0) {
            return;
        }
        let since = self
            .last
            .replace(t)
            .map(|last| t - last)
            .filter(|dt| (0.0..PAUSE).contains(dt));
        for ((offset, own, likelihood), rate) in self.filters.iter_mut().zip(RATES) {
            let Some(dt) = since else {
                (*offset, *own) = (apparent, variance);
                continue;
            };
            *own += (rate * self.unit).powi(2) * dt;
            let (total, innovation) = (*own + variance, apparent - *offset);
            let gain = *own / total;
            *offset += gain * innovation;
            *own *= 1.0 - gain;
            *likelihood *= (-dt / MEMORY).exp();
            *likelihood -= 0.5 * (total.ln() + innovation * innovation / total);
        }
    }

    /// The rate: standard deviation of a second of drift, in the channel's unit.
    pub(super) fn rate(&self) -> f64 {
        let score = |(filter, rate): (&(f64, f64, f64), f64)| {
            let apart = (rate / GUESS).ln() / SPREAD;
            filter.2 - 0.5 * apart * apart
        };
        let best = self
            .filters
            .iter()
            .zip(RATES)
            .map(score)
            .fold(f64::NEG_INFINITY, f64::max);
        let (mut sum, mut weights) = (0.0, 0.0);
        for (filter, rate) in self.filters.iter().zip(RATES) {
            let weight = (score((filter, rate)) - best).exp();
            sum += weight * rate.ln();
            weights += weight;
        }
        self.unit * (sum / weights).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two numbers from a normal distribution (Box, Muller), seeded.
    fn normal(state: &mut u64) -> f64 {
        let mut uniform = || {
            *state = state
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            ((*state >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
        };
        (-2.0 * uniform().ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos()
    }

    /// What is found of a walk at `rate` after so many seconds, means having the deviation `noise`; all in units of 0.08.
    fn found(rate: f64, noise: f64, seconds: u32, seed: u64) -> f64 {
        let (mut walk, mut state, mut offset) = (Walk::new(0.08), seed, 11.0);
        for second in 0..seconds {
            offset += 0.08 * rate * normal(&mut state);
            walk.take(
                f64::from(second),
                offset + 0.08 * noise * normal(&mut state),
                (0.08 * noise).powi(2),
            );
        }
        walk.rate() / 0.08
    }

    #[test]
    fn rates_over_three_decades_are_found_within_a_factor_of_two() {
        for seed in 1..=20 {
            for rate in [0.03, 0.1, 0.3, 1.0, 3.0] {
                let got = found(rate, 0.1, 600, seed);
                assert!(got / rate > 0.5 && got / rate < 2.0, "{rate} {got} (seed {seed})");
            }
        }
    }

    #[test]
    fn rates_are_bounded_and_nothing_is_made_of_nothing() {
        let nothing = Walk::new(0.08).rate() / 0.08;
        assert!((0.05..0.4).contains(&nothing), "{nothing}");
        assert!((5.0..10.001).contains(&found(1000.0, 0.1, 100, 1)));
        assert!((0.009..0.03).contains(&found(0.0, 0.1, 5000, 1)));
        // Noise that hides a walk tells nothing of it.
        let hidden = found(0.1, 30.0, 300, 1);
        assert!((hidden / nothing).ln().abs() < 0.7, "{hidden} {nothing}");
    }

    #[test]
    fn a_jump_across_a_pause_is_no_drift() {
        let (mut walk, mut state) = (Walk::new(1.0), 5);
        for second in 0..400 {
            // A contact of five seconds, and the offset elsewhere after it.
            let (t, level) = (
                f64::from(second) + if second < 200 { 0.0 } else { 5.0 },
                if second < 200 { 0.0 } else { 500.0 },
            );
            walk.take(t, level + 0.1 * normal(&mut state), 0.01);
        }
        assert!(walk.rate() < 0.1, "{}", walk.rate());
        // Without the pause it is.
        let mut jumping = Walk::new(1.0);
        (0..20).for_each(|second| jumping.take(f64::from(second), if second < 10 { 0.0 } else { 500.0 }, 0.01));
        assert!(jumping.rate() > 5.0, "{}", jumping.rate());
    }
}
