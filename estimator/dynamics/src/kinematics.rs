//! The kinematic pass from any base, and inverse dynamics with known external wrenches.
//!
//! Link states are in one array in the order of the model: parents first, limbs contiguous. The
//! pass works in link axes, where inertia is constant, and ends with the net wrench of each link in
//! *base coordinates*. After that nothing is transformed: the wrenches of sub-trees, F/T sensors
//! and contacts are about one point and in one set of axes, so they are accumulated by addition,
//! and no sub-tree needs its own root. This is how the reordered recursion (towards the contact
//! link) is implemented.
//!
//! Quantities that depend on no other link are computed before the pass: sines and cosines four at
//! a time, and the pose of each joint, with short cuts for axes along x, y or z. This keeps the
//! chain of dependent operations along the tree short.
//!
//! Tried and rejected: the recursion in base axes (slower), visiting the tree breadth first (no
//! gain), two links in one vector register for the net wrenches (no gain: gathering costs what it
//! saves), link-time optimisation (no gain), one code-generation unit (slower).

use wide::f64x4;

use crate::error::{DynamicsError, check_size, check_sizes};
use crate::model::{Frame, Joint, JointAxis, JointKind, Model};
use crate::spatial::{Motion, Pose, Vec3, Wrench};

/// Angles beyond this [rad] are computed by the standard library: their reduction to one turn needs
/// more digits.
const MANY_TURNS: f64 = 1e5;

/// Motion of a frame: what an ideal IMU at its origin and along its axes would measure.
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
    /// A frame at rest, with physical gravity `gravity` in its axes [m/s^2]: its proper
    /// acceleration is `-gravity`.
    pub fn standing(gravity: &Vec3) -> Self {
        Self {
            angular_velocity: Vec3::zeros(),
            angular_acceleration: Vec3::zeros(),
            proper_acceleration: -gravity,
        }
    }

    /// Motion of a frame `b` fixed to this one, `a`, at `x_ab`:
    /// `a_b = R^T (a_a + alpha x t + omega x (omega x t))`, the other vectors are only rotated.
    #[inline(always)]
    pub fn at(&self, x_ab: &Pose) -> Self {
        let (omega, alpha, t) = (
            &self.angular_velocity,
            &self.angular_acceleration,
            &x_ab.translation,
        );
        let a = self.proper_acceleration + alpha.cross(t) + omega.cross(&omega.cross(t));
        Self {
            angular_velocity: x_ab.rotation.tr_mul(omega),
            angular_acceleration: x_ab.rotation.tr_mul(alpha),
            proper_acceleration: x_ab.rotation.tr_mul(&a),
        }
    }

    /// Motion of the link that carries an IMU, from what the IMU measures and its pose in the link,
    /// `x_li` (the lever arm).
    pub fn of_link_from_imu(measured: &Self, x_li: &Pose) -> Self {
        measured.at(&x_li.inverse())
    }

    fn is_finite(&self) -> bool {
        let finite = |v: &Vec3| v.iter().all(|x| x.is_finite());
        finite(&self.angular_velocity)
            && finite(&self.angular_acceleration)
            && finite(&self.proper_acceleration)
    }
}

/// Positions [rad or m], velocities and accelerations of all joints, by degree of freedom. A locked
/// joint has its position, and zero velocity and acceleration; one that follows another one
/// ([`Joint::ratio`]) has none.
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
struct LinkKinematics {
    /// Pose in the base, `x_bl`.
    pose: Pose,
    /// Motion of the link's frame, in link axes.
    motion: FrameMotion,
}

/// Pose, motion and net wrench of every link, from the motion of one of them.
#[derive(Clone, Debug)]
pub struct Kinematics {
    base: usize,
    /// The joints in the order of the pass: first those from the base to the model's root, crossed
    /// from child to parent; then every other one in the model's order.
    steps: Vec<usize>,
    /// Whether joint `j` is crossed from child to parent: the base lies beyond it.
    reversed: Vec<bool>,
    /// Position of each joint, and its sine and cosine; zero for a fixed one.
    positions: Vec<f64>,
    sines: Vec<(f64, f64)>,
    dofs: usize,
    /// Pose of each joint's child in its parent, `x_pc`.
    local: Vec<Pose>,
    links: Vec<LinkKinematics>,
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
            positions: vec![0.0; model.joint_count()],
            sines: vec![(0.0, 1.0); model.joint_count()],
            dofs: model.dof_count(),
            local: vec![Pose::identity(); model.joint_count()],
            links: vec![
                LinkKinematics {
                    pose: Pose::identity(),
                    motion: rest
                };
                count
            ],
            net: vec![Wrench::zero(); count],
        };
        kinematics.root_at(model, base)?;
        Ok(kinematics)
    }

    /// Changes the base, and expresses the computed poses and wrenches in its coordinates. If the
    /// base is this link already, nothing is changed. Does not allocate.
    ///
    /// # Errors
    /// There is no such link, or the size of the model differs from that at construction. Nothing
    /// is changed in that case.
    pub fn set_base(&mut self, model: &Model, base: usize) -> Result<(), DynamicsError> {
        self.check_model(model)?;
        if base == self.base {
            return Ok(());
        }
        self.root_at(model, base)
    }

    /// Orders the pass to begin at `base`.
    fn root_at(&mut self, model: &Model, base: usize) -> Result<(), DynamicsError> {
        let Some(x_ba) = self.links.get(base).map(|link| link.pose.inverse()) else {
            return Err(DynamicsError::NoLink(base));
        };
        for (link, net) in self.links.iter_mut().zip(&mut self.net) {
            link.pose = x_ba * link.pose;
            *net = x_ba.wrench(net);
        }
        self.links[base].pose = Pose::identity();
        self.base = base;
        self.steps.clear();
        self.reversed.fill(false);
        // Joint j moves link j + 1.
        let mut link = base;
        while link > 0 {
            self.steps.push(link - 1);
            self.reversed[link - 1] = true;
            link = model.joints()[link - 1].parent;
        }
        let reversed = &self.reversed;
        let others = (0..reversed.len()).filter(|&joint| !reversed[joint]);
        self.steps.extend(others);
        Ok(())
    }

    fn check_model(&self, model: &Model) -> Result<(), DynamicsError> {
        check_sizes([
            ("links of the model", model.link_count(), self.links.len()),
            (
                "degrees of freedom of the model",
                model.dof_count(),
                self.dofs,
            ),
        ])
    }

    /// The link where the pass starts, whose frame is that of base coordinates.
    pub fn base(&self) -> usize {
        self.base
    }

    /// Computes everything from the joints' state and the motion of the base link's frame.
    ///
    /// Per joint from parent `p` to child `c`, with `(R, t)` the pose of `c` in `p` and `s` the
    /// axis in `c` (all in the axes of `c`, except the bracket, which is in those of `p`):
    ///
    /// ```text
    /// omega_c = R^T omega_p + s dq
    /// alpha_c = R^T alpha_p + s ddq + R^T omega_p x s dq
    /// a_c     = R^T [a_p + alpha_p x t + omega_p x (omega_p x t)]
    ///           + s ddq + 2 R^T omega_p x s dq
    /// ```
    ///
    /// The terms with `s` in the first two lines are for revolute joints. Those in the last line
    /// are for prismatic joints, where `omega` and `alpha` are only rotated. The equations are
    /// solved for `p` where a joint is crossed from child to parent.
    ///
    /// # Errors
    /// Sizes do not fit the model, or a number is not finite. Nothing is changed in that case.
    pub fn update(
        &mut self,
        model: &Model,
        state: JointState<'_>,
        base: &FrameMotion,
    ) -> Result<(), DynamicsError> {
        self.check_model(model)?;
        for (what, values) in [
            ("joint positions", state.position),
            ("joint velocities", state.velocity),
            ("joint accelerations", state.acceleration),
        ] {
            check_size(what, values.len(), model.dof_count())?;
            if let Some(index) = first_not_finite(values) {
                return Err(DynamicsError::NotFinite { what, index });
            }
        }
        if !base.is_finite() {
            return Err(DynamicsError::NotFinite {
                what: "motion of base link",
                index: self.base,
            });
        }
        self.links[self.base] = LinkKinematics {
            pose: Pose::identity(),
            motion: *base,
        };
        // Quantities that do not depend on the previous links come first: this keeps the dependency
        // chain along the tree short.
        for (q, joint) in self.positions.iter_mut().zip(model.joints()) {
            *q = joint
                .dof
                .map_or(0.0, |dof| joint.ratio * state.position[dof] + joint.offset);
        }
        sin_cos(&self.positions, &mut self.sines);
        let positions = self.positions.iter().zip(&self.sines);
        for ((x_pc, joint), (q, sin_cos)) in
            self.local.iter_mut().zip(model.joints()).zip(positions)
        {
            *x_pc = joint.kind.place(&joint.placement, *q, *sin_cos);
        }
        for &number in &self.steps {
            let (joint, x_pc) = (&model.joints()[number], &self.local[number]);
            let (parent, child) = (joint.parent, joint.child);
            let (dq, ddq) = joint.dof.map_or((0.0, 0.0), |dof| {
                let ratio = joint.ratio;
                (ratio * state.velocity[dof], ratio * state.acceleration[dof])
            });
            if self.reversed[number] {
                self.links[parent] = down_to_parent(&self.links[child], joint, x_pc, dq, ddq);
            } else {
                self.links[child].pose = self.links[parent].pose * *x_pc;
                self.links[child].motion =
                    up_to_child(&self.links[parent].motion, joint, x_pc, dq, ddq);
            }
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

    /// Pose in the base of a frame fixed to a link.
    ///
    /// # Panics
    /// There is no such link.
    pub fn frame_pose(&self, frame: &Frame) -> Pose {
        self.links[frame.link].pose * frame.pose
    }

    /// Motion of a frame fixed to a link, in its own axes: what an IMU there would measure.
    ///
    /// # Panics
    /// There is no such link.
    pub fn frame_motion(&self, frame: &Frame) -> FrameMotion {
        self.links[frame.link].motion.at(&frame.pose)
    }

    /// Net wrench of each link in base coordinates: the sum of all wrenches on it except gravity.
    pub fn net_wrenches(&self) -> &[Wrench] {
        &self.net
    }

    /// Whether a joint is between the base and the model's root, so that it is crossed from child
    /// to parent.
    pub(crate) fn is_reversed(&self, joint: usize) -> bool {
        self.reversed[joint]
    }

    /// Motion of the child of a joint relative to its parent at unit rate of its degree of freedom,
    /// in base coordinates; `None` for a fixed joint.
    // Always inlined: it has many callers and is on the critical path of inverse dynamics.
    #[inline(always)]
    pub fn joint_axis(&self, joint: &Joint) -> Option<Motion> {
        let pose = &self.links[joint.child].pose;
        let along = |axis: &JointAxis| pose.rotation * axis.vector * joint.ratio;
        match &joint.kind {
            JointKind::Revolute(axis) => Some(Motion::rotation(&along(axis), &pose.translation)),
            JointKind::Prismatic(axis) => Some(Motion::translation(&along(axis))),
            JointKind::Fixed => None,
        }
    }
}

/// The first number that is NaN or infinite.
fn first_not_finite(values: &[f64]) -> Option<usize> {
    // Zero times any finite number is zero, so one sum tests all of them; a search took 3 % of the
    // pass.
    let sum: f64 = values.iter().map(|x| 0.0 * x).sum();
    if sum == 0.0 {
        return None;
    }
    values.iter().position(|x| !x.is_finite())
}

/// Sine and cosine of each angle [rad]: four at a time by `wide`, with an error below one unit in
/// the last place of 1; the remaining ones by the standard library.
fn sin_cos(angles: &[f64], sines: &mut [(f64, f64)]) {
    let (fours, rest) = angles.as_chunks::<4>();
    let (four_sines, rest_sines) = sines.as_chunks_mut::<4>();
    for (angles, sines) in fours.iter().zip(four_sines) {
        *sines = if angles.iter().all(|angle| angle.abs() < MANY_TURNS) {
            let (sin, cos) = f64x4::from(*angles).sin_cos();
            let (sin, cos) = (sin.to_array(), cos.to_array());
            std::array::from_fn(|i| (sin[i], cos[i]))
        } else {
            angles.map(f64::sin_cos)
        };
    }
    for (angle, sin_cos) in rest.iter().zip(rest_sines) {
        *sin_cos = angle.sin_cos();
    }
}

/// Motion of a joint's child from that of its parent.
#[inline(always)]
fn up_to_child(parent: &FrameMotion, joint: &Joint, x_pc: &Pose, dq: f64, ddq: f64) -> FrameMotion {
    let mut motion = parent.at(x_pc);
    // `motion` is that of the child with the joint at rest: its angular velocity is that of the
    // parent, in the axes of the child.
    let omega = motion.angular_velocity;
    match &joint.kind {
        JointKind::Revolute(axis) => {
            let rate = axis.vector * dq;
            motion.angular_velocity += rate;
            motion.angular_acceleration += axis.vector * ddq + omega.cross(&rate);
        }
        JointKind::Prismatic(axis) => {
            motion.proper_acceleration +=
                axis.vector * ddq + omega.cross(&axis.vector) * (2.0 * dq);
        }
        JointKind::Fixed => {}
    }
    motion
}

/// State of a joint's parent from that of its child.
#[inline]
fn down_to_parent(
    child: &LinkKinematics,
    joint: &Joint,
    x_pc: &Pose,
    dq: f64,
    ddq: f64,
) -> LinkKinematics {
    let x_cp = x_pc.inverse();
    let mut motion = child.motion;
    // First the motion of the child with the joint at rest, then the rigid transform.
    match &joint.kind {
        JointKind::Revolute(axis) => {
            let rate = axis.vector * dq;
            motion.angular_velocity -= rate;
            motion.angular_acceleration -= axis.vector * ddq + motion.angular_velocity.cross(&rate);
        }
        JointKind::Prismatic(axis) => {
            motion.proper_acceleration -=
                axis.vector * ddq + motion.angular_velocity.cross(&axis.vector) * (2.0 * dq);
        }
        JointKind::Fixed => {}
    }
    LinkKinematics {
        pose: child.pose * x_cp,
        motion: motion.at(&x_cp),
    }
}

/// A known wrench exerted by the environment on a link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExternalWrench {
    /// The frame of the wrench: its axes, and its origin as the point of the torque.
    pub frame: Frame,
    /// The wrench.
    pub wrench: Wrench,
}

impl ExternalWrench {
    /// The wrench in base coordinates.
    #[inline]
    pub fn in_base(&self, kinematics: &Kinematics) -> Wrench {
        kinematics
            .pose(self.frame.link)
            .wrench(&self.frame.pose.wrench(&self.wrench))
    }
}

/// The recursive Newton-Euler algorithm: torques, transmitted wrenches and the wrench at the base,
/// given every other external wrench.
#[derive(Clone, Debug)]
pub struct InverseDynamics {
    /// Per link: the wrench that the joint above transmits to it, in base coordinates.
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

    /// Computes the joint torques and the wrench by the environment on the base link, from the
    /// links' motion and the known external wrenches.
    ///
    /// # Errors
    /// The objects are made for another model, a frame's link does not exist, or a wrench is not
    /// finite.
    pub fn update(
        &mut self,
        model: &Model,
        kinematics: &Kinematics,
        external: &[ExternalWrench],
    ) -> Result<(), DynamicsError> {
        let (links, dofs) = (self.transmitted.len(), self.torque.len());
        check_sizes([
            ("links of the kinematics", kinematics.link_count(), links),
            ("links of the model", model.link_count(), links),
            ("degrees of freedom of the model", model.dof_count(), dofs),
        ])?;
        check_external(external, links)?;
        self.transmitted.copy_from_slice(kinematics.net_wrenches());
        for wrench in external {
            self.transmitted[wrench.frame.link] -= wrench.in_base(kinematics);
        }
        for joint in model.joints().iter().rev() {
            let wrench = self.transmitted[joint.child];
            self.transmitted[joint.parent] += wrench;
        }
        self.base_wrench = self.transmitted[0];
        self.torque.fill(0.0);
        for (number, joint) in model.joints().iter().enumerate() {
            if kinematics.is_reversed(number) {
                // The base, and with it the wrench on the base, is below this joint.
                let wrench = self.base_wrench;
                self.transmitted[joint.child] -= wrench;
            }
            if let (Some(dof), Some(axis)) = (joint.dof, kinematics.joint_axis(joint)) {
                self.torque[dof] += axis.dot(&self.transmitted[joint.child]);
            }
        }
        Ok(())
    }

    /// Joint torques [Nm or N], by degree of freedom: along the URDF axis, exerted by the parent on
    /// the child. With joints that follow this one ([`Joint::ratio`]), their torques times their
    /// ratios are added: it is the torque at the actuated joint.
    pub fn torque(&self) -> &[f64] {
        &self.torque
    }

    /// The wrench by the environment on the base link, at its origin and in its axes.
    pub fn base_wrench(&self) -> Wrench {
        self.base_wrench
    }

    /// The wrench that a joint's parent exerts on its child, at the origin and in the axes of the
    /// child; see [`super::SensorCut::reading`].
    ///
    /// # Panics
    /// There is no such joint.
    pub fn transmitted(&self, kinematics: &Kinematics, joint: usize) -> Wrench {
        let child = joint + 1;
        kinematics.pose(child).wrench_back(&self.transmitted[child])
    }
}

/// Checks known external wrenches before they are used.
pub(crate) fn check_external(
    external: &[ExternalWrench],
    links: usize,
) -> Result<(), DynamicsError> {
    for (index, wrench) in external.iter().enumerate() {
        if wrench.frame.link >= links {
            return Err(DynamicsError::NoLink(wrench.frame.link));
        }
        if !(wrench.wrench.is_finite() && wrench.frame.pose.is_finite()) {
            return Err(DynamicsError::NotFinite {
                what: "external wrench",
                index,
            });
        }
    }
    Ok(())
}

/// Checks F/T readings before they are used.
pub(crate) fn check_readings(readings: &[Wrench], sensors: usize) -> Result<(), DynamicsError> {
    check_size("F/T readings", readings.len(), sensors)?;
    match readings.iter().position(|reading| !reading.is_finite()) {
        Some(index) => Err(DynamicsError::NotFinite {
            what: "F/T reading",
            index,
        }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Comparison with the standard library, whose error is below one unit in the last place: over
    /// many turns, around the quarter turns where sine and cosine exchange roles, beyond the bound,
    /// and for every number of remaining angles.
    #[test]
    fn sines_are_the_standard_librarys() {
        let quarters = (-40..=40).flat_map(|k| {
            let quarter = f64::from(k) * std::f64::consts::FRAC_PI_2;
            [-1e-3, -1e-9, 0.0, 1e-12, 0.4].map(|offset| quarter + offset)
        });
        let spread = (0..20_000).map(|i| f64::from(i - 10_000) * 9.999_1);
        let angles: Vec<f64> = quarters.chain(spread).collect();
        let check = |angles: &[f64]| {
            let mut sines = vec![(9.0, 9.0); angles.len()];
            sin_cos(angles, &mut sines);
            for (&angle, &(sin, cos)) in angles.iter().zip(&sines) {
                let error = (sin - angle.sin()).abs().max((cos - angle.cos()).abs());
                assert!(error <= f64::EPSILON, "{angle}: {error:e}");
            }
        };
        for count in [1, 2, 3, 4, angles.len() - 1, angles.len()] {
            check(&angles[..count]);
        }
        for far in [
            MANY_TURNS,
            -MANY_TURNS,
            1e9,
            -1e15,
            1e300,
            f64::MIN_POSITIVE,
            -0.0,
        ] {
            check(&[0.1, far, -0.2, 0.3]);
        }
    }

    #[test]
    fn the_first_number_that_is_not_finite_is_found() {
        assert_eq!(first_not_finite(&[]), None);
        assert_eq!(first_not_finite(&[f64::MAX, -f64::MAX, -0.0, 1.0]), None);
        for wrong in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert_eq!(first_not_finite(&[1.0, wrong, 2.0, f64::NAN]), Some(1));
        }
    }
}
