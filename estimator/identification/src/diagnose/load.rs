//! A load on any link that is picked up or put down within a log, or is there in one of several.
//!
//! Without it, .8 kg on the forearm in one of two logs raise the error on held-out torques from
//! .7 % to several times that, and nothing names the cause.

use crate::dataset::observation::{Annotated, Observation, SubtreeSet};
use crate::fit::NoiseAndMap;
use crate::linear::information::Information;
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::{LogSegment, ReducedLog, blocks, reduce};
use crate::measurement::unknowns::Unknowns;
use crate::nested_test::needed;
use crate::parallel;
use crate::prepared_log::{PreparedLog, reduced_segments};
use crate::prior::Prior;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn, SMatrix, SVector};
use proprio_dynamics::regressor::LINK_PARAMETERS;
use proprio_topics::Nanos;
use std::ops::Range;

/// A log is divided into segments of a second, but at most this many, to find when a load changes.
pub(crate) const SEGMENTS: usize = 64;

/// Length of these segments \[s\].
pub(crate) const SEGMENT_SECONDS: f64 = 1.0;

/// Fewest segments on either side of the change.
pub(crate) const LEAST_SEGMENTS: usize = 3;

/// Smallest mass of a load \[kg\].
pub(crate) const LEAST_MASS: f64 = 0.02;

/// Largest distance of its centre of mass from its link's origin \[m\].
pub(crate) const REACH: f64 = 1.0;

/// A load that changes within a log.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct LoadChange {
    /// Number of the training log.
    pub log: usize,
    /// Place of its link in the layout.
    pub index: usize,
    /// The side of the change that is excluded, first and last stamp.
    pub span: (Nanos, Nanos),
    /// The part of it that is not close to the change: there the load is constant.
    pub clear: (Nanos, Nanos),
    /// Uncertainty of the time of the change \[s\].
    pub within: f64,
    /// Whether the excluded side is that after the change.
    pub is_after: bool,
    /// The sub-trees whose equations contain it.
    pub subtrees: SubtreeSet,
}

impl LoadChange {
    /// Whether an instant of that log is in the excluded part.
    pub(crate) fn has(&self, t: Nanos) -> bool {
        self.span.0 <= t && t <= self.span.1
    }
}

/// Inertial parameters that a load adds to a link, with their covariance.
#[derive(Clone, Debug)]
pub(crate) struct AddedBody {
    pub parameters: SVector<f64, LINK_PARAMETERS>,
    pub covariance: SMatrix<f64, LINK_PARAMETERS, LINK_PARAMETERS>,
}

/// Normal equations `[R^T R, R^T z]` of some information. They are used to search for a load, not
/// for the final estimate.
#[derive(Clone)]
pub(crate) struct Normal {
    pub(crate) matrix: DMatrix<f64>,
    pub(crate) right: DVector<f64>,
}

impl Normal {
    pub(crate) fn new(unknowns: usize) -> Self {
        Self {
            matrix: DMatrix::zeros(unknowns, unknowns),
            right: DVector::zeros(unknowns),
        }
    }

    /// Of these segments together.
    fn of(unknowns: usize, reduced: &[ReducedLog]) -> Self {
        let mut sum = Self::new(unknowns);
        reduced.iter().for_each(|own| sum.add(&own.information));
        sum
    }

    pub(crate) fn add(&mut self, information: &Information) {
        let (r, z) = information.to_triangle();
        self.matrix += r.transpose() * &r;
        self.right += r.transpose() * z;
    }

    /// Adds the prior, but for links whose parameters are known otherwise.
    pub(crate) fn add_prior(
        &mut self,
        prior: &Prior,
        unknowns: &Unknowns,
        tau: f64,
        is_known: &dyn Fn(usize) -> bool,
    ) {
        let unknown = unknowns.links.iter().copied().enumerate();
        for (index, link) in unknown.filter(|(_, link)| !is_known(*link)) {
            let mut block = self
                .matrix
                .fixed_view_mut::<LINK_PARAMETERS, LINK_PARAMETERS>(
                    LINK_PARAMETERS * index,
                    LINK_PARAMETERS * index,
                );
            block += prior.metric(link) / (2.0 * tau * tau);
        }
        for (precision, column) in unknowns.precision.iter().zip(unknowns.inertial()..) {
            self.matrix[(column, column)] += precision;
        }
    }
}

/// The precision of a body's parameters before any data: it is known to three times the link's own
/// size.
fn weak(prior: &Prior, link: usize) -> SMatrix<f64, LINK_PARAMETERS, LINK_PARAMETERS> {
    prior.metric(link) / 18.0
}

/// The parameters of a body that is on the link at `index` in `some` of the data only, and by how
/// much it reduces the squared residuals. `weak`: the precision of its prior; `factor`: of all data
/// and the prior; `x`: their solution.
pub(crate) fn body(
    weak: &SMatrix<f64, LINK_PARAMETERS, LINK_PARAMETERS>,
    index: usize,
    some: &Normal,
    factor: &Cholesky<f64, Dyn>,
    x: &DVector<f64>,
) -> Option<(AddedBody, f64)> {
    let cross = some
        .matrix
        .fixed_columns::<LINK_PARAMETERS>(LINK_PARAMETERS * index)
        .into_owned();
    let block = cross
        .fixed_rows::<LINK_PARAMETERS>(LINK_PARAMETERS * index)
        .into_owned();
    let rest = block + weak - cross.transpose() * factor.solve(&cross);
    let misfit = some
        .right
        .fixed_rows::<LINK_PARAMETERS>(LINK_PARAMETERS * index)
        .into_owned()
        - cross.transpose() * x;
    let covariance = rest.cholesky()?.inverse();
    let parameters = covariance * misfit;
    let gain = misfit.dot(&parameters);
    Some((
        AddedBody {
            parameters,
            covariance,
        },
        gain,
    ))
}

impl AddedBody {
    /// Whether these parameters are plausible for a load.
    pub(crate) fn is_a_body(&self) -> bool {
        let mass = self.parameters[0];
        let centre = self.parameters.fixed_rows::<3>(1) / mass;
        let is_sure = mass * mass > needed(1, 1) * self.covariance[(0, 0)];
        mass.abs() > LEAST_MASS && is_sure && centre.norm() < REACH
    }
}

/// The best change of a load that was found.
struct LoadCandidate {
    log: usize,
    /// The number of the segment before which the load changes.
    at: usize,
    /// Place of the link in the layout.
    index: usize,
    /// Reduction of the squared residuals by a body on the link after the change, and before it.
    later: f64,
    earlier: f64,
}

/// Looks for a load that changes within one of the logs, given a fit to all of them.
///
/// A log is divided into segments. For each boundary between two segments and each link: the gain
/// is the reduction of the squared residuals by a body on that link in the segments after the
/// boundary only, or in those before it only. The side that is excluded: with several logs, the one
/// with the larger gain; with a single log, the shorter one.
pub(crate) fn find(
    measurement: &MeasurementModel<'_>,
    training: &[&PreparedLog],
    estimate: &NoiseAndMap,
) -> Option<LoadChange> {
    let mut segments = Vec::new();
    let mut of_logs: Vec<Range<usize>> = Vec::new();
    for (number, log) in training.iter().enumerate() {
        let first = segments.len();
        let ranges = blocks(&log.instants, segment_seconds(log)).into_iter();
        segments.extend(ranges.map(|range| LogSegment {
            instants: &log.instants[range],
            log: Some(number),
        }));
        of_logs.push(first..segments.len());
    }
    let search = LoadSearch::new(measurement, &segments, estimate)?;
    let mut best = None;
    for (log, range) in of_logs.iter().enumerate() {
        if range.len() >= 2 * LEAST_SEGMENTS {
            search.search_log(log, range, training.len() > 1, &mut best);
        }
    }
    let LoadCandidate {
        log,
        at,
        index,
        later,
        earlier,
    } = best?;
    let range = &of_logs[log];
    let is_after = if training.len() > 1 {
        later >= earlier
    } else {
        at - range.start >= range.end - at
    };
    let excluded = if is_after {
        at..range.end
    } else {
        range.start..at
    };
    // The change may be anywhere in the adjacent segment.
    let clear = if excluded == *range {
        excluded.clone()
    } else if is_after {
        excluded.start + 1..excluded.end
    } else {
        excluded.start..excluded.end - 1
    };
    let stamps = |range: Range<usize>| {
        let first = segments[range.start].instants.first()?.t;
        Some((first, segments[range.end - 1].instants.last()?.t))
    };
    Some(LoadChange {
        log,
        index,
        span: stamps(excluded)?,
        clear: stamps(clear)?,
        within: segment_seconds(training[log]),
        is_after,
        subtrees: linked_subtrees(measurement, index),
    })
}

/// Length of the segments of a log \[s\].
fn segment_seconds(log: &PreparedLog) -> f64 {
    ((log.span.1 - log.span.0).seconds() / SEGMENTS as f64).max(SEGMENT_SECONDS)
}

/// All sub-trees whose rows share links or channels with those of the link at this index.
fn linked_subtrees(measurement: &MeasurementModel<'_>, index: usize) -> SubtreeSet {
    let structure = &measurement.robot().structure;
    let (unknowns, groups) = (measurement.unknowns(), &measurement.groups().links);
    let mut subtrees = SubtreeSet::default();
    for (other, group) in unknowns.links.iter().zip(groups) {
        if *group == groups[index] {
            subtrees.insert(structure.subtree_of(*other).unwrap_or(0));
            if !unknowns.joints.is_empty() {
                subtrees.insert(Observation::TORQUES);
            }
        }
    }
    subtrees
}

/// The search for a load that changes: what each segment tells, and all of them together.
struct LoadSearch<'a> {
    links: &'a [usize],
    prior: &'a Prior,
    reduced: Vec<ReducedLog>,
    factor: Cholesky<f64, Dyn>,
    x: DVector<f64>,
}

impl<'a> LoadSearch<'a> {
    fn new(
        measurement: &'a MeasurementModel<'_>,
        segments: &[LogSegment<'_>],
        estimate: &'a NoiseAndMap,
    ) -> Option<Self> {
        let (unknowns, prior) = (measurement.unknowns(), &estimate.prior);
        let reduced = reduced_segments(measurement, segments, &estimate.noise);
        let mut all = Normal::of(unknowns.parameters(), &reduced);
        all.add_prior(prior, unknowns, estimate.fit.tau, &|_| false);
        let factor = all.matrix.cholesky()?;
        Some(Self {
            links: &unknowns.links,
            prior,
            reduced,
            x: factor.solve(&all.right),
            factor,
        })
    }

    /// Tests all changes within a log with these segments. With several logs, one of them may have
    /// the load throughout.
    fn search_log(
        &self,
        log: usize,
        range: &Range<usize>,
        is_one_of_several: bool,
        best: &mut Option<LoadCandidate>,
    ) {
        let reduced = &self.reduced[range.clone()];
        let mut before = Normal::new(self.x.len());
        let whole = Normal::of(self.x.len(), reduced);
        if is_one_of_several {
            self.test((log, range.start), &before, &whole, true, best);
        }
        for (number, own) in reduced[..reduced.len() - LEAST_SEGMENTS].iter().enumerate() {
            before.add(&own.information);
            if number + 1 >= LEAST_SEGMENTS {
                let after = Normal {
                    matrix: &whole.matrix - &before.matrix,
                    right: &whole.right - &before.right,
                };
                let at = range.start + number + 1;
                self.test((log, at), &before, &after, false, best);
            }
        }
    }

    /// Tests a change at this segment of a log, on every link.
    fn test(
        &self,
        (log, at): (usize, usize),
        before: &Normal,
        after: &Normal,
        is_throughout: bool,
        best: &mut Option<LoadCandidate>,
    ) {
        // The threshold is that of a single test, because the noise still includes the load. The
        // noise of the fit without it decides.
        let least = needed(LINK_PARAMETERS, 1);
        // What one log has throughout more than the others is a load in it, not one that is
        // missing.
        let may_be = |added: &AddedBody| !is_throughout || added.parameters[0] > 0.0;
        let gains = parallel::map(self.links.len(), |index| {
            let weak = weak(self.prior, self.links[index]);
            [after, before].map(|some| {
                body(&weak, index, some, &self.factor, &self.x)
                    .filter(|(added, _)| added.is_a_body() && may_be(added))
                    .map_or(0.0, |(_, gain)| gain)
            })
        });
        for (index, [later, earlier]) in gains.into_iter().enumerate() {
            let gain = later.max(earlier);
            let is_better = |best: &LoadCandidate| gain > best.later.max(best.earlier);
            if gain > least && best.as_ref().is_none_or(is_better) {
                *best = Some(LoadCandidate {
                    log,
                    at,
                    index,
                    later,
                    earlier,
                });
            }
        }
    }
}

/// The inertial parameters of a load, from the part of the log that was excluded for it and from
/// all used data; and the index of the link that it is on, which shows better than when it was
/// found, since the noise no longer contains it.
pub(crate) fn added_body(
    measurement: &MeasurementModel<'_>,
    training: &[&PreparedLog],
    load: &LoadChange,
    estimate: &NoiseAndMap,
) -> Option<(usize, AddedBody)> {
    let log = training.get(load.log)?;
    let is_clear = |instant: &&Annotated| load.clear.0 <= instant.t && instant.t <= load.clear.1;
    let first = log.instants.iter().position(|instant| is_clear(&instant))?;
    let count = log.instants[first..].iter().take_while(is_clear).count();
    let mut measurement = measurement.clone();
    measurement.include_disturbed(true);
    let segment = LogSegment {
        instants: &log.instants[first..first + count],
        log: Some(load.log),
    };
    let reduced = reduce(&mut measurement, segment, &estimate.noise);
    let (unknowns, prior) = (measurement.unknowns(), &estimate.prior);
    let some = Normal::of(unknowns.parameters(), std::slice::from_ref(&reduced));
    let mut all = some.clone();
    all.add(&estimate.information);
    all.add_prior(prior, unknowns, estimate.fit.tau, &|_| false);
    let factor = all.matrix.cholesky()?;
    let x = factor.solve(&all.right);
    let each = unknowns.links.iter().enumerate();
    let each = each.filter_map(|(index, &link)| {
        let (added, gain) = body(&weak(prior, link), index, &some, &factor, &x)?;
        added.is_a_body().then_some((gain, index, added))
    });
    let (_, index, added) = each.max_by(|a, b| a.0.total_cmp(&b.0))?;
    Some((index, added))
}
