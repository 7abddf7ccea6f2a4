//! From positions, velocities and accelerations to wrenches: kinematics from any base, inverse dynamics, and the reordered recursive Newton-Euler algorithm.
//!
//! ```text
//! joint state, motion of the base -> Kinematics: pose, motion and net wrench of every link
//!                                      -> InverseDynamics: known external wrenches in, torques and F/T readings out (simulation, tests)
//!                                      -> Solver: F/T readings in, torques and unknown contact wrenches out, sub-tree by sub-tree
//! ```
//!
//! - [`Kinematics`] starts at any link, the *base*, whose motion is known: it stands still, or carries an IMU ([`FrameMotion`]). The base may change at run time.
//! - [`Structure`] is the robot cut at its F/T sensors into sub-trees, with the places where the environment may touch it; built once.
//! - [`Solver`] balances each sub-tree: what its links need, less what its F/T sensors measure, must come from its contacts. Then every joint torque follows.
//!
//! Notation and signs: [`crate::spatial`].
//!
//! # How it is laid out
//! Link states lie in one array in the order of the model (parents first, limbs contiguous). The kinematic pass works in link axes, where
//! inertia is constant, and ends with each link's net wrench in *base coordinates*. From there on nothing is transformed any more: wrenches of
//! sub-trees, of F/T sensors and of contacts are about one point and in one set of axes, so that accumulating them is adding them, and no sub-tree needs
//! a root of its own. This is what "reordering" the recursion for the contact link comes to. Nothing allocates after construction.

mod kinematics;
mod least;
mod solver;
mod structure;

pub use kinematics::{ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics};
pub use solver::{Balance, Certainty, ContactEstimate, Solver};
pub use structure::{
    BitSet, ContactKind, ContactSet, ContactSpec, Dependence, DofSet, LinkSet, Noise, Route, SensorCut, SensorSet,
    Structure, StructureError, SubTree,
};

/// Why a computation was refused; nothing was changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DynamicsError {
    /// A slice, or an object made for another model, has another size than needed.
    #[error("{what}: {got} given, {expected} needed")]
    Size {
        /// Of what.
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
    /// There is no such link.
    #[error("there is no link {0}")]
    NoLink(usize),
}

fn check_size(what: &'static str, got: usize, expected: usize) -> Result<(), DynamicsError> {
    if got == expected {
        Ok(())
    } else {
        Err(DynamicsError::Size { what, got, expected })
    }
}
