#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

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
