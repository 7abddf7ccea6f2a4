//! What of a log can not be, whatever is made of it: units, signs and frames of its channels,
//! channels that are dead or lie at the end of their range. `proprio estimate` asks what
//! identification asks before it fits anything.

use super::batch::{LEAST_FOLD, stamps_apart, usable};
use super::instants::{Defect, Recording, RecordingError};
use super::outcome::{Finding, Role, Severity};
use super::rows::RowMaker;
use super::{mounting, wrenches};
use crate::config::IdentificationInput;
use crate::setup::Setup;
use std::io::Read;

/// Findings that say that a log, or the configuration, is wrong, rather than that little can be
/// learnt from it or that some instants are lost.
const WRONG: [&str; 5] = ["wrong_units", "derivative", "frozen", "saturated", "never_seen"];

/// What in a log can not be.
///
/// # Errors
/// The log can not be read.
pub fn implausible(setup: &Setup, log: impl Read) -> Result<Vec<Finding>, RecordingError> {
    let setup = &setup.as_configured();
    let recording = Recording::read(setup, log)?;
    let says_nothing = |defect: &Defect| matches!(defect, Defect::WrongUnits { .. } | Defect::NoMotion { .. });
    let tells = !recording.defects().iter().any(says_nothing);
    let apart = stamps_apart(setup, &recording);
    let mut log = usable(setup, String::new(), Role::Validate, recording);
    // An IMU without noise on a base that stands still is a simulator's.
    let is_ideal = |finding: &Finding| finding.code == "frozen" && finding.subject.starts_with("imu/");
    let told = log.findings.iter().filter(|finding| WRONG.contains(&finding.code));
    let told = told.filter(|finding| !is_ideal(finding));
    let mut findings: Vec<Finding> = told.cloned().collect();
    // A slow channel does no harm as long as something can be made of the others.
    findings.extend(apart.filter(|_| log.instants.is_empty()).map(|text| Finding {
        severity: Severity::Warning,
        code: "spacing",
        subject: String::new(),
        text,
    }));
    log.findings.clear();
    // Motion that is none, or in other units, says nothing of F/T readings; nor do a few instants.
    log.refused = !tells || log.instants.len() < LEAST_FOLD;
    let wrench = [IdentificationInput::Wrench];
    let maker = RowMaker::survey(setup, &wrench, log.instants.iter()).ok();
    if let Some(mut maker) = maker.filter(|maker| !log.refused && !maker.layout().links.is_empty()) {
        wrenches::check(&mut maker, &mut log);
        findings.append(&mut log.findings);
        if !log.refused {
            findings.extend(mounting::wrong(&maker, &[&log]));
        }
    }
    Ok(findings)
}
