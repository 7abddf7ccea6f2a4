//! Frames and directions of an F/T sensor other than the configured ones.

use crate::readings::quarter_turns;
use crate::robot::Robot;
use nalgebra::{Matrix6, Rotation3, Vector6};
use proprio_dynamics::SensorCut;
use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame};
use proprio_dynamics::spatial::{Mat3, Pose, Wrench};

/// Another frame that a sensor's readings may be in.
#[derive(Clone)]
pub(super) struct Mounting {
    /// What the configuration should state; none: the opposite direction, all else unchanged.
    pub(super) instead: Option<String>,
    /// From readings in that frame to readings as configured, [torque; force].
    pub(super) change: Matrix6<f64>,
}

impl Mounting {
    pub(super) fn opposite() -> Self {
        Self {
            instead: None,
            change: -Matrix6::identity(),
        }
    }
}

/// Frames that have a name in the configuration; then axes rotated by right angles about the
/// configured origin; all in both directions, the configured one first.
pub(super) fn mountings(robot: &Robot, sensor: usize) -> Vec<Mounting> {
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
    let mut elements = robot.model.sensors().iter();
    let element = elements.find(|element| element.joint == joint);
    let mut poses: Vec<(String, Pose)> = vec![("frame = \"child\"".into(), Pose::identity())];
    poses.extend(parent.map(|parent| ("frame = \"parent\"".to_owned(), *parent.pose())));
    poses.extend(element.map(|element| {
        let text = "frame = \"sensor\" (as the URDF poses it)";
        (text.to_owned(), element.pose)
    }));
    let list = |values: [f64; 3]| {
        let numbers = values.map(|value| format!("{}", (1e4 * value).round() / 1e4 + 0.0));
        format!("[{}]", numbers.join(", "))
    };
    for turn in [Mat3::identity()].into_iter().chain(quarter_turns()) {
        let rotation = configured.rotation * turn;
        let (roll, pitch, yaw) = Rotation3::from_matrix_unchecked(rotation).euler_angles();
        let text = format!(
            "frame = \"sensor\", xyz_m = {}, rpy_rad = {}",
            list(configured.translation.into()),
            list([roll, pitch, yaw])
        );
        poses.push((
            text,
            Pose {
                rotation,
                ..configured
            },
        ));
    }
    let mut mountings = vec![
        Mounting {
            instead: None,
            change: Matrix6::identity(),
        },
        Mounting::opposite(),
    ];
    for (sign, direction) in [(1.0, same), (-1.0, other)] {
        for (text, pose) in &poses {
            let change = Matrix6::from_columns(&std::array::from_fn::<_, 6, _>(|channel| {
                let mut unit = [0.0; 6];
                unit[channel] = sign;
                let in_child = pose.wrench(&Wrench::from_torque_first(unit));
                Vector6::from(configured.wrench_back(&in_child).torque_first())
            }));
            let is_new = |other: &Mounting| (change - other.change).amax() > 1e-6;
            if mountings.iter().all(is_new) {
                mountings.push(Mounting {
                    instead: Some(format!("{text}, direction = \"{direction}\"")),
                    change,
                });
            }
        }
    }
    mountings.split_off(2)
}
