//! The result of identification from recorded logs: the robot's parameters with their uncertainty,
//! figures for each log, and findings.
//!
//! Plain data: `parameters.toml`, `summary.json` and `report.html` are written from it. What can be
//! serialised has the keys of `summary.json`, without the name that is a key there itself. Units
//! are SI, angles in radians; a vector over channels of an F/T sensor is in the order of samples
//! and logs, `[fx fy fz tx ty tz]` [N, Nm]; ten parameters of a link are `[m, h_x, h_y, h_z, I_xx,
//! I_xy, I_xz, I_yy, I_yz, I_zz]` about its origin ([`proprio_dynamics::spatial`]).

use crate::dataset::LogRole;
use crate::finding::Finding;
use crate::prepared_log::Excluded;
use nalgebra::DMatrix;
use proprio_dynamics::calibration::{Calibration, Kind, Unknown};
use proprio_dynamics::regressor::identifiable::ParameterColumn;
use proprio_dynamics::spatial::RigidInertia;
use proprio_topics::Nanos;
use serde::{Serialize, Serializer};

/// The same quantity for three sets of parameters. CAD contains no rotor inertias
/// ([`RotorOutcome`]): with CAD's parameters they are fitted to the training logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct ModelComparison<T> {
    /// CAD, with the configured offsets and without friction.
    pub cad: T,
    /// CAD with offsets (a random walk each) and friction fitted to the log.
    pub cad_fitted: T,
    /// The identified parameters, with offsets and friction fitted to the log in the same way.
    pub identified: T,
}

/// The same quantity for CAD's parameters and the identified ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Both<T> {
    /// With CAD's.
    pub cad: T,
    /// With the identified ones.
    pub identified: T,
}

pub(crate) fn both<T: Copy>([cad, identified]: [T; 2]) -> Both<T> {
    Both { cad, identified }
}

/// The prediction error of a log, by which parameters are judged. Parameters, gains and friction
/// are those of the training logs (for CAD, friction fitted with CAD's parameters). Only one
/// constant offset of each F/T channel is fitted to the log. So the error depends on the log and
/// the parameters alone. It includes all instants, also those with undeclared disturbances.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Predicted {
    /// Relative error. Of joint torques if the log has any: `|tau_hat - tau| / |tau|` over all
    /// joints and samples. Else of F/T readings: the same over all channels of all sensors, the
    /// mean of the readings removed, each force multiplied by
    /// [`proprio_dynamics::Structure::LENGTH_SCALE`]. NaN where there is nothing to compare.
    pub relative_error: Both<f64>,
    /// The same of F/T readings with a linear drift of each channel fitted, too; NaN without any.
    pub relative_error_with_drift: Both<f64>,
    /// Per joint with a measured torque: its name, RMS of measured less predicted torque \[Nm\].
    #[serde(rename = "joints_rms_nm", serialize_with = "by_name")]
    pub joints: Vec<(String, Both<f64>)>,
    /// Per F/T sensor: its name, RMS of read less predicted, `[fx fy fz tx ty tz]` [N, Nm].
    #[serde(rename = "sensors_rms", serialize_with = "by_name")]
    pub sensors: Vec<(String, Both<[f64; 6]>)>,
    /// Per joint whose torque follows from two sides ([`TwoRouteOutcome`]): its name, RMS of the
    /// difference \[Nm\].
    #[serde(rename = "two_route_rms_nm", serialize_with = "by_name")]
    pub two_route: Vec<(String, Both<f64>)>,
}

/// An object with the names as keys.
fn by_name<T: Serialize, S: Serializer>(
    named: &[(String, T)],
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_map(named.iter().map(|(name, value)| (name, value)))
}

/// Parameters that were in use from some instant on.
#[derive(Clone, Debug, PartialEq)]
pub struct InForce {
    /// Stamp of the first estimate that used them.
    pub since: Nanos,
    /// All links' inertias.
    pub bodies: Vec<RigidInertia>,
    /// All F/T sensors' calibrations.
    pub calibrations: Vec<Calibration>,
}

/// Whether anything was identified.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum Verdict {
    /// The parameters of at least one group of links predict data that they were not fitted to
    /// better than CAD, its channels together. Links of other groups keep their CAD parameters:
    /// [`LinkOutcome::retained_fraction`].
    Identified,
    /// For no link do the parameters predict held-out data better than CAD (or there were too few
    /// data for cross-validation): all links keep their CAD parameters.
    #[default]
    NoBetterThanCad,
    /// Nothing was identified, and the parameters are CAD's: the reason, in words.
    Nothing(String),
}

/// One link's parameters, CAD's and identified.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkOutcome {
    /// Its number in the model.
    pub link: usize,
    /// Its name.
    pub name: String,
    /// As in the URDF.
    pub cad: RigidInertia,
    /// Start of the identification and centre of the prior: CAD with a minimum mass and a minimum
    /// radius of gyration, so that it is physically consistent. None: CAD is consistent.
    pub floored: Option<RigidInertia>,
    /// Identified; always physically consistent. Equal to `cad` if no row contains the link.
    pub identified: RigidInertia,
    /// Standard deviations of the ten identified parameters (those of the prior where the logs
    /// contain no information, or where the parameters were shrunk to CAD).
    pub deviation: [f64; 10],
    /// Fraction of the change from CAD that was retained in cross-validation. 1: all of it; 0: the
    /// parameters are CAD's (as for a link that no row contains).
    pub retained_fraction: f64,
    /// Significance of the change from CAD: the Mahalanobis distance of those combinations that the
    /// logs determine rather than the prior, by the covariance that they would have if CAD were
    /// right, expressed as a standard normal deviate (2 and less is not significant).
    pub significance: f64,
    /// Whether any row contains this link.
    pub seen: bool,
}

/// Covariance of the identified parameters, and of the offsets at the end of the last training log
/// in which each sensor was read, as `U U^T`: inflated noise and prior included.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CovarianceRoot {
    /// Quantities of the first rows: ten parameters of each seen link, then six offsets per sensor.
    pub columns: Vec<ParameterColumn>,
    /// Quantities of the rows after those: the sensor's number and its calibration parameter.
    pub calibrations: Vec<(usize, Unknown)>,
    /// `U`, square, upper triangular; the covariance is `U U^T`.
    pub root: DMatrix<f64>,
}

/// A combination of parameters that the motion of the logs excites least.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct WeakDirection {
    /// An expression, with factors in the parameters' units: `right_hand.m - 0.41
    /// right_forearm.h_z`. Terms that are small in units of the prior's spread are omitted.
    pub expression: String,
    /// The links of these parameters.
    #[serde(skip)]
    pub links: Vec<usize>,
    /// Its singular value relative to the largest, columns scaled to the prior's spread.
    pub relative: f64,
    /// Fraction of its prior variance that remains. 1: the logs contain no information about it; 0:
    /// they determine it.
    pub prior_share: f64,
}

/// Time offset of a stream's stamps relative to the encoders'.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TimeOffset {
    /// The stream: the channel of an F/T sensor, or `joint torques`.
    pub channel: String,
    /// What happens at `t` is stamped `t + seconds` \[s\].
    pub seconds: f64,
    /// Its standard deviation \[s\].
    #[serde(rename = "std")]
    pub deviation: f64,
    /// Whether it is statistically significant and large enough to matter.
    pub significant: bool,
}

/// A base parameter (an identifiable combination): CAD's value and the identified one.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BaseParameterOutcome {
    /// An expression: `lower.h_y - 0.25 hand.m`.
    pub expression: String,
    /// Its unit: `kg`, `kg m` or `kg m^2`, that of its leading parameter.
    pub unit: &'static str,
    /// CAD's value.
    pub cad: f64,
    /// The identified value.
    pub identified: f64,
    /// Its standard deviation.
    #[serde(rename = "std")]
    pub deviation: f64,
}

/// The noise of one measured channel, from the residuals of the training logs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChannelNoise {
    /// `wrench/r_leg_ft_sensor/fx`, `joint/knee/torque`.
    pub name: String,
    /// `N` or `Nm`.
    pub unit: &'static str,
    /// Standard deviation of the residual at the rate of the rows [`unit`].
    #[serde(rename = "std")]
    pub deviation: f64,
    /// Its integrated autocorrelation time \[s\].
    #[serde(rename = "autocorrelation_s")]
    pub autocorrelation_seconds: f64,
    /// Rate of the offset's random walk [`unit` per square root of second]; 0 for a constant.
    pub drift: f64,
}

/// Calibration of one F/T sensor, the robot's: the same in all logs.
#[derive(Clone, Debug, PartialEq)]
pub struct CalibrationOutcome {
    /// The sensor's channel name.
    pub sensor: String,
    /// The configured calibration, which [`ModelComparison::cad`] and
    /// [`ModelComparison::cad_fitted`] use.
    pub configured: Calibration,
    /// The whole identified calibration. Offsets and [`ModelComparison::identified`] refer to
    /// readings corrected by it.
    pub identified: Calibration,
    /// The parameters that were identified.
    pub kind: Kind,
    /// Identified errors, in the order of [`Kind::unknowns`]: of the factory gain, relative to the
    /// readings that it corrects, and of the configured change per kelvin.
    pub error: Vec<f64>,
    /// Standard deviation of each.
    pub deviation: Vec<f64>,
    /// Standard deviation of each before any log.
    pub prior: Vec<f64>,
}

/// Offset of one F/T sensor through a log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OffsetOutcome {
    /// The sensor's channel name.
    #[serde(skip)]
    pub sensor: String,
    /// At the first instant used, `[fx fy fz tx ty tz]` [N, Nm]: raw reading less true wrench.
    pub start: [f64; 6],
    /// At the last instant used.
    pub end: [f64; 6],
    /// Standard deviation at the end.
    #[serde(rename = "std")]
    pub deviation: [f64; 6],
    /// Rate of its random walk [N, Nm per square root of second].
    pub rate: [f64; 6],
}

/// Friction of one joint through a log.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct FrictionOutcome {
    /// The joint's name.
    #[serde(skip)]
    pub joint: String,
    /// Coulomb friction, times `tanh(velocity / 0.02 rad/s)` \[Nm\].
    pub coulomb_nm: f64,
    /// Viscous friction \[Nm s/rad\].
    pub viscous: f64,
    /// Offset \[Nm\].
    pub offset_nm: f64,
    /// Standard deviations of the three.
    #[serde(rename = "std")]
    pub deviation: [f64; 3],
}

/// Inertia of the rotor of a joint's motor. It belongs to the robot, not to a log; only where the
/// measured torques are the motors' ([`crate::robot::TorqueSide`]).
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct RotorOutcome {
    /// The joint's name.
    #[serde(skip)]
    pub joint: String,
    /// Reflected to the joint: the rotor's inertia times the square of the gear ratio \[kg m^2; kg
    /// for a prismatic joint\]. Never negative. Where its links keep their CAD parameters
    /// ([`LinkOutcome::retained_fraction`] is 0), the value that fits best together with CAD.
    #[serde(rename = "kgm2")]
    pub inertia: f64,
    /// Its standard deviation. Where it is not separable from the inertia of links
    /// ([`Outcome::not_separable`]: for the first joint of a fixed base, which rotates all links
    /// about a single axis), it is as uncertain as that inertia is in CAD.
    #[serde(rename = "std")]
    pub deviation: f64,
}

/// Prediction errors of the torque of one joint in a log (only where joint torque is measured).
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct JointOutcome {
    /// The joint's name.
    #[serde(skip)]
    pub name: String,
    /// RMS of measured less predicted torque \[Nm\].
    pub rms_nm: ModelComparison<f64>,
    /// RMS of the measured torque itself \[Nm\].
    pub measured_rms_nm: f64,
    /// Fraction of the instants at which the measured torque is within 1.96 standard deviations of
    /// the identified prediction.
    pub coverage: f64,
}

/// Prediction errors of the readings of one F/T sensor in a log.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SensorOutcome {
    /// Its channel name.
    #[serde(skip)]
    pub name: String,
    /// RMS of its readings less the prediction from the parameters of all links on its contact-free
    /// side, offsets and neighbouring sensors, `[fx fy fz tx ty tz]` [N, Nm].
    pub rms: ModelComparison<[f64; 6]>,
    /// Per axis, fraction of the instants at which the error is within 1.96 standard deviations of
    /// noise and identified parameters together.
    pub coverage: [f64; 6],
}

/// A joint torque computed from two sides: from one F/T sensor and the links on its side alone, and
/// from the other.
#[derive(Clone, Debug, PartialEq)]
pub struct TwoRouteOutcome {
    /// The joint's name.
    pub joint: String,
    /// RMS of the difference \[Nm\]. With CAD unfitted it contains the errors of the configured
    /// offsets.
    pub rms_nm: ModelComparison<f64>,
    /// The same with the mean removed \[Nm\].
    pub rms_mean_removed_nm: ModelComparison<f64>,
}

/// A curve for a plot: at most 2000 points.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Joint, `<sensor> fx`, ...
    pub name: String,
    /// `Nm`, `N`.
    pub unit: &'static str,
    /// Seconds since the log's first stamp.
    pub t: Vec<f64>,
    /// Measured values; of an F/T channel with its (fitted) offset removed.
    pub measured: Vec<f64>,
    /// Predicted by CAD with fitted offsets and friction.
    pub cad_fitted: Vec<f64>,
    /// Predicted by the identified parameters.
    pub identified: Vec<f64>,
    /// Standard deviation of the identified prediction, from the parameters' covariance and the
    /// measurement noise.
    pub sigma: Vec<f64>,
}

/// The result for one log.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LogOutcome {
    /// Its file name.
    pub file: String,
    /// Its role: training or validation.
    pub role: LogRole,
    /// First and last stamp.
    pub span: (Nanos, Nanos),
    /// Observations used.
    pub used: u64,
    /// Observations not used, by reason.
    pub excluded: Vec<Excluded>,
    /// When the robot began to move; none if it never moved, or moved from the start.
    pub onset: Option<Nanos>,
    /// Prediction errors, by which the parameters are judged.
    pub predicted: Predicted,
    /// Per joint with a measured torque.
    pub joints: Vec<JointOutcome>,
    /// Per F/T sensor of a contact-free sub-tree.
    pub sensors: Vec<SensorOutcome>,
    /// Per joint whose torque follows from two sides.
    pub two_route: Vec<TwoRouteOutcome>,
    /// Offsets, per sensor.
    pub offsets: Vec<OffsetOutcome>,
    /// Friction, per joint with a measured torque.
    pub friction: Vec<FrictionOutcome>,
    /// Findings about the log.
    pub findings: Vec<Finding>,
    /// For plots: measured joint torques, then F/T channels.
    pub curves: Vec<Curve>,
}

/// The result of identification from recorded logs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Outcome {
    /// The robot's name.
    pub robot: String,
    /// Whether anything was identified.
    pub verdict: Verdict,
    /// All links of the model, in its order.
    pub links: Vec<LinkOutcome>,
    /// Covariance of the parameters of the seen links, and of offsets.
    pub covariance: CovarianceRoot,
    /// Rotor inertias, per joint whose motor's torque was measured while it accelerated.
    pub rotors: Vec<RotorOutcome>,
    /// Calibrations of F/T sensors, if identified.
    pub calibrations: Vec<CalibrationOutcome>,
    /// The prior's scale, which maximises the evidence: the relative error of CAD (at most 1).
    pub tau: f64,
    /// The smallest [`LinkOutcome::retained_fraction`] of the seen links. 1: every change from CAD
    /// is retained; 0: at least one group of links keeps its CAD parameters.
    pub least_retained_fraction: f64,
    /// Number of unknown inertial parameters.
    pub unknowns: usize,
    /// Number of combinations of them that the logs determine (singular values above rounding).
    pub rank: usize,
    /// Number of combinations that are identifiable with sufficiently exciting motion of the joints
    /// that move in the logs, from the robot's structure alone. Combinations that are identifiable
    /// only in a sum with an offset are not counted.
    pub structural_rank: usize,
    /// Effective number of parameters: combinations that the logs determine rather than the prior.
    pub effective: f64,
    /// Condition number of the information, columns scaled to the prior's spread, over the rank.
    pub condition: f64,
    /// Singular values of the square-root information, descending, columns scaled to the prior's
    /// spread: the excitation spectrum. Above 1 the logs dominate, below 1 the prior.
    pub singular_values: Vec<f64>,
    /// The least excited of the identifiable directions, worst first.
    pub weakest: Vec<WeakDirection>,
    /// Combinations whose terms the logs' motion cannot separate, in words.
    pub not_separable: Vec<String>,
    /// Base parameters of the seen links.
    pub base_parameters: Vec<BaseParameterOutcome>,
    /// Noise of each measured channel.
    pub channels: Vec<ChannelNoise>,
    /// Time offsets of streams relative to the encoders: reported, not corrected.
    pub time_offsets: Vec<TimeOffset>,
    /// Per log, in the order given.
    pub logs: Vec<LogOutcome>,
    /// Findings that concern no single log: signs, frames, encoder offsets, inconsistent CAD links.
    pub findings: Vec<Finding>,
}
