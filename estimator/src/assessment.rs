//! How good a run of estimates over a recorded log was: `proprio estimate --assess`.
//!
//! | figure | meaning |
//! |---|---|
//! | predicted | error of F/T readings predicted with the parameters in force: [`Predicted`] |
//! | residuals | per sub-tree, the share within two standard deviations |
//! | torques | per joint with a measured torque, the error of the estimated one, and its share |
//!
//! What was identified on-line was learnt from the past alone, so each instant is one that the
//! parameters were not fitted to. Where nothing unknown acts and deviations are right, 97.7 % of
//! residuals are covered (theirs is one-sided, [`proprio_topics::Residual::significance`]), and
//! 95.4 % of torques, less what the measured torque's own noise and friction (and, measured at the
//! motor, the rotor's inertia) take, which no deviation states.

use crate::identify::instants::{Instant, RecordingError};
use crate::identify::{self, InForce, Predicted};
use crate::pipeline::{Estimate, Pipeline};
use crate::setup::Setup;
use proprio_topics::{JointTorque, Nanos};
use std::io::Read;

/// Standard deviations within which an error counts as covered.
const WITHIN: f64 = 2.0;

/// Collects, estimate by estimate, what the figures need.
pub struct Assessor {
    /// Without identified parameters.
    cad: Setup,
    instants: Vec<Instant>,
    /// The first instant that no estimate has reached yet.
    next: usize,
    /// The last estimate: when, and the torques.
    last: Option<(Nanos, Vec<JointTorque>)>,
    course: Vec<InForce>,
    joints: Vec<Tally>,
    subtrees: Vec<Tally>,
}

/// The figures of a log.
#[derive(Clone, Debug)]
pub struct Assessment {
    /// How well readings are predicted by CAD's parameters and by those in force.
    pub predicted: Predicted,
    /// How often other parameters came into force.
    pub changes: usize,
    /// Per sub-tree that can be tested, the name of its top link.
    pub residuals: Vec<(String, Coverage)>,
    /// Per joint with a measured torque, its name.
    pub torques: Vec<(String, Coverage)>,
}

/// How often errors were as little as stated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coverage {
    /// RMS error: of torques \[Nm\]; of residuals, those that are more than usual, in standard
    /// deviations.
    pub rms: f64,
    /// The share within two stated standard deviations.
    pub covered: f64,
    /// How many numbers.
    pub count: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    squares: f64,
    covered: u64,
    count: u64,
}

impl Tally {
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
    /// Reads the log, once before estimates are made of it.
    ///
    /// # Errors
    /// The log can not be read.
    pub fn new(setup: &Setup, log: impl Read) -> Result<Self, RecordingError> {
        let cad = setup.as_configured();
        Ok(Self {
            instants: identify::judged_instants(&cad, log)?,
            next: 0,
            last: None,
            course: vec![in_force(setup, Nanos::MIN)],
            joints: vec![Tally::default(); setup.joint_names().count()],
            subtrees: vec![Tally::default(); setup.subtree_names().count()],
            cad,
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
        while let Some(instant) = self.instants.get(self.next).filter(|instant| instant.t <= t) {
            self.next += 1;
            let (before, earlier) = match &self.last {
                Some((before, earlier)) if instant.t < t => (*before, &earlier[..]),
                // This very instant.
                _ if instant.t == t => (t, joints),
                _ => continue,
            };
            if t - before > self.cad.max_silence {
                continue;
            }
            let late = if t > before {
                (instant.t - before).seconds() / (t - before).seconds()
            } else {
                0.0
            };
            let each = earlier.iter().zip(joints).zip(&instant.torque);
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

    /// Asks whether the estimate at `t` was the first with other parameters.
    pub(crate) fn parameters(&mut self, t: Nanos, pipeline: &mut Pipeline) {
        if pipeline.inertia().is_none() {
            return;
        }
        let now = in_force(pipeline.setup(), t);
        // Offsets alone may have changed.
        if self.course.last().is_none_or(|last| last.bodies != now.bodies) {
            self.course.push(now);
        }
    }

    /// The figures.
    #[must_use]
    pub fn finish(self) -> Assessment {
        let named = |names: Vec<&str>, tallies: &[Tally]| {
            let pairs = names.into_iter().zip(tallies);
            pairs
                .filter_map(|(name, tally)| Some((name.to_owned(), tally.coverage()?)))
                .collect()
        };
        Assessment {
            // Instants of this very robot are not refused.
            predicted: identify::predicted(&self.cad, &self.instants, &self.course).unwrap_or_default(),
            changes: self.course.len() - 1,
            residuals: named(self.cad.subtree_names().collect(), &self.subtrees),
            torques: named(self.cad.joint_names().collect(), &self.joints),
        }
    }
}

/// What a setup works with, from `since` on.
fn in_force(setup: &Setup, since: Nanos) -> InForce {
    InForce {
        since,
        bodies: setup.model.inertias().to_vec(),
        calibrations: setup.calibrations.clone(),
    }
}
