//! Results of the solver: contact wrenches, balances, and their certainty.

use crate::spatial::Wrench;

/// The basis of a result.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Determinacy {
    /// Measurements and the model.
    Determined,
    /// Also a choice. Either the contacts have more unknowns than the six equations determine, and
    /// the solution of least norm was taken; or nothing measures the wrench that holds the
    /// sub-tree, and its imbalance was left as it is.
    Assumed,
    /// The contact is not present; its wrench is zero by declaration.
    Absent,
}

/// The wrench of one contact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContactSolution {
    /// The wrench by the environment on the link, in the axes and about the origin of the contact's
    /// frame.
    pub wrench: Wrench,
    /// Standard deviations from F/T noise, `[fx fy fz tx ty tz]` [N, Nm]; see
    /// [`crate::Solver::update_deviations`].
    pub deviation: [f64; 6],
    /// Its basis.
    pub certainty: Determinacy,
}

impl ContactSolution {
    pub(crate) fn absent() -> Self {
        Self {
            wrench: Wrench::zero(),
            deviation: [0.0; 6],
            certainty: Determinacy::Absent,
        }
    }
}

/// The residual of the six equations of a sub-tree.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Balance {
    /// The part of the net wrench that neither sensors nor contacts explain, about the origin and
    /// in the axes of the sub-tree's top link.
    pub residual: Wrench,
    /// The residual squared, weighted by the inverse covariance of F/T noise: chi-square
    /// distributed if the model is correct and there is no undeclared contact. `None` if no sensor
    /// measures the sub-tree.
    pub chi_square: Option<f64>,
    /// Its degrees of freedom: six minus the rank of the unknowns.
    pub degrees: usize,
}
