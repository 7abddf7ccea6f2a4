//! The robot: a tree of rigid bodies and joints, read from a URDF, with fixed joints folded and F/T
//! joints kept.
//!
//! The URDF of a real robot has hundreds of links; most of them are massless frames on fixed
//! joints. [`Model::from_urdf`] *folds* every fixed joint: links that move together become one
//! *body*, also if several of them have mass. Joints named in `keep` are not folded; these carry
//! F/T sensors, and the tree will be cut there. The result is a flat list in an order suited to the
//! dynamics:
//!
//! - body 0 holds the URDF's root link; the others follow depth first, so a body comes after its
//!   parent and the bodies of a limb are adjacent;
//! - body `b > 0` is moved by joint `b - 1`, its only joint towards the root. Its frame is that of
//!   the URDF link that this joint moves;
//! - degrees of freedom ("dofs") are numbered in the order in which the URDF lists the moving
//!   joints, which may differ from the order of the bodies. A joint with a `<mimic>` has none of
//!   its own. So the positions of the joints are a linear map of those of the dofs, and this map is
//!   in the joints alone: `q_j = ratio_j q_dof(j) + offset_j` ([`Joint::ratio`]). Velocities,
//!   torques (its transpose) and regressors follow.
//!
//! Every URDF link remains available: [`Model::frame`] finds any link by name, folded or not, and
//! returns its body and its pose in that body.
//!
//! The root only starts this numbering: any body can be the base of the kinematics
//! ([`crate::Kinematics`]).

mod rewrite;
mod urdf;
mod xml;

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;

use crate::spatial::{Mat3, Pose, RigidInertia, Vec3};

/// The axis of a joint: a unit vector in the axes of the child, which at position zero are also
/// those of the joint's placement, and its kind, which allows short cuts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointAxis {
    /// The unit vector.
    pub vector: Vec3,
    /// The coordinate axis that it is along, if any. Most joints have one, and rotation about it is
    /// cheaper.
    pub kind: AxisKind,
}

/// The coordinate axis that a joint axis is along, with its sign, 1 or -1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AxisKind {
    /// Along x.
    X(f64),
    /// Along y.
    Y(f64),
    /// Along z.
    Z(f64),
    /// In any other direction.
    Any,
}

impl JointAxis {
    /// The axis along `direction`, normalised; `None` if its length is zero or not finite.
    /// Components of the size of rounding errors are set to zero.
    pub fn new(direction: Vec3) -> Option<Self> {
        const ROUNDING: f64 = 1e-14;
        let norm = direction.norm();
        if !norm.is_finite() || norm < 1e-9 {
            return None;
        }
        // Generated URDFs have axes such as -2.2e-16 -0.9999999999999998 0 where y is meant.
        let cleaned = (direction / norm).map(|x| if x.abs() < ROUNDING { 0.0 } else { x });
        let vector = cleaned.normalize();
        let kind = match (vector.x, vector.y, vector.z) {
            (x, 0.0, 0.0) => AxisKind::X(x.signum()),
            (0.0, y, 0.0) => AxisKind::Y(y.signum()),
            (0.0, 0.0, z) => AxisKind::Z(z.signum()),
            _ => AxisKind::Any,
        };
        Some(Self { vector, kind })
    }

    /// `r * Rot(axis, angle)`: `r` rotated about this axis, given in the rotated axes, by an angle
    /// of this sine and cosine.
    #[inline(always)]
    fn turn_by(&self, r: &Mat3, (sin, c): (f64, f64)) -> Mat3 {
        let columns = |i: usize| r.column(i).into_owned();
        match self.kind {
            AxisKind::X(sign) => {
                let (s, x, y, z) = (sign * sin, columns(0), columns(1), columns(2));
                Mat3::from_columns(&[x, y * c + z * s, z * c - y * s])
            }
            AxisKind::Y(sign) => {
                let (s, x, y, z) = (sign * sin, columns(0), columns(1), columns(2));
                Mat3::from_columns(&[x * c - z * s, y, z * c + x * s])
            }
            AxisKind::Z(sign) => {
                let (s, x, y, z) = (sign * sin, columns(0), columns(1), columns(2));
                Mat3::from_columns(&[x * c + y * s, y * c - x * s, z])
            }
            AxisKind::Any => {
                // Rodrigues: c 1 + s [a]x + (1 - c) a a^T.
                let (a, v) = (&self.vector, self.vector * (1.0 - c));
                let w = self.vector * sin;
                #[rustfmt::skip]
                let turn = Mat3::new(
                    v.x * a.x + c,   v.x * a.y - w.z, v.x * a.z + w.y,
                    v.y * a.x + w.z, v.y * a.y + c,   v.y * a.z - w.x,
                    v.z * a.x - w.y, v.z * a.y + w.x, v.z * a.z + c,
                );
                r * turn
            }
        }
    }
}

/// The motion that a joint allows its child.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum JointKind {
    /// Rotation about the axis: the URDF's `revolute` and `continuous`.
    Revolute(JointAxis),
    /// Translation along the axis.
    Prismatic(JointAxis),
    /// None: a joint that was kept because it carries an F/T sensor.
    Fixed,
}

/// A joint between two bodies; joint `j` moves body `j + 1`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Joint {
    /// The motion that it allows, and its axis in the axes of the child.
    pub kind: JointKind,
    /// The body nearer to the URDF's root.
    pub parent: usize,
    /// The other body.
    pub child: usize,
    /// Pose of the child in the parent with the joint at zero, `x_pc(0)`.
    pub placement: Pose,
    /// Number of its degree of freedom, unless it is fixed.
    pub dof: Option<usize>,
    /// Its position is `ratio q + offset` and its rate `ratio dq`, where `q` is the position of its
    /// degree of freedom: 1 and 0, except for a joint that follows another one (`<mimic>`).
    pub ratio: f64,
    /// See [`Joint::ratio`] [rad or m].
    pub offset: f64,
}

impl Joint {
    /// Pose of the child in the parent, `x_pc(q)`, with the joint at `q` [rad or m]; `q` is ignored
    /// for a fixed joint.
    pub fn pose(&self, q: f64) -> Pose {
        self.kind.place(&self.placement, q, q.sin_cos())
    }
}

impl JointKind {
    /// Pose of the child in the parent with the joint at `q` [rad or m], whose sine and cosine are
    /// given; `placement` is that with the joint at zero.
    #[inline(always)]
    pub(crate) fn place(&self, placement: &Pose, q: f64, sin_cos: (f64, f64)) -> Pose {
        let Pose {
            rotation,
            translation,
        } = placement;
        match self {
            Self::Revolute(axis) => Pose {
                rotation: axis.turn_by(rotation, sin_cos),
                translation: *translation,
            },
            Self::Prismatic(axis) => Pose {
                rotation: *rotation,
                translation: translation + rotation * axis.vector * q,
            },
            Self::Fixed => *placement,
        }
    }
}

/// Range of a joint as the URDF gives it [rad or m].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Least position.
    pub lower: f64,
    /// Greatest position.
    pub upper: f64,
}

impl Limits {
    /// The position in the middle.
    pub fn middle(&self) -> f64 {
        0.5 * (self.lower + self.upper)
    }

    /// The distance from the middle to either end.
    pub fn half(&self) -> f64 {
        0.5 * (self.upper - self.lower)
    }
}

/// A frame fixed to a body: a URDF link, folded or not.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// The body.
    pub link: usize,
    /// Pose of the frame in the body, `x_lf`.
    pub pose: Pose,
}

/// A principal moment below the mass times this [m^2] is zero: it is that of the mass 0.03 mm away,
/// and lengths of a URDF are given to 0.1 mm at best.
pub const POINT: f64 = 1e-9;

/// Data of a joint that the loops do not need.
#[derive(Clone, Debug, PartialEq)]
struct JointFacts {
    name: String,
    parent_link: String,
    child_link: String,
    limits: Option<Limits>,
    effort: Option<f64>,
    velocity: Option<f64>,
    /// The joint that it follows, multiplier and offset.
    mimic: Option<(String, f64, f64)>,
}

/// The frame in which an F/T sensor measures: its axes, and the origin as the point of its torque.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MeasurementFrame {
    /// The frame of the joint's child link.
    Child,
    /// The frame of the joint's parent link.
    Parent,
    /// A frame of its own, given by its pose in the child link.
    Sensor,
}

/// Which of the two opposite wrenches an F/T sensor reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MeasurementDirection {
    /// The wrench that the child exerts on the parent.
    ChildToParent,
    /// The wrench that the parent exerts on the child.
    ParentToChild,
}

/// An F/T sensor as a URDF describes it: iDynTree's `<sensor>` element, or Gazebo's inside
/// `<gazebo reference="joint">`.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorElement {
    /// Its name.
    pub name: String,
    /// The joint it sits in.
    pub joint: String,
    /// The frame it measures in (child, if the URDF does not give it).
    pub frame: MeasurementFrame,
    /// The wrench it reports (child to parent, if the URDF does not give it).
    pub direction: MeasurementDirection,
    /// Its pose in the joint's child link, `x_cs`: the identity if the URDF does not give it. Used
    /// with [`MeasurementFrame::Sensor`] only.
    pub pose: Pose,
}

/// The robot after folding: bodies, joints, frames by name.
///
/// "Link" in the names of this interface means a body: the URDF links that move together as one.
#[derive(Clone, Debug)]
pub struct Model {
    name: String,
    // Parallel arrays: the data that the loops read are adjacent, names are separate.
    inertias: Vec<RigidInertia>,
    joints: Vec<Joint>,
    dofs: Vec<usize>,
    link_names: Vec<String>,
    joint_facts: Vec<JointFacts>,
    joint_numbers: HashMap<String, usize>,
    /// Per fixed joint that was folded, its parent and child links.
    folded_joints: HashMap<String, (String, String)>,
    /// Per joint that follows a fixed one, that one.
    held: HashMap<String, String>,
    frames: HashMap<String, Frame>,
    /// Links and joints above a joint that lets the whole robot float, and that joint.
    dropped: HashSet<String>,
    sensors: Vec<SensorElement>,
    unread: Vec<Unread>,
    warnings: Vec<String>,
}

/// An F/T sensor element that cannot be understood.
#[derive(Clone, Debug)]
struct Unread {
    /// Its joint; empty if it names none.
    joint: String,
    /// Its line, its name, and what is wrong.
    why: String,
}

impl Model {
    /// The robot's name in the URDF.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of bodies.
    pub fn link_count(&self) -> usize {
        self.inertias.len()
    }

    /// Number of joints left after folding: one less than the bodies.
    pub fn joint_count(&self) -> usize {
        self.joints.len()
    }

    /// Number of degrees of freedom: the moving joints, without those that follow another one.
    pub fn dof_count(&self) -> usize {
        self.dofs.len()
    }

    /// Name of a body: that of the URDF link whose frame it has. Empty if there is no such body.
    pub fn link_name(&self, link: usize) -> &str {
        self.link_names.get(link).map_or("", String::as_str)
    }

    /// All joints; joint `j` moves body `j + 1`.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Name of a joint. Empty if there is no such joint.
    pub fn joint_name(&self, joint: usize) -> &str {
        self.joint_facts
            .get(joint)
            .map_or("", |facts| facts.name.as_str())
    }

    /// The parent and child links of a joint in the URDF (either may have been folded into a larger
    /// body).
    pub fn joint_links(&self, joint: usize) -> Option<(&str, &str)> {
        self.joint_facts
            .get(joint)
            .map(|facts| (facts.parent_link.as_str(), facts.child_link.as_str()))
    }

    /// Index of the fixed joint where an F/T sensor in the joint of this name cuts the tree. If the
    /// joint moves, this one is on the side of its child, behind a body without mass.
    pub fn cut(&self, name: &str) -> Option<usize> {
        let number = self.joint(name)?;
        (number..self.joints.len().min(number + 2)).find(|&joint| {
            self.joints[joint].kind == JointKind::Fixed && self.joint_name(joint) == name
        })
    }

    /// Index of the joint of this name, if it is in the URDF and was not folded.
    pub fn joint(&self, name: &str) -> Option<usize> {
        self.joint_numbers.get(name).copied()
    }

    /// Whether the URDF has a fixed joint of this name that was folded.
    pub fn is_folded(&self, joint: &str) -> bool {
        self.folded_joints.contains_key(joint)
    }

    /// Each fixed joint that was folded, with its parent and child links, in no particular order.
    pub fn folded_joints(&self) -> impl Iterator<Item = (&str, [&str; 2])> {
        let joints = self.folded_joints.iter();
        joints.map(|(joint, (parent, child))| (joint.as_str(), [parent.as_str(), child.as_str()]))
    }

    /// Whether a link or joint of this name was dropped, because it is the joint that lets the
    /// whole robot float or is above that. The root link, body 0, is below.
    pub fn is_dropped(&self, name: &str) -> bool {
        self.dropped.contains(name)
    }

    /// The fixed joint that holds a joint, which follows it (its `<mimic>`, if necessary through
    /// others).
    pub fn held_by(&self, joint: &str) -> Option<&str> {
        self.held.get(joint).map(String::as_str)
    }

    /// Index of the degree of freedom of the moving joint of this name; none if the joint follows
    /// another one.
    pub fn dof(&self, joint: &str) -> Option<usize> {
        let number = self.joint(joint)?;
        let dof = self.joints.get(number)?.dof?;
        (self.dof_joint(dof) == Some(number)).then_some(dof)
    }

    /// The joint that a joint follows (its `<mimic>`, if necessary through others).
    pub fn follows(&self, joint: &str) -> Option<&str> {
        let dof = self.joints.get(self.joint(joint)?)?.dof?;
        let leader = self.dof_name(dof);
        (leader != joint).then_some(leader)
    }

    /// Holds a joint that follows another one at a position [rad or m] of its own, and so those
    /// that follow it. False if there is no such joint.
    pub fn hold(&mut self, joint: &str, position: f64) -> bool {
        let follower = self.follows(joint).and_then(|_| self.joint(joint));
        let Some(held) = follower else {
            return false;
        };
        (self.joints[held].ratio, self.joints[held].offset) = (0.0, position);
        self.joint_facts[held].mimic = None;
        let mut leaders = vec![held];
        while let Some(leader) = leaders.pop() {
            let name = self.joint_facts[leader].name.clone();
            let (of_leader, at) = (self.joints[leader].ratio, self.joints[leader].offset);
            for (number, joint) in self.joints.iter_mut().enumerate() {
                match &self.joint_facts[number].mimic {
                    Some((leads, ratio, offset)) if *leads == name && joint.dof.is_some() => {
                        (joint.ratio, joint.offset) = (ratio * of_leader, ratio * at + offset);
                        leaders.push(number);
                    }
                    _ => {}
                }
            }
        }
        true
    }

    /// The joint that a degree of freedom is named after. Others may follow it.
    pub fn dof_joint(&self, dof: usize) -> Option<usize> {
        self.dofs.get(dof).copied()
    }

    /// Whether the joint that a degree of freedom is named after is prismatic: its torque is a
    /// force \[N\].
    pub fn is_prismatic(&self, dof: usize) -> bool {
        let joint = self.dof_joint(dof).and_then(|joint| self.joints.get(joint));
        joint.is_some_and(|joint| matches!(joint.kind, JointKind::Prismatic(_)))
    }

    /// Name of the joint that has this degree of freedom. Empty if there is no such dof.
    pub fn dof_name(&self, dof: usize) -> &str {
        self.dof_joint(dof)
            .map_or("", |joint| self.joint_name(joint))
    }

    /// The position range of a joint in the URDF; `None` for continuous and fixed joints.
    pub fn limits(&self, joint: usize) -> Option<Limits> {
        self.joint_facts.get(joint).and_then(|facts| facts.limits)
    }

    /// The effort limit of a joint in the URDF [Nm or N]; `None` if it is missing or zero.
    pub fn effort(&self, joint: usize) -> Option<f64> {
        self.joint_facts.get(joint).and_then(|facts| facts.effort)
    }

    /// The velocity limit of a joint in the URDF [rad/s or m/s]; `None` if it is missing or zero.
    pub fn velocity(&self, joint: usize) -> Option<f64> {
        self.joint_facts.get(joint).and_then(|facts| facts.velocity)
    }

    /// The inertia of every body, about the origin and in the axes of its frame.
    pub fn inertias(&self) -> &[RigidInertia] {
        &self.inertias
    }

    /// Replaces the inertia of a body (identified parameters). Physical consistency is not checked
    /// here; [`RigidInertia::check`] does that.
    ///
    /// # Errors
    /// There is no such body, or a number is not finite. Nothing is changed in that case.
    pub fn set_inertia(&mut self, link: usize, inertia: RigidInertia) -> Result<(), ModelError> {
        if link >= self.inertias.len() {
            return Err(ModelError::NoLink(link));
        }
        if !inertia.is_finite() {
            return Err(ModelError::InertiaNotFinite {
                link: self.link_name(link).to_owned(),
            });
        }
        self.inertias[link] = inertia;
        Ok(())
    }

    /// The body of the URDF link of this name and its pose in that body, whether or not it was
    /// folded.
    pub fn frame(&self, name: &str) -> Option<Frame> {
        self.frames.get(name).copied()
    }

    /// Names of all URDF links, in no particular order.
    pub fn frame_names(&self) -> impl Iterator<Item = &str> {
        self.frames.keys().map(String::as_str)
    }

    /// What is wrong with an F/T sensor element of this joint.
    pub fn unread_sensor(&self, joint: &str) -> Option<&str> {
        let mut unread = self.unread.iter();
        Some(&unread.find(|unread| unread.joint == joint)?.why)
    }

    /// The F/T sensors that the URDF describes; one entry for a sensor described twice.
    pub fn sensors(&self) -> &[SensorElement] {
        &self.sensors
    }

    /// Oddities of the URDF that are not errors, one sentence each.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }
}

/// Why a URDF, or a change of the model made from it, is refused. Messages say what to do.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ModelError {
    /// The file cannot be read.
    #[error("cannot read {}: {reason}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error message.
        reason: String,
    },
    /// Not XML.
    #[error("the URDF is not XML: line {line}: {reason}")]
    Syntax {
        /// Line of the URDF.
        line: usize,
        /// What is wrong there.
        reason: String,
    },
    /// XML, but not a URDF.
    #[error("not a URDF: its root element is <{root}>, not <robot>{}", advice(.root))]
    NotUrdf {
        /// The root element.
        root: String,
    },
    /// No `<link>` at all.
    #[error("the URDF has no link: nothing in its <robot> is a <link>")]
    NoLinks,
    /// An element that is missing, wrong or of no use: `line 8: joint turn: ` and what to do.
    #[error("{0}")]
    Defect(String),
    /// More than one link has no parent.
    #[error(
        "links {} have no parent; a robot has one root: connect the others to it by joints, or \
         remove them",
        .0.join(", ")
    )]
    SeveralRoots(Vec<String>),
    /// A joint to be kept that the URDF does not have.
    #[error(
        "joint {joint}, named as the joint of an F/T sensor, is not in the URDF; any of its \
         joints could carry one, fixed or moving (it is then on the child's side): {}",
        or_none(.some)
    )]
    UnknownSensorJoint {
        /// The joint.
        joint: String,
        /// Joints of the URDF with an F/T `<sensor>` element; if there are none, the first ten,
        /// fixed ones before others.
        some: Vec<String>,
    },
    /// There is no body with this index.
    #[error("there is no link {0}")]
    NoLink(usize),
    /// The number of inertias differs from the number of bodies.
    #[error("{given} inertias given for {needed} links")]
    InertiaCount {
        /// How many were given.
        given: usize,
        /// How many are needed.
        needed: usize,
    },
    /// An inertia with NaN or infinity, for a body of the model.
    #[error("link {link}: the inertia given for it is not finite")]
    InertiaNotFinite {
        /// The link.
        link: String,
    },
}

fn or_none(names: &[String]) -> String {
    if names.is_empty() {
        "none".to_owned()
    } else {
        names.join(", ")
    }
}

/// What to do with a file of another kind.
fn advice(root: &str) -> &'static str {
    match root {
        "sdf" => "; convert it, for example with gz sdf or sdformat_urdf",
        "mujoco" => "; export a URDF of the same robot",
        _ => "",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every axis kind against the same rotation computed by nalgebra.
    #[test]
    fn turning_about_a_coordinate_axis_is_turning_about_any() {
        use nalgebra::{Rotation3, Unit};
        let r = Pose::from_xyz_rpy([0.0; 3], [0.3, -0.4, 1.9]).rotation;
        for direction in [
            [1.0, 0.0, 0.0],
            [-2.0, 0.0, 0.0],
            [0.0, 3.0, 0.0],
            [0.0, -1.0, 0.0],
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
            [0.2, -0.5, 0.9],
        ] {
            let axis = JointAxis::new(Vec3::from(direction)).expect("not zero");
            let expected =
                r * Rotation3::from_axis_angle(&Unit::new_normalize(Vec3::from(direction)), 0.7)
                    .matrix();
            assert!(
                (axis.turn_by(&r, 0.7_f64.sin_cos()) - expected).amax() < 1e-15,
                "{direction:?}"
            );
        }
        let almost =
            JointAxis::new(Vec3::new(-2.2e-16, -0.999_999_999_999_999_8, 0.0)).expect("not zero");
        assert_eq!(
            (almost.vector, almost.kind),
            (-Vec3::y(), AxisKind::Y(-1.0))
        );
        let oblique = JointAxis::new(Vec3::new(1e-12, 1.0, 0.0)).expect("not zero");
        assert_eq!(oblique.kind, AxisKind::Any);
        assert_eq!(JointAxis::new(Vec3::zeros()), None);
        assert_eq!(JointAxis::new(Vec3::new(f64::NAN, 0.0, 0.0)), None);
    }
}
