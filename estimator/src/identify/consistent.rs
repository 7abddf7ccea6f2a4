//! From what the data alone say, without any prior, to the nearest set of bodies that can exist; and whether there is one at all.
//!
//! Least squares knows nothing of bodies: its base parameters may ask for a negative mass somewhere in every choice of the parameters that it leaves open. Given the
//! data's information `[R | z]` over the links' parameters, of any rank (information about base parameters `pi = B^T phi` is `R = R_pi B^T`), this finds
//!
//! ```text
//! min 1/2 |R d - z|^2    over all sets of bodies, J_l positive semidefinite
//! ```
//!
//! and, among those that attain it, the one nearest to CAD by the log-det divergence ([`super::prior`]): what the data do not see stays as in CAD, in the measure that is
//! the same in every frame. It is the limit of the fit with a prior as the prior's weight goes to nothing, which is followed (an interior-point method): the
//! problem is convex, its iterates are bodies, it converges from CAD, and it ends within a known distance of the *least* misfit of any bodies, which the
//! verdict needs. (With the log-Cholesky parametrisation of Rucker and Wensing, RA-L 2022, bodies are bodies too, but the problem is not convex any more and has
//! its infeasible answers at infinity; a descent that ends there proves nothing.)
//!
//! # Verdict
//! If the truth is a set of bodies, `|R d - z|^2` there exceeds its unconstrained least by a chi-square variable with as many degrees of freedom as `R` has
//! rank, and the least over all bodies is not above that. So an excess that such a variable exceeds in one of a thousand cases says: no bodies have these
//! parameters. Usually that is a wrong sign or frame of a sensor, a joint's zero, a mass that is not in the model, or noise that is greater than stated.
//! Rarely one in a thousand false alarms: an excess only comes from the constraints that bind.
//!
//! Which link it is follows from the multipliers of the constraints, `weight (1 + U_l)^-1`: how much the misfit would fall if `J_l` could be a little negative.

use nalgebra::{DMatrix, DVector, Matrix4, SymmetricEigen, Vector4};

use super::hypothesis::needed;
use super::prior::{CENTRED, Posterior, Prior, PriorError};
use crate::spatial::{RigidInertia, Vec3};

/// Of two links that bind, the one that matters less than this share of all is not named.
const LEAST_SHARE: f64 = 0.05;

/// What of a body would have to be negative.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lacking {
    /// Its mass.
    Mass,
    /// Its extent: the second moment of mass along this unit vector of the link's axes.
    Extent(Vec3),
}

/// A link that keeps the data from being fitted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Violation {
    /// The link.
    pub link: usize,
    /// What binds.
    pub lacking: Lacking,
    /// How much of all that binds, from 0 to 1.
    pub share: f64,
    /// What the data ask for there if nothing forbids it, as a multiple of CAD's: of the mass, or of the second moment.
    pub asked: f64,
}

/// Whether bodies with the identified parameters can exist.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Verdict {
    /// They can, within the data's uncertainty.
    Feasible,
    /// They can not. The links that bind, most binding first.
    Infeasible(Vec<Violation>),
    /// The search did not end.
    Undecided,
}

/// The bodies nearest to what the data say.
#[derive(Clone, Debug)]
pub struct Consistent {
    /// `[d | s]`: parameters less CAD as given, ten per link; further unknowns.
    pub x: DVector<f64>,
    /// The links' bodies, in the order of the columns.
    pub bodies: Vec<RigidInertia>,
    /// By how much `|R x - z|^2` exceeds its least over all parameters, those of impossible bodies included: squared standard deviations.
    pub excess: f64,
    /// The excess above which the verdict is [`Verdict::Infeasible`].
    pub limit: f64,
    /// How many combinations of the links' parameters the data see.
    pub rank: usize,
    /// See [Verdict](self#verdict).
    pub verdict: Verdict,
    /// Newton steps taken.
    pub iterations: usize,
}

impl Consistent {
    /// How far the data are from the nearest bodies, in standard deviations.
    pub fn deviations(&self) -> f64 {
        self.excess.sqrt()
    }

    /// The verdict as a sentence for a person, given the links' names.
    pub fn describe<'a>(&self, name: impl Fn(usize) -> &'a str) -> String {
        let (sigma, limit) = (self.deviations(), self.limit.sqrt());
        match &self.verdict {
            Verdict::Feasible => format!(
                "bodies with the identified parameters can exist ({sigma:.1} standard deviations away, {limit:.1} would be too many)"
            ),
            Verdict::Undecided => {
                "whether bodies with the identified parameters can exist was not decided: the search did not end"
                    .to_owned()
            }
            Verdict::Infeasible(violations) => {
                let links: Vec<_> = violations
                    .iter()
                    .map(|violation| violation.describe(name(violation.link)))
                    .collect();
                format!(
                    "no bodies have the identified parameters (the nearest are {sigma:.1} standard deviations away, {limit:.1} is the limit): {}. Check the \
                     signs and frames of the F/T sensors, the joints' zeros and the masses in the URDF",
                    links.join("; ")
                )
            }
        }
    }
}

impl Violation {
    fn describe(&self, link: &str) -> String {
        let asked = self.asked;
        match self.lacking {
            Lacking::Mass => format!("link '{link}' would need {asked:.2} times its mass"),
            Lacking::Extent(axis) => format!(
                "link '{link}' would need {asked:.2} times its extent (second moment of mass) along [{:.2} {:.2} {:.2}] of its frame",
                axis.x, axis.y, axis.z
            ),
        }
    }
}

/// The nearest bodies to data `[R | z]`, any number of whitened rows without a prior; columns, and the precision of further unknowns, as for [`Posterior::new`].
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
    // What is known of the further unknowns counts as data: only the weight of CAD goes to nothing.
    let (rows, further) = (data.nrows(), precision.len());
    let mut stacked = data.clone().resize(rows + further, data.ncols(), 0.0);
    for (index, &precision) in precision.iter().enumerate() {
        let column = data.ncols().saturating_sub(further) + index;
        if column < data.ncols() {
            stacked[(rows + index, column)] = precision.sqrt();
        }
    }
    let padded = right.clone().resize_vertically(right.len() + further, 0.0);
    let posterior = Posterior::new(prior, links, &stacked, &padded, &vec![0.0; further])?;
    follow(&posterior, further)
}

/// Lowers the prior's weight until what it may still add to the misfit is nothing.
fn follow(posterior: &Posterior, further: usize) -> Result<Consistent, PriorError> {
    let links = posterior.links().len();
    let mut state = posterior.start();
    let mut weight = 0.5;
    let mut iterations = 0;
    // What no bodies can be below, by the last weight whose minimum was found.
    let mut least = 0.0;
    let descent = loop {
        let descent = posterior.descend(&mut state, weight, CENTRED * weight)?;
        iterations += descent.iterations;
        // Of |R x - z|^2, above that of the best bodies: twice four barrier parameters per link times the weight, a quarter more for a minimum that is found but nearly; and by how much the divergence's
        // trace differs there, times the weight, which is nothing beside it in the end.
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
    let rank = posterior.rank().saturating_sub(further);
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
fn violations(posterior: &Posterior, inverses: &[Matrix4<f64>]) -> Result<Vec<Violation>, PriorError> {
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
            asked: direction.dot(&(unbounded[position] * direction)),
        });
    }
    for violation in &mut found {
        violation.share /= total;
    }
    found.retain(|violation| violation.share >= LEAST_SHARE);
    found.sort_by(|a, b| b.share.total_cmp(&a.share));
    Ok(found)
}
