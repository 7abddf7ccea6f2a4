//! The estimator: samples of joints, IMU and force/torque (F/T) sensors in, joint torques and
//! contact wrenches out, with their standard deviations and whether they are valid.
//!
//! # Stages
//! 1. [`pipeline::Pipeline::push`] stores a stamped sample of a channel. [`daemon`] takes samples
//!    from shared memory, [`offline`] from a log.
//! 2. [`pipeline::Pipeline::poll`] releases a stamp `t` of the trigger channel as soon as the other
//!    channels have passed it, and evaluates every channel at `t`: interpolated or differentiated,
//!    F/T readings corrected for calibration, temperature and offset.
//! 3. [`proprio_dynamics::Kinematics::update`]: pose, motion and net wrench of every link.
//! 4. [`proprio_dynamics::Solver::solve`] balances each sub-tree between F/T sensors and solves for
//!    its contact wrenches and joint torques.
//! 5. [`propagation::Propagation::update`]: standard deviations from the covariance of parameters
//!    and offsets, beside those from noise and motion.
//! 6. The residual of each sub-tree is tested. Where that changes the detected contacts, 3 to 5 run
//!    once more.
//! 7. Every torque and contact wrench is written with its standard deviation, whether it is valid,
//!    and the reason if it is not ([`pipeline::Estimate`]).
//!
//! With identification on, the pipeline also feeds [`proprio_identification::online`], which
//! updates inertial parameters and F/T offsets once a second.
//!
//! # Modules
//! - Input: [`config`] is estimator.toml as typed, [`setup`] is the same checked against the URDF
//!   with every name resolved, and [`reading`] reads logs.
//! - Pipeline: [`pipeline`] does no input or output and reads no clock. [`history`] interpolates,
//!   [`differentiate`] differentiates.
//! - Contacts: [`skin`] turns the values of taxels into touches, and where they are.
//! - Parameters: [`inertial`] holds the parameters in use, [`parameters`] is the file
//!   parameters.toml, [`export`] writes it from an identification result.
//! - Uncertainty: `uncertainty` turns all uncertain inputs into standard deviations,
//!   [`propagation`] those of the parameters.
//! - Drives: [`drive`] identifies what joints' drives report from the torques of the F/T sensors;
//!   the pipeline compares both.
//! - Programs: [`daemon`] and [`offline`] run the pipeline, [`check`] and `description` print what
//!   `--check` shows, [`assessment`] measures the accuracy of a run, `first_look` tests the first
//!   samples for implausible readings, `gateway_log` says who is missing, [`files`] replaces files
//!   atomically.
//!
//! # Notation
//! That of [`proprio_dynamics`] and [`proprio_identification`]; `t` is a stamp of the trigger
//! channel.

pub mod assessment;
pub mod check;
pub mod config;
pub mod daemon;
mod description;
pub mod differentiate;
pub mod drive;
pub mod export;
pub mod files;
mod first_look;
mod gateway_log;
pub mod history;
pub mod inertial;
pub mod offline;
pub mod parameters;
pub mod pipeline;
mod plausible;
pub mod reading;
#[cfg(test)]
#[path = "../../tests/schema.rs"]
mod schema;
pub mod setup;
pub mod skin;
mod uncertainty;

pub use uncertainty::propagation;
