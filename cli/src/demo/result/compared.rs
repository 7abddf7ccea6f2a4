//! Compares every estimate with the simulator's truth and with the torque that the CAD's parameters
//! give from the same samples, and computes the accuracy of the torques in each phase of the run.

use crate::demo::watching::ReceivedRun;
use anyhow::Context;
use proprio_topics::JointTorque;
use proprio_topics::csv::{self, Value};
use proprio_topics::{Kind, Nanos, Reading};
use serde_json::{Value as Json, json};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// The identification is evaluated from this time after the onset of motion on.
const LEARNING: Nanos = Nanos::from_millis(10_000);

/// The simulator's truth: joint torques over time.
pub(super) struct TrueTorques {
    t: Vec<Nanos>,
    /// Per joint, its torque at each of `t`.
    torques: Vec<Vec<f64>>,
}

impl TrueTorques {
    pub(super) fn read(file: &Path, joints: &[String]) -> anyhow::Result<Self> {
        let mut reader = csv::TableReader::new(BufReader::new(File::open(file)?))?;
        let series: Vec<Option<usize>> = joints
            .iter()
            .map(|j| {
                reader
                    .series()
                    .iter()
                    .position(|s| s.kind == csv::SeriesKind::Channel(Kind::Joint) && s.name == *j)
            })
            .collect();
        let mut this = Self {
            t: vec![],
            torques: vec![vec![]; joints.len()],
        };
        let mut row = csv::Row::default();
        while reader.next_row(&mut row)? {
            let Some(t) = row.t else { continue };
            this.t.push(t);
            for (torques, series) in this.torques.iter_mut().zip(&series) {
                let torque = row
                    .items
                    .iter()
                    .find(|i| Some(i.series) == *series)
                    .and_then(|i| match i.value {
                        Value::Reading(Reading::Joint(state), _) => Some(state.torque),
                        _ => None,
                    });
                torques.push(torque.unwrap_or(f64::NAN));
            }
        }
        Ok(this)
    }

    /// The torque of joint `joint` at `t`, interpolated linearly; NaN outside the table.
    fn torque(&self, joint: usize, t: Nanos) -> f64 {
        let after = self.t.partition_point(|x| *x < t);
        let row = |i: usize| Some((*self.t.get(i)?, *self.torques.get(joint)?.get(i)?));
        match (row(after), after.checked_sub(1).and_then(row)) {
            (Some((t1, y1)), _) if t1 == t => y1,
            (Some((t1, y1)), Some((t0, y0))) => {
                y0 + (y1 - y0) * ((t - t0).seconds() / (t1 - t0).seconds())
            }
            _ => f64::NAN,
        }
    }
}

/// A share in percent.
pub(super) fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// `part / whole`; NaN if `whole` is zero.
pub(super) fn ratio(part: usize, whole: usize) -> f64 {
    part as f64 / whole as f64
}

/// Every estimate with the truth and the CAD's torque from the same samples.
pub(super) struct AlignedRun {
    /// The instant of the first estimate, the origin of the report's time.
    pub(super) first: Nanos,
    /// The start of the motion, and 10 s later.
    pub(super) moving: Nanos,
    pub(super) settled: Nanos,
    /// Per joint, per instant.
    pub(super) joints: Vec<Vec<AlignedTorque>>,
}

/// The torque of one joint at one instant.
#[derive(Clone, Copy)]
pub(super) struct AlignedTorque {
    pub(super) t: Nanos,
    pub(super) estimate: JointTorque,
    /// With the CAD's parameters, and the truth \[Nm\]; NaN where unknown.
    pub(super) cad: f64,
    pub(super) truth: f64,
}

impl AlignedTorque {
    pub(super) fn error(&self) -> f64 {
        self.estimate.torque - self.truth
    }
}

impl AlignedRun {
    pub(super) fn new(
        watched: &ReceivedRun,
        truth: &TrueTorques,
        still: f64,
    ) -> anyhow::Result<Self> {
        let first = watched.estimates.first().map_or(Nanos::ZERO, |seen| seen.t);
        let began = watched.simulator["t0"]
            .as_i64()
            .context("when the simulation began")?;
        let moving = Nanos(began) + Nanos::from_seconds(still);
        let mut joints = vec![Vec::with_capacity(watched.estimates.len()); watched.joints.len()];
        let mut baseline = watched.baseline.iter().peekable();
        for seen in &watched.estimates {
            while baseline.next_if(|(t, _)| *t < seen.t).is_some() {}
            let cad = baseline
                .peek()
                .filter(|(t, _)| *t == seen.t)
                .map(|(_, torques)| torques);
            for ((joint, instants), estimate) in joints.iter_mut().enumerate().zip(&seen.joints) {
                instants.push(AlignedTorque {
                    t: seen.t,
                    estimate: *estimate,
                    cad: cad
                        .and_then(|torques| torques.get(joint))
                        .copied()
                        .unwrap_or(f64::NAN),
                    truth: truth.torque(joint, seen.t),
                });
            }
        }
        Ok(Self {
            first,
            moving,
            settled: moving + LEARNING,
            joints,
        })
    }

    /// An instant in the report's time \[s\].
    pub(super) fn time(&self, t: Nanos) -> f64 {
        (t - self.first).seconds()
    }

    /// Per joint, the number of torques that break the promise: valid, but more than four stated
    /// deviations and 1 % of the joint's range off the truth.
    pub(super) fn untrue(&self) -> Vec<usize> {
        let untrue = |instants: &Vec<AlignedTorque>| {
            let truths = || instants.iter().map(|i| i.truth).filter(|x| x.is_finite());
            let (least, most) = (
                truths().fold(f64::INFINITY, f64::min),
                truths().fold(f64::NEG_INFINITY, f64::max),
            );
            let is_untrue = |i: &&AlignedTorque| {
                let promised = (4.0 * i.estimate.standard_deviation).max(0.01 * (most - least));
                // A torque that is no number is untrue; without a truth it is not known.
                let is_kept = i.error().abs() <= promised || i.truth.is_nan();
                i.estimate.valid == 1 && !is_kept
            };
            instants.iter().filter(is_untrue).count()
        };
        self.joints.iter().map(untrue).collect()
    }

    /// The accuracy of the torques from `from` until before `until`; `None` without an estimate
    /// that has a truth.
    pub(super) fn phase(&self, from: Nanos, until: Nanos) -> Option<PhaseAccuracy> {
        let (mut phase, mut count, mut valid, mut within) = (PhaseAccuracy::default(), 0, 0, 0);
        for instants in &self.joints {
            let inside = instants
                .iter()
                .filter(|i| i.t >= from && i.t < until && i.truth.is_finite());
            let (mut cad, mut identified, mut size) = (
                MeanSquare::default(),
                MeanSquare::default(),
                MeanSquare::default(),
            );
            for instant in inside {
                count += 1;
                // Of a withheld torque there is no figure, of the CAD's at that instant neither.
                if instant.estimate.valid != 1 {
                    continue;
                }
                valid += 1;
                within +=
                    usize::from(instant.error().abs() <= 2.0 * instant.estimate.standard_deviation);
                identified.see(instant.error());
                size.see(instant.truth);
                if instant.cad.is_finite() {
                    cad.see(instant.cad - instant.truth);
                }
            }
            phase.joints.push(Accuracy {
                cad: cad.rms(),
                identified: identified.rms(),
                size: size.rms(),
                valid: identified.count,
            });
        }
        (phase.valid_share, phase.within_2_sigma) = (ratio(valid, count), ratio(within, valid));
        (count > 0).then_some(phase)
    }
}

/// The root of a mean of squares.
#[derive(Default)]
struct MeanSquare {
    sum: f64,
    count: usize,
}

impl MeanSquare {
    fn see(&mut self, value: f64) {
        self.sum += value * value;
        self.count += 1;
    }

    /// NaN of nothing.
    fn rms(&self) -> f64 {
        (self.sum / self.count as f64).sqrt()
    }
}

/// The accuracy in a part of the run.
#[derive(Clone, Default)]
pub(super) struct PhaseAccuracy {
    pub(super) joints: Vec<Accuracy>,
    /// Fraction of the torques that were not withheld.
    pub(super) valid_share: f64,
    /// Fraction of these whose error is within twice the stated deviation; NaN without any.
    pub(super) within_2_sigma: f64,
}

/// The accuracy of a joint's torques, over its valid estimates.
#[derive(Clone, Copy)]
pub(super) struct Accuracy {
    /// RMS errors with the CAD's and with identified parameters, and RMS torque \[Nm\]; NaN
    /// without a valid estimate.
    pub(super) cad: f64,
    pub(super) identified: f64,
    pub(super) size: f64,
    /// Number of valid estimates.
    pub(super) valid: usize,
}

impl PhaseAccuracy {
    pub(super) fn json(phase: Option<&Self>, names: &[String]) -> Json {
        let Some(phase) = phase else {
            return Json::Null;
        };
        json!({
            "cad": phase.each(names, |joint| joint.cad.into()),
            "identified": phase.each(names, |joint| joint.identified.into()),
            "valid_estimates": phase.each(names, |joint| joint.valid.into()),
            "valid_share": phase.valid_share, "within_2_sigma": phase.within_2_sigma,
        })
    }

    /// A figure of each joint, by its name.
    pub(super) fn each(&self, names: &[String], figure: impl Fn(&Accuracy) -> Json) -> Json {
        let named = names.iter().zip(&self.joints);
        named
            .map(|(name, joint)| (name.clone(), figure(joint)))
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn instant(t: f64, torque: f64) -> AlignedTorque {
        let valid = torque.is_finite();
        AlignedTorque {
            t: Nanos::from_seconds(t),
            estimate: JointTorque {
                torque,
                standard_deviation: if valid { 0.5 } else { 930.0 },
                valid: u32::from(valid),
                ..JointTorque::ABSENT
            },
            cad: if valid { 3.0 } else { 933.0 },
            truth: 1.0,
        }
    }

    #[test]
    fn phases_are_told_apart_and_withheld_torques_enter_no_figure() {
        // Before the motion one torque of two is withheld; in motion three of four are right.
        let joint = vec![
            instant(1.0, f64::NAN),
            instant(2.0, -1.0),
            instant(5.0, 1.0),
            instant(6.0, 1.0),
            instant(7.0, 1.0),
            instant(8.0, 3.0),
            instant(15.0, f64::NAN),
        ];
        let compared = AlignedRun {
            first: Nanos::ZERO,
            moving: Nanos::from_seconds(4.0),
            settled: Nanos::from_seconds(14.0),
            joints: vec![joint],
        };
        let figures = |from, until| {
            let phase = compared.phase(from, until).unwrap();
            let joint = phase.joints[0];
            let errors = [joint.identified, joint.cad, joint.size];
            let shares = [phase.valid_share, phase.within_2_sigma];
            (errors, joint.valid, shares)
        };
        let before = figures(Nanos::ZERO, compared.moving);
        assert_eq!(before, ([2.0, 2.0, 1.0], 1, [0.5, 0.0]));
        let learning = figures(compared.moving, compared.settled);
        assert_eq!(learning, ([1.0, 2.0, 1.0], 4, [1.0, 0.75]));
        // Withheld throughout: no figure.
        let after = compared.phase(compared.settled, Nanos::MAX).unwrap();
        let json = PhaseAccuracy::json(Some(&after), &["elbow".to_owned()]);
        let expected = json!({
            "cad": {"elbow": null}, "identified": {"elbow": null}, "valid_estimates": {"elbow": 0},
            "valid_share": 0.0, "within_2_sigma": null,
        });
        assert_eq!(json, expected);
        assert!(
            compared
                .phase(Nanos::from_seconds(20.0), Nanos::MAX)
                .is_none()
        );
        // Two torques are 2 Nm off: four deviations, but with a smaller deviation more. 1 % of the
        // range always counts as true.
        assert_eq!(compared.untrue(), [0]);
        let mut compared = compared;
        for instant in &mut compared.joints[0] {
            instant.estimate.standard_deviation = 0.4;
        }
        assert_eq!(compared.untrue(), [2]);
        compared.joints[0][0].estimate.valid = 1;
        assert_eq!(compared.untrue(), [3]);
        compared.joints[0][0].estimate.valid = 0;
        compared.joints[0][0].truth = 202.0;
        assert_eq!(compared.untrue(), [0]);
        assert_eq!(PhaseAccuracy::json(None, &[]), Json::Null);
    }
}
