//! What of a log can not be, whatever is made of it: units, signs and frames of its channels, channels
//! that are dead or lie at the end of their range. `proprio estimate` asks what identification asks
//! before it fits anything.

use super::batch::{stamps_apart, usable};
use super::instants::{Defect, Recording, RecordingError};
use super::outcome::{Finding, Role, Severity};
use super::rows::RowMaker;
use super::{mounting, wrenches};
use crate::config::IdentificationInput;
use crate::setup::Setup;
use std::io::Read;

/// Findings that say that a log, or the configuration, is wrong, rather than that little can be learnt
/// from it or that some instants are lost.
const WRONG: [&str; 5] = ["wrong_units", "derivative", "frozen", "saturated", "never_seen"];

/// What in a log can not be.
///
/// # Errors
/// The log can not be read.
pub fn implausible(setup: &Setup, log: impl Read) -> Result<Vec<Finding>, RecordingError> {
    let setup = &setup.as_configured();
    let recording = Recording::read(setup, log)?;
    let is_degrees = |defect: &Defect| matches!(defect, Defect::WrongUnits { .. });
    let has_units = !recording.defects().iter().any(is_degrees);
    let apart = stamps_apart(setup, &recording);
    let mut log = usable(setup, String::new(), Role::Validate, recording);
    let told = log.findings.iter().filter(|finding| WRONG.contains(&finding.code));
    let mut findings: Vec<Finding> = told.cloned().collect();
    findings.extend(apart.map(|text| Finding {
        severity: Severity::Warning,
        code: "stamps",
        subject: String::new(),
        text,
    }));
    log.findings.clear();
    // Motion that is none says nothing of F/T readings.
    log.refused = !has_units || log.instants.is_empty();
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
