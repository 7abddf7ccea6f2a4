//! The kinematic pass from any base, and inverse dynamics with known external wrenches.

use super::{DynamicsError, check_size};
use crate::model::{Frame, Joint, JointKind, Model};
use crate::spatial::{Motion, Pose, Vec3, Wrench};

/// How a frame moves: what an ideal IMU at its origin and along its axes would measure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameMotion {
    /// Angular velocity [rad/s].
    pub angular_velocity: Vec3,
    /// Angular acceleration [rad/s^2].
    pub angular_acceleration: Vec3,
    /// Classical acceleration of the origin minus gravity [m/s^2].
    pub proper_acceleration: Vec3,
}

impl FrameMotion {
    /// A frame that stands still, where physical gravity is `gravity` in its axes [m/s^2]: its proper acceleration is `-gravity`.
    pub fn standing(gravity: &Vec3) -> Self {
        Self {
            angular_velocity: Vec3::zeros(),
            angular_acceleration: Vec3::zeros(),
            proper_acceleration: -gravity,
        }
    }

    /// Motion of a frame `b` fixed to this one, `a`, at `x_ab`: `a_b = R^T (a_a + alpha x t + omega x (omega x t))`, the rest only turned.
    pub fn at(&self, x_ab: &Pose) -> Self {
        let (omega, alpha, t) = (&self.angular_velocity, &self.angular_acceleration, &x_ab.translation);
        let a = self.proper_acceleration + alpha.cross(t) + omega.cross(&omega.cross(t));
        Self {
            angular_velocity: x_ab.rotation.tr_mul(omega),
            angular_acceleration: x_ab.rotation.tr_mul(alpha),
            proper_acceleration: x_ab.rotation.tr_mul(&a),
        }
    }

    /// Motion of the link that carries an IMU, from what the IMU measures and its pose in the link, `x_li` (the lever arm).
    pub fn of_link_from_imu(measured: &Self, x_li: &Pose) -> Self {
        measured.at(&x_li.inverse())
    }

    fn is_finite(&self) -> bool {
        let finite = |v: &Vec3| v.iter().all(|x| x.is_finite());
        finite(&self.angular_velocity) && finite(&self.angular_acceleration) && finite(&self.proper_acceleration)
    }
}

/// Positions [rad or m], velocities and accelerations of all joints, by number of degree of freedom. A locked joint has its position and zeros.
#[derive(Clone, Copy, Debug)]
pub struct JointState<'a> {
    /// Positions.
    pub position: &'a [f64],
    /// Velocities.
    pub velocity: &'a [f64],
    /// Accelerations.
    pub acceleration: &'a [f64],
}

/// State of one link.
#[derive(Clone, Copy, Debug)]
struct LinkState {
    /// Pose in the base, `x_bl`.
    pose: Pose,
    /// Motion, in link axes, of the link's origin.
    motion: FrameMotion,
}

/// One crossing of a joint, from a link whose state is known to its neighbour.
#[derive(Clone, Copy, Debug)]
struct Step {
    from: usize,
    to: usize,
    joint: usize,
    /// From the child to the parent.
    reversed: bool,
}

/// Pose, motion and net wrench of every link, from the motion of one of them.
#[derive(Clone, Debug)]
pub struct Kinematics {
    base: usize,
    /// First the way from the base up to the model's root, reversed; then every other link in the model's order.
    steps: Vec<Step>,
    /// Whether joint `j` is crossed from child to parent: the base lies beyond it.
    reversed: Vec<bool>,
    links: Vec<LinkState>,
    /// Net wrench of each link in base coordinates.
    net: Vec<Wrench>,
}

impl Kinematics {
    /// For a model, starting at link `base`.
    ///
    /// # Errors
    /// There is no such link.
    pub fn new(model: &Model, base: usize) -> Result<Self, DynamicsError> {
        let count = model.link_count();
        let rest = FrameMotion::standing(&Vec3::zeros());
        let mut kinematics = Self {
            base: 0,
            steps: Vec::with_capacity(model.joint_count()),
            reversed: vec![false; model.joint_count()],
            links: vec![
                LinkState {
                    pose: Pose::identity(),
                    motion: rest
                };
                count
            ],
            net: vec![Wrench::zero(); count],
        };
        kinematics.set_base(model, base)?;
        Ok(kinematics)
    }

    /// Starts at another link from the next update on. Does not allocate.
    ///
    /// # Errors
    /// There is no such link, or the model is another one than at construction.
    pub fn set_base(&mut self, model: &Model, base: usize) -> Result<(), DynamicsError> {
        check_size("links of the model", model.link_count(), self.links.len())?;
        if base >= self.links.len() {
            return Err(DynamicsError::NoLink(base));
        }
        self.base = base;
        self.steps.clear();
        self.reversed.fill(false);
        // Joint j moves link j + 1.
        let mut link = base;
        while link > 0 {
            let joint = link - 1;
            let parent = model.joints()[joint].parent;
            self.steps.push(Step {
                from: link,
                to: parent,
                joint,
                reversed: true,
            });
            self.reversed[joint] = true;
            link = parent;
        }
        for (number, joint) in model.joints().iter().enumerate() {
            if !self.reversed[number] {
                self.steps.push(Step {
                    from: joint.parent,
                    to: joint.child,
                    joint: number,
                    reversed: false,
                });
            }
        }
        Ok(())
    }

    /// The link where the pass starts, whose frame is that of base coordinates.
    pub fn base(&self) -> usize {
        self.base
    }

    /// Computes everything from the joints' state and the motion of the base link's frame.
    ///
    /// Per joint from parent `p` to child `c`, with `(R, t)` the pose of `c` in `p` and `s` the axis in `c` (all in `c`'s axes but the bracket):
    ///
    /// ```text
    /// omega_c = R^T omega_p + s dq
    /// alpha_c = R^T alpha_p + s ddq + R^T omega_p x s dq                              (revolute)
    /// a_c     = R^T [a_p + alpha_p x t + omega_p x (omega_p x t)]
    ///           + s ddq + 2 R^T omega_p x s dq                                        (last line: prismatic, whose omega and alpha are only turned)
    /// ```
    ///
    /// and solved for `p` where a joint is crossed the other way.
    ///
    /// # Errors
    /// Sizes do not fit the model, or a number is not finite. Nothing is changed then.
    pub fn update(&mut self, model: &Model, state: JointState<'_>, base: &FrameMotion) -> Result<(), DynamicsError> {
        check_size("links of the model", model.link_count(), self.links.len())?;
        for (what, values) in [
            ("joint positions", state.position),
            ("joint velocities", state.velocity),
            ("joint accelerations", state.acceleration),
        ] {
            check_size(what, values.len(), model.dof_count())?;
            if let Some(index) = values.iter().position(|x| !x.is_finite()) {
                return Err(DynamicsError::NotFinite { what, index });
            }
        }
        if !base.is_finite() {
            return Err(DynamicsError::NotFinite {
                what: "motion of base link",
                index: self.base,
            });
        }
        self.links[self.base] = LinkState {
            pose: Pose::identity(),
            motion: *base,
        };
        for step in &self.steps {
            let joint = &model.joints()[step.joint];
            let (q, dq, ddq) = joint.dof.map_or((0.0, 0.0, 0.0), |dof| {
                (state.position[dof], state.velocity[dof], state.acceleration[dof])
            });
            let from = &self.links[step.from];
            let to = if step.reversed {
                down_to_parent(from, joint, q, dq, ddq)
            } else {
                up_to_child(from, joint, q, dq, ddq)
            };
            self.links[step.to] = to;
        }
        for ((net, link), inertia) in self.net.iter_mut().zip(&self.links).zip(model.inertias()) {
            let motion = &link.motion;
            let in_link = inertia.net_wrench(
                &motion.angular_velocity,
                &motion.angular_acceleration,
                &motion.proper_acceleration,
            );
            *net = link.pose.wrench(&in_link);
        }
        Ok(())
    }

    /// Number of links.
    pub fn link_count(&self) -> usize {
        self.links.len()
    }

    /// Pose of each link in the base, `x_bl`.
    ///
    /// # Panics
    /// There is no such link.
    #[inline]
    pub fn pose(&self, link: usize) -> &Pose {
        &self.links[link].pose
    }

    /// Motion of each link's frame, in its own axes.
    ///
    /// # Panics
    /// There is no such link.
    #[inline]
    pub fn motion(&self, link: usize) -> &FrameMotion {
        &self.links[link].motion
    }

    /// Motion of a frame fixed to a link, in its own axes: what an IMU there would measure.
    ///
    /// # Panics
    /// There is no such link.
    pub fn frame_motion(&self, frame: &Frame) -> FrameMotion {
        self.links[frame.link].motion.at(&frame.pose)
    }

    /// Net wrench of each link in base coordinates: the sum of everything that acts on it but gravity.
    pub fn net_wrenches(&self) -> &[Wrench] {
        &self.net
    }

    /// Whether a joint lies between the base and the model's root, so that it is crossed from child to parent.
    pub(super) fn is_reversed(&self, joint: usize) -> bool {
        self.reversed[joint]
    }

    /// The unit motion of the child of a joint relative to its parent, in base coordinates; none for a fixed joint.
    #[inline]
    pub(super) fn joint_axis(&self, joint: &Joint) -> Option<Motion> {
        let pose = &self.links[joint.child].pose;
        match &joint.kind {
            JointKind::Revolute(axis) => Some(Motion::rotation(&(pose.rotation * axis.vector), &pose.translation)),
            JointKind::Prismatic(axis) => Some(Motion::translation(&(pose.rotation * axis.vector))),
            JointKind::Fixed => None,
        }
    }
}

/// State of a joint's child from that of its parent.
#[inline]
fn up_to_child(parent: &LinkState, joint: &Joint, q: f64, dq: f64, ddq: f64) -> LinkState {
    let x_pc = joint.pose(q);
    let mut motion = parent.motion.at(&x_pc);
    // `motion` is that of the child if the joint stood still: its angular velocity is the parent's, in the child's axes.
    let omega = motion.angular_velocity;
    match &joint.kind {
        JointKind::Revolute(axis) => {
            let rate = axis.vector * dq;
            motion.angular_velocity += rate;
            motion.angular_acceleration += axis.vector * ddq + omega.cross(&rate);
        }
        JointKind::Prismatic(axis) => {
            motion.proper_acceleration += axis.vector * ddq + omega.cross(&axis.vector) * (2.0 * dq);
        }
        JointKind::Fixed => {}
    }
    LinkState {
        pose: parent.pose * x_pc,
        motion,
    }
}

/// State of a joint's parent from that of its child.
#[inline]
fn down_to_parent(child: &LinkState, joint: &Joint, q: f64, dq: f64, ddq: f64) -> LinkState {
    let x_cp = joint.pose(q).inverse();
    let mut motion = child.motion;
    // First what the child would do if the joint stood still, then the rigid transform.
    match &joint.kind {
        JointKind::Revolute(axis) => {
            let rate = axis.vector * dq;
            motion.angular_velocity -= rate;
            motion.angular_acceleration -= axis.vector * ddq + motion.angular_velocity.cross(&rate);
        }
        JointKind::Prismatic(axis) => {
            motion.proper_acceleration -= axis.vector * ddq + motion.angular_velocity.cross(&axis.vector) * (2.0 * dq);
        }
        JointKind::Fixed => {}
    }
    LinkState {
        pose: child.pose * x_cp,
        motion: motion.at(&x_cp),
    }
}

/// A known wrench by the environment on a link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExternalWrench {
    /// The frame at whose origin and in whose axes the wrench is given.
    pub frame: Frame,
    /// The wrench.
    pub wrench: Wrench,
}

impl ExternalWrench {
    /// The wrench in base coordinates.
    #[inline]
    pub(super) fn in_base(&self, kinematics: &Kinematics) -> Wrench {
        kinematics
            .pose(self.frame.link)
            .wrench(&self.frame.pose.wrench(&self.wrench))
    }
}

/// Torques, transmitted wrenches and the wrench at the base, when every other external wrench is known: the plain recursive Newton-Euler algorithm.
#[derive(Clone, Debug)]
pub struct InverseDynamics {
    /// Per link: what the joint above must transmit to it, in base coordinates.
    transmitted: Vec<Wrench>,
    torque: Vec<f64>,
    base_wrench: Wrench,
}

impl InverseDynamics {
    /// For a model.
    pub fn new(model: &Model) -> Self {
        Self {
            transmitted: vec![Wrench::zero(); model.link_count()],
            torque: vec![0.0; model.dof_count()],
            base_wrench: Wrench::zero(),
        }
    }

    /// Computes the joint torques, and the wrench that the environment must exert on the base link for the rest to hold, from the links' motion and
    /// the known external wrenches.
    ///
    /// # Errors
    /// The objects are made for another model, a frame's link does not exist, or a wrench is not finite.
    pub fn update(
        &mut self,
        model: &Model,
        kinematics: &Kinematics,
        external: &[ExternalWrench],
    ) -> Result<(), DynamicsError> {
        check_size(
            "links of the kinematics",
            kinematics.link_count(),
            self.transmitted.len(),
        )?;
        check_size("links of the model", model.link_count(), self.transmitted.len())?;
        check_size("degrees of freedom of the model", model.dof_count(), self.torque.len())?;
        check_external(external, self.transmitted.len())?;
        self.transmitted.copy_from_slice(kinematics.net_wrenches());
        for wrench in external {
            self.transmitted[wrench.frame.link] -= wrench.in_base(kinematics);
        }
        for joint in model.joints().iter().rev() {
            let wrench = self.transmitted[joint.child];
            self.transmitted[joint.parent] += wrench;
        }
        self.base_wrench = self.transmitted[0];
        for (number, joint) in model.joints().iter().enumerate() {
            if kinematics.is_reversed(number) {
                // The base hangs below this joint, and with it the wrench on the base.
                let wrench = self.base_wrench;
                self.transmitted[joint.child] -= wrench;
            }
            if let (Some(dof), Some(axis)) = (joint.dof, kinematics.joint_axis(joint)) {
                self.torque[dof] = axis.dot(&self.transmitted[joint.child]);
            }
        }
        Ok(())
    }

    /// Joint torques [Nm or N], by degree of freedom: along the URDF axis, by the parent on the child.
    pub fn torque(&self) -> &[f64] {
        &self.torque
    }

    /// The wrench by the environment on the base link, at its origin and in its axes.
    pub fn base_wrench(&self) -> Wrench {
        self.base_wrench
    }

    /// The wrench that a joint's parent exerts on its child, at the origin and in the axes of the child; see [`super::SensorCut::reading`].
    ///
    /// # Panics
    /// There is no such joint.
    pub fn transmitted(&self, kinematics: &Kinematics, joint: usize) -> Wrench {
        let child = joint + 1;
        kinematics.pose(child).wrench_back(&self.transmitted[child])
    }
}

/// Checks known external wrenches before they are used.
pub(super) fn check_external(external: &[ExternalWrench], links: usize) -> Result<(), DynamicsError> {
    for (index, wrench) in external.iter().enumerate() {
        if wrench.frame.link >= links {
            return Err(DynamicsError::NoLink(wrench.frame.link));
        }
        if !wrench.wrench.is_finite() {
            return Err(DynamicsError::NotFinite {
                what: "external wrench",
                index,
            });
        }
    }
    Ok(())
}
