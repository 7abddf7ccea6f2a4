//! Motion and force vectors, rigid transforms and rigid-body inertia: the algebra under everything here, and its notation.
//!
//! # Notation, used by every module of this crate
//!
//! **Frames.** A *link frame* is that of the URDF: it sits at the joint that connects the link to its URDF parent and moves with the link. A quantity
//! of link `l` is in the axes of `l` and about the origin of `l`, unless its name or comment says otherwise. The *base* is the link where the
//! kinematic pass starts; *base coordinates* are the axes and the origin of that link. No world frame exists: nothing here needs one.
//!
//! **Poses.** `x_ab` is the [`Pose`] of frame `b` in frame `a`: it takes coordinates in `b` to coordinates in `a`, `p_a = R_ab p_b + t_ab`. Neighbouring
//! letters cancel: `x_ac = x_ab * x_bc`. `r_ab` is a rotation alone. A trailing letter on a vector names its axes: `omega_b`.
//!
//! **Order.** Six-vectors are [angular; linear] and [torque; force], as in Featherstone, "Rigid Body Dynamics Algorithms" (Springer, 2008), and in
//! Traversaro et al. (ICRA 2015), eq. (8). F/T samples, logs and URDF sensors are force first: [`Wrench`] has named fields, so that the order
//! shows only where six numbers are unpacked.
//!
//! **Transforms.** For frames rigidly attached to each other, `x_ab = (R, t)`:
//! - wrench, [`Pose::wrench`]: `f_a = R f_b`, `n_a = R n_b + t x f_a` (the `X*` of the book);
//! - twist, [`Pose::twist`]: `omega_a = R omega_b`, `v_a = R v_b + t x omega_a` (the `X` of the book);
//! - `S(v)` is the matrix of the cross product, `S(v) w = v x w`;
//! - power is invariant: `n . omega + f . v` is the same in `a` and `b`.
//!
//! **Accelerations** are classical, not spatial: `a_O` is the second derivative of the position of the origin. A point at `r` in the same body has
//! `a_O + alpha x r + omega x (omega x r)`. (A spatial acceleration would be `a_O - omega x v_O`; no velocity of an origin is needed this way, and none can
//! be measured.)
//!
//! **Gravity** never appears by itself. Accelerations are *proper*: `a - g`, with `g` the physical gravity, pointing down. It is what an accelerometer
//! reads; a link standing still has `-g`, upwards. (Eq. (9) and (10) of the paper add `I a_g`: right with `a_g = -g`.)
//! There is one exception, the bias of the equation of motion: [`crate::dynamics::EquationOfMotion`] puts weight there if gravity is given to it, and
//! the base's acceleration that goes with this bias is `a`, not `a - g`. Where else gravity is asked for, of a base that stands, `-g` is made of it at once.
//!
//! **Inertia.** `I` is about the link's *origin*, in link axes; `h = m c` is the first moment, `c` the centre of mass. The ten parameters are, in this order,
//! `[m, m c_x, m c_y, m c_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]` (the paper's `vech`; iDynTree's order; Pinocchio swaps `I_xz` and `I_yy`).
//! The *net wrench* of a body, the sum of everything that acts on it but gravity, about its origin:
//!
//! ```text
//! f = m a + alpha x h + omega x (omega x h)
//! n = I alpha + omega x (I omega) + h x a           a: proper acceleration of the origin
//! ```
//!
//! which is `I a + v x* I v` (Featherstone 2008, eq. 2.72) written with classical accelerations.
//!
//! The *pseudo-inertia* is the same ten numbers as a symmetric 4 x 4 matrix, `[[Sigma, h], [h^T, m]]` with `Sigma = tr(I)/2 1 - I`
//! ([`RigidInertia::pseudo_inertia`]): positive semidefinite exactly for bodies that can exist (Wensing, Kim, Slotine, RA-L 2018).
//!
//! **Signs.** A joint's wrench is by its URDF parent on its URDF child; its torque (or force, if prismatic) is the component of that wrench along the
//! URDF axis, on the link side: without rotor inertia and friction. A joint's position, velocity and acceleration are of the child relative to the parent about
//! that axis. Wherever the base is, these do not change. An external wrench is by the environment on the link.
//!
//! **F/T sensors** sit in fixed joints. With `f_c` the joint's wrench (parent on child, at the child's origin), and `m` the measurement frame, whose
//! axes the readings have and whose origin their torque is about (child link's, parent link's, or the sensor's own, which is given in the child's):
//!
//! ```text
//! raw = reading + offset        reading = sign X*_mc f_c        sign = -1: child_to_parent, +1: parent_to_child
//! ```
//!
//! An offset is what the sensor adds, six numbers in the axes and about the origin of `m`: it is subtracted from what comes in, and a positive one makes the raw
//! reading larger whichever the direction. Noise is independent per channel of `m`, so a motion `s` sees the variance `s_m . (Sigma s_m)`.
//! The balance of a sub-tree counts each sensor's wrench *on the sub-tree*: `f_c` for the one that has the child, `-f_c` for the one that has the parent.
//!
//! **Regressors** ([`crate::regressor`]) are matrices `Y` with `wrench or torques = Y phi`. Rows: the wrench [torque; force], then degrees of freedom. Columns:
//! the ten parameters of each link in turn, about that link's own origin and in its own axes; then offsets, six per sensor [torque; force]. The wrench
//! rows are in the frame that the regressor names: that of the link, of the base, or of the sub-tree's top link. *Base parameters* are the coordinates
//! `pi = B^T phi` in an orthonormal basis `B` of the identifiable subspace; they mix kg, kg m and kg m^2, and `B pi` is that choice of `phi` with these base
//! parameters which has the least norm.
//!
//! # Quantities
//!
//! SI units throughout, angles in radians. `n` degrees of freedom, `L` links.
//!
//! | quantity | where | shape | axes | about or of | unit | source |
//! |---|---|---|---|---|---|---|
//! | pose `x_bl` | [`Pose`] | 3 x 3, 3 | base | origin of the link | 1, m | Featherstone 2008, ch. 2 |
//! | motion | [`crate::dynamics::FrameMotion`] | 3, 3, 3 | the frame's own | its origin | rad/s, rad/s^2, m/s^2 | classical, proper |
//! | twist, joint axis | [`Motion`] | [3; 3] | as stated | point at the origin | rad/s, m/s; unit | Featherstone 2008, eq. 2.31 |
//! | wrench | [`Wrench`] | [3; 3] | as stated | origin of those axes | Nm, N | Featherstone 2008, eq. 2.32 |
//! | inertia | [`RigidInertia`] | 10 | link | origin of the link | kg, kg m, kg m^2 | paper, eq. (8) |
//! | net wrench of a link | [`RigidInertia::net_wrench`] | [3; 3] | link | origin of the link | Nm, N | Featherstone 2008, eq. 2.72 |
//! | net wrenches | [`crate::dynamics::Kinematics`] | `L` of them | base | origin of the base | Nm, N | the same, carried by `X*` |
//! | joint torques | [`crate::dynamics::InverseDynamics`], [`crate::dynamics::Solver`] | n | joint axis | | Nm or N | paper, eq. (3) |
//! | contact wrench | [`crate::dynamics::ContactEstimate`] | [3; 3] | contact's frame | its origin | Nm, N | paper, eq. (3), rows 1 to 6 |
//! | F/T reading, offset | [`crate::dynamics::SensorCut`] | [3; 3] | measurement frame | its origin | Nm, N | above |
//! | mass matrix, bias | [`crate::dynamics::EquationOfMotion`] | (6 + n) x (6 + n) | base; joint axes | origin of the base | mixed | paper, eq. (3) |
//! | regressor of a link | [`crate::regressor::link_regressor`] | 6 x 10 | link | origin of the link | mixed | paper, eq. (8) to (10) |
//! | regressor of the robot | [`crate::regressor::Regressor`] | (6 + n) x 10 L | base; joint axes | origin of the base | mixed | paper, eq. (11), (12) |
//! | identifiable basis `B` | [`crate::regressor::identifiable::Identifiable`] | columns x rank | | | 1 | paper, eq. (6), (7) |
//!
//! "Paper" is S. Traversaro, A. Del Prete, S. Ivaldi, F. Nori, "Inertial parameters identification and joint torques estimation with proximal force/torque
//! sensing", ICRA 2015.

use std::ops::{Add, AddAssign, Mul, Neg, Sub, SubAssign};

use nalgebra::{Matrix3, Matrix4, Vector3, Vector6};

/// A vector in three-dimensional space.
pub type Vec3 = Vector3<f64>;

/// A 3 x 3 matrix: a rotation or a tensor of inertia.
pub type Mat3 = Matrix3<f64>;

/// A motion vector: angular and linear part of a twist, or the axis of a joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Angular part [rad/s].
    pub angular: Vec3,
    /// Linear part: of the point at the origin of the frame in use [m/s].
    pub linear: Vec3,
}

impl Motion {
    /// No motion.
    pub fn zero() -> Self {
        Self {
            angular: Vec3::zeros(),
            linear: Vec3::zeros(),
        }
    }

    /// The unit rotation about the line through `point` along `axis`, as a twist about the origin: `[axis; point x axis]`.
    #[inline]
    pub fn rotation(axis: &Vec3, point: &Vec3) -> Self {
        Self {
            angular: *axis,
            linear: point.cross(axis),
        }
    }

    /// The unit translation along `axis`: `[0; axis]`.
    #[inline]
    pub fn translation(axis: &Vec3) -> Self {
        Self {
            angular: Vec3::zeros(),
            linear: *axis,
        }
    }

    /// Power of `wrench` on this motion, both in the same frame: `omega . n + v . f` [W].
    #[inline]
    pub fn dot(&self, wrench: &Wrench) -> f64 {
        self.angular.dot(&wrench.torque) + self.linear.dot(&wrench.force)
    }

    /// Cross product of motions, `self x other` (Featherstone 2008, eq. 2.31).
    pub fn cross(&self, other: &Self) -> Self {
        Self {
            angular: self.angular.cross(&other.angular),
            linear: self.angular.cross(&other.linear) + self.linear.cross(&other.angular),
        }
    }

    /// Cross product with a wrench or a momentum, `self x* wrench` (Featherstone 2008, eq. 2.32).
    pub fn cross_wrench(&self, wrench: &Wrench) -> Wrench {
        Wrench {
            torque: self.angular.cross(&wrench.torque) + self.linear.cross(&wrench.force),
            force: self.angular.cross(&wrench.force),
        }
    }
}

impl Add for Motion {
    type Output = Self;
    #[inline]
    fn add(self, other: Self) -> Self {
        Self {
            angular: self.angular + other.angular,
            linear: self.linear + other.linear,
        }
    }
}

impl Sub for Motion {
    type Output = Self;
    #[inline]
    fn sub(self, other: Self) -> Self {
        Self {
            angular: self.angular - other.angular,
            linear: self.linear - other.linear,
        }
    }
}

impl AddAssign for Motion {
    #[inline]
    fn add_assign(&mut self, other: Self) {
        self.angular += other.angular;
        self.linear += other.linear;
    }
}

impl Neg for Motion {
    type Output = Self;
    #[inline]
    fn neg(self) -> Self {
        Self {
            angular: -self.angular,
            linear: -self.linear,
        }
    }
}

impl Mul<f64> for Motion {
    type Output = Self;
    #[inline]
    fn mul(self, factor: f64) -> Self {
        Self {
            angular: self.angular * factor,
            linear: self.linear * factor,
        }
    }
}

/// A force vector: torque about a point and force. The same pair holds a momentum (angular about the point, and linear).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Wrench {
    /// Torque about the origin of the frame in use [Nm].
    pub torque: Vec3,
    /// Force [N].
    pub force: Vec3,
}

impl Default for Wrench {
    fn default() -> Self {
        Self::zero()
    }
}

impl Wrench {
    /// No force, no torque.
    #[inline]
    pub fn zero() -> Self {
        Self {
            torque: Vec3::zeros(),
            force: Vec3::zeros(),
        }
    }

    /// A wrench from its force and torque parts, in the order of samples and logs: `[fx fy fz]` [N], `[tx ty tz]` [Nm].
    pub fn from_parts(force: [f64; 3], torque: [f64; 3]) -> Self {
        Self {
            torque: Vec3::from(torque),
            force: Vec3::from(force),
        }
    }

    /// The inverse of [`Wrench::torque_first`].
    pub fn from_torque_first([tx, ty, tz, fx, fy, fz]: [f64; 6]) -> Self {
        Self::from_parts([fx, fy, fz], [tx, ty, tz])
    }

    /// The six components in the order of regressors' rows and offsets, `[tx ty tz fx fy fz]` [Nm, N].
    pub fn torque_first(&self) -> [f64; 6] {
        let (n, f) = (&self.torque, &self.force);
        [n.x, n.y, n.z, f.x, f.y, f.z]
    }

    /// The six components in the order of samples and logs, `[fx fy fz tx ty tz]` [N, Nm].
    pub fn force_first(&self) -> [f64; 6] {
        [
            self.force.x,
            self.force.y,
            self.force.z,
            self.torque.x,
            self.torque.y,
            self.torque.z,
        ]
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

impl Add for Wrench {
    type Output = Self;
    #[inline]
    fn add(self, other: Self) -> Self {
        Self {
            torque: self.torque + other.torque,
            force: self.force + other.force,
        }
    }
}

impl Sub for Wrench {
    type Output = Self;
    #[inline]
    fn sub(self, other: Self) -> Self {
        Self {
            torque: self.torque - other.torque,
            force: self.force - other.force,
        }
    }
}

impl AddAssign for Wrench {
    #[inline]
    fn add_assign(&mut self, other: Self) {
        self.torque += other.torque;
        self.force += other.force;
    }
}

impl SubAssign for Wrench {
    #[inline]
    fn sub_assign(&mut self, other: Self) {
        self.torque -= other.torque;
        self.force -= other.force;
    }
}

impl Neg for Wrench {
    type Output = Self;
    #[inline]
    fn neg(self) -> Self {
        Self {
            torque: -self.torque,
            force: -self.force,
        }
    }
}

impl Mul<f64> for Wrench {
    type Output = Self;
    #[inline]
    fn mul(self, factor: f64) -> Self {
        Self {
            torque: self.torque * factor,
            force: self.force * factor,
        }
    }
}

/// Six numbers from two vectors: [angular; linear] or [torque; force].
#[inline]
pub(crate) fn stack(upper: &Vec3, lower: &Vec3) -> Vector6<f64> {
    Vector6::new(upper.x, upper.y, upper.z, lower.x, lower.y, lower.z)
}

/// Pose of one frame in another: `x_ab` takes coordinates in `b` to coordinates in `a`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Rotation `r_ab`: its columns are the axes of `b` in `a`.
    pub rotation: Mat3,
    /// Origin of `b` in `a` [m].
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

    /// A pose from the URDF's `xyz` [m] and `rpy` [rad]: fixed-axis roll, pitch, yaw, `R = Rz(yaw) Ry(pitch) Rx(roll)`.
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

    // `#[inline(always)]` here and below: as the crate grew, the compiler began to call these, and the kinematic pass took a third longer.
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

/// `a * b`, written out: nalgebra's loops over rows and columns are not unrolled here, and the kinematic pass took a fifth longer.
#[inline(always)]
fn product(a: &Mat3, b: &Mat3) -> Mat3 {
    let at = |i: usize, j: usize| a[(i, 0)] * b[(0, j)] + a[(i, 1)] * b[(1, j)] + a[(i, 2)] * b[(2, j)];
    #[rustfmt::skip]
    let product = Mat3::new(
        at(0, 0), at(0, 1), at(0, 2),
        at(1, 0), at(1, 1), at(1, 2),
        at(2, 0), at(2, 1), at(2, 2),
    );
    product
}

impl Mul for Pose {
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

/// Inertia of a rigid body about the origin of its link frame, in link axes: the ten inertial parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RigidInertia {
    /// Mass [kg].
    pub mass: f64,
    /// First moment `h = m c` [kg m].
    pub first_moment: Vec3,
    /// Tensor of inertia about the origin of the link frame, not about the centre of mass [kg m^2].
    pub inertia: Mat3,
}

/// Why an inertia is not that of a body that can exist.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Inconsistency {
    /// The mass is not positive [kg].
    Mass(f64),
    /// The least eigenvalue of the tensor of inertia about the centre of mass is negative [kg m^2].
    NotPositive {
        /// The eigenvalue.
        least: f64,
    },
    /// Principal moments about the centre of mass break the triangle inequality, greatest <= sum of the others [kg m^2].
    Triangle {
        /// The three principal moments, ascending.
        moments: [f64; 3],
    },
}

impl RigidInertia {
    /// No mass.
    pub fn zero() -> Self {
        Self {
            mass: 0.0,
            first_moment: Vec3::zeros(),
            inertia: Mat3::zeros(),
        }
    }

    /// From mass [kg], centre of mass in link axes [m], and the tensor of inertia about the centre of mass in link axes [kg m^2]
    /// (the parallel-axis theorem: `I_O = I_c + m (c.c 1 - c c^T)`).
    pub fn from_centroidal(mass: f64, centre: &Vec3, inertia: &Mat3) -> Self {
        let shift = Mat3::from_diagonal_element(centre.dot(centre)) - centre * centre.transpose();
        Self {
            mass,
            first_moment: centre * mass,
            inertia: inertia + shift * mass,
        }
    }

    /// Whether every component is finite.
    pub fn is_finite(&self) -> bool {
        let mut vectors = self.first_moment.iter().chain(self.inertia.iter());
        self.mass.is_finite() && vectors.all(|value| value.is_finite())
    }

    /// From the ten parameters `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]` about the origin of the link.
    pub fn from_parameters(p: &[f64; 10]) -> Self {
        #[rustfmt::skip]
        let inertia = Mat3::new(
            p[4], p[5], p[6],
            p[5], p[7], p[8],
            p[6], p[8], p[9],
        );
        Self {
            mass: p[0],
            first_moment: Vec3::new(p[1], p[2], p[3]),
            inertia,
        }
    }

    /// The ten parameters, in the order of [`RigidInertia::from_parameters`].
    pub fn parameters(&self) -> [f64; 10] {
        let (h, i) = (&self.first_moment, &self.inertia);
        [
            self.mass,
            h.x,
            h.y,
            h.z,
            i[(0, 0)],
            i[(0, 1)],
            i[(0, 2)],
            i[(1, 1)],
            i[(1, 2)],
            i[(2, 2)],
        ]
    }

    /// Centre of mass in link axes [m], where there is mass.
    pub fn centre(&self) -> Option<Vec3> {
        (self.mass > 0.0).then(|| self.first_moment / self.mass)
    }

    /// The same body described in frame `a`, this being its description in `b`, given `x_ab`.
    pub fn transformed(&self, x_ab: &Pose) -> Self {
        let (r, t) = (&x_ab.rotation, &x_ab.translation);
        let h = r * self.first_moment;
        let turned = r * self.inertia * r.transpose();
        // I_a = I_b + m (t.t 1 - t t^T) + 2 (t.h) 1 - (t h^T + h t^T): the parallel-axis theorem without going through the centre of mass,
        // so that it holds for any ten parameters, zero mass included.
        let diagonal = self.mass * t.dot(t) + 2.0 * t.dot(&h);
        let inertia = turned + Mat3::from_diagonal_element(diagonal)
            - t * t.transpose() * self.mass
            - (t * h.transpose() + h * t.transpose());
        Self {
            mass: self.mass,
            first_moment: h + t * self.mass,
            inertia,
        }
    }

    /// Momentum about the origin of a body that moves with `twist`: `[I omega + h x v; m v - h x omega]`.
    pub fn momentum(&self, twist: &Motion) -> Wrench {
        Wrench {
            torque: self.inertia * twist.angular + self.first_moment.cross(&twist.linear),
            force: twist.linear * self.mass - self.first_moment.cross(&twist.angular),
        }
    }

    /// Net wrench about the origin: everything that acts on the body but gravity [Nm, N].
    ///
    /// `f = m a + alpha x h + omega x (omega x h)`, `n = I alpha + omega x I omega + h x a`; `omega` [rad/s] and `alpha` [rad/s^2] are those of the
    /// body, `a` [m/s^2] the proper acceleration of the link's origin, all in link axes. Source: Featherstone 2008, eq. 2.72, with classical accelerations.
    #[inline(always)]
    pub fn net_wrench(&self, omega: &Vec3, alpha: &Vec3, a: &Vec3) -> Wrench {
        let h = &self.first_moment;
        Wrench {
            torque: self.inertia * alpha + omega.cross(&(self.inertia * omega)) + h.cross(a),
            force: a * self.mass + alpha.cross(h) + omega.cross(&omega.cross(h)),
        }
    }

    /// The 4 x 4 pseudo-inertia `[[Sigma, h], [h^T, m]]`, `Sigma = tr(I)/2 1 - I`: positive definite exactly if the ten parameters are those of a body
    /// with extent in all directions (Wensing, Kim, Slotine 2018).
    pub fn pseudo_inertia(&self) -> Matrix4<f64> {
        let sigma = Mat3::from_diagonal_element(self.inertia.trace() / 2.0) - self.inertia;
        let mut pseudo = Matrix4::zeros();
        pseudo.fixed_view_mut::<3, 3>(0, 0).copy_from(&sigma);
        pseudo.fixed_view_mut::<3, 1>(0, 3).copy_from(&self.first_moment);
        pseudo
            .fixed_view_mut::<1, 3>(3, 0)
            .copy_from(&self.first_moment.transpose());
        pseudo[(3, 3)] = self.mass;
        pseudo
    }

    /// Checks that a body with these parameters can exist: mass > 0, and about the centre of mass a tensor of inertia that is positive semidefinite
    /// and whose principal moments obey the triangle inequality. `tolerance` is relative to the greatest moment (rods and plates sit on the boundary).
    ///
    /// # Errors
    /// The first of the three conditions that fails, with the numbers.
    pub fn check(&self, tolerance: f64) -> Result<(), Inconsistency> {
        if self.mass.is_nan() || self.mass <= 0.0 {
            return Err(Inconsistency::Mass(self.mass));
        }
        let c = self.first_moment / self.mass;
        let shift = (Mat3::from_diagonal_element(c.dot(&c)) - c * c.transpose()) * self.mass;
        let mut moments: [f64; 3] = (self.inertia - shift).symmetric_eigenvalues().into();
        moments.sort_by(f64::total_cmp);
        // Subtracting the parallel-axis part leaves rounding of its size.
        let slack = tolerance * moments[2].abs() + 64.0 * f64::EPSILON * self.inertia.amax();
        if moments[0] < -slack {
            return Err(Inconsistency::NotPositive { least: moments[0] });
        }
        if moments[2] > moments[0] + moments[1] + slack {
            return Err(Inconsistency::Triangle { moments });
        }
        Ok(())
    }
}

impl Add for RigidInertia {
    type Output = Self;
    /// Two bodies fixed to each other, both described in the same frame.
    fn add(self, other: Self) -> Self {
        Self {
            mass: self.mass + other.mass,
            first_moment: self.first_moment + other.first_moment,
            inertia: self.inertia + other.inertia,
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

    fn close(a: &Wrench, b: &Wrench) -> bool {
        (a.torque - b.torque).norm() < 1e-12 * (1.0 + a.torque.norm())
            && (a.force - b.force).norm() < 1e-12 * (1.0 + a.force.norm())
    }

    /// URDF's definition: rotate about fixed x by roll, then fixed y by pitch, then fixed z by yaw.
    #[test]
    fn rpy_is_three_rotations_about_fixed_axes() {
        use nalgebra::Rotation3;
        let (roll, pitch, yaw) = (0.3, -1.1, 2.7);
        let expected = Rotation3::from_axis_angle(&Vec3::z_axis(), yaw)
            * Rotation3::from_axis_angle(&Vec3::y_axis(), pitch)
            * Rotation3::from_axis_angle(&Vec3::x_axis(), roll);
        let got = Pose::from_xyz_rpy([0.0; 3], [roll, pitch, yaw]).rotation;
        assert!((got - expected.matrix()).amax() < 1e-15);
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn power_is_the_same_in_every_frame(x_ab in pose(), angular in vector(), linear in vector(), torque in vector(), force in vector()) {
            let (twist, wrench) = (Motion { angular, linear }, Wrench { torque, force });
            let (twist_a, wrench_a) = (x_ab.twist(&twist), x_ab.wrench(&wrench));
            prop_assert!((twist.dot(&wrench) - twist_a.dot(&wrench_a)).abs() < 1e-11);
            prop_assert!(close(&x_ab.wrench_back(&wrench_a), &wrench));
            prop_assert!(close(&x_ab.inverse().wrench(&wrench_a), &wrench));
            prop_assert!((x_ab.twist_back(&twist_a).linear - linear).norm() < 1e-12);
        }

        /// The derivative of (motion . wrench) carried along by a motion vanishes: crm and crf are dual.
        #[test]
        fn cross_products_are_dual(v in (vector(), vector()), m in (vector(), vector()), f in (vector(), vector())) {
            let (v, m) = (Motion { angular: v.0, linear: v.1 }, Motion { angular: m.0, linear: m.1 });
            let f = Wrench { torque: f.0, force: f.1 };
            prop_assert!((v.cross(&m).dot(&f) + m.dot(&v.cross_wrench(&f))).abs() < 1e-11);
        }

        /// Net wrench from classical accelerations equals I a + v x* I v with spatial ones, a = [alpha; a_O - omega x v_O].
        #[test]
        fn net_wrench_is_featherstones(body in parameters(), omega in vector(), v in vector(), alpha in vector(), a in vector()) {
            let twist = Motion { angular: omega, linear: v };
            let spatial = Motion { angular: alpha, linear: a - omega.cross(&v) };
            let expected = body.momentum(&spatial) + twist.cross_wrench(&body.momentum(&twist));
            prop_assert!(close(&body.net_wrench(&omega, &alpha, &a), &expected));
        }

        /// Momentum is a wrench: computed in b and carried to a, or computed in a from the transformed inertia.
        #[test]
        fn inertia_transforms_as_momentum_does(x_ab in pose(), body in parameters(), angular in vector(), linear in vector()) {
            let twist = Motion { angular, linear };
            let in_a = body.transformed(&x_ab).momentum(&x_ab.twist(&twist));
            let carried = x_ab.wrench(&body.momentum(&twist));
            prop_assert!((in_a.torque - carried.torque).norm() < 1e-11 * (1.0 + carried.torque.norm()));
            prop_assert!((in_a.force - carried.force).norm() < 1e-11 * (1.0 + carried.force.norm()));
            prop_assert_eq!(RigidInertia::from_parameters(&body.parameters()), body);
        }

        /// Motions add, subtract and scale as the space that power is linear on.
        #[test]
        fn power_is_linear_in_motions(m in (vector(), vector()), n in (vector(), vector()), f in (vector(), vector()), factor in -2.0..2.0_f64) {
            let (m, n) = (Motion { angular: m.0, linear: m.1 }, Motion { angular: n.0, linear: n.1 });
            let f = Wrench { torque: f.0, force: f.1 };
            let (a, b) = (m.dot(&f), n.dot(&f));
            let mut sum = m;
            sum += n;
            prop_assert_eq!(sum, m + n);
            for (got, expected) in [((m + n).dot(&f), a + b), ((m - n).dot(&f), a - b), ((-m).dot(&f), -a), ((m * factor).dot(&f), a * factor)] {
                prop_assert!((got - expected).abs() < 1e-12);
            }
        }

        /// The check agrees with the definition: the pseudo-inertia is positive semidefinite.
        #[test]
        fn consistency_is_a_positive_pseudo_inertia(mass in 0.01..5.0_f64, c in vector(), d in prop::array::uniform3(0.001..1.0_f64), x in pose()) {
            let body = RigidInertia::from_centroidal(mass, &c, &Mat3::from_diagonal(&Vec3::from(d))).transformed(&x);
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
        assert!(matches!(flat([1.0, -1.0, 1.0]), Err(Inconsistency::NotPositive { .. })));
        assert!(matches!(flat([1.0, 1.0, 2.1]), Err(Inconsistency::Triangle { .. })));
        assert_eq!(flat([1.0, 1.0, 2.0]), Ok(()), "a flat plate is on the boundary");
    }
}
