//! The estimator: samples of joints, IMU and force/torque (F/T) sensors in, joint torques and
//! contact wrenches out, with their standard deviations and whether they are valid.
//!
//! # Stages
//! 1. Samples: each channel sends stamped readings. [`daemon`] takes them from shared memory,
//!    [`offline`] from a log.
//! 2. Pipeline ([`pipeline::Pipeline`]): each stamp `t` of the trigger channel is an instant. The
//!    pipeline waits for the other channels, then interpolates or differentiates each one at `t`,
//!    corrects F/T readings for calibration, temperature and offset, and tests their residuals.
//! 3. Kinematics ([`proprio_dynamics::Kinematics`]): pose, motion and net wrench of every link.
//! 4. Solver ([`proprio_dynamics::Solver`]): balances each sub-tree between F/T sensors and solves
//!    for its contact wrenches.
//! 5. Torques: the solver's joint torques, with standard deviations from noise, parameters
//!    ([`propagation`]) and motion, are published if they are valid.
//!
//! With identification on, the pipeline also feeds [`proprio_identification::online`], which
//! updates inertial parameters and F/T offsets once a second.
//!
//! # Modules
//! - Input: [`config`] is estimator.toml as typed, [`setup`] is the same checked against the URDF
//!   with every name resolved, and [`reading`] reads logs.
//! - Pipeline: [`pipeline`] does no input or output and reads no clock. [`history`] interpolates,
//!   [`differentiate`] differentiates.
//! - Parameters: [`inertial`] holds the parameters in use, [`parameters`] is the file
//!   parameters.toml, [`export`] writes it from an identification result.
//! - Uncertainty: [`propagation`] turns the covariance of the parameters into standard deviations.
//! - Programs: [`daemon`] and [`offline`] run the pipeline, [`check`] and `description` print what
//!   `--check` shows, [`assessment`] measures the accuracy of a run, `first_look` tests the first
//!   samples for implausible readings, [`files`] replaces files atomically.
//!
//! Notation, frames and signs: [`proprio_dynamics::spatial`].

pub mod assessment;
pub mod check;
pub mod config;
pub mod daemon;
mod description;
pub mod differentiate;
pub mod export;
pub mod files;
mod first_look;
pub mod history;
pub mod inertial;
pub mod offline;
pub mod parameters;
pub mod pipeline;
pub mod propagation;
pub mod reading;
pub mod setup;
