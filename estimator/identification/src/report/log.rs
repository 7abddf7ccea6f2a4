//! The figures of one log: residuals, prediction errors, coverage, offsets, friction, findings.

use crate::arithmetic::{dot, mean, rms};
use crate::dataset::LogRole;
use crate::dataset::observation::{Annotated, SubtreeSet};
use crate::finding::{Finding, FindingCode};
use crate::fit::Identified;
use crate::measurement::channels::{channel_of, sensor_name};
use crate::measurement::reduction::{LogSegment, Residuals, reduce, residuals};
use crate::measurement::unknowns::{FRICTION, Unknowns, friction_row};
use crate::prepared_log::{MIN_FOLD, PreparedLog, SEGMENT_INSTANTS};
use crate::report::comparison::{
    Judged, STILL, SensorComparison, TorqueSeries, cases, configured_nuisance, three,
};
use crate::report::curves::curves;
use crate::report::outcome::{
    FrictionOutcome, JointOutcome, LogOutcome, OffsetOutcome, Predicted, SensorOutcome,
    TwoRouteOutcome, both,
};
use crate::report::prediction::PredictionError;
use crate::robot::{AXES, Robot};
use proprio_dynamics::Structure;
use proprio_topics::Nanos;

/// Time at both ends of a log that is not used to compare torques, because derivatives are less
/// certain there \[s\].
const EDGE: f64 = 0.3;

impl TorqueSeries {
    /// The same without both ends of the log; `times` since its first stamp.
    fn inner(&self, times: &[f64]) -> Self {
        let ends = times.first().zip(times.last());
        let is_inner = |t: f64| ends.is_some_and(|(a, b)| (a + EDGE..=b - EDGE).contains(&t));
        let keep = |values: &Vec<f64>| {
            let inner = values.iter().zip(times).filter(|(_, t)| is_inner(**t));
            inner.map(|(x, _)| *x).collect()
        };
        Self {
            dof: self.dof,
            errors: self.errors.each_ref().map(keep),
            measured: keep(&self.measured),
        }
    }
}

/// Residuals of a joint's torque with the friction of the training logs for one set of parameters,
/// instead of the friction fitted to the log.
pub(crate) fn with_friction_of_training(
    unknowns: &Unknowns,
    instants: &[Annotated],
    residuals: &Residuals,
    (set, friction): (usize, &[[f64; FRICTION]]),
    index: usize,
) -> Vec<f64> {
    let wrenches = unknowns.wrenches();
    let mut errors = residuals.noise[set][wrenches + index].clone();
    for (range, block) in residuals.ranges.iter().zip(&residuals.nuisance) {
        for i in range.clone() {
            for (k, share) in friction_row(instants[i].velocity[unknowns.joints[index]])
                .into_iter()
                .enumerate()
            {
                let fitted = block.x[(wrenches + FRICTION * index + k, set)];
                errors[i] += share * (fitted - friction[index][k]);
            }
        }
    }
    errors
}

pub(crate) fn log_outcome(log: &PreparedLog, judged: &Judged<'_>) -> LogOutcome {
    let (identified, unknowns) = (judged.identified, judged.identified.unknowns());
    let usable = !log.instants.is_empty() && !log.refused;
    let instants = if usable { log.instants.as_slice() } else { &[] };
    let residuals = judged.residuals(instants);
    let times = instants.iter().map(|i| (i.t - log.span.0).seconds());
    let times: Vec<f64> = times.collect();
    let compared = SensorComparison::new(judged, instants, &residuals);
    let torques = residuals.noise[1].iter().skip(unknowns.wrenches());
    let errors: Vec<&[f64]> = compared.errors[2]
        .iter()
        .chain(torques)
        .map(Vec::as_slice)
        .collect();
    let coverage = judged.covered(instants, &errors);
    // Torques: an input of the identification, or a reference for F/T sensors.
    let torques = if unknowns.joints.is_empty() {
        reference_torques(judged, instants)
    } else {
        input_torques(judged, instants, &residuals)
    };
    let inner: Vec<TorqueSeries> = torques.iter().map(|own| own.inner(&times)).collect();
    let undisturbed = undisturbed(judged, log);
    let tested = undisturbed.as_ref().unwrap_or(&compared);
    let sensors = unknowns.sensors.iter().enumerate();
    let robot = identified.robot();
    let findings = sensors.filter_map(|(index, &sensor)| unexplained(robot, sensor, tested, index));
    let deviations = nuisance_deviations(judged, instants);
    LogOutcome {
        file: log.file.clone(),
        role: log.role,
        span: log.span,
        used: instants.len() as u64,
        excluded: log.excluded.clone(),
        onset: onset(instants),
        predicted: predicted(judged, instants, &inner),
        joints: joint_outcomes(identified, &inner, &coverage),
        sensors: sensor_outcomes(identified, &compared, &coverage),
        two_route: two_route(judged, instants, &residuals),
        offsets: offsets(identified, &residuals, &deviations),
        friction: friction(identified, &residuals, &deviations),
        findings: log.findings.iter().cloned().chain(findings).collect(),
        curves: curves(judged, instants, &times, &compared, &torques),
    }
}

impl Judged<'_> {
    /// The residuals of CAD and of the identified parameters.
    fn residuals(&self, instants: &[Annotated]) -> Residuals {
        let (segment, noise) = (LogSegment::alone(instants), &self.identified.noise);
        residuals(&self.identified.measurement, segment, noise, &self.sets)
    }
}

/// Residuals of torques that nothing is identified from: no friction is fitted to them.
fn reference_torques(judged: &Judged<'_>, instants: &[Annotated]) -> Vec<TorqueSeries> {
    let measurement = &judged.identified.measurement;
    let dofs = measurement.robot().model.dof_count();
    let is_measured = |i: &Annotated| i.torque.iter().any(|x| x.is_finite());
    if !instants.iter().any(is_measured) {
        return Vec::new();
    }
    // Per instant, with each set, of each degree of freedom.
    let errors = measurement.map(instants, |measurement, instant| {
        judged.sets.each_ref().map(|set| {
            let errors = measurement.torque_errors(instant, set.as_slice());
            errors.unwrap_or_else(|_| vec![f64::NAN; dofs])
        })
    });
    let of_set = |set: usize, dof: usize| errors.iter().map(|own| own[set][dof]).collect();
    let pairs = (0..dofs)
        .map(|dof| -> (usize, [Vec<f64>; 2]) { (dof, [0, 1].map(|set| of_set(set, dof))) });
    let compared = pairs.filter(|(_, [cad, _])| cad.iter().any(|x| x.is_finite()));
    compared
        .map(|(dof, [cad, own])| TorqueSeries {
            dof,
            errors: [cad.clone(), cad.clone(), own.clone(), cad, own],
            measured: instants.iter().map(|i| i.torque[dof]).collect(),
        })
        .collect()
}

/// Residuals of torques that are an input of the identification.
fn input_torques(
    judged: &Judged<'_>,
    instants: &[Annotated],
    residuals: &Residuals,
) -> Vec<TorqueSeries> {
    let unknowns = judged.identified.unknowns();
    let series = |(index, &dof): (usize, &usize)| {
        let channel = unknowns.wrenches() + index;
        let raw = residuals.measured[channel]
            .iter()
            .zip(&residuals.predicted[channel])
            .map(|(m, p)| m - p)
            .collect();
        let [cad, own] = [0, 1].map(|set| {
            let friction = (set, judged.candidates[set].friction.as_slice());
            with_friction_of_training(unknowns, instants, residuals, friction, index)
        });
        let [cad_fitted, own_fitted] = [0, 1].map(|set| residuals.noise[set][channel].clone());
        TorqueSeries {
            dof,
            errors: [raw, cad_fitted, own_fitted, cad, own],
            measured: instants.iter().map(|i| i.torque[dof]).collect(),
        }
    };
    unknowns.joints.iter().enumerate().map(series).collect()
}

/// The prediction errors by which parameters are judged; `torques` without the ends of the log.
fn predicted(judged: &Judged<'_>, instants: &[Annotated], torques: &[TorqueSeries]) -> Predicted {
    let (identified, robot) = (judged.identified, judged.identified.robot());
    let prediction_error = PredictionError::of_record(
        robot,
        &identified.inputs,
        identified.calibrated,
        instants.iter().map(Annotated::observation),
    );
    // No error is expected: rows of the same instants were computed before.
    let mut predicted = prediction_error.map_or_else(
        |_| Predicted::default(),
        |errors| errors.predicted(identified.unknowns(), &judged.candidates),
    );
    let of_joint = |own: &TorqueSeries| {
        let of_training = both([3, 4].map(|set| rms(own.errors[set].iter().copied())));
        (robot.model.dof_name(own.dof).to_owned(), of_training)
    };
    predicted.joints = torques.iter().map(of_joint).collect();
    let relative = |set: usize| {
        let (mut above, mut below) = (0.0, 0.0);
        for TorqueSeries {
            errors, measured, ..
        } in torques
        {
            for (e, m) in errors[set].iter().zip(measured) {
                if e.is_finite() && m.is_finite() {
                    above += e * e;
                    below += m * m;
                }
            }
        }
        (above / below).sqrt()
    };
    if !torques.is_empty() {
        predicted.relative_error = both([3, 4].map(relative));
    }
    predicted
}

/// The figures of each torque, without the ends of the log.
fn joint_outcomes(
    identified: &Identified<'_>,
    torques: &[TorqueSeries],
    coverage: &[f64],
) -> Vec<JointOutcome> {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let outcome = |own: &TorqueSeries| {
        let index = unknowns.joints.binary_search(&own.dof).ok();
        let channel = index.map(|index| unknowns.wrenches() + index);
        JointOutcome {
            name: robot.model.dof_name(own.dof).to_owned(),
            rms_nm: three([0, 1, 2].map(|set| rms(own.errors[set].iter().copied()))),
            measured_rms_nm: rms(own.measured.iter().copied()),
            coverage: channel.map_or(f64::NAN, |channel| coverage[channel]),
        }
    };
    torques.iter().map(outcome).collect()
}

fn sensor_outcomes(
    identified: &Identified<'_>,
    compared: &SensorComparison,
    coverage: &[f64],
) -> Vec<SensorOutcome> {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let outcome = |(index, &sensor): (usize, &usize)| SensorOutcome {
        name: sensor_name(robot, sensor),
        rms: three(compared.errors.each_ref().map(|errors| {
            std::array::from_fn(|axis| rms(errors[channel_of(index, axis)].iter().copied()))
        })),
        coverage: std::array::from_fn(|axis| coverage[channel_of(index, axis)]),
    };
    unknowns.sensors.iter().enumerate().map(outcome).collect()
}

/// A validation log compared as a training log: without undeclared disturbances and their effect on
/// the offsets. None if no disturbance was found, because the comparison is then the same.
fn undisturbed(judged: &Judged<'_>, log: &PreparedLog) -> Option<SensorComparison> {
    if log.role == LogRole::Train || log.contacts.iter().all(SubtreeSet::is_empty) {
        return None;
    }
    let mut instants = log.instants.clone();
    for (instant, subtrees) in instants.iter_mut().zip(&log.contacts) {
        instant.disturbed = *subtrees;
    }
    let residuals = judged.residuals(&instants);
    Some(SensorComparison::new(judged, &instants, &residuals))
}

/// A warning if the residual of a sensor's readings with the identified parameters is much larger
/// than its noise. Its fraction of the readings depends on the motion of the log: it is reported,
/// and refuses nothing.
///
/// For a log with undeclared disturbances, `compared` excludes these. Axes with fewer than
/// [`MIN_FOLD`] instants are not tested.
pub(crate) fn unexplained(
    robot: &Robot,
    sensor: usize,
    compared: &SensorComparison,
    index: usize,
) -> Option<Finding> {
    /// Residuals above this multiple of the stated noise are reported ...
    const TIMES: f64 = 10.0;
    /// ... if they exceed this fraction of the axis's changes.
    const FRACTION: f64 = 0.02;
    /// A correlation of an axis with its prediction below this is not due to noise.
    const OPPOSITE: f64 = -0.5;
    let noise = robot.structure.sensors()[sensor].noise();
    let noise = [noise.force, noise.torque].concat();
    // Only instants with the rows of all sub-trees of the sensor: if one of them is disturbed, the
    // errors of the others would be attributed to this sensor alone.
    let all_rows = compared.rows[index].iter().copied().max().unwrap_or(0);
    let (mut residual, mut all) = (0.0, 0.0);
    let (mut axes, mut opposite) = (Vec::new(), Vec::new());
    for (axis, word) in AXES.into_iter().enumerate() {
        let channel = channel_of(index, axis);
        let (load, error) = (&compared.load[channel], &compared.errors[2][channel]);
        let is_compared = |&i: &usize| {
            load[i].is_finite() && error[i].is_finite() && compared.rows[index][i] == all_rows
        };
        let (load, error): (Vec<f64>, Vec<f64>) = (0..load.len())
            .filter(is_compared)
            .map(|i| (load[i], error[i]))
            .unzip();
        if load.len() < MIN_FOLD {
            continue;
        }
        let centre = mean(&load);
        let load: Vec<f64> = load.iter().map(|x| x - centre).collect();
        let predicted: Vec<f64> = load.iter().zip(&error).map(|(l, e)| l - e).collect();
        let scale = if axis < 3 {
            Structure::LENGTH_SCALE
        } else {
            1.0
        };
        let (ll, ee) = (dot(&load, &load), dot(&error, &error));
        let (pp, lp) = (dot(&predicted, &predicted), dot(&load, &predicted));
        (residual, all) = (residual + scale * scale * ee, all + scale * scale * ll);
        let times = (ee / load.len() as f64).sqrt() / noise[axis];
        if times > TIMES && ee > FRACTION * FRACTION * ll {
            axes.push(format!("{word} {times:.0}"));
            if lp < OPPOSITE * (ll * pp).sqrt() {
                opposite.push(word);
            }
        }
    }
    if axes.is_empty() {
        return None;
    }
    let (share, name) = ((residual / all).sqrt(), sensor_name(robot, sensor));
    let hint = if opposite.is_empty() {
        String::new()
    } else {
        format!(
            " Opposite to the prediction: {} (wrong sign or axis).",
            opposite.join(", ")
        )
    };
    Some(Finding::warning(
        FindingCode::Unexplained,
        format!("wrench/{name}"),
        format!(
            "wrench/{name}: the identified parameters leave {:.0} % of its changes unexplained \
             (times the stated noise: {}).{hint} Check encoder offsets, signs and the order of \
             joints, dead encoders, the sensor's axes and calibration, time offsets, cables, \
             undeclared contacts, noise_n and noise_nm, and whether the log is of this robot",
            100.0 * share,
            axes.join(", ")
        ),
    ))
}

/// When a joint first moves by more than [`STILL`] from its initial position; none if none does, or
/// within the first half second.
pub(crate) fn onset(instants: &[Annotated]) -> Option<Nanos> {
    let first = instants.first()?;
    let moved = instants.iter().find(|i| {
        i.position
            .iter()
            .zip(&first.position)
            .any(|(a, b)| (a - b).abs() > STILL)
    })?;
    ((moved.t - first.t).seconds() > 0.5).then_some(moved.t)
}

/// Joint torques computed from the two sides of a joint.
fn two_route(
    judged: &Judged<'_>,
    instants: &[Annotated],
    residuals: &Residuals,
) -> Vec<TwoRouteOutcome> {
    let (robot, unknowns) = (judged.identified.robot(), judged.identified.unknowns());
    if unknowns.sensors.len() < 2 {
        return Vec::new();
    }
    let mut measurement = judged.identified.measurement.clone();
    let dofs = robot.model.dof_count();
    let configured = configured_nuisance(robot, unknowns);
    let mut series = vec![[const { Vec::new() }; 3]; dofs];
    for (range, block) in residuals.ranges.iter().zip(&residuals.nuisance) {
        let cases = cases(&judged.sets, &configured, block);
        for instant in &instants[range.clone()] {
            let rows = measurement.rows(instant);
            for (dof, along) in measurement.two_routes(&rows) {
                for (series, (d, nuisance)) in series[dof].iter_mut().zip(cases) {
                    let weights = along.iter().enumerate();
                    let terms = weights
                        .map(|(row, weight)| weight * rows.residual(row, d.as_slice(), nuisance));
                    series.push(terms.sum());
                }
            }
        }
    }
    (0..dofs)
        .filter(|&dof| !series[dof][0].is_empty())
        .map(|dof| TwoRouteOutcome {
            joint: robot.model.dof_name(dof).to_owned(),
            rms_nm: three([0, 1, 2].map(|set| rms(series[dof][set].iter().copied()))),
            rms_mean_removed_nm: three([0, 1, 2].map(|set| {
                let centre = mean(&series[dof][set]);
                rms(series[dof][set].iter().map(|x| x - centre))
            })),
        })
        .collect()
}

/// Standard deviations of the nuisance parameters at the end of the log: their uncertainty for
/// known parameters, and the contribution of the parameters' covariance.
fn nuisance_deviations(judged: &Judged<'_>, instants: &[Annotated]) -> Vec<f64> {
    // From the last instants only: an offset drifts, and a filter that starts there without prior
    // knowledge overestimates the uncertainty.
    let first = instants.len().saturating_sub(SEGMENT_INSTANTS);
    let segment = LogSegment::alone(&instants[first..]);
    let mut measurement = judged.identified.measurement.clone();
    let reduced = reduce(&mut measurement, segment, &judged.identified.noise);
    let moved = &reduced.slope * judged.root;
    (0..reduced.covariance.nrows())
        .map(|i| (reduced.covariance[(i, i)].max(0.0) + moved.row(i).norm_squared()).sqrt())
        .collect()
}

/// Offsets of the sensors that occur in rows of the log.
fn offsets(
    identified: &Identified<'_>,
    residuals: &Residuals,
    deviations: &[f64],
) -> Vec<OffsetOutcome> {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let (Some(first), Some(last)) = (residuals.nuisance.first(), residuals.nuisance.last()) else {
        return Vec::new();
    };
    let axes = |index: usize, value: &dyn Fn(usize) -> f64| {
        std::array::from_fn(|axis| value(channel_of(index, axis)))
    };
    let is_read = |index: usize| (0..6).any(|axis| residuals.has_channel(6 * index + axis));
    let sensors = unknowns.sensors.iter().enumerate();
    let offsets = sensors.filter(|(index, _)| is_read(*index));
    offsets
        .map(|(index, &sensor)| OffsetOutcome {
            sensor: sensor_name(robot, sensor),
            start: axes(index, &|channel| first.x[(channel, 1)]),
            end: axes(index, &|channel| last.x[(channel, 1)]),
            deviation: axes(index, &|channel| deviations[channel]),
            rate: axes(index, &|channel| {
                identified.noise.drift_variance[channel].sqrt()
            }),
        })
        .collect()
}

/// Friction of the joints whose torque was measured in the log.
fn friction(
    identified: &Identified<'_>,
    residuals: &Residuals,
    deviations: &[f64],
) -> Vec<FrictionOutcome> {
    let (robot, unknowns) = (identified.robot(), identified.unknowns());
    let Some(last) = residuals.nuisance.last() else {
        return Vec::new();
    };
    let first = unknowns.wrenches();
    let value = |index: usize, k: usize| last.x[(first + FRICTION * index + k, 1)];
    unknowns
        .joints
        .iter()
        .enumerate()
        .filter(|(index, _)| residuals.has_channel(first + index))
        .map(|(index, &dof)| FrictionOutcome {
            joint: robot.model.dof_name(dof).to_owned(),
            coulomb_nm: value(index, 0),
            viscous: value(index, 1),
            offset_nm: value(index, 2),
            deviation: [0, 1, 2].map(|k| deviations[first + FRICTION * index + k]),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measurement::reduction::tests::between_two_sensors;

    /// The finding for residuals of a tenth of each axis's changes, at `instants` instants.
    fn a_tenth_left(instants: usize) -> Option<Finding> {
        let robot = between_two_sensors();
        let mut load: Vec<f64> = (0..400)
            .map(|i| 100.0 * (0.3 * f64::from(i)).sin())
            .collect();
        load[instants..].fill(f64::NAN);
        let error = load.iter().map(|load| 0.1 * load).collect();
        let compared = SensorComparison {
            rows: vec![vec![6; load.len()]],
            load: vec![load; 6],
            errors: [Vec::new(), Vec::new(), vec![error; 6]],
        };
        unexplained(&robot, 0, &compared, 0)
    }

    #[test]
    fn few_compared_instants_give_no_finding() {
        assert!(a_tenth_left(MIN_FOLD).is_some());
        assert!(a_tenth_left(MIN_FOLD - 1).is_none());
        assert!(a_tenth_left(0).is_none());
    }
}
