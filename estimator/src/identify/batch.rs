//! Several recorded logs to one set of parameters.

use super::outcome::{Outcome, Role};
use crate::config::IdentificationInput;
use crate::setup::Setup;
use std::io::Read;

/// A log to identify from, or to validate with.
pub struct Log<'a> {
    /// What it is called in the outcome: its file name.
    pub file: String,
    /// What it is for.
    pub role: Role,
    /// The table of samples (CSV).
    pub samples: &'a mut (dyn Read + Send),
}

/// What is asked for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Options {
    /// From which measurements; empty: from the F/T sensors if the robot has any, else from measured joint torques.
    pub inputs: Vec<IdentificationInput>,
}

/// How far it is.
#[derive(Clone, Debug, PartialEq)]
pub struct Progress {
    /// What it is doing, in a few words: `reading walk.csv`, `round 3`.
    pub step: String,
    /// Share done, 0 to 1.
    pub done: f64,
}

/// Why there is no outcome at all. (Logs that tell nothing do give one, which says so.)
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IdentifyError {
    /// A log can not be read.
    #[error("{file}: {problem}")]
    Log {
        /// Its name.
        file: String,
        /// What is wrong, in words.
        problem: String,
    },
    /// No log to train on.
    #[error("no log to identify from: give at least one that is not for validation")]
    NoLogs,
    /// Nothing to identify from is configured or measured.
    #[error("{0}")]
    NoInputs(String),
}

/// Identifies.
///
/// # Errors
/// [`IdentifyError`]: a log that can not be read or lacks a channel, no log at all, nothing measured that parameters could be identified from.
pub fn identify(
    _setup: &Setup,
    logs: Vec<Log<'_>>,
    _options: &Options,
    _progress: &mut dyn FnMut(&Progress),
) -> Result<Outcome, IdentifyError> {
    if !logs.iter().any(|log| log.role == Role::Train) {
        return Err(IdentifyError::NoLogs);
    }
    // The work comes with the next commit; this one is for the types.
    Err(IdentifyError::NoInputs(
        "identification is not built into this version".into(),
    ))
}
