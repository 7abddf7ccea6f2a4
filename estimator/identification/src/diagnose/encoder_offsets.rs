//! Encoder signs and encoder offsets: joints whose measured position differs from the model's. An
//! error is reported if it explains more than the inertial parameters can, at the prior's scale
//! ([`crate::hypothesis`]).
//!
//! # Encoder sign
//! The parameters are fitted again to the logs with a joint's position, velocity and acceleration
//! negated. The joint that reduces the cost the most is accepted, then further joints in the same
//! way, before gains of the F/T sensors are fitted. If a sign is wrong, offsets are not tested: a
//! wrong sign looks like offsets of other joints.
//!
//! # Encoder offset
//! A constant error of the position, of joints beyond or between F/T sensors, and of joints between
//! the base and the sensors. An error of the latter tilts everything beyond by an amount that
//! depends on the posture; only for the joint at the base it is not separable from a base that is
//! not level. The error is the same in all logs, or present in one of several: incremental encoders
//! find their zero again at each start.
//!
//! The angles are extra parameters of each log
//! ([`crate::measurement::reduction::reduce_with_angles`]), with a prior. The candidate that
//! reduces the cost the most is accepted, then further candidates in the same way.

use crate::dataset::observation::Annotated;
use crate::finding::{Finding, FindingCode, Severity};
use crate::fit::{Identified, NoiseAndMap, added};
use crate::hypothesis::needed;
use crate::linear::information::Information;
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::{Segment, reduce, reduce_with_angles};
use crate::measurement::unknowns::Unknowns;
use crate::parallel;
use crate::prior::{Fit, Posterior};
use crate::robot::Robot;
use crate::training::{TrainingLog, map_segments};
use nalgebra::{DMatrix, DVector};
use proprio_dynamics::model::{Joint, JointKind};
use std::f64::consts::FRAC_1_SQRT_2;

/// Prior standard deviation of an encoder offset \[rad\].
const OFFSET_STD: f64 = 0.1;

/// Smallest offset that is reported \[rad\].
const MIN_REPORTED: f64 = 0.01;

/// The same of a joint between the base and the sensors \[rad\]: floors and bases are tilted by
/// less.
const MIN_REPORTED_BEFORE_SENSORS: f64 = 0.02;

/// Observations that are used in all.
const ENOUGH: usize = 2000;

/// Observations that are used of each log at least.
const LEAST_OF_LOG: usize = 400;

/// Stretches of consecutive instants per log. Offsets and noise need consecutive instants, and each
/// stretch has sensor offsets of its own.
const STRETCHES: usize = 4;

/// The same for signs: a wrong sign shows in fewer observations.
const ENOUGH_FOR_SIGN: usize = 1200;
const LEAST_OF_LOG_FOR_SIGN: usize = 300;

/// Fraction of the cost that the right sign must save. The noise is that of a fit with the wrong
/// sign, which leaves most of the cost; a joint that hardly moves may save a little by chance of
/// the model's errors.
const SURE: f64 = 0.25;

/// Most likely candidates that are fitted in each round.
const TRIED: usize = 6;

/// An encoder offset of a joint (its place among the tested ones), in all logs or in one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct EncoderOffset {
    joint: usize,
    log: Option<usize>,
}

/// Search for encoder offsets.
struct Search<'a> {
    identified: &'a Identified,
    joints: usize,
    logs: usize,
    /// The logs in which an offset may be: all; if there are several, also each one.
    places: Vec<Option<usize>>,
    /// Triangle of the information about the angles, log by log, then the parameters; and its right
    /// side.
    r: DMatrix<f64>,
    z: DVector<f64>,
    /// Reduction of the cost that one offset must reach.
    gain: f64,
}

impl<'a> Search<'a> {
    fn new(
        measurement: &MeasurementModel<'_>,
        training: &[&TrainingLog],
        identified: &'a Identified,
        dofs: &[usize],
    ) -> Self {
        let (logs, joints, unknowns) =
            (training.len(), dofs.len(), identified.unknowns.parameters());
        let mut sum = Information::new(joints * logs + unknowns);
        for (number, log) in training.iter().enumerate() {
            let segments = stretches(log, (ENOUGH / logs.max(1)).max(LEAST_OF_LOG));
            let reduced = map_segments(measurement, &segments, |measurement, _, segment| {
                reduce_with_angles(
                    measurement,
                    segment,
                    &identified.noise,
                    dofs,
                    identified.fit.x.as_slice(),
                )
            });
            let own = added(&reduced, unknowns + joints);
            let parameters = (0..unknowns).map(|column| joints * logs + column);
            let angles = (0..joints).map(|joint| joints * number + joint);
            let _ = sum.merge(&own, &parameters.chain(angles).collect::<Vec<_>>());
        }
        let (r, z) = sum.to_triangle();
        let each = (0..logs).filter(|_| logs > 1).map(Some);
        let places: Vec<Option<usize>> = std::iter::once(None).chain(each).collect();
        Self {
            identified,
            joints,
            logs,
            r,
            z,
            gain: needed(1, joints * places.len()),
            places,
        }
    }

    fn candidates(&self) -> impl Iterator<Item = EncoderOffset> {
        let of = |log: &Option<usize>| {
            let log = *log;
            (0..self.joints).map(move |joint| EncoderOffset { joint, log })
        };
        self.places.iter().flat_map(of)
    }

    fn column(&self, offset: EncoderOffset) -> DVector<f64> {
        let logs = offset.log.map_or(0..self.logs, |log| log..log + 1);
        let columns = logs.map(|log| self.r.column(self.joints * log + offset.joint));
        columns.fold(DVector::zeros(self.r.nrows()), |sum, column| sum + column)
    }

    /// The parameters' columns, then those of these offsets. (Other offsets are zero: their columns
    /// are omitted.)
    fn columns(&self, offsets: &[EncoderOffset]) -> DMatrix<f64> {
        let unknowns = self.identified.unknowns.parameters();
        let own = self
            .r
            .columns(self.joints * self.logs, unknowns)
            .into_owned();
        let mut own = own.resize_horizontally(unknowns + offsets.len(), 0.0);
        for (place, offset) in offsets.iter().enumerate() {
            own.set_column(unknowns + place, &self.column(*offset));
        }
        own
    }

    /// The MAP parameters and these offsets, and their cost.
    fn fit(&self, offsets: &[EncoderOffset]) -> Option<(f64, Fit)> {
        let Identified {
            unknowns,
            prior,
            fit,
            ..
        } = self.identified;
        let mut precision = unknowns.precision.clone();
        precision.resize(unknowns.extra.len() + offsets.len(), OFFSET_STD.powi(-2));
        let posterior = Posterior::new(
            prior,
            &unknowns.links,
            &self.columns(offsets),
            &self.z,
            &precision,
        );
        let fit = posterior.ok()?.fit(fit.tau).ok()?;
        Some((cost(unknowns, &fit, &precision), fit))
    }

    /// The most likely candidates beside these offsets, whose fit this is: those with the largest
    /// gain if the prior were quadratic, and the same joints in all logs.
    fn likely(&self, offsets: &[EncoderOffset], fit: &Fit) -> Vec<EncoderOffset> {
        let own = self.columns(offsets);
        let (residuals, root) = (&self.z - &own * &fit.x, fit.covariance_root());
        let gain = |offset: EncoderOffset| {
            let column = self.column(offset);
            let known = root.tr_mul(&own.tr_mul(&column)).norm_squared();
            column.dot(&residuals).powi(2)
                / (column.norm_squared() - known + OFFSET_STD.powi(-2)).max(OFFSET_STD.powi(-2))
        };
        let rest = self.candidates().filter(|offset| !offsets.contains(offset));
        let mut ranked: Vec<(f64, EncoderOffset)> =
            rest.map(|offset| (gain(offset), offset)).collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut likely: Vec<EncoderOffset> = ranked
            .into_iter()
            .take(TRIED)
            .map(|(_, offset)| offset)
            .collect();
        for place in 0..likely.len() {
            let in_all = EncoderOffset {
                log: None,
                ..likely[place]
            };
            if !likely.contains(&in_all) && !offsets.contains(&in_all) {
                likely.push(in_all);
            }
        }
        likely
    }

    /// All offsets that are found, each with its angle, and the cost.
    fn run(&self) -> Option<(f64, Vec<(EncoderOffset, f64)>)> {
        let mut offsets: Vec<EncoderOffset> = Vec::new();
        let (mut cost, mut fit) = self.fit(&[])?;
        loop {
            let likely = self.likely(&offsets, &fit);
            let with =
                |offset: EncoderOffset| offsets.iter().copied().chain([offset]).collect::<Vec<_>>();
            let fits = parallel::map(likely.len(), |number| self.fit(&with(likely[number])));
            let tried = likely.iter().zip(fits);
            let mut tried: Vec<(EncoderOffset, f64, Fit)> = tried
                .filter_map(|(offset, fit)| fit.map(|(cost, fit)| (*offset, cost, fit)))
                .collect();
            tried.sort_by(|a, b| a.1.total_cmp(&b.1));
            let Some(&(best, least, _)) = tried.first().filter(|best| cost - best.1 >= self.gain)
            else {
                break;
            };
            // An offset in one log only if that is clearly better than in all.
            let in_all = EncoderOffset { log: None, ..best };
            let is_taken = |(offset, own, _): &(EncoderOffset, f64, Fit)| {
                *offset == in_all && *own < least + self.gain
            };
            let place = tried.iter().position(is_taken).unwrap_or(0);
            let (offset, own, with) = tried.swap_remove(place);
            if cost - own < self.gain {
                break;
            }
            offsets.push(offset);
            (cost, fit) = (own, with);
        }
        let angles = fit
            .x
            .iter()
            .skip(self.identified.unknowns.parameters())
            .copied();
        Some((cost, offsets.into_iter().zip(angles).collect()))
    }

    /// Whether the offset may as well be in another log, with the opposite sign.
    fn is_exchangeable(&self, cost: f64, offsets: &[(EncoderOffset, f64)], place: usize) -> bool {
        let own = offsets[place].0;
        let others: Vec<usize> = (0..self.logs).filter(|log| Some(*log) != own.log).collect();
        let costs = parallel::map(others.len(), |number| {
            let mut offsets: Vec<EncoderOffset> =
                offsets.iter().map(|(offset, _)| *offset).collect();
            offsets[place].log = Some(others[number]);
            self.fit(&offsets).map(|(cost, _)| cost)
        });
        costs
            .into_iter()
            .flatten()
            .any(|other| other < cost + self.gain)
    }
}

/// The squared residuals of a fit plus twice its prior cost.
fn cost(unknowns: &Unknowns, fit: &Fit, precision: &[f64]) -> f64 {
    let extra = fit.x.iter().skip(unknowns.inertial());
    let extra: f64 = extra
        .zip(precision)
        .map(|(x, precision)| x * x * precision)
        .sum();
    fit.residual_square + fit.divergence / fit.tau.powi(2) + extra
}

/// At most `share` of a log's instants, in stretches from the first to the last.
fn stretches(log: &TrainingLog, share: usize) -> Vec<Segment<'_>> {
    let stretches = if log.instants.len() > share {
        STRETCHES
    } else {
        1
    };
    let count = log.instants.len().min(share) / stretches;
    let segment = |stretch: usize| {
        let start = (log.instants.len() - count) * stretch / (stretches - 1).max(1);
        Segment {
            instants: &log.instants[start..start + count],
            log: None,
        }
    };
    (0..stretches).map(segment).collect()
}

/// Findings of wrong encoder signs, with a fit without gains: 36 of them would make up for much of
/// a wrong sign.
pub(crate) fn wrong_signs(
    measurement: &MeasurementModel<'_>,
    training: &[&TrainingLog],
    estimate: &NoiseAndMap,
) -> Vec<Finding> {
    let robot = measurement.robot();
    let dofs = turning(robot);
    let finding = |dof: &usize| {
        let joint = format!("joint/{}", robot.model.dof_name(*dof));
        Finding {
            severity: Severity::Warning,
            code: FindingCode::WrongSign,
            text: format!(
                "{joint}: wrong encoder sign, the data fit only with the position negated; negate \
                 the encoder's reading, or the joint's axis in the URDF"
            ),
            subject: joint,
        }
    };
    let negated = negated(measurement, training, estimate, &dofs);
    negated.iter().map(finding).collect()
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

/// The joints among `dofs` with a wrong encoder sign.
fn negated(
    measurement: &MeasurementModel<'_>,
    training: &[&TrainingLog],
    estimate: &NoiseAndMap,
    dofs: &[usize],
) -> Vec<usize> {
    let unknowns = measurement.unknowns();
    let NoiseAndMap {
        prior, noise, fit, ..
    } = estimate;
    // A joint's axis can be reversed by links that are nothing like CAD's: CAD is taken to be as
    // good as stated.
    let stated = measurement.robot().urdf_relative_std * FRAC_1_SQRT_2;
    let tau = if stated > 0.0 {
        fit.tau.min(stated)
    } else {
        fit.tau
    };
    let share = (ENOUGH_FOR_SIGN / training.len().max(1)).max(LEAST_OF_LOG_FOR_SIGN);
    let segments: Vec<Segment<'_>> = training
        .iter()
        .flat_map(|log| stretches(log, share))
        .collect();
    let cost_with = |negated: &[usize]| {
        let (mut measurement, mut all) =
            (measurement.clone(), Information::new(unknowns.parameters()));
        let columns: Vec<usize> = (0..unknowns.parameters()).collect();
        for segment in &segments {
            let other = |own: &Annotated| own.clone().map(|o| o.turned(negated));
            let instants: Vec<Annotated> = segment.instants.iter().map(other).collect();
            let (instants, log) = (&instants[..], segment.log);
            let _ = all.merge(
                &reduce(&mut measurement, Segment { instants, log }, noise).information,
                &columns,
            );
        }
        let (r, z) = all.to_triangle();
        let posterior = Posterior::new(prior, &unknowns.links, &r, &z, &unknowns.precision);
        let fit = posterior.ok()?.fit(tau).ok()?;
        Some(all.residual_square() + cost(unknowns, &fit, &unknowns.precision))
    };
    let mut negated: Vec<usize> = Vec::new();
    let Some(mut least) = cost_with(&[]) else {
        return negated;
    };
    loop {
        let rest: Vec<usize> = dofs
            .iter()
            .copied()
            .filter(|dof| !negated.contains(dof))
            .collect();
        let costs = parallel::map(rest.len(), |number| {
            let with: Vec<usize> = negated.iter().copied().chain([rest[number]]).collect();
            cost_with(&with)
        });
        let found = rest
            .iter()
            .zip(costs)
            .filter_map(|(dof, cost)| Some((*dof, cost?)));
        let best = found.min_by(|a, b| a.1.total_cmp(&b.1));
        let is_sure =
            |best: &(usize, f64)| best.1 < least - needed(1, dofs.len()).max(SURE * least);
        match best.filter(is_sure) {
            Some((dof, cost)) => {
                negated.push(dof);
                least = cost;
            }
            None => return negated,
        }
    }
}

/// Findings of encoder offsets.
pub(crate) fn encoder_errors(
    measurement: &MeasurementModel<'_>,
    training: &[&TrainingLog],
    identified: &Identified,
) -> Vec<Finding> {
    let robot = measurement.robot();
    let unknowns = &identified.unknowns;
    // Joints between two identified links of a sub-tree; with joint torques, any joint with an
    // identified child link.
    let is_within = |dof: usize| {
        revolute(robot, dof).is_some_and(|joint| {
            let inside = robot.structure.subtree_of(joint.parent)
                == robot.structure.subtree_of(joint.child)
                && unknowns.links.contains(&joint.parent);
            unknowns.links.contains(&joint.child) && (inside || !unknowns.joints.is_empty())
        })
    };
    let mounting = if unknowns.sensors.is_empty() {
        ""
    } else {
        " (an F/T sensor that is mounted turned, its rpy_rad, looks the same)"
    };
    let dofs = turning(robot);
    let search = Search::new(measurement, training, identified, &dofs);
    let Some((cost, offsets)) = search.run() else {
        return Vec::new();
    };
    let mut findings = Vec::new();
    for (number, &dof) in dofs.iter().enumerate() {
        let of_joint = |place: &usize| offsets[*place].0.joint == number;
        let places: Vec<usize> = (0..offsets.len()).filter(of_joint).collect();
        let is_within = is_within(dof);
        let least = if is_within {
            MIN_REPORTED
        } else {
            MIN_REPORTED_BEFORE_SENSORS
        };
        if places.iter().all(|&place| offsets[place].1.abs() <= least) {
            continue;
        }
        let file = |log: usize| training[log].file.as_str();
        let (what, rest) = match *places {
            [place] => match offsets[place] {
                (EncoderOffset { log: None, .. }, angle) => {
                    (format!("encoder offset of {angle:.4} rad"), String::new())
                }
                (EncoderOffset { log: Some(log), .. }, angle)
                    if search.is_exchangeable(cost, &offsets, place) =>
                {
                    (
                        format!(
                            "the encoder offsets in {} and in the other logs differ by {:.4} \
                             rad, and either may be wrong",
                            file(log),
                            angle.abs()
                        ),
                        " and use logs of one calibration".to_owned(),
                    )
                }
                (EncoderOffset { log: Some(log), .. }, angle) => (
                    format!(
                        "the encoder offset in {} differs by {angle:.4} rad from the other logs",
                        file(log)
                    ),
                    format!(" and exclude {}", file(log)),
                ),
            },
            _ => {
                let each = places.iter().map(|&place| match offsets[place] {
                    (EncoderOffset { log: None, .. }, angle) => {
                        format!("{angle:.4} rad in all logs")
                    }
                    (EncoderOffset { log: Some(log), .. }, angle) => {
                        format!("{angle:.4} rad in {}", file(log))
                    }
                });
                let each = each.collect::<Vec<_>>().join(", ");
                (
                    format!("encoder offset that differs between logs: {each}"),
                    " and use logs of one calibration".to_owned(),
                )
            }
        };
        let name = robot.model.dof_name(dof);
        let text = if is_within {
            format!(
                "joint/{name}: {what}; calibrate the encoder{rest}, or the parameters will contain \
                 a shifted centre of mass{mounting}"
            )
        } else {
            format!(
                "joint/{name}: {what}, or the base (its IMU, its gravity_mps2, the floor) is \
                 tilted by as much; calibrate the encoder{rest}, and level the base{mounting}"
            )
        };
        findings.push(Finding {
            severity: Severity::Warning,
            code: FindingCode::EncoderOffset,
            subject: name.to_owned(),
            text,
        });
    }
    findings
}
