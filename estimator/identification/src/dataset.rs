//! Converts recorded channels to observations at common times, with velocities and accelerations,
//! and finds what is wrong with the log.
//!
//! ```text
//! samples -> Recording                               recording
//!     -> ordered stamps; repeats, spikes removed     cleaning, repeats
//!     -> checks of single channels                   inspection
//!     -> every channel at common times               resampling, stream, smooth
//!     -> Dataset: observations, findings
//! ```

mod cleaning;
mod inspection;
pub mod observation;
pub mod recording;
mod repeats;
pub mod resampling;
pub mod smooth;
pub(crate) mod stream;

use crate::finding::{Finding, FindingCode};
use crate::robot::{ChannelRole, Robot};
use observation::Observation;
use proprio_topics::Nanos;
use recording::Recording;

/// The use of a log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogRole {
    /// Parameters are identified from it.
    #[default]
    Train,
    /// Only for assessment: its offsets and friction are fitted to it, for CAD and for the
    /// identified parameters alike.
    Validate,
}

/// Why no dataset can be made from a recording.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// A channel that the kinematics need has no usable sample.
    #[error("{0} has no usable sample")]
    NoSamples(String),
}

/// A log, prepared for identification: every channel at common times.
#[derive(Debug, Clone)]
pub struct Dataset {
    /// Its name in the outcome: its file name.
    pub name: String,
    /// Its use.
    pub role: LogRole,
    pub(crate) instants: Vec<Observation>,
    pub(crate) findings: Vec<Finding>,
    /// Sample spacing, if it exceeds the time that a channel may be silent.
    pub(crate) apart: Option<Nanos>,
}

impl Dataset {
    /// Prepares a recording.
    ///
    /// # Errors
    /// [`DatasetError`]: a joint that is not locked, or the IMU of the base, has no sample. A
    /// missing F/T sensor is a finding.
    pub fn new(
        robot: &Robot,
        name: &str,
        role: LogRole,
        mut recording: Recording,
    ) -> Result<Self, DatasetError> {
        for declared in &mut recording.declared {
            declared.sort_by_key(|(t, _)| *t);
        }
        for temperatures in &mut recording.temperatures {
            temperatures.sort_by_key(|(t, _)| *t);
        }
        cleaning::clean(&mut recording, robot);
        recording.set_span();
        for channel in &recording.channels {
            let imu = &recording.imu;
            let is_empty = match channel.role {
                ChannelRole::Joint(dof) => recording.joints[dof].position.t.is_empty(),
                ChannelRole::Base => {
                    imu.proper_acceleration.t.is_empty() || imu.angular_velocity.t.is_empty()
                }
                ChannelRole::Sensor(_) => false,
            };
            if is_empty {
                return Err(DatasetError::NoSamples(cleaning::label(channel)));
            }
        }
        inspection::inspect(&mut recording, robot);
        let spacing = recording.spacing();
        Ok(Self {
            name: name.to_owned(),
            role,
            instants: recording.observations(robot),
            apart: (recording.stamped && spacing > robot.max_silence).then_some(spacing),
            findings: recording.findings,
        })
    }

    /// A log that cannot be used at all, with the reason. It is still part of the outcome.
    #[must_use]
    pub fn unreadable(name: &str, role: LogRole, reason: String) -> Self {
        Self {
            name: name.to_owned(),
            role,
            instants: Vec::new(),
            findings: vec![Finding::refusal(FindingCode::Unreadable, "", reason)],
            apart: None,
        }
    }

    /// All channels at each time.
    #[must_use]
    pub fn observations(&self) -> &[Observation] {
        &self.instants
    }

    /// What is wrong with the log.
    #[must_use]
    pub fn findings(&self) -> &[Finding] {
        &self.findings
    }
}
