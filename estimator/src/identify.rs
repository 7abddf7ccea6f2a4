//! Identifies a robot's inertial parameters, and the offsets of its F/T sensors, from what they measure while it moves.
//!
//! # The way of the data
//! ```text
//! log -> Recording, Instants: all channels at common instants, derivatives, what is wrong      instants
//!     -> rows of each instant: A d + G s = r + N e                                             rows
//!     -> offsets and friction s eliminated, by a filter on all columns at once                 session, passes
//!     -> [R | z], what all logs tell of d = phi - phi_CAD                                      information
//!     -> the most probable bodies under CAD's prior, and its weight                            prior
//!     -> what is left -> noise of each channel -> again, until it stays                        noise, passes
//!     -> undeclared contacts, another load: left out, and again, until it stays                gate
//!     -> held-out data: what gains nothing is shrunk to CAD                                    batch
//!     -> motion that only other F/T sensors feel, taken off; all of the fit again              shaking
//!     -> Outcome: parameters, covariance, figures per log, in words                            assess, export
//! ```
//! [`identify`] does all of it. Parameters belong to the robot and are common to all logs; offsets and friction belong to a log.
//!
//! The same while the robot works, once a second: [`online`], which the pipeline feeds.
//!
//! # What is known when
//! Nothing is fitted to a validation log but its offsets and friction, for CAD and for the identified parameters alike. No weight is chosen by hand: noise comes from residuals, the
//! prior's weight from the evidence ([`prior`]), and both are the same rules for every robot. What motion does not show stays as in CAD, and its uncertainty says so.
//!
//! # Noise
//! What is left of a channel is mostly model error, not noise of the sensor: correlated in time, and larger when the robot moves. As white noise it would be believed far too much, and the
//! evidence would let the data overrule CAD where they know nothing. So its variance is multiplied by its integrated autocorrelation time, or taken from the scatter of block means,
//! whichever is more. An F/T sensor's offset walks besides; how fast is found by the likelihood of the block means, within a bound: it follows nothing faster than a second, or it would swallow
//! motion and touch. Where a contact is declared, or found though nobody declared it, the rows that it reaches are gone, and with them all influence on parameters and offsets.

mod assess;
mod batch;
pub mod consistent;
mod export;
mod gate;
pub mod information;
pub mod instants;
mod noise;
pub mod online;
mod outcome;
mod passes;
pub mod prior;
mod rows;
mod session;
mod shaking;

pub use batch::{IdentifyError, Log, Options, Progress, identify};
pub use export::parameters;
pub use gate::UnitSet;
pub use outcome::{
    BaseParameterOutcome, ChannelNoise, Consistency, CovarianceRoot, Curve, Finding, FrictionOutcome, JointOutcome,
    LeftOut, LinkOutcome, LogOutcome, OffsetOutcome, Outcome, Role, SensorOutcome, Severity, Spectrum, Three,
    TwoRouteOutcome, Verdict, WeakDirection,
};

/// The axes of a wrench as samples have them, in words.
const AXES: [&str; 6] = ["fx", "fy", "fz", "tx", "ty", "tz"];

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
