//! The blocks of the equation of motion, eq. (3) of Traversaro et al. (ICRA 2015), for any base;
//! and Jacobians of frames.

use nalgebra::{DMatrix, DMatrixViewMut, Matrix6, Matrix6xX};

use crate::error::{DynamicsError, check_size};
use crate::kinematics::Kinematics;
use crate::model::{Frame, Joint, Model};
use crate::spatial::{Motion, RigidInertia, Vec3, Wrench, stack};

/// The link and joint next to a link towards the base.
#[derive(Clone, Copy, Debug)]
struct Inward {
    /// The neighbouring link.
    link: usize,
    /// Degree of freedom of the joint between them.
    dof: Option<usize>,
}

/// Inertia, coupling and bias of the whole robot as seen from one link, the base: the blocks of
///
/// ```text
/// [ I^c  F ] [ a_b ]   [ p^c ]   [ f_b ]         [ X*_l  ]
/// [ F^T  H ] [ ddq ] + [ C   ] = [ tau ] + sum_l [ J_l^T ] f^x_l
/// ```
///
/// (eq. (3) of the paper; the equation printed after it has the wrong sign on the right side, it
/// should read `[f_b; tau] = M a + bias - sum [X*; J^T] f^x`.) [`super::InverseDynamics`] gives
/// `[f_b; tau]` for known accelerations; this type gives the matrices. `X*_l` and `J_l` are from
/// [`Kinematics::floating_jacobian`]. It owns its results and all working storage.
///
/// Everything except the external wrenches is in base coordinates. Six-vectors are
/// [angular; linear] and [torque; force]. The sign of a joint is that of the URDF, on whichever
/// side of it the base is: `ddq`, `tau`, `C`, the columns of `F` and `J` and both indices of `H`
/// refer to the motion of the URDF child relative to its URDF parent.
///
/// # Where gravity is
/// In `a_b` or in the bias, as the caller of [`EquationOfMotion::update`] chooses, never in both:
/// - gravity given as zero: `a_b = [alpha; a - g]` is the base's *proper* acceleration, as
///   everywhere in this crate ([`super::FrameMotion`]), and `p^c`, `C` contain only velocity terms.
///   Weight is then in `I^c a_b` and `F^T a_b`, and the direction of gravity is not needed.
/// - gravity given as `g`: `a_b = [alpha; a]` is the base's acceleration in space, and `p^c`, `C`
///   contain weight too: `p^c = ... - I^c [0; g]`, `C = ... - F^T [0; g]`, the "Coriolis,
///   centrifugal and gravitational effects" of the paper.
///
/// `a` is the classical acceleration of the base's origin in both cases. That of the paper is
/// spatial, smaller by `omega x v_O`. The two are equal for an inertial observer who moves with the
/// origin at this instant. The bias is computed for that observer: `v_O = 0`, and the velocity of
/// the base's origin is not needed.
///
/// # How
/// The composite-rigid-body algorithm (Featherstone 2008, sections 6.2 and 9.3) in base
/// coordinates: nothing is transformed between links, so the tree can be rooted anywhere without a
/// rebuild.
#[derive(Clone, Debug)]
pub struct EquationOfMotion {
    // Results, in base coordinates.
    base: usize,
    coupling: Matrix6xX<f64>,
    joint_inertia: DMatrix<f64>,
    bias_wrench: Wrench,
    bias_torque: Vec<f64>,
    /// Per link: the inertia of it and of all links beyond it as seen from the base.
    composite: Vec<RigidInertia>,
    // Scratch.
    /// Per link; unused for the base.
    inward: Vec<Inward>,
    /// Per link: motion of it, as the outer link, relative to the inner one at unit rate.
    axes: Vec<Motion>,
    twists: Vec<Motion>,
    accelerations: Vec<Motion>,
    wrenches: Vec<Wrench>,
}

impl EquationOfMotion {
    /// For a model.
    pub fn new(model: &Model) -> Self {
        let (links, dofs) = (model.link_count(), model.dof_count());
        Self {
            base: 0,
            coupling: Matrix6xX::zeros(dofs),
            joint_inertia: DMatrix::zeros(dofs, dofs),
            bias_wrench: Wrench::zero(),
            bias_torque: vec![0.0; dofs],
            composite: vec![RigidInertia::zero(); links],
            inward: vec![Inward { link: 0, dof: None }; links],
            axes: vec![Motion::zero(); links],
            twists: vec![Motion::zero(); links],
            accelerations: vec![Motion::zero(); links],
            wrenches: vec![Wrench::zero(); links],
        }
    }

    /// Computes all blocks for the base, the poses and the velocities of the last update of
    /// `kinematics`. Accelerations in the kinematics are not used. Does not allocate.
    ///
    /// `gravity` [m/s^2], in the axes of the base, is physical gravity if the bias is to contain
    /// weight, and zero if `a_b` is to be proper (see [`EquationOfMotion`]).
    ///
    /// The bias is the result of a Newton-Euler pass with all accelerations zero. From a link `i`
    /// to the next one outward, `o`, with `s` the motion of `o` relative to `i` at unit rate (minus
    /// the URDF axis where `o` is the URDF parent), all about the base's origin:
    ///
    /// ```text
    /// v_o = v_i + s dq                        v_b = [omega_b; 0]
    /// a_o = a_i + v_i x s dq                  a_b = [0; -gravity]
    /// f_l = I_l a_l + v_l x* I_l v_l          p^c = sum f_l,  C_j = s_j . (sum of f_l beyond j)
    /// F_j = I^c_j s_j,  H_kj = s_k . F_j      I^c_j = sum of I_l beyond j
    /// ```
    ///
    /// `k` is `j` and the joints between it and the base.
    ///
    /// # Errors
    /// The objects are made for another model, or gravity is not finite. Nothing is changed in that
    /// case.
    pub fn update(
        &mut self,
        model: &Model,
        kinematics: &Kinematics,
        gravity: &Vec3,
    ) -> Result<(), DynamicsError> {
        check_size(
            "links of the model",
            model.link_count(),
            self.composite.len(),
        )?;
        check_size(
            "links of the kinematics",
            kinematics.link_count(),
            self.composite.len(),
        )?;
        check_size(
            "degrees of freedom of the model",
            model.dof_count(),
            self.bias_torque.len(),
        )?;
        check_size(
            "degrees of freedom of the kinematics",
            kinematics.joint_velocity().len(),
            self.bias_torque.len(),
        )?;
        if let Some(index) = gravity.iter().position(|x| !x.is_finite()) {
            return Err(DynamicsError::NotFinite {
                what: "gravity",
                index,
            });
        }
        self.base = kinematics.base();

        // Outward: first from the base to the model's root, then to all other links.
        self.twists[self.base] = Motion {
            angular: kinematics.motion(self.base).angular_velocity,
            linear: Vec3::zeros(),
        };
        self.accelerations[self.base] = Motion {
            angular: Vec3::zeros(),
            linear: -gravity,
        };
        for joint in model
            .joints()
            .iter()
            .rev()
            .filter(|joint| is_reversed(kinematics, joint))
        {
            self.cross(kinematics, joint, true);
        }
        for joint in model
            .joints()
            .iter()
            .filter(|joint| !is_reversed(kinematics, joint))
        {
            self.cross(kinematics, joint, false);
        }
        for (link, inertia) in model.inertias().iter().enumerate() {
            let (twist, inertia) = (
                &self.twists[link],
                inertia.transformed(kinematics.pose(link)),
            );
            self.wrenches[link] = inertia.momentum(&self.accelerations[link])
                + twist.cross_wrench(&inertia.momentum(twist));
            self.composite[link] = inertia;
        }

        // Inward, in the opposite order.
        for joint in model
            .joints()
            .iter()
            .rev()
            .filter(|joint| !is_reversed(kinematics, joint))
        {
            self.gather(joint.child, joint.parent);
        }
        for joint in model
            .joints()
            .iter()
            .filter(|joint| is_reversed(kinematics, joint))
        {
            self.gather(joint.parent, joint.child);
        }
        self.bias_wrench = self.wrenches[self.base];

        // Joints that are not on one path outward from the base have no coupling; which joints
        // these are depends on the base. Several joints may have one degree of freedom.
        self.joint_inertia.fill(0.0);
        self.coupling.fill(0.0);
        self.bias_torque.fill(0.0);
        for outer in 0..self.inward.len() {
            let Inward { mut link, dof } = self.inward[outer];
            let Some(dof) = dof.filter(|_| outer != self.base) else {
                continue;
            };
            let axis = &self.axes[outer];
            self.bias_torque[dof] += axis.dot(&self.wrenches[outer]);
            let momentum = self.composite[outer].momentum(axis);
            let mut column = self.coupling.column_mut(dof);
            column += stack(&momentum.torque, &momentum.force);
            self.joint_inertia[(dof, dof)] += axis.dot(&momentum);
            while link != self.base {
                let next = self.inward[link];
                if let Some(other) = next.dof {
                    let value = self.axes[link].dot(&momentum);
                    self.joint_inertia[(dof, other)] += value;
                    self.joint_inertia[(other, dof)] += value;
                }
                link = next.link;
            }
        }
        Ok(())
    }

    /// Twist and acceleration across one joint, away from the base.
    fn cross(&mut self, kinematics: &Kinematics, joint: &Joint, reversed: bool) {
        let (inner, outer) = if reversed {
            (joint.child, joint.parent)
        } else {
            (joint.parent, joint.child)
        };
        self.inward[outer] = Inward {
            link: inner,
            dof: joint.dof,
        };
        let (mut twist, mut acceleration) = (self.twists[inner], self.accelerations[inner]);
        if let (Some(dof), Some(axis)) = (joint.dof, kinematics.joint_axis(joint)) {
            let axis = if reversed { -axis } else { axis };
            self.axes[outer] = axis;
            let rate = axis * kinematics.joint_velocity()[dof];
            acceleration += twist.cross(&rate);
            twist += rate;
        }
        self.twists[outer] = twist;
        self.accelerations[outer] = acceleration;
    }

    /// Adds `outer` and all links beyond it to `inner`.
    fn gather(&mut self, outer: usize, inner: usize) {
        let wrench = self.wrenches[outer];
        self.wrenches[inner] += wrench;
        self.composite[inner] = self.composite[inner] + self.composite[outer];
    }

    /// The base of the last update, in whose coordinates the blocks are.
    pub fn base(&self) -> usize {
        self.base
    }

    /// `I^c`, the inertia of the whole robot with its joints held, about the origin and in the axes
    /// of the base.
    pub fn composite_inertia(&self) -> &RigidInertia {
        &self.composite[self.base]
    }

    /// `I^c` as a 6 x 6 matrix, [angular; linear] to [torque; force]: `[I, [h]x; -[h]x, m 1]`
    /// (Featherstone 2008, eq. 2.63).
    pub fn composite_matrix(&self) -> Matrix6<f64> {
        let RigidInertia {
            mass,
            first_moment,
            inertia,
        } = self.composite_inertia();
        let mut matrix = Matrix6::from_diagonal_element(*mass);
        matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(inertia);
        matrix
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&first_moment.cross_matrix());
        matrix
            .fixed_view_mut::<3, 3>(3, 0)
            .copy_from(&-first_moment.cross_matrix());
        matrix
    }

    /// `F` (6 x n): per degree of freedom the [torque; force] about the base's origin for its unit
    /// acceleration. It is also the momentum of its unit velocity, the "joint Jacobian of the
    /// tree's momentum" of the paper.
    pub fn coupling(&self) -> &Matrix6xX<f64> {
        &self.coupling
    }

    /// `H` (n x n), the joint-space inertia for a fixed base: symmetric, positive semidefinite, and
    /// definite if only the zero joint velocity has zero kinetic energy. (It is not sufficient that
    /// every joint moves some mass: consider two coaxial hinges with a massless link between them.)
    pub fn joint_inertia(&self) -> &DMatrix<f64> {
        &self.joint_inertia
    }

    /// `p^c`, the wrench at the base due to velocities, and to gravity if it was given [Nm, N].
    pub fn bias_wrench(&self) -> Wrench {
        self.bias_wrench
    }

    /// `C`, the joint torques due to velocities, and to gravity if it was given [Nm or N], by
    /// degree of freedom.
    pub fn bias_torque(&self) -> &[f64] {
        &self.bias_torque
    }

    /// The left side of (3): writes the torques to `torque` and returns the wrench at the base,
    /// both without external wrenches, for the base's acceleration `[alpha; a]` (proper if gravity
    /// was given as zero) and the joints' accelerations. Does not allocate.
    ///
    /// # Errors
    /// The size of a slice is not the number of degrees of freedom.
    pub fn left_side(
        &self,
        base_acceleration: &Motion,
        joint_acceleration: &[f64],
        torque: &mut [f64],
    ) -> Result<Wrench, DynamicsError> {
        check_size(
            "joint accelerations",
            joint_acceleration.len(),
            self.bias_torque.len(),
        )?;
        check_size("torques", torque.len(), self.bias_torque.len())?;
        let a_b = stack(&base_acceleration.angular, &base_acceleration.linear);
        let mut wrench = self.composite_inertia().momentum(base_acceleration) + self.bias_wrench;
        torque.copy_from_slice(&self.bias_torque);
        for ((f, h), ddq) in self
            .coupling
            .column_iter()
            .zip(self.joint_inertia.column_iter())
            .zip(joint_acceleration)
        {
            wrench += Wrench {
                torque: f.fixed_rows::<3>(0) * *ddq,
                force: f.fixed_rows::<3>(3) * *ddq,
            };
            for (torque, h) in torque.iter_mut().zip(h.iter()) {
                *torque += h * ddq;
            }
        }
        for (torque, f) in torque.iter_mut().zip(self.coupling.column_iter()) {
            *torque += f.dot(&a_b);
        }
        Ok(wrench)
    }
}

fn is_reversed(kinematics: &Kinematics, joint: &Joint) -> bool {
    // Joint j moves link j + 1.
    kinematics.is_reversed(joint.child - 1)
}

/// Jacobians for the poses and the base of the last update.
impl Kinematics {
    /// Writes `J_l` (6 x n) of a frame fixed to a link: its twist relative to the base is `J_l dq`,
    /// [angular; linear], at the frame's origin and in the frame's axes. So an external wrench
    /// given in that frame ([`super::ExternalWrench`]) adds `J_l^T f` to the right side of (3).
    /// Columns of joints that are not between the base and the link are zero. Does not allocate.
    ///
    /// # Errors
    /// The model is another one, there is no such link, the frame's pose is not finite, or `out`
    /// has another shape. Nothing is changed in that case.
    pub fn jacobian(
        &self,
        model: &Model,
        frame: &Frame,
        mut out: DMatrixViewMut<'_, f64>,
    ) -> Result<(), DynamicsError> {
        self.check_jacobian(model, frame, &out, 0)?;
        self.write_joint_columns(model, frame, &mut out, 0);
        Ok(())
    }

    /// Writes `[X_b | J_l]` (6 x (6 + n)) of a frame fixed to a link: its twist is
    /// `X_b v_b + J_l dq`, with `v_b` the [angular; linear] twist of the base in base coordinates,
    /// and the rest as for [`Kinematics::jacobian`]. Its transpose takes an external wrench to the
    /// right side of (3): `X_b^T` is the paper's `X*_l`. Does not allocate.
    ///
    /// # Errors
    /// As [`Kinematics::jacobian`].
    pub fn floating_jacobian(
        &self,
        model: &Model,
        frame: &Frame,
        mut out: DMatrixViewMut<'_, f64>,
    ) -> Result<(), DynamicsError> {
        self.check_jacobian(model, frame, &out, 6)?;
        self.write_joint_columns(model, frame, &mut out, 6);
        let x_bf = *self.pose(frame.link) * frame.pose;
        for axis in 0..3 {
            let mut unit = Vec3::zeros();
            unit[axis] = 1.0;
            for (column, motion) in [
                (axis, Motion::rotation(&unit, &Vec3::zeros())),
                (axis + 3, Motion::translation(&unit)),
            ] {
                let twist = x_bf.twist_back(&motion);
                out.set_column(column, &stack(&twist.angular, &twist.linear));
            }
        }
        Ok(())
    }

    fn check_jacobian(
        &self,
        model: &Model,
        frame: &Frame,
        out: &DMatrixViewMut<'_, f64>,
        before: usize,
    ) -> Result<(), DynamicsError> {
        check_size("links of the model", model.link_count(), self.link_count())?;
        check_size("rows of the Jacobian", out.nrows(), 6)?;
        check_size(
            "columns of the Jacobian",
            out.ncols(),
            before + model.dof_count(),
        )?;
        if frame.link >= self.link_count() {
            return Err(DynamicsError::NoLink(frame.link));
        }
        if !frame.pose.is_finite() {
            return Err(DynamicsError::NotFinite {
                what: "pose of a frame on link",
                index: frame.link,
            });
        }
        Ok(())
    }

    fn write_joint_columns(
        &self,
        model: &Model,
        frame: &Frame,
        out: &mut DMatrixViewMut<'_, f64>,
        before: usize,
    ) {
        out.fill(0.0);
        let x_bf = *self.pose(frame.link) * frame.pose;
        // From both ends of the path up to where they meet: the greater number is lower in the
        // tree.
        let (mut base_end, mut link_end) = (self.base(), frame.link);
        while base_end != link_end {
            let reversed = base_end > link_end;
            let lower = if reversed {
                &mut base_end
            } else {
                &mut link_end
            };
            let joint = &model.joints()[*lower - 1];
            if let (Some(dof), Some(axis)) = (joint.dof, self.joint_axis(joint)) {
                let twist = x_bf.twist_back(&if reversed { -axis } else { axis });
                let mut column = out.column_mut(before + dof);
                column += stack(&twist.angular, &twist.linear);
            }
            *lower = joint.parent;
        }
    }
}
