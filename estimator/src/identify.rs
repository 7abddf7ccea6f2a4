//! Identifies a robot's inertial parameters, and the offsets of its F/T sensors, from what they measure while it moves.

mod batch;
pub mod consistent;
pub mod information;
pub mod instants;
mod outcome;
pub mod prior;

pub use batch::{IdentifyError, Log, Options, Progress, identify};
pub use outcome::{
    BaseParameterOutcome, ChannelNoise, Consistency, CovarianceRoot, Curve, Finding, FrictionOutcome, JointOutcome,
    LeftOut, LinkOutcome, LogOutcome, OffsetOutcome, Outcome, Role, SensorOutcome, Severity, Spectrum, Three,
    TimeOffsetOutcome, TwoRouteOutcome, Unknown, Verdict, WeakDirection,
};
