//! Errors of computations.

/// Why a computation was refused. Nothing has been changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DynamicsError {
    /// A slice has the wrong length, or an object was made for another model.
    #[error("{what}: {got} given, {expected} needed")]
    Size {
        /// What has this size.
        what: &'static str,
        /// How many were given.
        got: usize,
        /// How many are needed.
        expected: usize,
    },
    /// A number is NaN or infinite.
    #[error("{what} {index} is not finite")]
    NotFinite {
        /// What it belongs to.
        what: &'static str,
        /// Which one.
        index: usize,
    },
    /// A number is finite but too large to compute with.
    #[error("{what} {index} is too large to compute with")]
    OutOfRange {
        /// What it belongs to.
        what: &'static str,
        /// Which one.
        index: usize,
    },
    /// A present contact with fewer than six unknowns, or one beside measured torques, at a place
    /// where the identifiable subspace has no closed form ([`crate::regressor::identifiable`]).
    #[error("the identifiable subspace with contact {0} is not known in closed form")]
    Contact(usize),
    /// There is no such link.
    #[error("there is no link {0}")]
    NoLink(usize),
    /// An index out of range: of a sub-tree, a degree of freedom, a contact or a component of a
    /// wrench.
    #[error("index {index} is out of range: there are {count} {what}")]
    Index {
        /// What the index counts, in the plural.
        what: &'static str,
        /// The index.
        index: usize,
        /// How many of these there are.
        count: usize,
    },
    /// The solver has no solution for these kinematics: it has not solved yet, or its last solution
    /// is for other poses of the links.
    #[error("the solver has no solution for these kinematics")]
    NotSolved,
}

/// Checks the size of an object or a list.
///
/// # Errors
/// The sizes differ.
pub fn check_size(what: &'static str, got: usize, expected: usize) -> Result<(), DynamicsError> {
    if got == expected {
        Ok(())
    } else {
        Err(DynamicsError::Size {
            what,
            got,
            expected,
        })
    }
}

/// Checks several sizes: what each is of, the one given and the one needed.
pub(crate) fn check_sizes<const N: usize>(
    sizes: [(&'static str, usize, usize); N],
) -> Result<(), DynamicsError> {
    let mut sizes = sizes.into_iter();
    sizes.try_for_each(|(what, got, expected)| check_size(what, got, expected))
}
