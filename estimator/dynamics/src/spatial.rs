//! Motion and force vectors, rigid transforms and rigid-body inertia: the algebra that all modules
//! of this crate use, and its notation.
//!
//! # Notation, used by every module of this crate
//!
//! **Frames.** A *link frame* is that of the URDF: it sits at the joint that connects the link to
//! its URDF parent and moves with the link. A quantity of link `l` is in the axes of `l` and about
//! the origin of `l`, unless its name or comment says otherwise. The *base* is the link where the
//! kinematic pass starts; *base coordinates* are the axes and the origin of that link. There is no
//! world frame.
//!
//! **Poses.** `x_ab` is the [`Pose`] of frame `b` in frame `a`: it takes coordinates in `b` to
//! coordinates in `a`, `p_a = R_ab p_b + t_ab`. Neighbouring letters cancel: `x_ac = x_ab * x_bc`.
//! `r_ab` is a rotation alone. A trailing letter on a vector names its axes: `omega_b`.
//!
//! **Order.** Six-vectors are [angular; linear] and [torque; force], as in Featherstone, "Rigid
//! Body Dynamics Algorithms" (Springer, 2008), and in Traversaro et al. (ICRA 2015), eq. (8). F/T
//! samples, logs and URDF sensors are force first. [`Wrench`] has named fields, so the order
//! matters only where six numbers are unpacked.
//!
//! **Transforms.** For frames rigidly attached to each other, `x_ab = (R, t)`:
//! - wrench, [`Pose::wrench`]: `f_a = R f_b`, `n_a = R n_b + t x f_a` (the `X*` of the book);
//! - twist, [`Pose::twist`]: `omega_a = R omega_b`, `v_a = R v_b + t x omega_a` (the `X` of the
//!   book);
//! - `S(v)` is the matrix of the cross product, `S(v) w = v x w`;
//! - power is invariant: `n . omega + f . v` is the same in `a` and `b`.
//!
//! **Accelerations** are classical, not spatial: `a_O` is the second derivative of the position of
//! the origin. A point at `r` in the same body has `a_O + alpha x r + omega x (omega x r)`. (A
//! spatial acceleration would be `a_O - omega x v_O`. The classical form needs no velocity of the
//! origin, which cannot be measured.)
//!
//! **Gravity** is always part of the acceleration. Accelerations are *proper*: `a - g`, with `g`
//! the physical gravity, pointing down. This is what an accelerometer reads; a link at rest has
//! `-g`, upwards. (Eq. (9) and (10) of the paper add `I a_g`, which is correct with `a_g = -g`.)
//! Functions that take gravity, for a base at rest, convert it to `-g` at once.
//!
//! **Inertia.** `I` is about the link's *origin*, in link axes; `h = m c` is the first moment, `c`
//! the centre of mass. The ten parameters are, in this order,
//! `[m, m c_x, m c_y, m c_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]` (the paper's `vech`; iDynTree's
//! order; Pinocchio swaps `I_xz` and `I_yy`). The *net wrench* of a body is the sum of all wrenches
//! on it except gravity, about its origin:
//!
//! ```text
//! f = m a + alpha x h + omega x (omega x h)
//! n = I alpha + omega x (I omega) + h x a           a: proper acceleration of the origin
//! ```
//!
//! which is `I a + v x* I v` (Featherstone 2008, eq. 2.72) written with classical accelerations.
//!
//! The *pseudo-inertia* is the same ten numbers as a symmetric 4 x 4 matrix,
//! `[[Sigma, h], [h^T, m]]` with `Sigma = tr(I)/2 1 - I` ([`RigidInertia::pseudo_inertia`]):
//! positive semidefinite if and only if the body is physically consistent (Wensing, Kim, Slotine,
//! RA-L 2018).
//!
//! **Signs.** The wrench of a joint is exerted by its URDF parent on its URDF child. Its torque (or
//! force, if prismatic) is the component of that wrench along the URDF axis, on the link side:
//! without rotor inertia and friction. The position, velocity and acceleration of a joint are those
//! of the child relative to the parent about that axis. These conventions do not depend on the
//! base. An external wrench is exerted by the environment on the link.
//!
//! **F/T sensors** sit in fixed joints. Let `f_c` be the joint's wrench (parent on child, at the
//! child's origin). The measurement frame `m` gives the axes of the readings and the point of their
//! torque; it is the frame of the child link, that of the parent link, or the sensor's own, which
//! is given in that of the child:
//!
//! ```text
//! raw = reading + offset
//! reading = sign X*_mc f_c        sign = -1: child_to_parent, +1: parent_to_child
//! ```
//!
//! An offset is what the sensor adds to the reading, six numbers in the axes and about the origin
//! of `m`. It is subtracted from the raw reading; a positive offset makes the raw reading larger
//! for either sign. Noise is independent per channel of `m`, so its component along a motion `s`
//! has the variance `s_m . (Sigma s_m)`. The balance of a sub-tree counts each sensor's wrench *on
//! the sub-tree*: `f_c` for the one that has the child, `-f_c` for the one that has the parent.
//!
//! **Regressors** ([`crate::regressor`]) are matrices `Y` with `wrench or torques = Y phi`. Rows:
//! the wrench [torque; force], then degrees of freedom. Columns: the ten parameters of each link in
//! turn, about that link's own origin and in its own axes; then offsets, six per sensor
//! [torque; force]. The documentation of each regressor gives the frame of its wrench rows: the
//! link, the base, or the top link of the sub-tree. *Base parameters* are the coordinates
//! `pi = B^T phi` in an orthonormal basis `B` of the identifiable subspace. They mix kg, kg m and
//! kg m^2. `B pi` is the `phi` of least norm that has these base parameters.
//!
//! # Quantities
//!
//! SI units throughout, angles in radians. `n` degrees of freedom, `L` links.
//!
//! Kinematics and wrenches:
//!
//! | quantity | where | shape | axes | about or of | unit |
//! |---|---|---|---|---|---|
//! | pose `x_bl` | [`Pose`] | 3 x 3, 3 | base | origin of the link | 1, m |
//! | motion | [`FrameMotion`] | 3, 3, 3 | the frame's own | its origin | rad/s, rad/s^2, m/s^2 |
//! | twist | [`Motion`] | [3; 3] | as stated | point at the origin | rad/s, m/s |
//! | joint axis | [`Motion`] | [3; 3] | as stated | point at the origin | unit vector |
//! | wrench | [`Wrench`] | [3; 3] | as stated | origin of those axes | Nm, N |
//! | inertia | [`RigidInertia`] | 10 | link | origin of the link | kg, kg m, kg m^2 |
//! | net wrench | [`RigidInertia::net_wrench`] | [3; 3] | link | origin of the link | Nm, N |
//! | net wrenches | [`Kinematics`] | `L` of them | base | origin of the base | Nm, N |
//! | joint torques | [`InverseDynamics`], [`Solver`] | n | joint axis | | Nm or N |
//! | contact wrench | [`ContactSolution`] | [3; 3] | contact's frame | its origin | Nm, N |
//! | F/T reading, offset | [`SensorCut`] | [3; 3] | measurement frame | its origin | Nm, N |
//!
//! Sources: Featherstone 2008, ch. 2 (pose), eq. 2.31 (twist, joint axis), eq. 2.32 (wrench) and
//! eq. 2.72 (net wrench of a link, carried to the base by `X*`); the paper, eq. (8) (inertia),
//! eq. (3) (joint torques) and its rows 1 to 6 (contact wrench).
//!
//! Matrices:
//!
//! | quantity | where | shape | axes | about | source |
//! |---|---|---|---|---|---|
//! | regressor of a link | [`link_regressor`] | 6 x 10 | link | link | (8) to (10) |
//! | regressor of the robot | [`Regressor`] | (6 + n) x 10 L | base; joints | base | (11), (12) |
//! | identifiable basis `B` | [`Identifiable`] | columns x rank | | | (6), (7) |
//!
//! Their "about" is the origin of the link or of the base; their sources are equations of the
//! paper. Units are mixed; `B` has none.
//!
//! [`FrameMotion`]: crate::FrameMotion
//! [`Kinematics`]: crate::Kinematics
//! [`InverseDynamics`]: crate::InverseDynamics
//! [`Solver`]: crate::Solver
//! [`ContactSolution`]: crate::ContactSolution
//! [`SensorCut`]: crate::SensorCut
//! [`link_regressor`]: crate::regressor::link_regressor
//! [`Regressor`]: crate::regressor::Regressor
//! [`Identifiable`]: crate::regressor::identifiable::Identifiable
//!
//! "Paper" is S. Traversaro, A. Del Prete, S. Ivaldi, F. Nori, "Inertial parameters identification
//! and joint torques estimation with proximal force/torque sensing", ICRA 2015.

mod inertia;

pub use inertia::{Inconsistency, RigidInertia};

use derive_more::{Add, AddAssign, Mul, Neg, Sub, SubAssign};
use nalgebra::{Matrix3, Matrix6, Rotation3, UnitQuaternion, Vector3, Vector6};

/// A vector in three-dimensional space.
pub type Vec3 = Vector3<f64>;

/// A 3 x 3 matrix: a rotation or a tensor of inertia.
pub type Mat3 = Matrix3<f64>;

/// A motion vector: angular and linear part of a twist, or the axis of a joint.
#[derive(Add, AddAssign, Clone, Copy, Debug, Default, Mul, Neg, PartialEq, Sub)]
pub struct Motion {
    /// Angular part [rad/s].
    pub angular: Vec3,
    /// Linear part: velocity of the point at the origin of the frame in use [m/s].
    pub linear: Vec3,
}

impl Motion {
    /// No motion.
    pub fn zero() -> Self {
        Self::default()
    }

    /// Unit rotation about the line through `point` along `axis`, as a twist at the origin:
    /// `[axis; point x axis]`.
    #[inline]
    pub fn rotation(axis: &Vec3, point: &Vec3) -> Self {
        Self {
            angular: *axis,
            linear: point.cross(axis),
        }
    }

    /// Unit translation along `axis`: `[0; axis]`.
    #[inline]
    pub fn translation(axis: &Vec3) -> Self {
        Self {
            angular: Vec3::zeros(),
            linear: *axis,
        }
    }

    /// Power of `wrench` along this motion, both in the same frame: `omega . n + v . f` \[W\].
    #[inline]
    pub fn dot(&self, wrench: &Wrench) -> f64 {
        self.angular.dot(&wrench.torque) + self.linear.dot(&wrench.force)
    }
}

/// A force vector: torque about a point, and force. The same type holds a momentum (angular about
/// the point, and linear).
#[derive(Add, AddAssign, Clone, Copy, Debug, Default, Mul, Neg, PartialEq, Sub, SubAssign)]
pub struct Wrench {
    /// Torque about the origin of the frame in use \[Nm\].
    pub torque: Vec3,
    /// Force \[N\].
    pub force: Vec3,
}

impl Wrench {
    /// No force, no torque.
    #[inline]
    pub fn zero() -> Self {
        Self::default()
    }

    /// A wrench from its force and torque parts, in the order of samples and logs: `[fx fy fz]`
    /// \[N\], `[tx ty tz]` \[Nm\].
    pub fn from_parts(force: [f64; 3], torque: [f64; 3]) -> Self {
        Self {
            torque: Vec3::from(torque),
            force: Vec3::from(force),
        }
    }

    /// A force that acts at a point.
    pub(crate) fn of_force(point: &Vec3, force: Vec3) -> Self {
        Self {
            torque: point.cross(&force),
            force,
        }
    }

    /// The inverse of [`Wrench::torque_first`].
    pub fn from_torque_first([tx, ty, tz, fx, fy, fz]: [f64; 6]) -> Self {
        Self::from_parts([fx, fy, fz], [tx, ty, tz])
    }

    /// The six components in the order of regressor rows and offsets, `[tx ty tz fx fy fz]`
    /// [Nm, N].
    pub fn torque_first(&self) -> [f64; 6] {
        let (n, f) = (&self.torque, &self.force);
        [n.x, n.y, n.z, f.x, f.y, f.z]
    }

    /// The six components in the order of samples and logs, `[fx fy fz tx ty tz]` [N, Nm].
    pub fn force_first(&self) -> [f64; 6] {
        let (n, f) = (&self.torque, &self.force);
        [f.x, f.y, f.z, n.x, n.y, n.z]
    }

    /// Whether every component is finite.
    pub fn is_finite(&self) -> bool {
        self.force_first().iter().all(|value| value.is_finite())
    }

    /// The same wrench with the torque taken about `point` instead of the origin: `n - point x f`.
    #[inline]
    pub fn about(&self, point: &Vec3) -> Self {
        Self {
            torque: self.torque - point.cross(&self.force),
            force: self.force,
        }
    }
}

/// Six numbers from two vectors: [angular; linear] or [torque; force].
#[inline]
pub fn stack(upper: &Vec3, lower: &Vec3) -> Vector6<f64> {
    Vector6::new(upper.x, upper.y, upper.z, lower.x, lower.y, lower.z)
}

/// The symmetric matrix `[upper, mixed; mixed^T, lower]`.
pub(crate) fn symmetric(upper: &Mat3, mixed: &Mat3, lower: &Mat3) -> Matrix6<f64> {
    let mut matrix = Matrix6::zeros();
    let mut put = |row, column, block: &Mat3| {
        let mut view = matrix.fixed_view_mut::<3, 3>(row, column);
        view.copy_from(block);
    };
    put(0, 0, upper);
    put(0, 3, mixed);
    put(3, 0, &mixed.transpose());
    put(3, 3, lower);
    matrix
}

/// Pose of one frame in another: `x_ab` takes coordinates in `b` to coordinates in `a`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Rotation `r_ab`: its columns are the axes of `b` in `a`.
    pub rotation: Mat3,
    /// Origin of `b` in `a` \[m\].
    pub translation: Vec3,
}

impl Pose {
    /// The pose of a frame in itself.
    pub fn identity() -> Self {
        Self {
            rotation: Mat3::identity(),
            translation: Vec3::zeros(),
        }
    }

    /// A pose from the URDF's `xyz` \[m\] and `rpy` \[rad\]: fixed-axis roll, pitch, yaw,
    /// `R = Rz(yaw) Ry(pitch) Rx(roll)`.
    pub fn from_xyz_rpy(xyz: [f64; 3], rpy: [f64; 3]) -> Self {
        let [(sr, cr), (sp, cp), (sy, cy)] = rpy.map(f64::sin_cos);
        #[rustfmt::skip]
        let rotation = Mat3::new(
            cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
            sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
            -sp,     cp * sr,                cp * cr,
        );
        Self {
            rotation,
            translation: Vec3::from(xyz),
        }
    }

    /// The rotation as a unit quaternion, in the order `x, y, z, w`.
    pub fn quaternion(&self) -> [f64; 4] {
        let rotation = Rotation3::from_matrix_unchecked(self.rotation);
        UnitQuaternion::from_rotation_matrix(&rotation)
            .coords
            .into()
    }

    /// Whether every component is finite.
    pub fn is_finite(&self) -> bool {
        self.rotation
            .iter()
            .chain(self.translation.iter())
            .all(|value| value.is_finite())
    }

    /// `x_ba` from `x_ab`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self {
            rotation,
            translation: -(rotation * self.translation),
        }
    }

    // `#[inline(always)]` here and below: without it the compiler no longer inlines these
    // functions, and the kinematic pass takes a third longer.
    /// A point of `b`, in `a`.
    #[inline(always)]
    pub fn point(&self, point_b: &Vec3) -> Vec3 {
        self.rotation * point_b + self.translation
    }

    /// A wrench about the origin of `b`, taken to `a`: `X* f_b`.
    #[inline(always)]
    pub fn wrench(&self, wrench_b: &Wrench) -> Wrench {
        let force = self.rotation * wrench_b.force;
        Wrench {
            torque: self.rotation * wrench_b.torque + self.translation.cross(&force),
            force,
        }
    }

    /// A wrench about the origin of `a`, taken to `b`: the inverse of [`Pose::wrench`].
    #[inline]
    pub fn wrench_back(&self, wrench_a: &Wrench) -> Wrench {
        Wrench {
            torque: self
                .rotation
                .tr_mul(&(wrench_a.torque - self.translation.cross(&wrench_a.force))),
            force: self.rotation.tr_mul(&wrench_a.force),
        }
    }

    /// A twist at the origin of `b`, taken to `a`: `X v_b`.
    #[inline]
    pub fn twist(&self, twist_b: &Motion) -> Motion {
        let angular = self.rotation * twist_b.angular;
        Motion {
            angular,
            linear: self.rotation * twist_b.linear + self.translation.cross(&angular),
        }
    }

    /// A twist at the origin of `a`, taken to `b`: the inverse of [`Pose::twist`].
    #[inline]
    pub fn twist_back(&self, twist_a: &Motion) -> Motion {
        Motion {
            angular: self.rotation.tr_mul(&twist_a.angular),
            linear: self
                .rotation
                .tr_mul(&(twist_a.linear - self.translation.cross(&twist_a.angular))),
        }
    }
}

/// `a * b`, written out: nalgebra's loops over rows and columns are not unrolled here, and with
/// them the kinematic pass takes a fifth longer.
#[inline(always)]
fn product(a: &Mat3, b: &Mat3) -> Mat3 {
    let at =
        |i: usize, j: usize| a[(i, 0)] * b[(0, j)] + a[(i, 1)] * b[(1, j)] + a[(i, 2)] * b[(2, j)];
    #[rustfmt::skip]
    let product = Mat3::new(
        at(0, 0), at(0, 1), at(0, 2),
        at(1, 0), at(1, 1), at(1, 2),
        at(2, 0), at(2, 1), at(2, 2),
    );
    product
}

impl std::ops::Mul for Pose {
    type Output = Self;
    /// `x_ac = x_ab * x_bc`.
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self {
            rotation: product(&self.rotation, &other.rotation),
            translation: self.point(&other.translation),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn vector() -> impl Strategy<Value = Vec3> {
        prop::array::uniform3(-2.0..2.0_f64).prop_map(Vec3::from)
    }

    fn pose() -> impl Strategy<Value = Pose> {
        (
            prop::array::uniform3(-2.0..2.0_f64),
            prop::array::uniform3(-3.2..3.2_f64),
        )
            .prop_map(|(xyz, rpy)| Pose::from_xyz_rpy(xyz, rpy))
    }

    fn parameters() -> impl Strategy<Value = RigidInertia> {
        prop::array::uniform10(-2.0..2.0_f64).prop_map(|p| RigidInertia::from_parameters(&p))
    }

    /// Momentum about the origin of a body that moves with `twist`.
    fn momentum(body: &RigidInertia, twist: &Motion) -> Wrench {
        let (h, Motion { angular, linear }) = (&body.first_moment, twist);
        Wrench {
            torque: body.inertia * angular + h.cross(linear),
            force: linear * body.mass - h.cross(angular),
        }
    }

    fn close(a: &Wrench, b: &Wrench) -> bool {
        (a.torque - b.torque).norm() < 1e-12 * (1.0 + a.torque.norm())
            && (a.force - b.force).norm() < 1e-12 * (1.0 + a.force.norm())
    }

    /// URDF's definition: rotate about fixed x by roll, then fixed y by pitch, then fixed z by yaw.
    #[test]
    fn rpy_is_three_rotations_about_fixed_axes() {
        let (roll, pitch, yaw) = (0.3, -1.1, 2.7);
        let expected = Rotation3::from_axis_angle(&Vec3::z_axis(), yaw)
            * Rotation3::from_axis_angle(&Vec3::y_axis(), pitch)
            * Rotation3::from_axis_angle(&Vec3::x_axis(), roll);
        let got = Pose::from_xyz_rpy([0.0; 3], [roll, pitch, yaw]).rotation;
        assert!((got - expected.matrix()).amax() < 1e-15);
    }

    proptest! {
        #![proptest_config(ProptestConfig {
            failure_persistence: None,
            ..ProptestConfig::default()
        })]

        /// The columns of the rotation are the axes, which the quaternion turns by `q v q*`.
        #[test]
        fn a_quaternion_turns_as_its_rotation(x_ab in pose(), v in vector()) {
            let [x, y, z, w] = x_ab.quaternion();
            let axis = Vec3::new(x, y, z);
            let turned = v + 2.0 * axis.cross(&(axis.cross(&v) + w * v));
            prop_assert!((turned - x_ab.rotation * v).norm() < 1e-12);
            prop_assert!((axis.norm_squared() + w * w - 1.0).abs() < 1e-12);
        }

        #[test]
        fn power_is_the_same_in_every_frame(
            x_ab in pose(),
            angular in vector(),
            linear in vector(),
            torque in vector(),
            force in vector(),
        ) {
            let (twist, wrench) = (Motion { angular, linear }, Wrench { torque, force });
            let (twist_a, wrench_a) = (x_ab.twist(&twist), x_ab.wrench(&wrench));
            prop_assert!((twist.dot(&wrench) - twist_a.dot(&wrench_a)).abs() < 1e-11);
            prop_assert!(close(&x_ab.wrench_back(&wrench_a), &wrench));
            prop_assert!(close(&x_ab.inverse().wrench(&wrench_a), &wrench));
            prop_assert!((x_ab.twist_back(&twist_a).linear - linear).norm() < 1e-12);
        }

        /// The net wrench from classical accelerations equals I a + v x* I v with spatial ones,
        /// a = [alpha; a_O - omega x v_O].
        #[test]
        fn net_wrench_is_featherstones(
            body in parameters(),
            omega in vector(),
            v in vector(),
            alpha in vector(),
            a in vector(),
        ) {
            let twist = Motion {
                angular: omega,
                linear: v,
            };
            let spatial = Motion {
                angular: alpha,
                linear: a - omega.cross(&v),
            };
            let p = momentum(&body, &twist);
            let rate = Wrench {
                torque: omega.cross(&p.torque) + v.cross(&p.force),
                force: omega.cross(&p.force),
            };
            let expected = momentum(&body, &spatial) + rate;
            prop_assert!(close(&body.net_wrench(&omega, &alpha, &a), &expected));
        }

        /// Momentum is a wrench: computed in b and carried to a, or computed in a from the
        /// transformed inertia.
        #[test]
        fn inertia_transforms_as_momentum_does(
            x_ab in pose(),
            body in parameters(),
            angular in vector(),
            linear in vector(),
        ) {
            let twist = Motion { angular, linear };
            let in_a = momentum(&body.transformed(&x_ab), &x_ab.twist(&twist));
            let carried = x_ab.wrench(&momentum(&body, &twist));
            prop_assert!(
                (in_a.torque - carried.torque).norm() < 1e-11 * (1.0 + carried.torque.norm())
            );
            prop_assert!(
                (in_a.force - carried.force).norm() < 1e-11 * (1.0 + carried.force.norm())
            );
            prop_assert_eq!(RigidInertia::from_parameters(&body.parameters()), body);
        }

        /// Power is linear in the motion: addition, subtraction and scaling of motions.
        #[test]
        fn power_is_linear_in_motions(
            m in (vector(), vector()),
            n in (vector(), vector()),
            f in (vector(), vector()),
            factor in -2.0..2.0_f64,
        ) {
            let (m, n) = (
                Motion {
                    angular: m.0,
                    linear: m.1,
                },
                Motion {
                    angular: n.0,
                    linear: n.1,
                },
            );
            let f = Wrench {
                torque: f.0,
                force: f.1,
            };
            let (a, b) = (m.dot(&f), n.dot(&f));
            let mut sum = m;
            sum += n;
            prop_assert_eq!(sum, m + n);
            for (got, expected) in [
                ((m + n).dot(&f), a + b),
                ((m - n).dot(&f), a - b),
                ((-m).dot(&f), -a),
                ((m * factor).dot(&f), a * factor),
            ] {
                prop_assert!((got - expected).abs() < 1e-12);
            }
        }

        /// The check agrees with the definition by the pseudo-inertia, which must be positive
        /// semidefinite.
        #[test]
        fn consistency_is_a_positive_pseudo_inertia(
            mass in 0.01..5.0_f64,
            c in vector(),
            d in prop::array::uniform3(0.001..1.0_f64),
            x in pose(),
        ) {
            let body =
                RigidInertia::from_centroidal(mass, &c, &Mat3::from_diagonal(&Vec3::from(d)))
                    .transformed(&x);
            let mut sorted = d;
            sorted.sort_by(f64::total_cmp);
            let margin = sorted[0] + sorted[1] - sorted[2];
            prop_assume!(margin.abs() > 1e-6);
            prop_assert_eq!(body.check(0.0).is_ok(), margin > 0.0);
            prop_assert_eq!(body.pseudo_inertia().cholesky().is_some(), margin > 0.0);
        }
    }

    #[test]
    fn check_names_the_condition() {
        let unit = RigidInertia::from_centroidal(1.0, &Vec3::zeros(), &Mat3::identity());
        assert_eq!(unit.check(0.0), Ok(()));
        assert_eq!(
            RigidInertia { mass: -1.0, ..unit }.check(0.0),
            Err(Inconsistency::Mass(-1.0))
        );
        let flat = |d: [f64; 3]| {
            RigidInertia {
                inertia: Mat3::from_diagonal(&Vec3::from(d)),
                ..unit
            }
            .check(1e-6)
        };
        assert!(matches!(
            flat([1.0, -1.0, 1.0]),
            Err(Inconsistency::NotPositive { .. })
        ));
        assert!(matches!(
            flat([1.0, 1.0, 2.1]),
            Err(Inconsistency::Triangle { .. })
        ));
        assert_eq!(
            flat([1.0, 1.0, 2.0]),
            Ok(()),
            "a flat plate is on the boundary"
        );
    }
}
