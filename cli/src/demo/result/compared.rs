//! Compares every estimate with the simulator's truth and with the CAD's estimate from the same
//! samples, and computes the accuracy of the torques in each phase of the run.

use crate::demo::watching::Watched;
use anyhow::Context;
use proprio_topics::JointTorque;
use proprio_topics::csv::{self, Value};
use proprio_topics::{Kind, Nanos, Reading};
use serde_json::json;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// The identification is evaluated from this time after the onset of motion on.
const LEARNING: Nanos = Nanos::from_millis(10_000);

/// The simulator's truth: joint torques over time.
pub(super) struct Truth {
    t: Vec<Nanos>,
    /// Per joint, its torque at each of `t`.
    torques: Vec<Vec<f64>>,
}

impl Truth {
    pub(super) fn read(file: &Path, joints: &[String]) -> anyhow::Result<Self> {
        let mut reader = csv::Reader::new(BufReader::new(File::open(file)?))?;
        let series: Vec<Option<usize>> = joints
            .iter()
            .map(|j| {
                reader
                    .series()
                    .iter()
                    .position(|s| s.what == csv::What::Channel(Kind::Joint) && s.name == *j)
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

/// `part / whole`; NaN if `whole` is zero.
pub(super) fn ratio(part: usize, whole: usize) -> f64 {
    part as f64 / whole as f64
}

/// Every estimate with the truth and the CAD's estimate from the same samples.
pub(super) struct Compared {
    /// The instant of the first estimate, the origin of the report's time.
    pub(super) first: Nanos,
    /// The start of the motion, and 10 s later.
    pub(super) moving: Nanos,
    pub(super) settled: Nanos,
    /// Per joint, per instant.
    pub(super) joints: Vec<Vec<Instant>>,
}

/// The torque of one joint at one instant.
#[derive(Clone, Copy)]
pub(super) struct Instant {
    pub(super) t: Nanos,
    pub(super) estimate: JointTorque,
    /// With the CAD alone, and the truth \[Nm\]; NaN where unknown.
    pub(super) cad: f64,
    pub(super) truth: f64,
}

impl Instant {
    pub(super) fn error(&self) -> f64 {
        self.estimate.torque - self.truth
    }
}

impl Compared {
    pub(super) fn new(watched: &Watched, truth: &Truth, still: f64) -> anyhow::Result<Self> {
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
                instants.push(Instant {
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

    /// The accuracy of the torques from `from` until before `until`; `None` if a joint has no
    /// torque to compare.
    pub(super) fn phase(&self, from: Nanos, until: Nanos) -> Option<Phase> {
        let (mut phase, mut count, mut valid, mut within, mut known) =
            (Phase::default(), 0, 0, 0, 0);
        for instants in &self.joints {
            let inside = instants
                .iter()
                .filter(|i| i.t >= from && i.t < until && i.truth.is_finite());
            let (mut cad, mut identified, mut size) =
                (Mean::default(), Mean::default(), Mean::default());
            for instant in inside {
                count += 1;
                valid += usize::from(instant.estimate.valid == 1);
                if instant.estimate.torque.is_finite() {
                    known += 1;
                    within += usize::from(
                        instant.error().abs() <= 2.0 * instant.estimate.standard_deviation,
                    );
                    identified.see(instant.error());
                    size.see(instant.truth);
                }
                if instant.cad.is_finite() {
                    cad.see(instant.cad - instant.truth);
                }
            }
            phase.identified.push(identified.rms()?);
            phase.cad.push(cad.rms().unwrap_or(f64::NAN));
            phase.size.push(size.rms()?);
        }
        (phase.valid_share, phase.within_2_sigma) = (ratio(valid, count), ratio(within, known));
        Some(phase)
    }
}

/// The root of a mean of squares.
#[derive(Default)]
struct Mean {
    sum: f64,
    count: u32,
}

impl Mean {
    fn see(&mut self, value: f64) {
        self.sum += value * value;
        self.count += 1;
    }

    fn rms(&self) -> Option<f64> {
        (self.count > 0).then(|| (self.sum / f64::from(self.count)).sqrt())
    }
}

/// The accuracy in a part of the run.
#[derive(Clone, Default)]
pub(super) struct Phase {
    /// Per joint, RMS errors and RMS torque \[Nm\].
    pub(super) cad: Vec<f64>,
    pub(super) identified: Vec<f64>,
    pub(super) size: Vec<f64>,
    pub(super) valid_share: f64,
    pub(super) within_2_sigma: f64,
}

impl Phase {
    pub(super) fn json(phase: Option<&Self>, names: &[String]) -> serde_json::Value {
        let Some(phase) = phase else {
            return serde_json::Value::Null;
        };
        let of = |values: &[f64]| -> serde_json::Map<_, _> {
            let named = names.iter().zip(values);
            named
                .map(|(name, value)| (name.clone(), json!(value)))
                .collect()
        };
        json!({
            "cad": of(&phase.cad), "identified": of(&phase.identified),
            "valid_share": phase.valid_share, "within_2_sigma": phase.within_2_sigma,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn instant(t: f64, torque: f64, valid: bool) -> Instant {
        Instant {
            t: Nanos::from_seconds(t),
            estimate: JointTorque {
                torque,
                standard_deviation: 0.5,
                valid: u32::from(valid),
                ..JointTorque::ABSENT
            },
            cad: 3.0,
            truth: 1.0,
        }
    }

    #[test]
    fn phases_are_told_apart_and_nothing_is_said_of_what_was_not() {
        // Before the motion the error is 2 Nm and the torque is withheld; in motion three of four
        // are right.
        let joint = vec![
            instant(1.0, 3.0, false),
            instant(2.0, -1.0, false),
            instant(5.0, 1.0, true),
            instant(6.0, 1.0, true),
            instant(7.0, 1.0, true),
            instant(8.0, 3.0, false),
        ];
        let compared = Compared {
            first: Nanos::ZERO,
            moving: Nanos::from_seconds(4.0),
            settled: Nanos::from_seconds(14.0),
            joints: vec![joint],
        };
        let before = compared.phase(Nanos::ZERO, compared.moving).unwrap();
        assert_eq!(
            (&before.identified[..], &before.cad[..]),
            (&[2.0][..], &[2.0][..])
        );
        assert_eq!((before.valid_share, before.within_2_sigma), (0.0, 0.0));
        let after = compared.phase(compared.moving, compared.settled).unwrap();
        assert_eq!(
            (after.identified[0], after.cad[0], after.size[0]),
            (1.0, 2.0, 1.0)
        );
        assert_eq!((after.valid_share, after.within_2_sigma), (0.75, 0.75));
        assert!(compared.phase(compared.settled, Nanos::MAX).is_none());
        assert_eq!(Phase::json(None, &[]), serde_json::Value::Null);
    }
}
