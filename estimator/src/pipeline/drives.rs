//! Compares the estimated torques with those that the joints' drives report ([`crate::drive`]). No
//! estimate depends on it.

use crate::drive::{DriveModel, DriveRow};
use crate::history::History;
use crate::setup::Setup;
use proprio_dynamics::{Dependence, JointState};
use proprio_identification::Robot;
use proprio_identification::robot::ChannelRole;
use proprio_topics::{
    Agreement, Candidate, Code, DriveEstimate, DriveTorque, JointTorque, NO_CAUSE, NO_GROUP, Name,
    NamedCandidate, Nanos, Quality, Reason,
};

/// Time constant of the smoothed difference \[s\]: less than the half second in which a person or a
/// monitor expects to hear of it, and longer than the jitter of a drive's report.
const SMOOTHING: f64 = 0.1;

/// How many deviations the smoothed difference of a joint may have. A normal variable with one
/// independent value in each time constant exceeds it once in an hour: `erfc(z / sqrt 2) = 0.1 s /
/// 3600 s`.
const DISAGREEMENT: f64 = 4.2;

/// A disagreement ends at half of it.
const AGREEMENT: f64 = 0.5 * DISAGREEMENT;

/// Time constant of a drive's ratio \[s\]: that of a motion.
const RATIO: f64 = 2.0;

/// How many reports of a drive are kept: as many as come while an estimate waits.
const KEPT: usize = 256;

/// The drives of all joints.
pub(super) struct Drives {
    /// Per degree of freedom, if its reports are kept.
    watched: Vec<Option<Watched>>,
    estimate: DriveEstimate,
}

struct Watched {
    /// The number of the joint's channel; beyond all others if it is locked.
    channel: usize,
    /// Torque and current.
    reports: History<2, KEPT>,
    /// None while it is to be identified.
    drive: Option<DriveModel>,
    comparison: Comparison,
}

impl Watched {
    /// The joint's channel, as the cause of a reason.
    fn number(&self) -> u32 {
        u32::try_from(self.channel).unwrap_or(NO_CAUSE)
    }

    /// Whether a report has what is needed.
    fn wants(&self, report: [f64; 2]) -> bool {
        match &self.drive {
            Some(drive) => drive.signal.of(report).is_finite(),
            None => report.iter().any(|value| value.is_finite()),
        }
    }
}

/// The difference between both torques so far.
#[derive(Clone, Copy, Default)]
struct Comparison {
    /// The instant of the last comparison.
    last: Option<Nanos>,
    /// The smoothed difference, in deviations.
    deviate: f64,
    disagrees: bool,
    /// Smoothed products `m^2` and `m d` of the motor's torque `m = K s` and the difference `d`, of
    /// this disagreement.
    moments: [f64; 2],
}

impl Comparison {
    /// Takes a motor's torque, the difference of the drive's torque to that of the F/T sensors, and
    /// the deviation of the difference.
    fn update(&mut self, t: Nanos, motor: f64, difference: f64, deviation: f64) {
        let since = self.last.map_or(f64::INFINITY, |last| (t - last).seconds());
        // After a gap, what was before does not count.
        let since = if since > RATIO { f64::INFINITY } else { since };
        let part = |constant: f64| 1.0 - (-since / constant).exp();
        if since.is_finite() {
            self.deviate += part(SMOOTHING) * (difference / deviation - self.deviate);
        } else {
            // One instant is no disagreement yet.
            *self = Self::default();
        }
        let most = if self.disagrees {
            AGREEMENT
        } else {
            DISAGREEMENT
        };
        let before = std::mem::replace(&mut self.disagrees, self.deviate.abs() > most);
        // Of this disagreement alone: its beginning is a step in both.
        let part = if before { part(RATIO) } else { 1.0 };
        let now = [motor * motor, motor * difference];
        for (moment, now) in self.moments.iter_mut().zip(now) {
            *moment += part * (now - *moment);
        }
        self.last = Some(t);
    }

    /// What the drive reports by what it should, by least squares, if only that is wrong: with `r`
    /// times the report `s`, the difference is `(1 - 1/r) K s`. NaN if they agree.
    fn ratio(&self) -> f64 {
        match self.disagrees {
            true => 1.0 / (1.0 - self.moments[1] / self.moments[0]),
            false => f64::NAN,
        }
    }

    fn agreement(&self) -> Code<Agreement> {
        match self.disagrees {
            true => Agreement::Disagrees.in_memory(),
            false => Agreement::Agrees.in_memory(),
        }
    }
}

impl Drives {
    /// None if there is nothing to compare, and nothing to learn.
    pub(super) fn new(setup: &Setup) -> Option<Box<Self>> {
        if setup.drives.is_empty() && !setup.learns_drives {
            return None;
        }
        let robot = &setup.robot;
        let watched = (0..robot.model.dof_count()).map(|dof| {
            let mut channels = robot.channels.iter();
            let channel = channels.position(|own| own.role == ChannelRole::Joint(dof));
            let joint = robot.model.dof_name(dof);
            let drive = setup.drives.iter().find(|drive| drive.joint == joint);
            (drive.is_some() || setup.learns_drives).then(|| Watched {
                channel: channel.unwrap_or(usize::MAX),
                reports: History::default(),
                drive: drive.cloned(),
                comparison: Comparison::default(),
            })
        });
        Some(Box::new(Self {
            watched: watched.collect(),
            estimate: DriveEstimate::new(),
        }))
    }

    /// Takes the report of a joint's drive; a value that it does not report is NaN.
    pub(super) fn push(&mut self, dof: usize, t: Nanos, report: [f64; 2], quality: Quality) {
        if let Some(Some(own)) = self.watched.get_mut(dof)
            && own.wants(report)
            && own.reports.newest().is_none_or(|newest| t > newest)
        {
            own.reports.push(t, report, quality);
        }
    }

    /// The drives' torques at the last estimate, and whether they agree with it.
    pub(super) fn estimate(&self) -> &DriveEstimate {
        &self.estimate
    }

    /// What joints and drives do, per degree of freedom whose torque is valid and whose drive
    /// reports something.
    pub(super) fn rows(&self, at: DriveInstant<'_>) -> impl Iterator<Item = (usize, DriveRow)> {
        let joints = at.joints().filter(|(_, torque)| torque.valid == 1);
        joints.filter_map(move |(dof, torque)| {
            let watched = self.watched.get(dof)?.as_ref()?;
            let [velocity, acceleration] = at.motion(dof);
            let row = DriveRow {
                t: at.t,
                report: at.report(watched).ok()?,
                torque: torque.torque,
                deviation: torque.standard_deviation,
                velocity,
                acceleration,
            };
            Some((dof, row))
        })
    }

    /// Compares the torques of an estimate with what the drives report.
    pub(super) fn compare(&mut self, at: &DriveInstant<'_>, dependences: &[Dependence]) {
        let out = &mut self.estimate;
        (out.count, out.candidate_count) = (0, 0);
        out.header.acquired = at.t;
        let mut any_disagrees = false;
        for (joint, (dof, torque)) in at.joints().enumerate() {
            let Some(Some(own)) = self.watched.get_mut(dof) else {
                continue;
            };
            let Some(drive) = &own.drive else { continue };
            let Some(slot) = out.drives.get_mut(out.count as usize) else {
                break;
            };
            out.count += 1;
            *slot = DriveTorque {
                joint: u32::try_from(joint).unwrap_or(u32::MAX),
                ..DriveTorque::ABSENT
            };
            let (reason, cause) = match at.report(own) {
                Ok(report) => {
                    let [velocity, acceleration] = at.motion(dof);
                    let signal = drive.signal.of(report);
                    let (by_drive, [variance, inherited]) =
                        drive.torque(signal, velocity, acceleration);
                    slot.torque = by_drive;
                    slot.standard_deviation = (variance + inherited).sqrt();
                    match torque.valid {
                        1 if by_drive.is_finite() => {
                            let difference = by_drive - torque.torque;
                            let deviation = (variance + torque.standard_deviation.powi(2)).sqrt();
                            let comparison = &mut own.comparison;
                            comparison.update(
                                at.t,
                                drive.parameters[0] * signal,
                                difference,
                                deviation,
                            );
                            slot.deviate = comparison.deviate;
                            slot.ratio = comparison.ratio();
                            slot.agreement = comparison.agreement();
                            any_disagrees |= comparison.disagrees;
                            (Reason::None, NO_CAUSE)
                        }
                        1 => (Reason::NotFinite, own.number()),
                        _ => (torque.reason.get().unwrap_or_default(), torque.cause),
                    }
                }
                Err(reason) => (reason, own.number()),
            };
            slot.reason = reason.in_memory();
            slot.cause = cause;
        }
        if any_disagrees {
            self.name_candidates(at, dependences);
        }
    }

    /// Names what may have caused the disagreements: for the joints of each sub-tree together, what
    /// the torques of all of them rest on, then their drives. A joint that agrees clears nothing: a
    /// force may pass through its axis.
    fn name_candidates(&mut self, at: &DriveInstant<'_>, dependences: &[Dependence]) {
        let (model, structure) = (&at.robot.model, &at.robot.structure);
        let DriveEstimate {
            count,
            candidate_count,
            drives,
            candidates,
            ..
        } = &mut self.estimate;
        let mut add = |kind: Candidate, name: &str, joint: u32| {
            if let Some(slot) = candidates.get_mut(*candidate_count as usize) {
                *slot = NamedCandidate {
                    name: Name::new(name).unwrap_or(Name::EMPTY),
                    kind: kind.in_memory(),
                    joint,
                };
                *candidate_count += 1;
            }
        };
        let dof_of = |own: &DriveTorque| at.robot.published().nth(own.joint as usize);
        let subtree_of = |dof: usize| structure.subtree_of(structure.link_of(dof)?);
        let drives = drives.get_mut(..*count as usize).unwrap_or_default();
        for first in 0..drives.len() {
            let (_, rest) = drives.split_at_mut(first);
            let Some(leader) = rest.first().filter(|own| is_ungrouped(own)).copied() else {
                continue;
            };
            let Some(leading) = dof_of(&leader) else {
                continue;
            };
            let mut common = dependences.get(leading).copied().unwrap_or_default();
            for own in rest.iter_mut().filter(|own| is_ungrouped(own)) {
                let Some(dof) = dof_of(own) else { continue };
                if subtree_of(dof) != subtree_of(leading) {
                    continue;
                }
                own.group = leader.joint;
                if let Some(own) = dependences.get(dof) {
                    common.links = common.links.intersection(&own.links);
                    common.sensors = common.sensors.intersection(&own.sensors);
                }
            }
            for link in common.links.iter() {
                add(Candidate::Contact, model.link_name(link), leader.joint);
            }
            for channel in &at.robot.channels {
                if let ChannelRole::Sensor(sensor) = channel.role
                    && common.sensors.contains(sensor)
                {
                    add(Candidate::Sensor, &channel.name, leader.joint);
                }
            }
            let drives = rest.iter().filter(|own| own.group == leader.joint);
            for dof in drives.filter_map(dof_of) {
                add(Candidate::Drive, model.dof_name(dof), leader.joint);
            }
        }
    }
}

/// Whether this is a disagreement without candidates yet.
fn is_ungrouped(own: &DriveTorque) -> bool {
    own.agreement == Agreement::Disagrees && own.group == NO_GROUP
}

/// An estimate, and what it was made from.
#[derive(Clone, Copy)]
pub(super) struct DriveInstant<'a> {
    pub(super) t: Nanos,
    /// Reports up to this stamp count.
    pub(super) until: Nanos,
    pub(super) robot: &'a Robot,
    pub(super) torques: &'a [JointTorque],
    /// Of all joints.
    pub(super) state: JointState<'a>,
    /// Per channel, why its value is not valid.
    pub(super) faults: &'a [Reason],
}

impl<'a> DriveInstant<'a> {
    /// The degrees of freedom of the joints, and their torques.
    fn joints(self) -> impl Iterator<Item = (usize, &'a JointTorque)> {
        self.robot.published().zip(self.torques)
    }

    fn motion(&self, dof: usize) -> [f64; 2] {
        [self.state.velocity, self.state.acceleration]
            .map(|values| values.get(dof).copied().unwrap_or(f64::NAN))
    }

    /// What the drive of a joint reports; or why that, or the joint's motion, is not known.
    fn report(&self, own: &Watched) -> Result<[f64; 2], Reason> {
        let fault = self.faults.get(own.channel);
        if let Some(fault) = fault.filter(|fault| **fault != Reason::None) {
            return Err(*fault);
        }
        match own.reports.at(self.t, self.until) {
            None => Err(Reason::NeverSeen),
            Some(held) if held.age > self.robot.max_silence => Err(Reason::Stale),
            Some(held) if held.quality.intersects(Quality::DRIVE_FAULT) => Err(Reason::DeviceFault),
            Some(held) => Ok(held.value),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The comparison at 1 kHz, with a difference for each millisecond.
    fn compared(difference: impl Fn(i32) -> f64, milliseconds: i32) -> (Comparison, Option<i32>) {
        let (mut comparison, mut first) = (Comparison::default(), None);
        for ms in 0..milliseconds {
            let t = Nanos::from_millis(i64::from(ms));
            comparison.update(t, 8.0, difference(ms), 1.0);
            if comparison.disagrees {
                first.get_or_insert(ms);
            }
        }
        (comparison, first)
    }

    #[test]
    fn ten_deviations_are_found_in_a_twentieth_of_a_second() {
        let (_, first) = compared(|ms| if ms < 500 { 0.0 } else { 10.0 }, 1000);
        // 10 (1 - exp(-t / 0.1)) = 4.2
        assert_eq!(first, Some(554));
        // Four never are; and a single one is not a disagreement, whatever it is.
        assert_eq!(compared(|_| 4.0, 5000).1, None);
        assert_eq!(
            compared(|ms| if ms == 500 { 100.0 } else { 0.0 }, 1000).1,
            None
        );
    }

    #[test]
    fn a_disagreement_ends_and_a_gap_ends_it() {
        let (mut comparison, _) = compared(|ms| if ms < 500 { 10.0 } else { 0.0 }, 600);
        assert!(comparison.disagrees, "2.1 deviations are not reached yet");
        comparison.update(Nanos::from_millis(800), 8.0, 0.0, 1.0);
        assert!(!comparison.disagrees);
        let (mut comparison, _) = compared(|_| 10.0, 500);
        comparison.update(Nanos::from_millis(3000), 8.0, 10.0, 1.0);
        assert!(!comparison.disagrees && comparison.deviate == 0.0);
    }

    /// Twice the report of a motor of 4 Nm is 8 Nm, and the difference 4 Nm.
    #[test]
    fn the_ratio_is_that_of_the_report() {
        let (comparison, _) = compared(|_| 4.3, 5000);
        assert!((comparison.ratio() - 8.0 / (8.0 - 4.3)).abs() < 1e-9);
        assert!(compared(|_| 1.0, 500).0.ratio().is_nan());
    }
}
