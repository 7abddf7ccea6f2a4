//! The job of on-line identification ([`SolutionJob`]), which any thread may run, and each
//! component's part of it: noise, the most probable bodies, changes, and the parameters in use.

use crate::arithmetic::mean;
use crate::linear::information::{Information, Panel};
use crate::measurement::noise_estimate::LEAST_SHARE;
use crate::online::bank::{self, Bank, LATEST, Tick};
use crate::online::component::{Component, ComponentLayout};
use crate::online::noise_tracker::{NoiseTracker, SecondMean, SecondResiduals, take_scatters};
use crate::online::parameters::ParameterEstimate;
use crate::online::rows::{RowBuffer, SubtreeRows, expand};
use crate::online::selection::{self, ModelSelection};
use crate::online::solution::{ComponentSolution, DetectedChange, SOLVE, Solution};
use crate::prior::{Posterior, Prior, PriorError};
use nalgebra::{DMatrix, DMatrixView, DVector};
use proprio_dynamics::calibration::UNKNOWN_OFFSET;
use proprio_dynamics::spatial::Wrench;
use proprio_topics::Nanos;
use std::sync::Arc;

/// Duration of rejection, with tilting sensors, after which a change is tested \[s\].
pub(crate) const PERSISTENT: f64 = 3.0;

/// Duration up to which a disturbance is a push rather than an offset jump \[s\]: a force that is
/// steady in the sensor's axes looks like one. A jump is a tenth as usual as a push, and of pushes
/// of some four seconds in the mean a tenth lasts longer.
pub(crate) const PUSH: f64 = 10.0;

/// Cosine of the least tilt of a sensor for that test, 20 degrees. Without tilt an offset, a weight
/// and a push are not separable.
pub(crate) const TILTED_COSINE: f64 = 0.94;

/// Mean square of the innovations after a change, in units of inflated noise, up to which the
/// change explains them.
pub(crate) const EXPLAINED: f64 = 1.0;

/// Squared Newton decrements of the fits for the prior's weight, and for the solution: a hundredth
/// and a ten-thousandth of a standard deviation.
pub(crate) const PRIOR_WEIGHT_TOLERANCE: f64 = 1e-4;

pub(crate) const SOLUTION_TOLERANCE: f64 = 1e-8;

/// Logarithmic step of the prior's weight that needs no second fit in the same job.
pub(crate) const SETTLED: f64 = 1e-3;

/// Longest series of residuals [observations]. Longer ones come from unexplained gaps.
pub(crate) const LONGEST: usize = 100_000;

/// A component's part of a job.
#[derive(Clone, Debug)]
pub(crate) struct ComponentJob {
    pub(crate) layout: Arc<ComponentLayout>,
    pub(crate) information: Information,
    pub(crate) accepted_rows: RowBuffer,
    pub(crate) rejected_rows: RowBuffer,
    pub(crate) is_disturbed: bool,
    /// Whether a sensor's offset was forgotten since the solution in use.
    pub(crate) has_new_zero: bool,
    /// [`Component::cosines`].
    pub(crate) cosines: Vec<f64>,
    /// Inflated variances of the channels.
    pub(crate) variances: Vec<f64>,
    pub(crate) channels: Vec<NoiseTracker>,
    /// The sensitivities of the previous second's means to the bodies, a column per channel, and
    /// the parameters used for them.
    pub(crate) before: Option<(DMatrix<f64>, Vec<f64>)>,
    /// The variances with which the rows are whitened.
    pub(crate) row_variances: Vec<f64>,
    pub(crate) drift_std: Vec<f64>,
    pub(crate) period: f64,
    pub(crate) tau: f64,
    /// Why the last job failed.
    pub(crate) failure: Option<PriorError>,
    pub(crate) seconds_in_motion: f64,
    pub(crate) rows: u64,
    /// The last valid solution.
    pub(crate) last_valid: ComponentSolution,
    /// The most probable unknowns, `[s | d]`, a root of their covariance, and the parameters; then
    /// the parameters in use and their candidates.
    pub(crate) estimate: Vec<f64>,
    pub(crate) covariance_root: DMatrix<f64>,
    pub(crate) newest: ParameterEstimate,
    pub(crate) selection: ModelSelection<ParameterEstimate>,
    /// Whether the parameters in use must be replaced.
    pub(crate) is_replaced: bool,
    /// The information in the rejected rows, and the time over which they were collected \[s\].
    pub(crate) rejected_information: Information,
    pub(crate) rejected_time: f64,
    /// How long the disturbance has lasted \[s\].
    pub(crate) disturbed_time: f64,
    /// Their slots.
    pub(crate) rejected_slots: Vec<i64>,
    pub(crate) change: Option<(DetectedChange, Information)>,
}

/// Per block of a tenth of a second: its time and the mean of each channel.
pub(crate) type TimedMeans = Vec<(f64, Vec<f64>)>;

/// The range of observations of some rows.
pub(crate) struct SlotRange {
    pub(crate) first: i64,
    pub(crate) count: usize,
}

impl SlotRange {
    /// None if there are no rows, or if they have unexplained gaps.
    pub(crate) fn of<'a>(rows: impl Iterator<Item = &'a RowBuffer>) -> Option<Self> {
        let ends = |rows: &'a RowBuffer| rows.iter().flat_map(SubtreeRows::slots).copied();
        let (first, last) = rows
            .flat_map(ends)
            .fold((i64::MAX, i64::MIN), |(a, b), slot| {
                (a.min(slot), b.max(slot))
            });
        let count = usize::try_from(last.checked_sub(first)?).ok()? + 1;
        (count <= LONGEST).then_some(Self { first, count })
    }

    pub(crate) fn place(&self, slot: i64) -> Option<usize> {
        usize::try_from(slot - self.first)
            .ok()
            .filter(|at| *at < self.count)
    }
}

impl ComponentJob {
    pub(crate) fn new(
        component: &Component,
        last_valid: ComponentSolution,
        period: Nanos,
        prior: &Prior,
        relative: f64,
    ) -> Self {
        Self {
            layout: component.layout.clone(),
            information: component.information.clone(),
            accepted_rows: component.accepted_rows.clone_room(),
            rejected_rows: component.rejected_rows.clone_room(),
            is_disturbed: false,
            has_new_zero: false,
            cosines: component.cosines.clone(),
            variances: component.variances.clone(),
            channels: component.layout.trackers(period.seconds()),
            before: None,
            row_variances: component.variances.clone(),
            drift_std: component.drift_std.clone(),
            period: period.seconds(),
            tau: prior.expected_tau(),
            failure: None,
            seconds_in_motion: 0.0,
            rows: 0,
            estimate: Vec::new(),
            covariance_root: DMatrix::zeros(0, 0),
            newest: ParameterEstimate::default(),
            selection: ModelSelection::new(
                component.variances.len(),
                ParameterEstimate::of_cad(&last_valid.bodies, relative),
            ),
            is_replaced: false,
            last_valid,
            rejected_information: Information::new(component.information.unknowns()),
            rejected_time: 0.0,
            disturbed_time: 0.0,
            rejected_slots: Vec::new(),
            change: None,
        }
    }

    pub(crate) fn run(
        &mut self,
        prior: &Prior,
        data_until: Nanos,
        solution: &mut ComponentSolution,
        may_end: bool,
        is_rather_a_contact: impl FnOnce(&[i64]) -> bool,
    ) {
        // A new load is in the information by now, but not in the parameters in use.
        let is_replaced = std::mem::take(&mut self.is_replaced);
        self.change = None;
        let weighed = if may_end {
            self.change = Some((
                DetectedChange::Anew,
                Information::new(self.information.unknowns()),
            ));
            self.is_replaced = true;
            Ok(())
        } else {
            self.test_change(prior, is_rather_a_contact)
        };
        self.update_noise();
        self.judge_candidates();
        self.failure = weighed.and_then(|()| self.solve(prior)).err();
        match &self.failure {
            // The job's own solution is older than the one in use.
            Some(_) => solution.clone_from(&self.last_valid),
            None => {
                if is_replaced {
                    self.selection.replace_all(self.newest.clone());
                }
                let newest = &self.newest;
                self.selection.enter(|| newest.clone());
                self.write_solution(solution);
                solution.data_until = data_until;
            }
        }
        solution.is_accepted = self.failure.is_none();
        (solution.seconds_in_motion, solution.rows) = (self.seconds_in_motion, self.rows);
        if solution.is_accepted {
            self.last_valid.clone_from(solution);
        }
    }

    /// Solves for the most probable bodies and offsets.
    pub(crate) fn solve(&mut self, prior: &Prior) -> Result<(), PriorError> {
        let (offset_count, parameters) = (self.layout.offset_count(), self.layout.parameters());
        let unknowns = offset_count + parameters;
        let posterior = self.posterior(prior, &self.information)?;
        // One iteration of the evidence per second: it converges while data come in. The last
        // solution is a good start.
        let last: Vec<f64> = match self.estimate.split_at_checked(offset_count) {
            Some((offsets, bodies)) => bodies.iter().chain(offsets).copied().collect(),
            None => vec![0.0; unknowns],
        };
        let mut fit = posterior.fit_from(&last, self.tau, PRIOR_WEIGHT_TOLERANCE)?;
        let tau = fit.next_tau();
        if (tau / self.tau).ln().abs() > SETTLED || fit.decrement > SOLUTION_TOLERANCE {
            fit = posterior.fit_from(fit.x.as_slice(), tau, SOLUTION_TOLERANCE)?;
        }
        self.tau = tau;
        // [d | s] -> [s | d]
        let (bodies, offsets) = fit.x.as_slice().split_at(parameters);
        self.estimate.clear();
        self.estimate.extend_from_slice(offsets);
        self.estimate.extend_from_slice(bodies);
        self.covariance_root = fit.covariance_root().transpose();
        self.newest = ParameterEstimate {
            change: bodies.to_vec(),
            root: self.covariance_root.columns(0, parameters).into_owned(),
            tau: fit.tau,
            effective: fit.effective,
            bodies: fit.bodies,
        };
        Ok(())
    }

    /// Judges the candidates by the rows of this second.
    pub(crate) fn judge_candidates(&mut self) {
        // At rest all parameters predict equally well.
        let is_any = self.accepted_rows.is_moving() && !self.estimate.is_empty();
        let Some(span) = SlotRange::of([&self.accepted_rows].into_iter()).filter(|_| is_any) else {
            return;
        };
        let residuals: Vec<TimedMeans> = self
            .selection
            .all()
            .map(|own| self.blocks(&span, &own.change))
            .collect();
        for (number, (t, _)) in residuals.first().into_iter().flatten().enumerate() {
            self.selection
                .take(*t, residuals.iter().map(|own| own[number].1.as_slice()));
        }
        // The parameters in use stay if the mixture fails, which needs numbers that are not finite.
        let between = |old: &ParameterEstimate, new: &ParameterEstimate, share| {
            ParameterEstimate::between(old, new, share).unwrap_or_else(|_| old.clone())
        };
        self.selection.decide(between);
    }

    /// The mean residual of each channel in each block of this second's rows, for these parameters:
    /// time, and per channel.
    pub(crate) fn blocks(&self, span: &SlotRange, change: &[f64]) -> TimedMeans {
        let offset_count = self.variances.len();
        let unknowns: Vec<f64> = self
            .estimate
            .iter()
            .take(offset_count)
            .chain(change)
            .copied()
            .collect();
        let (series, _) = self.series(&[&self.accepted_rows], span, &unknowns);
        let per_block = (selection::BLOCK / self.period).round().max(1.0) as usize;
        let starts = (0..span.count).step_by(per_block);
        let blocks = starts.map(|from| {
            let channels = series.chunks_exact(span.count);
            let block = channels.map(|own| own.iter().skip(from).take(per_block));
            let means: Vec<f64> = block.map(mean).collect();
            ((span.first as f64 + from as f64) * self.period, means)
        });
        blocks
            .filter(|(_, means)| means.iter().any(|x| x.is_finite()))
            .collect()
    }

    /// Writes the solution in use: the parameters, the offsets that fit them best, and the
    /// uncertainty of both.
    pub(crate) fn write_solution(&self, solution: &mut ComponentSolution) {
        let in_use = self.selection.in_use();
        let (change, root) = (&in_use.change, &in_use.root);
        let (offset_count, parameters) = (self.variances.len(), change.len());
        let (r, z) = self.information.to_triangle();
        // R_ss s = z - R_sd d, and the prior of the offsets.
        let mut of_offsets = DMatrix::zeros(2 * offset_count, offset_count + parameters + 1);
        for i in 0..offset_count {
            for j in i..offset_count + parameters {
                of_offsets[(i, j)] = r[(i, j)];
            }
            of_offsets[(i, offset_count + parameters)] = z[i];
            of_offsets[(offset_count + i, i)] = 1.0 / UNKNOWN_OFFSET[i % 6];
        }
        let qr = of_offsets.columns(0, offset_count).into_owned().qr();
        qr.q_tr_mul(&mut of_offsets);
        let triangle = qr.r();
        let mut solved = of_offsets
            .view((0, offset_count), (offset_count, parameters + 1))
            .into_owned();
        let _ = triangle.solve_upper_triangular_mut(&mut solved);
        let slope = solved.columns(0, parameters);
        let offsets = solved.column(parameters) - slope * DVector::from_column_slice(change);
        solution.estimate.clone_from(&self.estimate);
        solution.covariance_root.clone_from(&self.covariance_root);
        // [d | s]: the error of d enters s by the slope.
        let own = root.nrows();
        let mut joint = DMatrix::zeros(own + offset_count, parameters + offset_count);
        joint.view_mut((0, 0), (own, parameters)).copy_from(root);
        joint
            .view_mut((0, parameters), (own, offset_count))
            .copy_from(&(root * slope.transpose() * -1.0));
        let inverse = triangle
            .try_inverse()
            .unwrap_or_else(|| DMatrix::from_element(offset_count, offset_count, f64::INFINITY));
        joint
            .view_mut((own, parameters), (offset_count, offset_count))
            .copy_from(&inverse.transpose());
        solution.root = joint;
        (solution.tau, solution.effective) = (in_use.tau, in_use.effective);
        solution.bodies.clone_from(&in_use.bodies);
        let drift_std = self.drift_std.chunks_exact(6);
        for (to, of_sensor) in solution.drift_std.iter_mut().zip(drift_std) {
            to.copy_from_slice(of_sensor);
        }
        let noise = solution.noise.iter_mut().zip(&mut solution.worst);
        for ((noise, worst), six) in noise.zip(self.channels.chunks_exact(6)) {
            *noise = std::array::from_fn(|i| six[i].reading());
            *worst = std::array::from_fn(|i| six[i].worst());
        }
        for (place, offset) in solution.offsets.iter_mut().enumerate() {
            let six = |i: usize| self.layout.reference[6 * place + i] + offsets[6 * place + i];
            *offset = Wrench::from_torque_first(std::array::from_fn(six));
        }
    }

    /// Updates the channels' noise from this second's rows and the earlier estimate. Whitened
    /// residuals are mapped back to channels (Gauss, Markov).
    pub(crate) fn update_noise(&mut self) {
        let (offset_count, unknowns) = (self.variances.len(), self.information.unknowns());
        let mut seconds = vec![SecondResiduals::NONE; offset_count];
        let rows = [&self.accepted_rows, &self.rejected_rows];
        let is_solved =
            self.estimate.len() == unknowns && self.newest.root.ncols() + offset_count == unknowns;
        let Some(span) = SlotRange::of(rows.into_iter()).filter(|_| is_solved) else {
            return self.take_seconds(&seconds);
        };
        let is_moving = rows.iter().any(|rows| rows.is_moving());
        let observations = span.count;
        let (series, shown) = self.series(&rows, &span, &self.estimate);
        let mut sensitivities = self.sensitivities(&rows);
        let counts: Vec<f64> = (series.chunks_exact(observations))
            .map(|own| own.iter().filter(|x| x.is_finite()).count() as f64)
            .collect();
        // Where rows mix channels, the most likely noise of each varies less than its noise, by a
        // known share.
        let shares: Vec<f64> = (shown.iter().zip(&counts))
            .map(|(shown, count)| (shown / count).clamp(LEAST_SHARE, 1.0))
            .collect();
        for ((mut column, count), share) in
            sensitivities.column_iter_mut().zip(&counts).zip(&shares)
        {
            column /= count.max(1.0) * share.sqrt();
        }
        // While the robot is as in the previous second, the bodies' error acts as a part of the
        // offset. A change of posture changes it by |U (s - s')|.
        let bodies = &self.estimate[offset_count..];
        let before = match self.before.take() {
            Some((before, others)) => {
                let change = DVector::from_fn(bodies.len(), |i, _| bodies[i] - others[i]);
                let shifts = before.tr_mul(&change);
                self.channels
                    .iter_mut()
                    .zip(&shifts)
                    .for_each(|(own, shift)| own.shift(-shift));
                before
            }
            None => sensitivities.clone(),
        };
        let of_bodies = &self.newest.root * (&sensitivities - before);
        self.before = Some((sensitivities, bodies.to_vec()));
        for (channel, own) in self.channels.iter_mut().enumerate() {
            // An offset jump is no drift.
            if self.change.is_some() || self.has_new_zero {
                own.interrupt();
            }
            let seen = || {
                series[channel * observations..][..observations]
                    .iter()
                    .filter(|x| x.is_finite())
            };
            let (count, share) = (counts[channel], shares[channel]);
            if count > 0.0 {
                let mean = seen().sum::<f64>() / count;
                let squares = seen().map(|x| (x - mean) * (x - mean)).sum::<f64>();
                let (mean, scatter) = (mean / share.sqrt(), squares / (count * share));
                let is_likely_noise = own.take(&SecondMean {
                    t: (span.first as f64 + 0.5 * span.count as f64) * self.period,
                    mean: self.estimate[channel] + mean,
                    count,
                    of_bodies: of_bodies.column(channel).norm_squared(),
                    scatter,
                    is_moving,
                });
                seconds[channel] = SecondResiduals {
                    mean,
                    scatter,
                    is_likely_noise,
                };
            }
            (self.variances[channel], self.drift_std[channel]) = own.noise();
        }
        self.take_seconds(&seconds);
    }

    /// Takes in the residuals of each channel in this second.
    fn take_seconds(&mut self, seconds: &[SecondResiduals]) {
        let sensors = self.channels.chunks_exact_mut(6);
        for (six, seconds) in sensors.zip(seconds.chunks_exact(6)) {
            take_scatters(six, seconds);
        }
    }

    /// Maps whitened residuals back to channels (Gauss, Markov): per channel and observation its
    /// share of the residuals for these unknowns, NaN where no row has it. Also per channel the
    /// visible part of one unit of its own noise, summed over observations.
    pub(crate) fn series(
        &self,
        rows: &[&RowBuffer],
        span: &SlotRange,
        unknowns: &[f64],
    ) -> (Vec<f64>, Vec<f64>) {
        let offset_count = self.variances.len();
        let mut series = vec![f64::NAN; offset_count * span.count];
        let mut shown = vec![0.0; offset_count];
        for rows in rows {
            for (kind, rows) in self.layout.kinds.iter().zip(rows.iter()) {
                for (row, right, slot) in rows.iter() {
                    let residual = kind.residual(row, right, unknowns);
                    let Some(place) = span.place(slot) else {
                        continue;
                    };
                    for (value, &channel) in row.iter().zip(&kind.columns[..kind.offsets]) {
                        if *value != 0.0 {
                            let weight = self.row_variances[channel] * value;
                            let sum = &mut series[channel * span.count + place];
                            *sum = if sum.is_nan() { 0.0 } else { *sum } + weight * residual;
                            shown[channel] += weight * value;
                        }
                    }
                }
            }
        }
        (series, shown)
    }

    /// The sensitivity of each channel's share, summed over observations, to the bodies: its column
    /// of rows^T x weights.
    pub(crate) fn sensitivities(&self, rows: &[&RowBuffer]) -> DMatrix<f64> {
        let (offset_count, unknowns) = (self.variances.len(), self.information.unknowns());
        let mut sensitivities = DMatrix::zeros(unknowns - offset_count, offset_count);
        for rows in rows {
            for (kind, rows) in self.layout.kinds.iter().zip(rows.iter()) {
                let (width, count) = (kind.width(), rows.slots().len());
                let all = DMatrixView::from_slice(rows.values(), width, count);
                let weights = DMatrix::from_fn(count, kind.offsets, |row, place| {
                    self.row_variances[kind.columns[place]] * all[(place, row)]
                });
                let own = all * &weights;
                for (place, column) in own.column_iter().enumerate() {
                    let bodies = kind.columns.iter().zip(column.iter()).skip(kind.offsets);
                    bodies.for_each(|(at, value)| {
                        sensitivities[(at - offset_count, kind.columns[place])] += value;
                    });
                }
            }
        }
        sensitivities
    }

    /// Tests whether a change explains the rejected rows: an offset jump of the tilted sensors, or
    /// another load.
    ///
    /// A push explains any reading, so it is the alternative unless a change fits in many postures,
    /// an offset jump better than a steady push. It also does no harm: nothing is learnt from its
    /// rows.
    pub(crate) fn test_change(
        &mut self,
        prior: &Prior,
        is_rather_a_contact: impl FnOnce(&[i64]) -> bool,
    ) -> Result<(), PriorError> {
        if !self.is_disturbed {
            self.drop_rejected();
            self.disturbed_time = 0.0;
            return Ok(());
        }
        self.disturbed_time += SOLVE.seconds();
        // Nothing is rejected under a declared contact, or without a sensor: that time does not
        // count.
        if self.rejected_rows.is_empty() {
            return Ok(());
        }
        let unknowns = self.information.unknowns();
        let mut panel = Panel::new(unknowns, self.rejected_rows.len());
        let mut dense = vec![0.0; unknowns];
        for (kind, rows) in self.layout.kinds.iter().zip(self.rejected_rows.iter()) {
            for (row, right, _) in rows.iter() {
                expand(kind, row, &mut dense);
                let _ = panel.push_row(&dense, right);
            }
            self.rejected_slots.extend(rows.slots());
            self.rejected_slots.dedup();
        }
        // The bank has no older ticks.
        let kept = (LATEST as f64 * bank::TICK.seconds() / self.period) as i64;
        let newest = self.rejected_slots.iter().max().copied().unwrap_or(0);
        self.rejected_slots.retain(|slot| slot + kept > newest);
        let _ = self.rejected_information.absorb(&mut panel);
        self.rejected_time += SOLVE.seconds();
        let tilted: Vec<usize> = (self.cosines.iter().enumerate())
            .filter(|(_, cosine)| **cosine < TILTED_COSINE)
            .flat_map(|(place, _)| 6 * place..6 * place + 6)
            .collect();
        if self.rejected_time < PERSISTENT || tilted.is_empty() {
            return Ok(());
        }
        let all: Vec<usize> = (0..unknowns).collect();
        let (mut best, mut least) = (None, EXPLAINED * self.rejected_information.rows() as f64);
        let outermost = &self.layout.outermost;
        for (change, columns) in [
            (DetectedChange::Offset, &tilted),
            (DetectedChange::Load, outermost),
        ] {
            let mut fresh = self.information.clone();
            if columns.is_empty() || fresh.marginalise(columns).is_err() {
                continue;
            }
            let before = self.misfit(prior, &fresh)?;
            let _ = fresh.merge(&self.rejected_information, &all);
            let increase = self.misfit(prior, &fresh)? - before;
            if increase < least {
                (best, least) = (Some((change, fresh)), increase);
            }
        }
        // A load looks like a steady force, so only its inertia tells it from a push.
        if let Some((change, information)) = best
            && (change == DetectedChange::Load
                || self.disturbed_time > PUSH && !is_rather_a_contact(&self.rejected_slots))
        {
            // The parameters in use do not include the load; an offset jump does not affect them.
            self.is_replaced = change == DetectedChange::Load;
            self.change = Some((change, information));
        }
        // A load that is being picked up fits no hypothesis yet. Unexplained rows are dropped, and
        // the test is repeated with new ones.
        self.drop_rejected();
        Ok(())
    }

    fn drop_rejected(&mut self) {
        self.rejected_information.clear();
        self.rejected_time = 0.0;
        self.rejected_slots.clear();
    }

    /// The squared residual of the most probable bodies for these data, plus twice their cost under
    /// the prior.
    pub(crate) fn misfit(
        &self,
        prior: &Prior,
        information: &Information,
    ) -> Result<f64, PriorError> {
        let fit = self.posterior(prior, information)?.fit(self.tau)?;
        Ok(fit.residual_square
            + information.residual_square()
            + fit.divergence / (fit.tau * fit.tau))
    }

    /// The posterior of data and prior, over `[d | s]`.
    pub(crate) fn posterior(
        &self,
        prior: &Prior,
        information: &Information,
    ) -> Result<Posterior, PriorError> {
        let (offset_count, parameters) = (self.layout.offset_count(), self.layout.parameters());
        let (root, right) = information.to_triangle();
        // [s | d] -> [d | s]
        let order: Vec<usize> = (offset_count..offset_count + parameters)
            .chain(0..offset_count)
            .collect();
        let precision: Vec<f64> = (0..offset_count)
            .map(|i| UNKNOWN_OFFSET[i % 6].powi(-2))
            .collect();
        Posterior::new(
            prior,
            &self.layout.links,
            &root.select_columns(&order),
            &right,
            &precision,
        )
    }
}

/// A snapshot of the information, to be solved in any thread. The result depends on the snapshot
/// alone.
#[derive(Debug)]
pub struct SolutionJob {
    pub(crate) prior: Arc<Prior>,
    pub(crate) data_until: Nanos,
    pub(crate) components: Vec<ComponentJob>,
    pub(crate) solution: Solution,
    pub(crate) bank: Bank,
    /// The first `tick_count` are new.
    pub(crate) ticks: Vec<Tick>,
    pub(crate) tick_count: usize,
}

impl SolutionJob {
    /// Solves: prior with its weight by evidence, physical bodies, covariance, noise, changes.
    /// Takes one or two milliseconds for a single limb, a tenth of a second for 426 linked
    /// unknowns, longer if bodies have changed much, and allocates.
    pub fn run(&mut self) {
        self.solution.data_until = self.data_until;
        for (number, (part, solution)) in (self
            .components
            .iter_mut()
            .zip(&mut self.solution.components))
        .enumerate()
        {
            let may_end = part.is_disturbed && self.bank.may_have_begun_in_contact(number);
            let (bank, ticks) = (&mut self.bank, &self.ticks[..self.tick_count]);
            let is_push = |slots: &[i64]| bank.is_rather_a_contact(number, slots, ticks);
            part.run(&self.prior, self.data_until, solution, may_end, is_push);
        }
        self.weigh_hypotheses();
    }

    /// Weighs what may be other than stated.
    fn weigh_hypotheses(&mut self) {
        let mut decided = Vec::new();
        for part in &self.components {
            let mut slots: Vec<i64> = part
                .accepted_rows
                .iter()
                .flat_map(SubtreeRows::slots)
                .copied()
                .collect();
            slots.sort_unstable();
            slots.dedup();
            decided.push((slots.last().copied().unwrap_or(i64::MIN), slots));
        }
        let ticks = &self.ticks[..self.tick_count];
        self.bank.learn(ticks, &decided);
        for (number, part) in self.components.iter().enumerate() {
            if let Some((change, _)) = part.change {
                self.bank.forget(number, change);
            } else if part.has_new_zero {
                // A contact may be there since: that again is to be refuted.
                self.bank.forget(number, DetectedChange::Anew);
            }
        }
        let those = |is: fn(&ComponentJob) -> bool| {
            let those = (self.components.iter().enumerate()).filter(|(_, part)| is(part));
            bank::bits(those.map(|(number, _)| number))
        };
        let disturbed = those(|part| part.is_disturbed);
        let anew = those(|part| part.has_new_zero);
        self.bank.doubt(&mut self.solution, disturbed, anew);
    }

    /// The result.
    pub fn solution(&self) -> &Solution {
        &self.solution
    }

    /// For each component why its solution failed, if it did. The earlier solution stays in use.
    pub fn failures(&self) -> impl Iterator<Item = Option<&PriorError>> {
        self.components.iter().map(|part| part.failure.as_ref())
    }
}
