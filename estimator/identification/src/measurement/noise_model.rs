//! The noise of all channels: its white and slow parts, and the drift rates of the offsets.

use crate::measurement::unknowns::Unknowns;
use proprio_topics::Nanos;
use std::collections::BTreeMap;

/// The noise of all channels.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct NoiseModel {
    /// Per channel: mean square of the residual without the drifting offset.
    pub square: Vec<f64>,
    /// Per channel: integrated autocorrelation time of that residual, in observations.
    pub time: Vec<f64>,
    /// Per channel: rate of the offset's random walk [unit^2/s].
    pub drift_variance: Vec<f64>,
    /// Per channel: variance of a row for which block means have the variance that was found for
    /// them beside the random walk.
    pub block: Vec<f64>,
    /// Per channel: lower limit of its variance.
    pub least: Vec<f64>,
    /// Factors of the F/T channels' variances, per second of the training logs.
    pub seconds: Seconds,
}

impl NoiseModel {
    /// The initial model: far above the lower limits, in their proportions.
    pub(crate) fn unknown(least: Vec<f64>) -> Self {
        let channels = least.len();
        let start: Vec<f64> = least.iter().map(|least| 1e6 * least).collect();
        Self {
            square: start.clone(),
            time: vec![1.0; channels],
            drift_variance: vec![0.0; channels],
            block: start,
            least,
            seconds: Seconds::default(),
        }
    }

    /// Variances with which correlated rows may count as independent. They are used for estimating
    /// parameters.
    pub(crate) fn inflated(&self) -> Vec<f64> {
        let correlated = |c: usize| self.square[c] * self.time[c];
        (0..self.square.len())
            .map(|c| correlated(c).max(self.block[c]).max(self.least[c]))
            .collect()
    }

    /// Variances for tracking the offsets.
    pub(crate) fn offset_tracking_variances(&self) -> Vec<f64> {
        let pairs = self.block.iter().zip(&self.least);
        pairs.map(|(block, least)| block.max(*least)).collect()
    }

    /// The mean of this model, from the data that the parameters were fitted to, and one from
    /// held-out data. To first order in the number of parameters, the first is below the noise by
    /// as much as the second is above it, since held-out residuals contain the parameters' errors.
    /// The drift rates are those of this model.
    pub(crate) fn cross_validated_noise(&self, held_out: &Self) -> Self {
        let mut midway = self.clone();
        let (own, others) = (self.inflated(), held_out.inflated());
        for (channel, time) in midway.time.iter_mut().enumerate() {
            // Channels that are absent from the held-out data keep their noise.
            if self.square[channel] > 0.0 && held_out.square[channel] > 0.0 {
                *time = 0.5 * (own[channel] + others[channel]) / self.square[channel];
            }
        }
        midway
    }

    /// The greatest relative change of a variance.
    pub(crate) fn change(&self, other: &Self) -> f64 {
        let pairs = self.inflated().into_iter().zip(other.inflated());
        pairs.map(|(x, y)| (x / y).ln().abs()).fold(0.0, f64::max)
    }

    /// Ends a limit cycle of the iteration between noise and fit. If an earlier model is like the
    /// newest (no variance changed by more than `within`, see [`NoiseModel::change`]), the result
    /// has for each channel the greatest noise in between, so that no uncertainty is stated too
    /// small. None if there is no cycle.
    pub(crate) fn end_limit_cycle(rounds: &[Self], within: f64) -> Option<Self> {
        let (newest, before) = rounds.split_last()?;
        let is_alike = |other: &Self| newest.change(other) < within;
        let back = before.iter().rposition(is_alike)?;
        let mut greatest = newest.clone();
        for other in &before[back + 1..] {
            let (own, others) = (greatest.inflated(), other.inflated());
            for channel in (0..own.len()).filter(|&channel| others[channel] > own[channel]) {
                greatest.square[channel] = other.square[channel];
                greatest.time[channel] = other.time[channel];
                greatest.drift_variance[channel] = other.drift_variance[channel];
                greatest.block[channel] = other.block[channel];
            }
        }
        Some(greatest)
    }

    /// The geometric mean of the ratio of another model's variances to this model's, over these
    /// channels, in the mean of all seconds.
    pub(crate) fn variance_ratio(
        &self,
        other: &Self,
        unknowns: &Unknowns,
        channels: &[usize],
    ) -> f64 {
        let (own, others) = (self.inflated(), other.inflated());
        let of_seconds = (other.seconds.mean() / self.seconds.mean()).ln();
        let of_channel = |&c: &usize| {
            let varies = c < unknowns.wrenches();
            (others[c] / own[c]).ln() + if varies { of_seconds } else { 0.0 }
        };
        let sum: f64 = channels.iter().map(of_channel).sum();
        (sum / channels.len().max(1) as f64).exp()
    }

    /// Variances of the steps of all nuisance parameters over this time.
    pub(crate) fn steps(&self, unknowns: &Unknowns, seconds: f64) -> Vec<f64> {
        let mut variances = vec![0.0; unknowns.nuisance()];
        for (channel, rate) in self.drift_variance.iter().enumerate() {
            variances[unknowns.offset_of(channel)] = rate * seconds;
        }
        variances
    }
}

/// The factor of the F/T channels' variances in each second of the training logs.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Seconds(pub(crate) BTreeMap<(usize, i64), f64>);

impl Seconds {
    /// The mean of all factors.
    fn mean(&self) -> f64 {
        match self.0.len() {
            0 => 1.0,
            count => self.0.values().sum::<f64>() / count as f64,
        }
    }

    /// The factor at an instant of a training log; 1 elsewhere.
    pub(crate) fn factor(&self, log: Option<usize>, t: Nanos) -> f64 {
        let known = log.and_then(|log| self.0.get(&(log, second(t))));
        known.copied().unwrap_or(1.0)
    }
}

impl NoiseModel {
    /// These variances at an instant: those of the F/T channels times the factor of its second.
    pub(crate) fn at(
        &self,
        unknowns: &Unknowns,
        variances: &[f64],
        (log, t): (Option<usize>, Nanos),
    ) -> Vec<f64> {
        let (mut own, factor) = (variances.to_vec(), self.seconds.factor(log, t));
        own[..unknowns.wrenches()]
            .iter_mut()
            .for_each(|x| *x *= factor);
        own
    }
}

/// The second of an instant, as [`Seconds`] counts them.
pub(crate) fn second(t: Nanos) -> i64 {
    t.0.div_euclid(1_000_000_000)
}
