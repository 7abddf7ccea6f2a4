//! Rigid-body dynamics for robots with force/torque (F/T) sensors inside their limbs: kinematics
//! from any base, joint torques, contact wrenches, and the regressors and base parameters that
//! identification needs. `examples/dynamics.rs` is a program of 20 lines.
//!
//! # Stages
//! 1. [`model::Model::from_urdf`]: a URDF becomes a tree of rigid bodies and joints. Fixed joints
//!    are folded, except those that carry F/T sensors.
//! 2. [`Structure::new`]: the robot is cut at its F/T sensors into sub-trees, with the places where
//!    the environment may touch it.
//! 3. [`Kinematics::update`]: joint positions, velocities and accelerations and the motion of one
//!    link, the *base* ([`FrameMotion`]), become the pose, the motion and the net wrench of every
//!    link. The base stands still or carries an IMU; it may change at run time.
//! 4. [`Solver::solve`]: F/T readings become joint torques and unknown contact wrenches. The net
//!    wrench of a sub-tree's links, minus what its F/T sensors measure, is the wrench of its
//!    contacts ([`LeastSquares`]). Every joint torque follows. [`Solver::update_deviations`] adds
//!    the standard deviations due to noise.
//! 5. [`regressor`]: the same wrenches and torques as linear functions of the inertial parameters
//!    and the F/T offsets.
//! 6. [`regressor::identifiable::Identifiable::new`]: which combinations of parameters and offsets
//!    are identifiable, the *base parameters*.
//!
//! Without F/T sensors, [`InverseDynamics::update`] takes the place of 2 and 4 (recursive
//! Newton-Euler with known external wrenches). [`calibration`] is the calibration of an F/T sensor.
//!
//! # Notation
//! ```text
//! x_ab = (R, t)      pose of frame b in frame a: p_a = R p_b + t
//! [n; f]             wrench: torque, then force; of a joint: by the parent on the child
//! a                  proper acceleration (a link at rest: minus gravity); there is no world frame
//! m, h, I            mass, first moment m c, inertia about the origin of the link, in its axes
//! tau = Y(q, dq, ddq) phi    phi = [m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz] per link
//! ```
//! SI units. [`spatial`] defines all of it. Nothing allocates after construction. Speeds are in
//! docs/book/src/figures/speed.md.

pub mod calibration;
mod error;
mod kinematics;
mod least_squares;
pub mod model;
mod place_errors;
pub mod regressor;
mod solver;
pub mod spatial;
mod structure;

pub use error::{DynamicsError, check_size};
pub use kinematics::{ExternalWrench, FrameMotion, InverseDynamics, JointState, Kinematics};
pub use least_squares::{LeastSquares, noise_factor};
pub use place_errors::{PlaceErrors, PlaceStd};
pub use solver::{Balance, ContactSolution, Determinacy, Solver, unknowns};
pub use structure::{
    BitSet, ContactKind, ContactSet, ContactSpec, Dependence, DofSet, LinkSet, Noise, Route,
    SensorCut, SensorSet, Structure, StructureError, SubTree,
};
