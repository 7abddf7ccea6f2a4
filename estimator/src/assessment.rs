//! Accuracy of the estimates of a recorded log: `proprio estimate --assess`.
//!
//! | figure | meaning |
//! |---|---|
//! | predicted | error of F/T readings predicted with the parameters in use: [`Predicted`] |
//! | residuals | per sub-tree, the share within two standard deviations |
//! | torques | per joint with a measured torque, the error of the estimate, and the same share |
//!
//! Parameters identified on-line depend on the past alone, so they were not fitted to the instant
//! at which they are assessed. Without disturbances and with correct standard deviations, 97.7 % of
//! residuals are covered (the test is one-sided, [`proprio_topics::Residual::significance`]), and
//! 95.4 % of torques. The share of torques is smaller if the measured torque contains noise and
//! friction (and, at the motor, the rotor's inertia), which the standard deviations do not include.

use crate::inertial::InertialState;
use crate::pipeline::{Estimate, Pipeline};
use crate::sample_log::{self, SampleLogError};
use crate::setup::Setup;
use proprio_identification::dataset::observation::Observation;
use proprio_identification::{InForce, LogRole, Predicted, Robot, judged, predicted};
use proprio_topics::{JointTorque, Nanos};
use std::io::Read;

/// Standard deviations within which an error counts as covered.
const WITHIN: f64 = 2.0;

/// Collects the figures, estimate by estimate.
pub struct Assessor {
    /// The robot with the URDF's parameters.
    robot: Robot,
    instants: Vec<Observation>,
    /// The first instant that no estimate has reached yet.
    next: usize,
    /// The last estimate: its instant and torques.
    last: Option<(Nanos, Vec<JointTorque>)>,
    course: Vec<InForce>,
    joints: Vec<CoverageSum>,
    subtrees: Vec<CoverageSum>,
}

/// The figures of a log.
#[derive(Clone, Debug)]
pub struct Assessment {
    /// Prediction errors of the readings, with the CAD parameters and with those in use.
    pub predicted: Predicted,
    /// How often the parameters in use changed.
    pub changes: usize,
    /// Per sub-tree that can be tested: the name of its top link, and its coverage.
    pub residuals: Vec<(String, Coverage)>,
    /// Per joint with a measured torque: its name, and its coverage.
    pub torques: Vec<(String, Coverage)>,
}

/// How often errors were within the stated standard deviations.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coverage {
    /// RMS error: of torques \[Nm\]; of residuals, the positive deviates, in standard deviations.
    pub rms: f64,
    /// The share within two stated standard deviations.
    pub covered: f64,
    /// Number of values.
    pub count: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct CoverageSum {
    squares: f64,
    covered: u64,
    count: u64,
}

impl CoverageSum {
    fn add(&mut self, error: f64, deviation: f64) {
        self.squares += error * error;
        self.covered += u64::from(error.abs() <= WITHIN * deviation);
        self.count += 1;
    }

    fn coverage(self) -> Option<Coverage> {
        let count = self.count as f64;
        (self.count > 0).then(|| Coverage {
            rms: (self.squares / count).sqrt(),
            covered: self.covered as f64 / count,
            count: self.count,
        })
    }
}

impl Assessor {
    /// Reads the log. Call it before the estimates are computed.
    ///
    /// # Errors
    /// The log cannot be read.
    pub fn new(setup: &Setup, log: impl Read) -> Result<Self, SampleLogError> {
        let robot = setup.robot.clone();
        Ok(Self {
            instants: judged(
                &robot,
                sample_log::dataset(&robot, "", LogRole::Validate, log)?,
            ),
            next: 0,
            last: None,
            course: vec![in_force(&setup.initial, Nanos::MIN)],
            joints: vec![CoverageSum::default(); setup.robot.joint_names().count()],
            subtrees: vec![CoverageSum::default(); setup.robot.subtree_names().count()],
            robot,
        })
    }

    /// Takes an estimate.
    pub(crate) fn estimate(&mut self, estimate: &Estimate) {
        for (tally, residual) in self.subtrees.iter_mut().zip(estimate.contacts.residuals()) {
            if residual.significance.is_finite() {
                tally.add(residual.significance.max(0.0), 1.0);
            }
        }
        let (t, joints) = (estimate.t, estimate.torques.joints());
        while let Some(instant) = self
            .instants
            .get(self.next)
            .filter(|instant| instant.t <= t)
        {
            self.next += 1;
            let (before, earlier) = match &self.last {
                Some((before, earlier)) if instant.t < t => (*before, &earlier[..]),
                // Exactly this instant.
                _ if instant.t == t => (t, joints),
                _ => continue,
            };
            if t - before > self.robot.max_silence {
                continue;
            }
            let late = if t > before {
                (instant.t - before).seconds() / (t - before).seconds()
            } else {
                0.0
            };
            let measured = self
                .robot
                .published()
                .filter_map(|dof| instant.torque.get(dof));
            let each = earlier.iter().zip(joints).zip(measured);
            for (((one, other), measured), tally) in each.zip(&mut self.joints) {
                if measured.is_finite() && one.valid == 1 && other.valid == 1 {
                    let estimated = one.torque + late * (other.torque - one.torque);
                    tally.add(
                        estimated - measured,
                        one.standard_deviation.max(other.standard_deviation),
                    );
                }
            }
        }
        match &mut self.last {
            Some((last, own)) => {
                *last = t;
                own.clear();
                own.extend_from_slice(joints);
            }
            None => self.last = Some((t, joints.to_vec())),
        }
    }

    /// Records the parameters in use if the estimate at `t` is the first with other ones.
    pub(crate) fn parameters(&mut self, t: Nanos, pipeline: &mut Pipeline) {
        if pipeline.inertia().is_none() {
            return;
        }
        let now = in_force(pipeline.parameters(), t);
        // It may be that only offsets have changed.
        if self
            .course
            .last()
            .is_none_or(|last| last.bodies != now.bodies)
        {
            self.course.push(now);
        }
    }

    /// The figures.
    #[must_use]
    pub fn finish(self) -> Assessment {
        let named = |names: Vec<&str>, tallies: &[CoverageSum]| {
            let pairs = names.into_iter().zip(tallies);
            pairs
                .filter_map(|(name, tally)| Some((name.to_owned(), tally.coverage()?)))
                .collect()
        };
        Assessment {
            // No error: the observations are of the same robot.
            predicted: predicted(&self.robot, &self.instants, &self.course).unwrap_or_default(),
            changes: self.course.len() - 1,
            residuals: named(self.robot.subtree_names().collect(), &self.subtrees),
            torques: named(self.robot.joint_names().collect(), &self.joints),
        }
    }
}

/// These parameters, in use from `since` on.
fn in_force(parameters: &InertialState, since: Nanos) -> InForce {
    InForce {
        since,
        bodies: parameters.model.inertias().to_vec(),
        calibrations: parameters.calibrations.clone(),
    }
}
