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
//! - [`EquationOfMotion`] has the matrices: inertia, coupling and bias for any base; Jacobians are with [`Kinematics`].
//! - [`Solver`] balances each sub-tree: what its links need, less what its F/T sensors measure, must come from its contacts. Then every joint torque
//!   follows; where a joint can be had from both sides, from either ([`Sides`]).
//!
//! Notation and signs: [`crate::spatial`].
//!
//! # How it is laid out
//! Link states lie in one array in the order of the model (parents first, limbs contiguous). The kinematic pass works in link axes, where
//! inertia is constant, and ends with each link's net wrench in *base coordinates*. From there on nothing is transformed any more: wrenches of
//! sub-trees, of F/T sensors and of contacts are about one point and in one set of axes, so that accumulating them is adding them, and no sub-tree needs
//! a root of its own. This is what "reordering" the recursion for the contact link comes to. Nothing allocates after construction.
//!
//! # Where the speed comes from
//! - Fixed joints are folded when the model is read ([`crate::model`]): iCub V2.5's 213 links are 33 bodies, or 39 with the six F/T joints kept.
//! - One pass along the tree, in link axes; after it wrenches are only added, in base coordinates. [`Solver`], [`InverseDynamics`] and the
//!   regressors share one [`Kinematics`]: poses, motions and net wrenches are computed once per sample, whoever uses them.
//! - What depends on no other link is done before that pass: sines and cosines four at a time, and each joint's pose, with short cuts for axes along x, y or
//!   z (two columns of a rotation change instead of nine numbers). Little is left in the chain where each link waits for the one before it.
//! - Joints, inertias and link states are plain arrays in the order in which they are visited; names and limits lie elsewhere. All of a humanoid fits the
//!   first-level cache.
//! - A single full wrench in a sub-tree needs no solving: it is the imbalance, moved to the contact.
//!
//! Measured with `cargo bench -p proprio-estimator --bench dynamics` on one core of a shared two-core virtual machine (AMD EPYC, Zen 4), iCub V2.5, 32 degrees of
//! freedom, another state at every call, fastest of interleaved runs [us]:
//!
//! | | plain x86-64 | `-C target-cpu=x86-64-v3` | `-C target-cpu=native` |
//! |---|---|---|---|
//! | kinematics, 33 bodies | 1.3 | 1.1 | 1.5 |
//! | inverse dynamics from joint states (RNEA): the same and torques | 1.5 | 1.4 | 1.7 |
//! | full cycle, 39 bodies: kinematics, seven full contact wrenches, torques | 2.3 | 2.1 | 2.5 |
//! | the same with all standard deviations | 4.1 | 3.5 | 3.9 |
//!
//! Beside other libraries, all on one core in one interleaved run with equal outputs (`tests/peers/run`; idle two-core virtual machine, Intel Xeon with AVX-512; least and
//! median of 100 rounds \[us\], and their time as a multiple of ours, of the medians):
//!
//! | | ours, plain x86-64 | ours, native | Pinocchio 4.1.0, native | dynibo 0.5.3, native | iDynTree 15.1.0, its wheel |
//! |---|---|---|---|---|---|
//! | RNEA, 33 bodies, base standing | 1.49 / 1.61 | 1.65 / 1.75 | 3.66 / 4.01 (2.3 x native) | 1.59 / 1.71 (0.98 x native, 1.06 x plain) | 5.96 / 6.39 (4.0 x plain) |
//! | RNEA, base moving | 1.51 / 1.64 | 1.65 / 1.74 | 3.81 / 4.22 (2.4 x) | 1.64 / 1.77 (1.02 x native, 1.08 x plain) | 5.93 / 6.42 (3.9 x) |
//! | full cycle, 39 bodies, 7 wrenches, 32 torques | 2.06 / 2.22 | 2.38 / 2.63 | | | 21.13 / 22.77 (10.3 x plain) |
//!
//! The native build is the slower of ours: AVX-512 does not pay for 3-vectors.
//!
//! Cost grows linearly from 8 to 500 links: 43 to 47 ns per link for RNEA on chains and on binary trees, 53 to 57 for the full cycle on limbs of eight.
//!
//! Tried there and left out: link-time optimisation (no gain), one code-generation unit (slower), the recursion in base axes (slower), visiting the tree breadth
//! first (no gain), two links in one vector register for the net wrenches (no gain: gathering costs what it saves). Choosing AVX2 at run time was not tried: it
//! would gain less than the second column does, for `wide` chooses its instructions when it is compiled.

mod equation;
mod kinematics;
mod least;
mod solver;
mod structure;

pub use equation::EquationOfMotion;
pub use kinematics::{ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics};
pub(crate) use kinematics::{check_external, check_readings};
pub(crate) use least::{LeastSquares, noise_factor, scale_factor};
pub(crate) use solver::unknowns;
pub use solver::{Balance, Certainty, ContactEstimate, Disagreement, SideTorque, Sides, Solver};
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
    /// A number is finite, but too large to compute with.
    #[error("{what} {index} is too large to compute with")]
    OutOfRange {
        /// What it belongs to.
        what: &'static str,
        /// Which one.
        index: usize,
    },
    /// A rotation is not orthonormal, or a reflection.
    #[error("{what} {index} has a rotation that is none")]
    NoRotation {
        /// What it belongs to.
        what: &'static str,
        /// Which one.
        index: usize,
    },
    /// A present contact that has fewer than six unknowns, or stands beside measured torques, and is not where the identifiable subspace has a closed form
    /// ([`crate::regressor::identifiable`]).
    #[error("what contact {0} hides is not known in closed form")]
    Contact(usize),
    /// There is no such link.
    #[error("there is no link {0}")]
    NoLink(usize),
    /// A number as great as the count of what it numbers, or greater: of a sub-tree, a degree of freedom, a contact, a component of a wrench.
    #[error("there is no number {index}: there are {count} {what}")]
    Index {
        /// What is numbered, in the plural.
        what: &'static str,
        /// The number asked for.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// A solver has nothing to tell of these kinematics: it has not solved yet, or last for other poses of the links.
    #[error("the solver has no solution for these kinematics")]
    NotSolved,
}

/// Refuses an object made for another model, or a list of another length.
pub(crate) fn check_size(what: &'static str, got: usize, expected: usize) -> Result<(), DynamicsError> {
    if got == expected {
        Ok(())
    } else {
        Err(DynamicsError::Size { what, got, expected })
    }
}
