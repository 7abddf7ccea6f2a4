//! The prior on the links' inertia from CAD, with a weight that the data choose, and the most
//! probable bodies under data and prior.
//!
//! The ten parameters `phi` of a link belong to a physical body exactly if its 4 x 4 pseudo-inertia
//! `J` is positive definite ([`RigidInertia::pseudo_inertia`]). The distance from CAD's `J0` is the
//! log-det divergence (Lee, Wensing, Park, "Geometric robot dynamic identification", T-RO 2020):
//!
//! ```text
//! D(J || J0) = tr(J0^-1 J) - log det(J0^-1 J) - 4     >= 0, convex, infinite at the boundary
//! cost(x)    = 1/2 |R x - z|^2 + sum_l D(J_l || J0_l) / (2 tau^2) + 1/2 sum_i p_i s_i^2
//! x          = [d = phi - phi_CAD | s]
//! ```
//!
//! `[R | z]` is the square root of the data's information without any prior. `s` are extra
//! parameters that belong to no link, with Gaussian priors of precision `p_i`. `D` does not depend
//! on the frame or the units of a link: it is invariant under `J -> T J T^T`. So `tau` has no unit,
//! and one number serves all links of all robots: a link scaled by `1 + e` as a whole costs about
//! `e^2 / tau^2`.
//!
//! # Coordinates
//! With `J0 = C C^T` and `J = C (1 + U) C^T`, the coordinates of a link are the ten entries of the
//! symmetric `U`. In them the Hessian of the prior at CAD is the unit matrix:
//! `D = tr U - log det(1 + U) = 1/2 |U|^2 - ...`, and at `U` it is
//! `K -> (1 + U)^-1 K (1 + U)^-1`. A column-pivoted QR of the data in these coordinates gives
//! `R = Q diag(s) T`, with `T` unit triangular and entries of order one. With
//! `y = T u` a Newton step solves
//!
//! ```text
//! (diag(s)^2 + T^-T H T^-1) dy = -gradient
//! ```
//!
//! Here data of any weight, zero and 1e9 together, appear on the diagonal alone, so that a Cholesky
//! factorisation is as exact as its rounded entries. If a body comes within a thousandth of the
//! boundary, the coordinates are rebuilt about it (`C` becomes its own root). The cost is convex
//! and self-concordant, so that Newton's method with backtracking converges from CAD for any data.
//! If its first step would leave the feasible set, it follows the central path from a larger weight
//! of the prior.
//!
//! # The weight
//! [`MapEstimate::next_tau`] maximises the evidence. The prior in the ten parameters of a link,
//! `exp(-D / (2 tau^2))`, is a Wishart distribution (`n = 5 + 1/tau^2` degrees of freedom, scale
//! `tau^2 J0`, mode at CAD). Its mean divergence is known:
//!
//! ```text
//! e(tau) = 20 tau^2 - sum_{i=0..3} digamma((n - i) / 2) - 4 log(2 tau^2)
//! ```
//!
//! It is `10 tau^2` for small `tau`, and 1.5 times that at `tau = 1`.
//!
//! By Laplace's approximation of the posterior, the evidence is stationary where the divergence
//! equals that mean, for as many parameters as the data determine: `D = (gamma / 10) e(tau)`,
//! `gamma = tr(R^T R (R^T R + H / (2 tau^2))^-1)` (MacKay's effective number). With the quadratic
//! form of `D`, `e = 10 tau^2`, this is `tau^2 = D / gamma = d^T M d / (2 gamma)`, `M = hess D`.
//! The mean of the Wishart distribution corrects the bias of that form: on bodies drawn from the
//! prior with tau = 0.5 and 0.8 the form gives 0.55 and 0.96, this rule 0.50 and 0.81 (medians;
//! `tau 0.1`: 0.094 both).
//!
//! Two assumptions on `tau` precede the data. It is at most 1, since CAD is worth at least one
//! sample per parameter. And `ln tau ~ N(ln tau_0, s^2)`, worth `1 / (2 s^2)` parameters, where
//! `tau_0` is the usual distance of a CAD model from its robot and `s = ln 1.5` the uncertainty of
//! that ([`Prior::with_relative_std`]). So data without information leave `tau` there, where D /
//! gamma would be 0 / 0. For a CAD of unknown quality `tau_0` is 1, the weakest assumption, and `s`
//! is 1.
//!
//! # Speed
//! One round needs one QR, `O(n^3)`, and about five Newton steps with a matrix product and a
//! Cholesky factorisation each; one or two from the previous solution. All factorisations use
//! matrix products on blocks. To measure: `cargo bench -p proprio-identification --bench prior`.

mod posterior;

use std::f64::consts::FRAC_1_SQRT_2;

use nalgebra::{Matrix4, SMatrix, SVector, SymmetricEigen};

use proprio_dynamics::spatial::{Mat3, RigidInertia};

pub use posterior::{MapEstimate, Posterior};

type Matrix10 = SMatrix<f64, 10, 10>;
type Vector10 = SVector<f64, 10>;

/// The least mass of a link in CAD \[kg\]. Smaller masses are raised.
pub const LEAST_MASS: f64 = 0.02;

/// The least radius of gyration in CAD, in any direction about the centre of mass \[m\]. Smaller
/// ones are raised.
pub const LEAST_RADIUS: f64 = 0.02;

/// The greatest weight `tau`, which also is the default without knowledge of CAD's quality.
pub const GREATEST_TAU: f64 = 1.0;

/// Unknown quality of CAD: data without information leave `tau` at its greatest.
const UNKNOWN_QUALITY: Expected = Expected {
    median: GREATEST_TAU,
    log_std: 1.0,
};

/// Uncertainty factor of the stated quality of CAD: two of three CAD models are within it. It is
/// worth three parameters that the data determine. So a log of one slow motion, which determines
/// two, does not make links of twice their mass credible.
const QUALITY_FACTOR: f64 = 1.5;

/// The least `tau`: CAD right to a hundredth of a per cent.
const LEAST_TAU: f64 = 1e-4;

/// Why there is no fit.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PriorError {
    /// Sizes do not match.
    #[error(
        "the data have {found} {what} instead of {expected}: ten per link and one per extra \
         parameter are needed"
    )]
    Size {
        /// The quantity.
        what: &'static str,
        /// Its number.
        found: usize,
        /// The required number.
        expected: usize,
    },
    /// The link does not exist.
    #[error("there is no link {link}: the prior is for {count} links")]
    NoLink {
        /// The requested number.
        link: usize,
        /// Number of links.
        count: usize,
    },
    /// A link occurs twice.
    #[error("link {0} is among the unknowns twice")]
    Twice(usize),
    /// A number is not finite, or a precision or weight not positive.
    #[error("{what} is {value}, which cannot be used for a fit")]
    Number {
        /// The quantity.
        what: &'static str,
        /// The number.
        value: f64,
    },
    /// Neither the data nor a prior determine an extra parameter.
    #[error("neither data nor prior determine the extra parameters: give each of them a precision")]
    Undetermined,
}

/// CAD values of a link that no body of its size can have, and that were raised before use.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Floor {
    /// The link.
    pub link: usize,
    /// Its mass in CAD \[kg\]; raised if below [`LEAST_MASS`].
    pub mass: f64,
    /// The least second moment of mass about the centre of mass in CAD, over all directions [kg
    /// m^2].
    pub second_moment: f64,
    /// Number of principal directions in which the second moment was raised to mass times
    /// [`LEAST_RADIUS`] squared.
    pub directions: usize,
}

impl Floor {
    /// Text for a person, given the link's name.
    pub fn describe(&self, name: &str) -> String {
        let mut what = Vec::new();
        if self.mass < LEAST_MASS {
            what.push(format!(
                "a mass of {:.4} kg, raised to {LEAST_MASS} kg in the prior",
                self.mass
            ));
        }
        if self.directions > 0 {
            let (count, least) = (self.directions, self.second_moment);
            what.push(format!(
                "a least second moment of mass of {least:.2e} kg m^2, raised in {count} of 3 \
                 directions to that of a radius of gyration of {LEAST_RADIUS} m"
            ));
        }
        format!("the URDF gives link '{name}' {}", what.join(" and "))
    }
}

/// The prior of one link.
#[derive(Clone, Debug)]
struct Centre {
    /// CAD as given.
    cad: Vector10,
    /// CAD after flooring: the divergence is zero there.
    reference: RigidInertia,
    /// `C`, `J0 = C C^T`. Its lower right 1 x 1 is the root of the mass, its upper left 3 x 3 the
    /// root of the second moments about the centre of mass.
    root: Matrix4<f64>,
    /// `phi -> U`, without its constant part.
    whiten: Matrix10,
    /// Its inverse.
    parameters: Matrix10,
}

/// CAD's inertia of every link of a robot, as the centre of a prior.
///
/// `D` is relative to floored CAD ([`Prior::floors`]). Parameters `d` are always relative to CAD as
/// given.
#[derive(Clone, Debug)]
pub struct Prior {
    centres: Vec<Centre>,
    floors: Vec<Floor>,
    expected: Expected,
}

/// The prior of `tau`: `ln tau ~ N(ln median, log_std^2)`.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Expected {
    median: f64,
    log_std: f64,
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
            expected: UNKNOWN_QUALITY,
        })
    }

    /// With a stated quality of CAD: masses and second moments have the relative error `relative`,
    /// to a factor of 1.5. That is `tau = relative / sqrt 2` ([`crate::prior::link_cad_root`]).
    /// Zero: CAD is exact.
    #[must_use]
    pub fn with_relative_std(self, relative: f64) -> Self {
        self.with_quality(relative, QUALITY_FACTOR.ln())
    }

    /// As [`Prior::with_relative_std`], with the quality known to a factor of e only: whole logs
    /// tell it better than whoever stated it.
    ///
    /// To a factor of 1.5, noise and prior settle where CAD's error is blamed on the noise: an arm
    /// whose CAD is worse than stated had an error of 11 % on held-out torques, where least squares
    /// has 9 % and no statement at all 4.5 %. Without any, half of a KUKA's postures predict the
    /// others 10 to 14 % worse.
    pub(crate) fn with_roughly(self, relative: f64) -> Self {
        self.with_quality(relative, 1.0)
    }

    fn with_quality(self, relative: f64, log_std: f64) -> Self {
        let median = (relative * FRAC_1_SQRT_2).clamp(LEAST_TAU, GREATEST_TAU);
        let expected = Expected { median, log_std };
        Self { expected, ..self }
    }

    /// `tau` without data.
    pub(crate) fn expected_tau(&self) -> f64 {
        self.expected.median
    }

    /// Number of links.
    pub fn link_count(&self) -> usize {
        self.centres.len()
    }

    /// The links whose CAD had to be raised.
    pub fn floors(&self) -> &[Floor] {
        &self.floors
    }

    /// The reference of a link, where its divergence is zero: floored CAD.
    ///
    /// # Panics
    /// If the link does not exist, as in all methods with a link.
    pub fn reference(&self, link: usize) -> &RigidInertia {
        &self.centres[link].reference
    }

    /// The divergence of a body from CAD; infinite if `phi` is not physical.
    pub fn divergence(&self, link: usize, phi: &[f64; 10]) -> f64 {
        divergence(&self.stretch(link, phi))
    }

    /// The Hessian at [`Prior::reference`], `M_ab = tr(J0^-1 E_a J0^-1 E_b)`: `D = 1/2 d^T M d` to
    /// second order.
    pub fn metric(&self, link: usize) -> SMatrix<f64, 10, 10> {
        self.centres[link].whiten.transpose() * self.centres[link].whiten
    }

    /// `U`, for `J = C (1 + U) C^T`.
    fn stretch(&self, link: usize, phi: &[f64; 10]) -> Matrix4<f64> {
        let centre = &self.centres[link];
        unpack(
            &(centre.whiten
                * (Vector10::from(*phi) - Vector10::from(centre.reference.parameters()))),
        )
    }
}

/// CAD's body with the least mass and extent; the root of its pseudo-inertia; and the report if
/// anything was raised.
fn floored(link: usize, body: &RigidInertia) -> (RigidInertia, Matrix4<f64>, Option<Floor>) {
    let mass = body.mass.max(LEAST_MASS);
    let centre = body.centre().unwrap_or_default();
    let pseudo = body.pseudo_inertia();
    let given: Mat3 = pseudo.fixed_view::<3, 3>(0, 0) - centre * body.first_moment.transpose();
    let eigen = SymmetricEigen::new((given + given.transpose()) / 2.0);
    let least = mass * LEAST_RADIUS * LEAST_RADIUS;
    let values = eigen.eigenvalues.iter();
    let directions = values.filter(|&&value| value < least).count();
    let raised = eigen.eigenvalues.map(|value| value.max(least).sqrt());
    let extent = eigen.eigenvectors * Mat3::from_diagonal(&raised);

    let mut root = Matrix4::zeros();
    root.fixed_view_mut::<3, 3>(0, 0).copy_from(&extent);
    root.fixed_view_mut::<3, 1>(0, 3)
        .copy_from(&(centre * mass.sqrt()));
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

/// The places of the different entries of a symmetric matrix.
#[rustfmt::skip]
const PLACES: [(usize, usize); 10] = [
    (0, 0), (0, 1), (0, 2), (0, 3), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 3),
];

/// The entries of a symmetric matrix as ten numbers with the same norm: off-diagonal entries are
/// multiplied by the root of two.
fn pack(matrix: &Matrix4<f64>) -> Vector10 {
    let entry = |(i, j): (usize, usize)| match i == j {
        true => matrix[(i, i)],
        false => (matrix[(i, j)] + matrix[(j, i)]) * FRAC_1_SQRT_2,
    };
    PLACES.map(entry).into()
}

/// The inverse of [`pack`].
fn unpack(packed: &Vector10) -> Matrix4<f64> {
    let mut matrix = Matrix4::zeros();
    for (value, (i, j)) in packed.iter().zip(PLACES) {
        let scale = if i == j { 1.0 } else { FRAC_1_SQRT_2 };
        matrix[(i, j)] = value * scale;
        matrix[(j, i)] = value * scale;
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

/// The `tau` at which the evidence is stationary: `(gamma / 10) e(tau) + tau^2 ln tau = D`, where
/// the middle term is that of `ln tau ~ N(0, 1)`.
fn stationary_tau(divergence: f64, effective: f64, expected: Expected) -> f64 {
    let of_prior = |tau: f64| (tau / expected.median).ln() / (expected.log_std * expected.log_std);
    let slope = |tau: f64| {
        effective / 10.0 * mean_divergence(tau) / (tau * tau) + of_prior(tau)
            - divergence / (tau * tau)
    };
    let (mut low, mut high) = (LEAST_TAU.ln(), GREATEST_TAU.ln());
    if slope(GREATEST_TAU) <= 0.0 {
        return GREATEST_TAU;
    }
    if slope(LEAST_TAU) >= 0.0 {
        return LEAST_TAU;
    }
    // Every term of the slope grows with tau.
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
        // The terms below cancel here; the next term of the series is a ten-thousandth of it.
        return 10.0 * square;
    }
    let freedom = 5.0 + 1.0 / square;
    let logs = (0..4).map(|i| digamma((freedom - f64::from(i)) / 2.0));
    20.0 * square - logs.sum::<f64>() - 4.0 * (2.0 * square).ln()
}

/// The derivative of `ln Gamma` for positive arguments: its asymptotic series (Abramowitz, Stegun
/// 6.3.18) beyond 10, its recurrence below.
fn digamma(mut x: f64) -> f64 {
    let mut value = 0.0;
    while x < 10.0 {
        value -= 1.0 / x;
        x += 1.0;
    }
    let s = 1.0 / (x * x);
    value + x.ln() - 0.5 / x - s * (1.0 / 12.0 - s * (1.0 / 120.0 - s * (1.0 / 252.0 - s / 240.0)))
}

/// The uncertainty of a URDF's values of a link: ten rows `U` with `U^T U` the covariance of its
/// ten parameters.
///
/// With the pseudo-inertia `J = L L^T` of the link, its error is `L S L^T`, `S` symmetric with
/// independent entries, of standard deviation `relative` on the diagonal and `relative / sqrt 2`
/// off it. So the mass, and the second moment of the mass about any plane, have the relative
/// standard deviation `relative`. The standard deviation of the centre of mass is that share, over
/// the root of two, of the body's radius of gyration. None of this depends on the frame. It is the
/// quadratic form of the log-det divergence, the prior of identification (Lee, Wensing, Park 2020):
/// `d^T P^-1 d = tr((J^-1 dJ)^2) / relative^2`. So it equals the prior of [`crate::prior`] with
/// `tau = relative / sqrt 2` to second order. Bodies lighter than [`LEAST_MASS`] or thinner than
/// [`LEAST_RADIUS`] are raised to these; otherwise the place of a point mass would be exact.
#[must_use]
pub fn link_cad_root(inertia: &RigidInertia, relative: f64) -> SMatrix<f64, 10, 10> {
    let (_, l, _) = floored(0, inertia);
    let mut root = Matrix10::zeros();
    for (row, (i, j)) in PLACES.into_iter().enumerate() {
        let (a, b) = (l.column(i).into_owned(), l.column(j).into_owned());
        let change = if i == j {
            a * a.transpose()
        } else {
            (a * b.transpose() + b * a.transpose()) * FRAC_1_SQRT_2
        } * relative;
        let parameters = Vector10::from(body_of(&change).parameters());
        root.set_row(row, &parameters.transpose());
    }
    root
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
            assert!(
                (digamma(x) - expected).abs() < 1e-12,
                "{x}: {} {expected}",
                digamma(x)
            );
        }
    }

    /// Small weights give the quadratic form's mean; the two branches meet; the rule for tau
    /// inverts the mean.
    #[test]
    fn the_weight_is_where_the_divergence_is_the_expected_one() {
        for tau in [0.0099, 0.0101, 0.03] {
            let ratio = mean_divergence(tau) / (10.0 * tau * tau);
            assert!((ratio - 1.0).abs() < 2.0 * tau * tau, "{tau}: {ratio}");
        }
        for tau in [0.01, 0.1, 0.4, 0.9] {
            // Enough data that ln tau ~ N(0, 1) does not matter.
            let found = stationary_tau(1e5 * mean_divergence(tau), 1e6, UNKNOWN_QUALITY);
            assert!((found / tau - 1.0).abs() < 1e-4, "{tau}: {found}");
        }
        assert_eq!(
            stationary_tau(0.0, 0.0, UNKNOWN_QUALITY).to_bits(),
            GREATEST_TAU.to_bits()
        );
        assert_eq!(
            stationary_tau(1e9, 10.0, UNKNOWN_QUALITY).to_bits(),
            GREATEST_TAU.to_bits()
        );
        assert_eq!(
            stationary_tau(0.0, 1e3, UNKNOWN_QUALITY).to_bits(),
            LEAST_TAU.to_bits()
        );
    }
}
