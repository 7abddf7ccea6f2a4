//! The nearest set of physical bodies to parameters from the data alone, and whether the data allow
//! any.
//!
//! Least squares ignores physical consistency: its base parameters may require a negative mass
//! somewhere, for every choice of the parameters that it leaves open. Given the data's information
//! `[R | z]` about the links' parameters, of any rank (information about base parameters `pi = B^T
//! phi` is `R = R_pi B^T`), this module solves
//!
//! ```text
//! min 1/2 |R d - z|^2    over all sets of bodies, J_l positive semidefinite
//! ```
//!
//! and takes, among the minima, the one nearest to CAD by the log-det divergence
//! ([`crate::prior`]): directions that the data do not determine keep their CAD values, independent
//! of the frame. It is the limit of the fit with a prior as the prior's weight goes to zero. An
//! interior-point method follows this limit: the problem is convex, its iterates are physical
//! bodies, it converges from CAD, and it ends within a known distance of the *least* misfit of any
//! bodies, which the verdict needs. (With the log-Cholesky parametrisation of Rucker and Wensing,
//! RA-L 2022, bodies are physical too, but the problem is not convex and has its infeasible
//! solutions at infinity. A descent that ends there proves nothing.)
//!
//! # Verdict
//! If the true parameters are physical, `|R d - z|^2` at them exceeds its unconstrained minimum by
//! a chi-square variable with rank(R) degrees of freedom, and the minimum over all bodies is not
//! above that. So the parameters are infeasible if the excess is above the 0.999 quantile of that
//! variable. The usual cause is a wrong sign or frame of a sensor, a joint's encoder offset, a mass
//! missing in the model, or noise above the stated one. False alarms are rarer than one in a
//! thousand, since only binding constraints cause an excess.
//!
//! The link at fault follows from the multipliers of the constraints, `weight (1 + U_l)^-1`: how
//! much the misfit would fall if `J_l` could be slightly negative.

use nalgebra::{DMatrix, DVector, Matrix4, SymmetricEigen, Vector4};

use crate::hypothesis::needed;
use crate::prior::{CENTRED, Posterior, Prior, PriorError};
use proprio_dynamics::spatial::{RigidInertia, Vec3};

/// Binding links with a smaller share than this are not reported.
const LEAST_SHARE: f64 = 0.05;

/// The quantity of a body that would have to be negative.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lacking {
    /// Its mass.
    Mass,
    /// Its extent: the second moment of mass along this unit vector of the link's axes.
    Extent(Vec3),
}

/// A link whose constraint prevents a fit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Violation {
    /// The link.
    pub link: usize,
    /// The binding quantity.
    pub lacking: Lacking,
    /// Its share of all binding constraints, from 0 to 1.
    pub share: f64,
    /// The value that the data require without constraints, as a multiple of CAD's: of the mass, or
    /// of the second moment.
    pub required: f64,
}

/// Whether physical bodies with the identified parameters exist.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Verdict {
    /// They exist, within the data's uncertainty.
    Feasible,
    /// They do not exist. The links that bind, most binding first.
    Infeasible(Vec<Violation>),
    /// The search did not converge.
    Undecided,
}

/// The physical bodies nearest to the data.
#[derive(Clone, Debug)]
pub struct Consistent {
    /// `[d | s]`: parameters minus CAD as given, ten per link; extra parameters.
    pub x: DVector<f64>,
    /// The links' bodies, in the order of the columns.
    pub bodies: Vec<RigidInertia>,
    /// Excess of `|R x - z|^2` over its minimum over all parameters, impossible bodies included:
    /// squared standard deviations.
    pub excess: f64,
    /// The excess above which the verdict is [`Verdict::Infeasible`].
    pub limit: f64,
    /// Number of combinations of the links' parameters that the data determine.
    pub rank: usize,
    /// See [Verdict](self#verdict).
    pub verdict: Verdict,
    /// Newton steps taken.
    pub iterations: usize,
}

impl Consistent {
    /// Distance of the data from the nearest bodies, in standard deviations.
    pub fn deviations(&self) -> f64 {
        self.excess.sqrt()
    }

    /// The verdict as text for a person, given the links' names.
    pub fn describe<'a>(&self, name: impl Fn(usize) -> &'a str) -> String {
        let (sigma, limit) = (self.deviations(), self.limit.sqrt());
        match &self.verdict {
            Verdict::Feasible => format!(
                "the identified parameters are physically consistent ({sigma:.1} standard \
                 deviations from the nearest bodies, limit {limit:.1})"
            ),
            Verdict::Undecided => {
                "the physical consistency of the identified parameters is unknown: the search did \
                 not converge"
                    .to_owned()
            }
            Verdict::Infeasible(violations) => {
                let links: Vec<_> = violations
                    .iter()
                    .map(|violation| violation.describe(name(violation.link)))
                    .collect();
                format!(
                    "the identified parameters are not physically consistent ({sigma:.1} standard \
                     deviations from the nearest bodies, limit {limit:.1}): {}. Check the signs \
                     and frames of the F/T sensors, the encoder offsets and the masses in the URDF",
                    links.join("; ")
                )
            }
        }
    }
}

impl Violation {
    fn describe(&self, link: &str) -> String {
        let required = self.required;
        match self.lacking {
            Lacking::Mass => format!("link '{link}' would need {required:.2} times its mass"),
            Lacking::Extent(axis) => format!(
                "link '{link}' would need {required:.2} times its extent (second moment of mass) \
                 along [{:.2} {:.2} {:.2}] of its frame",
                axis.x, axis.y, axis.z
            ),
        }
    }
}

/// The nearest bodies to data `[R | z]`, any number of whitened rows without a prior. Columns, and
/// the precision of extra parameters, as for [`Posterior::new`].
///
/// # Errors
/// As for [`Posterior::new`] and [`Posterior::fit`].
pub fn nearest(
    prior: &Prior,
    links: &[usize],
    data: &DMatrix<f64>,
    right: &DVector<f64>,
    precision: &[f64],
) -> Result<Consistent, PriorError> {
    // Priors of extra parameters count as data: only the weight of CAD goes to zero.
    let (rows, extra) = (data.nrows(), precision.len());
    let mut stacked = data.clone().resize(rows + extra, data.ncols(), 0.0);
    for (index, &precision) in precision.iter().enumerate() {
        let column = data.ncols().saturating_sub(extra) + index;
        if column < data.ncols() {
            stacked[(rows + index, column)] = precision.sqrt();
        }
    }
    let padded = right.clone().resize_vertically(right.len() + extra, 0.0);
    let posterior = Posterior::new(prior, links, &stacked, &padded, &vec![0.0; extra])?;
    follow(&posterior, extra)
}

/// Lowers the prior's weight until its possible contribution to the misfit is negligible.
fn follow(posterior: &Posterior, extra: usize) -> Result<Consistent, PriorError> {
    let links = posterior.links().len();
    let mut state = posterior.start();
    let mut weight = 0.5;
    let mut iterations = 0;
    // Lower bound of the excess of any bodies, by the last weight whose minimum was found.
    let mut least = 0.0;
    let descent = loop {
        let descent = posterior.descend(&mut state, weight, CENTRED * weight)?;
        iterations += descent.iterations;
        // Bound on |R x - z|^2 above that of the best bodies: twice four barrier parameters per
        // link times the weight, and a quarter more for an approximate minimum. (The change of the
        // divergence's trace, times the weight, is negligible beside it in the end.)
        let gap = 1.25 * 8.0 * links as f64 * weight;
        if descent.is_converged {
            least = state.excess() - gap;
        }
        if gap <= 1e-7 + 1e-4 * state.excess() || !descent.is_converged {
            let descent = posterior.descend(&mut state, weight, 1e-12 * weight)?;
            iterations += descent.iterations;
            break descent;
        }
        weight *= 0.1;
    };
    let excess = state.excess();
    let fit = posterior.finish(state, descent, (0.5 / weight).sqrt());
    let rank = posterior.rank().saturating_sub(extra);
    let limit = needed(rank, 1);
    let verdict = if excess <= limit {
        Verdict::Feasible
    } else if least > limit {
        Verdict::Infeasible(violations(posterior, &fit.inverses)?)
    } else {
        Verdict::Undecided
    };
    Ok(Consistent {
        x: fit.x,
        bodies: fit.bodies,
        excess,
        limit,
        rank,
        verdict,
        iterations,
    })
}

/// The links whose constraints bind, given `(1 + U)^-1` of all.
fn violations(
    posterior: &Posterior,
    inverses: &[Matrix4<f64>],
) -> Result<Vec<Violation>, PriorError> {
    let unbounded = posterior.unbounded()?;
    let mut found = Vec::new();
    let mut total = 0.0;
    for (position, inverse) in inverses.iter().enumerate() {
        let eigen = SymmetricEigen::new(*inverse);
        let (index, _) = eigen.eigenvalues.argmax();
        let direction: Vector4<f64> = eigen.eigenvectors.column(index).into_owned();
        let share = inverse.trace();
        total += share;
        let plane = posterior.plane(position, &direction).xyz();
        let is_mass = direction.w * direction.w > 0.5;
        found.push(Violation {
            link: posterior.links()[position],
            lacking: match plane.try_normalize(0.0) {
                Some(axis) if !is_mass => Lacking::Extent(axis),
                _ => Lacking::Mass,
            },
            share,
            required: direction.dot(&(unbounded[position] * direction)),
        });
    }
    for violation in &mut found {
        violation.share /= total;
    }
    found.retain(|violation| violation.share >= LEAST_SHARE);
    found.sort_by(|a, b| b.share.total_cmp(&a.share));
    Ok(found)
}
