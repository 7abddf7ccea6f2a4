//! Identifies a robot's inertial parameters, and the offsets and calibrations of its sensors, from
//! what its sensors read while it moves.
//!
//! - Off-line, [`identify`]`(&`[`Robot`]`, Vec<`[`Dataset`]`>, ..)` takes recorded logs and returns
//!   an [`Outcome`]: parameters, covariance, figures for each log, findings.
//! - On-line, [`online`] estimates the same parameters recursively while the robot works.
//! - [`forecast`] states what the covariance would be after a motion that nobody has made yet.
//!
//! `examples/identification.rs` is a program of 20 lines.
//!
//! # Stages
//! [`Dataset::new`] makes a log into observations: all channels at common instants, with
//! derivatives, and a list of findings. [`identify`] then calls, in this order (details:
//! `batch.rs`):
//!
//! 1. `prepare_logs`: drops observations without motion.
//! 2. `plausible_model`: leaves out joint torques with a wrong sign or unit, refuses F/T sensors
//!    with wrong units, frame or direction, and a wrong gravity (`diagnose::configuration`); rows
//!    of each observation, `A d + G s = r + N e`.
//! 3. `exclude_disturbed`: the nuisance parameters `s` are eliminated by a Kalman filter
//!    (`measurement::reduction`), which leaves the square-root information `[R | z]` about `d`
//!    ([`linear::information`]). The maximum a posteriori (MAP) parameters under a prior at CAD
//!    ([`prior`]) and the noise of each channel are estimated in turn. Undeclared contacts and
//!    loads are excluded.
//! 4. `with_gains`: all gains of the F/T sensors.
//! 5. `cross_validated_fit`: that share of the change from CAD is retained which predicts held-out
//!    data best.
//! 6. `diagnose::search`: encoder signs, encoder offsets and time offsets are reported.
//! 7. `outcome`: the [`Outcome`].
//!
//! One test, `hypothesis`, decides whether a load, an encoder offset or a delay explains more of
//! the data than parameters and noise do.
//!
//! # Notation
//! ```text
//! A d + G s = r + N e
//! ```
//!
//! - `d = phi - phi_CAD`: ten inertial parameters per link (mass \[kg\], first moments [kg m],
//!   second moments [kg m^2], about the link's origin and in its axes), then the extra parameters
//!   (rotor inertia, calibration). They belong to the robot and are common to all logs.
//! - `s`: nuisance parameters of one log: six offsets per F/T sensor [Nm, N], each a random walk;
//!   Coulomb friction, viscous friction and offset per measured joint torque.
//! - `r`: measured less predicted by CAD [Nm, N].
//! - `e`: noise of the channels, independent of each other; `N` distributes it over the rows.
//!
//! # What is estimated from what
//! No weight is chosen by hand: noise comes from the residuals, the prior's scale from the
//! evidence, by the same rules for every robot. Directions that the motion does not excite keep
//! their CAD values, and their uncertainty. On a validation log only offsets and friction are
//! fitted, for CAD and for the identified parameters alike.
//!
//! # Noise
//! The residual of a channel is mostly model error: correlated in time, and larger when the robot
//! moves. Taken as white noise it would be trusted far too much, and the evidence would let the
//! data overrule CAD where they contain no information. So its variance is multiplied by its
//! integrated autocorrelation time, or taken from the scatter of block means, whichever is larger.
//!
//! The offset of an F/T sensor drifts (random walk). Its rate maximises the likelihood of the block
//! means, within bounds: the offset follows nothing faster than a second, or it would absorb motion
//! and contacts; and in the final fit the rate is at most the sensor's stated noise per square root
//! of a second, or it would absorb model error.
//!
//! Rows that a contact reaches, declared or found, are excluded. They influence neither parameters
//! nor offsets.

mod arithmetic;
mod batch;
mod cross_validation;
pub mod dataset;
mod diagnose;
mod finding;
mod fit;
pub mod forecast;
mod hypothesis;
pub mod linear;
mod measurement;
pub mod online;
pub mod parallel;
mod payload;
pub mod prior;
mod report;
pub mod robot;
pub mod statistics;
mod training;

pub use batch::{Progress, identify};
pub use dataset::recording::Recording;
pub use dataset::{Dataset, LogRole};
pub use diagnose::plausibility::implausible;
pub use finding::{Finding, FindingCode, Severity};
pub use fit::IdentifyError;
pub use measurement::unknowns::COULOMB_SPEED;
pub use payload::{KnownParameters, Payload, PayloadError, payload};
pub use report::outcome::{
    BaseParameterOutcome, Both, CalibrationOutcome, ChannelNoise, CovarianceRoot, Curve,
    FrictionOutcome, InForce, JointOutcome, LinkOutcome, LogOutcome, ModelComparison,
    OffsetOutcome, Outcome, Predicted, RotorOutcome, SensorOutcome, TimeOffset, TwoRouteOutcome,
    Verdict, WeakDirection,
};
pub use report::prediction::predicted;
pub use robot::Robot;
pub use training::{Excluded, judged};
