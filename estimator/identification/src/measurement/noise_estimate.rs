//! Estimates the noise of every channel from the residuals of all segments.

use crate::arithmetic::mean;
use crate::linear::noise;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::reduction::{BLOCK, Residuals};
use crate::measurement::unknowns::Unknowns;
use std::ops::Range;

/// Time constant of the fastest random walk of an offset \[s\]: the motion that excites the
/// parameters is faster.
const DRIFT_TIME: f64 = 1.0;

/// Means over this many autocorrelation times count as independent.
const INDEPENDENT: f64 = 8.0;
/// Greatest number of blocks that are merged into one.
const LONGEST: usize = 10;

/// Lower limit of a channel's share of noise, for channels mixed with others.
pub(crate) const LEAST_SHARE: f64 = 1e-3;

/// The noise of every channel, from the residuals of all segments for one set of parameters. The
/// drift of an F/T channel's offset is at most that of `fastest`, the rate of a random walk
/// [unit^2/s]; the variance of a channel is at least that of `least`.
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
    fastest: &[f64],
    least: &[f64],
) -> NoiseModel {
    let mut model = NoiseModel {
        least: least.to_vec(),
        ..NoiseModel::default()
    };
    for channel in 0..unknowns.channels() {
        let mut left: Vec<Vec<f64>> = segments
            .iter()
            .map(|segment| segment.noise[0][channel].clone())
            .collect();
        // Those of F/T sensors, which come first, have a limit; the others do not drift.
        let walk = fastest.get(channel).map(|fastest| {
            for (segment, left) in segments.iter().zip(&mut left) {
                let drift = segment.offset_drift(unknowns, channel);
                for (range, offset) in segment.ranges.iter().zip(drift) {
                    left[range.clone()].iter_mut().for_each(|x| *x += offset);
                }
            }
            remove_random_walk(segments, &mut left, *fastest)
        });
        let (square, time) = noise::autocorrelation_time(&left);
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
        let (step, block) = walk.unwrap_or((0.0, square * time));
        model.square.push(square / share);
        model.time.push(time);
        model.drift_variance.push(step / BLOCK / share);
        model.block.push(block / share);
    }
    model.least = alike(unknowns, segments, &model);
    model
}

/// Removes the random walk of a channel's offset from the sums of offset and noise. Returns the
/// variances of its step between blocks, and of a row for which block means have the variance that
/// was found for them beside it.
fn remove_random_walk(segments: &[Residuals], left: &mut [Vec<f64>], fastest: f64) -> (f64, f64) {
    let mut means: Vec<noise::BlockMeans> = Vec::new();
    let (mut used, mut filled) = (0usize, 0usize);
    for (segment, left) in segments.iter().zip(&*left) {
        let block_mean = |range: &Range<usize>| {
            let values = left[range.clone()].iter().filter(|x| x.is_finite());
            let (sum, count) = values.fold((0.0, 0usize), |(sum, count), x| (sum + x, count + 1));
            used += count;
            filled += usize::from(count > 0);
            sum / count as f64
        };
        means.push(segment.ranges.iter().map(block_mean).collect());
    }
    let per_block = used as f64 / filled.max(1) as f64;
    // Noise that is correlated over more than a block looks like a random walk there. Once its
    // correlation time is known, longer blocks separate the two.
    let totals = left.to_vec();
    let (mut step, mut variance) = (0.0, 0.0);
    let mut merged = 1;
    for _ in 0..2 {
        let merge = |means: &noise::BlockMeans| means.chunks(merged).map(mean).collect();
        let longer: Vec<noise::BlockMeans> = means.iter().map(merge).collect();
        let count = merged as f64;
        let fastest = fastest * BLOCK * count;
        // The greatest variance of a step, relative to that of a mean's noise.
        let mut bound = ((BLOCK / DRIFT_TIME).powi(2) * count * count).min(1.0);
        for _ in 0..4 {
            (step, variance) = noise::random_walk(&longer, bound);
            if step <= fastest {
                break;
            }
            bound = fastest / (variance + step - fastest);
        }
        step = step.min(fastest);
        (step, variance) = (step / count, variance * count);
        for ((segment, means), (left, total)) in segments
            .iter()
            .zip(&means)
            .zip(left.iter_mut().zip(&totals))
        {
            let levels = noise::levels(means, step, variance);
            for (range, level) in segment.ranges.iter().zip(levels) {
                for (x, total) in left[range.clone()].iter_mut().zip(&total[range.clone()]) {
                    *x = total - level;
                }
            }
        }
        let (_, time) = noise::autocorrelation_time(left);
        merged = ((INDEPENDENT * time / per_block).round() as usize).clamp(1, LONGEST);
    }
    (step, variance * per_block)
}

/// Lower limits of the variances of channels that rows show only together with others. How their
/// sum is shared among them is poorly determined, and the likelihood is greatest where some have no
/// noise at all. Combinations of rows that show only these channels would then count as exact. So
/// each channel has at least half the mean noise of these channels, relative to the stated noise.
fn alike(unknowns: &Unknowns, segments: &[Residuals], model: &NoiseModel) -> Vec<f64> {
    const MIN_SHARE: f64 = 0.5;
    let wrenches = unknowns.wrenches();
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
