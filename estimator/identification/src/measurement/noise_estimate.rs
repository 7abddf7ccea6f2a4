//! Estimates the noise of every channel from the residuals of all segments.

use crate::linear::noise;
use crate::measurement::noise_model::{DriftLimits, NoiseModel};
use crate::measurement::reduction::{BLOCK, Residuals};
use crate::measurement::unknowns::Unknowns;
use std::ops::Range;

/// Means over this many autocorrelation times count as independent.
pub(crate) const INDEPENDENT: f64 = 8.0;
/// Greatest number of blocks that are merged into one.
pub(crate) const LONGEST: usize = 10;

/// Lower limit of a channel's share of noise, for channels mixed with others.
pub(crate) const LEAST_SHARE: f64 = 1e-3;

/// Means of `count` consecutive blocks each.
pub(crate) fn merge(means: &[f64], count: usize) -> Vec<f64> {
    let mean = |values: &[f64]| {
        let finite = values.iter().filter(|x| x.is_finite());
        let (sum, count) = finite.fold((0.0, 0.0), |(sum, count), x| (sum + x, count + 1.0));
        sum / count
    };
    means.chunks(count).map(mean).collect()
}

/// The noise of every channel, from the residuals of all segments for one set of parameters.
///
/// Where rows mix channels (a sub-tree between two sensors shows the sum of both), the residual is
/// the *most likely* noise of each channel. It varies less than the noise: its variance is the
/// channel's minus the posterior one, `v - (V - V N^T W^-1 N V)_cc`, a known share of `v`. The
/// variance found is divided by that share. At the fixed point the variances maximise the
/// likelihood, as with the EM algorithm, which adds the posterior variance instead and needs many
/// more iterations.
pub(crate) fn estimate_noise(
    unknowns: &Unknowns,
    segments: &[Residuals],
    set: usize,
    drift_limits: &DriftLimits,
    least: &[f64],
) -> NoiseModel {
    let mut model = NoiseModel {
        least: least.to_vec(),
        ..NoiseModel::default()
    };
    for channel in 0..unknowns.channels() {
        let is_wrench = channel < 6 * unknowns.sensors.len();
        let (mut step, mut variance) = (0.0, 0.0);
        let mut left: Vec<Vec<f64>> = segments
            .iter()
            .map(|segment| segment.noise[set][channel].clone())
            .collect();
        let mut per_block = 1.0;
        if is_wrench {
            // The sum of offset and noise: a random walk, and the noise beside it.
            let mut means: Vec<noise::BlockMeans> = Vec::new();
            let (mut used, mut filled) = (0usize, 0usize);
            for (segment, left) in segments.iter().zip(&mut left) {
                for (range, offset) in segment
                    .ranges
                    .iter()
                    .zip(segment.offset_drift(unknowns, set, channel))
                {
                    left[range.clone()].iter_mut().for_each(|x| *x += offset);
                }
                let mean = |range: &Range<usize>| {
                    let values = left[range.clone()].iter().filter(|x| x.is_finite());
                    let (sum, count) =
                        values.fold((0.0, 0usize), |(sum, count), x| (sum + x, count + 1));
                    (sum / count as f64, count)
                };
                let blocks: Vec<(f64, usize)> = segment.ranges.iter().map(mean).collect();
                used += blocks.iter().map(|b| b.1).sum::<usize>();
                filled += blocks.iter().filter(|b| b.1 > 0).count();
                means.push(blocks.iter().map(|block| block.0).collect());
            }
            per_block = used as f64 / filled.max(1) as f64;
            // Noise that is correlated over more than a block looks like a random walk there. Once
            // its correlation time is known, longer blocks separate the two.
            let totals = left.clone();
            let mut merged = 1;
            for _ in 0..2 {
                let longer: Vec<noise::BlockMeans> =
                    means.iter().map(|means| merge(means, merged)).collect();
                let count = merged as f64;
                let fastest = drift_limits.rates[channel] * BLOCK * count;
                let mut bound = (drift_limits.relative * count * count).min(1.0);
                for _ in 0..4 {
                    (step, variance) = noise::random_walk(&longer, bound);
                    if step <= fastest {
                        break;
                    }
                    bound = fastest / (variance + step - fastest);
                }
                step = step.min(fastest);
                (step, variance) = (step / count, variance * count);
                let mut levels = means
                    .iter()
                    .flat_map(|means| noise::levels(means, step, variance));
                for ((segment, left), total) in segments.iter().zip(&mut left).zip(&totals) {
                    for range in &segment.ranges {
                        let level = levels.next().unwrap_or(f64::NAN);
                        for (x, total) in left[range.clone()].iter_mut().zip(&total[range.clone()])
                        {
                            *x = total - level;
                        }
                    }
                }
                let slices: Vec<&[f64]> = left.iter().map(Vec::as_slice).collect();
                let (_, time) = noise::autocorrelation_time(&slices);
                merged = ((INDEPENDENT * time / per_block).round() as usize).clamp(1, LONGEST);
            }
        }
        let slices: Vec<&[f64]> = left.iter().map(Vec::as_slice).collect();
        let (square, time) = noise::autocorrelation_time(&slices);
        let seen: f64 = segments.iter().map(|segment| segment.seen[channel]).sum();
        let shown: f64 = segments
            .iter()
            .map(|p| p.shares[(channel, channel)] * p.seen[channel])
            .sum();
        let share = if seen > 0.0 {
            (shown / seen).clamp(LEAST_SHARE, 1.0)
        } else {
            1.0
        };
        model.square.push(square / share);
        model.time.push(time);
        model.drift.push(step / BLOCK / share);
        let block = if is_wrench {
            variance * per_block
        } else {
            square * time
        };
        model.block.push(block / share);
    }
    model.least = alike(unknowns, segments, &model);
    model
}

/// Lower limits of the variances of channels that rows show only together with others. How their
/// sum is shared among them is poorly determined, and the likelihood is greatest where some have no
/// noise at all. Combinations of rows that show only these channels would then count as exact. So
/// each channel has at least half the mean noise of these channels, relative to the stated noise.
pub(crate) fn alike(unknowns: &Unknowns, segments: &[Residuals], model: &NoiseModel) -> Vec<f64> {
    const MIN_SHARE: f64 = 0.5;
    let wrenches = 6 * unknowns.sensors.len();
    let relative =
        |c: usize| (model.square[c] * model.time[c]).max(model.block[c]) / model.least[c];
    let mut least = model.least.clone();
    for (channel, least) in least.iter_mut().enumerate().take(wrenches) {
        let is_mixed = |other: usize| {
            let shares = |p: &Residuals| {
                p.shares[(channel, other)] != 0.0 || p.shares[(other, channel)] != 0.0
            };
            other / 6 != channel / 6 && segments.iter().any(shares)
        };
        // Forces with forces, torques with torques.
        let others =
            (0..wrenches).filter(|&other| other % 6 / 3 == channel % 6 / 3 && is_mixed(other));
        let (sum, count) = others.fold((relative(channel), 1.0), |(sum, count), c| {
            (sum + relative(c), count + 1.0)
        });
        if count > 1.0 {
            *least *= (MIN_SHARE.powi(2) * sum / count).max(1.0);
        }
    }
    least
}
