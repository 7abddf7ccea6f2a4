//! What identification from recorded logs gives: the robot's parameters with their uncertainty, what became of each log, and what is wrong, in words.
//!
//! Plain data, without methods that compute: `parameters.toml`, `summary.json` and `report.html` are written from it. Units are SI, angles in radians; a vector over channels of an
//! F/T sensor is in the order of samples and logs, `[fx fy fz tx ty tz]` [N, Nm]; ten parameters of a link are `[m, h_x, h_y, h_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz]` about its origin
//! ([`crate::spatial`]).

use crate::calibration::{Calibration, Kind, Unknown};
use crate::regressor::identifiable::Column;
use crate::spatial::RigidInertia;
use nalgebra::DMatrix;
use proprio_topics::Nanos;

/// What a log is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Parameters are identified from it.
    Train,
    /// It only tells how good they are: its offsets and friction are fitted to it, for CAD and for the identified parameters alike.
    Validate,
}

/// The same quantity for three sets of parameters. Of the inertia of motors' rotors ([`RotorOutcome`]) CAD says nothing: with its parameters it is what goes best with them in the training logs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Three<T> {
    /// CAD as it is, with the offsets that the configuration states and without friction.
    pub cad: T,
    /// CAD with offsets (a random walk each) and friction fitted to the log.
    pub cad_fitted: T,
    /// The identified parameters, with offsets and friction fitted to the log in the same way.
    pub identified: T,
}

/// The same quantity for CAD's parameters and for the identified ones.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Both<T> {
    /// With CAD's.
    pub cad: T,
    /// With the identified ones.
    pub identified: T,
}

/// How well a log is predicted, by which parameters are judged: parameters, gains and friction are
/// those found in the training logs (friction found with CAD's parameters for CAD), and nothing is
/// fitted to the log but one constant offset of each F/T channel. It depends on the log and on the
/// parameters alone. Of all instants, also of those left out because something undeclared acted.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Predicted {
    /// Relative error. Of joint torques if the log has any: `|tau_hat - tau| / |tau|` over all joints
    /// and samples. Else of F/T readings: the same over all channels of all sensors, the mean of the
    /// readings removed, each force multiplied by [`crate::dynamics::Structure::LENGTH_SCALE`]. NaN
    /// where there is nothing to compare.
    pub relative_error: Both<f64>,
    /// The same of F/T readings with a linear drift of each channel fitted, too; NaN without any.
    pub relative_error_with_drift: Both<f64>,
    /// Per joint with a measured torque: its name, RMS of measured less predicted torque \[Nm\].
    pub joints: Vec<(String, Both<f64>)>,
    /// Per F/T sensor: its name, RMS of read less predicted, `[fx fy fz tx ty tz]` [N, Nm].
    pub sensors: Vec<(String, Both<[f64; 6]>)>,
    /// Per joint that two sides tell ([`TwoRouteOutcome`]): its name, RMS of the difference \[Nm\].
    pub two_route: Vec<(String, Both<f64>)>,
}

/// Parameters that were in force from some instant on.
#[derive(Clone, Debug, PartialEq)]
pub struct InForce {
    /// The first estimate that rested on them.
    pub since: Nanos,
    /// All links' inertias.
    pub bodies: Vec<RigidInertia>,
    /// All F/T sensors' calibrations.
    pub calibrations: Vec<Calibration>,
}

/// How serious a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Good to know.
    Note,
    /// The result is sound as far as it goes, but something is wrong and should be looked at.
    Warning,
    /// This part of the input was not used, or nothing could be identified, because of it.
    Refusal,
}

/// Something found in a log, in the model or in the result, in words for a person.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// How serious it is.
    pub severity: Severity,
    /// One word for a program: `jump`, `gap`, `no_motion`, `wrong_sign`, `wrong_frame`, `joint_zero`, `not_physical`, `shrunk`, `not_checked`, ...
    pub code: &'static str,
    /// What it is about: the name of a channel, joint, link; empty if about everything.
    pub subject: String,
    /// One or two sentences: what, where, how much, what to do.
    pub text: String,
}

/// Whether anything was identified.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The parameters of at least one group of links predict data that they were not fitted to better than CAD, its channels together. Links of other groups stay as in CAD:
    /// [`LinkOutcome::kept`].
    Identified,
    /// Of no link were they shown to be better than CAD on data that they were not fitted to (or there were too few to hold any back): all stay as in CAD.
    NoBetterThanCad,
    /// Nothing can be said of the parameters, and they are CAD's: the reason, in words.
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
    /// Where identification started and what the prior draws it to: CAD, with a least mass and a least extent, so that it is the inertia of a body. None: CAD is one.
    pub floored: Option<RigidInertia>,
    /// Identified: always of a body that can exist. Equal to `cad` where the log can see nothing of the link.
    pub identified: RigidInertia,
    /// Standard deviations of the ten identified parameters (those of the prior where the logs say nothing, or were not believed).
    pub deviation: [f64; 10],
    /// Which share of the change from CAD was kept after the check on held-out data: 1: all of it; 0: the parameters are CAD's (as they are of a link that no row reaches).
    pub kept: f64,
    /// How far the identified parameters are from CAD's: the Mahalanobis distance of those combinations of which the logs rather than the prior decide, by the scatter that they would have
    /// if CAD were right, expressed as a standard normal deviate (2 and less is nothing).
    pub significance: f64,
    /// Whether the log's rows reach this link at all.
    pub seen: bool,
}

/// Covariance of the identified parameters, and of the offsets at the end of the last training log in which each sensor was read, as `U U^T`: inflated noise and prior included.
#[derive(Clone, Debug, PartialEq)]
pub struct CovarianceRoot {
    /// What rows stand for: all links that are seen, ten parameters each, then six per sensor.
    pub columns: Vec<Column>,
    /// What the rows after those stand for: the sensor's number, and what of its calibration.
    pub calibrations: Vec<(usize, Unknown)>,
    /// `U`, square, upper triangular; the covariance is `U U^T`.
    pub root: DMatrix<f64>,
}

/// A combination of parameters that the motion of the logs excites least.
#[derive(Clone, Debug, PartialEq)]
pub struct WeakDirection {
    /// In words, factors in the units of the parameters: `right_hand.m - 0.41 right_forearm.h_z`. Terms that weigh little by the prior's spread are left out.
    pub expression: String,
    /// The links that these are of.
    pub links: Vec<usize>,
    /// Its singular value relative to the greatest, columns scaled to the prior's spread.
    pub relative: f64,
    /// Share of its variance that is the prior's: 1: the log says nothing, 0: the log says it all.
    pub prior_share: f64,
}

/// How late a stream's stamps are against the encoders'.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeOffset {
    /// The stream: the channel of an F/T sensor, or `joint torques`.
    pub channel: String,
    /// What happens at `t` is stamped `t + seconds` \[s\].
    pub seconds: f64,
    /// Its standard deviation \[s\].
    pub deviation: f64,
    /// Whether it is no chance, and large enough to matter.
    pub significant: bool,
}

/// A base parameter: a combination that shows, CAD's value and the identified one.
#[derive(Clone, Debug, PartialEq)]
pub struct BaseParameterOutcome {
    /// In words: `lower.h_y - 0.25 hand.m`.
    pub expression: String,
    /// Its unit: `kg`, `kg m` or `kg m^2`, that of its leading parameter.
    pub unit: &'static str,
    /// CAD's value.
    pub cad: f64,
    /// The identified value.
    pub identified: f64,
    /// Its standard deviation.
    pub deviation: f64,
}

/// The noise of one measured number, from the residuals of the training logs.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelNoise {
    /// `wrench/r_leg_ft_sensor/fx`, `joint/knee/torque`.
    pub name: String,
    /// `N` or `Nm`.
    pub unit: &'static str,
    /// Standard deviation of the residual at the rate of the rows [`unit`].
    pub deviation: f64,
    /// Its integrated autocorrelation time, in samples of the rows (1: white).
    pub autocorrelation: f64,
    /// The same \[s\].
    pub autocorrelation_seconds: f64,
    /// Rate of the offset's random walk [`unit` per square root of second]; 0 for a constant.
    pub drift: f64,
}

/// Whether bodies exist that have what the logs say.
#[derive(Clone, Debug, PartialEq)]
pub struct Consistency {
    /// Whether they do, within the uncertainty of the data; none if that was not decided.
    pub feasible: Option<bool>,
    /// By how many standard deviations the data disagree with the nearest bodies (0: not at all).
    pub deviations: f64,
    /// Links on the edge of what can exist, by name.
    pub links: Vec<String>,
    /// In words.
    pub text: String,
}

/// Calibration of one F/T sensor, the robot's: the same in all logs.
#[derive(Clone, Debug, PartialEq)]
pub struct CalibrationOutcome {
    /// The sensor's channel name.
    pub sensor: String,
    /// As configured, and as [`Three::cad`] and [`Three::cad_fitted`] have it.
    pub workbench: Calibration,
    /// All of it, with what was found: offsets and [`Three::identified`] are of readings corrected by it.
    pub identified: Calibration,
    /// What was to be found.
    pub kind: Kind,
    /// What was found, in the order of [`Kind::unknowns`]: how far the workbench's gain is off, relative to the readings that it corrects, and the change per kelvin beside the configured one.
    pub error: Vec<f64>,
    /// Standard deviation of each.
    pub deviation: Vec<f64>,
    /// Standard deviation of each before any log.
    pub prior: Vec<f64>,
}

/// Offset of one F/T sensor through a log.
#[derive(Clone, Debug, PartialEq)]
pub struct OffsetOutcome {
    /// The sensor's channel name.
    pub sensor: String,
    /// At the first instant used, `[fx fy fz tx ty tz]` [N, Nm]: raw reading less true wrench.
    pub start: [f64; 6],
    /// At the last instant used.
    pub end: [f64; 6],
    /// Standard deviation at the end.
    pub deviation: [f64; 6],
    /// Rate of its random walk [N, Nm per square root of second].
    pub rate: [f64; 6],
    /// Instants at which it started afresh, because the sensor jumped.
    pub breaks: Vec<Nanos>,
}

/// Friction of one joint through a log.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrictionOutcome {
    /// The joint's name.
    pub joint: String,
    /// Coulomb friction, times `tanh(velocity / 0.02 rad/s)` \[Nm\].
    pub coulomb_nm: f64,
    /// Viscous friction \[Nm s/rad\].
    pub viscous: f64,
    /// Offset \[Nm\].
    pub offset_nm: f64,
    /// Standard deviations of the three.
    pub deviation: [f64; 3],
}

/// Inertia of the rotor of a joint's motor. It belongs to the robot, not to a log; only where the measured torques are the motors' ([`crate::config::TorqueSide`]).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RotorOutcome {
    /// The joint's name.
    pub joint: String,
    /// Reflected to the joint: the rotor's inertia times the square of the gear ratio \[kg m^2; kg if the joint slides\]. Never negative where its links were identified; where they stay as in CAD
    /// ([`LinkOutcome::kept`] is 0), the value that goes best with CAD's bodies.
    pub inertia: f64,
    /// Its standard deviation. Where the motion does not tell it from the inertia of links ([`Outcome::confused`]: of the first joints of a fixed base, which turn all links about one axis
    /// alone), it is as uncertain as that is in CAD.
    pub deviation: f64,
}

/// One joint of a log: how far its measured torque and the predicted one are apart (only where joint torque is measured).
#[derive(Clone, Debug, PartialEq)]
pub struct JointOutcome {
    /// The joint's name.
    pub name: String,
    /// RMS of measured less predicted torque \[Nm\].
    pub rms_nm: Three<f64>,
    /// RMS of the measured torque itself \[Nm\].
    pub measured_rms_nm: f64,
    /// Share of instants at which the measured torque is within 1.96 standard deviations of the identified one.
    pub coverage: f64,
}

/// One F/T sensor of a log: how far its reading and the predicted one are apart.
#[derive(Clone, Debug, PartialEq)]
pub struct SensorOutcome {
    /// Its channel name.
    pub name: String,
    /// RMS of what it reads less what the parameters of all links on its contact-free side, offsets and neighbouring sensors predict, `[fx fy fz tx ty tz]` [N, Nm].
    pub rms: Three<[f64; 6]>,
    /// Per axis, share of the instants at which it is within 1.96 standard deviations, of noise and of the identified parameters.
    pub coverage: [f64; 6],
}

/// A joint torque had from two sides: from one F/T sensor and the links on its side alone, and from the other.
#[derive(Clone, Debug, PartialEq)]
pub struct TwoRouteOutcome {
    /// The joint's name.
    pub joint: String,
    /// RMS of the difference \[Nm\]. With CAD as it is it holds the configured offsets' errors.
    pub rms_nm: Three<f64>,
    /// The same with the mean removed \[Nm\].
    pub rms_mean_removed_nm: Three<f64>,
}

/// A curve for a plot: at most 2000 points of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Curve {
    /// Joint, `<sensor> fx`, ...
    pub name: String,
    /// `Nm`, `N`.
    pub unit: &'static str,
    /// Seconds since the log's first stamp.
    pub t: Vec<f64>,
    /// What was measured. Of an F/T channel: with its (fitted) offset removed.
    pub measured: Vec<f64>,
    /// Predicted by CAD with fitted offsets and friction.
    pub cad_fitted: Vec<f64>,
    /// Predicted by the identified parameters.
    pub identified: Vec<f64>,
    /// Standard deviation of the identified prediction, parameters' and measurement's noise together.
    pub sigma: Vec<f64>,
}

/// Power spectrum of a channel's residual, one-sided.
#[derive(Clone, Debug, PartialEq)]
pub struct Spectrum {
    /// As in [`ChannelNoise::name`].
    pub name: String,
    /// Frequencies \[Hz\].
    pub frequency: Vec<f64>,
    /// Density with CAD fitted [`unit`^2/Hz].
    pub cad_fitted: Vec<f64>,
    /// Density with the identified parameters.
    pub identified: Vec<f64>,
}

/// A span that was left out, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LeftOut {
    /// Why, in a few words: `contact declared: hand (the links that it touches)`, `contact suspected: the links at l_arm_ft_sensor`, `moment of a jump: the links at
    /// l_arm_ft_sensor`, `another load: l_hand`, `outlier of r_leg_ft_sensor`, `stale of knee`, or that it is too close to an end or a gap for accelerations.
    pub reason: String,
    /// How many instants.
    pub instants: u64,
    /// When it was first.
    pub first: Nanos,
    /// When it was last.
    pub last: Nanos,
}

/// What became of one log.
#[derive(Clone, Debug, PartialEq)]
pub struct LogOutcome {
    /// Its file name.
    pub file: String,
    /// What it was for.
    pub role: Role,
    /// First and last stamp.
    pub span: (Nanos, Nanos),
    /// Instants used.
    pub used: u64,
    /// Instants not used, by reason.
    pub left_out: Vec<LeftOut>,
    /// When the robot began to move; none if it never did, or moved from the start.
    pub onset: Option<Nanos>,
    /// How well the parameters predict it: what they are judged by.
    pub predicted: Predicted,
    /// Relative error with offsets that walk, and friction, fitted to the log: see [`LogOutcome`]'s fields `joints` and `sensors` for what it is made of.
    ///
    /// Joint torques: `|tau_hat - tau| / |tau|` over all joints and samples, edges cut. F/T sensors: the same over all channels of all sensors, means removed, each force multiplied by
    /// [`crate::dynamics::Structure::LENGTH_SCALE`]; of the reading with the fitted offset removed. NaN where there is nothing to compare.
    pub fitted_error: Three<f64>,
    /// Per joint with a measured torque.
    pub joints: Vec<JointOutcome>,
    /// Per F/T sensor that a contact-free sub-tree has.
    pub sensors: Vec<SensorOutcome>,
    /// Per joint that two sides tell.
    pub two_route: Vec<TwoRouteOutcome>,
    /// Offsets, per sensor.
    pub offsets: Vec<OffsetOutcome>,
    /// Friction, per joint with a measured torque.
    pub friction: Vec<FrictionOutcome>,
    /// What is wrong with the log.
    pub findings: Vec<Finding>,
    /// For plots: measured joint torques, then F/T channels.
    pub curves: Vec<Curve>,
    /// For plots: of the residuals.
    pub spectra: Vec<Spectrum>,
}

/// Everything that identification from recorded logs gives.
#[derive(Clone, Debug, PartialEq)]
pub struct Outcome {
    /// The robot's name.
    pub robot: String,
    /// In one word, whether it worked.
    pub verdict: Verdict,
    /// All links of the model, in its order.
    pub links: Vec<LinkOutcome>,
    /// Covariance of the parameters of those that are seen, and of offsets.
    pub covariance: CovarianceRoot,
    /// Rotor inertias, per joint whose motor's torque was measured while it accelerated.
    pub rotors: Vec<RotorOutcome>,
    /// Calibrations of F/T sensors, where these were to be identified.
    pub calibrations: Vec<CalibrationOutcome>,
    /// The prior's scale, chosen by evidence: how far, relatively, CAD is from the robot (bounded at 1).
    pub tau: f64,
    /// The least [`LinkOutcome::kept`] of the links that are seen: 1: all of every change from CAD; 0: at least one group of links stays as in CAD.
    pub shrink: f64,
    /// Number of unknown inertial parameters.
    pub unknowns: usize,
    /// Number of combinations of them that show in the logs (singular values above rounding).
    pub rank: usize,
    /// Number of combinations that rich enough motion of those joints which move in the logs would show, from the structure of the robot alone; not those that show only in a sum with an
    /// offset.
    pub structural_rank: usize,
    /// Effective number of parameters: how many combinations the logs rather than the prior decide.
    pub effective: f64,
    /// Condition number of what the logs tell, columns scaled to the prior's spread, over the rank.
    pub condition: f64,
    /// Singular values of what the logs tell, descending, columns scaled to the prior's spread: the excitation spectrum. Above 1: the log decides; below: the prior.
    pub singular_values: Vec<f64>,
    /// The least excited directions of those that could show, worst first.
    pub weakest: Vec<WeakDirection>,
    /// What the logs' motion can not tell apart, in words.
    pub confused: Vec<String>,
    /// Base parameters of what is seen.
    pub base_parameters: Vec<BaseParameterOutcome>,
    /// Noise of each measured number.
    pub channels: Vec<ChannelNoise>,
    /// How late streams are against the encoders: told, not removed.
    pub time_offsets: Vec<TimeOffset>,
    /// Whether bodies exist that have what the logs say.
    pub consistency: Consistency,
    /// Per log, in the order given.
    pub logs: Vec<LogOutcome>,
    /// What concerns no single log: signs, frames, joint zeros, links that CAD cannot be right about.
    pub findings: Vec<Finding>,
}
