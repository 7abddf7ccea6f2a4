//! The samples of one channel, and its value at any time.

use crate::arithmetic::add_multiple;
use crate::dataset::smooth::{Scratch, Smoother};
use proprio_topics::{Nanos, Reason};

/// The samples of one channel, `D` numbers each, with strictly increasing stamps.
#[derive(Debug, Clone, Default)]
pub(crate) struct SampleStream<const D: usize> {
    pub(crate) t: Vec<Nanos>,
    pub(crate) value: Vec<Values<D>>,
    /// Samples that their device or quality bits mark as faulty; excluded from the above.
    pub(crate) faulty: Vec<(Nanos, Reason)>,
    /// Samples further apart than this are separated by a gap.
    pub(crate) max_gap: Nanos,
    /// Median time between samples.
    pub(crate) spacing: Nanos,
}

pub(crate) type Values<const D: usize> = [f64; D];

#[derive(Debug, Clone, Default)]
pub(crate) struct JointTrack {
    pub(crate) position: SampleStream<1>,
    pub(crate) velocity: SampleStream<1>,
    pub(crate) acceleration: SampleStream<1>,
    pub(crate) torque: SampleStream<1>,
}

#[derive(Debug, Clone, Default)]
pub(crate) struct ImuTrack {
    pub(crate) proper_acceleration: SampleStream<3>,
    pub(crate) angular_velocity: SampleStream<3>,
    pub(crate) angular_acceleration: SampleStream<3>,
}

/// The state of a joint at one time.
#[derive(Debug, Clone, Copy)]
pub(crate) struct JointAt {
    pub(crate) motion: [f64; 3],
    pub(crate) torque: f64,
    pub(crate) fault: Reason,
}

impl JointTrack {
    /// At each of these times.
    pub(crate) fn at_all(&self, times: &[Nanos]) -> Vec<JointAt> {
        if self.position.t.is_empty() {
            return Vec::new();
        }
        let is_given = !self.acceleration.t.is_empty();
        let has_velocity = !self.velocity.t.is_empty();
        let of_position = (!has_velocity).then(|| self.position.smoother(0));
        let of_velocity = (has_velocity && !is_given).then(|| self.velocity.smoother(0));
        let mut scratch = Scratch::default();
        let mut derivatives = |smoother: &Smoother, t, orders| {
            let own = smoother.at(t, orders, &mut scratch);
            own.ok_or(Reason::Starting)
        };
        let mut motion = |t: Nanos| -> Result<[f64; 3], Reason> {
            let [mut position] = self.position.mean(t)?;
            let (velocity, mut acceleration) = if let Some(smoother) = &of_position {
                let orders = if is_given || of_velocity.is_some() {
                    0..=1
                } else {
                    0..=2
                };
                let [of_0, of_1, of_2] = derivatives(smoother, t, orders)?;
                position = of_0;
                (of_1, of_2)
            } else {
                (self.velocity.mean(t)?[0], 0.0)
            };
            if is_given {
                acceleration = self.acceleration.mean(t)?[0];
            } else if let Some(smoother) = &of_velocity {
                acceleration = derivatives(smoother, t, 1..=1)?[1];
            }
            Ok([position, velocity, acceleration])
        };
        let mut at = |&t: &Nanos| {
            let torque = self.torque.mean(t);
            let (motion, fault) = match motion(t) {
                Ok(motion) => (motion, Reason::None),
                Err(fault) => ([self.position.nearest(t)[0], 0.0, 0.0], fault),
            };
            JointAt {
                motion,
                torque: torque.map_or(f64::NAN, |[torque]| torque),
                fault,
            }
        };
        times.iter().map(&mut at).collect()
    }
}

/// Least time between observations.
pub(crate) const PERIOD: Nanos = Nanos::from_millis(10);

/// Whether a channel sampled every `spacing` is averaged over blocks of [`PERIOD`].
pub(crate) fn is_dense(spacing: Nanos) -> bool {
    spacing > Nanos::ZERO && spacing.0 < PERIOD.0 / 4 * 3
}

impl<const D: usize> SampleStream<D> {
    pub(crate) fn push(&mut self, t: Nanos, value: Values<D>, fault: Reason) {
        if value.iter().any(|v| v.is_nan()) {
            return;
        }
        if fault == Reason::None {
            self.t.push(t);
            self.value.push(value);
        } else {
            self.faulty.push((t, fault));
        }
    }

    /// Determines the length of a gap, once the stamps are in order: silence for longer than
    /// `max_silence`, or several missing samples.
    pub(crate) fn measure(&mut self, max_silence: Nanos) {
        self.faulty.sort_by_key(|(t, _)| *t);
        let mut spacings: Vec<i64> = self.t.windows(2).map(|w| (w[1] - w[0]).0).collect();
        let middle = spacings.len() / 2;
        self.spacing = if spacings.is_empty() {
            Nanos::ZERO
        } else {
            Nanos(*spacings.select_nth_unstable(middle).1)
        };
        self.max_gap =
            max_silence.min(Nanos(self.spacing.0.saturating_mul(5)).max(Nanos::from_millis(30)));
    }

    /// Keeps some samples, by number and stamp.
    pub(crate) fn retain(&mut self, keep: impl Fn(usize, Nanos) -> bool) {
        let samples = self.t.iter().enumerate();
        let kept: Vec<bool> = samples.map(|(i, t)| keep(i, *t)).collect();
        let mut flags = kept.iter();
        self.t.retain(|_| *flags.next().unwrap_or(&true));
        let mut flags = kept.iter();
        self.value.retain(|_| *flags.next().unwrap_or(&true));
    }

    pub(crate) fn column(&self, axis: usize) -> Vec<f64> {
        self.value.iter().map(|v| v[axis]).collect()
    }

    pub(crate) fn smoother(&self, axis: usize) -> Smoother {
        Smoother::new(&self.t, &self.column(axis), self.max_gap)
    }

    pub(crate) fn nearest(&self, t: Nanos) -> Values<D> {
        let after = self.t.partition_point(|s| *s <= t);
        let after = after.min(self.t.len().saturating_sub(1));
        let before = after.saturating_sub(1);
        match (self.t.get(before), self.t.get(after)) {
            (Some(a), Some(b)) => self.value[if t - *a < *b - t { before } else { after }],
            _ => [0.0; D],
        }
    }

    /// The values from one stamp to the other.
    pub(crate) fn within(&self, from: Nanos, to: Nanos) -> &[Values<D>] {
        let begin = self.t.partition_point(|t| *t < from);
        let end = self.t.partition_point(|t| *t <= to);
        &self.value[begin..end.max(begin)]
    }

    /// The first fault between `from` and `to`.
    pub(crate) fn faulty(&self, from: Nanos, to: Nanos) -> Option<Reason> {
        let at = self.faulty.partition_point(|(t, _)| *t < from);
        let next = self.faulty.get(at).filter(|(t, _)| *t <= to);
        next.map(|(_, reason)| *reason)
    }

    /// The value at `t`: the mean over [`PERIOD`] for a faster channel, else a sample or an
    /// interpolation.
    pub(crate) fn mean(&self, t: Nanos) -> Result<Values<D>, Reason> {
        let (Some(first), Some(last)) = (self.t.first(), self.t.last()) else {
            let first = self.faulty.first();
            return Err(first.map_or(Reason::NeverSeen, |(_, reason)| *reason));
        };
        let after = self.t.partition_point(|s| *s <= t);
        let fault = || self.faulty(t - self.max_gap, t + self.max_gap);
        if t < *first || t > *last {
            return Err(fault().unwrap_or(Reason::Stale));
        }
        // `after` is at least 1: the first sample is not later than t.
        let before = after - 1;
        let half = if is_dense(self.spacing) {
            Nanos(PERIOD.0 / 2).min(t - *first).min(*last - t)
        } else {
            Nanos::ZERO
        };
        let (low, high) = (t - half, t + half);
        let begin = self.t.partition_point(|s| *s <= low) - 1;
        let end = self.t.partition_point(|s| *s < high).min(self.t.len() - 1);
        let mut pairs = self.t[begin..=end].windows(2);
        let apart = pairs.any(|w| w[1] - w[0] > self.max_gap);
        if let Some(reason) = self.faulty(self.t[begin], self.t[end]) {
            return Err(reason);
        }
        if apart {
            return Err(Reason::Stale);
        }
        if half == Nanos::ZERO {
            return Ok(if self.t[before] == t {
                self.value[before]
            } else {
                self.between(before, t)
            });
        }
        // Trapezoids under the straight lines between low, the samples in between, and high.
        let (mut sum, mut from, mut value) = ([0.0; D], low, self.line(begin, low));
        for i in begin + 1..=end {
            let to = self.t[i].min(high);
            let next = if to == self.t[i] {
                self.value[i]
            } else {
                self.line(i - 1, high)
            };
            let weight = 0.5 * (to - from).seconds();
            for (sum, (a, b)) in sum.iter_mut().zip(value.iter().zip(&next)) {
                *sum += weight * (a + b);
            }
            (from, value) = (to, next);
        }
        Ok(sum.map(|sum| sum / (high - low).seconds()))
    }

    /// The cubic through sample `i`, the next, and their neighbours, at `t`. The straight line if
    /// neighbours are missing, beyond a gap, or so unevenly spaced that the cubic would be noisier
    /// than a sample.
    pub(crate) fn between(&self, i: usize, t: Nanos) -> Values<D> {
        /// Greatest ratio of neighbouring spacings.
        const UNEVEN: f64 = 2.0;
        let (Some(a), Some(b)) = (self.t.get(i), self.t.get(i + 1)) else {
            return self.value[i];
        };
        let spacing = (*b - *a).seconds();
        let even = |from: Nanos, to: Nanos| {
            to - from <= self.max_gap
                && (spacing / UNEVEN..=spacing * UNEVEN).contains(&(to - from).seconds())
        };
        let around = i
            .checked_sub(1)
            .and_then(|before| Some((self.t.get(before..i + 3)?, self.value.get(before..i + 3)?)));
        let (stamps, values) = match around {
            Some((stamps, values))
                if even(stamps[0], *a)
                    && even(*b, stamps[3])
                    && self.faulty(stamps[0], stamps[3]).is_none() =>
            {
                (stamps, values)
            }
            _ => return self.line(i, t),
        };
        let x = [0, 1, 2, 3].map(|k| (stamps[k] - t).seconds());
        let mut sum = [0.0; D];
        for (weight, value) in cubic(x, 0.0).iter().zip(values) {
            add_multiple(&mut sum, *weight, value);
        }
        sum
    }

    /// The straight line from sample `i` to the next, at `t`.
    pub(crate) fn line(&self, i: usize, t: Nanos) -> Values<D> {
        let (Some(a), Some(b)) = (self.t.get(i), self.t.get(i + 1)) else {
            return self.value[i];
        };
        let share = (t - *a).seconds() / (*b - *a).seconds();
        std::array::from_fn(|k| {
            self.value[i][k] + share * (self.value[i + 1][k] - self.value[i][k])
        })
    }
}

/// Lagrange weights at `t` of four samples at `x`, for the cubic through them.
fn cubic(x: [f64; 4], t: f64) -> [f64; 4] {
    let d = x.map(|x| t - x);
    [
        d[1] * d[2] * d[3] / ((x[0] - x[1]) * (x[0] - x[2]) * (x[0] - x[3])),
        d[0] * d[2] * d[3] / ((x[1] - x[0]) * (x[1] - x[2]) * (x[1] - x[3])),
        d[0] * d[1] * d[3] / ((x[2] - x[0]) * (x[2] - x[1]) * (x[2] - x[3])),
        d[0] * d[1] * d[2] / ((x[3] - x[0]) * (x[3] - x[1]) * (x[3] - x[2])),
    ]
}

impl<const D: usize> SampleStream<D> {
    /// Appends the samples that follow these.
    pub(crate) fn append(&mut self, next: &mut Self) {
        self.t.append(&mut next.t);
        self.value.append(&mut next.value);
        self.faulty.append(&mut next.faulty);
    }
}

/// Least range of a joint that counts as motion, besides a few encoder steps \[rad or m\].
pub(crate) const MOTION: f64 = 0.01;

pub(crate) fn range(values: impl Iterator<Item = f64>) -> f64 {
    let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| {
        (l.min(v), h.max(v))
    });
    (high - low).max(0.0)
}

impl ImuTrack {
    /// Proper acceleration, angular velocity, angular acceleration.
    pub(crate) fn all(&mut self) -> [&mut SampleStream<3>; 3] {
        [
            &mut self.proper_acceleration,
            &mut self.angular_velocity,
            &mut self.angular_acceleration,
        ]
    }
}

impl JointTrack {
    /// Position, velocity, acceleration, torque.
    pub(crate) fn all(&mut self) -> [&mut SampleStream<1>; 4] {
        [
            &mut self.position,
            &mut self.velocity,
            &mut self.acceleration,
            &mut self.torque,
        ]
    }

    /// The range of positions from `from` to `to`.
    pub(crate) fn range(&self, from: Nanos, to: Nanos) -> f64 {
        range(self.position.within(from, to).iter().map(|[v]| *v))
    }
}
