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

use super::{Recording, Stream, cubic};
use crate::identify::hypothesis::deviations;
use crate::identify::{add_multiple, dot, parallel};
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
/// Significant is what is no chance, and exceeds this \[s\]: less than that does no harm and is not worth moving a stream for.
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
            significant: seconds.abs() > deviations(self.channels.len()) * deviation && seconds.abs() > LEAST,
        })
    }
}

fn estimate<const D: usize>(
    stream: &Stream<D>,
    order: [usize; D],
    times: &[Nanos],
    predicted: &[f64],
) -> Option<(f64, f64)> {
    let origin = *times.first()?;
    let (rows, _) = predicted.as_chunks::<D>();
    let (at, rows): (Vec<f64>, Vec<[f64; D]>) = times
        .iter()
        .zip(rows)
        .filter(|(_, row)| row.iter().all(|v| v.is_finite()))
        .map(|(t, row)| ((*t - origin).seconds(), *row))
        .unzip();
    let stamps: Vec<f64> = stream.t.iter().map(|t| (*t - origin).seconds()).collect();
    if rows.len() < 100 || stamps.len() < 100 {
        return None;
    }
    // Where measurement and prediction are both there without a gap, far enough from their ends for every shift tried: how many gaps there are until each row tells.
    let mut gaps = vec![0_usize];
    gaps.extend(at.windows(2).scan(0, |gaps, w| {
        *gaps += usize::from(w[1] - w[0] > 0.05);
        Some(*gaps)
    }));
    let whole = |low: f64, high: f64| {
        let (begin, end) = (at.partition_point(|t| *t <= low), at.partition_point(|t| *t < high));
        begin > 0 && end < at.len() && gaps[end] == gaps[begin - 1]
    };
    // At most 100 a second count: more tell nothing new about motion.
    let spacing = stream.spacing.seconds().max(1e-6);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let thin = ((0.01 / spacing).round() as usize).max(1);
    let n = thin as f64;
    let block_times: Vec<f64> = stamps.chunks_exact(thin).map(|t| t.iter().sum::<f64>() / n).collect();
    let blocks: Vec<[f64; D]> = stream
        .value
        .chunks_exact(thin)
        .map(|values| order.map(|k| values.iter().map(|v| v[k]).sum::<f64>() / n))
        .collect();
    let used: Vec<bool> = block_times
        .iter()
        .map(|t| whole(t - SLOW - WITHIN, t + SLOW + WITHIN))
        .collect();
    if used.iter().filter(|u| **u).count() < 100 {
        return None;
    }
    let spacings = |t: &[f64]| super::smooth::median(t.windows(2).map(|w| w[1] - w[0]).collect());
    let width = SMOOTH * spacings(&block_times).max(spacings(&at));
    // Both without their slow part: what was measured with its stamps; the prediction at its own instants, and between them.
    let measured: Vec<(f64, [f64; D])> = quick(&block_times, &blocks, width)
        .into_iter()
        .zip(&block_times)
        .zip(&used)
        .filter(|(_, used)| **used)
        .map(|((y, t), _)| (*t, y))
        .collect();
    let columns = quick(&at, &rows, width);
    let count = measured.len() as f64;
    // Half the deviance: what all axes leave over at an offset.
    let left = |offset: f64| -> f64 {
        let mut model = Model::new(&at, &columns);
        let (mut xx, mut xy, mut yy) = ([0.0; D], [0.0; D], [0.0; D]);
        for (t, y) in &measured {
            let x = model.at(t - offset);
            for k in 0..D {
                xx[k] += x[k] * x[k];
                xy[k] += x[k] * y[k];
                yy[k] += y[k] * y[k];
            }
        }
        (0..D)
            // An axis on which nothing happens, or nothing is predicted, says nothing.
            .filter(|&k| xx[k] > 0.0 && yy[k] > 0.0)
            .map(|k| 0.5 * count * ((yy[k] - xy[k] * xy[k] / xx[k]) / yy[k]).max(1e-12).ln())
            .sum()
    };
    #[allow(clippy::cast_possible_truncation)]
    let steps = (WITHIN / STEP).floor() as i32 - 1;
    let tried: Vec<i32> = (-steps..=steps).collect();
    let values = parallel::map(tried.len(), |number| left(f64::from(tried[number]) * STEP));
    let (mut best, mut least) = (0, f64::INFINITY);
    for (step, value) in tried.into_iter().zip(values) {
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
    // The prediction there, and its slope.
    let mut models = [-1e-3, 0.0, 1e-3].map(|by| (by, Model::new(&at, &columns)));
    let model: Vec<[[f64; 2]; D]> = measured
        .iter()
        .map(|(t, _)| {
            let [before, here, after] = models.each_mut().map(|(by, model)| model.at(t - offset + *by));
            std::array::from_fn(|k| [here[k], (after[k] - before[k]) / 2e-3])
        })
        .collect();
    let (mut information, mut plain) = (0.0, 0.0);
    let mut scores: BTreeMap<i64, f64> = BTreeMap::new();
    for k in 0..D {
        let (mut xx, mut xy) = (0.0, 0.0);
        for (x, (_, y)) in model.iter().zip(&measured) {
            xx += x[k][0] * x[k][0];
            xy += x[k][0] * y[k];
        }
        if xx <= 0.0 {
            continue;
        }
        let gain = xy / xx;
        let each = model.iter().zip(&measured);
        let residual: Vec<f64> = each.map(|(x, (_, y))| y[k] - gain * x[k][0]).collect();
        // A shift changes the signal by its slope; what of that looks like a change of the gain does not count.
        let (mut ss, mut sx) = (0.0, 0.0);
        for [x, slope] in model.iter().map(|x| x[k]) {
            ss += slope * slope;
            sx += slope * x;
        }
        let variance = dot(&residual, &residual) / count;
        if variance > 0.0 {
            let told = gain * gain * (ss - sx * sx / xx).max(0.0);
            information += told / inflated_variance(&residual);
            plain += told / variance;
            for ((x, (t, _)), e) in model.iter().zip(&measured).zip(&residual) {
                let [x, slope] = x[k];
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
    let variance = dot(series, series) / n;
    let mut time = 1.0;
    for lag in 1..series.len() / 4 {
        let product = dot(&series[..series.len() - lag], &series[lag..]);
        time += 2.0 * product / (n * variance);
        if lag as f64 > 6.0 * time {
            break;
        }
    }
    variance * time.max(1.0)
}

/// Series smoothed by lines fitted around each sample, weighted by a Gaussian curve of this standard deviation \[s\].
fn smoothed<const D: usize>(at: &[f64], values: &[[f64; D]], width: f64) -> Vec<[f64; D]> {
    let mut low = 0;
    at.iter()
        .enumerate()
        .map(|(i, centre)| {
            while at[low] < centre - 3.0 * width {
                low += 1;
            }
            let (mut w0, mut w1, mut w2, mut y0, mut y1) = (0.0, 0.0, 0.0, [0.0; D], [0.0; D]);
            for (t, y) in at[low..].iter().zip(&values[low..]) {
                let x = (t - centre) / width;
                if x > 3.0 {
                    break;
                }
                let w = (-0.5 * x * x).exp();
                (w0, w1, w2) = (w0 + w, w1 + w * x, w2 + w * x * x);
                add_multiple(&mut y0, w, y);
                add_multiple(&mut y1, w * x, y);
            }
            let determinant = w0 * w2 - w1 * w1;
            if determinant > 1e-9 * w0 * w0 {
                std::array::from_fn(|k| (w2 * y0[k] - w1 * y1[k]) / determinant)
            } else {
                values[i]
            }
        })
        .collect()
}

/// Series smoothed over this \[s\], less their means over [`SLOW`] to either side.
fn quick<const D: usize>(at: &[f64], values: &[[f64; D]], width: f64) -> Vec<[f64; D]> {
    let values = smoothed(at, values, width);
    // Integrals from the first sample to each.
    let mut integral = vec![[0.0; D]];
    for (i, (t, v)) in at.windows(2).zip(values.windows(2)).enumerate() {
        let mut sum = integral[i];
        add_multiple(&mut sum, 0.5 * (t[1] - t[0]), &v[0]);
        add_multiple(&mut sum, 0.5 * (t[1] - t[0]), &v[1]);
        integral.push(sum);
    }
    let until = |place: &mut Place<'_>, t: f64| -> [f64; D] {
        let i = place.of(t);
        let (dt, span) = (t - at[i - 1], at[i] - at[i - 1]);
        let mut sum = integral[i - 1];
        add_multiple(&mut sum, dt - 0.5 * dt * dt / span, &values[i - 1]);
        add_multiple(&mut sum, 0.5 * dt * dt / span, &values[i]);
        sum
    };
    let (mut low, mut high) = (Place::new(at), Place::new(at));
    at.iter()
        .zip(&values)
        .map(|(t, value)| {
            let mut out = *value;
            add_multiple(&mut out, -0.5 / SLOW, &until(&mut high, t + SLOW));
            add_multiple(&mut out, 0.5 / SLOW, &until(&mut low, t - SLOW));
            out
        })
        .collect()
}

/// Finds the interval of stamps that a time is in, for times that go forward.
struct Place<'a> {
    at: &'a [f64],
    behind: usize,
}

impl<'a> Place<'a> {
    fn new(at: &'a [f64]) -> Self {
        Self { at, behind: 1 }
    }

    /// The number of the stamp behind `t`; of times before all or behind all, the first interval's or the last one's.
    fn of(&mut self, t: f64) -> usize {
        while self.behind + 1 < self.at.len() && self.at[self.behind] <= t {
            self.behind += 1;
        }
        self.behind
    }
}

/// Series between their samples, at times that go forward.
struct Model<'a, const D: usize> {
    at: &'a [f64],
    values: &'a [[f64; D]],
    place: Place<'a>,
}

impl<'a, const D: usize> Model<'a, D> {
    fn new(at: &'a [f64], values: &'a [[f64; D]]) -> Self {
        Self {
            at,
            values,
            place: Place::new(at),
        }
    }

    /// The four-point cubic (Lagrange) through the samples around `t`; a line at the ends.
    fn at(&mut self, t: f64) -> [f64; D] {
        let (at, i) = (self.at, self.place.of(t));
        let mut sum = [0.0; D];
        if i < 2 || i + 1 >= at.len() {
            let share = (t - at[i - 1]) / (at[i] - at[i - 1]);
            add_multiple(&mut sum, 1.0 - share, &self.values[i - 1]);
            add_multiple(&mut sum, share, &self.values[i]);
            return sum;
        }
        let x = [at[i - 2], at[i - 1], at[i], at[i + 1]];
        for (weight, values) in cubic(x, t).iter().zip(&self.values[i - 2..i + 2]) {
            add_multiple(&mut sum, *weight, values);
        }
        sum
    }
}
