//! Rigid-body inertia: ten parameters, and the test of their physical consistency.

use crate::spatial::{Mat3, Pose, Vec3, Wrench};
use derive_more::{Add, Sub};
use nalgebra::Matrix4;

/// Inertia of a rigid body about the origin of its link frame, in link axes: the ten inertial
/// parameters. The sum of two bodies described in the same frame is both, fixed to each other.
#[derive(Add, Clone, Copy, Debug, Default, PartialEq, Sub)]
pub struct RigidInertia {
    /// Mass \[kg\].
    pub mass: f64,
    /// First moment `h = m c` [kg m].
    pub first_moment: Vec3,
    /// Tensor of inertia about the origin of the link frame, not about the centre of mass [kg m^2].
    pub inertia: Mat3,
}

/// Why an inertia is not physically consistent: no rigid body has it.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Inconsistency {
    /// The mass is not positive \[kg\].
    #[error("its mass is {0} kg")]
    Mass(f64),
    /// The least eigenvalue of the tensor of inertia about the centre of mass is negative [kg m^2].
    #[error("a principal moment about the centre of mass is {least:.3e} kg m^2")]
    NotPositive {
        /// The eigenvalue.
        least: f64,
    },
    /// The principal moments about the centre of mass violate the triangle inequality, greatest <=
    /// sum of the others [kg m^2].
    #[error(
        "principal moments {:.3e}, {:.3e}, {:.3e} kg m^2 violate the triangle inequality",
        moments[0], moments[1], moments[2]
    )]
    Triangle {
        /// The three principal moments, ascending.
        moments: [f64; 3],
    },
}

impl RigidInertia {
    /// No mass.
    pub fn zero() -> Self {
        Self::default()
    }

    /// From mass \[kg\], centre of mass in link axes \[m\], and the tensor of inertia about the
    /// centre of mass in link axes [kg m^2] (the parallel-axis theorem: `I_O = I_c + m (c.c 1 - c
    /// c^T)`).
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

    /// From the ten parameters `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]` about the
    /// origin of the link.
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

    /// Centre of mass in link axes \[m\]; `None` if the mass is not positive.
    pub fn centre(&self) -> Option<Vec3> {
        (self.mass > 0.0).then(|| self.first_moment / self.mass)
    }

    /// The tensor of inertia about the centre of mass in link axes [kg m^2], the inverse of
    /// [`RigidInertia::from_centroidal`]; about the origin if the mass is not positive.
    pub fn about_centre(&self) -> Mat3 {
        let c = self.centre().unwrap_or_default();
        let shift = Mat3::from_diagonal_element(c.dot(&c)) - c * c.transpose();
        self.inertia - shift * self.mass
    }

    /// The same body in frame `a`; `self` describes it in frame `b`. `x_ab` is the pose of `b` in
    /// `a`.
    pub fn transformed(&self, x_ab: &Pose) -> Self {
        let (r, t) = (&x_ab.rotation, &x_ab.translation);
        let h = r * self.first_moment;
        let turned = r * self.inertia * r.transpose();
        // I_a = I_b + m (t.t 1 - t t^T) + 2 (t.h) 1 - (t h^T + h t^T): the parallel-axis theorem
        // without the centre of mass, so that it holds for any ten parameters, zero mass included.
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

    /// Net wrench about the origin: the sum of all wrenches on the body except gravity [Nm, N].
    ///
    /// `f = m a + alpha x h + omega x (omega x h)`, `n = I alpha + omega x I omega + h x a`;
    /// `omega` [rad/s] and `alpha` [rad/s^2] are those of the body, `a` [m/s^2] the proper
    /// acceleration of the link's origin, all in link axes. Source: Featherstone 2008, eq. 2.72,
    /// with classical accelerations.
    #[inline(always)]
    pub fn net_wrench(&self, omega: &Vec3, alpha: &Vec3, a: &Vec3) -> Wrench {
        let h = &self.first_moment;
        Wrench {
            torque: self.inertia * alpha + omega.cross(&(self.inertia * omega)) + h.cross(a),
            force: a * self.mass + alpha.cross(h) + omega.cross(&omega.cross(h)),
        }
    }

    /// The 4 x 4 pseudo-inertia `[[Sigma, h], [h^T, m]]`, `Sigma = tr(I)/2 1 - I`. It is positive
    /// definite if and only if the ten parameters are those of a body with extent in all directions
    /// (Wensing, Kim, Slotine 2018).
    pub fn pseudo_inertia(&self) -> Matrix4<f64> {
        let sigma = Mat3::from_diagonal_element(self.inertia.trace() / 2.0) - self.inertia;
        let mut pseudo = Matrix4::zeros();
        pseudo.fixed_view_mut::<3, 3>(0, 0).copy_from(&sigma);
        pseudo
            .fixed_view_mut::<3, 1>(0, 3)
            .copy_from(&self.first_moment);
        pseudo
            .fixed_view_mut::<1, 3>(3, 0)
            .copy_from(&self.first_moment.transpose());
        pseudo[(3, 3)] = self.mass;
        pseudo
    }

    /// Checks physical consistency: mass > 0, and a tensor of inertia about the centre of mass that
    /// is positive semidefinite and whose principal moments satisfy the triangle inequality.
    /// `tolerance` is relative to the greatest moment (rods and plates are on the boundary).
    ///
    /// # Errors
    /// The first of the three conditions that fails, with the numbers.
    pub fn check(&self, tolerance: f64) -> Result<(), Inconsistency> {
        if self.mass.is_nan() || self.mass <= 0.0 {
            return Err(Inconsistency::Mass(self.mass));
        }
        let mut moments: [f64; 3] = self.about_centre().symmetric_eigenvalues().into();
        moments.sort_by(f64::total_cmp);
        // Subtracting the parallel-axis part leaves rounding errors of its size.
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
