//! F/T sensors that are mounted, or configured, otherwise than their configuration says: the wrong way round, or with the axes or the origin of another frame.
//!
//! What is asked is by how much CAD and constant offsets miss all rows of F/T sensors as they are, and if what this sensor reads, or that one, were in another frame: where a sub-tree has two sensors, putting the right
//! one right makes all well. The change that helps the most is taken, as long as it leaves less than a third of the squares, which is what a correlation of -1/2 is; then the next.
//!
//! A sign is tried always: masses would come out negative. Frames are tried only where the readings hardly follow CAD at all ([`STRANGE`]), and believed only if they do then: bodies that differ from
//! CAD's by a third are no wrong frame.

use super::assess;
use super::batch::{Prepared, finding, over, sample};
use super::instants::Defect;
use super::outcome::{Finding, Severity};
use super::passes::{OFFSET_VARIANCE, session_prior};
use super::rows::{RowMaker, Rows};
use super::session::Session;
use crate::dynamics::{SensorCut, Structure};
use crate::model::{MeasurementDirection, MeasurementFrame};
use crate::setup::Setup;
use crate::spatial::{Mat3, Pose, Vec3, Wrench};
use nalgebra::{Matrix6, Rotation3, Vector6};

/// Squares that CAD misses, of those that there are without any links, from which on something else than bodies is wrong: bodies off by a third leave a ninth.
const STRANGE: f64 = 0.25;

/// A change counts if it leaves less of the squares.
const LEFT: f64 = 1.0 / 3.0;

/// Of changes that leave nearly the same the simplest is meant.
const ALIKE: f64 = 1.5;

/// A log tells by itself how sensors were mounted if what they read in it changes by this share, of squares, of what it does in others: where little is moved, what CAD has wrong looks like a wrong frame.
const ALONE: f64 = 1.0 / 9.0;

/// Another frame that a sensor's readings may be in.
struct Candidate {
    /// What the configuration should say; none: the other direction, all else as it is.
    instead: Option<String>,
    /// From readings in that frame to readings as configured, [torque; force].
    change: Matrix6<f64>,
}

/// Sensors whose readings fit CAD only in another frame than the configuration says.
pub(super) fn wrong(maker: &RowMaker<'_>, training: &[&Prepared]) -> Vec<Finding> {
    let (setup, layout) = (maker.setup(), maker.layout());
    let count = layout.sensors.len();
    let mut chosen: Vec<Option<Candidate>> = (0..count).map(|_| None).collect();
    loop {
        let open: Vec<usize> = (0..count).filter(|place| chosen[*place].is_none()).collect();
        let mut tries: Vec<(usize, Candidate)> = Vec::new();
        tries.extend(open.iter().map(|&place| (place, turned())));
        let mut cases = vec![case(&chosen, None)];
        cases.extend(tries.iter().map(|own| case(&chosen, Some(own))));
        let (mut found, without) = misfits(maker, training, &cases);
        let before = found.remove(0);
        if before > STRANGE * without {
            let frames = open.iter().flat_map(|&place| {
                let candidates = frames(setup, layout.sensors[place]).into_iter();
                candidates.map(move |candidate| (place, candidate))
            });
            let frames: Vec<(usize, Candidate)> = frames.collect();
            let cases: Vec<_> = frames.iter().map(|own| case(&chosen, Some(own))).collect();
            let (more, _) = misfits(maker, training, &cases);
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
            .position(|misfit| *misfit < LEFT * before && *misfit <= ALIKE * least);
        let Some(best) = best else { break };
        let (place, candidate) = tries.swap_remove(best);
        chosen[place] = Some(candidate);
    }
    let told = layout.sensors.iter().zip(&chosen).filter_map(|(&sensor, candidate)| {
        let sensor = assess::sensor_name(setup, sensor);
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
    told.collect()
}

/// The same of each log alone, those for validation too, where all together fit: a sensor that was mounted otherwise in the minority of them. Nothing of one that is refused already.
pub(super) fn wrong_alone(maker: &RowMaker<'_>, training: &[&Prepared], logs: &[Prepared]) -> Vec<Vec<Finding>> {
    let others = change(maker, training);
    let found = logs.iter().map(|log| {
        let is_all = training.len() == 1 && std::ptr::eq(training[0], log);
        if log.refused || is_all || change(maker, &[log]) < ALONE * others {
            return Vec::new();
        }
        wrong(maker, &[log])
    });
    found.collect()
}

/// Mean square of what the sensors read at an instant, less constant offsets.
fn change(maker: &RowMaker<'_>, logs: &[&Prepared]) -> f64 {
    let instants: usize = sample(maker, logs).iter().map(|piece| piece.instants.len()).sum();
    misfits(maker, logs, &[]).1 / instants.max(1) as f64
}

/// What each sensor's readings are changed by.
type Case = Vec<Option<Matrix6<f64>>>;

fn case(chosen: &[Option<Candidate>], tried: Option<&(usize, Candidate)>) -> Case {
    let mut case: Case = chosen.iter().map(|own| own.as_ref().map(|own| own.change)).collect();
    if let Some((place, candidate)) = tried {
        case[*place] = Some(candidate.change);
    }
    case
}

/// Squares that CAD and constant offsets miss in each of these cases; and that there are without any links.
fn misfits(maker: &RowMaker<'_>, training: &[&Prepared], cases: &[Case]) -> (Vec<f64>, f64) {
    let layout = maker.layout();
    let count = cases.len() + 1;
    // A force counts as much as its torque on an arm of this length.
    let mut variances = vec![1.0; layout.channels()];
    for torque in (0..layout.sensors.len()).flat_map(|place| 6 * place..6 * place + 3) {
        variances[torque] = Structure::LENGTH_SCALE.powi(2);
    }
    let pieces = sample(maker, training);
    let parts = over(maker, &pieces, |maker, _, piece| {
        let mut misfits = vec![0.0; count];
        let mut session = Session::new(&session_prior(layout), count);
        let mut rows = Rows::new(layout);
        let (mut lines, mut last) = (Vec::new(), None);
        for instant in piece.instants {
            let t = last.replace(instant.t).unwrap_or(instant.t);
            for broken in piece.breaks.iter().filter(|b| t < b.t && b.t <= instant.t) {
                if let Ok(place) = layout.sensors.binary_search(&broken.sensor) {
                    (6 * place..6 * place + 6).for_each(|unknown| session.renew(unknown, OFFSET_VARIANCE));
                }
            }
            if maker.make(instant, &mut rows).is_err() {
                continue;
            }
            let readings: Vec<Vector6<f64>> = layout
                .sensors
                .iter()
                .map(|&sensor| Vector6::from(instant.readings[sensor].torque_first()))
                .collect();
            // By how much each case changes each sensor's reading.
            let changes: Vec<Vec<Option<Vector6<f64>>>> = cases
                .iter()
                .map(|case| {
                    let each = case.iter().zip(&readings);
                    each.map(|(change, reading)| change.map(|change| change * reading - reading))
                        .collect()
                })
                .collect();
            // What a reading has in the right side.
            let share = |g: &[f64], values: &Vector6<f64>| -> f64 {
                let pairs = g.iter().zip(values).filter(|(g, _)| **g != 0.0);
                pairs.map(|(g, x)| g * x).sum()
            };
            let of_joints = 6 * layout.sensors.len();
            lines.clear();
            for row in 0..rows.count {
                let g = || rows.g(row).chunks_exact(6);
                for case in &changes {
                    let changed = g().zip(case).filter_map(|(g, change)| Some(share(g, change.as_ref()?)));
                    lines.push(rows.r(row) + changed.sum::<f64>());
                }
                lines.push(g().zip(&readings).map(|(g, reading)| share(g, reading)).sum());
            }
            rows.whiten_with(&variances, &mut lines, count);
            for (row, line) in lines.chunks_exact_mut(count).enumerate() {
                // A joint's torque does not change with how a sensor is mounted, and what CAD has wrong of it would hide what does. (Its row shares no noise with a sensor's.)
                if rows.n(row)[of_joints..].iter().any(|n| *n != 0.0) {
                    continue;
                }
                session.update(rows.g(row), line);
                misfits.iter_mut().zip(line).for_each(|(sum, x)| *sum += *x * *x);
            }
        }
        misfits
    });
    let mut sums: Vec<f64> = (0..count).map(|k| parts.iter().map(|part| part[k]).sum()).collect();
    let without = sums.pop().unwrap_or(0.0);
    (sums, without)
}

/// The other direction.
fn turned() -> Candidate {
    Candidate {
        instead: None,
        change: -Matrix6::identity(),
    }
}

/// Frames that have a name in the configuration, both directions; then axes that are turned by right angles about the configured origin, both directions.
fn frames(setup: &Setup, sensor: usize) -> Vec<Candidate> {
    let cut = &setup.structure.sensors()[sensor];
    let joint = setup.model.joint_name(cut.joint());
    let configured = *cut.pose();
    let (same, other) = match cut.sign() < 0.0 {
        true => ("child_to_parent", "parent_to_child"),
        false => ("parent_to_child", "child_to_parent"),
    };
    let parent = SensorCut::new(
        &setup.model,
        joint,
        MeasurementFrame::Parent,
        MeasurementDirection::ChildToParent,
        &Pose::identity(),
        &cut.noise(),
    );
    let element = setup.model.sensors().iter().find(|element| element.joint == joint);
    let mut poses: Vec<(String, Pose)> = vec![("frame = \"child\"".into(), Pose::identity())];
    poses.extend(parent.map(|parent| ("frame = \"parent\"".to_owned(), *parent.pose())));
    poses.extend(element.map(|element| ("frame = \"sensor\" (as the URDF poses it)".to_owned(), element.pose)));
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
    // Those in the same direction first.
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

/// The 24 turns by right angles: permutations of the axes with signs, of determinant one.
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
    fn right_angles_are_all_turns_of_a_cube() {
        let turns: Vec<Mat3> = right_angles().collect();
        assert_eq!(turns.len(), 24);
        for (number, turn) in turns.iter().enumerate() {
            assert!((turn.determinant() - 1.0).abs() < 1e-15);
            assert!(turns[..number].iter().all(|other| other != turn));
        }
        assert_eq!(turns.iter().filter(|turn| **turn == Mat3::identity()).count(), 1);
    }
}
