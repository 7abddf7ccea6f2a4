//! The promise of a valid torque, and its judge, who knows the truth.
//!
//! **The promise.** A valid torque is within four stated deviations of the truth, or within 1 % of
//! the joint's range (at least .02 Nm). A run breaks it if more than one of a thousand torques do.
//! **Use.** In a run without trouble 95 % of the torques are valid from ten seconds after the first
//! motion on.

use proprio_topics::{JointTorque, NO_CAUSE};
use std::collections::BTreeMap;

/// The true torques of all joints at an instant \[s\].
pub(crate) type TrueTorques<'a> = &'a mut dyn FnMut(f64) -> Vec<f64>;

/// Deviations within which a valid torque is.
const DEVIATIONS: f64 = 4.0;
/// The part of a joint's range that need not be covered, and its least \[Nm\].
const SMALL: (f64, f64) = (0.01, 0.02);
/// The share of a run's torques that may break the promise: four deviations are exceeded once in
/// 16,000 times by chance, but errors last for a while.
const FEW: f64 = 1e-3;

/// A valid torque that is not true.
#[derive(Debug, Clone)]
pub struct Worst {
    /// The joint.
    pub joint: String,
    /// When \[s\].
    pub t: f64,
    /// Its error \[Nm\].
    pub error: f64,
    /// Its error in stated deviations.
    pub deviations: f64,
    /// Its error as a part of the joint's range.
    pub share: f64,
}

/// What a run showed.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// The robot, in words.
    pub robot: String,
    /// Torques: all; valid; valid and not true.
    pub torques: [usize; 3],
    /// Torques from ten seconds after the first motion on: all; valid.
    pub late: [usize; 2],
    /// The largest error of a valid torque that is not true.
    pub worst: Option<Worst>,
    /// The median deviation of late valid torques, as a part of the joint's range.
    pub deviation: f64,
    /// Why torques were withheld, and how often.
    pub withheld: BTreeMap<String, usize>,
    /// The channel that has the trouble.
    pub channel: Option<String>,
}

impl Outcome {
    /// Whether the promise is broken.
    #[must_use]
    pub fn is_broken(&self) -> bool {
        let [all, _, bad] = self.torques;
        bad as f64 > FEW * all as f64
    }

    /// The share of withheld torques that name the channel that has the trouble; NaN if there is
    /// none, or if no torque is withheld.
    #[must_use]
    pub fn named(&self) -> f64 {
        let Some(channel) = &self.channel else {
            return f64::NAN;
        };
        let counts = self.withheld.iter();
        let counts =
            counts.filter(|(why, _)| why.split_once(':').is_some_and(|(_, c)| c == channel));
        let all: usize = self.withheld.values().sum();
        counts.map(|(_, count)| count).sum::<usize>() as f64 / all as f64
    }

    /// The share of late torques that are valid.
    #[must_use]
    pub fn use_of(&self) -> f64 {
        self.late[1] as f64 / self.late[0].max(1) as f64
    }
}

/// Compares torques with the truth.
pub(crate) struct Judge {
    joints: Vec<String>,
    channels: Vec<String>,
    small: Vec<f64>,
    ranges: Vec<f64>,
    begin: f64,
    deviations: Vec<f64>,
    outcome: Outcome,
}

impl Judge {
    /// For torques of `joints`, whose withheld ones may name `channels`; of a run of `duration`
    /// \[s\], of which what follows after `begin` is late.
    pub(crate) fn new(
        joints: Vec<String>,
        channels: Vec<String>,
        truth: TrueTorques<'_>,
        duration: f64,
        begin: f64,
    ) -> Self {
        let mut least = vec![f64::INFINITY; joints.len()];
        let mut most = vec![f64::NEG_INFINITY; joints.len()];
        for step in 0..200 {
            let truth = truth(duration / 200.0 * f64::from(step));
            for (torque, (least, most)) in truth.iter().zip(least.iter_mut().zip(&mut most)) {
                (*least, *most) = (least.min(*torque), most.max(*torque));
            }
        }
        let ranges: Vec<f64> = (least.iter().zip(&most))
            .map(|(a, b)| b - a + 0.1 * a.abs().max(b.abs()))
            .collect();
        let small = ranges.iter().map(|range| SMALL.1.max(SMALL.0 * range));
        Self {
            small: small.collect(),
            joints,
            channels,
            ranges,
            begin,
            deviations: Vec::new(),
            outcome: Outcome {
                robot: String::new(),
                torques: [0; 3],
                late: [0; 2],
                worst: None,
                deviation: f64::NAN,
                withheld: BTreeMap::new(),
                channel: None,
            },
        }
    }

    /// The torques of an estimate of `t`.
    pub(crate) fn on_estimate(&mut self, t: f64, torques: &[JointTorque], truth: TrueTorques<'_>) {
        let truth = truth(t);
        for (joint, (torque, truth)) in torques.iter().zip(truth).enumerate() {
            let is_late = t > self.begin;
            self.outcome.torques[0] += 1;
            self.outcome.late[0] += usize::from(is_late);
            if torque.valid != 1 {
                let word = torque.reason.get().map_or("?", |reason| reason.word());
                let cause = match torque.cause {
                    NO_CAUSE => String::new(),
                    cause => format!(":{}", self.channels[cause as usize]),
                };
                *(self.outcome.withheld.entry(format!("{word}{cause}"))).or_default() += 1;
                continue;
            }
            self.outcome.torques[1] += 1;
            if is_late {
                self.outcome.late[1] += 1;
                self.deviations
                    .push(torque.standard_deviation / self.ranges[joint]);
            }
            let error = (torque.torque - truth).abs();
            let deviations = error / torque.standard_deviation;
            // A value that is not finite is no true one.
            let is_true = deviations <= DEVIATIONS || error <= self.small[joint];
            if !is_true {
                self.outcome.torques[2] += 1;
                let share = error / self.ranges[joint];
                if self
                    .outcome
                    .worst
                    .as_ref()
                    .is_none_or(|worst| share > worst.share)
                {
                    self.outcome.worst = Some(Worst {
                        joint: self.joints[joint].clone(),
                        t,
                        error,
                        deviations,
                        share,
                    });
                }
            }
        }
    }

    /// Forgets the deviations so far: a long run has many.
    pub(crate) fn forget(&mut self) {
        self.deviations.clear();
    }

    /// What the run of `robot` showed, with trouble in `channel`.
    pub(crate) fn outcome(mut self, robot: String, channel: Option<String>) -> Outcome {
        (self.outcome.robot, self.outcome.channel) = (robot, channel);
        self.deviations.sort_by(f64::total_cmp);
        if let Some(median) = self.deviations.get(self.deviations.len() / 2) {
            self.outcome.deviation = *median;
        }
        self.outcome
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proprio_topics::Reason;

    /// An estimate of two joints that is off by so many of its deviations, which are a part of the
    /// joint's range.
    fn judged(deviations: f64, part: f64) -> Outcome {
        let mut truth = |t: f64| vec![8.0 * t.sin(), 3.0 * t.cos()];
        let names = vec!["one".into(), "two".into()];
        let mut judge = Judge::new(names, vec!["channel".into()], &mut truth, 45.0, 10.0);
        let t = 11.0;
        let mut torques: Vec<JointTorque> = (truth(t).iter().zip(&judge.ranges))
            .map(|(truth, range)| JointTorque {
                torque: truth + deviations * part * range,
                standard_deviation: part * range,
                valid: 1,
                reason: Reason::None.into(),
                ..JointTorque::ABSENT
            })
            .collect();
        judge.on_estimate(t, &torques, &mut truth);
        torques.truncate(1);
        torques[0] = JointTorque {
            cause: 0,
            reason: Reason::Stale.into(),
            ..JointTorque::ABSENT
        };
        judge.on_estimate(t, &torques, &mut truth);
        judge.outcome("a robot".into(), None)
    }

    #[test]
    fn what_is_far_off_and_valid_is_not_true() {
        for (deviations, part, is_true) in [
            (3.9, 0.1, true),
            (-3.9, 0.1, true),
            (4.1, 0.1, false),
            (-4.1, 0.1, false),
            // Within the small part of the range.
            (9.0, 0.0005, true),
            (100.0, 0.005, false),
            (f64::NAN, 0.1, false),
        ] {
            let outcome = judged(deviations, part);
            let valid = outcome.torques[1];
            let bad = if is_true { 0 } else { valid };
            assert_eq!(
                outcome.torques,
                [valid + 1, valid, bad],
                "{deviations} {part}"
            );
            assert_eq!(outcome.late, [valid + 1, valid]);
            assert_eq!(outcome.is_broken(), !is_true);
            assert_eq!(outcome.withheld, [("stale:channel".to_owned(), 1)].into());
            assert!((outcome.deviation - part).abs() < 1e-12 || !is_true);
        }
    }
}
