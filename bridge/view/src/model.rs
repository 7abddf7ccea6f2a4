//! The robot's model: its URDF, and the transforms of its links at the joints' positions.

use proprio_bridge::cdr::CdrMessage;
use proprio_dynamics::model::{Model as Dynamics, ModelError};
use proprio_dynamics::spatial::Pose;
use std::collections::BTreeMap;
use std::path::Path;

/// A robot's model.
pub(crate) struct ShownModel {
    urdf: String,
    dynamics: Dynamics,
    /// Joints that nobody measures, and where they are held \[rad or m\].
    locked: BTreeMap<String, f64>,
}

/// The pose of a link in its parent link.
pub(crate) struct Transform<'m> {
    parent: &'m str,
    child: &'m str,
    pose: Pose,
}

impl ShownModel {
    /// Reads a URDF. `locked` are joints that nobody measures, and their positions \[rad or m\].
    ///
    /// # Errors
    /// It cannot be read, or is no URDF.
    pub(crate) fn read(file: &Path, locked: BTreeMap<String, f64>) -> Result<Self, ModelError> {
        let urdf = Dynamics::read_text(file)?;
        let mut dynamics = Dynamics::from_urdf(&urdf, &[])?;
        for (joint, position) in &locked {
            dynamics.hold(joint, *position);
        }
        Ok(Self {
            urdf,
            dynamics,
            locked,
        })
    }

    /// The text of the URDF.
    pub(crate) fn urdf(&self) -> &str {
        &self.urdf
    }

    /// One transform per joint of the URDF, those that are fixed too. `measured` is the position of
    /// a joint \[rad or m\]; one that is NaN, and what follows it, is left out.
    pub(crate) fn transforms(&self, measured: impl Fn(&str) -> f64) -> Vec<Transform<'_>> {
        let position = |dof: usize| {
            let name = self.dynamics.dof_name(dof);
            let locked = self.locked.get(name).copied();
            locked.unwrap_or_else(|| measured(name))
        };
        // A joint is placed in a body, of which its parent link is a part.
        let between = |parent, pose: Pose| {
            let link = self.dynamics.frame(parent)?;
            Some(link.pose.inverse() * pose)
        };
        let joints = self.dynamics.joints().iter().enumerate();
        let moving = joints.filter_map(|(number, joint)| {
            let (parent, child) = self.dynamics.joint_links(number)?;
            let q = joint.ratio * position(joint.dof?) + joint.offset;
            let pose = between(parent, joint.pose(q)).filter(Pose::is_finite)?;
            Some(Transform {
                parent,
                child,
                pose,
            })
        });
        let fixed = self
            .dynamics
            .folded_joints()
            .filter_map(|(_, [parent, child])| {
                let pose = between(parent, self.dynamics.frame(child)?.pose)?;
                Some(Transform {
                    parent,
                    child,
                    pose,
                })
            });
        moving.chain(fixed).collect()
    }
}

/// The `TFMessage`; `wall` is in \[ns since 1970, UTC\].
pub(crate) fn message(wall: u64, transforms: &[Transform<'_>]) -> CdrMessage {
    let mut message = CdrMessage::new();
    message.count(transforms.len());
    for transform in transforms {
        message.time(wall);
        message.text(transform.parent);
        message.text(transform.child);
        message.f64s(transform.pose.translation.as_slice());
        message.f64s(&transform.pose.quaternion());
    }
    message
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_dynamics::spatial::Vec3;
    use proprio_dynamics::{FrameMotion, JointState, Kinematics};
    use std::collections::BTreeMap;

    /// A joint below a fixed one, a sliding joint, a follower, a held joint, an oblique axis.
    const ODD: &str = r#"<robot name="odd">
        <link name="base"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"
          ixz="0" iyz="0"/></inertial></link>
        <link name="mount"/>
        <joint name="bolt" type="fixed"><parent link="base"/><child link="mount"/>
          <origin xyz="0.1 0.2 0.3" rpy="0.4 0.5 0.6"/></joint>
        <link name="arm"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"
          ixz="0" iyz="0"/></inertial></link>
        <joint name="turn" type="continuous"><parent link="mount"/><child link="arm"/>
          <origin xyz="0 0 0.5" rpy="1 0 0"/><axis xyz="1 2 3"/></joint>
        <link name="slider"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"
          ixz="0" iyz="0"/></inertial></link>
        <joint name="slide" type="prismatic"><parent link="arm"/><child link="slider"/>
          <origin xyz="0.3 0 0" rpy="0 0 2"/><axis xyz="0 1 0"/>
          <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
        <link name="finger"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"
          ixz="0" iyz="0"/></inertial></link>
        <joint name="follow" type="revolute"><parent link="slider"/><child link="finger"/>
          <origin xyz="0 0.1 0"/><axis xyz="0 0 -1"/><mimic joint="turn" multiplier="-2"
          offset="0.1"/><limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
        <link name="tool"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0"
          ixz="0" iyz="0"/></inertial></link>
        <joint name="held" type="revolute"><parent link="finger"/><child link="tool"/>
          <origin xyz="0 0.1 0"/><axis xyz="0 1 0"/>
          <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
        </robot>"#;

    /// Each link's pose in the root, along the transforms.
    fn poses(transforms: &[Transform<'_>], root: &str) -> BTreeMap<String, Pose> {
        let mut poses = BTreeMap::from([(root.to_owned(), Pose::identity())]);
        for _ in transforms {
            for one in transforms {
                if let Some(parent) = poses.get(one.parent) {
                    poses.insert(one.child.to_owned(), *parent * one.pose);
                }
            }
        }
        poses
    }

    #[test]
    fn transforms_are_the_forward_kinematics() {
        let folder = std::env::temp_dir().join(format!("proprio-model-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        let odd = folder.join("odd.urdf");
        std::fs::write(&odd, ODD).expect("a file");
        let config = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config");
        let robots = ["icub_left_arm", "six_axis_arm", "moteus_leg"];
        let files = robots.map(|robot| config.join(robot).join("model.urdf"));
        for file in files.into_iter().chain([odd]) {
            let locked = BTreeMap::from([("held".to_owned(), 0.7)]);
            let model = ShownModel::read(&file, locked).expect("a model");
            let dynamics = &model.dynamics;
            let dofs = dynamics.dof_count();
            let q: Vec<f64> = (0..dofs)
                .map(|dof| match dynamics.dof_name(dof) {
                    "held" => 0.7,
                    _ => 0.3 - 0.17 * dof as f64,
                })
                .collect();
            let position = |name: &str| dynamics.dof(name).map_or(f64::NAN, |dof| q[dof]);
            let transforms = model.transforms(position);
            let root = dynamics.link_name(0);
            let poses = poses(&transforms, root);
            let mut kinematics = Kinematics::new(dynamics, 0).expect("kinematics");
            let zeros = vec![0.0; dofs];
            let state = JointState {
                position: &q,
                velocity: &zeros,
                acceleration: &zeros,
            };
            let still = FrameMotion::standing(&Vec3::zeros());
            kinematics.update(dynamics, state, &still).expect("a state");
            let links: Vec<&str> = dynamics.frame_names().collect();
            assert_eq!(links.len(), transforms.len() + 1, "one transform per joint");
            for name in links {
                let frame = dynamics.frame(name).expect("a link");
                let expected = *kinematics.pose(frame.link) * frame.pose;
                let pose = poses.get(name).expect("a pose");
                let apart = (pose.translation - expected.translation).norm();
                let turned = (pose.rotation - expected.rotation).norm();
                assert!(apart < 1e-12 && turned < 1e-12, "{name}: {apart} {turned}");
            }
        }
        std::fs::remove_dir_all(folder).expect("its own folder");
    }

    #[test]
    fn what_is_not_measured_is_left_out() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR"));
        let file = file.join("../../config/icub_left_arm/model.urdf");
        let model = ShownModel::read(&file, BTreeMap::new()).expect("a model");
        let children = |unknown: &str| {
            let transforms = model.transforms(|name| match name {
                name if name == unknown => f64::NAN,
                _ => 0.1,
            });
            transforms.iter().map(|it| it.child).collect::<Vec<_>>()
        };
        let all = children("");
        assert_eq!(all.len(), 10);
        let some: Vec<_> = all
            .iter()
            .copied()
            .filter(|it| *it != "l_forearm")
            .collect();
        assert_eq!(children("l_wrist_prosup"), some);
    }
}
