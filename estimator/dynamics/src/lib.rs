//! Rigid-body dynamics for robots with force/torque sensors inside their limbs: kinematics from
//! any base, joint torques, contact wrenches, and the regressors and base parameters that
//! identification needs.
//!
//! # Stages
//! 1. *Model.* [`model::Model`] is read from a URDF: a tree of rigid bodies and joints. Fixed
//!    joints are folded, except those that carry F/T sensors.
//! 2. *Kinematics.* [`Kinematics`] takes joint positions, velocities and accelerations and the
//!    motion of one link, the *base* ([`FrameMotion`]). The base stands still or carries an IMU; it
//!    may change at run time. The result is the pose, the motion and the net wrench of every link.
//! 3. *Inverse dynamics.* [`InverseDynamics`] computes joint torques from known external wrenches
//!    (recursive Newton-Euler, for simulation and tests). [`Solver`] computes torques and unknown
//!    contact wrenches from F/T readings. It works on a [`Structure`]: the robot cut at its F/T
//!    sensors into sub-trees, with the places where the environment may touch it. It balances each
//!    sub-tree: the net wrench of its links, minus what its F/T sensors measure, is the wrench of
//!    its contacts. Every joint torque follows, from either side of its joint where both sides
//!    determine it ([`Sides`]). [`EquationOfMotion`] has the matrices: inertia, coupling and bias
//!    for any base. Jacobians are with [`Kinematics`].
//! 4. *Regressors.* [`regressor`] expresses the same wrenches and torques as linear functions of
//!    the inertial parameters and of the F/T offsets: [`regressor::Regressor`],
//!    [`regressor::StackedRegressor`] (for identification), [`regressor::MotorRegressor`].
//!    [`regressor::EstimateRows`] carries a covariance of the parameters to torques and contact
//!    wrenches.
//! 5. *Base parameters.* [`regressor::identifiable::Identifiable`] computes which combinations of
//!    the parameters and offsets are identifiable.
//!
//! [`calibration`] has the calibration of an F/T sensor, [`LeastSquares`] the weighted solution of
//! six equations. Notation, frames, units and signs are defined in [`spatial`]; every module uses
//! them.
//!
//! # Data layout
//! Link states are in one array in the order of the model: parents first, limbs contiguous. The
//! kinematic pass works in link axes, where inertia is constant, and ends with the net wrench of
//! each link in *base coordinates*. After that nothing is transformed: the wrenches of sub-trees,
//! F/T sensors and contacts are about one point and in one set of axes, so they are accumulated by
//! addition, and no sub-tree needs its own root. This is how the reordered recursion (towards the
//! contact link) is implemented. Nothing allocates after construction.
//!
//! # Sources of the speed
//! - Fixed joints are folded when the model is read ([`model`]): iCub V2.5's 213 links become 33
//!   bodies, or 39 with the six F/T joints kept.
//! - There is one pass along the tree, in link axes; after it wrenches are only added, in base
//!   coordinates. [`Solver`], [`InverseDynamics`] and the regressors share one [`Kinematics`]:
//!   poses, motions and net wrenches are computed once per sample.
//! - Quantities that depend on no other link are computed before that pass: sines and cosines four
//!   at a time, and the pose of each joint, with short cuts for axes along x, y or z (two columns
//!   of a rotation change instead of nine numbers). This keeps the dependency chain along the tree
//!   short.
//! - Joints, inertias and link states are plain arrays in the order in which they are visited;
//!   names and limits are stored elsewhere. The data of a humanoid fit the first-level cache.
//! - A single full wrench in a sub-tree needs no linear solve: it is the imbalance, moved to the
//!   contact.
//!
//! Measured with `cargo bench -p proprio-dynamics --bench dynamics` on one core of a shared
//! two-core virtual machine (AMD EPYC, Zen 4), iCub V2.5, 32 degrees of freedom, another state at
//! every call, fastest of interleaved runs [us]; "v3" is `-C target-cpu=x86-64-v3`, "native" is
//! `-C target-cpu=native`:
//!
//! | | plain x86-64 | v3 | native |
//! |---|---|---|---|
//! | kinematics, 33 bodies | 1.3 | 1.1 | 1.5 |
//! | inverse dynamics from joint states (RNEA): the same and torques | 1.5 | 1.4 | 1.7 |
//! | full cycle, 39 bodies: kinematics, seven full contact wrenches, torques | 2.3 | 2.1 | 2.5 |
//! | the same with all standard deviations | 4.1 | 3.5 | 3.9 |
//!
//! Comparison with other libraries, all on one core in one interleaved run with equal outputs
//! (`tests/peers/run`; idle two-core virtual machine, Intel Xeon with AVX-512). Least / median of
//! 100 rounds \[us\]; in brackets the ratio of the medians to ours, built native (n) or plain (p).
//! RNEA is with 33 bodies; the full cycle is with 39 bodies, 7 wrenches and 32 torques:
//!
//! | | RNEA, base standing | RNEA, base moving | full cycle |
//! |---|---|---|---|
//! | ours, plain x86-64 | 1.49 / 1.61 | 1.51 / 1.64 | 2.06 / 2.22 |
//! | ours, native | 1.65 / 1.75 | 1.65 / 1.74 | 2.38 / 2.63 |
//! | Pinocchio 4.1.0, native | 3.66 / 4.01 (2.3 n) | 3.81 / 4.22 (2.4 n) | |
//! | dynibo 0.5.3, native | 1.59 / 1.71 (0.98 n, 1.06 p) | 1.64 / 1.77 (1.02 n, 1.08 p) | |
//! | iDynTree 15.1.0, wheel | 5.96 / 6.39 (4.0 p) | 5.93 / 6.42 (3.9 p) | 21.13 / 22.77 (10.3 p) |
//!
//! Our native build is slower than the plain one: AVX-512 does not pay for 3-vectors.
//!
//! Cost grows linearly from 8 to 500 links: 43 to 47 ns per link for RNEA on chains and on binary
//! trees, 53 to 57 for the full cycle on limbs of eight.
//!
//! Tried and rejected: link-time optimisation (no gain), one code-generation unit (slower), the
//! recursion in base axes (slower), visiting the tree breadth first (no gain), two links in one
//! vector register for the net wrenches (no gain: gathering costs what it saves). Choosing AVX2 at
//! run time was not tried: the gain would be below that of the "v3" column, because `wide` chooses
//! its instructions at compile time.

pub mod calibration;
mod equation;
mod error;
mod kinematics;
mod least_squares;
pub mod model;
pub mod regressor;
mod solver;
pub mod spatial;
mod structure;

pub use equation::EquationOfMotion;
pub use error::{DynamicsError, check_size};
pub use kinematics::{ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics};
pub use least_squares::{LeastSquares, noise_factor};
pub use solver::{
    Balance, Certainty, ContactEstimate, Disagreement, SideTorque, Sides, Solver, unknowns,
};
pub use structure::{
    BitSet, ContactKind, ContactSet, ContactSpec, Dependence, DofSet, LinkSet, Noise, Route,
    SensorCut, SensorSet, Structure, StructureError, SubTree,
};
