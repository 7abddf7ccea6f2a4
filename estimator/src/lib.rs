//! Samples in, joint torques and contact wrenches out.
//!
//! ```text
//! samples -> Pipeline: every channel at each stamp T of the trigger channel
//!                -> Kinematics -> net wrenches -> Solver, sub-tree by sub-tree -> torques, contact wrenches
//! ```
//!
//! - [`config`]: estimator.toml, as typed; [`setup`]: the same, checked against the URDF and resolved.
//! - [`calibration`]: gain and temperature of an F/T sensor, before its offset.
//! - [`spatial`]: motion and force vectors, rigid transforms, rigid-body inertia; the notation page of the crate.
//! - [`model`]: an undirected tree of links from a URDF; massless frames folded; F/T joints kept.
//! - [`dynamics`]: kinematics from any base, sub-trees cut at the F/T sensors, reordered recursive Newton-Euler.
//! - [`regressor`]: wrenches and torques as linear functions of the inertial parameters, and which of these can be identified at all.
//! - [`identify`]: the parameters themselves, from what the sensors measure while the robot moves.
//! - [`parameters`]: what was identified, as a file, and as a URDF; how uncertain it is.
//! - [`differentiate`]: position, velocity and acceleration at any instant from noisy, quantised samples; [`history`]: what
//!   is used as measured.
//! - [`pipeline`]: samples in, estimates out; no input, no output, no clock.
//! - [`files`]: files that are replaced whole.
//! - [`offline`]: a table of samples to a table of estimates; [`daemon`]: the same from and to shared memory.
//! - [`check`]: what a configuration comes to; [`assessment`]: how good a run of estimates was; `first_look`: what
//!   can not be in what the daemon receives.

pub mod assessment;
pub mod calibration;
pub mod check;
pub mod config;
pub mod daemon;
pub mod differentiate;
pub mod dynamics;
pub mod files;
mod first_look;
pub mod history;
pub mod identify;
pub mod model;
pub mod offline;
pub mod parameters;
pub mod pipeline;
pub mod regressor;
pub mod setup;
pub mod spatial;
mod statistics;
