//! Cross-validation: the retained fraction of the change from CAD, as far as it predicts held-out
//! data better than CAD does.
//!
//! The training logs are divided into folds that differ in motion: blocks of a second, in the order
//! of their posture along the direction in which postures differ most (in the order of time where
//! the robot repeats one posture). Each fold is predicted with parameters from all others, and the
//! prediction error is that by which parameters are judged ([`crate::report::prediction`]).
//!
//! Links that share rows form a group. The gain of a group over CAD is the sum of `e0^2 - e^2` over
//! its channels, `e0` being CAD's error: a parabola in the retained fraction. The retained fraction
//! is the largest of 1, 0.9, ... 0.1 whose gain exceeds its own standard error and is within a
//! standard error of the best gain; else 0. The standard error is that from blocks or that from
//! folds, whichever is larger, because errors in one posture are correlated.

use crate::finding::{Finding, FindingCode, Severity};
use crate::fit::{
    IdentifyError, added, parameters_without_cad, posterior, without_negative_rotors,
};
use crate::linear::information::Information;
use crate::measurement::channels;
use crate::measurement::model::{Groups, MeasurementModel};
use crate::measurement::noise_estimate::estimate_noise;
use crate::measurement::noise_model::{DriftLimits, NoiseModel};
use crate::measurement::reduction::{Residuals, Segment, reduce_with, residuals};
use crate::parallel;
use crate::prior::Prior;
use crate::report::prediction::{self, Candidate, Errors, Free, PredictionError};
use crate::training::{MIN_FOLD, map_segments};
use nalgebra::{DMatrix, DVector};
use proprio_topics::Nanos;
use std::ops::Range;

/// Most folds; each has at least [`MIN_FOLD`] instants.
const FOLDS: usize = 5;

/// Length of a block \[s\].
const BLOCK: f64 = 1.0;

/// The result of cross-validation.
pub(crate) struct Retention {
    /// Retained fraction of the change from CAD, per link of the layout, then per extra parameter.
    pub share: Vec<f64>,
    pub findings: Vec<Finding>,
    /// Errors of predicting held-out data with the retained fraction.
    pub held: HeldOutErrors,
    blocks: Vec<Block>,
    /// Per fold, the parameters from all other folds.
    sets: Vec<DVector<f64>>,
}

impl Retention {
    /// Noise of the same segments, corrected by the residuals of held-out data.
    pub(crate) fn noise(
        &self,
        measurement: &MeasurementModel<'_>,
        segments: &[Segment<'_>],
        noise: NoiseModel,
        walk_limits: &DriftLimits,
    ) -> NoiseModel {
        if self.sets.is_empty() {
            return noise;
        }
        let own_residuals: Vec<Residuals> =
            map_segments(measurement, segments, |measurement, number, segment| {
                let own = self.blocks.iter().filter(|block| block.segment == number);
                residuals_of_folds(residuals(measurement, segment, &noise, &self.sets), own)
            });
        noise.cross_validated_noise(&estimate_noise(
            measurement.unknowns(),
            &own_residuals,
            0,
            walk_limits,
            &noise.least,
        ))
    }
}

/// Errors of predicting held-out data.
#[derive(Clone, Debug, Default)]
pub(crate) struct HeldOutErrors {
    /// Per block, its fold.
    folds: Vec<usize>,
    /// Per channel and block, the sum of squares \[Nm^2\] and the number of instants.
    squares: Vec<Vec<(f64, usize)>>,
    /// Per F/T sensor, the sum of squares of its readings, less their means \[Nm^2\].
    loads: Vec<f64>,
    /// ... and of its stated noise.
    noises: Vec<f64>,
}

impl HeldOutErrors {
    /// By how much the squares are smaller than `other`'s of the same blocks, and the standard
    /// error of that. Blocks in which instants of one of the two are excluded are not compared.
    pub(crate) fn gain_over(&self, other: &Self) -> (f64, f64) {
        let of_block = |block: usize| -> f64 {
            let pairs = self
                .squares
                .iter()
                .zip(&other.squares)
                .map(|(own, other)| (own[block], other[block]));
            let same = pairs.filter(|((_, count), (_, others))| count == others);
            same.map(|((own, _), (other, _))| other - own).sum()
        };
        total(
            &(0..self.folds.len()).map(of_block).collect::<Vec<f64>>(),
            &self.folds,
        )
    }

    /// The RMS error relative to `other`'s.
    pub(crate) fn relative_to(&self, other: &Self) -> f64 {
        (sum(&self.squares) / sum(&other.squares)).sqrt()
    }

    /// Per F/T sensor, the mean square error less that of its stated noise, relative to the mean
    /// square of its readings.
    pub(crate) fn relative_squares(&self) -> Vec<f64> {
        let errors = self.squares.chunks(6).map(sum);
        let sizes = self.loads.iter().zip(&self.noises);
        errors
            .zip(sizes)
            .map(|(error, (load, noise))| (error - noise) / load)
            .collect()
    }
}

fn sum(squares: &[Vec<(f64, usize)>]) -> f64 {
    squares.iter().flatten().map(|(square, _)| square).sum()
}

/// Consecutive instants of a segment, and their fold.
struct Block {
    segment: usize,
    range: Range<usize>,
    fold: usize,
}

/// Holds out one fold after another of these segments of the training logs.
///
/// # Errors
/// As for [`posterior`].
pub(crate) fn held_out(
    measurement: &MeasurementModel<'_>,
    prior: &Prior,
    segments: &[Segment<'_>],
    noise: &NoiseModel,
    tau: f64,
) -> Result<Retention, IdentifyError> {
    let unknowns = measurement.unknowns();
    let total: usize = segments.iter().map(|segment| segment.instants.len()).sum();
    let count = (total / MIN_FOLD).min(FOLDS);
    if count < 2 {
        return Ok(Retention {
            share: vec![0.0; unknowns.links.len() + unknowns.extra.len()],
            findings: vec![not_cross_validated()],
            held: HeldOutErrors::default(),
            blocks: Vec::new(),
            sets: Vec::new(),
        });
    }
    let blocks = blocks(segments, count);
    let reduced = parallel::map_with(
        count * segments.len(),
        || measurement.clone(),
        |measurement, number| {
            let (fold, segment) = (number / segments.len(), number % segments.len());
            let mut held = vec![false; segments[segment].instants.len()];
            for block in blocks
                .iter()
                .filter(|b| b.fold == fold && b.segment == segment)
            {
                held[block.range.clone()].fill(true);
            }
            reduce_with(
                measurement,
                segments[segment],
                noise,
                &held,
                0,
                &mut |_, _, _, _| (),
            )
        },
    );
    let mut sets: Vec<DVector<f64>> = Vec::new();
    let mut candidates: Vec<Candidate> = Vec::new();
    // Per fold, CAD and the parameters from the others.
    let mut pairs: Vec<[usize; 2]> = Vec::new();
    let cad_is_one = unknowns.parameters_without_cad().is_empty() && unknowns.joints.is_empty();
    for (fold, reduced) in reduced.chunks(segments.len()).enumerate() {
        let others: Information = added(reduced, unknowns.parameters());
        let own = posterior(prior, unknowns, &others)?.fit(tau)?;
        // As the parameters are reported.
        let own = without_negative_rotors(prior, unknowns, &others, &own)?;
        let both = [parameters_without_cad(unknowns, &others), own];
        let of_others = blocks.iter().filter(|block| block.fold != fold);
        let instants =
            of_others.flat_map(|block| &segments[block.segment].instants[block.range.clone()]);
        let friction = prediction::friction(measurement, instants, &both);
        let both_judged = both.iter().zip(friction).map(|(d, friction)| Candidate {
            course: vec![(Nanos::ZERO, d.clone())],
            friction,
        });
        let cad_is_known = cad_is_one && fold > 0;
        candidates.extend(both_judged.skip(usize::from(cad_is_known)));
        let last = candidates.len() - 1;
        pairs.push([if cad_is_known { 0 } else { last - 1 }, last]);
        sets.push(both.into_iter().nth(1).unwrap_or_default());
    }
    let mut loads = vec![0.0; unknowns.sensors.len()];
    let mut noises = loads.clone();
    let mut errors: Vec<Vec<Errors>> = Vec::new();
    for segment in segments {
        let prediction_error = PredictionError::of_fit(measurement, segment.instants);
        let own = prediction_error.errors(unknowns, &candidates, Free::Constants);
        for (channel, stated) in unknowns.stated(measurement.robot()).enumerate() {
            let read = prediction_error.load(channel, &own[0]);
            let scale = unknowns.scale(channel).powi(2);
            loads[channel / 6] += scale * read.iter().map(|x| x * x).sum::<f64>();
            noises[channel / 6] += scale * read.len() as f64 * stated * stated;
        }
        errors.push(own);
    }
    // Per channel and block: sums of e0 (e0 - e1), (e0 - e1)^2 and e0^2.
    let sums: Vec<Vec<Sums>> = (0..unknowns.channels())
        .map(|channel| {
            let of_block = |block: &Block| {
                let of = |set: usize| {
                    let of_candidate = &errors[block.segment][pairs[block.fold][set]];
                    &of_candidate.channels[channel][block.range.clone()]
                };
                let pairs = of(0)
                    .iter()
                    .zip(of(1))
                    .filter(|(e0, e1)| e0.is_finite() && e1.is_finite());
                pairs.fold(Sums::default(), |sums, (e0, e1)| Sums {
                    cross: sums.cross + e0 * (e0 - e1),
                    square: sums.square + (e0 - e1).powi(2),
                    cad: sums.cad + e0 * e0,
                    count: sums.count + 1,
                })
            };
            blocks.iter().map(of_block).collect()
        })
        .collect();
    let folds: Vec<usize> = blocks.iter().map(|block| block.fold).collect();
    let (share, findings) = retained_fraction(measurement, &folds, &sums);
    let squares = sums.iter().enumerate().map(|(channel, sums)| {
        let own = links_of(measurement, channel).map_or(0.0, |place| share[place]);
        let scale = unknowns.scale(channel).powi(2);
        let square = |sums: &Sums| (scale * (sums.cad - sums.gain(own)), sums.count);
        sums.iter().map(square).collect()
    });
    let held = HeldOutErrors {
        squares: squares.collect(),
        folds,
        loads,
        noises,
    };
    Ok(Retention {
        share,
        findings,
        held,
        blocks,
        sets,
    })
}

/// Sums over the instants of a block, of CAD's error `e0` and that with the whole change, `e1`.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    /// Of `e0 (e0 - e1)`.
    cross: f64,
    /// Of `(e0 - e1)^2`.
    square: f64,
    /// Of `e0^2`.
    cad: f64,
    count: usize,
}

impl Sums {
    /// By how much the squares are smaller than CAD's with a fraction `share` of the change.
    fn gain(&self, share: f64) -> f64 {
        2.0 * share * self.cross - share * share * self.square
    }
}

/// The first link of the layout in a channel's group.
fn links_of(measurement: &MeasurementModel<'_>, channel: usize) -> Option<usize> {
    let Groups {
        links, channels, ..
    } = measurement.groups();
    links.iter().position(|group| *group == channels[channel])
}

/// A sum over blocks and its standard error, the larger of that from blocks and that from folds.
fn total(values: &[f64], folds: &[usize]) -> (f64, f64) {
    let mut of_folds = vec![0.0; folds.iter().max().map_or(0, |last| last + 1)];
    folds
        .iter()
        .zip(values)
        .for_each(|(fold, value)| of_folds[*fold] += value);
    (
        values.iter().sum(),
        standard_error(values).max(standard_error(&of_folds)),
    )
}

/// Divides segments into blocks, and assigns these to `count` folds by their posture.
fn blocks(segments: &[Segment<'_>], count: usize) -> Vec<Block> {
    let total: usize = segments.iter().map(|segment| segment.instants.len()).sum();
    let most = (total / count).max(1);
    let mut blocks = Vec::new();
    for (segment, Segment { instants, .. }) in segments.iter().enumerate() {
        let mut start = 0;
        for end in 1..=instants.len() {
            let is_long = |end: usize| {
                (instants[end].t - instants[start].t).seconds() >= BLOCK || end - start >= most
            };
            if end == instants.len() || is_long(end) {
                blocks.push(Block {
                    segment,
                    range: start..end,
                    fold: 0,
                });
                start = end;
            }
        }
    }
    let dofs = segments
        .first()
        .map_or(0, |segment| segment.instants[0].position.len());
    let mut postures = DMatrix::from_fn(blocks.len(), dofs, |number, dof| {
        let Block { segment, range, .. } = &blocks[number];
        let positions = segments[*segment].instants[range.clone()]
            .iter()
            .map(|i| i.position[dof]);
        positions.sum::<f64>() / range.len() as f64
    });
    for mut column in postures.column_iter_mut() {
        let mean = column.mean();
        column.add_scalar_mut(-mean);
    }
    // The direction in which postures differ most; time if they hardly differ.
    const STILL: f64 = 0.01;
    let svd = postures.clone().svd(false, true);
    let differ = svd.singular_values.max() / (blocks.len() as f64).sqrt();
    let along: Vec<f64> = match svd.v_t.filter(|_| differ > STILL) {
        Some(directions) => {
            let first = svd.singular_values.imax();
            (postures * directions.row(first).transpose())
                .iter()
                .copied()
                .collect()
        }
        None => (0..blocks.len()).map(|number| number as f64).collect(),
    };
    let mut order: Vec<usize> = (0..blocks.len()).collect();
    order.sort_by(|&a, &b| along[a].total_cmp(&along[b]));
    let mut before = 0;
    for number in order {
        let block = &mut blocks[number];
        let middle = before + block.range.len() / 2;
        block.fold = (middle * count / total).min(count - 1);
        before += block.range.len();
    }
    blocks
}

/// Residuals of a log in which each instant has those of its fold's parameters, to which it did not
/// contribute: from residuals with one set per fold to residuals with one set.
fn residuals_of_folds<'a>(
    mut residuals: Residuals,
    blocks: impl Iterator<Item = &'a Block>,
) -> Residuals {
    let count = residuals.measured.first().map_or(0, Vec::len);
    let mut folds = vec![0; count];
    for block in blocks {
        folds[block.range.clone()].fill(block.fold);
    }
    let own = |channel: usize| {
        (0..count)
            .map(|i| residuals.noise[folds[i]][channel][i])
            .collect()
    };
    let own: Vec<Vec<f64>> = (0..residuals.measured.len()).map(own).collect();
    residuals.noise = vec![own];
    for (range, block) in residuals.ranges.iter().zip(&mut residuals.nuisance) {
        let set = folds.get(range.start).copied().unwrap_or(0);
        block.x = block.x.columns(set, 1).into_owned();
    }
    residuals
}

/// The retained fraction of each group, from sums per channel and block.
fn retained_fraction(
    measurement: &MeasurementModel<'_>,
    folds: &[usize],
    sums: &[Vec<Sums>],
) -> (Vec<f64>, Vec<Finding>) {
    let unknowns = measurement.unknowns();
    let Groups {
        links,
        extra,
        channels,
    } = measurement.groups();
    let mut share = vec![0.0; links.len() + extra.len()];
    let mut findings = Vec::new();
    let mut groups: Vec<usize> = links.clone();
    groups.sort_unstable();
    groups.dedup();
    for group in groups {
        let own: Vec<usize> = (0..unknowns.channels())
            .filter(|&c| channels[c] == group)
            .collect();
        // The gain with a fraction `share` of the change, over some channels, and its standard
        // error.
        let gain = |share: f64, some: &[usize]| {
            let of_block = |block: usize| -> f64 {
                let each = some
                    .iter()
                    .map(|&c| unknowns.scale(c).powi(2) * sums[c][block].gain(share));
                each.sum()
            };
            total(&(0..folds.len()).map(of_block).collect::<Vec<f64>>(), folds)
        };
        let shares: Vec<f64> = (1..=10)
            .rev()
            .map(|tenth| f64::from(tenth) / 10.0)
            .collect();
        let best = shares.iter().map(|share| gain(*share, &own));
        let best = best.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default();
        let is_enough = |share: &&f64| {
            let (gain, error) = gain(**share, &own);
            gain > error && gain >= best.0 - best.1
        };
        let retained_fraction = shares.iter().find(is_enough).copied().unwrap_or(0.0);
        if retained_fraction < 1.0 {
            let of_group = unknowns
                .links
                .iter()
                .zip(links)
                .filter(|(_, g)| **g == group);
            let names: Vec<&str> = of_group
                .map(|(link, _)| measurement.robot().model.link_name(*link))
                .collect();
            findings.push(shrunk(retained_fraction, names.join(", ")));
        }
        for &channel in &own {
            let (gain, error) = gain(retained_fraction, &[channel]);
            if gain < -2.0 * error {
                findings.push(worse(
                    channels::channel_name(measurement.robot(), unknowns, channel).0,
                ));
            }
        }
        let all = share.iter_mut().zip(links.iter().chain(extra));
        for (value, _) in all.filter(|(_, g)| **g == group) {
            *value = retained_fraction;
        }
    }
    (share, findings)
}

/// Standard error of the sum of these values.
fn standard_error(values: &[f64]) -> f64 {
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0);
    (variance * count).sqrt()
}

fn not_cross_validated() -> Finding {
    Finding {
        severity: Severity::Warning,
        code: FindingCode::NotCrossValidated,
        subject: String::new(),
        text: format!(
            "the logs are too short for cross-validation: all links keep their URDF parameters; \
             record at least {} usable instants",
            2 * MIN_FOLD
        ),
    }
}

fn shrunk(retained_fraction: f64, names: String) -> Finding {
    let text = if retained_fraction > 0.0 {
        format!(
            "{names}: the full change from CAD predicts held-out data less well than a fraction \
             of it; {:.0} % of the change is retained",
            100.0 * retained_fraction
        )
    } else {
        format!(
            "{names}: identified parameters predict held-out data no better than CAD, so these \
             links keep their URDF parameters; record more, and more varied, motion"
        )
    };
    Finding {
        severity: Severity::Warning,
        code: FindingCode::ShrunkToCad,
        subject: names,
        text,
    }
}

fn worse(channel: String) -> Finding {
    Finding {
        severity: Severity::Note,
        code: FindingCode::WorseThanCad,
        text: format!(
            "{channel}: held-out data are predicted slightly worse than by CAD, although all \
             channels of its links together are predicted better"
        ),
        subject: channel,
    }
}
