#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), warn(clippy::too_many_lines))]

mod arithmetic;
mod cross_validation;
pub mod dataset;
mod diagnose;
mod finding;
mod fit;
pub mod forecast;
mod identify;
pub mod linear;
mod measurement;
mod nested_test;
pub mod online;
pub mod parallel;
mod payload;
mod prepared_log;
pub mod prior;
mod readings;
mod report;
pub mod robot;
pub mod statistics;

pub use dataset::recording::Recording;
pub use dataset::{Dataset, LogRole};
pub use diagnose::plausibility::implausible;
pub use finding::{Finding, FindingCode, Severity};
pub use fit::IdentifyError;
pub use identify::{Progress, identify};
pub use measurement::unknowns::COULOMB_SPEED;
pub use payload::{KnownParameters, Payload, PayloadError, payload};
pub use prepared_log::{Excluded, judged};
pub use report::outcome::{
    BaseParameterOutcome, Both, CalibrationOutcome, ChannelNoise, CovarianceRoot, Curve,
    FrictionOutcome, InForce, JointOutcome, LinkOutcome, LogOutcome, ModelComparison,
    OffsetOutcome, Outcome, Predicted, RotorOutcome, SensorOutcome, TimeOffset, TwoRouteOutcome,
    Verdict, WeakDirection,
};
pub use report::prediction::predicted;
pub use robot::Robot;
