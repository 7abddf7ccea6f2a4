//! Implausible logs: wrong units, signs and frames of channels, channels that are dead or
//! saturated. `proprio estimate` runs the tests that identification runs before any fit.

use crate::dataset::{Dataset, LogRole};
use crate::diagnose::configuration;
use crate::finding::{Finding, FindingCode};
use crate::prepared_log::{folds, prepare, stamps_apart};
use crate::robot::{IdentificationInput, Robot};

/// Findings that mean that a log, or the configuration, is wrong. (Others mean that a log contains
/// little information or that some instants are lost.)
const WRONG: [FindingCode; 5] = [
    FindingCode::WrongUnits,
    FindingCode::Derivative,
    FindingCode::Frozen,
    FindingCode::Saturated,
    FindingCode::NeverSeen,
];

/// Implausible channels of a log.
#[must_use]
pub fn implausible(robot: &Robot, dataset: Dataset) -> Vec<Finding> {
    let no_motion = [FindingCode::WrongUnits, FindingCode::NoMotion];
    let mut findings = dataset.findings.iter();
    let has_motion = !findings.any(|own| no_motion.contains(&own.code));
    let apart = stamps_apart(robot, &dataset);
    let mut log = prepare(robot, dataset);
    // A simulated IMU without noise on a base that stands still is constant.
    let is_ideal = |finding: &Finding| {
        finding.code == FindingCode::Frozen && finding.subject.starts_with("imu/")
    };
    let mut findings = std::mem::take(&mut log.findings);
    findings.retain(|finding| WRONG.contains(&finding.code) && !is_ideal(finding));
    // A slow channel does no harm as long as observations exist without it.
    let apart = apart.filter(|_| log.instants.is_empty());
    findings.extend(apart.map(|text| Finding::warning(FindingCode::SampleSpacing, "", text)));
    // Without motion, with motion in wrong units, or with too few instants, F/T readings cannot be
    // tested.
    log.refused = !has_motion || folds(log.instants.iter().map(|instant| instant.t)) < 1;
    // Alone: what contradicts the configuration is a finding of this log.
    log.role = LogRole::Validate;
    let wrench = [IdentificationInput::Wrench];
    // No error is expected: the observations are of this robot.
    let _ = configuration::check(robot, &wrench, std::slice::from_mut(&mut log));
    // Torques that are measured are excluded by identification alone.
    let is_used = |finding: &Finding| !finding.subject.ends_with("/torque");
    findings.extend(log.findings.into_iter().filter(is_used));
    findings
}
