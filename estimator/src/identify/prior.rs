//! What CAD says of the links' inertia, as a prior whose weight the data choose; and the best bodies under data and prior together.
//!
//! The ten parameters `phi` of a link are a body's exactly if its 4 x 4 pseudo-inertia `J` is positive definite ([`RigidInertia::pseudo_inertia`]). The distance
//! from CAD's `J0` is the log-det divergence (Lee, Wensing, Park, "Geometric robot dynamic identification", T-RO 2020):
//!
//! ```text
//! D(J || J0) = tr(J0^-1 J) - log det(J0^-1 J) - 4          >= 0, convex, infinite where J stops being a body's
//! cost(x)    = 1/2 |R x - z|^2 + sum_l D(J_l || J0_l) / (2 tau^2) + 1/2 sum_i p_i s_i^2          x = [d = phi - phi_CAD | s]
//! ```
//!
//! `[R | z]` is the square root of the data's information, free of any prior; `s` are unknowns that are no link's (friction), with Gaussian priors of precision
//! `p_i`. `D` does not change if a link is described in another frame or in other units: any `J -> T J T^T` leaves it alone. So `tau` has no unit, and one
//! number does for all links of all robots: to `tau` the whole of a link scaled by `1 + e`, with everything about it, costs `e^2 / tau^2`.
//!
//! # Coordinates
//! With `J0 = C C^T` and `J = C (1 + U) C^T`, the ten entries of the symmetric `U` are what a link's unknowns are here. In them the prior's curvature at CAD is the
//! unit matrix: `D = tr U - log det(1 + U) = 1/2 |U|^2 - ...`, and at `U` it is `K -> (1 + U)^-1 K (1 + U)^-1`. The data are graded in them once
//! by a column-pivoted QR, `R = Q diag(s) T`, `T` unit triangular with entries of order one. With `y = T u` a Newton step solves
//!
//! ```text
//! (diag(s)^2 + T^-T H T^-1) dy = -gradient
//! ```
//!
//! in which data of any weight, none and 1e9 side by side, stand on the diagonal alone: a Cholesky factorization is as exact as its rounded entries. Where a body
//! comes within a thousandth of what can not exist, the same is done anew about it (`C` becomes its own root). The cost is convex and self-concordant: Newton's
//! method with backtracking converges from CAD whatever the data; where its first step would leave the bodies, along the central path, from a larger weight of the prior.
//!
//! # The weight
//! [`Fit::next_tau`] maximises the evidence. The prior in the ten parameters of a link, `exp(-D / (2 tau^2))`, is a Wishart distribution (`n = 5 + 1/tau^2` degrees of
//! freedom, scale `tau^2 J0`, mode at CAD), so that its mean divergence is known,
//!
//! ```text
//! e(tau) = 20 tau^2 - sum_{i=0..3} digamma((n - i) / 2) - 4 log(2 tau^2)          10 tau^2 for small tau, 1.5 times that at tau = 1
//! ```
//!
//! Laplace's approximation of the posterior makes the evidence stationary where the divergence found is that mean, for as many parameters as the data
//! determine: `D = (gamma / 10) e(tau)`, `gamma = tr(R^T R (R^T R + H / (2 tau^2))^-1)` (MacKay's effective number). With the quadratic form of `D`, `e = 10 tau^2`, this is
//! `tau^2 = D / gamma = d^T M d / (2 gamma)`, `M = hess D`; the mean of the Wishart distribution takes away what that form overstates: on bodies drawn from the prior with
//! tau = 0.5 and 0.8 it finds 0.55 and 0.96, this rule 0.50 and 0.81 (medians; `tau 0.1`: 0.094 both).
//!
//! Two things are said of `tau` before any data. It is at most 1, for CAD is worth at least one sample
//! per parameter. And `ln tau ~ N(ln tau_0, s^2)`, worth `1 / (2 s^2)` parameters, where `tau_0` is how
//! far CADs are from robots and `s = ln 1.5` how well that is known ([`Prior::expecting`]). So data that
//! say nothing leave tau there, where D / gamma would be nothing by nothing. Of a CAD of which nothing
//! is said `tau_0` is 1, the weakest claim, and `s` is 1.
//!
//! # Speed
//! One round grades, `O(n^3)` once, and takes some five Newton steps of a matrix product and a Cholesky factorization each; from where the last solution was, one or two. All factors are
//! made of matrix products on blocks. To measure: `cargo bench -p proprio-estimator --bench prior`.

mod blocked;
mod posterior;

use nalgebra::{Matrix4, SMatrix, SVector, SymmetricEigen};

use crate::spatial::{Mat3, RigidInertia};

pub(super) use posterior::CENTRED;
pub use posterior::{Fit, Posterior};

type Matrix10 = SMatrix<f64, 10, 10>;
type Vector10 = SVector<f64, 10>;

/// The least mass of a link that CAD may claim [kg].
pub const LEAST_MASS: f64 = 0.02;

/// The least radius of gyration that CAD may claim, in any direction about the centre of mass [m].
pub const LEAST_RADIUS: f64 = 0.02;

/// The greatest weight `tau`, and the one that nothing known gives.
pub const GREATEST_TAU: f64 = 1.0;

/// Nothing is said of CAD: data that say nothing leave `tau` at its greatest.
const NOTHING: Expected = Expected {
    median: GREATEST_TAU,
    spread: 1.0,
};

/// How many times farther from the robot, or nearer to it, a CAD may well be than it is said to be: two
/// of three are within it. It is worth three parameters that the data determine: a log of one slow motion,
/// which determines two, does not make links of twice their mass credible.
const FACTOR: f64 = 1.5;

/// Below it `tau` is not followed: CAD right to a hundredth of a per cent.
const LEAST_TAU: f64 = 1e-4;

/// What stands against a fit.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PriorError {
    /// Sizes do not go together.
    #[error("the data have {found} {what} where {expected} are needed: ten per link and one per further unknown")]
    Size {
        /// Of what.
        what: &'static str,
        /// What is there.
        found: usize,
        /// What should be.
        expected: usize,
    },
    /// No such link.
    #[error("there is no link {link}: the prior is for {count} links")]
    NoLink {
        /// The number asked for.
        link: usize,
        /// How many there are.
        count: usize,
    },
    /// A link is there twice.
    #[error("link {0} is among the unknowns twice")]
    Twice(usize),
    /// A number is not finite, or a precision or weight not positive.
    #[error("{what} is {value}, which nothing can be fitted with")]
    Number {
        /// What it is.
        what: &'static str,
        /// The number.
        value: f64,
    },
    /// Neither the data nor a prior say anything of a further unknown.
    #[error("neither data nor prior determine the unknowns beyond the links' parameters: give each a precision")]
    Undetermined,
}

/// CAD of a link that no body of some size could have, and that was raised before use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Floor {
    /// The link.
    pub link: usize,
    /// Its mass in CAD [kg]; raised if below [`LEAST_MASS`].
    pub mass: f64,
    /// The least second moment of mass about the centre of mass in CAD, over all directions [kg m^2].
    pub second_moment: f64,
    /// In how many of the three principal directions the second moment was raised to mass times [`LEAST_RADIUS`] squared.
    pub directions: usize,
}

impl Floor {
    /// A sentence for a person, given the link's name.
    pub fn describe(&self, name: &str) -> String {
        let mut what = Vec::new();
        if self.mass < LEAST_MASS {
            what.push(format!(
                "a mass of {:.4} kg, taken as {LEAST_MASS} kg as the centre of the prior",
                self.mass
            ));
        }
        if self.directions > 0 {
            let (count, least) = (self.directions, self.second_moment);
            what.push(format!(
                "{least:.2e} kg m^2 as its least second moment of mass, taken as that of a body with {LEAST_RADIUS} m radius of gyration in {count} of 3 directions"
            ));
        }
        format!("the URDF gives link '{name}' {}", what.join(" and "))
    }
}

/// One link's prior.
#[derive(Clone, Debug)]
struct Centre {
    /// CAD as it was given.
    cad: Vector10,
    /// CAD floored: where the divergence is zero.
    reference: RigidInertia,
    /// `C`, `J0 = C C^T`: lower right 1 x 1 the root of the mass, upper left 3 x 3 that of the second moments about the centre of mass.
    root: Matrix4<f64>,
    /// `phi -> U`, less a constant.
    whiten: Matrix10,
    /// Its inverse.
    parameters: Matrix10,
}

/// CAD's inertia of every link of a robot, as the centre of a prior.
///
/// `D` is about CAD floored ([`Prior::floors`]); parameters `d` are always relative to CAD as it was given.
#[derive(Clone, Debug)]
pub struct Prior {
    centres: Vec<Centre>,
    floors: Vec<Floor>,
    expected: Expected,
}

/// What is known of `tau` before any data: `ln tau ~ N(ln median, spread^2)`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Expected {
    median: f64,
    spread: f64,
}

impl Prior {
    /// From the links' inertia in CAD, each about the origin and in the axes of its link.
    ///
    /// # Errors
    /// A number is not finite.
    pub fn new(cad: &[RigidInertia]) -> Result<Self, PriorError> {
        let mut floors = Vec::new();
        let mut centres = Vec::with_capacity(cad.len());
        for (link, body) in cad.iter().enumerate() {
            let given = Vector10::from(body.parameters());
            check_finite("a parameter of CAD", given.as_slice())?;
            let (reference, root, floor) = floored(link, body);
            floors.extend(floor);
            let inverse = root.try_inverse().ok_or(PriorError::Number {
                what: "the scale of a link in CAD",
                value: root.determinant(),
            })?;
            let mut whiten = Matrix10::zeros();
            for parameter in 0..10 {
                let unit = RigidInertia::from_parameters(&unit(parameter).into()).pseudo_inertia();
                whiten.set_column(parameter, &pack(&(inverse * unit * inverse.transpose())));
            }
            let mut parameters = Matrix10::zeros();
            for index in 0..10 {
                let body = body_of(&(root * unpack(&unit(index)) * root.transpose()));
                parameters.set_column(index, &Vector10::from(body.parameters()));
            }
            centres.push(Centre {
                cad: given,
                reference,
                root,
                whiten,
                parameters,
            });
        }
        Ok(Self {
            centres,
            floors,
            expected: NOTHING,
        })
    }

    /// With what is known of CAD before any data: its masses and second moments are off by the share `relative`, to a
    /// factor of 1.5.
    /// That is `tau = relative / sqrt 2` ([`crate::parameters::cad_root`]). Zero: CAD is exact.
    #[must_use]
    pub fn expecting(self, relative: f64) -> Self {
        let median = (relative * std::f64::consts::FRAC_1_SQRT_2).clamp(LEAST_TAU, GREATEST_TAU);
        let spread = FACTOR.ln();
        let expected = Expected { median, spread };
        Self { expected, ..self }
    }

    /// `tau` before any data.
    pub fn expected_tau(&self) -> f64 {
        self.expected.median
    }

    /// How many links.
    pub fn link_count(&self) -> usize {
        self.centres.len()
    }

    /// The links whose CAD had to be raised.
    pub fn floors(&self) -> &[Floor] {
        &self.floors
    }

    /// Where the divergence of a link is zero: CAD, floored.
    ///
    /// # Panics
    /// There is no such link; as in all methods that take one.
    pub fn reference(&self, link: usize) -> &RigidInertia {
        &self.centres[link].reference
    }

    /// The divergence of a body from CAD; infinite where `phi` is no body's.
    pub fn divergence(&self, link: usize, phi: &[f64; 10]) -> f64 {
        divergence(&self.stretch(link, phi))
    }

    /// Gradient of the divergence by the ten parameters, `tr((J0^-1 - J^-1) E_a)`; not finite where `phi` is no body's.
    pub fn gradient(&self, link: usize, phi: &[f64; 10]) -> [f64; 10] {
        let u = self.stretch(link, phi);
        let inverse = (Matrix4::identity() + u).cholesky().map(|factor| factor.inverse());
        let slope = inverse.map_or(Vector10::repeat(f64::NAN), |inverse| {
            pack(&(Matrix4::identity() - inverse))
        });
        (self.centres[link].whiten.transpose() * slope).into()
    }

    /// Hessian of the divergence by the ten parameters, `tr(J^-1 E_a J^-1 E_b)`; not finite where `phi` is no body's.
    pub fn hessian(&self, link: usize, phi: &[f64; 10]) -> SMatrix<f64, 10, 10> {
        let u = self.stretch(link, phi);
        let root = (Matrix4::identity() + u).cholesky().and_then(|x| x.l().try_inverse());
        let root = root.map_or(Matrix10::repeat(f64::NAN), |p| {
            congruence(&p) * self.centres[link].whiten
        });
        root.transpose() * root
    }

    /// The Hessian at [`Prior::reference`], `M_ab = tr(J0^-1 E_a J0^-1 E_b)`: `D = 1/2 d^T M d` to second order.
    pub fn metric(&self, link: usize) -> SMatrix<f64, 10, 10> {
        self.centres[link].whiten.transpose() * self.centres[link].whiten
    }

    /// `U`, for `J = C (1 + U) C^T`.
    fn stretch(&self, link: usize, phi: &[f64; 10]) -> Matrix4<f64> {
        let centre = &self.centres[link];
        unpack(&(centre.whiten * (Vector10::from(*phi) - Vector10::from(centre.reference.parameters()))))
    }
}

/// CAD's body with at least some mass and extent; the root of its pseudo-inertia; and what was raised.
fn floored(link: usize, body: &RigidInertia) -> (RigidInertia, Matrix4<f64>, Option<Floor>) {
    let mass = body.mass.max(LEAST_MASS);
    let centre = body.centre().unwrap_or_default();
    let pseudo = body.pseudo_inertia();
    let given: Mat3 = pseudo.fixed_view::<3, 3>(0, 0) - centre * body.first_moment.transpose();
    let eigen = SymmetricEigen::new((given + given.transpose()) / 2.0);
    let least = mass * LEAST_RADIUS * LEAST_RADIUS;
    let directions = eigen.eigenvalues.iter().filter(|&&value| value < least).count();
    let raised = eigen.eigenvalues.map(|value| value.max(least).sqrt());
    let extent = eigen.eigenvectors * Mat3::from_diagonal(&raised);

    let mut root = Matrix4::zeros();
    root.fixed_view_mut::<3, 3>(0, 0).copy_from(&extent);
    root.fixed_view_mut::<3, 1>(0, 3).copy_from(&(centre * mass.sqrt()));
    root[(3, 3)] = mass.sqrt();
    let is_raised = directions > 0 || body.mass < LEAST_MASS;
    let floor = is_raised.then(|| Floor {
        link,
        mass: body.mass,
        second_moment: eigen.eigenvalues.min(),
        directions,
    });
    let reference = if is_raised {
        body_of(&(root * root.transpose()))
    } else {
        *body
    };
    (reference, root, floor)
}

/// The ten parameters of a pseudo-inertia.
fn body_of(pseudo: &Matrix4<f64>) -> RigidInertia {
    let sigma: Mat3 = pseudo.fixed_view::<3, 3>(0, 0).into_owned();
    RigidInertia {
        mass: pseudo[(3, 3)],
        first_moment: pseudo.fixed_view::<3, 1>(0, 3).into_owned(),
        inertia: Mat3::from_diagonal_element(sigma.trace()) - sigma,
    }
}

/// The entries of a symmetric matrix as ten numbers with the same norm: those off the diagonal by the root of two.
fn pack(matrix: &Matrix4<f64>) -> Vector10 {
    let mut packed = Vector10::zeros();
    let mut next = 0;
    for row in 0..4 {
        packed[next] = matrix[(row, row)];
        next += 1;
        for column in row + 1..4 {
            packed[next] = (matrix[(row, column)] + matrix[(column, row)]) * std::f64::consts::FRAC_1_SQRT_2;
            next += 1;
        }
    }
    packed
}

/// The inverse of [`pack`].
fn unpack(packed: &Vector10) -> Matrix4<f64> {
    let mut matrix = Matrix4::zeros();
    let mut next = 0;
    for row in 0..4 {
        matrix[(row, row)] = packed[next];
        next += 1;
        for column in row + 1..4 {
            let value = packed[next] * std::f64::consts::FRAC_1_SQRT_2;
            matrix[(row, column)] = value;
            matrix[(column, row)] = value;
            next += 1;
        }
    }
    matrix
}

/// `K -> P K P^T` on packed matrices.
fn congruence(p: &Matrix4<f64>) -> Matrix10 {
    let mut map = Matrix10::zeros();
    for index in 0..10 {
        map.set_column(index, &pack(&(p * unpack(&unit(index)) * p.transpose())));
    }
    map
}

fn unit(index: usize) -> Vector10 {
    let mut unit = Vector10::zeros();
    unit[index] = 1.0;
    unit
}

/// `tr U - log det(1 + U)`, without cancellation near zero.
fn divergence(u: &Matrix4<f64>) -> f64 {
    u.symmetric_eigenvalues()
        .iter()
        .map(|&value| {
            if value > -1.0 {
                value - value.ln_1p()
            } else {
                f64::INFINITY
            }
        })
        .sum()
}

fn check_finite(what: &'static str, values: &[f64]) -> Result<(), PriorError> {
    match values.iter().find(|value| !value.is_finite()) {
        Some(&value) => Err(PriorError::Number { what, value }),
        None => Ok(()),
    }
}

/// The `tau` at which the evidence is stationary: `(gamma / 10) e(tau) + tau^2 ln tau = D`, the middle term from `ln tau ~ N(0, 1)`.
fn stationary_tau(divergence: f64, effective: f64, expected: Expected) -> f64 {
    let of_prior = |tau: f64| (tau / expected.median).ln() / (expected.spread * expected.spread);
    let slope =
        |tau: f64| effective / 10.0 * mean_divergence(tau) / (tau * tau) + of_prior(tau) - divergence / (tau * tau);
    let (mut low, mut high) = (LEAST_TAU.ln(), GREATEST_TAU.ln());
    if slope(GREATEST_TAU) <= 0.0 {
        return GREATEST_TAU;
    }
    if slope(LEAST_TAU) >= 0.0 {
        return LEAST_TAU;
    }
    // It grows with tau, every term of it.
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        if slope(middle.exp()) < 0.0 {
            low = middle;
        } else {
            high = middle;
        }
    }
    (0.5 * (low + high)).exp()
}

/// `e(tau)`: the mean divergence of a link under its prior.
fn mean_divergence(tau: f64) -> f64 {
    let square = tau * tau;
    if tau < 0.01 {
        // Where the terms below cancel; the next one of the series is a ten-thousandth of it.
        return 10.0 * square;
    }
    let freedom = 5.0 + 1.0 / square;
    let logs: f64 = (0..4).map(|i| digamma((freedom - f64::from(i)) / 2.0)).sum();
    20.0 * square - logs - 4.0 * (2.0 * square).ln()
}

/// The derivative of `ln Gamma` for positive arguments: its asymptotic series (Abramowitz, Stegun 6.3.18) beyond 10, its recurrence below.
fn digamma(mut x: f64) -> f64 {
    let mut value = 0.0;
    while x < 10.0 {
        value -= 1.0 / x;
        x += 1.0;
    }
    let s = 1.0 / (x * x);
    value + x.ln() - 0.5 / x - s * (1.0 / 12.0 - s * (1.0 / 120.0 - s * (1.0 / 252.0 - s / 240.0)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digamma_has_its_known_values() {
        let euler = 0.577_215_664_901_532_9;
        let half = -euler - 2.0 * std::f64::consts::LN_2;
        for (x, expected) in [
            (1.0, -euler),
            (2.0, 1.0 - euler),
            (0.5, half),
            (1.5, half + 2.0),
            (2.5, half + 8.0 / 3.0),
        ] {
            assert!((digamma(x) - expected).abs() < 1e-12, "{x}: {} {expected}", digamma(x));
        }
    }

    /// Small weights: the quadratic form's mean; the two branches meet; and the rule for tau inverts it.
    #[test]
    fn the_weight_is_where_the_divergence_is_the_expected_one() {
        for tau in [0.0099, 0.0101, 0.03] {
            let ratio = mean_divergence(tau) / (10.0 * tau * tau);
            assert!((ratio - 1.0).abs() < 2.0 * tau * tau, "{tau}: {ratio}");
        }
        for tau in [0.01, 0.1, 0.4, 0.9] {
            // Enough of it that ln tau ~ N(0, 1) does not matter.
            let found = stationary_tau(1e5 * mean_divergence(tau), 1e6, NOTHING);
            assert!((found / tau - 1.0).abs() < 1e-4, "{tau}: {found}");
        }
        assert_eq!(stationary_tau(0.0, 0.0, NOTHING).to_bits(), GREATEST_TAU.to_bits());
        assert_eq!(stationary_tau(1e9, 10.0, NOTHING).to_bits(), GREATEST_TAU.to_bits());
        assert_eq!(stationary_tau(0.0, 1e3, NOTHING).to_bits(), LEAST_TAU.to_bits());
    }
}
