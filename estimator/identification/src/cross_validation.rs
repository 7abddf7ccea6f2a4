//! Cross-validation: that share of the change from CAD is retained which predicts held-out data
//! best.
//!
//! The training logs are divided into folds of consecutive seconds. Each fold is predicted with
//! parameters from all others, and the prediction error is that by which parameters are judged
//! ([`crate::report::prediction`]). Links that share rows form a group. With the share `k` of the
//! change the squared error of a group is a parabola, and its minimum is known:
//!
//! ```text
//! e(k) = e0 - k (e0 - e1),   k = sum e0 (e0 - e1) / sum (e0 - e1)^2,   0 <= k <= 1
//! ```
//!
//! `e0` is the error with CAD, `e1` with the whole change; seconds count by their noise
//! ([`crate::measurement::seconds`]). To demand a gain above its standard error left eleven of
//! fifteen choices of the real leg's spans with CAD, although the best share predicts other spans
//! with .6 to .99 of CAD's error (and 1.03 once, from a span in which the leg hardly moves).

use crate::dataset::observation::Annotated;
use crate::finding::{Finding, FindingCode, Severity};
use crate::fit::{
    IdentifyError, added, parameters_without_cad, posterior, without_negative_rotors,
};
use crate::linear::information::Information;
use crate::measurement::model::MeasurementModel;
use crate::measurement::noise_estimate::estimate_noise;
use crate::measurement::noise_model::NoiseModel;
use crate::measurement::reduction::{LogSegment, Residuals, reduce_with, residuals};
use crate::measurement::unknowns::Unknowns;
use crate::prepared_log::{MIN_FOLD, MIN_SECONDS, folds};
use crate::prior::Prior;
use crate::report::prediction::{self, JudgedParameters, PredictionError, PredictionErrors};
use nalgebra::DVector;
use std::collections::BTreeSet;
use std::ops::Range;

/// Most folds; as [`folds`] allows.
const FOLDS: usize = 5;

/// Length of a block \[s\].
const BLOCK: f64 = 1.0;

/// The result of cross-validation.
pub(crate) struct Retention {
    /// Retained fraction of the change from CAD, per link of the layout, then per extra parameter.
    pub share: Vec<f64>,
    pub findings: Vec<Finding>,
    blocks: Vec<FoldBlock>,
    /// Per fold, the parameters from all other folds.
    sets: Vec<DVector<f64>>,
}

impl Retention {
    /// Noise of the same segments, corrected by the residuals of held-out data.
    pub(crate) fn noise(
        &self,
        measurement: &MeasurementModel<'_>,
        segments: &[LogSegment<'_>],
        noise: NoiseModel,
        fastest: &[f64],
    ) -> NoiseModel {
        if self.sets.is_empty() {
            return noise;
        }
        let mut own_residuals: Vec<Residuals> = measurement.map(
            segments.iter().enumerate(),
            |measurement, (number, segment)| {
                let blocks = self.blocks.iter().filter(|block| block.segment == number);
                residuals_of_folds(residuals(measurement, *segment, &noise, &self.sets), blocks)
            },
        );
        let unknowns = measurement.unknowns();
        let seconds = &noise.seconds;
        seconds.standardise(unknowns, segments, &mut own_residuals);
        noise.cross_validated_noise(&estimate_noise(
            unknowns,
            &own_residuals,
            fastest,
            &noise.least,
        ))
    }
}

/// Consecutive instants of a segment, and their fold.
struct FoldBlock {
    segment: usize,
    range: Range<usize>,
    fold: usize,
}

impl FoldBlock {
    fn instants<'a>(&self, segments: &[LogSegment<'a>]) -> &'a [Annotated] {
        &segments[self.segment].instants[self.range.clone()]
    }
}

/// Holds out one fold after another of these segments of the training logs.
///
/// # Errors
/// As for [`posterior`].
pub(crate) fn held_out(
    measurement: &MeasurementModel<'_>,
    prior: &Prior,
    segments: &[LogSegment<'_>],
    noise: &NoiseModel,
    tau: f64,
) -> Result<Retention, IdentifyError> {
    let unknowns = measurement.unknowns();
    let all = segments.iter().flat_map(|segment| segment.instants);
    let count = folds(all.map(|instant| instant.t)).min(FOLDS);
    if count < 2 {
        return Ok(Retention {
            share: vec![0.0; unknowns.links.len() + unknowns.extra.len()],
            findings: vec![not_cross_validated()],
            blocks: Vec::new(),
            sets: Vec::new(),
        });
    }
    let blocks = blocks(segments, count);
    let each = (0..count).flat_map(|fold| (0..segments.len()).map(move |own| (fold, own)));
    let reduced = measurement.map(each, |measurement, (fold, segment)| {
        let mut held = vec![false; segments[segment].instants.len()];
        let is_held = |block: &&FoldBlock| block.fold == fold && block.segment == segment;
        for block in blocks.iter().filter(is_held) {
            held[block.range.clone()].fill(true);
        }
        reduce_with(
            measurement,
            segments[segment],
            noise,
            &held,
            0,
            &|_, _, _| Vec::new(),
        )
    });
    let (mut sets, mut candidates) = (Vec::new(), Vec::new());
    // Per fold, CAD and the parameters from the others.
    let mut pairs: Vec<[usize; 2]> = Vec::new();
    let cad_is_one = unknowns.parameters_without_cad().is_empty() && unknowns.joints.is_empty();
    for (fold, reduced) in reduced.chunks(segments.len()).enumerate() {
        let others: Information = added(reduced, unknowns.parameters());
        let fitted = posterior(prior, unknowns, &others)?.fit(tau)?;
        // As the parameters are reported.
        let fitted = without_negative_rotors(prior, unknowns, &others, &fitted)?;
        let both = [parameters_without_cad(unknowns, &others), fitted];
        let of_others = blocks.iter().filter(|block| block.fold != fold);
        let instants = of_others.flat_map(|block| block.instants(segments));
        let friction = prediction::friction(measurement, instants, &both);
        let judged = both.iter().zip(friction);
        let judged = judged.map(|(d, friction)| JudgedParameters::constant(d, friction));
        let cad_is_known = cad_is_one && fold > 0;
        candidates.extend(judged.skip(usize::from(cad_is_known)));
        let last = candidates.len() - 1;
        pairs.push([if cad_is_known { 0 } else { last - 1 }, last]);
        let [_, fitted] = both;
        sets.push(fitted);
    }
    let errors = |segment: &LogSegment<'_>| {
        let log = PredictionError::of_fit(measurement, segment.instants);
        log.errors(unknowns, &candidates, false)
    };
    let judgement = HeldOutErrors {
        segments,
        blocks: &blocks,
        errors: segments.iter().map(errors).collect(),
        pairs,
        noise,
    };
    let sums: Vec<(f64, f64)> = (0..unknowns.channels())
        .map(|channel| judgement.sums(unknowns, channel))
        .collect();
    let (share, findings) = retained_fraction(measurement, &sums);
    Ok(Retention {
        share,
        findings,
        blocks,
        sets,
    })
}

/// The prediction errors of held-out data.
struct HeldOutErrors<'a> {
    segments: &'a [LogSegment<'a>],
    blocks: &'a [FoldBlock],
    /// Per segment, of each candidate.
    errors: Vec<Vec<PredictionErrors>>,
    /// Per fold, the candidates of CAD and of the parameters from the others.
    pairs: Vec<[usize; 2]>,
    noise: &'a NoiseModel,
}

impl HeldOutErrors<'_> {
    /// Of a channel, the sums of `e0 (e0 - e1)` and `(e0 - e1)^2`.
    fn sums(&self, unknowns: &Unknowns, channel: usize) -> (f64, f64) {
        let is_wrench = channel < unknowns.wrenches();
        let (mut cross, mut square) = (0.0, 0.0);
        for block in self.blocks {
            let [e0, e1] = self.pairs[block.fold].map(|candidate| {
                let errors = &self.errors[block.segment][candidate];
                &errors.channels[channel][block.range.clone()]
            });
            let log = self.segments[block.segment].log;
            for ((e0, e1), instant) in e0.iter().zip(e1).zip(block.instants(self.segments)) {
                if e0.is_finite() && e1.is_finite() {
                    let weight = if is_wrench {
                        self.noise.seconds.factor(log, instant.t).recip()
                    } else {
                        1.0
                    };
                    cross += weight * e0 * (e0 - e1);
                    square += weight * (e0 - e1).powi(2);
                }
            }
        }
        let scale = unknowns.scale(channel).powi(2);
        (scale * cross, scale * square)
    }
}

/// Divides segments into blocks, and assigns these to `count` folds in the order of time.
fn blocks(segments: &[LogSegment<'_>], count: usize) -> Vec<FoldBlock> {
    let total: usize = segments.iter().map(|segment| segment.instants.len()).sum();
    let most = (total / count).max(1);
    let mut blocks = Vec::new();
    for (segment, LogSegment { instants, .. }) in segments.iter().enumerate() {
        let mut start = 0;
        for end in 1..=instants.len() {
            let is_long = |end: usize| {
                (instants[end].t - instants[start].t).seconds() >= BLOCK || end - start >= most
            };
            if end == instants.len() || is_long(end) {
                blocks.push(FoldBlock {
                    segment,
                    range: start..end,
                    fold: 0,
                });
                start = end;
            }
        }
    }
    let mut before = 0;
    for block in &mut blocks {
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
    blocks: impl Iterator<Item = &'a FoldBlock>,
) -> Residuals {
    let count = residuals.measured.first().map_or(0, Vec::len);
    let mut folds = vec![0; count];
    for block in blocks {
        folds[block.range.clone()].fill(block.fold);
    }
    let channel_noise = |channel: usize| {
        (0..count)
            .map(|i| residuals.noise[folds[i]][channel][i])
            .collect()
    };
    let noise: Vec<Vec<f64>> = (0..residuals.measured.len()).map(channel_noise).collect();
    residuals.noise = vec![noise];
    for (range, block) in residuals.ranges.iter().zip(&mut residuals.nuisance) {
        let set = folds.get(range.start).copied().unwrap_or(0);
        block.x = block.x.columns(set, 1).into_owned();
    }
    residuals
}

/// The retained fraction of each group, from sums per channel.
fn retained_fraction(
    measurement: &MeasurementModel<'_>,
    sums: &[(f64, f64)],
) -> (Vec<f64>, Vec<Finding>) {
    let unknowns = measurement.unknowns();
    let groups = measurement.groups();
    let (links, extra) = (&groups.links, &groups.extra);
    let mut share = vec![0.0; links.len() + extra.len()];
    let mut findings = Vec::new();
    for group in links.iter().copied().collect::<BTreeSet<usize>>() {
        let group_sums = sums.iter().zip(&groups.channels);
        let group_sums = group_sums.filter(|(_, g)| **g == group);
        let (cross, square) =
            group_sums.fold((0.0, 0.0), |sum, (own, _)| (sum.0 + own.0, sum.1 + own.1));
        let retained_fraction = if square > 0.0 {
            (cross / square).clamp(0.0, 1.0)
        } else {
            0.0
        };
        if retained_fraction < 1.0 {
            let members = unknowns.links.iter().zip(links);
            let members = members.filter(|(_, g)| **g == group);
            let model = &measurement.robot().model;
            let names: Vec<&str> = members.map(|(link, _)| model.link_name(*link)).collect();
            findings.push(shrunk(retained_fraction, names.join(", ")));
        }
        let all = share.iter_mut().zip(links.iter().chain(extra));
        for (value, _) in all.filter(|(_, g)| **g == group) {
            *value = retained_fraction;
        }
    }
    (share, findings)
}

fn not_cross_validated() -> Finding {
    Finding::warning(
        FindingCode::NotCrossValidated,
        "",
        format!(
            "the logs are too short for cross-validation: all links keep their URDF parameters; \
             record at least {} usable instants, or static poses in {} seconds",
            2 * MIN_FOLD,
            2 * MIN_SECONDS,
        ),
    )
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
    let severity = if retained_fraction > 0.0 {
        Severity::Note
    } else {
        Severity::Warning
    };
    Finding::new(severity, FindingCode::ShrunkToCad, &names, text)
}
