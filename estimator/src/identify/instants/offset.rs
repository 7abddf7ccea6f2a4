//! How late a stream's stamps are against the encoders', from what the encoders and the model predict that it should read.
//!
//! ```text
//! measured(t) = gain * predicted(t - offset) + slowly varying + noise
//! ```
//!
//! Both sides lose what varies more slowly than about a second (a moving average is taken off), so that sensor offsets and most of what is wrong with the model's weights
//! go; the gain of each axis takes up the rest of a wrong weight. The offset maximises the likelihood with the noise of every axis unknown (sum over axes of
//! `n/2 log` of what is left over). Moving samples between their stamps smooths their noise, most half-way, and the half-way would look best: a prediction has noise too, that of
//! accelerations from encoders or of another sensor. So both sides are smoothed alike first, over a few samples, so that neither has anything left that moving could smooth away.
//!
//! The standard deviation is that of a linear fit at the best offset. What is left over there is mostly model error, not noise: as slow as the motion, as the slope of the prediction is, and
//! common to all axes. Its autocorrelation time does not show it (without its slow part a series has next to none, whatever happens at the frequencies of the motion). So what each
//! stretch of the log wants the offset moved by is looked at: their scatter is what the offset is uncertain by, `sqrt(sum s_b^2) / I` for scores `s_b` of the stretches and the
//! information `I` (the sandwich estimator; White 1980, in blocks: Liang, Zeger 1986), if that is more than what noise gives with its autocorrelation time.

use super::{Recording, Stream};
use proprio_topics::Nanos;
use std::collections::BTreeMap;

/// Offsets are looked for within this \[s\].
const WITHIN: f64 = 0.15;
/// Steps of the search \[s\]; a parabola finds the place between them.
const STEP: f64 = 0.005;
/// Half of the moving average that is taken off \[s\].
const SLOW: f64 = 0.5;
/// Stretches of this length \[s\] count as independent in what they want the offset to be.
const STRETCH: f64 = 2.0;
/// Standard deviation of the smoothing of both sides, in samples of the one that has fewer.
const SMOOTH: f64 = 2.0;
/// Significant is what exceeds this many standard deviations ...
const DEVIATIONS: f64 = 4.0;
/// ... and this \[s\]: less than that does no harm and is not worth moving a stream for.
const LEAST: f64 = 0.5e-3;

/// A stream whose stamps are compared with the encoders'.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Signal {
    /// An F/T sensor: six columns, torque first as in [`crate::spatial`], axes of its measurement frame.
    Wrench(usize),
    /// The measured torque of a degree of freedom: one column.
    Torque(usize),
    /// The angular velocity of the base's IMU, in its axes: three columns.
    AngularVelocity,
}

/// How late a stream's stamps are.
#[derive(Debug, Clone, PartialEq)]
pub struct TimeOffset {
    /// The stream.
    pub signal: Signal,
    /// Its channel, for people.
    pub channel: String,
    /// What happens at `t` is stamped `t + seconds`.
    pub seconds: f64,
    /// Its standard deviation \[s\].
    pub deviation: f64,
    /// Whether it is surely not zero, and large enough to matter.
    pub significant: bool,
}

impl Recording {
    /// Compares a stream with what it should read: `predicted` row by row at `times` (strictly increasing, not more than 50 ms apart where it counts), as
    /// many columns as the signal has; rows that are not finite are left out.
    ///
    /// None if there is not enough of either, if too little changes to tell (a standard deviation above 20 ms), or if the best offset is not within 150 ms.
    #[must_use]
    pub fn time_offset(&self, signal: Signal, times: &[Nanos], predicted: &[f64]) -> Option<TimeOffset> {
        use crate::setup::Use;
        let role = match signal {
            Signal::Wrench(sensor) => Use::Sensor(sensor),
            Signal::Torque(dof) => Use::Joint(dof),
            Signal::AngularVelocity => Use::Base,
        };
        let channel = self.channels.iter().find(|c| c.role == role)?;
        let (seconds, deviation) = match signal {
            // Streams hold the force first, as logs do.
            Signal::Wrench(sensor) => estimate(self.sensors.get(sensor)?, [3, 4, 5, 0, 1, 2], times, predicted),
            Signal::Torque(dof) => estimate(&self.joints.get(dof)?.torque, [0], times, predicted),
            Signal::AngularVelocity => estimate(&self.imu.angular_velocity, [0, 1, 2], times, predicted),
        }?;
        Some(TimeOffset {
            signal,
            channel: match signal {
                Signal::Torque(_) => format!("{}/{}/torque", channel.kind.word(), channel.name),
                _ => format!("{}/{}", channel.kind.word(), channel.name),
            },
            seconds,
            deviation,
            significant: seconds.abs() > DEVIATIONS * deviation && seconds.abs() > LEAST,
        })
    }
}

/// One axis over one stretch: measured at the stream's stamps, the prediction on a grid of its own.
struct Axis {
    /// Per measurement: what is left without the slow part, and its stamp \[s\].
    measured: Vec<(f64, f64)>,
}

fn estimate<const D: usize>(
    stream: &Stream<D>,
    order: [usize; D],
    times: &[Nanos],
    predicted: &[f64],
) -> Option<(f64, f64)> {
    let origin = *times.first()?;
    let rows: Vec<(f64, &[f64])> = times
        .iter()
        .zip(predicted.chunks_exact(D))
        .filter(|(_, row)| row.iter().all(|v| v.is_finite()))
        .map(|(t, row)| ((*t - origin).seconds(), row))
        .collect();
    let stamps: Vec<f64> = stream.t.iter().map(|t| (*t - origin).seconds()).collect();
    if rows.len() < 100 || stamps.len() < 100 {
        return None;
    }
    // Where measurement and prediction are both there without a gap, far enough from their ends for every shift tried.
    let at: Vec<f64> = rows.iter().map(|(t, _)| *t).collect();
    let whole = |low: f64, high: f64| {
        let (begin, end) = (at.partition_point(|t| *t <= low), at.partition_point(|t| *t < high));
        begin > 0 && end < at.len() && at[begin - 1..=end].windows(2).all(|w| w[1] - w[0] <= 0.05)
    };
    // At most 100 a second count: more tell nothing new about motion.
    let spacing = stream.spacing.seconds().max(1e-6);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let thin = ((0.01 / spacing).round() as usize).max(1);
    let blocks: Vec<(f64, Vec<f64>)> = (0..stamps.len() / thin)
        .map(|b| {
            let range = b * thin..(b + 1) * thin;
            let n = thin as f64;
            let mean = |k: usize| stream.value[range.clone()].iter().map(|v| v[k]).sum::<f64>() / n;
            (
                stamps[range.clone()].iter().sum::<f64>() / n,
                order.iter().map(|k| mean(*k)).collect(),
            )
        })
        .collect();
    let used: Vec<bool> = blocks
        .iter()
        .map(|(t, _)| whole(t - SLOW - WITHIN, t + SLOW + WITHIN))
        .collect();
    if used.iter().filter(|u| **u).count() < 100 {
        return None;
    }
    let block_times: Vec<f64> = blocks.iter().map(|(t, _)| *t).collect();
    let spacings = |t: &[f64]| super::smooth::median(t.windows(2).map(|w| w[1] - w[0]).collect());
    let width = SMOOTH * spacings(&block_times).max(spacings(&at));
    let axes: Vec<Axis> = (0..D)
        .map(|k| {
            let values: Vec<f64> = blocks.iter().map(|(_, v)| v[k]).collect();
            let values = smoothed(&block_times, &values, width);
            let slow = Slow::new(&block_times, &values);
            let measured = block_times.iter().zip(&values).zip(&used).filter(|(_, used)| **used);
            Axis {
                measured: measured
                    .map(|((t, v), _)| (v - slow.mean(t - SLOW, t + SLOW), *t))
                    .collect(),
            }
        })
        .collect();
    // The prediction without its slow part, at its own instants and between them.
    let columns: Vec<Vec<f64>> = (0..D)
        .map(|k| {
            let column: Vec<f64> = rows.iter().map(|(_, row)| row[k]).collect();
            let column = smoothed(&at, &column, width);
            let slow = Slow::new(&at, &column);
            at.iter()
                .zip(&column)
                .map(|(t, v)| v - slow.mean(t - SLOW, t + SLOW))
                .collect()
        })
        .collect();
    let model = |k: usize, t: f64| {
        let i = at.partition_point(|s| *s <= t).clamp(1, at.len() - 1);
        cubic(&at, &columns[k], i, t)
    };
    let count = axes.first()?.measured.len() as f64;
    // Half the deviance: what all axes leave over at an offset.
    let left = |offset: f64| -> f64 {
        axes.iter()
            .enumerate()
            .map(|(k, axis)| {
                let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
                for (y, t) in &axis.measured {
                    let x = model(k, t - offset);
                    xx += x * x;
                    xy += x * y;
                    yy += y * y;
                }
                // An axis on which nothing happens, or nothing is predicted, says nothing.
                if xx <= 0.0 || yy <= 0.0 {
                    0.0
                } else {
                    0.5 * count * ((yy - xy * xy / xx) / yy).max(1e-12).ln()
                }
            })
            .sum()
    };
    #[allow(clippy::cast_possible_truncation)]
    let steps = (WITHIN / STEP).floor() as i32 - 1;
    let (mut best, mut least) = (0, f64::INFINITY);
    for step in -steps..=steps {
        let value = left(f64::from(step) * STEP);
        if value < least {
            (best, least) = (step, value);
        }
    }
    if best.abs() == steps {
        return None;
    }
    // A parabola through ever closer neighbours.
    let (mut offset, mut step) = (f64::from(best) * STEP, STEP);
    for _ in 0..4 {
        let (a, b, c) = (left(offset - step), left(offset), left(offset + step));
        let curvature = a - 2.0 * b + c;
        if curvature > 0.0 {
            offset += (0.5 * step * (a - c) / curvature).clamp(-step, step);
        }
        step *= 0.3;
    }
    let (mut information, mut plain) = (0.0, 0.0);
    let mut scores: BTreeMap<i64, f64> = BTreeMap::new();
    for (k, axis) in axes.iter().enumerate() {
        let (mut xx, mut xy) = (0.0, 0.0);
        let model: Vec<[f64; 2]> = axis
            .measured
            .iter()
            .map(|(_, t)| {
                [
                    model(k, t - offset),
                    (model(k, t - offset + 1e-3) - model(k, t - offset - 1e-3)) / 2e-3,
                ]
            })
            .collect();
        for ([x, _], (y, _)) in model.iter().zip(&axis.measured) {
            xx += x * x;
            xy += x * y;
        }
        if xx <= 0.0 {
            continue;
        }
        let gain = xy / xx;
        let residual: Vec<f64> = model
            .iter()
            .zip(&axis.measured)
            .map(|([x, _], (y, _))| y - gain * x)
            .collect();
        // A shift changes the signal by its slope; what of that looks like a change of the gain does not count.
        let (mut ss, mut sx) = (0.0, 0.0);
        for [x, slope] in &model {
            ss += slope * slope;
            sx += slope * x;
        }
        let variance = residual.iter().map(|v| v * v).sum::<f64>() / count;
        if variance > 0.0 {
            let told = gain * gain * (ss - sx * sx / xx).max(0.0);
            information += told / inflated_variance(&residual);
            plain += told / variance;
            for (([x, slope], (_, t)), e) in model.iter().zip(&axis.measured).zip(&residual) {
                #[allow(clippy::cast_possible_truncation)]
                let stretch = (t / STRETCH).floor() as i64;
                *scores.entry(stretch).or_default() += gain * (slope - sx / xx * x) * e / variance;
            }
        }
    }
    // One is spent on the offset itself.
    let stretches = scores.len() as f64;
    let scatter = scores.values().map(|s| s * s).sum::<f64>() * stretches / (stretches - 1.0).max(0.5);
    let deviation = information.sqrt().recip().max(scatter.sqrt() / plain);
    (deviation < 0.02).then_some((offset, deviation))
}

/// The variance of a series times its integrated autocorrelation time, `1 + 2 sum rho_k`, summed until `k` exceeds six times it.
fn inflated_variance(series: &[f64]) -> f64 {
    let n = series.len() as f64;
    let variance = series.iter().map(|v| v * v).sum::<f64>() / n;
    let mut time = 1.0;
    for lag in 1..series.len() / 4 {
        let product: f64 = series.iter().zip(&series[lag..]).map(|(a, b)| a * b).sum();
        time += 2.0 * product / (n * variance);
        if lag as f64 > 6.0 * time {
            break;
        }
    }
    variance * time.max(1.0)
}

/// A series smoothed by lines fitted around each sample, weighted by a Gaussian curve of this standard deviation \[s\].
fn smoothed(at: &[f64], values: &[f64], width: f64) -> Vec<f64> {
    let mut low = 0;
    at.iter()
        .enumerate()
        .map(|(i, centre)| {
            while at[low] < centre - 3.0 * width {
                low += 1;
            }
            let (mut w0, mut w1, mut w2, mut y0, mut y1) = (0.0, 0.0, 0.0, 0.0, 0.0);
            for (t, y) in at[low..].iter().zip(&values[low..]) {
                let x = (t - centre) / width;
                if x > 3.0 {
                    break;
                }
                let w = (-0.5 * x * x).exp();
                (w0, w1, w2) = (w0 + w, w1 + w * x, w2 + w * x * x);
                (y0, y1) = (y0 + w * y, y1 + w * x * y);
            }
            let determinant = w0 * w2 - w1 * w1;
            if determinant > 1e-9 * w0 * w0 {
                (w2 * y0 - w1 * y1) / determinant
            } else {
                values[i]
            }
        })
        .collect()
}

/// The four-point cubic (Lagrange) through the samples around sample interval `i - 1` to `i`, at `t`; a line at the ends.
fn cubic(at: &[f64], values: &[f64], i: usize, t: f64) -> f64 {
    if i < 2 || i + 1 >= at.len() {
        let share = (t - at[i - 1]) / (at[i] - at[i - 1]);
        return values[i - 1] + share * (values[i] - values[i - 1]);
    }
    let (x, y) = (&at[i - 2..i + 2], &values[i - 2..i + 2]);
    let d = [t - x[0], t - x[1], t - x[2], t - x[3]];
    y[0] * d[1] * d[2] * d[3] / ((x[0] - x[1]) * (x[0] - x[2]) * (x[0] - x[3]))
        + y[1] * d[0] * d[2] * d[3] / ((x[1] - x[0]) * (x[1] - x[2]) * (x[1] - x[3]))
        + y[2] * d[0] * d[1] * d[3] / ((x[2] - x[0]) * (x[2] - x[1]) * (x[2] - x[3]))
        + y[3] * d[0] * d[1] * d[2] / ((x[3] - x[0]) * (x[3] - x[1]) * (x[3] - x[2]))
}

/// Integrals of a sampled signal.
struct Slow<'a> {
    at: &'a [f64],
    values: Vec<f64>,
    /// From the first sample to each.
    integral: Vec<f64>,
}

impl<'a> Slow<'a> {
    fn new(at: &'a [f64], values: &[f64]) -> Self {
        let mut integral = vec![0.0];
        for i in 1..at.len() {
            integral.push(integral[i - 1] + 0.5 * (values[i] + values[i - 1]) * (at[i] - at[i - 1]));
        }
        Self {
            at,
            values: values.to_vec(),
            integral,
        }
    }

    fn until(&self, t: f64) -> f64 {
        let i = self.at.partition_point(|s| *s <= t).clamp(1, self.at.len() - 1);
        let (dt, span) = (t - self.at[i - 1], self.at[i] - self.at[i - 1]);
        let slope = (self.values[i] - self.values[i - 1]) / span;
        self.integral[i - 1] + dt * (self.values[i - 1] + 0.5 * slope * dt)
    }

    /// The mean from `low` to `high`.
    fn mean(&self, low: f64, high: f64) -> f64 {
        (self.until(high) - self.until(low)) / (high - low)
    }
}
