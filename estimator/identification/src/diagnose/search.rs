//! The search for errors of the set-up that a fit shows: encoders that count backwards or have
//! another zero, readings that are stamped late.
//!
//! Every hypothesis is judged by the same evidence, the cost of a fit with it: squared residuals
//! plus twice the prior's cost, at the prior's scale. The hypothesis that lowers the cost the most
//! is accepted if it does so by more than parameters and noise do ([`crate::nested_test`]); then
//! the next beside it ([`crate::nested_test::accepted`]). What is found is reported, not corrected.
//!
//! # Encoder sign
//! Other rows: positions, velocities and accelerations are negated. Tested before gains of the F/T
//! sensors are fitted, 36 of which would make up for much of a wrong sign. If a sign is wrong,
//! nothing else is tested: it looks like zeros of other joints.
//!
//! # Encoder zero
//! An unknown with a prior, whose column is a difference of the rows. A zero of a joint beyond or
//! between F/T sensors shifts a centre of mass. That of a joint between the base and the sensors
//! tilts everything beyond by an amount that depends on the posture; only for the joint at the base
//! it is not separable from a base that is not level. The error is the same in all logs, or present
//! in one of several: incremental encoders find their zero again at each start.
//!
//! # Delay
//! What happens at `t` is stamped `t + delay`: an unknown with a prior, whose column is the
//! negative rate of change of the stream. An error of the friction model makes each joint torque
//! seem late by a different time (a real arm with joint torque sensors: 10 to 95 ms, but no delay
//! of all together); and friction and masses that were fitted to late torques absorb most of a
//! delay. So joint torques are one stream. A single torque is reported only if its delay differs
//! from the common one of the others by far more than any of theirs does, and the others together
//! have no delay: the reference is the encoders, not the majority.

use crate::arithmetic::dot;
use crate::dataset::observation::{Annotated, Observation};
use crate::finding::{Finding, FindingCode};
use crate::fit::{Identified, NoiseAndMap, added};
use crate::linear::information::Information;
use crate::measurement::channels::sensor_name;
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::{LogSegment, reduce, reduce_with, residuals};
use crate::measurement::rows::MeasurementRows;
use crate::measurement::unknowns::Unknowns;
use crate::nested_test::{accepted, needed, threshold};
use crate::prepared_log::PreparedLog;
use crate::prior::{MapEstimate, Posterior};
use crate::readings::MotionReading;
use crate::report::outcome::TimeOffset;
use crate::robot::Robot;
use nalgebra::{DMatrix, DVector};
use proprio_dynamics::model::{Joint, JointKind};
use std::f64::consts::FRAC_1_SQRT_2;
use std::ops::Range;

/// Prior standard deviation of an encoder's zero \[rad\], and of a delay \[s\].
const ZERO_STD: f64 = 0.1;
const DELAY_STD: f64 = 0.05;

/// A step of an encoder whose effect is linear \[rad\].
const STEP: f64 = 1e-5;

/// Smallest zero that is reported \[rad\] ...
const MIN_ZERO: f64 = 0.01;

/// ... of a joint between the base and the sensors: floors and bases are tilted by less ...
const MIN_ZERO_BEFORE_SENSORS: f64 = 0.02;

/// ... and smallest delay \[s\].
const MIN_DELAY: f64 = 2e-3;

/// Observations that are used in all, and of each log at least.
const ENOUGH: [usize; 2] = [4000, 400];

/// The same for signs: a wrong sign shows in fewer observations.
const ENOUGH_FOR_SIGN: [usize; 2] = [1200, 300];

/// Stretches of consecutive instants per log. Offsets and noise need consecutive instants, and each
/// stretch has sensor offsets of its own.
const STRETCHES: usize = 4;

/// Fraction of the cost that the right sign must save. The noise is that of a fit with the wrong
/// sign, which leaves most of the cost; a joint that hardly moves may save a little by chance of
/// the model's errors.
const SURE: f64 = 0.25;

/// Most likely candidates that are fitted in each round.
const TRIED: usize = 6;

/// A single torque is reported if its delay exceeds that of any other by this factor. (A real arm
/// with joint torque sensors, whose friction makes them seem late, reaches 3.7.)
const SINGLE: f64 = 8.0;

/// Rates are computed over this time before and after an instant \[s\], because friction changes
/// its sign suddenly.
const REACH: f64 = 0.03;

/// The squared residuals of a fit plus twice its prior cost.
fn cost(unknowns: &Unknowns, fit: &MapEstimate, precision: &[f64]) -> f64 {
    let extra = fit.x.iter().skip(unknowns.inertial());
    let extra = extra.zip(precision).map(|(x, precision)| x * x * precision);
    fit.residual_square + fit.divergence / fit.tau.powi(2) + extra.sum::<f64>()
}

/// Instants of all logs, so many in all and of each log at least, in stretches from the first to
/// the last.
fn stretches<'a>(training: &[&'a PreparedLog], enough: [usize; 2]) -> Vec<Vec<LogSegment<'a>>> {
    let share = (enough[0] / training.len().max(1)).max(enough[1]);
    let of_log = |log: &&'a PreparedLog| {
        let all = log.instants.as_slice();
        let stretches = if all.len() > share { STRETCHES } else { 1 };
        let count = all.len().min(share) / stretches;
        let segment = |stretch: usize| {
            let start = (all.len() - count) * stretch / (stretches - 1).max(1);
            LogSegment::alone(&all[start..start + count])
        };
        (0..stretches).map(segment).collect()
    };
    training.iter().map(of_log).collect()
}

/// The revolute joint of a degree of freedom.
fn revolute(robot: &Robot, dof: usize) -> Option<&Joint> {
    let joint = robot.model.dof_joint(dof)?;
    let joint = &robot.model.joints()[joint];
    matches!(joint.kind, JointKind::Revolute(_)).then_some(joint)
}

/// The degrees of freedom that are tested. (A joint that moves no identified link has columns of
/// zeros, and explains nothing.)
fn turning(robot: &Robot) -> Vec<usize> {
    let is_tested = |dof: &usize| robot.locked[*dof].is_nan() && revolute(robot, *dof).is_some();
    (0..robot.model.dof_count()).filter(is_tested).collect()
}

/// Findings of wrong encoder signs, with a fit without gains.
pub(crate) fn wrong_signs(
    measurement: &MeasurementModel<'_>,
    training: &[&PreparedLog],
    estimate: &NoiseAndMap,
) -> Vec<Finding> {
    let (robot, unknowns) = (measurement.robot(), measurement.unknowns());
    let (prior, fit) = (&estimate.prior, &estimate.fit);
    // A joint's axis can be reversed by links that are nothing like CAD's: CAD is taken to be as
    // good as stated.
    let stated = robot.urdf_relative_std * FRAC_1_SQRT_2;
    let tau = if stated > 0.0 {
        fit.tau.min(stated)
    } else {
        fit.tau
    };
    let segments = stretches(training, ENOUGH_FOR_SIGN).concat();
    let cost_with = |negated: &[usize]| {
        let (mut measurement, mut reduced) = (measurement.clone(), Vec::new());
        for LogSegment { instants, .. } in &segments {
            let other = |own: &Annotated| {
                let readings = negated.iter().map(|&dof| MotionReading::Reversed(dof));
                own.clone()
                    .map(|own| readings.fold(own, Observation::read_as))
            };
            let instants: Vec<Annotated> = instants.iter().map(other).collect();
            let segment = LogSegment::alone(&instants);
            reduced.push(reduce(&mut measurement, segment, &estimate.noise));
        }
        let all = added(&reduced, unknowns.parameters());
        let (r, z) = all.to_triangle();
        let posterior = Posterior::new(prior, &unknowns.links, &r, &z, &unknowns.precision);
        let fit = posterior.ok()?.fit(tau).ok()?;
        Some(all.residual_square() + cost(unknowns, &fit, &unknowns.precision))
    };
    let dofs = turning(robot);
    let negated = accepted(
        |negated| {
            let rest = dofs.iter().copied();
            rest.filter(|dof| !negated.contains(dof)).collect()
        },
        cost_with,
        |before| needed(1, dofs.len()).max(SURE * before),
        1.0,
    );
    let finding = |dof: usize| {
        let joint = format!("joint/{}", robot.model.dof_name(dof));
        Finding::warning(
            FindingCode::WrongSign,
            &joint,
            format!(
                "{joint}: wrong encoder sign, the data fit only with the position negated; negate \
                 the encoder's reading, or the joint's axis in the URDF. Encoder zeros and delays \
                 were not tested: they cannot be told from a wrong sign"
            ),
        )
    };
    negated.into_iter().map(finding).collect()
}

/// An error that is estimated.
#[derive(Clone, Debug, PartialEq)]
enum SetupError {
    /// The zero of a joint's encoder (its index among the tested ones), in all logs or in one.
    Zero { joint: usize, log: Option<usize> },
    /// The common delay of these streams: F/T sensors, then joint torques.
    Delay(Range<usize>),
}

impl SetupError {
    fn precision(&self) -> f64 {
        match self {
            Self::Zero { .. } => ZERO_STD.powi(-2),
            Self::Delay(_) => DELAY_STD.powi(-2),
        }
    }
}

/// An error and its standard deviation.
type Estimate = (f64, f64);

/// The columns of the errors in the rows of a segment: the zeros of these joints, then the delays.
struct SegmentColumns<'a> {
    dofs: &'a [usize],
    instants: &'a [Annotated],
    /// Per instant, the rate of change of each channel.
    rates: Vec<Vec<f64>>,
    d: &'a [f64],
}

impl SegmentColumns<'_> {
    /// The columns of an instant's rows, row by row.
    fn of_rows(
        &self,
        measurement: &mut MeasurementModel<'_>,
        number: usize,
        rows: &MeasurementRows,
    ) -> Vec<f64> {
        let (joints, rates, d) = (self.dofs.len(), &self.rates[number], self.d);
        let sensors = measurement.unknowns().sensors.len();
        let width = joints + sensors + measurement.unknowns().joints.len();
        let mut out = vec![0.0; width * rows.count];
        for (joint, &dof) in self.dofs.iter().enumerate() {
            // The row holds at the true position: the measured one minus the error. The small
            // change of the offset terms is ignored.
            let step = MotionReading::Encoder(dof, [STEP, 0.0]);
            let instant = self.instants[number].clone().map(|own| own.read_as(step));
            let moved = measurement.rows(&instant);
            if moved.count == rows.count {
                for row in 0..rows.count {
                    let change = moved.without_bodies(row, d) - rows.without_bodies(row, d);
                    out[row * width + joint] = change / STEP;
                }
            }
        }
        // A reading enters a row as its offset does.
        for (row, out) in out.chunks_exact_mut(width.max(1)).enumerate() {
            for sensor in 0..sensors {
                let six = 6 * sensor..6 * sensor + 6;
                out[joints + sensor] = -dot(&rows.g(row)[six.clone()], &rates[six]);
            }
            if let Some(joint) = rows.joint(row) {
                out[joints + sensors + joint] = -rates[6 * sensors + joint];
            }
        }
        out
    }
}

/// The search for errors that are estimated.
pub(crate) struct Search<'a> {
    training: &'a [&'a PreparedLog],
    identified: &'a Identified<'a>,
    /// The tested joints.
    dofs: Vec<usize>,
    /// Triangle of the information about the zeros, log by log, then the delays, then the
    /// parameters; and its right side.
    r: DMatrix<f64>,
    z: DVector<f64>,
    candidates: Vec<SetupError>,
    /// Reduction of the cost that one error must reach.
    gain: f64,
}

impl<'a> Search<'a> {
    pub(crate) fn new(training: &'a [&'a PreparedLog], identified: &'a Identified<'a>) -> Self {
        let (measurement, unknowns) = (&identified.measurement, identified.unknowns());
        let dofs = turning(measurement.robot());
        let (logs, joints, parameters) = (training.len(), dofs.len(), unknowns.parameters());
        let streams = unknowns.sensors.len() + unknowns.joints.len();
        let (first, width) = (joints * logs, joints + streams);
        let mut sum = Information::new(first + streams + parameters);
        let stretches = stretches(training, ENOUGH);
        for (number, segments) in stretches.iter().enumerate() {
            let reduced = measurement.map(segments, |measurement, segment| {
                let columns = SegmentColumns {
                    dofs: &dofs,
                    instants: segment.instants,
                    rates: rates(*segment, identified),
                    d: identified.fit.x.as_slice(),
                };
                let of_rows =
                    |measurement: &mut MeasurementModel<'_>, number, rows: &MeasurementRows| {
                        columns.of_rows(measurement, number, rows)
                    };
                let noise = &identified.noise;
                reduce_with(measurement, *segment, noise, &[], width, &of_rows)
            });
            let own = added(&reduced, parameters + width);
            let own_columns = (first + streams..first + streams + parameters)
                .chain(joints * number..joints * (number + 1))
                .chain(first..first + streams);
            let _ = sum.merge(&own, &own_columns.collect::<Vec<_>>());
        }
        let (r, z) = sum.to_triangle();
        let each = (0..logs).filter(|_| logs > 1).map(Some);
        let zeros = [None]
            .into_iter()
            .chain(each)
            .flat_map(|log| (0..joints).map(move |joint| SetupError::Zero { joint, log }));
        let mut search = Self {
            training,
            identified,
            r,
            z,
            candidates: zeros.collect(),
            gain: 0.0,
            dofs,
        };
        search.candidates.extend(search.streams());
        search.gain = needed(1, search.candidates.len());
        search
    }

    /// The delay of each F/T sensor, and that of all joint torques.
    fn streams(&self) -> Vec<SetupError> {
        let unknowns = self.identified.unknowns();
        let (sensors, joints) = (unknowns.sensors.len(), unknowns.joints.len());
        let torques = Some(sensors..sensors + joints).filter(|_| joints > 0);
        let single = (0..sensors).map(|own| own..own + 1);
        single.chain(torques).map(SetupError::Delay).collect()
    }

    fn column(&self, error: &SetupError) -> DVector<f64> {
        let (joints, logs) = (self.dofs.len(), self.training.len());
        let columns: Vec<usize> = match error {
            SetupError::Zero { joint, log } => {
                let logs = log.map_or(0..logs, |log| log..log + 1);
                logs.map(|log| joints * log + joint).collect()
            }
            SetupError::Delay(streams) => streams.clone().map(|own| joints * logs + own).collect(),
        };
        self.r.select_columns(&columns).column_sum()
    }

    /// The parameters' columns, then those of these errors. (Other errors are zero: their columns
    /// are omitted.)
    fn columns(&self, errors: &[SetupError]) -> DMatrix<f64> {
        let parameters = self.identified.unknowns().parameters();
        let columns = self.r.columns(self.r.ncols() - parameters, parameters);
        let mut columns =
            (columns.into_owned()).resize_horizontally(parameters + errors.len(), 0.0);
        for (index, error) in errors.iter().enumerate() {
            columns.set_column(parameters + index, &self.column(error));
        }
        columns
    }

    /// The MAP parameters and these errors, and their cost.
    fn fit(&self, errors: &[SetupError]) -> Option<(f64, MapEstimate)> {
        let (unknowns, prior) = (self.identified.unknowns(), &self.identified.prior);
        let mut precision = unknowns.precision.clone();
        precision.extend(errors.iter().map(SetupError::precision));
        let columns = self.columns(errors);
        let posterior = Posterior::new(prior, &unknowns.links, &columns, &self.z, &precision);
        let fit = posterior.ok()?.fit(self.identified.fit.tau).ok()?;
        Some((cost(unknowns, &fit, &precision), fit))
    }

    /// These errors, all of them estimated together, with their deviations.
    fn estimates(&self, errors: &[SetupError]) -> Option<Vec<Estimate>> {
        let (_, fit) = self.fit(errors)?;
        let (root, first) = (
            fit.covariance_root(),
            self.identified.unknowns().parameters(),
        );
        let estimates = (first..first + errors.len()).map(|k| (fit.x[k], root.row(k).norm()));
        Some(estimates.collect())
    }

    /// The most likely candidates beside these errors: those with the largest gain if the prior
    /// were quadratic, and the same joints in all logs.
    fn likely(&self, errors: &[SetupError]) -> Vec<SetupError> {
        let Some((_, fit)) = self.fit(errors) else {
            return Vec::new();
        };
        let columns = self.columns(errors);
        let (residuals, root) = (&self.z - &columns * &fit.x, fit.covariance_root());
        let gain = |error: &SetupError| {
            let column = self.column(error);
            let known = root.tr_mul(&columns.tr_mul(&column)).norm_squared();
            let precision = error.precision();
            column.dot(&residuals).powi(2)
                / (column.norm_squared() - known + precision).max(precision)
        };
        let rest = (self.candidates.iter()).filter(|error| !errors.contains(error));
        let mut ranked: Vec<(f64, &SetupError)> = rest.map(|error| (gain(error), error)).collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut likely: Vec<SetupError> = ranked
            .into_iter()
            .take(TRIED)
            .map(|(_, own)| own.clone())
            .collect();
        for index in 0..likely.len() {
            if let SetupError::Zero { joint, .. } = likely[index] {
                let in_all = SetupError::Zero { joint, log: None };
                if !likely.contains(&in_all) && !errors.contains(&in_all) {
                    likely.push(in_all);
                }
            }
        }
        likely
    }

    /// All errors that are accepted. A zero that is wrong in one log only costs as much as one
    /// error more: it must be clearly better than the same in all logs.
    fn run(&self) -> Vec<SetupError> {
        let cost = |errors: &[SetupError]| {
            let alone =
                |error: &&SetupError| matches!(error, SetupError::Zero { log: Some(_), .. });
            let more = errors.iter().filter(alone).count() as f64 * self.gain;
            Some(self.fit(errors)?.0 + more)
        };
        accepted(|errors| self.likely(errors), cost, |_| self.gain, 1.0)
    }

    /// Whether the zero at `index` may as well be in another log, with the opposite sign.
    fn is_exchangeable(&self, errors: &[SetupError], index: usize) -> bool {
        let cost_in = |log: Option<usize>| {
            let mut errors = errors.to_vec();
            if let SetupError::Zero { log: own, .. } = &mut errors[index] {
                *own = log.or(*own);
            }
            self.fit(&errors).map_or(f64::INFINITY, |(cost, _)| cost)
        };
        let SetupError::Zero { log, .. } = &errors[index] else {
            return false;
        };
        let cost = cost_in(None);
        let mut others = (0..self.training.len()).filter(|other| Some(*other) != *log);
        others.any(|other| cost_in(Some(other)) < cost + self.gain)
    }

    /// Findings about zeros and delays, and the delays of all streams.
    pub(crate) fn findings(&self) -> (Vec<Finding>, Vec<TimeOffset>) {
        let is_zero = |error: &SetupError| matches!(error, SetupError::Zero { .. });
        let errors = self.run();
        let zeros: Vec<SetupError> = errors.into_iter().filter(is_zero).collect();
        let count = zeros.len();
        let with = |delays: &[SetupError]| self.estimates(&[&zeros[..], delays].concat());
        let together = with(&self.streams()).unwrap_or_else(|| vec![(0.0, f64::INFINITY); count]);
        let (of_zeros, of_streams) = together.split_at(count);
        let mut findings = self.about_zeros(&zeros, of_zeros);

        let (robot, unknowns) = (self.identified.robot(), self.identified.unknowns());
        let (sensors, torques) = (unknowns.sensors.len(), unknowns.joints.len());
        let significance = threshold(sensors + torques + 1);
        let is_long = |(seconds, deviation): Estimate| {
            seconds.abs() > MIN_DELAY.max(significance * deviation)
        };
        let names = unknowns
            .sensors
            .iter()
            .map(|&own| format!("wrench/{}", sensor_name(robot, own)));
        let names = names.chain(["joint torques".to_owned()]);
        let known = names.zip(of_streams).filter(|(_, own)| is_known(own));
        let offsets = known.map(|(channel, &(seconds, deviation))| TimeOffset {
            channel,
            seconds,
            deviation,
            significant: is_long((seconds, deviation)),
        });
        let offsets: Vec<TimeOffset> = offsets.collect();
        for offset in offsets.iter().filter(|offset| offset.significant) {
            let channel = &offset.channel;
            let is_one = channel != "joint torques";
            let seem = format!("{channel} seem{}", if is_one { "s" } else { "" });
            findings.push(late(channel, &seem, (offset.seconds, offset.deviation)));
        }
        if torques > 2 {
            let each = (0..sensors + torques).map(|own| SetupError::Delay(own..own + 1));
            let each = with(&each.collect::<Vec<_>>()).unwrap_or_default();
            let own = each
                .get(count + sensors..)
                .and_then(|each| alone(each, is_long));
            findings.extend(own.map(|(index, delay)| {
                let joint = robot.model.dof_name(unknowns.joints[index]);
                let joint = format!("joint/{joint}/torque");
                late(
                    &joint,
                    &format!("{joint}, unlike the other torques, seems"),
                    delay,
                )
            }));
        }
        (findings, offsets)
    }

    fn about_zeros(&self, zeros: &[SetupError], estimates: &[Estimate]) -> Vec<Finding> {
        let (robot, unknowns) = (self.identified.robot(), self.identified.unknowns());
        let file = |log: usize| self.training[log].file.as_str();
        let mut findings = Vec::new();
        for (number, &dof) in self.dofs.iter().enumerate() {
            let found: Vec<(usize, Option<usize>, f64)> = (zeros.iter().zip(estimates).enumerate())
                .filter_map(|(index, (error, (angle, _)))| match error {
                    SetupError::Zero { joint, log } if *joint == number => {
                        Some((index, *log, *angle))
                    }
                    _ => None,
                })
                .collect();
            // Joints between two identified links of a sub-tree; with joint torques, any joint with
            // an identified child link.
            let is_within = revolute(robot, dof).is_some_and(|joint| {
                let inside = robot.structure.subtree_of(joint.parent)
                    == robot.structure.subtree_of(joint.child)
                    && unknowns.links.contains(&joint.parent);
                unknowns.links.contains(&joint.child) && (inside || !unknowns.joints.is_empty())
            });
            let least = if is_within {
                MIN_ZERO
            } else {
                MIN_ZERO_BEFORE_SENSORS
            };
            if found.iter().all(|(_, _, angle)| angle.abs() <= least) {
                continue;
            }
            let each = found.iter().map(|(_, log, angle)| {
                format!("{angle:.4} rad in {}", log.map_or("all logs", file))
            });
            let mut what = format!("encoder offset of {}", each.collect::<Vec<_>>().join(", "));
            let rest = match *found {
                [(_, None, _)] => "",
                [(index, Some(_), _)] if self.is_exchangeable(zeros, index) => {
                    what += ", or the opposite in all other logs";
                    " and use logs of one calibration"
                }
                _ => " and use logs of one calibration",
            };
            let mounting = if unknowns.sensors.is_empty() {
                ""
            } else {
                " (an F/T sensor that is mounted turned, its rpy_rad, looks the same)"
            };
            let name = robot.model.dof_name(dof);
            let text = if is_within {
                format!(
                    "joint/{name}: {what}; calibrate the encoder{rest}, or the parameters will \
                     contain a shifted centre of mass{mounting}"
                )
            } else {
                format!(
                    "joint/{name}: {what}, or the base (its IMU, its gravity_mps2, the floor) is \
                     tilted by as much; calibrate the encoder{rest}, and level the base{mounting}"
                )
            };
            findings.push(Finding::warning(FindingCode::EncoderOffset, name, text));
        }
        findings
    }
}

/// Whether the logs contain information about a delay.
fn is_known((_, deviation): &Estimate) -> bool {
    *deviation < 0.5 * DELAY_STD
}

/// Per instant, the rate of change of each channel without noise; 0 where it is not known.
fn rates(segment: LogSegment<'_>, identified: &Identified<'_>) -> Vec<Vec<f64>> {
    let (unknowns, instants) = (identified.unknowns(), segment.instants);
    let d = std::slice::from_ref(&identified.d);
    let noise = residuals(&identified.measurement, segment, &identified.noise, d).noise;
    let exact = |channel: usize, i: usize| {
        let measured = match unknowns.sensors.get(channel / 6) {
            Some(&sensor) => instants[i].readings[sensor].torque_first()[channel % 6],
            None => instants[i].torque[unknowns.joints[channel - unknowns.wrenches()]],
        };
        measured - noise[0][channel][i]
    };
    let around = |number: usize| {
        let t = |i: usize| (instants[i].t - instants[number].t).seconds();
        let before = (0..number).rev().take_while(|&i| t(i) >= -REACH).last();
        let after = number + 1..instants.len();
        let after = after.take_while(|&i| t(i) <= REACH).last();
        // The adjacent ones if instants are farther apart.
        let low = before.unwrap_or(number.saturating_sub(1));
        let high = after.unwrap_or((number + 1).min(instants.len() - 1));
        let span = t(high) - t(low);
        let rate = |channel: usize| {
            let rate = (exact(channel, high) - exact(channel, low)) / span;
            if rate.is_finite() && span < 0.2 {
                rate
            } else {
                0.0
            }
        };
        (0..unknowns.channels()).map(rate).collect()
    };
    (0..instants.len()).map(around).collect()
}

fn late(subject: &str, seem: &str, (seconds, deviation): Estimate) -> Finding {
    Finding::warning(
        FindingCode::TimeOffset,
        subject,
        format!(
            "{seem} to be stamped {:.1} ms {} the encoders (+- {:.1} ms). This was not corrected, \
             and friction and parameters have absorbed a part of it: compare the clocks and the \
             filters of the sensors, and correct the stamps",
            1e3 * seconds.abs(),
            if seconds > 0.0 { "behind" } else { "ahead of" },
            1e3 * deviation
        ),
    )
}

/// The single torque that has a delay while all others have none.
fn alone(each: &[Estimate], is_long: impl Fn(Estimate) -> bool) -> Option<(usize, Estimate)> {
    let known: Vec<usize> = (0..each.len()).filter(|&k| is_known(&each[k])).collect();
    known.iter().filter(|_| known.len() > 2).find_map(|&index| {
        let others = || known.iter().filter(|&&k| k != index).map(|&k| each[k]);
        let weight: f64 = others().map(|(_, deviation)| deviation.powi(-2)).sum();
        let weighted = others().map(|(own, deviation)| own * deviation.powi(-2));
        let common = (weighted.sum::<f64>() / weight, weight.sqrt().recip());
        let off = others().map(|(seconds, _)| (seconds - common.0).abs());
        let farthest = off.fold(0.0, f64::max);
        let own = each[index];
        let apart = (own.0 - common.0, own.1.hypot(common.1));
        let is_alone = is_long(apart) && apart.0.abs() > SINGLE * farthest;
        (is_alone && is_long(own) && !is_long(common)).then_some((index, own))
    })
}
