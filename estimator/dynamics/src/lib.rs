#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

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
