//! The F/T sensors of the configuration: how each measures, as estimator.toml says it, else the
//! sensor element of the URDF, else by default.

use super::names::no_joint;
use crate::config::{Config, ForceTorque};
use proprio_dynamics::model::{MeasurementDirection, MeasurementFrame, Model, SensorElement};
use proprio_dynamics::spatial::Pose;
use proprio_dynamics::{Noise, SensorCut, StructureError};

/// The cuts of the tree at the F/T sensors. Adds warnings where estimator.toml and URDF differ.
pub(super) fn sensors(
    config: &Config,
    model: &Model,
    warnings: &mut Vec<String>,
) -> Result<Vec<SensorCut>, String> {
    let sensors = config.force_torque.iter();
    sensors.map(|ft| sensor(ft, model, warnings)).collect()
}

fn sensor(
    ft: &ForceTorque,
    model: &Model,
    warnings: &mut Vec<String>,
) -> Result<SensorCut, String> {
    let at = format!("force_torque {:?}", ft.sensor);
    let element = element_of(model, &ft.sensor, &ft.joint).map_err(|why| at.clone() + &why)?;
    if let Some(element) = element {
        warnings.extend(differences(ft, element).map(|difference| format!("{at}: {difference}")));
    }
    if let (None, Some(why)) = (element, model.unread_sensor(&ft.joint))
        && (ft.frame.is_none() || ft.direction.is_none())
    {
        return Err(format!(
            "{at}: the URDF does not tell how it measures: {why}; correct it there, or give frame \
             and direction here"
        ));
    }
    let frame = ft.frame.or(element.map(|e| e.frame));
    let frame = frame.unwrap_or(MeasurementFrame::Child);
    let direction = ft.direction.or(element.map(|e| e.direction));
    let direction = direction.unwrap_or(MeasurementDirection::ChildToParent);
    let own_pose = own_pose(ft, frame).map_err(|why| format!("{at}: {why}"))?;
    let pose = match (own_pose, element) {
        (Some(pose), Some(element)) => {
            let apart = element.pose.inverse() * pose;
            let turned = (apart.rotation.trace() - 3.0).abs();
            if apart.translation.norm() > 1e-6 || turned > 1e-9 {
                warnings.push(format!(
                    "{at}: its pose here differs from the one in the URDF; this file's pose is used"
                ));
            }
            pose
        }
        (Some(pose), None) => pose,
        (None, Some(element)) => element.pose,
        (None, None) if frame == MeasurementFrame::Sensor => {
            return Err(format!(
                "{at}: frame = \"sensor\" needs its pose: xyz_m and rpy_rad here, or a sensor \
                 element in the URDF"
            ));
        }
        (None, None) => Pose::identity(),
    };
    let noise = Noise {
        force: ft.noise_n,
        torque: ft.noise_nm,
    };
    SensorCut::new(model, &ft.joint, frame, direction, &pose, &noise).map_err(|e| match e {
        StructureError::NoJoint(_) => {
            let why = no_joint(model, &ft.joint);
            format!("{at}: joint = {:?}: {why}", ft.joint)
        }
        e => format!("{at}: {e}"),
    })
}

/// What estimator.toml says otherwise than the URDF.
fn differences(ft: &ForceTorque, element: &SensorElement) -> impl Iterator<Item = String> {
    let frame = ft
        .frame
        .map(|frame| ["frame", frame_word(frame), frame_word(element.frame)]);
    let direction = ft.direction.map(|direction| {
        let urdf = direction_word(element.direction);
        ["direction", direction_word(direction), urdf]
    });
    let differing = |[_, here, urdf]: &[&str; 3]| here != urdf;
    let words = frame.into_iter().chain(direction).filter(differing);
    words.map(|[key, here, urdf]| {
        format!("{key} is \"{here}\" here and \"{urdf}\" in the URDF; this file's value is used")
    })
}

/// The pose that estimator.toml gives.
fn own_pose(ft: &ForceTorque, frame: MeasurementFrame) -> Result<Option<Pose>, &'static str> {
    match (ft.xyz_m, ft.rpy_rad) {
        (None, None) => Ok(None),
        (Some(xyz), Some(rpy)) if frame == MeasurementFrame::Sensor => {
            Ok(Some(Pose::from_xyz_rpy(xyz, rpy)))
        }
        (Some(_), Some(_)) => Err(
            "xyz_m and rpy_rad are allowed with frame = \"sensor\" only; remove them, or set frame \
             = \"sensor\"",
        ),
        _ => Err("only one of xyz_m and rpy_rad is given: give both or neither"),
    }
}

/// A frame, as the configuration and the URDF name it.
const fn frame_word(frame: MeasurementFrame) -> &'static str {
    match frame {
        MeasurementFrame::Child => "child",
        MeasurementFrame::Parent => "parent",
        MeasurementFrame::Sensor => "sensor",
    }
}

/// A direction, as the configuration and the URDF name it.
const fn direction_word(direction: MeasurementDirection) -> &'static str {
    match direction {
        MeasurementDirection::ChildToParent => "child_to_parent",
        MeasurementDirection::ParentToChild => "parent_to_child",
    }
}

/// The element of the URDF that describes a sensor: that of its name in its joint, else the only
/// one of the joint.
fn element_of<'m>(
    model: &'m Model,
    sensor: &str,
    joint: &str,
) -> Result<Option<&'m SensorElement>, String> {
    let of_joint: Vec<_> = model
        .sensors()
        .iter()
        .filter(|e| e.joint == joint)
        .collect();
    let named = of_joint.iter().find(|element| element.name == sensor);
    match (named, &of_joint[..]) {
        (Some(element), _) | (None, [element]) => Ok(Some(element)),
        (None, []) => Ok(None),
        (None, several) => {
            let names: Vec<&str> = several.iter().map(|e| e.name.as_str()).collect();
            Err(format!(
                ": the URDF has several sensors in joint {joint}, none of this name: {}; use the \
                 name of one of them",
                names.join(", ")
            ))
        }
    }
}
