//! F/T sensors with a wrong measurement frame or direction: their configuration differs from how
//! they are mounted.
//!
//! The test compares the squared residuals of all F/T rows, with CAD and constant offsets, for the
//! configured frames and with the readings of one sensor in another frame: where a sub-tree has two
//! sensors, correcting the right one removes the residuals of both. The change that reduces the
//! residuals the most is accepted if less than a third of the squares remains, which corresponds to
//! a correlation of -1/2; then the next change in the same way.
//!
//! The opposite direction is always tested: with it, masses would be estimated as negative. Other
//! frames are tested only if the readings hardly follow CAD ([`STRANGE`]), and accepted only if the
//! readings follow CAD with them: inertial parameters that differ from CAD's by a third do not look
//! like a wrong frame.

use crate::dataset::defects::Defect;
use crate::finding::{Finding, Severity};
use crate::linear::nuisance::NuisanceFilter;
use crate::measurement::channels;
use crate::measurement::model::MeasurementModel;
use crate::measurement::reduction::nuisance_prior;
use crate::measurement::rows::Rows;
use crate::robot::Robot;
use crate::training::{TrainingLog, finding, map_segments, sample};
use nalgebra::{Matrix6, Rotation3, Vector6};
use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame};
use proprio_dynamics::spatial::{Mat3, Pose, Vec3, Wrench};
use proprio_dynamics::{SensorCut, Structure};

/// Fraction of the squared readings that CAD leaves unexplained, above which errors of the inertial
/// parameters are not the cause: parameters wrong by a third leave a ninth.
const STRANGE: f64 = 0.25;

/// A change is accepted if less than this fraction of the squares remains.
const REMAINING: f64 = 1.0 / 3.0;

/// Among changes whose remaining squares differ by less than this factor, the simplest is accepted.
const SIMILAR: f64 = 1.5;

/// A log is tested alone if the mean square of its readings is at least this fraction of that of
/// the training logs: with little motion, errors of CAD look like a wrong frame.
const ENOUGH_ALONE: f64 = 1.0 / 9.0;

/// Another frame that a sensor's readings may be in.
struct Candidate {
    /// What the configuration should state; none: the opposite direction, all else unchanged.
    instead: Option<String>,
    /// From readings in that frame to readings as configured, [torque; force].
    change: Matrix6<f64>,
}

/// Sensors whose readings fit CAD only in another frame than the configuration says.
pub(crate) fn wrong(measurement: &MeasurementModel<'_>, training: &[&TrainingLog]) -> Vec<Finding> {
    let (robot, unknowns) = (measurement.robot(), measurement.unknowns());
    let count = unknowns.sensors.len();
    let mut chosen: Vec<Option<Candidate>> = (0..count).map(|_| None).collect();
    loop {
        let open: Vec<usize> = (0..count)
            .filter(|place| chosen[*place].is_none())
            .collect();
        let mut tries: Vec<(usize, Candidate)> = Vec::new();
        tries.extend(open.iter().map(|&place| (place, opposite_direction())));
        let mut cases = vec![case(&chosen, None)];
        cases.extend(tries.iter().map(|own| case(&chosen, Some(own))));
        let (mut found, without) = misfits(measurement, training, &cases);
        let before = found.remove(0);
        if before > STRANGE * without {
            let frames = open.iter().flat_map(|&place| {
                let candidates = frames(robot, unknowns.sensors[place]).into_iter();
                candidates.map(move |candidate| (place, candidate))
            });
            let frames: Vec<(usize, Candidate)> = frames.collect();
            let cases: Vec<_> = frames.iter().map(|own| case(&chosen, Some(own))).collect();
            let (more, _) = misfits(measurement, training, &cases);
            for (candidate, misfit) in frames.into_iter().zip(more) {
                if misfit < STRANGE * without {
                    tries.push(candidate);
                    found.push(misfit);
                }
            }
        }
        let least = found.iter().copied().fold(f64::INFINITY, f64::min);
        // In the order of the tries: signs, frames with a name, turned axes.
        let best = found
            .iter()
            .position(|misfit| *misfit < REMAINING * before && *misfit <= SIMILAR * least);
        let Some(best) = best else { break };
        let (place, candidate) = tries.swap_remove(best);
        chosen[place] = Some(candidate);
    }
    let findings = unknowns
        .sensors
        .iter()
        .zip(&chosen)
        .filter_map(|(&sensor, candidate)| {
            let sensor = channels::sensor_name(robot, sensor);
            let defect = match &candidate.as_ref()?.instead {
                None => Defect::WrongSign { sensor },
                Some(instead) => Defect::WrongFrame {
                    sensor,
                    instead: instead.clone(),
                },
            };
            Some(Finding {
                severity: Severity::Refusal,
                ..finding(&defect)
            })
        });
    findings.collect()
}

/// The same for each log alone, validation logs included, after all logs together are accepted: a
/// sensor that was mounted differently in a minority of the logs. Refused logs are skipped.
pub(crate) fn wrong_alone(
    measurement: &MeasurementModel<'_>,
    training: &[&TrainingLog],
    logs: &[TrainingLog],
) -> Vec<Vec<Finding>> {
    let others = change(measurement, training);
    let found = logs.iter().map(|log| {
        let is_all = training.len() == 1 && std::ptr::eq(training[0], log);
        if log.refused || is_all || change(measurement, &[log]) < ENOUGH_ALONE * others {
            return Vec::new();
        }
        wrong(measurement, &[log])
    });
    found.collect()
}

/// Mean square of the sensors' readings per instant, less constant offsets.
fn change(measurement: &MeasurementModel<'_>, logs: &[&TrainingLog]) -> f64 {
    let instants: usize = sample(measurement, logs)
        .iter()
        .map(|segment| segment.instants.len())
        .sum();
    misfits(measurement, logs, &[]).1 / instants.max(1) as f64
}

/// The change of each sensor's readings.
type Case = Vec<Option<Matrix6<f64>>>;

fn case(chosen: &[Option<Candidate>], tried: Option<&(usize, Candidate)>) -> Case {
    let mut case: Case = chosen
        .iter()
        .map(|own| own.as_ref().map(|own| own.change))
        .collect();
    if let Some((place, candidate)) = tried {
        case[*place] = Some(candidate.change);
    }
    case
}

/// Sums of squared residuals with CAD and constant offsets in each of these cases; and without any
/// links.
fn misfits(
    measurement: &MeasurementModel<'_>,
    training: &[&TrainingLog],
    cases: &[Case],
) -> (Vec<f64>, f64) {
    let unknowns = measurement.unknowns();
    let count = cases.len() + 1;
    // A force has the weight of its torque at a lever of this length.
    let mut variances = vec![1.0; unknowns.channels()];
    for torque in (0..unknowns.sensors.len()).flat_map(|place| 6 * place..6 * place + 3) {
        variances[torque] = Structure::LENGTH_SCALE.powi(2);
    }
    let segments = sample(measurement, training);
    let parts = map_segments(measurement, &segments, |measurement, _, segment| {
        let mut misfits = vec![0.0; count];
        let mut nuisance = NuisanceFilter::new(&nuisance_prior(unknowns), count);
        let mut rows = Rows::new(unknowns);
        let mut lines = Vec::new();
        for instant in segment.instants {
            if measurement.make(instant, &mut rows).is_err() {
                continue;
            }
            let readings: Vec<Vector6<f64>> = unknowns
                .sensors
                .iter()
                .map(|&sensor| Vector6::from(instant.readings[sensor].torque_first()))
                .collect();
            // The change of each sensor's reading in each case.
            let changes: Vec<Vec<Option<Vector6<f64>>>> = cases
                .iter()
                .map(|case| {
                    let each = case.iter().zip(&readings);
                    each.map(|(change, reading)| change.map(|change| change * reading - reading))
                        .collect()
                })
                .collect();
            // The contribution of a reading to the right side.
            let share = |g: &[f64], values: &Vector6<f64>| -> f64 {
                let pairs = g.iter().zip(values).filter(|(g, _)| **g != 0.0);
                pairs.map(|(g, x)| g * x).sum()
            };
            let of_joints = 6 * unknowns.sensors.len();
            lines.clear();
            for row in 0..rows.count {
                let g = || rows.g(row).chunks_exact(6);
                for case in &changes {
                    let changed = g()
                        .zip(case)
                        .filter_map(|(g, change)| Some(share(g, change.as_ref()?)));
                    lines.push(rows.r(row) + changed.sum::<f64>());
                }
                lines.push(
                    g().zip(&readings)
                        .map(|(g, reading)| share(g, reading))
                        .sum(),
                );
            }
            rows.whiten_with(&variances, &mut lines, count);
            for (row, line) in lines.chunks_exact_mut(count).enumerate() {
                // A joint torque does not depend on how a sensor is mounted, and its CAD errors
                // would hide what does. (Its row shares no noise with a sensor's.)
                if rows.n(row)[of_joints..].iter().any(|n| *n != 0.0) {
                    continue;
                }
                nuisance.update(rows.g(row), line);
                misfits
                    .iter_mut()
                    .zip(line)
                    .for_each(|(sum, x)| *sum += *x * *x);
            }
        }
        misfits
    });
    let mut sums: Vec<f64> = (0..count)
        .map(|k| parts.iter().map(|part| part[k]).sum())
        .collect();
    let without = sums.pop().unwrap_or(0.0);
    (sums, without)
}

/// The opposite direction.
fn opposite_direction() -> Candidate {
    Candidate {
        instead: None,
        change: -Matrix6::identity(),
    }
}

/// Frames that have a name in the configuration, in both directions; then axes rotated by right
/// angles about the configured origin, in both directions.
fn frames(robot: &Robot, sensor: usize) -> Vec<Candidate> {
    let cut = &robot.structure.sensors()[sensor];
    let joint = robot.model.joint_name(cut.joint());
    let configured = *cut.pose();
    let (same, other) = match cut.sign() < 0.0 {
        true => ("child_to_parent", "parent_to_child"),
        false => ("parent_to_child", "child_to_parent"),
    };
    let parent = SensorCut::new(
        &robot.model,
        joint,
        MeasurementFrame::Parent,
        MeasurementDirection::ChildToParent,
        &Pose::identity(),
        &cut.noise(),
    );
    let element = robot
        .model
        .sensors()
        .iter()
        .find(|element| element.joint == joint);
    let mut poses: Vec<(String, Pose)> = vec![("frame = \"child\"".into(), Pose::identity())];
    poses.extend(parent.map(|parent| ("frame = \"parent\"".to_owned(), *parent.pose())));
    poses.extend(element.map(|element| {
        (
            "frame = \"sensor\" (as the URDF poses it)".to_owned(),
            element.pose,
        )
    }));
    for turn in right_angles() {
        let pose = Pose {
            rotation: configured.rotation * turn,
            ..configured
        };
        let (roll, pitch, yaw) = Rotation3::from_matrix_unchecked(pose.rotation).euler_angles();
        let list = |values: [f64; 3]| {
            let numbers = values.map(|value| format!("{}", (1e4 * value).round() / 1e4 + 0.0));
            format!("[{}]", numbers.join(", "))
        };
        let text = format!(
            "frame = \"sensor\", xyz_m = {}, rpy_rad = {}",
            list(pose.translation.into()),
            list([roll, pitch, yaw])
        );
        poses.push((text, pose));
    }
    let mut candidates: Vec<Candidate> = Vec::new();
    // The configured direction first.
    for (sign, direction) in [(1.0, same), (-1.0, other)] {
        for (text, pose) in &poses {
            let change = Matrix6::from_columns(&std::array::from_fn::<_, 6, _>(|channel| {
                let mut unit = [0.0; 6];
                unit[channel] = sign;
                let in_child = pose.wrench(&Wrench::from_torque_first(unit));
                Vector6::from(configured.wrench_back(&in_child).torque_first())
            }));
            let is_new = |other: &Matrix6<f64>| (change - other).amax() > 1e-6;
            let known = candidates.iter().map(|own| own.change);
            let plain = [Matrix6::identity(), -Matrix6::identity()];
            if known.chain(plain).all(|other| is_new(&other)) {
                candidates.push(Candidate {
                    instead: Some(format!("{text}, direction = \"{direction}\"")),
                    change,
                });
            }
        }
    }
    candidates
}

/// The 24 rotations by right angles: signed permutations of the axes with determinant one.
fn right_angles() -> impl Iterator<Item = Mat3> {
    let axis = |number: usize| {
        let sign = if number < 3 { 1.0 } else { -1.0 };
        let mut axis = Vec3::zeros();
        axis[number % 3] = sign;
        axis
    };
    let pairs = (0..6).flat_map(|x| (0..6).map(move |y| (x, y)));
    pairs.filter(|(x, y)| x % 3 != y % 3).map(move |(x, y)| {
        let (x, y) = (axis(x), axis(y));
        Mat3::from_columns(&[x, y, x.cross(&y)])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn right_angles_are_all_rotations_of_a_cube() {
        let turns: Vec<Mat3> = right_angles().collect();
        assert_eq!(turns.len(), 24);
        for (number, turn) in turns.iter().enumerate() {
            assert!((turn.determinant() - 1.0).abs() < 1e-15);
            assert!(turns[..number].iter().all(|other| other != turn));
        }
        assert_eq!(
            turns
                .iter()
                .filter(|turn| **turn == Mat3::identity())
                .count(),
            1
        );
    }
}
