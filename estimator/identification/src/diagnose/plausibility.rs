//! Implausible logs: wrong units, signs and frames of channels, channels that are dead or
//! saturated. `proprio estimate` runs the tests that identification runs before any fit.

use crate::dataset::Dataset;
use crate::dataset::defects::Defect;

use crate::diagnose::{sensor_frame, wrench_units};
use crate::finding::{Finding, FindingCode, Severity};
use crate::measurement::model::MeasurementModel;
use crate::robot::{IdentificationInput, Robot};
use crate::training::{folds, prepare, stamps_apart};

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
    let lacks_motion =
        |defect: &Defect| matches!(defect, Defect::WrongUnits { .. } | Defect::NoMotion { .. });
    let has_motion = !dataset.defects.iter().any(lacks_motion);
    let apart = stamps_apart(robot, &dataset);
    let mut log = prepare(robot, dataset);
    // A simulated IMU without noise on a base that stands still is constant.
    let is_ideal = |finding: &Finding| {
        finding.code == FindingCode::Frozen && finding.subject.starts_with("imu/")
    };
    let channel_faults = log
        .findings
        .iter()
        .filter(|finding| WRONG.contains(&finding.code));
    let channel_faults = channel_faults.filter(|finding| !is_ideal(finding));
    let mut findings: Vec<Finding> = channel_faults.cloned().collect();
    // A slow channel does no harm as long as observations exist without it.
    findings.extend(
        apart
            .filter(|_| log.instants.is_empty())
            .map(|text| Finding {
                severity: Severity::Warning,
                code: FindingCode::SampleSpacing,
                subject: String::new(),
                text,
            }),
    );
    log.findings.clear();
    // Without motion, with motion in wrong units, or with too few instants, F/T readings cannot be
    // tested.
    log.refused = !has_motion || folds(log.instants.iter().map(|instant| instant.t)) < 1;
    let wrench = [IdentificationInput::Wrench];
    let measurement = MeasurementModel::for_observations(robot, &wrench, log.instants.iter()).ok();
    if let Some(mut measurement) =
        measurement.filter(|measurement| !log.refused && !measurement.unknowns().links.is_empty())
    {
        let wrong = wrench_units::wrong(&mut measurement, &log);
        log.add_findings(wrong);
        findings.append(&mut log.findings);
        if !log.refused {
            findings.extend(sensor_frame::wrong(&measurement, &[&log]));
        }
    }
    findings
}
